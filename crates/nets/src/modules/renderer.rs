//! A residual network that makes images of feature maps, modulated by a vector per image (Perez et al. 2018), with an upsampling by
//! pixel shuffle.

use crate::bridge::OpError;
use crate::layers::{Conv2d, Init, Linear};
use crate::ops::{self, Activation, Conv};
use crate::param::{Mode, Module, Visitor};
use burn::tensor::Tensor;

/// Size of a renderer.
#[derive(Clone, Copy, Debug)]
pub struct RendererSettings {
    /// Channels of the feature maps.
    pub inputs: usize,
    /// Numbers of the vector that modulates.
    pub codes: usize,
    pub width: usize,
    pub blocks: usize,
    /// How many times as large as the feature maps the images are; 1 for the same size.
    pub scale: usize,
}

/// Two convolutions, modulated in between, around which the input is added.
#[derive(Debug)]
struct Block {
    conv1: Conv2d,
    conv2: Conv2d,
    scale: Linear,
    shift: Linear,
}

impl Block {
    fn new(init: &mut Init, s: &RendererSettings) -> Block {
        let mut conv = || Conv2d::new(init, [s.width; 2], 3, Conv::same(3));
        let (conv1, conv2) = (conv(), conv());
        let mut linear = || Linear::new(init, s.codes, s.width, Activation::None);
        Block { conv1, conv2, scale: linear(), shift: linear() }
    }

    fn forward(&self, x: Tensor<4>, code: Tensor<2>, mode: Mode) -> Result<Tensor<4>, OpError> {
        let [x, skip] = ops::fork(x)?;
        let [for_scale, for_shift] = ops::fork(code)?;
        let (scale, shift) = (self.scale.forward(for_scale, mode)?, self.shift.forward(for_shift, mode)?);
        let x = ops::modulate(self.conv1.forward(x, mode)?, scale, shift)?;
        let x = self.conv2.forward(ops::activation(x, Activation::LeakyRelu(0.2))?, mode)?;
        ops::add(x, skip)
    }
}

impl Module for Block {
    fn visit(&self, v: &mut Visitor) {
        v.part("conv1", &self.conv1);
        v.part("conv2", &self.conv2);
        v.part("scale", &self.scale);
        v.part("shift", &self.shift);
    }
}

/// A renderer of feature maps.
#[derive(Debug)]
pub struct Renderer {
    stem: Conv2d,
    blocks: Vec<Block>,
    head: Conv2d,
    scale: usize,
}

impl Renderer {
    pub fn new(init: &mut Init, s: RendererSettings) -> Renderer {
        Renderer {
            stem: Conv2d::new(init, [s.inputs, s.width], 3, Conv::same(3).activation(Activation::LeakyRelu(0.2))),
            blocks: (0..s.blocks).map(|_| Block::new(init, &s)).collect(),
            head: Conv2d::new(init, [s.width, 3 * s.scale * s.scale], 3, Conv::same(3)),
            scale: s.scale,
        }
    }

    /// Colors in [0, 1].
    ///
    /// # Shapes
    /// features `[N, inputs, H, W]`; code `[N, codes]`; result `[N, 3, H · scale, W · scale]`.
    pub fn forward(&self, features: Tensor<4>, code: Tensor<2>, mode: Mode) -> Result<Tensor<4>, OpError> {
        let mut x = self.stem.forward(features, mode)?;
        let mut code = code;
        for block in &self.blocks {
            let [here, next] = ops::fork(code)?;
            code = next;
            x = block.forward(x, here, mode)?;
        }
        let x = self.head.forward(x, mode)?;
        let x = if self.scale > 1 { ops::pixel_shuffle(x, self.scale)? } else { x };
        ops::activation(x, Activation::Sigmoid)
    }
}

impl Module for Renderer {
    fn visit(&self, v: &mut Visitor) {
        v.part("stem", &self.stem);
        v.parts("blocks", &self.blocks);
        v.part("head", &self.head);
    }
}
