//! One unit per value, or per point of the grid for the grid's gradient.

use super::{GridSample, Mode, Outside};
use crate::gpu::{Accumulate, Buffer, Gpu, launch};
use cubecl::prelude::*;

impl GridSample {
    fn size(&self) -> usize {
        self.from[0] * self.from[1]
    }

    /// Mode, border and corners, for a launch.
    fn rules(&self) -> (bool, bool, bool) {
        (self.mode == Mode::Nearest, self.outside == Outside::Border, self.align_corners)
    }
}

/// Values at the grid's points.
///
/// # Shapes
/// x `[N, C, H, W]`, grid `[N, H', W', 2]`; result `[N, C, H', W']`.
pub fn forward(gpu: &Gpu, s: &GridSample, x: &Buffer, grid: &Buffer) -> Buffer {
    let n = s.images * s.channels * s.points;
    let out = gpu.empty(n);
    let (nearest, border, align) = s.rules();
    launch!(
        gpu,
        sample,
        n,
        [x => s.images * s.channels * s.size(), grid => s.images * s.points * 2, out => n],
        n as u32,
        s.channels as u32,
        s.points as u32,
        s.from[0] as u32,
        s.from[1] as u32,
        nearest,
        border,
        align,
    );
    out
}

/// Gradient of x, given that of the result.
///
/// # Shapes
/// grid `[N, H', W', 2]`, d `[N, C, H', W']`; result `[N, C, H, W]`.
pub fn backward_input(gpu: &Gpu, s: &GridSample, grid: &Buffer, d: &Buffer) -> Buffer {
    let n = s.images * s.channels * s.points;
    let dx = gpu.zeros(s.images * s.channels * s.size());
    let (nearest, border, align) = s.rules();
    launch!(
        gpu,
        spread::<Adder>,
        n,
        [grid => s.images * s.points * 2, d => n, dx => s.images * s.channels * s.size()],
        n as u32,
        s.channels as u32,
        s.points as u32,
        s.from[0] as u32,
        s.from[1] as u32,
        nearest,
        border,
        align,
    );
    dx
}

/// Gradient of the grid, given that of the result.
///
/// # Shapes
/// x `[N, C, H, W]`, grid `[N, H', W', 2]`, d `[N, C, H', W']`; result as the grid.
pub fn backward_grid(gpu: &Gpu, s: &GridSample, x: &Buffer, grid: &Buffer, d: &Buffer) -> Buffer {
    let n = s.images * s.points;
    if s.mode == Mode::Nearest {
        return gpu.zeros(n * 2);
    }
    let d_grid = gpu.empty(n * 2);
    let (_, border, align) = s.rules();
    launch!(
        gpu,
        correlate,
        n,
        [x => s.images * s.channels * s.size(), grid => n * 2, d => n * s.channels, d_grid => n * 2],
        n as u32,
        s.channels as u32,
        s.points as u32,
        s.from[0] as u32,
        s.from[1] as u32,
        border,
        align,
    );
    d_grid
}

/// Where a coordinate lies among the pixels of an axis.
#[derive(CubeType)]
struct Place {
    /// The pixel before it, within one of the image.
    low: f32,
    /// Share of the pixel after it.
    share: f32,
    /// Slope with respect to the grid's coordinate; 0 where it was clamped.
    slope: f32,
}

#[cube]
fn place(g: f32, size: u32, #[comptime] nearest: bool, #[comptime] border: bool, #[comptime] align: bool) -> Place {
    let n = f32::cast_from(size);
    let mut at = ((g + 1.0) * n - 1.0) * 0.5;
    let mut slope = 0.5 * n;
    if comptime!(align) {
        at = (g + 1.0) * 0.5 * (n - 1.0);
        slope = 0.5 * (n - 1.0);
    }
    if comptime!(border) {
        if at <= 0.0 || at >= n - 1.0 {
            slope = 0.0f32;
        }
        at = clamp(at, 0.0, n - 1.0);
    }
    // What is far away stays outside.
    at = clamp(at, -2.0, n + 1.0);
    let mut low = at.floor();
    let mut share = at - low;
    if comptime!(nearest) {
        let is_odd = low - 2.0 * (low * 0.5).floor() == 1.0;
        if share > 0.5 || (share == 0.5 && is_odd) {
            low += 1.0;
        }
        share = 0.0f32;
    }
    Place { low, share, slope }
}

/// One of the four pixels around a point.
#[derive(CubeType)]
struct Corner {
    pixel: usize,
    /// 0 where the pixel is outside.
    weight: f32,
    /// Slopes of the weight with respect to the grid's x and y.
    along_x: f32,
    along_y: f32,
}

#[cube]
fn corner(x: &Place, y: &Place, width: u32, height: u32, #[comptime] right: bool, #[comptime] below: bool) -> Corner {
    let mut px = x.low;
    let mut py = y.low;
    let mut wx = 1.0 - x.share;
    let mut wy = 1.0 - y.share;
    let mut turn_x = -x.slope;
    let mut turn_y = -y.slope;
    if comptime!(right) {
        px += 1.0;
        wx = x.share;
        turn_x = x.slope;
    }
    if comptime!(below) {
        py += 1.0;
        wy = y.share;
        turn_y = y.slope;
    }
    let mut pixel = 0usize;
    let mut weight = 0.0f32;
    let mut along_x = 0.0f32;
    let mut along_y = 0.0f32;
    if px >= 0.0 && px < f32::cast_from(width) && py >= 0.0 && py < f32::cast_from(height) {
        pixel = (u32::cast_from(py) * width + u32::cast_from(px)) as usize;
        weight = wx * wy;
        along_x = wy * turn_x;
        along_y = wx * turn_y;
    }
    Corner { pixel, weight, along_x, along_y }
}

#[cube(launch_unchecked)]
fn sample(
    x: &[f32],
    grid: &[f32],
    out: &mut [f32],
    n: u32,
    channels: u32,
    points: u32,
    height: u32,
    width: u32,
    #[comptime] nearest: bool,
    #[comptime] border: bool,
    #[comptime] align: bool,
) {
    let i = ABSOLUTE_POS;
    if i >= n as usize {
        terminate!();
    }
    let plane = i / points as usize;
    let point = plane / channels as usize * points as usize + i % points as usize;
    let px = place(grid[point * 2], width, nearest, border, align);
    let py = place(grid[point * 2 + 1], height, nearest, border, align);
    let first = plane * (height * width) as usize;
    let a = corner(&px, &py, width, height, false, false);
    let b = corner(&px, &py, width, height, true, false);
    let c = corner(&px, &py, width, height, false, true);
    let d = corner(&px, &py, width, height, true, true);
    out[i] = a.weight * x[first + a.pixel] + b.weight * x[first + b.pixel] + c.weight * x[first + c.pixel] + d.weight * x[first + d.pixel];
}

/// Adds a value's gradient to a pixel.
#[cube]
fn add_to_corner<A: Accumulate>(c: &Corner, d: f32, first: usize, dx: &[Atomic<A::Cell>]) {
    if c.weight != 0.0 {
        A::add(&dx[first + c.pixel], c.weight * d);
    }
}

#[cube(launch_unchecked)]
fn spread<A: Accumulate>(
    grid: &[f32],
    d: &[f32],
    dx: &[Atomic<A::Cell>],
    n: u32,
    channels: u32,
    points: u32,
    height: u32,
    width: u32,
    #[comptime] nearest: bool,
    #[comptime] border: bool,
    #[comptime] align: bool,
) {
    let i = ABSOLUTE_POS;
    if i >= n as usize {
        terminate!();
    }
    let plane = i / points as usize;
    let point = plane / channels as usize * points as usize + i % points as usize;
    let px = place(grid[point * 2], width, nearest, border, align);
    let py = place(grid[point * 2 + 1], height, nearest, border, align);
    let first = plane * (height * width) as usize;
    add_to_corner::<A>(&corner(&px, &py, width, height, false, false), d[i], first, dx);
    add_to_corner::<A>(&corner(&px, &py, width, height, true, false), d[i], first, dx);
    add_to_corner::<A>(&corner(&px, &py, width, height, false, true), d[i], first, dx);
    add_to_corner::<A>(&corner(&px, &py, width, height, true, true), d[i], first, dx);
}

#[cube(launch_unchecked)]
fn correlate(
    x: &[f32],
    grid: &[f32],
    d: &[f32],
    d_grid: &mut [f32],
    n: u32,
    channels: u32,
    points: u32,
    height: u32,
    width: u32,
    #[comptime] border: bool,
    #[comptime] align: bool,
) {
    let point = ABSOLUTE_POS;
    if point >= n as usize {
        terminate!();
    }
    let px = place(grid[point * 2], width, false, border, align);
    let py = place(grid[point * 2 + 1], height, false, border, align);
    let a = corner(&px, &py, width, height, false, false);
    let b = corner(&px, &py, width, height, true, false);
    let c = corner(&px, &py, width, height, false, true);
    let e = corner(&px, &py, width, height, true, true);
    let image = point / points as usize;
    let mut dx = 0.0f32;
    let mut dy = 0.0f32;
    for channel in 0..channels as usize {
        let plane = image * channels as usize + channel;
        let g = d[plane * points as usize + point % points as usize];
        let first = plane * (height * width) as usize;
        let xa = x[first + a.pixel];
        let xb = x[first + b.pixel];
        let xc = x[first + c.pixel];
        let xe = x[first + e.pixel];
        dx += g * (a.along_x * xa + b.along_x * xb + c.along_x * xc + e.along_x * xe);
        dy += g * (a.along_y * xa + b.along_y * xb + c.along_y * xc + e.along_y * xe);
    }
    d_grid[point * 2] = dx;
    d_grid[point * 2 + 1] = dy;
}
