//! Plain formulas in f64.

use super::Activation;

/// `erf x`: Taylor's series near 0, the continued fraction of erfc elsewhere.
pub fn erf(x: f64) -> f64 {
    let a = x.abs();
    let value = if a < 2.5 {
        let (mut term, mut sum) = (a, a);
        for n in 1..80 {
            term *= -a * a / n as f64;
            sum += term / (2 * n + 1) as f64;
        }
        2.0 / std::f64::consts::PI.sqrt() * sum
    } else {
        let fraction = (1..60).rev().fold(a, |f, n| a + n as f64 / 2.0 / f);
        1.0 - (-a * a).exp() / (std::f64::consts::PI.sqrt() * fraction)
    };
    value.copysign(x)
}

fn sigmoid(x: f64) -> f64 {
    1.0 / (1.0 + (-x).exp())
}

/// Argument of the hyperbolic tangent in [`Activation::GeluTanh`], and its slope.
fn gelu_argument(x: f64) -> (f64, f64) {
    let c = (2.0 / std::f64::consts::PI).sqrt();
    (c * (x + 0.044715 * x.powi(3)), c * (1.0 + 3.0 * 0.044715 * x * x))
}

/// `f(x)`
pub fn value(a: Activation, x: f64) -> f64 {
    match a {
        Activation::None => x,
        Activation::Relu => x.max(0.0),
        Activation::LeakyRelu(slope) => x.max(0.0) + slope as f64 * x.min(0.0),
        Activation::Softplus => x.max(0.0) + (-x.abs()).exp().ln_1p(),
        Activation::Sigmoid => sigmoid(x),
        Activation::Tanh => x.tanh(),
        Activation::Silu => x * sigmoid(x),
        Activation::Gelu => x * 0.5 * (1.0 + erf(x / 2.0f64.sqrt())),
        Activation::GeluTanh => x * 0.5 * (1.0 + gelu_argument(x).0.tanh()),
    }
}

/// `f′(x)`
pub fn slope(a: Activation, x: f64) -> f64 {
    let step = |below: f64| if x > 0.0 { 1.0 } else { below };
    match a {
        Activation::None => 1.0,
        Activation::Relu => step(0.0),
        Activation::LeakyRelu(slope) => step(slope as f64),
        Activation::Softplus => sigmoid(x),
        Activation::Sigmoid => sigmoid(x) * (1.0 - sigmoid(x)),
        Activation::Tanh => 1.0 - x.tanh().powi(2),
        Activation::Silu => sigmoid(x) * (1.0 + x * (1.0 - sigmoid(x))),
        Activation::Gelu => 0.5 * (1.0 + erf(x / 2.0f64.sqrt())) + x * (-0.5 * x * x).exp() / (2.0 * std::f64::consts::PI).sqrt(),
        Activation::GeluTanh => {
            let (argument, inner) = gelu_argument(x);
            0.5 * (1.0 + argument.tanh()) + 0.5 * x * (1.0 - argument.tanh().powi(2)) * inner
        }
    }
}
