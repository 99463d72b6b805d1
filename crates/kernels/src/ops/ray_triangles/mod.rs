//! Where rays hit triangles: the nearest hit, or whether there is any, through a bounding volume hierarchy.
//!
//! Triangles have two sides. Between the triangles of a closed surface no ray passes (Woop, Benthin and Wald 2013).

#[cfg(feature = "gpu")]
pub(crate) mod binary;
mod build;
mod bundle;
#[cfg(any(feature = "gpu", test))]
pub(crate) mod cases;
pub mod cpu;
#[cfg(feature = "gpu")]
pub mod gpu;
mod octet;
pub mod reference;
#[cfg(test)]
mod tests;

/// The part of a ray between two distances: `origin + t · direction` for `range[0] < t < range[1]`; the direction need not have length 1.
#[derive(Clone, Copy, Debug)]
pub struct Ray {
    pub origin: [f32; 3],
    pub direction: [f32; 3],
    pub range: [f32; 2],
}

/// A point of a triangle `a b c`: `(1 − u − v) a + u b + v c`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hit {
    /// Distance along the ray, in lengths of its direction.
    pub t: f32,
    /// Index of the triangle, or [`Hit::NONE`]'s.
    pub triangle: u32,
    /// `[u, v]`
    pub weights: [f32; 2],
}

impl Hit {
    /// No hit.
    pub const NONE: Hit = Hit { t: f32::INFINITY, triangle: u32::MAX, weights: [0.0; 2] };

    pub fn is_some(&self) -> bool {
        self.triangle != u32::MAX
    }
}

/// Children of a node, and triangles of a leaf.
const WIDTH: usize = 8;

/// A node: boxes and contents of up to eight children. Boxes of absent children are empty.
#[derive(Clone, Debug)]
#[repr(align(64))]
struct Node {
    /// Lowest and highest corner by axis, `[axis][lowest, highest][child]`.
    bounds: [[[f32; WIDTH]; 2]; 3],
    /// The node, or with [`LEAF`] set the packet of triangles.
    content: [u32; WIDTH],
}

/// Marks contents that are packets.
const LEAF: u32 = 1 << 31;

/// Up to eight triangles, `[corner][axis][triangle]`. Absent ones are not numbers, and never hit.
#[derive(Clone, Debug)]
#[repr(align(64))]
struct Packet {
    corners: [[[f32; WIDTH]; 3]; 3],
    ids: [u32; WIDTH],
}

/// A bounding volume hierarchy with eight children per node, built by the surface area heuristic in bins (Wald 2007).
#[derive(Clone, Debug)]
pub struct Bvh {
    nodes: Vec<Node>,
    packets: Vec<Packet>,
}
