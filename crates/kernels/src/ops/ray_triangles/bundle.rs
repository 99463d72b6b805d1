//! Rays that start and point alike, eight at a time: a box is tested against all of them at once, and where one of them goes, all go.

use super::cpu::{Prepared, WIDER};
use super::octet::Octet;
use super::{Bvh, Hit, LEAF, Node, Ray, WIDTH};

/// A node or packet to visit, and where each ray enters its box: infinitely far if it does not.
#[derive(Clone, Copy)]
pub(super) struct Entry {
    near: [f32; WIDTH],
    content: u32,
}

/// Eight rays, `[axis][ray]`.
struct Bundle {
    rays: [Prepared; WIDTH],
    ranges: [[f32; 2]; WIDTH],
    origin: [[f32; WIDTH]; 3],
    inverse: [[f32; WIDTH]; 3],
    first: [usize; 3],
    start: [f32; WIDTH],
    /// Beyond which no hit counts.
    end: [f32; WIDTH],
}

impl Bundle {
    /// None if rays differ in the signs of their directions.
    #[inline(always)]
    fn new(rays: &[Ray; WIDTH]) -> Option<Bundle> {
        let prepared: [Prepared; WIDTH] = std::array::from_fn(|i| Prepared::new(&rays[i]));
        let first = prepared[0].first;
        prepared.iter().all(|p| p.first == first).then(|| Bundle {
            ranges: rays.each_ref().map(|r| r.range),
            origin: std::array::from_fn(|axis| prepared.each_ref().map(|p| p.origin[axis])),
            inverse: std::array::from_fn(|axis| prepared.each_ref().map(|p| p.inverse[axis])),
            first,
            start: rays.each_ref().map(|r| r.range[0]),
            end: rays.each_ref().map(|r| r.range[1]),
            rays: prepared,
        })
    }

    /// Distances at which rays enter the box of a child, and a bit for each that meets it.
    #[inline(always)]
    unsafe fn child<O: Octet>(&self, node: &Node, child: usize) -> (O, u32) {
        // SAFETY: the caller guarantees the instruction set.
        unsafe {
            let (mut near, mut far) = (O::load(&self.start), O::load(&self.end));
            for axis in 0..3 {
                let bounds = &node.bounds[axis];
                let (origin, inverse) = (O::load(&self.origin[axis]), O::load(&self.inverse[axis]));
                let enter = O::splat(bounds[self.first[axis]][child]).sub(origin).mul(inverse);
                let leave = O::splat(bounds[1 - self.first[axis]][child]).sub(origin).mul(inverse).mul(O::splat(WIDER));
                (near, far) = (enter.max(near), leave.min(far));
            }
            (near, near.at_most(far))
        }
    }
}

impl Bvh {
    /// Nearest hits of eight rays, the same as those of each alone. `stack` is empty, and will be.
    #[inline(always)]
    pub(super) unsafe fn trace_bundle<O: Octet>(&self, rays: &[Ray; WIDTH], stack: &mut Vec<Entry>, hits: &mut [Hit; WIDTH]) {
        let Some(mut bundle) = Bundle::new(rays).filter(|_| !self.nodes.is_empty()) else {
            for (ray, hit) in rays.iter().zip(hits) {
                // SAFETY: as the caller guarantees.
                *hit = unsafe { self.trace::<O, false>(ray) };
            }
            return;
        };
        hits.fill(Hit::NONE);
        stack.push(Entry { near: bundle.start, content: 0 });
        while let Some(Entry { near, content }) = stack.pop() {
            // SAFETY: as the caller guarantees.
            let mut going = unsafe { O::load(&near).at_most(O::load(&bundle.end)) };
            if going == 0 {
                continue;
            }
            if content & LEAF != 0 {
                let packet = &self.packets[(content & !LEAF) as usize];
                while going != 0 {
                    let i = going.trailing_zeros() as usize % WIDTH;
                    going &= going - 1;
                    // SAFETY: as the caller guarantees.
                    unsafe { bundle.rays[i].triangles::<O>(packet, bundle.ranges[i], &mut hits[i]) };
                    bundle.end[i] = bundle.ranges[i][1].min(hits[i].t);
                }
                continue;
            }
            let node = &self.nodes[content as usize];
            let first = stack.len();
            // Absent children are the last.
            let children = (0..WIDTH).take_while(|child| node.bounds[0][0][*child] <= node.bounds[0][1][*child]);
            for child in children {
                // SAFETY: as the caller guarantees.
                let (distances, met) = unsafe { bundle.child::<O>(node, child) };
                if met == 0 {
                    continue;
                }
                let mut entry = Entry { near: [0.0; WIDTH], content: node.content[child] };
                // SAFETY: as the caller guarantees.
                unsafe { distances.store(&mut entry.near) };
                (0..WIDTH).for_each(|i| entry.near[i] = if met >> i & 1 == 1 { entry.near[i] } else { f32::INFINITY });
                // Sorted by where one ray enters, the farthest at the bottom.
                stack.push(entry);
                let ray = met.trailing_zeros() as usize % WIDTH;
                let mut at = stack.len() - 1;
                while at > first && stack[at - 1].near[ray] < stack[at].near[ray] {
                    stack.swap(at - 1, at);
                    at -= 1;
                }
            }
        }
    }
}
