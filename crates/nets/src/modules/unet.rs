//! U-Net (Ronneberger et al. 2015) with group normalization: halves the image on the way down, doubles it on the way up, and joins
//! what it knew at each size.

use crate::bridge::OpError;
use crate::layers::{Conv2d, GroupNorm, Init};
use crate::ops::{self, Activation, Conv, Filter, Pool};
use crate::param::{Mode, Module, Visitor};
use burn::tensor::Tensor;

/// Size of a U-Net.
#[derive(Clone, Copy, Debug)]
pub struct UNetSettings {
    pub inputs: usize,
    pub outputs: usize,
    /// Channels at full size; each halving doubles them.
    pub width: usize,
    /// How often the image is halved.
    pub depth: usize,
    /// Groups of the normalization.
    pub groups: usize,
}

/// Two convolutions with normalization and ReLU.
#[derive(Debug)]
struct Double {
    convs: [Conv2d; 2],
    norms: [GroupNorm; 2],
}

impl Double {
    fn new(init: &mut Init, from: usize, to: usize, groups: usize) -> Double {
        let mut conv = |from| Conv2d::new(init, [from, to], 3, Conv::same(3)).without_bias();
        let convs = [conv(from), conv(to)];
        let norms = std::array::from_fn(|_| GroupNorm::new(init, to, groups, Activation::Relu));
        Double { convs, norms }
    }

    fn forward(&self, mut x: Tensor<4>, mode: Mode) -> Result<Tensor<4>, OpError> {
        for (conv, norm) in self.convs.iter().zip(&self.norms) {
            x = norm.forward(conv.forward(x, mode)?, mode)?;
        }
        Ok(x)
    }
}

impl Module for Double {
    fn visit(&self, v: &mut Visitor) {
        v.part("0", &self.convs[0]);
        v.part("1", &self.norms[0]);
        v.part("3", &self.convs[1]);
        v.part("4", &self.norms[1]);
    }
}

/// A U-Net.
#[derive(Debug)]
pub struct UNet {
    down: Vec<Double>,
    up: Vec<Double>,
    head: Conv2d,
}

impl UNet {
    pub fn new(init: &mut Init, s: UNetSettings) -> UNet {
        let width = |i: usize| s.width << i;
        let down = (0..=s.depth).map(|i| Double::new(init, if i == 0 { s.inputs } else { width(i - 1) }, width(i), s.groups)).collect();
        let up = (0..s.depth).rev().map(|i| Double::new(init, width(i + 1) + width(i), width(i), s.groups)).collect();
        let head = Conv2d::new(init, [s.width, s.outputs], 1, Conv::default());
        UNet { down, up, head }
    }

    /// # Shapes
    /// x `[N, inputs, H, W]`, where H and W divide by `2^depth`; result `[N, outputs, H, W]`.
    pub fn forward(&self, mut x: Tensor<4>, mode: Mode) -> Result<Tensor<4>, OpError> {
        let mut known = Vec::new();
        for (i, part) in self.down.iter().enumerate() {
            if i > 0 {
                let [skip, next] = ops::fork(x)?;
                known.push(skip);
                x = ops::max_pool(next, Pool { kernel: [2; 2], stride: [2; 2], padding: [0; 2], ceil_mode: false })?;
            }
            x = part.forward(x, mode)?;
        }
        for part in &self.up {
            let skip = known.pop().expect("as many joins as halvings");
            let [_, _, h, w] = skip.dims();
            let large = ops::resize(x, Filter::Bilinear { align_corners: false }, [h, w])?;
            x = part.forward(ops::concat_channels(vec![skip, large])?, mode)?;
        }
        self.head.forward(x, mode)
    }
}

impl Module for UNet {
    fn visit(&self, v: &mut Visitor) {
        v.parts("down", &self.down);
        v.parts("up", &self.up);
        v.part("head", &self.head);
    }
}
