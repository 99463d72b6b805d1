//! The functions and their slopes in f32, free of branches, so that loops over them become vector code.

use crate::vector::{exp, fma, ln_1p, normal, sigmoid, tanh};

/// One function of one number.
pub(crate) trait Function: Copy {
    fn value<const F: bool>(self, x: f32) -> f32;
    fn slope<const F: bool>(self, x: f32) -> f32;
}

#[derive(Clone, Copy)]
pub(crate) struct Identity;
impl Function for Identity {
    #[inline(always)]
    fn value<const F: bool>(self, x: f32) -> f32 {
        x
    }
    #[inline(always)]
    fn slope<const F: bool>(self, _: f32) -> f32 {
        1.0
    }
}

#[derive(Clone, Copy)]
pub(crate) struct Relu;
impl Function for Relu {
    #[inline(always)]
    fn value<const F: bool>(self, x: f32) -> f32 {
        // Written so that NaN stays NaN.
        if x < 0.0 { 0.0 } else { x }
    }
    #[inline(always)]
    fn slope<const F: bool>(self, x: f32) -> f32 {
        if x > 0.0 { 1.0 } else { 0.0 }
    }
}

#[derive(Clone, Copy)]
pub(crate) struct LeakyRelu(pub f32);
impl Function for LeakyRelu {
    #[inline(always)]
    fn value<const F: bool>(self, x: f32) -> f32 {
        if x > 0.0 { x } else { self.0 * x }
    }
    #[inline(always)]
    fn slope<const F: bool>(self, x: f32) -> f32 {
        if x > 0.0 { 1.0 } else { self.0 }
    }
}

#[derive(Clone, Copy)]
pub(crate) struct Softplus;
impl Function for Softplus {
    #[inline(always)]
    fn value<const F: bool>(self, x: f32) -> f32 {
        (if x < 0.0 { 0.0 } else { x }) + ln_1p::<F>(exp::<F>(-x.abs()))
    }
    #[inline(always)]
    fn slope<const F: bool>(self, x: f32) -> f32 {
        sigmoid::<F>(x)
    }
}

#[derive(Clone, Copy)]
pub(crate) struct Sigmoid;
impl Function for Sigmoid {
    #[inline(always)]
    fn value<const F: bool>(self, x: f32) -> f32 {
        sigmoid::<F>(x)
    }
    #[inline(always)]
    fn slope<const F: bool>(self, x: f32) -> f32 {
        let y = sigmoid::<F>(x);
        y * (1.0 - y)
    }
}

#[derive(Clone, Copy)]
pub(crate) struct Tanh;
impl Function for Tanh {
    #[inline(always)]
    fn value<const F: bool>(self, x: f32) -> f32 {
        tanh::<F>(x)
    }
    #[inline(always)]
    fn slope<const F: bool>(self, x: f32) -> f32 {
        let y = tanh::<F>(x);
        fma::<F>(-y, y, 1.0)
    }
}

#[derive(Clone, Copy)]
pub(crate) struct Silu;
impl Function for Silu {
    #[inline(always)]
    fn value<const F: bool>(self, x: f32) -> f32 {
        x / (1.0 + exp::<F>(-x))
    }
    #[inline(always)]
    fn slope<const F: bool>(self, x: f32) -> f32 {
        let s = sigmoid::<F>(x);
        let y = x * s;
        fma::<F>(-y, s, y) + s
    }
}

#[derive(Clone, Copy)]
pub(crate) struct Gelu;
impl Function for Gelu {
    #[inline(always)]
    fn value<const F: bool>(self, x: f32) -> f32 {
        x * normal::<F>(x)
    }
    #[inline(always)]
    fn slope<const F: bool>(self, x: f32) -> f32 {
        const DENSITY: f32 = 0.398_942_3;
        fma::<F>(x * DENSITY, exp::<F>(-0.5 * x * x), normal::<F>(x))
    }
}

/// `√(2/π)` and the cubic term's factor.
const GELU: (f32, f32) = (0.797_884_6, 0.044_715);

#[derive(Clone, Copy)]
pub(crate) struct GeluTanh;
impl Function for GeluTanh {
    #[inline(always)]
    fn value<const F: bool>(self, x: f32) -> f32 {
        let half = 0.5 * x;
        fma::<F>(half, tanh::<F>(GELU.0 * x * fma::<F>(GELU.1 * x, x, 1.0)), half)
    }
    #[inline(always)]
    fn slope<const F: bool>(self, x: f32) -> f32 {
        let t = tanh::<F>(GELU.0 * x * fma::<F>(GELU.1 * x, x, 1.0));
        let inner = GELU.0 * fma::<F>(3.0 * GELU.1 * x, x, 1.0);
        0.5 * (1.0 + t) + 0.5 * x * fma::<F>(-t, t, 1.0) * inner
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
