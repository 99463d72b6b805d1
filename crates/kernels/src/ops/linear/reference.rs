//! Plain loops in f64.

use super::{Activation, BiasKind, Dense, LEAK};

/// Value of an activation.
pub fn activate(a: Activation, x: f64) -> f64 {
    match a {
        Activation::None => x,
        Activation::Relu => x.max(0.0),
        Activation::Sigmoid => 1.0 / (1.0 + (-x).exp()),
        Activation::Softplus => x.max(0.0) + (-x.abs()).exp().ln_1p(),
        Activation::TruncatedExp => x.exp(),
        Activation::LeakyRelu => x.max(LEAK * x),
        Activation::Tanh => x.tanh(),
        Activation::Silu => x / (1.0 + (-x).exp()),
    }
}

/// Slope of an activation.
pub fn slope(a: Activation, x: f64) -> f64 {
    match a {
        Activation::None => 1.0,
        Activation::Relu => (x > 0.0) as u8 as f64,
        Activation::Sigmoid => {
            let s = activate(a, x);
            s * (1.0 - s)
        }
        Activation::Softplus => activate(Activation::Sigmoid, x),
        Activation::TruncatedExp => x.min(15.0).exp(),
        Activation::LeakyRelu => {
            if x > 0.0 {
                1.0
            } else {
                LEAK
            }
        }
        Activation::Tanh => 1.0 - x.tanh().powi(2),
        Activation::Silu => {
            let s = activate(Activation::Sigmoid, x);
            s * (1.0 + x * (1.0 - s))
        }
    }
}

/// Second derivative of an activation.
pub fn second_slope(a: Activation, x: f64) -> f64 {
    let s = activate(Activation::Sigmoid, x);
    match a {
        Activation::None | Activation::Relu | Activation::LeakyRelu => 0.0,
        Activation::Sigmoid => s * (1.0 - s) * (1.0 - 2.0 * s),
        Activation::Softplus => s * (1.0 - s),
        Activation::TruncatedExp => {
            if x < 15.0 {
                x.exp()
            } else {
                0.0
            }
        }
        Activation::Tanh => -2.0 * x.tanh() * slope(a, x),
        Activation::Silu => s * (1.0 - s) * (2.0 + x * (1.0 - 2.0 * s)),
    }
}

fn pre(m: usize, &Dense { k, n, bias, .. }: &Dense, x: &[f64], w: &[f64], b: &[f64]) -> Vec<f64> {
    let mut out = vec![0.0; m * n];
    for i in 0..m {
        for j in 0..n {
            let start = match bias {
                BiasKind::None => 0.0,
                BiasKind::Shared => b[j],
                BiasKind::PerRow => b[i * n + j],
            };
            out[i * n + j] = start + (0..k).map(|p| x[i * k + p] * w[p * n + j]).sum::<f64>();
        }
    }
    out
}

/// `[M, N]`
pub fn forward(m: usize, layer: &Dense, x: &[f64], w: &[f64], b: &[f64]) -> Vec<f64> {
    pre(m, layer, x, w, b).into_iter().map(|v| activate(layer.activation, v)).collect()
}

/// Gradients of x, w and b.
pub fn backward(m: usize, layer: &Dense, x: &[f64], w: &[f64], b: &[f64], d: &[f64]) -> (Vec<f64>, Vec<f64>, Vec<f64>) {
    let pre = pre(m, layer, x, w, b);
    let &Dense { k, n, bias, activation } = layer;
    let (mut dx, mut dw, mut db) = (vec![0.0; m * k], vec![0.0; k * n], vec![0.0; b.len()]);
    for i in 0..m {
        for j in 0..n {
            let g = d[i * n + j] * slope(activation, pre[i * n + j]);
            for p in 0..k {
                dx[i * k + p] += g * w[p * n + j];
                dw[p * n + j] += g * x[i * k + p];
            }
            match bias {
                BiasKind::None => {}
                BiasKind::Shared => db[j] += g,
                BiasKind::PerRow => db[i * n + j] += g,
            }
        }
    }
    (dx, dw, db)
}
