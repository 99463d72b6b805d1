//! Cases of the op, for its tests and for `bench check`.

use super::{GridSample, Mode, Outside};
#[cfg(feature = "gpu")]
use super::{gpu as on_gpu, reference};
#[cfg(feature = "gpu")]
use crate::gpu::{Gpu, GpuError, table::Table};
use diorama_testkit::random;
#[cfg(feature = "gpu")]
use diorama_testkit::wide;

/// Every way of sampling, of nothing.
pub fn modes() -> Vec<GridSample> {
    let mut out = Vec::new();
    for mode in [Mode::Bilinear, Mode::Nearest] {
        for outside in [Outside::Zeros, Outside::Border] {
            for align_corners in [false, true] {
                out.push(GridSample { mode, outside, align_corners, images: 0, channels: 0, from: [1, 1], points: 0 });
            }
        }
    }
    out
}

/// Images, points inside and outside of them, and gradients of the values there.
pub struct Case {
    pub sample: GridSample,
    pub x: Vec<f32>,
    pub grid: Vec<f32>,
    pub d: Vec<f32>,
}

/// Points inside and outside.
pub fn grid(n: usize, seed: u64) -> Vec<f32> {
    random(2 * n, seed).iter().map(|g| g * 1.4).collect()
}

pub fn cases() -> Vec<Case> {
    let shapes = [(0, 3, [4, 4], 5), (1, 1, [1, 1], 1), (2, 3, [5, 7], 33), (1, 17, [16, 9], 700), (2, 2, [3, 3], 0)];
    let of = |(mode, (images, channels, from, points)): (GridSample, (usize, usize, [usize; 2], usize))| Case {
        x: random(images * channels * from[0] * from[1], 1),
        grid: grid(images * points, 2),
        d: random(images * channels * points, 3),
        sample: GridSample { images, channels, from, points, ..mode },
    };
    modes().into_iter().flat_map(|mode| shapes.map(|shape| (mode, shape))).map(of).collect()
}

#[cfg(feature = "gpu")]
pub fn check(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    const OP: &str = "grid sample";
    for c in cases() {
        let (s, shape) = (&c.sample, format!("{:?}", c.sample));
        let (x, grid, d) = (gpu.upload(&c.x), gpu.upload(&c.grid), gpu.upload(&c.d));
        let want = reference::forward(s, &wide(&c.x), &wide(&c.grid));
        table.close(OP, "forward", &shape, &on_gpu::forward(gpu, s, &x, &grid), &want)?;
        let (want_x, want_grid) = reference::backward(s, &wide(&c.x), &wide(&c.grid), &wide(&c.d));
        table.close(OP, "d x", &shape, &on_gpu::backward_input(gpu, s, &grid, &d), &want_x)?;
        table.close(OP, "d grid", &shape, &on_gpu::backward_grid(gpu, s, &x, &grid, &d), &want_grid)?;
    }
    Ok(())
}
