//! Blocks of points whose pixels and weights are computed once for all channels. The gradient of the image is made by
//! tasks that have channels of their own, so that no two add to one pixel.

use super::{GridSample, Mode, Outside};
use crate::math::multiversion;
use crate::tasks::{self, Parts};

/// Points whose pixels are known at a time.
const POINTS: usize = 256;
/// Channels per task backward.
const CHANNELS: usize = 8;

/// The four pixels around each of some points.
struct Corners {
    pixel: [[u32; POINTS]; 4],
    /// 0 where the pixel is outside.
    weight: [[f32; POINTS]; 4],
    /// Slopes of the weights with respect to the grid's x and y.
    along: [[[f32; POINTS]; 4]; 2],
}

impl Corners {
    const EMPTY: Corners = Corners { pixel: [[0; POINTS]; 4], weight: [[0.0; POINTS]; 4], along: [[[0.0; POINTS]; 4]; 2] };
}

/// Place along an axis of `n` pixels, and its slope with respect to the grid's coordinate.
#[inline(always)]
fn place(s: &GridSample, n: f32, g: f32) -> (f32, f32) {
    let (at, slope) = if s.align_corners { ((g + 1.0) * 0.5 * (n - 1.0), 0.5 * (n - 1.0)) } else { (((g + 1.0) * n - 1.0) * 0.5, 0.5 * n) };
    let is_inside = at > 0.0 && at < n - 1.0;
    match s.outside {
        Outside::Zeros => (at, slope),
        // This order of comparisons maps NaN to the first pixel.
        Outside::Border => (if at > 0.0 { if at < n - 1.0 { at } else { n - 1.0 } } else { 0.0 }, if is_inside { slope } else { 0.0 }),
    }
}

multiversion! {
    /// Fills the first `grid.len() / 2` corners.
    fn find(s: &GridSample, grid: &[f32], corners: &mut Corners) {
        let [h, w] = s.from.map(|n| n as f32);
        for i in 0..(grid.len() / 2).min(POINTS) {
            let ((x, slope_x), (y, slope_y)) = (place(s, w, grid[2 * i]), place(s, h, grid[2 * i + 1]));
            let nearest = s.mode == Mode::Nearest;
            let (x0, y0) = if nearest { (x.round_ties_even(), y.round_ties_even()) } else { (x.floor(), y.floor()) };
            let (tx, ty) = if nearest { (0.0, 0.0) } else { (x - x0, y - y0) };
            for k in 0..4 {
                let (px, py) = (x0 + (k & 1) as f32, y0 + (k >> 1) as f32);
                let (wx, wy) = (if k & 1 == 0 { 1.0 - tx } else { tx }, if k >> 1 == 0 { 1.0 - ty } else { ty });
                let is_inside = px >= 0.0 && px < w && py >= 0.0 && py < h;
                // NaN and points far away read the first pixel, with weight 0.
                let (px, py) = if is_inside { (px as u32, py as u32) } else { (0, 0) };
                corners.pixel[k][i] = py * s.from[1] as u32 + px;
                corners.weight[k][i] = if is_inside { wx * wy } else { 0.0 };
                let turned = |n: usize| if k >> n & 1 == 0 { -1.0 } else { 1.0 };
                let used = is_inside && !nearest;
                corners.along[0][k][i] = if used { wy * turned(0) * slope_x } else { 0.0 };
                corners.along[1][k][i] = if used { wx * turned(1) * slope_y } else { 0.0 };
            }
        }
    }
}

multiversion! {
    fn sample(corners: &Corners, x: &[f32], out: &mut [f32]) {
        for i in 0..out.len().min(POINTS) {
            let mut sum = 0.0;
            for k in 0..4 {
                // SAFETY: `find` names pixels of the plane alone, whose size `check` compared.
                sum += corners.weight[k][i] * unsafe { *x.get_unchecked(corners.pixel[k][i] as usize) };
            }
            out[i] = sum;
        }
    }
}

multiversion! {
    /// Adds `d x` of each of the four pixels to `sums`.
    fn correlate(corners: &Corners, x: &[f32], d: &[f32], sums: &mut [[f32; POINTS]; 4]) {
        for k in 0..4 {
            for i in 0..d.len().min(POINTS) {
                // SAFETY: as in `sample`.
                sums[k][i] += d[i] * unsafe { *x.get_unchecked(corners.pixel[k][i] as usize) };
            }
        }
    }
}

/// Adds a channel's gradient to its plane.
fn spread(corners: &Corners, d: &[f32], dx: &mut [f32]) {
    for (i, d) in d.iter().enumerate().take(POINTS) {
        for k in 0..4 {
            // SAFETY: as in `sample`.
            unsafe { *dx.get_unchecked_mut(corners.pixel[k][i] as usize) += corners.weight[k][i] * d };
        }
    }
}

impl GridSample {
    fn check(&self, x: usize, grid: usize, out: usize) {
        let size = self.from[0] * self.from[1];
        assert!(x == self.images * self.channels * size, "grid sample: x");
        assert!(grid == self.images * self.points * 2, "grid sample: grid");
        assert!(out == self.images * self.channels * self.points, "grid sample: output");
        assert!(size > 0 || out == 0, "grid sample: no pixels");
        // Places are computed in f32, which knows every integer up to 2²⁴.
        assert!(self.from.iter().all(|n| *n <= 1 << 24) && size <= u32::MAX as usize, "grid sample: image too large");
    }

    /// Calls `work(image, range of points)` for blocks of points, in parallel.
    fn by_points(&self, work: impl Fn(usize, std::ops::Range<usize>) + Sync) {
        let blocks = self.points.div_ceil(POINTS);
        tasks::run(self.images * blocks, self.images * self.points * self.channels * 4, |task| {
            let first = task % blocks * POINTS;
            work(task / blocks, first..(first + POINTS).min(self.points));
        });
    }

    fn grid_of<'a>(&self, grid: &'a [f32], image: usize, points: &std::ops::Range<usize>) -> &'a [f32] {
        &grid[2 * (image * self.points + points.start)..2 * (image * self.points + points.end)]
    }
}

/// Values at the grid's points.
///
/// # Shapes
/// x `[N, C, H, W]`, grid `[N, H', W', 2]`, out `[N, C, H', W']`.
pub fn forward(s: &GridSample, x: &[f32], grid: &[f32], out: &mut [f32]) {
    s.check(x.len(), grid.len(), out.len());
    let (size, parts) = (s.from[0] * s.from[1], Parts::new(out));
    s.by_points(|image, points| {
        let mut corners = Corners::EMPTY;
        find(s, s.grid_of(grid, image, &points), &mut corners);
        for plane in image * s.channels..(image + 1) * s.channels {
            // SAFETY: each task has points of its own.
            let out = unsafe { parts.range(plane * s.points + points.start..plane * s.points + points.end) };
            sample(&corners, &x[plane * size..][..size], out);
        }
    });
}

/// Gradient of x, overwritten.
///
/// # Shapes
/// grid `[N, H', W', 2]`, d `[N, C, H', W']`, dx `[N, C, H, W]`.
pub fn backward_input(s: &GridSample, grid: &[f32], d: &[f32], dx: &mut [f32]) {
    s.check(dx.len(), grid.len(), d.len());
    let (size, blocks) = (s.from[0] * s.from[1], s.channels.div_ceil(CHANNELS));
    let (elements, parts) = (dx.len() + d.len() * 4, Parts::new(dx));
    tasks::run(s.images * blocks, elements, |task| {
        let (image, first) = (task / blocks, task % blocks * CHANNELS);
        let planes = image * s.channels + first..image * s.channels + (first + CHANNELS).min(s.channels);
        // SAFETY: each task has planes of its own.
        let dx = unsafe { parts.range(planes.start * size..planes.end * size) };
        dx.fill(0.0);
        let mut corners = Corners::EMPTY;
        for start in (0..s.points).step_by(POINTS) {
            let points = start..(start + POINTS).min(s.points);
            find(s, s.grid_of(grid, image, &points), &mut corners);
            for (plane, dx) in planes.clone().zip(dx.chunks_exact_mut(size)) {
                spread(&corners, &d[plane * s.points + points.start..plane * s.points + points.end], dx);
            }
        }
    });
}

/// Gradient of the grid, overwritten.
///
/// # Shapes
/// x `[N, C, H, W]`, grid and d_grid `[N, H', W', 2]`, d `[N, C, H', W']`.
pub fn backward_grid(s: &GridSample, x: &[f32], grid: &[f32], d: &[f32], d_grid: &mut [f32]) {
    s.check(x.len(), grid.len(), d.len());
    assert_eq!(grid.len(), d_grid.len(), "grid sample: shapes");
    let (size, parts) = (s.from[0] * s.from[1], Parts::new(d_grid));
    s.by_points(|image, points| {
        let mut corners = Corners::EMPTY;
        find(s, s.grid_of(grid, image, &points), &mut corners);
        let mut sums = [[0.0f32; POINTS]; 4];
        for plane in image * s.channels..(image + 1) * s.channels {
            let d = &d[plane * s.points + points.start..plane * s.points + points.end];
            correlate(&corners, &x[plane * size..][..size], d, &mut sums);
        }
        let first = image * s.points;
        // SAFETY: each task has points of its own.
        let d_grid = unsafe { parts.range(2 * (first + points.start)..2 * (first + points.end)) };
        for (i, d) in d_grid.chunks_exact_mut(2).enumerate() {
            for axis in 0..2 {
                d[axis] = (0..4).map(|k| corners.along[axis][k][i] * sums[k][i]).sum();
            }
        }
    });
}
