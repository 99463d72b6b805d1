//! Cases of the op, for its tests and for `bench check`.

use super::Frequency;
#[cfg(feature = "gpu")]
use super::{gpu as on_gpu, reference};
#[cfg(feature = "gpu")]
use crate::gpu::{Gpu, GpuError, table::Table};
use diorama_testkit::random;
#[cfg(feature = "gpu")]
use diorama_testkit::wide;

/// Numbers, and gradients of what they are encoded to.
pub struct Case {
    pub encoding: Frequency,
    pub x: Vec<f32>,
    pub d: Vec<f32>,
}

/// With and without the input, with a window, and with no bands at all.
pub fn encodings() -> [Frequency; 5] {
    let f = Frequency { dims: 3, bands: 10, include_input: false, pi: true, window: None };
    [
        f,
        Frequency { include_input: true, pi: false, ..f },
        Frequency { window: Some(4.3), bands: 6, ..f },
        Frequency { window: Some(2.5), bands: 4, ..f },
        Frequency { dims: 2, bands: 0, include_input: true, ..f },
    ]
}

pub fn cases() -> Vec<Case> {
    let of = |(f, n): (Frequency, usize)| Case { encoding: f, x: random(n * f.dims, 1), d: random(n * f.output_dims(), 2) };
    encodings().into_iter().flat_map(|f| [0, 1, 333].map(|n| (f, n))).map(of).collect()
}

#[cfg(feature = "gpu")]
pub fn check(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    for Case { encoding: f, x, d } in cases() {
        let (x_gpu, d_gpu, shape) = (gpu.upload(&x), gpu.upload(&d), format!("N={} {} bands", x.len() / f.dims, f.bands));
        table.close("frequency", "forward", &shape, &on_gpu::forward(gpu, &f, &x_gpu), &reference::forward(&f, &wide(&x)))?;
        let want = reference::backward(&f, &wide(&x), &wide(&d));
        table.close("frequency", "d x", &shape, &on_gpu::backward(gpu, &f, &x_gpu, &d_gpu), &want)?;
    }
    Ok(())
}
