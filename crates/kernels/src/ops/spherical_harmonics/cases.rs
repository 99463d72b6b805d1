//! Cases of the op, for its tests and for `bench check`.

#[cfg(feature = "gpu")]
use super::{gpu as on_gpu, reference};
#[cfg(feature = "gpu")]
use crate::gpu::{Gpu, GpuError, table::Table};
use diorama_testkit::random;
#[cfg(feature = "gpu")]
use diorama_testkit::wide;

/// Directions, and gradients of their codes.
pub struct Case {
    pub degree: usize,
    pub dirs: Vec<f32>,
    pub d: Vec<f32>,
}

pub fn cases() -> Vec<Case> {
    let of = |(degree, n): (usize, usize)| Case { degree, dirs: random(n * 3, 1), d: random(n * degree * degree, 4) };
    (1..=4).flat_map(|degree| [0, 1, 333].map(|n| (degree, n))).map(of).collect()
}

#[cfg(feature = "gpu")]
pub fn check(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    for Case { degree, dirs, d } in cases() {
        let (x, g, shape) = (gpu.upload(&dirs), gpu.upload(&d), format!("N={} degree={degree}", dirs.len() / 3));
        let want = reference::forward(degree, &wide(&dirs));
        table.close("spherical harmonics", "forward", &shape, &on_gpu::forward(gpu, degree, &x), &want)?;
        let want = reference::backward(degree, &wide(&dirs), &wide(&d));
        table.close("spherical harmonics", "d directions", &shape, &on_gpu::backward(gpu, degree, &x, &g), &want)?;
    }
    Ok(())
}
