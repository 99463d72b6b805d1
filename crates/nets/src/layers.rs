//! Layers with weights of their own, named as in PyTorch; linear weights are `[in, out]`.

use crate::bridge::OpError;
use crate::ops::{self, Activation, BatchStatistics, Conv, NormSettings};
use crate::param::{Kind, Mode, Module, Param, Visitor};
use burn::tensor::{Device, Tensor};
use diorama_geom::rng::Rng;

/// Makes the weights of one network: each gets a stream of random numbers of its own.
pub struct Init {
    seed: u64,
    stream: u64,
    device: Device,
}

impl Init {
    pub fn new(seed: u64, device: &Device) -> Init {
        Init { seed, stream: 0, device: device.clone() }
    }

    fn rng(&mut self) -> Rng {
        self.stream += 1;
        Rng::new(self.seed, self.stream)
    }

    /// Normal numbers that keep the variance through a ReLU (He et al. 2015), by what an output or an input is summed of.
    pub fn kaiming(&mut self, shape: &[usize], fan: usize) -> Param {
        Param::normal(shape, (2.0 / fan as f32).sqrt(), &self.rng(), &self.device)
    }

    /// Uniform numbers in ±1 / √fan, PyTorch's default for weights and biases.
    pub fn by_fan(&mut self, shape: &[usize], fan: usize) -> Param {
        Param::uniform(shape, 1.0 / (fan as f32).sqrt(), &self.rng(), &self.device)
    }

    /// Normal numbers of a standard deviation.
    pub fn normal(&mut self, shape: &[usize], std: f32) -> Param {
        Param::normal(shape, std, &self.rng(), &self.device)
    }

    pub fn constant(&self, kind: Kind, shape: &[usize], value: f32) -> Param {
        Param::constant(kind, shape, value, &self.device)
    }
}

/// A convolution.
#[derive(Debug)]
pub struct Conv2d {
    /// `[out, in / groups, h, w]`.
    pub weight: Param,
    pub bias: Option<Param>,
    pub settings: Conv,
}

impl Conv2d {
    pub fn new(init: &mut Init, channels: [usize; 2], kernel: usize, settings: Conv) -> Conv2d {
        let (from, fan) = (channels[0] / settings.groups, channels[0] / settings.groups * kernel * kernel);
        let weight = init.kaiming(&[channels[1], from, kernel, kernel], fan);
        Conv2d { weight, bias: Some(init.constant(Kind::Weight, &[channels[1]], 0.0)), settings }
    }

    pub fn without_bias(self) -> Conv2d {
        Conv2d { bias: None, ..self }
    }

    pub fn forward(&self, x: Tensor<4>, mode: Mode) -> Result<Tensor<4>, OpError> {
        ops::conv2d(x, self.weight.tensor(mode), self.bias.as_ref().map(|b| b.tensor(mode)), self.settings)
    }
}

impl Module for Conv2d {
    fn visit(&self, v: &mut Visitor) {
        v.param("weight", &self.weight);
        if let Some(b) = &self.bias {
            v.param("bias", b);
        }
    }
}

/// A transposed convolution.
#[derive(Debug)]
pub struct ConvTranspose2d {
    /// `[in, out / groups, h, w]`.
    pub weight: Param,
    pub bias: Option<Param>,
    pub settings: Conv,
}

impl ConvTranspose2d {
    pub fn new(init: &mut Init, channels: [usize; 2], kernel: usize, settings: Conv) -> ConvTranspose2d {
        let stride = settings.stride[0] * settings.stride[1];
        // As many of the kernel's places as meet in one output.
        let fan = (channels[0] / settings.groups * kernel * kernel / stride).max(1);
        let weight = init.kaiming(&[channels[0], channels[1] / settings.groups, kernel, kernel], fan);
        ConvTranspose2d { weight, bias: Some(init.constant(Kind::Weight, &[channels[1]], 0.0)), settings }
    }

    pub fn without_bias(self) -> ConvTranspose2d {
        ConvTranspose2d { bias: None, ..self }
    }

    pub fn forward(&self, x: Tensor<4>, mode: Mode) -> Result<Tensor<4>, OpError> {
        ops::conv_transpose2d(x, self.weight.tensor(mode), self.bias.as_ref().map(|b| b.tensor(mode)), self.settings)
    }
}

impl Module for ConvTranspose2d {
    fn visit(&self, v: &mut Visitor) {
        v.param("weight", &self.weight);
        if let Some(b) = &self.bias {
            v.param("bias", b);
        }
    }
}

/// A fully connected layer on the last axis.
#[derive(Debug)]
pub struct Linear {
    /// `[in, out]`.
    pub weight: Param,
    pub bias: Option<Param>,
    pub activation: Activation,
}

impl Linear {
    pub fn new(init: &mut Init, inputs: usize, outputs: usize, activation: Activation) -> Linear {
        let weight = init.by_fan(&[inputs, outputs], inputs);
        Linear { weight, bias: Some(init.by_fan(&[outputs], inputs)), activation }
    }

    pub fn forward<const D: usize>(&self, x: Tensor<D>, mode: Mode) -> Result<Tensor<D>, OpError> {
        ops::linear(x, self.weight.tensor(mode), self.bias.as_ref().map(|b| b.tensor(mode)), self.activation)
    }
}

impl Module for Linear {
    fn visit(&self, v: &mut Visitor) {
        v.param("weight", &self.weight);
        if let Some(b) = &self.bias {
            v.param("bias", b);
        }
    }
}

/// Batch normalization with running statistics.
#[derive(Debug)]
pub struct BatchNorm {
    pub weight: Param,
    pub bias: Param,
    pub running_mean: Param,
    pub running_var: Param,
    pub momentum: f32,
    pub settings: NormSettings,
}

impl BatchNorm {
    pub fn new(init: &Init, channels: usize, activation: Activation) -> BatchNorm {
        let of = |kind, value| init.constant(kind, &[channels], value);
        BatchNorm {
            weight: of(Kind::Weight, 1.0),
            bias: of(Kind::Weight, 0.0),
            running_mean: of(Kind::Statistic, 0.0),
            running_var: of(Kind::Statistic, 1.0),
            momentum: 0.1,
            settings: NormSettings { activation, ..NormSettings::default() },
        }
    }

    pub fn forward<const D: usize>(&self, x: Tensor<D>, mode: Mode) -> Result<Tensor<D>, OpError> {
        let running = BatchStatistics { mean: &self.running_mean, variance: &self.running_var, momentum: self.momentum };
        ops::batch_norm(x, self.weight.tensor(mode), self.bias.tensor(mode), running, self.settings, mode)
    }
}

impl Module for BatchNorm {
    fn visit(&self, v: &mut Visitor) {
        v.param("weight", &self.weight);
        v.param("bias", &self.bias);
        v.param("running_mean", &self.running_mean);
        v.param("running_var", &self.running_var);
    }
}

/// Group normalization; instance normalization with as many groups as channels.
#[derive(Debug)]
pub struct GroupNorm {
    pub weight: Param,
    pub bias: Param,
    pub groups: usize,
    pub settings: NormSettings,
}

impl GroupNorm {
    pub fn new(init: &Init, channels: usize, groups: usize, activation: Activation) -> GroupNorm {
        let of = |value| init.constant(Kind::Weight, &[channels], value);
        GroupNorm { weight: of(1.0), bias: of(0.0), groups, settings: NormSettings { activation, ..NormSettings::default() } }
    }

    pub fn forward(&self, x: Tensor<4>, mode: Mode) -> Result<Tensor<4>, OpError> {
        ops::group_norm(x, self.weight.tensor(mode), self.bias.tensor(mode), self.groups, self.settings)
    }
}

impl Module for GroupNorm {
    fn visit(&self, v: &mut Visitor) {
        v.param("weight", &self.weight);
        v.param("bias", &self.bias);
    }
}

/// Layer normalization of the last axis.
#[derive(Debug)]
pub struct LayerNorm {
    pub weight: Param,
    pub bias: Param,
    pub settings: NormSettings,
}

impl LayerNorm {
    pub fn new(init: &Init, width: usize, epsilon: f32) -> LayerNorm {
        let of = |value| init.constant(Kind::Weight, &[width], value);
        LayerNorm { weight: of(1.0), bias: of(0.0), settings: NormSettings { epsilon, activation: Activation::None } }
    }

    pub fn forward<const D: usize>(&self, x: Tensor<D>, mode: Mode) -> Result<Tensor<D>, OpError> {
        ops::layer_norm(x, self.weight.tensor(mode), self.bias.tensor(mode), self.settings)
    }
}

impl Module for LayerNorm {
    fn visit(&self, v: &mut Visitor) {
        v.param("weight", &self.weight);
        v.param("bias", &self.bias);
    }
}
