//! Cases of the op, for its tests and for `bench check`.

#[cfg(feature = "gpu")]
use super::{gpu as on_gpu, reference};
#[cfg(feature = "gpu")]
use crate::gpu::{Gpu, GpuError, table::Table};
use diorama_testkit::random;
#[cfg(feature = "gpu")]
use diorama_testkit::wide;

/// A box that rays are clipped to, and the distance at which they begin.
pub const MIN: [f32; 3] = [-1.0; 3];
pub const MAX: [f32; 3] = [1.0, 1.5, 0.5];
pub const NEAR: f32 = 0.05;

/// Rays in and around the box, two of them along its axes.
pub struct Case {
    pub origins: Vec<f32>,
    pub dirs: Vec<f32>,
}

pub fn cases() -> Vec<Case> {
    let of = |n: usize| {
        let (origins, mut dirs) = (random(n * 3, 1).iter().map(|v| v * 3.0).collect(), random(n * 3, 2));
        if n > 3 {
            dirs[..6].copy_from_slice(&[0.0, 0.0, 1.0, 0.0, -1.0, 0.0]);
        }
        Case { origins, dirs }
    };
    [0, 1, 501].map(of).into()
}

#[cfg(feature = "gpu")]
pub fn check(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    for Case { origins, dirs } in cases() {
        let got = on_gpu::intersect(gpu, &gpu.upload(&origins), &gpu.upload(&dirs), MIN, MAX, NEAR);
        let want = reference::intersect(&wide(&origins), &wide(&dirs), MIN.map(f64::from), MAX.map(f64::from), NEAR as f64);
        table.close("ray and box", "near and far", format!("R={}", origins.len() / 3), &got, &want)?;
    }
    Ok(())
}
