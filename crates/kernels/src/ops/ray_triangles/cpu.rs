//! Traversal, nearest child first; boxes and triangles are tested eight at a time.

use super::{Bvh, Hit, LEAF, Node, Packet, Ray, WIDTH};
use crate::tasks::{self, Parts};
use crate::vector::vectorized;

/// Rays per task.
const BLOCK: usize = 256;
/// Rounding of the distances of boxes, upwards (Ize 2013).
const WIDER: f32 = 1.000_000_4;
/// Smallest component of a direction that divides.
const TINY: f32 = 1e-30;

/// A node or packet to visit, and the distance of its box.
type Entry = (u32, f32);

/// What the tests of a ray share.
struct Prepared {
    origin: [f32; 3],
    inverse: [f32; 3],
    /// Per axis, which of a box's planes is met first: 0 the lowest, 1 the highest.
    first: [usize; 3],
    /// Axes in the order in which the direction's largest is last, and the shear that turns it into that axis.
    axes: [usize; 3],
    shear: [f32; 3],
}

impl Prepared {
    #[inline(always)]
    fn new(ray: &Ray) -> Prepared {
        let d = ray.direction;
        let inverse = d.map(|d| 1.0 / if d.abs() < TINY { TINY.copysign(d) } else { d });
        let size = d.map(f32::abs);
        let z = if size[0] > size[1] && size[0] > size[2] {
            0
        } else if size[1] > size[2] {
            1
        } else {
            2
        };
        let (mut x, mut y) = ((z + 1) % 3, (z + 2) % 3);
        if d[z] < 0.0 {
            (x, y) = (y, x);
        }
        Prepared {
            origin: ray.origin,
            inverse,
            first: inverse.map(|i| (i < 0.0) as usize),
            axes: [x, y, z],
            shear: [d[x] / d[z], d[y] / d[z], 1.0 / d[z]],
        }
    }

    /// Distances at which the ray enters the boxes of a node, and whether it meets them.
    #[inline(always)]
    fn boxes(&self, node: &Node, range: [f32; 2]) -> ([f32; WIDTH], [bool; WIDTH]) {
        let (mut near, mut far) = ([range[0]; WIDTH], [range[1]; WIDTH]);
        for axis in 0..3 {
            let (enter, leave) = (&node.bounds[axis][self.first[axis]], &node.bounds[axis][1 - self.first[axis]]);
            for i in 0..WIDTH {
                let a = (enter[i] - self.origin[axis]) * self.inverse[axis];
                let b = (leave[i] - self.origin[axis]) * self.inverse[axis] * WIDER;
                near[i] = if a > near[i] { a } else { near[i] };
                far[i] = if b < far[i] { b } else { far[i] };
            }
        }
        (near, std::array::from_fn(|i| near[i] <= far[i]))
    }

    /// Nearest hit of a packet within a range.
    #[inline(always)]
    fn triangles(&self, packet: &Packet, range: [f32; 2], best: &mut Hit) {
        let [x, y, z] = self.axes;
        let (mut px, mut py, mut pz) = ([[0.0f32; WIDTH]; 3], [[0.0f32; WIDTH]; 3], [[0.0f32; WIDTH]; 3]);
        for corner in 0..3 {
            let p = &packet.corners[corner];
            for i in 0..WIDTH {
                let depth = p[z][i] - self.origin[z];
                px[corner][i] = p[x][i] - self.origin[x] - self.shear[0] * depth;
                py[corner][i] = p[y][i] - self.origin[y] - self.shear[1] * depth;
                pz[corner][i] = self.shear[2] * depth;
            }
        }
        // Twice the areas that the ray's point spans with the edges. An edge's area is the negative of its neighbor's, to the last bit.
        let mut hits = [(f32::INFINITY, 0.0f32, 0.0f32); WIDTH];
        for i in 0..WIDTH {
            let a = px[2][i] * py[1][i] - py[2][i] * px[1][i];
            let b = px[0][i] * py[2][i] - py[0][i] * px[2][i];
            let c = px[1][i] * py[0][i] - py[1][i] * px[0][i];
            let sum = a + b + c;
            let t = (a * pz[0][i] + b * pz[1][i] + c * pz[2][i]) / sum;
            let same = (a >= 0.0) & (b >= 0.0) & (c >= 0.0) | (a <= 0.0) & (b <= 0.0) & (c <= 0.0);
            let inside = same & (sum != 0.0) & (t > range[0]) & (t < range[1]);
            hits[i] = (if inside { t } else { f32::INFINITY }, b / sum, c / sum);
        }
        for (i, (t, u, v)) in hits.into_iter().enumerate() {
            // Of triangles at one distance the first counts, in whatever order packets are met.
            if t < best.t || t == best.t && t < f32::INFINITY && packet.ids[i] < best.triangle {
                *best = Hit { t, triangle: packet.ids[i], weights: [u, v] };
            }
        }
    }
}

impl Bvh {
    #[inline(always)]
    fn trace(&self, ray: &Ray, any: bool, stack: &mut Vec<Entry>) -> Hit {
        let (prepared, mut best) = (Prepared::new(ray), Hit::NONE);
        stack.clear();
        if !self.nodes.is_empty() {
            stack.push((0, ray.range[0]));
        }
        while let Some((content, distance)) = stack.pop() {
            if distance > best.t {
                continue;
            }
            if content & LEAF != 0 {
                prepared.triangles(&self.packets[(content & !LEAF) as usize], ray.range, &mut best);
                if any && best.is_some() {
                    return best;
                }
                continue;
            }
            let node = &self.nodes[content as usize];
            let (near, met) = prepared.boxes(node, [ray.range[0], ray.range[1].min(best.t)]);
            let first = stack.len();
            for i in 0..WIDTH {
                if met[i] {
                    // Sorted, the farthest at the bottom.
                    let mut at = stack.len();
                    stack.push((node.content[i], near[i]));
                    while at > first && stack[at - 1].1 < near[i] {
                        stack.swap(at - 1, at);
                        at -= 1;
                    }
                }
            }
        }
        best
    }
}

vectorized! {
    fn trace_block<const F>(bvh: &Bvh, rays: &[Ray], any: bool, hits: &mut [Hit]) {
        let mut stack = Vec::with_capacity(128);
        for (ray, hit) in rays.iter().zip(hits) {
            *hit = bvh.trace(ray, any, &mut stack);
        }
    }
}

/// Nearest hit of each ray, or [`Hit::NONE`]; of triangles at the same distance the one of the lowest index.
pub fn nearest(bvh: &Bvh, rays: &[Ray], hits: &mut [Hit]) {
    run(bvh, rays, false, hits);
}

/// Some hit of each ray, or [`Hit::NONE`] if nothing is in its way.
pub fn any(bvh: &Bvh, rays: &[Ray], hits: &mut [Hit]) {
    run(bvh, rays, true, hits);
}

fn run(bvh: &Bvh, rays: &[Ray], any: bool, hits: &mut [Hit]) {
    assert_eq!(rays.len(), hits.len(), "ray_triangles: shapes");
    let parts = Parts::new(hits);
    tasks::run(rays.len().div_ceil(BLOCK), 64 * rays.len(), |i| {
        // SAFETY: each task has a chunk of its own.
        let hits = unsafe { parts.chunk(i, BLOCK) };
        trace_block(bvh, &rays[i * BLOCK..i * BLOCK + hits.len()], any, hits);
    });
}
