//! The same march in f64, one ray after the other.

use super::{MarchConfig, MarchRays, Marched, OccupancyBits, Space};
use crate::ops::composite::Packed;

/// The cascade to read, and whether it holds the point.
fn cascade_of(grid: &OccupancyBits, x: [f64; 3], dt: f64) -> (usize, bool) {
    let reach = x.iter().map(|v| (v - 0.5).abs()).fold(0.0, f64::max);
    (0..grid.cascades)
        .find(|&c| {
            let size = (1u32 << c) as f64;
            let last = c + 1 == grid.cascades;
            reach < 0.5 * size && (last || dt * grid.resolution as f64 <= size)
        })
        .map_or((grid.cascades - 1, false), |c| (c, true))
}

/// Packed samples in f64, written as f32.
pub fn march(grid: &OccupancyBits, rays: &MarchRays, config: &MarchConfig) -> Marched {
    let mut out = Marched { offsets: vec![0], ..Marched::default() };
    for r in 0..rays.jitter.len() {
        let o: [f64; 3] = std::array::from_fn(|k| rays.origins[r * 3 + k] as f64);
        let d: [f64; 3] = std::array::from_fn(|k| rays.dirs[r * 3 + k] as f64);
        let (near, far) = (rays.near_far[r * 2] as f64, rays.near_far[r * 2 + 1] as f64);
        let jitter = rays.jitter[r] as f64;
        let step = |t: f64| {
            let stretch = (t / config.disparity_from as f64).max(1.0);
            (t * config.cone as f64 * stretch).clamp(config.dt_min as f64, config.dt_max as f64)
        };
        let (mut t, mut count) = (near, 0);
        if !rays.resumed {
            t = t.max(near + (jitter - 0.5) * step(near));
        }
        while t < far && count < config.max_samples {
            let dt = step(t);
            let mid = t + 0.5 * dt;
            let x: [f64; 3] = std::array::from_fn(|k| o[k] + mid * d[k]);
            let (c, inside) = cascade_of(grid, x, dt);
            if !inside && !config.unbounded {
                t += dt;
                continue;
            }
            let (low, size) = OccupancyBits::cube(c);
            let (low, size, n) = (low as f64, size as f64, grid.resolution);
            let cell: [usize; 3] = std::array::from_fn(|k| (((x[k] - low) / size * n as f64) as usize).min(n - 1));
            let cell_index = ((c * n + cell[2]) * n + cell[1]) * n + cell[0];
            if !inside || grid.get(cell_index) {
                out.cells.push(cell_index as u32);
                out.t.push(t as f32);
                out.dt.push(dt as f32);
                count += 1;
                t += dt;
                continue;
            }
            let exit = (0..3)
                .filter(|&k| d[k] != 0.0)
                .map(|k| (low + (cell[k] + (d[k] > 0.0) as usize) as f64 * size / n as f64 - o[k]) / d[k])
                .fold(f64::INFINITY, f64::min);
            let jump = exit + (jitter - 0.5) * dt;
            t = if jump > t { jump } else { t + dt };
        }
        out.offsets.push(out.t.len() as u32);
    }
    out
}

/// Coordinates of a space that run from −1 to 1, the factor that scales them to the result, and the result's center. Contracted ones go on
/// beyond ±1.
fn scaled(space: Space, point: [f64; 3]) -> ([f64; 3], f64, f64) {
    let by = |width: f32| point.map(|v| 2.0 / width as f64 * (v - 0.5));
    match space {
        Space::Model => (point, 1.0, 0.0),
        Space::Cube(width) => (by(width), 0.5, 0.5),
        Space::Centered(width) => (by(width), 1.0, 0.0),
        Space::Contracted(width) => (by(width), 0.25, 0.5),
        Space::ContractedCentered(width) => (by(width), 0.5, 0.0),
    }
}

/// `m`, the largest coordinate's size, where a space contracts a point (Barron et al. 2022, with the maximum norm).
fn contracts(space: Space, c: [f64; 3]) -> Option<f64> {
    let m = c.iter().fold(0.0, |m: f64, v| m.max(v.abs()));
    (matches!(space, Space::Contracted(_) | Space::ContractedCentered(_)) && m > 1.0).then_some(m)
}

/// A model point as coordinates of a space.
pub fn to_space(space: Space, point: [f64; 3]) -> [f64; 3] {
    let (c, scale, center) = scaled(space, point);
    let by = contracts(space, c).map_or(scale, |m| scale * (2.0 - 1.0 / m) / m);
    c.map(|v| by * v + center)
}

/// Gradient of a model point, given that of its coordinates in a space.
pub fn to_space_backward(space: Space, point: [f64; 3], d: [f64; 3]) -> [f64; 3] {
    let (c, scale, _) = scaled(space, point);
    let inner = match space {
        Space::Model => 1.0,
        Space::Cube(w) | Space::Centered(w) | Space::Contracted(w) | Space::ContractedCentered(w) => 2.0 / w as f64,
    };
    let Some(m) = contracts(space, c) else { return d.map(|d| inner * scale * d) };
    // The factor (2 − 1/m) / m has a slope with respect to the largest coordinate.
    let slope = (2.0 / m - 2.0) / (m * m) * (0..3).map(|k| d[k] * c[k]).sum::<f64>();
    std::array::from_fn(|k| {
        let of_largest = if c[k].abs() == m { slope * c[k].signum() } else { 0.0 };
        inner * scale * ((2.0 - 1.0 / m) / m * d[k] + of_largest)
    })
}

/// Calls `f(ray, sample, middle of the sample, its place in model space)` for every sample.
fn each_sample(rays: &MarchRays, p: &Packed, mut f: impl FnMut(usize, usize, f64, [f64; 3])) {
    for r in 0..p.rays() {
        for i in p.range(r) {
            let middle = p.t[i] as f64 + 0.5 * p.dt[i] as f64;
            f(r, i, middle, std::array::from_fn(|k| rays.origins[r * 3 + k] as f64 + middle * rays.dirs[r * 3 + k] as f64));
        }
    }
}

/// Middles of samples `[S, 3]` as coordinates of a space.
pub fn positions(rays: &MarchRays, p: &Packed, space: Space) -> Vec<f64> {
    let mut out = Vec::with_capacity(p.samples() * 3);
    each_sample(rays, p, |_, _, _, point| out.extend(to_space(space, point)));
    out
}

/// Gradients of origins and directions `[R, 3]`, given those of [`positions`].
pub fn positions_backward(rays: &MarchRays, p: &Packed, space: Space, d: &[f64]) -> (Vec<f64>, Vec<f64>) {
    let (mut d_origins, mut d_dirs) = (vec![0.0; rays.origins.len()], vec![0.0; rays.dirs.len()]);
    each_sample(rays, p, |r, i, middle, point| {
        let g = to_space_backward(space, point, [d[i * 3], d[i * 3 + 1], d[i * 3 + 2]]);
        for k in 0..3 {
            d_origins[r * 3 + k] += g[k];
            d_dirs[r * 3 + k] += middle * g[k];
        }
    });
    (d_origins, d_dirs)
}
