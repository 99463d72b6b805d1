//! Cases of the op, for its tests and for `bench check`.

#[cfg(feature = "gpu")]
use super::gpu::{self as on_gpu, Pair};
#[cfg(feature = "gpu")]
use super::{WINDOW, reference};
#[cfg(feature = "gpu")]
use crate::gpu::table::{TOLERANCE, Table};
#[cfg(feature = "gpu")]
use crate::gpu::{Gpu, GpuError};
use diorama_testkit::random_unit;
#[cfg(feature = "gpu")]
use diorama_testkit::{compare_proven, wide};

/// Two images of a width, height and channels.
pub struct Case {
    pub size: (usize, usize, usize),
    pub x: Vec<f32>,
    pub y: Vec<f32>,
}

pub fn cases() -> [Case; 5] {
    let of = |(w, h, c): (usize, usize, usize)| Case { size: (w, h, c), x: random_unit(w * h * c, 1), y: random_unit(w * h * c, 2) };
    // One is too small for a window.
    [(11, 11, 1), (10, 30, 3), (17, 13, 3), (24, 30, 1), (24, 17, 3)].map(of)
}

#[cfg(feature = "gpu")]
pub fn check(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    for Case { size: (w, h, c), x, y } in cases() {
        let (xg, yg, shape) = (gpu.upload(&x), gpu.upload(&y), format!("{w}x{h}x{c}"));
        let pair = Pair { size: (w, h, c), x: &xg, y: &yg };
        let values = gpu.read(&on_gpu::forward(gpu, pair))?;
        let mean = values.iter().sum::<f32>() / values.len() as f32;
        let want = reference::ssim(w, h, c, &wide(&x), &wide(&y));
        let outcome = if want.is_nan() && mean.is_nan() { Ok(0.0) } else { compare_proven(&[mean], &[want], TOLERANCE) };
        table.row("SSIM", "mean", shape.clone(), outcome);
        let fits = w >= WINDOW && h >= WINDOW;
        let want = if fits { reference::gradient(w, h, c, &wide(&x), &wide(&y)) } else { vec![0.0; x.len()] };
        table.close("SSIM", "d x", &shape, &on_gpu::backward(gpu, pair), &want)?;
    }
    Ok(())
}
