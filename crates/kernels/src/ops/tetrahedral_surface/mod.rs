//! Surface of a signed distance on the vertices of a deformable tetrahedral grid (Doi and Koide 1991; Shen et al. 2021, DMTet), with its
//! gradients.
//!
//! A vertex is inside where `s > 0`. A surface vertex lies where `s` crosses zero linearly along an edge,
//! `v = (v_a s_b − v_b s_a) / (s_b − s_a)`; a tetrahedron has 0, 1 or 2 triangles, counter-clockwise seen from outside. Each edge has a
//! static number, and the surface vertices are numbered in the order of their edges, so the result does not depend on threads.
//!
//! With `t = s_a / (s_a − s_b)`, `∂v/∂s_a = −(v_b − v_a) s_b / (s_a − s_b)²`, `∂v/∂s_b = (v_b − v_a) s_a / (s_a − s_b)²`,
//! `∂v/∂v_a = 1 − t`, `∂v/∂v_b = t`. One factor of the squared difference is at least [`MIN_GAP`], so gradients stay finite.

pub mod cpu;
pub mod reference;
#[cfg(test)]
pub(crate) mod tests;
mod topology;

pub use topology::Topology;

/// Smallest difference `|s_a − s_b|` by which gradients are divided twice.
pub const MIN_GAP: f32 = 1e-6;

/// Corners of the six edges of a tetrahedron.
pub const EDGES: [[usize; 2]; 6] = [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]];

/// Edges of the triangles of each of the 16 sets of inside corners, of a tetrahedron with positive volume.
pub fn case_table() -> [Vec<[u8; 3]>; 16] {
    let places = [[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
    let edge = |ends: [usize; 2]| EDGES.iter().position(|e| *e == ends || *e == [ends[1], ends[0]]).expect("an edge") as u8;
    std::array::from_fn(|case| {
        let inside = std::array::from_fn(|k| case >> k & 1 == 1);
        super::marching_tetrahedra::cut(places, inside).into_iter().map(|t| t.map(edge)).collect()
    })
}

/// An extracted surface, and what its gradients need. Buffers are kept between extractions.
#[derive(Clone, Debug, Default)]
pub struct Surface {
    /// `[N, 3]`.
    pub positions: Vec<[f32; 3]>,
    pub faces: Vec<[u32; 3]>,
    /// Edge of the grid on which each surface vertex lies, ascending `[N]`.
    pub cut_edges: Vec<u32>,
    /// Grid vertices at the ends of those edges, ascending.
    pub active: Vec<u32>,
    /// Whether each grid vertex is inside `[V]`.
    inside: Vec<bool>,
    /// Surface vertex of each edge `[E]`; valid for cut edges only.
    vertex_of_edge: Vec<u32>,
}

impl Surface {
    /// Whether a grid vertex is inside.
    pub fn is_inside(&self, vertex: usize) -> bool {
        self.inside[vertex]
    }

    /// Area of all triangles, in squared units of the grid.
    pub fn area(&self) -> f64 {
        use diorama_geom::mesh::{cross, sub};
        let of = |f: &[u32; 3]| {
            let [a, b, c] = f.map(|i| self.positions[i as usize]);
            let n = cross(sub(b, a), sub(c, a)).map(f64::from);
            0.5 * (n[0] * n[0] + n[1] * n[1] + n[2] * n[2]).sqrt()
        };
        self.faces.iter().map(of).sum()
    }
}
