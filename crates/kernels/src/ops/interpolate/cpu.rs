//! Runs of pixels that show one triangle: its corners are read once per run, and its gradients added up before they are scattered.

use super::Interpolate;
use crate::ops::rasterize::check_triangles;
use crate::partials;
use crate::tasks::{self, Parts};
use crate::vector::{fma, vectorized};

/// Pixels per task.
const BLOCK: usize = 4096;
/// Attributes that are interpolated at a time, at most.
const WIDTH: usize = 8;

/// Which attributes of how many, and the triangles that name them.
#[derive(Clone, Copy)]
struct Columns<'a> {
    attributes: &'a [f32],
    triangles: &'a [[u32; 3]],
    stride: usize,
    first: usize,
}

impl Columns<'_> {
    /// Attributes `c` of a triangle, and the differences `a − c` and `b − c`.
    #[inline(always)]
    fn load<const A: usize>(&self, id: u32) -> [[f32; A]; 3] {
        let Some(triangle) = id.checked_sub(1) else { return [[0.0; A]; 3] };
        let at = |corner: usize| -> [f32; A] {
            let start = self.triangles[triangle as usize][corner] as usize * self.stride + self.first;
            let row = &self.attributes[start..start + A];
            std::array::from_fn(|k| row[k])
        };
        let (a, b, c) = (at(0), at(1), at(2));
        [c, std::array::from_fn(|k| a[k] - c[k]), std::array::from_fn(|k| b[k] - c[k])]
    }
}

/// Length of the run of equal numbers at the beginning.
#[inline(always)]
fn run_length(ids: &[u32]) -> usize {
    ids.iter().take_while(|id| **id == ids[0]).count()
}

#[inline(always)]
fn blend<const F: bool, const A: usize>(c: &Columns, ids: &[u32], uv: &[f32], out: &mut [f32]) {
    let (mut last, mut at) = (0, [[0.0; A]; 3]);
    let pixels = ids.iter().zip(uv.as_chunks::<2>().0).zip(out.chunks_exact_mut(c.stride));
    for ((id, [u, v]), out) in pixels {
        if *id != last {
            last = *id;
            at = c.load::<A>(last);
        }
        let out = &mut out[c.first..c.first + A];
        for k in 0..A {
            out[k] = fma::<F>(*u, at[1][k], fma::<F>(*v, at[2][k], at[0][k]));
        }
    }
}

/// Adds gradients of attributes to `d_attributes` and those of barycentrics to `d_uv`.
#[inline(always)]
fn spread<const F: bool, const A: usize>(c: &Columns, ids: &[u32], uv: &[f32], d_out: &[f32], d_uv: &mut [f32], to: &mut [f32]) {
    let mut start = 0;
    while start < ids.len() {
        let run = start..start + run_length(&ids[start..]);
        start = run.end;
        let id = ids[run.start];
        if id == 0 {
            continue;
        }
        let [_, along_u, along_v] = c.load::<A>(id);
        let mut sums = [[0.0f32; A]; 3];
        for p in run {
            let (u, v) = (uv[2 * p], uv[2 * p + 1]);
            let d = &d_out[p * c.stride + c.first..][..A];
            let (mut du, mut dv) = (0.0, 0.0);
            for k in 0..A {
                du = fma::<F>(d[k], along_u[k], du);
                dv = fma::<F>(d[k], along_v[k], dv);
                sums[0][k] = fma::<F>(u, d[k], sums[0][k]);
                sums[1][k] = fma::<F>(v, d[k], sums[1][k]);
                sums[2][k] = fma::<F>(1.0 - u - v, d[k], sums[2][k]);
            }
            d_uv[2 * p] += du;
            d_uv[2 * p + 1] += dv;
        }
        for (corner, sum) in c.triangles[id as usize - 1].iter().zip(&sums) {
            let to = &mut to[*corner as usize * c.stride + c.first..][..A];
            (0..A).for_each(|k| to[k] += sum[k]);
        }
    }
}

/// Calls a function that is generic over the number of attributes for all of them.
macro_rules! by_width {
    ($columns:ident, $f:ident($($arg:expr),*)) => {
        let mut $columns = $columns;
        while $columns.first < $columns.stride {
            let width = ($columns.stride - $columns.first).min(WIDTH);
            match width {
                1 => $f::<F, 1>(&$columns, $($arg),*),
                2 => $f::<F, 2>(&$columns, $($arg),*),
                3 => $f::<F, 3>(&$columns, $($arg),*),
                4 => $f::<F, 4>(&$columns, $($arg),*),
                5 => $f::<F, 5>(&$columns, $($arg),*),
                6 => $f::<F, 6>(&$columns, $($arg),*),
                7 => $f::<F, 7>(&$columns, $($arg),*),
                _ => $f::<F, 8>(&$columns, $($arg),*),
            }
            $columns.first += width;
        }
    };
}

vectorized! {
    fn blend_all<const F>(columns: Columns, ids: &[u32], uv: &[f32], out: &mut [f32]) {
        by_width!(columns, blend(ids, uv, out));
    }
}

vectorized! {
    fn spread_all<const F>(columns: Columns, ids: &[u32], uv: &[f32], d_out: &[f32], d_uv: &mut [f32], to: &mut [f32]) {
        d_uv.fill(0.0);
        by_width!(columns, spread(ids, uv, d_out, d_uv, to));
    }
}

impl Interpolate {
    /// Numbers of attributes that pixels of one image read.
    fn group(&self) -> usize {
        self.vertices * self.attributes
    }

    fn groups(&self) -> usize {
        if self.per_image { self.images } else { 1 }
    }

    fn check(&self, attributes: usize, triangles: &[[u32; 3]], ids: &[u32]) {
        assert_eq!(attributes, self.groups() * self.group(), "interpolate: attributes");
        assert_eq!(ids.len(), self.images * self.pixels, "interpolate: pixels");
        check_triangles("interpolate", triangles, self.vertices);
    }

    fn columns<'a>(&self, attributes: &'a [f32], triangles: &'a [[u32; 3]], group: usize) -> Columns<'a> {
        let n = self.group();
        Columns { attributes: &attributes[group * n..(group + 1) * n], triangles, stride: self.attributes, first: 0 }
    }

    /// Calls `work(group of attributes, range of pixels)` in parallel.
    fn by_pixels(&self, per_pixel: usize, work: impl Fn(usize, std::ops::Range<usize>) + Sync) {
        let (groups, total) = (self.groups(), self.images * self.pixels);
        let each = total / groups.max(1);
        let blocks = each.div_ceil(BLOCK);
        tasks::run(groups * blocks, total * per_pixel, |task| {
            let (group, first) = (task / blocks, task % blocks * BLOCK);
            work(group, group * each + first..group * each + (first + BLOCK).min(each));
        });
    }

    /// Calls `work(group, range of pixels, gradient of the group's attributes)` and adds the gradients up.
    fn scatter(&self, into: &mut [f32], work: impl Fn(usize, std::ops::Range<usize>, &mut [f32]) + Sync) {
        let (groups, total) = (self.groups(), self.images * self.pixels);
        let each = total / groups.max(1);
        let tasks = partials::tasks_for(groups, each, self.vertices);
        let share = each.div_ceil(tasks);
        partials::scatter(groups, tasks, total * self.attributes, into, |group, task, to| {
            let at = |task: usize| group * each + (task * share).min(each);
            work(group, at(task)..at(task + 1), to);
        });
    }
}

/// Attributes at pixels; 0 where there is no triangle.
///
/// # Shapes
/// attributes `[V, A]` or `[N, V, A]`, triangles `[F, 3]`, ids `[N, H, W]`, uv `[N, H, W, 2]`, out `[N, H, W, A]`.
///
/// # Panics
/// When shapes disagree, or an id or a triangle names what is not there.
pub fn forward(s: &Interpolate, attributes: &[f32], triangles: &[[u32; 3]], ids: &[u32], uv: &[f32], out: &mut [f32]) {
    s.check(attributes.len(), triangles, ids);
    assert!(uv.len() == 2 * ids.len() && out.len() == ids.len() * s.attributes, "interpolate: shapes");
    let parts = Parts::new(out);
    s.by_pixels(s.attributes, |group, pixels| {
        // SAFETY: each task has pixels of its own.
        let out = unsafe { parts.range(pixels.start * s.attributes..pixels.end * s.attributes) };
        blend_all(s.columns(attributes, triangles, group), &ids[pixels.clone()], &uv[2 * pixels.start..2 * pixels.end], out);
    });
}

/// Pixels of a raster: ids `[N, H, W]` and barycentrics `[N, H, W, 2]`.
#[derive(Clone, Copy, Debug)]
pub struct Pixels<'a> {
    pub ids: &'a [u32],
    pub uv: &'a [f32],
}

/// Gradients of attributes and of barycentrics, both overwritten.
///
/// # Shapes
/// As [`forward`]; d_out `[N, H, W, A]`, d_attributes as attributes, d_uv `[N, H, W, 2]`.
///
/// # Panics
/// As [`forward`].
pub fn backward(
    s: &Interpolate,
    attributes: &[f32],
    triangles: &[[u32; 3]],
    at: Pixels,
    d_out: &[f32],
    d_attributes: &mut [f32],
    d_uv: &mut [f32],
) {
    s.check(attributes.len(), triangles, at.ids);
    let n = at.ids.len();
    assert!(at.uv.len() == 2 * n && d_out.len() == n * s.attributes && d_uv.len() == 2 * n, "interpolate: shapes");
    assert_eq!(attributes.len(), d_attributes.len(), "interpolate: gradient");
    let parts = Parts::new(d_uv);
    s.scatter(d_attributes, |group, pixels, to| {
        // SAFETY: each task has pixels of its own.
        let d_uv = unsafe { parts.range(2 * pixels.start..2 * pixels.end) };
        let (uv, d_out) = (&at.uv[2 * pixels.start..2 * pixels.end], &d_out[pixels.start * s.attributes..pixels.end * s.attributes]);
        spread_all(s.columns(attributes, triangles, group), &at.ids[pixels], uv, d_out, d_uv, to);
    });
}

/// Screen derivatives of the `chosen` attributes, from those of barycentrics, which `rasterize` gives.
///
/// # Shapes
/// slopes `[N, H, W, 4]` of `∂u/∂X, ∂u/∂Y, ∂v/∂X, ∂v/∂Y`, out `[N, H, W, chosen, 2]` of `∂/∂X, ∂/∂Y`; else as [`forward`].
///
/// # Panics
/// As [`forward`].
pub fn derivatives(
    s: &Interpolate,
    chosen: &[usize],
    attributes: &[f32],
    triangles: &[[u32; 3]],
    ids: &[u32],
    slopes: &[f32],
    out: &mut [f32],
) {
    s.check(attributes.len(), triangles, ids);
    let width = 2 * chosen.len();
    assert!(slopes.len() == 4 * ids.len() && out.len() == width * ids.len(), "interpolate: shapes");
    assert!(chosen.iter().all(|k| *k < s.attributes), "interpolate: chosen attributes {chosen:?} of {}", s.attributes);
    if width == 0 {
        return;
    }
    let parts = Parts::new(out);
    s.by_pixels(width, |group, pixels| {
        // SAFETY: each task has pixels of its own.
        let out = unsafe { parts.range(pixels.start * width..pixels.end * width) };
        let columns = s.columns(attributes, triangles, group);
        for (p, out) in pixels.zip(out.chunks_exact_mut(width)) {
            let slopes = &slopes[4 * p..4 * p + 4];
            for (k, out) in chosen.iter().zip(out.as_chunks_mut::<2>().0) {
                let [_, [along_u], [along_v]] = Columns { first: *k, ..columns }.load::<1>(ids[p]);
                *out = [slopes[0] * along_u + slopes[2] * along_v, slopes[1] * along_u + slopes[3] * along_v];
            }
        }
    });
}

/// Gradients of [`derivatives`]: adds those of attributes to `d_attributes`, overwrites those of the slopes.
///
/// # Shapes
/// at.uv here `[N, H, W, 4]`, the slopes; d_out `[N, H, W, chosen, 2]`, d_slopes `[N, H, W, 4]`; else as [`derivatives`].
///
/// # Panics
/// As [`forward`].
pub fn derivatives_backward(
    s: &Interpolate,
    chosen: &[usize],
    attributes: &[f32],
    triangles: &[[u32; 3]],
    at: Pixels,
    d_out: &[f32],
    (d_attributes, d_slopes): (&mut [f32], &mut [f32]),
) {
    s.check(attributes.len(), triangles, at.ids);
    let (width, n) = (2 * chosen.len(), at.ids.len());
    assert!(at.uv.len() == 4 * n && d_slopes.len() == 4 * n && d_out.len() == width * n, "interpolate: shapes");
    assert!(chosen.iter().all(|k| *k < s.attributes), "interpolate: chosen attributes {chosen:?} of {}", s.attributes);
    assert_eq!(attributes.len(), d_attributes.len(), "interpolate: gradient");
    let (parts, mut sums) = (Parts::new(d_slopes), vec![0.0; d_attributes.len()]);
    s.scatter(&mut sums, |group, pixels, to| {
        // SAFETY: each task has pixels of its own.
        let d_slopes = unsafe { parts.range(4 * pixels.start..4 * pixels.end) };
        let columns = s.columns(attributes, triangles, group);
        for (p, d_slopes) in pixels.zip(d_slopes.as_chunks_mut::<4>().0) {
            *d_slopes = [0.0; 4];
            let Some(triangle) = at.ids[p].checked_sub(1) else { continue };
            let slopes = &at.uv[4 * p..4 * p + 4];
            for (k, d) in chosen.iter().zip(d_out[p * width..(p + 1) * width].as_chunks::<2>().0) {
                let [_, [along_u], [along_v]] = Columns { first: *k, ..columns }.load::<1>(at.ids[p]);
                let (d_u, d_v) = (d[0] * slopes[0] + d[1] * slopes[1], d[0] * slopes[2] + d[1] * slopes[3]);
                for (corner, d) in columns.triangles[triangle as usize].iter().zip([d_u, d_v, -(d_u + d_v)]) {
                    to[*corner as usize * s.attributes + k] += d;
                }
                let all = [d[0] * along_u, d[1] * along_u, d[0] * along_v, d[1] * along_v];
                (0..4).for_each(|i| d_slopes[i] += all[i]);
            }
        }
    });
    d_attributes.iter_mut().zip(&sums).for_each(|(d, s)| *d += s);
}
