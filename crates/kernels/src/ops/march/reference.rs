//! The same walk in f64, one ray after the other.

use super::{MarchConfig, MarchRays, Marched, OccupancyBits};

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
