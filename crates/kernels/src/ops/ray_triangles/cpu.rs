//! Traversal, nearest child first; boxes and triangles are tested eight at a time.

use super::octet::{self, Entry, Octet, entry, ordered};
use super::{Bvh, Hit, LEAF, Node, Packet, Ray, WIDTH};
use crate::simd::{self, Level};
use crate::tasks::{self, Parts};
use std::mem::MaybeUninit;

/// Rays per task.
const BLOCK: usize = 256;
/// Rounding of the distances of boxes, upwards (Ize 2013).
pub(in crate::ops) const WIDER: f32 = 1.000_000_4;
/// Smallest component of a direction that divides.
const TINY: f32 = 1e-30;

/// Rays that take their steps in turns.
const AT_ONCE: usize = 4;
/// Entries at most: seven for each level of the deepest tree, which has 40 levels by area and 28 by halves.
const DEEPEST: usize = 512;

/// What the tests of a ray share.
pub(super) struct Prepared {
    pub origin: [f32; 3],
    pub inverse: [f32; 3],
    /// Per axis, which of a box's planes is met first: 0 the lowest, 1 the highest.
    pub first: [usize; 3],
    /// Axes in the order in which the direction's largest is last, and the shear that turns it into that axis.
    axes: [usize; 3],
    shear: [f32; 3],
}

impl Prepared {
    #[inline(always)]
    pub fn new(ray: &Ray) -> Prepared {
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
            shear: [d[x] * inverse[z], d[y] * inverse[z], inverse[z]],
        }
    }

    /// Distances at which the ray enters the boxes of a node, and a bit for each that it meets.
    #[inline(always)]
    unsafe fn boxes<O: Octet>(&self, node: &Node, range: [f32; 2]) -> (O, u32) {
        // SAFETY: the caller guarantees the instruction set.
        unsafe {
            let (mut near, mut far) = (O::splat(range[0]), O::splat(range[1]));
            for axis in 0..3 {
                let bounds = &node.bounds[axis];
                let (origin, inverse) = (O::splat(self.origin[axis]), O::splat(self.inverse[axis]));
                let enter = O::load(&bounds[self.first[axis]]).sub(origin).mul(inverse);
                let leave = O::load(&bounds[1 - self.first[axis]]).sub(origin).mul(inverse).mul(O::splat(WIDER));
                (near, far) = (enter.max(near), leave.min(far));
            }
            (near, near.at_most(far))
        }
    }

    /// Nearest hit of a packet within a range.
    #[inline(always)]
    pub unsafe fn triangles<O: Octet>(&self, packet: &Packet, range: [f32; 2], best: &mut Hit) {
        // SAFETY: the caller guarantees the instruction set.
        unsafe {
            let [x, y, z] = self.axes;
            let zero = O::splat(0.0);
            let (mut px, mut py, mut pz) = ([zero; 3], [zero; 3], [zero; 3]);
            for corner in 0..3 {
                let p = &packet.corners[corner];
                let depth = O::load(&p[z]).sub(O::splat(self.origin[z]));
                px[corner] = O::load(&p[x]).sub(O::splat(self.origin[x])).sub(O::splat(self.shear[0]).mul(depth));
                py[corner] = O::load(&p[y]).sub(O::splat(self.origin[y])).sub(O::splat(self.shear[1]).mul(depth));
                pz[corner] = O::splat(self.shear[2]).mul(depth);
            }
            // Twice the areas that the ray's point spans with the edges. An edge's area is the negative of its neighbor's, to the last bit.
            let a = px[2].mul(py[1]).sub(py[2].mul(px[1]));
            let b = px[0].mul(py[2]).sub(py[0].mul(px[2]));
            let c = px[1].mul(py[0]).sub(py[1].mul(px[0]));
            let front = zero.at_most(a) & zero.at_most(b) & zero.at_most(c);
            let back = a.at_most(zero) & b.at_most(zero) & c.at_most(zero);
            let sum = a.add(b).add(c);
            let area = sum.below(zero) | zero.below(sum);
            if (front | back) & area == 0 {
                return;
            }
            let t = a.mul(pz[0]).add(b.mul(pz[1])).add(c.mul(pz[2])).div(sum);
            let inside = (front | back) & area & O::splat(range[0]).below(t) & t.below(O::splat(range[1])) & t.at_most(O::splat(best.t));
            let (mut distances, mut u, mut v) = ([0.0; WIDTH], [0.0; WIDTH], [0.0; WIDTH]);
            t.store(&mut distances);
            b.div(sum).store(&mut u);
            c.div(sum).store(&mut v);
            for i in each(inside) {
                // Of triangles at one distance the first counts, in whatever order packets are met.
                let (t, triangle) = (distances[i], packet.ids[i]);
                if t < best.t || t == best.t && triangle < best.triangle {
                    *best = Hit { t, triangle, weights: [u[i], v[i]] };
                }
            }
        }
    }
}

/// Positions of the bits that are set.
#[inline(always)]
fn each(mut bits: u32) -> impl Iterator<Item = usize> {
    std::iter::from_fn(move || {
        let i = bits.trailing_zeros() as usize;
        bits &= bits.wrapping_sub(1);
        (i < WIDTH).then_some(i)
    })
}

/// What a ray still has to visit.
struct Stack {
    entries: [MaybeUninit<Entry>; DEEPEST],
    size: usize,
}

impl Stack {
    #[inline(always)]
    fn new() -> Stack {
        Stack { entries: [const { MaybeUninit::uninit() }; DEEPEST], size: 0 }
    }

    /// Places for the next entries.
    #[inline(always)]
    fn room(&mut self) -> &mut [MaybeUninit<Entry>; WIDTH] {
        self.entries[self.size..].first_chunk_mut().expect("the deepest tree fits")
    }

    /// Pushes an entry below those from `first` on that are nearer.
    #[inline(always)]
    fn insert(&mut self, entry: Entry, first: usize) {
        let mut at = self.size;
        while at > first {
            // SAFETY: entries below `size` are written.
            let below = unsafe { self.entries[at - 1].assume_init() };
            if below >= entry {
                break;
            }
            self.entries[at].write(below);
            at -= 1;
        }
        self.entries[at].write(entry);
        self.size += 1;
    }

    /// The entry on top that is not farther than `most`.
    #[inline(always)]
    fn pop(&mut self, most: f32) -> Option<u32> {
        let most = ordered(most);
        while self.size > 0 {
            self.size -= 1;
            // SAFETY: entries below `size` are written.
            let entry = unsafe { self.entries[self.size].assume_init() };
            if (entry >> 32) as i32 <= most {
                return Some(entry as u32);
            }
        }
        None
    }
}

/// A ray on its way.
struct Way {
    /// Index among those that are traced.
    ray: usize,
    prepared: Prepared,
    range: [f32; 2],
    best: Hit,
    stack: Stack,
    /// The node or packet that it is at.
    at: u32,
}

impl Way {
    #[inline(always)]
    fn new(ray: &Ray, index: usize) -> Way {
        Way { ray: index, prepared: Prepared::new(ray), range: ray.range, best: Hit::NONE, stack: Stack::new(), at: 0 }
    }

    /// Begins with another ray.
    #[inline(always)]
    fn start(&mut self, ray: &Ray, index: usize) {
        (self.ray, self.prepared, self.range, self.best, self.at) = (index, Prepared::new(ray), ray.range, Hit::NONE, 0);
        self.stack.size = 0;
    }

    /// Goes to what is next on the stack; false if nothing is.
    #[inline(always)]
    fn pop(&mut self) -> bool {
        let next = self.stack.pop(self.best.t);
        self.at = next.unwrap_or(0);
        next.is_some()
    }

    /// Visits a node or packet; false if the ray is at its end.
    #[inline(always)]
    unsafe fn step<O: Octet, const ANY: bool>(&mut self, bvh: &Bvh) -> bool {
        if self.at & LEAF != 0 {
            // SAFETY: as the caller guarantees.
            unsafe { self.prepared.triangles::<O>(&bvh.packets[(self.at & !LEAF) as usize], self.range, &mut self.best) };
            return !(ANY && self.best.is_some()) && self.pop();
        }
        let node = &bvh.nodes[self.at as usize];
        // SAFETY: as the caller guarantees.
        let (near, met) = unsafe { self.prepared.boxes::<O>(node, [self.range[0], self.range[1].min(self.best.t)]) };
        if met == 0 {
            return self.pop();
        }
        if O::COMPRESSES {
            // SAFETY: as the caller guarantees.
            let nearest = unsafe { near.compress(met, &node.content, self.stack.room()) };
            self.stack.size += met.count_ones() as usize - 1;
            self.at = nearest as u32;
            return true;
        }
        if met & (met - 1) == 0 {
            self.at = node.content[met.trailing_zeros() as usize % WIDTH];
            return true;
        }
        let mut distances = [0.0; WIDTH];
        // SAFETY: as the caller guarantees.
        unsafe { near.store(&mut distances) };
        let first = self.stack.size;
        for i in each(met) {
            // Sorted, the farthest at the bottom.
            self.stack.insert(entry(distances[i], node.content[i]), first);
        }
        self.pop()
    }
}

impl Bvh {
    #[inline(always)]
    pub(super) unsafe fn trace<O: Octet, const ANY: bool>(&self, ray: &Ray) -> Hit {
        let mut way = Way::new(ray, 0);
        // SAFETY: as the caller guarantees.
        while !self.nodes.is_empty() && unsafe { way.step::<O, ANY>(self) } {}
        way.best
    }

    /// Rays take their steps in turns, so that the CPU works on one while another waits for what it has to know next.
    #[inline(always)]
    unsafe fn trace_block<O: Octet, const ANY: bool>(&self, rays: &[Ray], hits: &mut [Hit]) {
        if self.nodes.is_empty() {
            return hits.fill(Hit::NONE);
        }
        let mut rest = (0..).zip(rays);
        let mut ways: [Option<Way>; AT_ONCE] = std::array::from_fn(|_| rest.next().map(|(i, ray)| Way::new(ray, i)));
        let mut going = ways.iter().flatten().count();
        while going > 0 {
            for slot in &mut ways {
                let Some(way) = slot else { continue };
                // SAFETY: as the caller guarantees.
                if unsafe { way.step::<O, ANY>(self) } {
                    continue;
                }
                hits[way.ray] = way.best;
                match rest.next() {
                    Some((i, ray)) => way.start(ray, i),
                    None => {
                        *slot = None;
                        going -= 1;
                    }
                }
            }
        }
    }

    #[inline(always)]
    unsafe fn trace_either<O: Octet>(&self, rays: &[Ray], any: bool, hits: &mut [Hit]) {
        // SAFETY: as the caller guarantees.
        unsafe { if any { self.trace_block::<O, true>(rays, hits) } else { self.trace_block::<O, false>(rays, hits) } }
    }

    /// The nearest hit of each ray, or with `any` some hit; [`Hit::NONE`] if nothing is in its way.
    ///
    /// # Panics
    /// When there are more rays than hits, or fewer.
    pub fn trace_each(&self, rays: &[Ray], any: bool, hits: &mut [Hit]) {
        assert_eq!(rays.len(), hits.len(), "ray_triangles: shapes");
        // SAFETY: `level()` only names sets that this CPU has.
        match simd::level() {
            #[cfg(target_arch = "x86_64")]
            Level::Avx512 => unsafe { self.trace_block_avx512(rays, any, hits) },
            #[cfg(target_arch = "x86_64")]
            Level::Avx2 => unsafe { self.trace_block_avx2(rays, any, hits) },
            _ => unsafe { self.trace_either::<octet::Plain>(rays, any, hits) },
        }
    }

    /// The nearest hit of each ray, faster than [`Bvh::trace_each`] where neighbors among them start and point alike.
    ///
    /// # Panics
    /// When there are more rays than hits, or fewer.
    pub fn trace_neighbors(&self, rays: &[Ray], hits: &mut [Hit]) {
        assert_eq!(rays.len(), hits.len(), "ray_triangles: shapes");
        // SAFETY: `level()` only names sets that this CPU has.
        match simd::level() {
            #[cfg(target_arch = "x86_64")]
            Level::Avx512 => unsafe { self.trace_bundles_avx512(rays, hits) },
            #[cfg(target_arch = "x86_64")]
            Level::Avx2 => unsafe { self.trace_bundles_avx2(rays, hits) },
            _ => unsafe { self.trace_bundles::<octet::Plain>(rays, hits) },
        }
    }

    #[inline(always)]
    unsafe fn trace_bundles<O: Octet>(&self, rays: &[Ray], hits: &mut [Hit]) {
        let ((bundles, rest), (bundle_hits, rest_hits)) = (rays.as_chunks::<WIDTH>(), hits.as_chunks_mut::<WIDTH>());
        let mut stack = Vec::with_capacity(DEEPEST);
        for (rays, hits) in bundles.iter().zip(bundle_hits) {
            // SAFETY: as the caller guarantees.
            unsafe { self.trace_bundle::<O>(rays, &mut stack, hits) };
        }
        // SAFETY: as the caller guarantees.
        unsafe { self.trace_block::<O, false>(rest, rest_hits) };
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx512f,avx512dq,avx512bw,avx512vl,avx2")]
    unsafe fn trace_bundles_avx512(&self, rays: &[Ray], hits: &mut [Hit]) {
        // SAFETY: compiled for the set.
        unsafe { self.trace_bundles::<octet::Avx512>(rays, hits) }
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    unsafe fn trace_bundles_avx2(&self, rays: &[Ray], hits: &mut [Hit]) {
        // SAFETY: compiled for the set.
        unsafe { self.trace_bundles::<octet::Avx2>(rays, hits) }
    }

    /// The nearest hit of one ray, or with `any` some hit; [`Hit::NONE`] if nothing is in its way.
    pub fn trace_one(&self, ray: &Ray, any: bool) -> Hit {
        let mut hit = [Hit::NONE];
        self.trace_each(std::slice::from_ref(ray), any, &mut hit);
        hit[0]
    }

    /// Vectors of eight as well, but twice as many registers.
    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx512f,avx512dq,avx512bw,avx512vl,avx2")]
    unsafe fn trace_block_avx512(&self, rays: &[Ray], any: bool, hits: &mut [Hit]) {
        // SAFETY: compiled for the set.
        unsafe { self.trace_either::<octet::Avx512>(rays, any, hits) }
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    unsafe fn trace_block_avx2(&self, rays: &[Ray], any: bool, hits: &mut [Hit]) {
        // SAFETY: compiled for the set.
        unsafe { self.trace_either::<octet::Avx2>(rays, any, hits) }
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
        bvh.trace_each(&rays[i * BLOCK..i * BLOCK + hits.len()], any, hits);
    });
}
