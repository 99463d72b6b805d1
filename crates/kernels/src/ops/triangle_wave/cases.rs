//! Cases of the op, for its tests and for `bench check`.

#[cfg(feature = "gpu")]
use super::{gpu as on_gpu, reference};
#[cfg(feature = "gpu")]
use crate::gpu::{Gpu, GpuError, table::Table};
use diorama_testkit::random;
#[cfg(feature = "gpu")]
use diorama_testkit::wide;

/// Rows of `dims` numbers, and gradients of what they are encoded to.
pub struct Case {
    pub dims: usize,
    pub bands: usize,
    pub x: Vec<f32>,
    pub d: Vec<f32>,
}

pub fn cases() -> Vec<Case> {
    let of = |(n, dims, bands): (usize, usize, usize)| Case { dims, bands, x: random(n * dims, 1), d: random(n * dims * bands, 3) };
    [(0, 3, 6), (1, 1, 1), (1, 3, 6), (40, 3, 12), (333, 3, 6)].map(of).into()
}

#[cfg(feature = "gpu")]
pub fn check(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    for c in cases() {
        let (x, d, shape) = (gpu.upload(&c.x), gpu.upload(&c.d), format!("N={} {} bands", c.x.len() / c.dims, c.bands));
        let want = reference::forward(c.bands, &wide(&c.x));
        table.close("triangle wave", "forward", &shape, &on_gpu::forward(gpu, c.bands, &x), &want)?;
        let want = reference::backward(c.bands, &wide(&c.x), &wide(&c.d));
        table.close("triangle wave", "d x", &shape, &on_gpu::backward(gpu, c.bands, &x, &d), &want)?;
    }
    Ok(())
}
