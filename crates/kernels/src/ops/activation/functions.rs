//! The functions and their slopes in f32, free of branches, so that loops over them become vector code.

use crate::math::exp;

/// One function of one number.
pub(crate) trait Function: Copy {
    fn value(self, x: f32) -> f32;
    fn slope(self, x: f32) -> f32;
}

/// `tanh x` to about 2e-7.
#[inline(always)]
pub(crate) fn tanh(x: f32) -> f32 {
    let s = x * x;
    // Taylor where 1 − 2 / (e²ˣ + 1) would cancel.
    let near = x * (1.0 + s * (-1.0 / 3.0 + s * (2.0 / 15.0 + s * (-17.0 / 315.0 + s * (62.0 / 2835.0 + s * (-1382.0 / 155_925.0))))));
    let far = 1.0 - 2.0 / (exp(2.0 * x) + 1.0);
    if x.abs() < 0.35 { near } else { far }
}

/// `1 / (1 + e⁻ˣ)`
#[inline(always)]
pub(crate) fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + exp(-x))
}

/// `ln(1 + e)` for `e` in 0..=1: `2 artanh(e / (2 + e))`.
#[inline(always)]
pub(crate) fn ln_1p(e: f32) -> f32 {
    let z = e / (2.0 + e);
    let s = z * z;
    let tail = 1.0 / 9.0 + s * (1.0 / 11.0 + s * (1.0 / 13.0 + s * (1.0 / 15.0)));
    2.0 * z * (1.0 + s * (1.0 / 3.0 + s * (1.0 / 5.0 + s * (1.0 / 7.0 + s * tail))))
}

/// The normal distribution's `Φ(x)` and `e^(−x²/2)`: Abramowitz and Stegun 7.1.26, absolute error 1.5e-7.
#[inline(always)]
pub(crate) fn normal(x: f32) -> (f32, f32) {
    let z = x.abs() * std::f32::consts::FRAC_1_SQRT_2;
    let bell = exp(-z * z);
    let t = 1.0 / (1.0 + 0.327_591_1 * z);
    let p = t * (0.254_829_6 + t * (-0.284_496_74 + t * (1.421_413_7 + t * (-1.453_152 + t * 1.061_405_4))));
    let tail = 0.5 * p * bell;
    (if x < 0.0 { tail } else { 1.0 - tail }, bell)
}

#[derive(Clone, Copy)]
pub(crate) struct Identity;
impl Function for Identity {
    #[inline(always)]
    fn value(self, x: f32) -> f32 {
        x
    }
    #[inline(always)]
    fn slope(self, _: f32) -> f32 {
        1.0
    }
}

#[derive(Clone, Copy)]
pub(crate) struct Relu;
impl Function for Relu {
    #[inline(always)]
    fn value(self, x: f32) -> f32 {
        // Written so that NaN stays NaN.
        if x < 0.0 { 0.0 } else { x }
    }
    #[inline(always)]
    fn slope(self, x: f32) -> f32 {
        if x > 0.0 { 1.0 } else { 0.0 }
    }
}

#[derive(Clone, Copy)]
pub(crate) struct LeakyRelu(pub f32);
impl Function for LeakyRelu {
    #[inline(always)]
    fn value(self, x: f32) -> f32 {
        if x > 0.0 { x } else { self.0 * x }
    }
    #[inline(always)]
    fn slope(self, x: f32) -> f32 {
        if x > 0.0 { 1.0 } else { self.0 }
    }
}

#[derive(Clone, Copy)]
pub(crate) struct Softplus;
impl Function for Softplus {
    #[inline(always)]
    fn value(self, x: f32) -> f32 {
        (if x < 0.0 { 0.0 } else { x }) + ln_1p(exp(-x.abs()))
    }
    #[inline(always)]
    fn slope(self, x: f32) -> f32 {
        sigmoid(x)
    }
}

#[derive(Clone, Copy)]
pub(crate) struct Sigmoid;
impl Function for Sigmoid {
    #[inline(always)]
    fn value(self, x: f32) -> f32 {
        sigmoid(x)
    }
    #[inline(always)]
    fn slope(self, x: f32) -> f32 {
        let y = sigmoid(x);
        y * (1.0 - y)
    }
}

#[derive(Clone, Copy)]
pub(crate) struct Tanh;
impl Function for Tanh {
    #[inline(always)]
    fn value(self, x: f32) -> f32 {
        tanh(x)
    }
    #[inline(always)]
    fn slope(self, x: f32) -> f32 {
        let y = tanh(x);
        1.0 - y * y
    }
}

#[derive(Clone, Copy)]
pub(crate) struct Silu;
impl Function for Silu {
    #[inline(always)]
    fn value(self, x: f32) -> f32 {
        x * sigmoid(x)
    }
    #[inline(always)]
    fn slope(self, x: f32) -> f32 {
        let s = sigmoid(x);
        s * (1.0 + x * (1.0 - s))
    }
}

#[derive(Clone, Copy)]
pub(crate) struct Gelu;
impl Function for Gelu {
    #[inline(always)]
    fn value(self, x: f32) -> f32 {
        x * normal(x).0
    }
    #[inline(always)]
    fn slope(self, x: f32) -> f32 {
        let (below, bell) = normal(x);
        below + x * bell * 0.398_942_3
    }
}

/// `√(2/π)` and the cubic term's factor.
const GELU: (f32, f32) = (0.797_884_6, 0.044_715);

#[derive(Clone, Copy)]
pub(crate) struct GeluTanh;
impl Function for GeluTanh {
    #[inline(always)]
    fn value(self, x: f32) -> f32 {
        0.5 * x * (1.0 + tanh(GELU.0 * (x + GELU.1 * x * x * x)))
    }
    #[inline(always)]
    fn slope(self, x: f32) -> f32 {
        let t = tanh(GELU.0 * (x + GELU.1 * x * x * x));
        0.5 * (1.0 + t) + 0.5 * x * (1.0 - t * t) * GELU.0 * (1.0 + 3.0 * GELU.1 * x * x)
    }
}

/// Evaluates an expression with the function of an [`Activation`](super::Activation), once compiled for each.
macro_rules! with_function {
    ($activation:expr, $f:ident => $body:expr) => {{
        use $crate::ops::activation::{Activation, functions};
        match $activation {
            Activation::None => {
                let $f = functions::Identity;
                $body
            }
            Activation::Relu => {
                let $f = functions::Relu;
                $body
            }
            Activation::LeakyRelu(slope) => {
                let $f = functions::LeakyRelu(slope);
                $body
            }
            Activation::Softplus => {
                let $f = functions::Softplus;
                $body
            }
            Activation::Sigmoid => {
                let $f = functions::Sigmoid;
                $body
            }
            Activation::Tanh => {
                let $f = functions::Tanh;
                $body
            }
            Activation::Silu => {
                let $f = functions::Silu;
                $body
            }
            Activation::Gelu => {
                let $f = functions::Gelu;
                $body
            }
            Activation::GeluTanh => {
                let $f = functions::GeluTanh;
                $body
            }
        }
    }};
}
pub(crate) use with_function;
