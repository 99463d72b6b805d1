//! Cases of the op, for its tests and for `bench check`.

use super::{Activation, BiasKind, Dense};
#[cfg(feature = "gpu")]
use super::{gpu as on_gpu, reference};
#[cfg(feature = "gpu")]
use crate::gpu::{Gpu, GpuError, Rows, table::Table};
use diorama_testkit::random;
#[cfg(feature = "gpu")]
use diorama_testkit::wide;

/// Activations whose slope is a function of the output.
pub const ACTIVATIONS: [Activation; 7] = [
    Activation::None,
    Activation::Relu,
    Activation::Sigmoid,
    Activation::Softplus,
    Activation::TruncatedExp,
    Activation::LeakyRelu,
    Activation::Tanh,
];

/// `m` rows, a layer's parameters, and gradients of its output.
pub struct Case {
    pub m: usize,
    pub layer: Dense,
    pub x: Vec<f32>,
    pub w: Vec<f32>,
    pub bias: Vec<f32>,
    pub d: Vec<f32>,
}

/// Every bias and activation at each size.
pub fn cases() -> impl Iterator<Item = Case> {
    let sizes = [(0, 3, 4), (1, 1, 1), (7, 5, 3), (500, 64, 64), (385, 33, 257), (12, 256, 16), (1300, 8, 5), (5000, 9, 11)];
    let biases = [BiasKind::None, BiasKind::Shared, BiasKind::PerRow];
    let all = sizes.into_iter().flat_map(move |size| biases.into_iter().flat_map(move |b| ACTIVATIONS.map(|a| (size, b, a))));
    all.map(|((m, k, n), bias, activation)| Case {
        m,
        layer: Dense { k, n, bias, activation },
        x: random(m * k, 1),
        w: random(k * n, 2).iter().map(|w| w / (k as f32).sqrt()).collect(),
        bias: random(bias.len(m, n), 3),
        d: random(m * n, 4),
    })
}

#[cfg(feature = "gpu")]
pub fn check(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    for Case { m, layer, x, w, bias, d } in cases() {
        let Dense { k, n, bias: kind, activation } = layer;
        let (shape, rows) = (format!("{m}x{k}x{n} {activation:?} {kind:?}"), Rows::all(gpu, m));
        let (xg, wg, bg) = (gpu.upload(&x), gpu.upload(&w), gpu.upload(&bias));
        let (xd, wd, bd) = (wide(&x), wide(&w), wide(&bias));
        let out = on_gpu::forward(gpu, &rows, &layer, &xg, &wg, Some(&bg));
        table.close("linear", "forward", &shape, &out, &reference::forward(m, &layer, &xd, &wd, &bd))?;
        let g = on_gpu::backward(gpu, &rows, &layer, &xg, &wg, &out, &gpu.upload(&d));
        let (dx, dw, db) = reference::backward(m, &layer, &xd, &wd, &bd, &wide(&d));
        table.close("linear", "d x", &shape, &g.x, &dx)?;
        table.close("linear", "d weight", &shape, &g.w, &dw)?;
        if let Some(bias) = &g.bias {
            table.close("linear", "d bias", &shape, bias, &db)?;
        }
    }
    Ok(())
}
