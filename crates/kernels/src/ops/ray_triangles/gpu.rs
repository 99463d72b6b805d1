//! One unit per ray, on the CPU's hierarchy with two children per node; a unit keeps the nodes that it still has to visit on a stack of
//! its own.

use super::binary::{Child, Forest, LEAF, NODE, NOTHING, PLACED, TRIANGLE};
use super::{Bvh, Hit, Ray};
use crate::gpu::vector::{V3, float, read, transform_direction, transform_point};
use crate::gpu::{Buffer, Gpu, GpuError, launch};
use cubecl::prelude::*;

/// Words before the nodes: where triangles and placed trees begin.
const HEADER: usize = 2;
/// Words of a placed tree: `mesh_from_world` and its root; `world_from_mesh` and the instance follow.
pub(crate) const PLACEMENT: usize = 26;
pub(crate) const PLACED_ROOT: usize = 12;
pub(crate) const WORLD_FROM_MESH: usize = 13;
pub(crate) const INSTANCE: usize = 25;
/// On a stack, the end of a placed tree.
const RETURN: u32 = LEAF - 1;
/// Distance that stands for infinity.
pub(crate) const FAR: f32 = 1e30;
/// Rounding of the distances of boxes, upwards (Ize 2013).
const WIDER: f32 = super::cpu::WIDER;
/// Smallest component of a direction that divides.
const TINY: f32 = 1e-20;
/// Stacks have a multiple of so many entries, so that few kernels are compiled.
const STACK: usize = 32;

/// A tree of all that rays may hit.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Tree {
    pub root: u32,
    /// Entries of a stack.
    pub stack: usize,
}

impl Tree {
    /// The tree below a child, if any, with placed trees of a depth.
    pub fn of(child: Option<&Child>, placed_depth: usize) -> Tree {
        let depth = child.map_or(0, |c| c.depth) + placed_depth + 2;
        Tree { root: child.map_or(NOTHING, |c| c.content), stack: depth.next_multiple_of(STACK) }
    }
}

/// Words of nodes, triangles and placed trees, as kernels read them.
pub(crate) fn words(forest: &Forest, placed: &[u32]) -> Vec<u32> {
    let triangles = HEADER + forest.nodes.len();
    let header = [triangles as u32, (triangles + forest.triangles.len()) as u32];
    [&header[..], &forest.nodes, &forest.triangles, placed].concat()
}

/// A hierarchy on the device.
pub struct GpuBvh {
    words: Buffer<u32>,
    tree: Tree,
}

impl GpuBvh {
    pub fn upload(gpu: &Gpu, bvh: &Bvh) -> GpuBvh {
        let mut forest = Forest::default();
        let root = forest.add(bvh, 0);
        GpuBvh { words: gpu.upload(&words(&forest, &[])), tree: Tree::of(root.as_ref(), 0) }
    }
}

/// Nearest hit of each ray, or with `any` some hit; [`Hit::NONE`] where nothing is in the way.
///
/// # Errors
/// When the device is lost.
pub fn trace(gpu: &Gpu, bvh: &GpuBvh, rays: &[Ray], any: bool) -> Result<Vec<Hit>, GpuError> {
    let n = rays.len();
    let numbers: Vec<f32> = rays.iter().flat_map(|r| [&r.origin[..], &r.direction, &r.range.map(|t| t.min(FAR))].concat()).collect();
    let (rays, hits) = (gpu.upload(&numbers), gpu.empty::<u32>(n * 4));
    launch!(
        gpu,
        trace_each,
        n,
        [bvh.words => bvh.words.len(), rays => n * 8, hits => n * 4],
        n as u32,
        bvh.tree.root,
        any as u32,
        bvh.tree.stack,
    );
    let words = gpu.read(&hits)?;
    let hit = |w: &[u32]| Hit { t: f32::from_bits(w[0]), triangle: w[1], weights: [f32::from_bits(w[2]), f32::from_bits(w[3])] };
    Ok(words.chunks_exact(4).map(hit).map(|h| if h.is_some() { h } else { Hit::NONE }).collect())
}

/// Where a ray meets a triangle, [`NOTHING`] if it meets none.
#[derive(CubeType, CubeTypeMut, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub(crate) struct Found {
    pub t: f32,
    pub u: f32,
    pub v: f32,
    pub triangle: u32,
    /// The placed tree, or [`NOTHING`] for what stands in the world.
    pub placed: u32,
}

/// What the tests of a ray share; see the CPU's `Prepared`.
#[derive(CubeType, CubeTypeMut, Clone, Copy)]
#[expand(derive(Clone, Copy))]
struct Prepared {
    origin: V3,
    inverse: V3,
    /// Axes in the order in which the direction's largest is last; the origin in this order, and the shear that turns the direction into
    /// the last axis.
    a: u32,
    b: u32,
    c: u32,
    sheared: V3,
    shear: V3,
}

#[cube]
fn axis(v: V3, k: u32) -> f32 {
    select(k == 0, v.x, select(k == 1, v.y, v.z))
}

#[cube]
fn inverse_of(d: f32) -> f32 {
    1.0 / select(d.abs() < TINY, select(d < 0.0, -TINY, TINY), d)
}

#[cube]
fn prepare(origin: V3, d: V3) -> Prepared {
    let inverse = V3 { x: inverse_of(d.x), y: inverse_of(d.y), z: inverse_of(d.z) };
    let is_x = d.x.abs() > d.y.abs() && d.x.abs() > d.z.abs();
    let c = select(is_x, 0u32, select(d.y.abs() > d.z.abs(), 1u32, 2u32));
    let next = (c + 1) % 3;
    let last = (c + 2) % 3;
    let is_behind = axis(d, c) < 0.0;
    let a = select(is_behind, last, next);
    let b = select(is_behind, next, last);
    let along = axis(inverse, c);
    let sheared = V3 { x: axis(origin, a), y: axis(origin, b), z: axis(origin, c) };
    let shear = V3 { x: axis(d, a) * along, y: axis(d, b) * along, z: along };
    Prepared { origin, inverse, a, b, c, sheared, shear }
}

/// Distance at which a ray enters the box whose corners begin at `at`, or [`FAR`] times 2 where it misses it.
#[cube]
fn enter(words: &[u32], at: usize, p: &Prepared, near: f32, far: f32) -> f32 {
    let low = read(words, at);
    let high = read(words, at + 3);
    let ax = (low.x - p.origin.x) * p.inverse.x;
    let bx = (high.x - p.origin.x) * p.inverse.x;
    let ay = (low.y - p.origin.y) * p.inverse.y;
    let by = (high.y - p.origin.y) * p.inverse.y;
    let az = (low.z - p.origin.z) * p.inverse.z;
    let bz = (high.z - p.origin.z) * p.inverse.z;
    let first = max(max(near, min(ax, bx)), max(min(ay, by), min(az, bz)));
    let last = min(min(max(ax, bx), max(ay, by)), max(az, bz)) * WIDER;
    select(first <= min(far, last), first, 2.0 * FAR)
}

/// `x y − z w` with a sign that is never wrong, so that neighbors agree about their edge (Kahan; Jeannerod et al. 2013).
#[cube]
fn difference(x: f32, y: f32, z: f32, w: f32) -> f32 {
    let product = z * w;
    let error = fma(-z, w, product);
    fma(x, y, -product) + error
}

/// A corner relative to the ray: sheared coordinates, and distance.
#[cube]
fn corner(words: &[u32], at: usize, p: &Prepared) -> V3 {
    let depth = float(words, at + p.c as usize) - p.sheared.z;
    V3 {
        x: fma(-p.shear.x, depth, float(words, at + p.a as usize) - p.sheared.x),
        y: fma(-p.shear.y, depth, float(words, at + p.b as usize) - p.sheared.y),
        z: p.shear.z * depth,
    }
}

/// Tests a triangle; of those at one distance the first counts.
#[cube]
fn meet(words: &[u32], at: usize, p: &Prepared, near: f32, placed: u32, best: &mut Found) {
    let i = corner(words, at, p);
    let j = corner(words, at + 3, p);
    let k = corner(words, at + 6, p);
    let a = difference(k.x, j.y, k.y, j.x);
    let b = difference(i.x, k.y, i.y, k.x);
    let c = difference(j.x, i.y, j.y, i.x);
    let sum = a + b + c;
    let is_met = (min(min(a, b), c) >= 0.0 || max(max(a, b), c) <= 0.0) && sum != 0.0;
    if is_met {
        let t = (a * i.z + b * j.z + c * k.z) / sum;
        let triangle = words[at + 9];
        if t > near && (t < best.t || (t == best.t && best.triangle != NOTHING && triangle < best.triangle)) {
            best.t = t;
            best.u = b / sum;
            best.v = c / sum;
            best.triangle = triangle;
            best.placed = placed;
        }
    }
}

/// The nearest hit below `root` between two distances, or with `any` = 1 some hit.
#[cube]
pub(crate) fn nearest(
    words: &[u32],
    root: u32,
    origin: V3,
    direction: V3,
    near: f32,
    far: f32,
    any: u32,
    #[comptime] stack: usize,
) -> Found {
    let triangles = words[0] as usize;
    let places = words[1] as usize;
    let mut open = Array::<u32>::new(stack);
    let mut size = 0u32;
    let mut at = root;
    let mut placed = NOTHING.runtime();
    let mut p = prepare(origin, direction);
    let mut best = Found { t: far, u: 0.0f32.runtime(), v: 0.0f32.runtime(), triangle: NOTHING.runtime(), placed: NOTHING.runtime() };
    while at != NOTHING {
        let mut pops = true.runtime();
        if at >= LEAF {
            let first = (at & (LEAF - 1)) >> 3;
            for i in 0..(at & 7) + 1 {
                meet(words, triangles + (first + i) as usize * TRIANGLE, &p, near, placed, &mut best);
            }
            if any == 1 && best.triangle != NOTHING {
                size = 0;
            }
        } else if at >= PLACED {
            let mut o = origin;
            let mut d = direction;
            placed = NOTHING.runtime();
            if at != RETURN {
                placed = at & (PLACED - 1);
                let place = places + placed as usize * PLACEMENT;
                o = transform_point(words, place, origin);
                d = transform_direction(words, place, direction);
                open[size as usize] = RETURN.runtime();
                size += 1;
                at = words[place + PLACED_ROOT];
                pops = false.runtime();
            }
            p = prepare(o, d);
        } else {
            let node = HEADER + at as usize * NODE;
            let left = enter(words, node, &p, near, best.t);
            let right = enter(words, node + 6, &p, near, best.t);
            let is_first = left <= right;
            if min(left, right) <= FAR {
                let one = words[node + 12];
                let two = words[node + 13];
                at = select(is_first, one, two);
                pops = false.runtime();
                if max(left, right) <= FAR {
                    open[size as usize] = select(is_first, two, one);
                    size += 1;
                }
            }
        }
        if pops {
            at = NOTHING.runtime();
            if size > 0 {
                size -= 1;
                at = open[size as usize];
            }
        }
    }
    best
}

#[cube(launch_unchecked)]
fn trace_each(words: &[u32], rays: &[f32], hits: &mut [u32], n: u32, root: u32, any: u32, #[comptime] stack: usize) {
    let r = ABSOLUTE_POS;
    if r >= n as usize {
        terminate!();
    }
    let at = r * 8;
    let origin = V3 { x: rays[at], y: rays[at + 1], z: rays[at + 2] };
    let direction = V3 { x: rays[at + 3], y: rays[at + 4], z: rays[at + 5] };
    let found = nearest(words, root, origin, direction, rays[at + 6], rays[at + 7], any, stack);
    hits[r * 4] = u32::reinterpret(found.t);
    hits[r * 4 + 1] = found.triangle;
    hits[r * 4 + 2] = u32::reinterpret(found.u);
    hits[r * 4 + 3] = u32::reinterpret(found.v);
}
