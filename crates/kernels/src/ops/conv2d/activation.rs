//! Non-linearities that follow a convolution: in place on f32, value and slope in f64.

use crate::math::{self, multiversion};

/// Elementwise non-linearity after the bias.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Activation {
    #[default]
    None,
    Relu,
    /// `x` where positive, else `slope · x`, with a slope of 0 or more.
    LeakyRelu(f32),
    Sigmoid,
    Tanh,
    /// `x · sigmoid(x)`
    Silu,
}

impl Activation {
    /// Whether the slope needs the value before the activation, as several inputs have the same output.
    pub fn needs_input(self) -> bool {
        self == Activation::Silu
    }

    /// Value at `x`.
    pub fn value(self, x: f64) -> f64 {
        match self {
            Activation::None => x,
            Activation::Relu => x.max(0.0),
            Activation::LeakyRelu(slope) => {
                if x > 0.0 {
                    x
                } else {
                    slope as f64 * x
                }
            }
            Activation::Sigmoid => 1.0 / (1.0 + (-x).exp()),
            Activation::Tanh => x.tanh(),
            Activation::Silu => x / (1.0 + (-x).exp()),
        }
    }

    /// Slope at `x`.
    pub fn slope(self, x: f64) -> f64 {
        match self {
            Activation::None => 1.0,
            Activation::Relu => (x > 0.0) as u8 as f64,
            Activation::LeakyRelu(slope) => {
                if x > 0.0 {
                    1.0
                } else {
                    slope as f64
                }
            }
            Activation::Sigmoid => {
                let s = self.value(x);
                s * (1.0 - s)
            }
            Activation::Tanh => 1.0 - x.tanh() * x.tanh(),
            Activation::Silu => {
                let s = Activation::Sigmoid.value(x);
                s * (1.0 + x * (1.0 - s))
            }
        }
    }

    /// `x ← act(x)`
    pub fn apply(self, values: &mut [f32]) {
        match self {
            Activation::None => {}
            Activation::Relu => relu(values),
            Activation::LeakyRelu(slope) => leaky(values, slope),
            Activation::Sigmoid => math::sigmoid_in_place(values),
            Activation::Tanh => tanh(values),
            Activation::Silu => silu(values),
        }
    }

    /// `out = d · slope`, with `kept` the activation's input where [`Activation::needs_input`], else its output.
    ///
    /// # Shapes
    /// All three of one length.
    pub fn backward(self, kept: &[f32], d: &[f32], out: &mut [f32]) {
        match self {
            Activation::None => out.copy_from_slice(d),
            Activation::Relu => leaky_backward(kept, d, out, 0.0),
            Activation::LeakyRelu(slope) => leaky_backward(kept, d, out, slope),
            Activation::Sigmoid => sigmoid_backward(kept, d, out),
            Activation::Tanh => tanh_backward(kept, d, out),
            Activation::Silu => silu_backward(kept, d, out),
        }
    }
}

multiversion! {
    fn relu(values: &mut [f32]) {
        values.iter_mut().for_each(|v| *v = if *v > 0.0 { *v } else { 0.0 });
    }
}

multiversion! {
    fn leaky(values: &mut [f32], slope: f32) {
        values.iter_mut().for_each(|v| *v = if *v > 0.0 { *v } else { slope * *v });
    }
}

multiversion! {
    fn tanh(values: &mut [f32]) {
        for v in values {
            let twice = 2.0 * v.abs();
            *v = (math::one_minus_exp_neg(twice) / (1.0 + math::exp(-twice))).copysign(*v);
        }
    }
}

multiversion! {
    fn silu(values: &mut [f32]) {
        values.iter_mut().for_each(|v| *v /= 1.0 + math::exp(-*v));
    }
}

multiversion! {
    fn leaky_backward(kept: &[f32], d: &[f32], out: &mut [f32], slope: f32) {
        for ((o, k), d) in out.iter_mut().zip(kept).zip(d) {
            *o = if *k > 0.0 { *d } else { slope * d };
        }
    }
}

multiversion! {
    fn sigmoid_backward(kept: &[f32], d: &[f32], out: &mut [f32]) {
        for ((o, k), d) in out.iter_mut().zip(kept).zip(d) {
            *o = d * k * (1.0 - k);
        }
    }
}

multiversion! {
    fn tanh_backward(kept: &[f32], d: &[f32], out: &mut [f32]) {
        for ((o, k), d) in out.iter_mut().zip(kept).zip(d) {
            *o = d * (1.0 - k * k);
        }
    }
}

multiversion! {
    fn silu_backward(kept: &[f32], d: &[f32], out: &mut [f32]) {
        for ((o, k), d) in out.iter_mut().zip(kept).zip(d) {
            let s = 1.0 / (1.0 + math::exp(-*k));
            *o = d * s * (1.0 + k * (1.0 - s));
        }
    }
}
