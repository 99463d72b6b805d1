//! Residual networks (He et al. 2016) as backbones: features at strides 4, 8, 16 and 32, and a classifier where there is one.

use crate::bridge::OpError;
use crate::layers::{BatchNorm, Conv2d, Init, Linear};
use crate::ops::{self, Activation, Conv, Pool};
use crate::param::{Mode, Module, Visitor};
use burn::tensor::{Tensor, TensorData};

/// Size of a residual network.
#[derive(Clone, Copy, Debug)]
pub struct ResNetSettings {
    /// Blocks of each stage.
    pub blocks: [usize; 4],
    /// Whether blocks narrow to a quarter between 1×1 convolutions.
    pub bottleneck: bool,
    /// Channels of the first stage before widening: 64.
    pub width: usize,
    pub classes: Option<usize>,
}

impl ResNetSettings {
    pub const RESNET_18: ResNetSettings = ResNetSettings { blocks: [2; 4], bottleneck: false, width: 64, classes: None };
    /// Backbone of small detectors: a block per stage, 16 to 128 channels, 0.31 M weights.
    pub const TINY: ResNetSettings = ResNetSettings { blocks: [1; 4], bottleneck: false, width: 16, classes: None };
    pub const RESNET_50: ResNetSettings = ResNetSettings { blocks: [3, 4, 6, 3], bottleneck: true, width: 64, classes: None };

    /// Channels of the features at each stride.
    pub fn channels(&self) -> [usize; 4] {
        std::array::from_fn(|i| (self.width << i) * if self.bottleneck { 4 } else { 1 })
    }
}

/// Mean and standard deviation of the channels of ImageNet's photographs (sRGB from 0 to 1), on which backbones are trained elsewhere.
pub(super) const IMAGENET: [[f32; 3]; 2] = [[0.485, 0.456, 0.406], [0.229, 0.224, 0.225]];

/// Images whose channels have mean 0 and variance 1 over many photographs.
///
/// # Shapes
/// x `[N, 3, H, W]`.
pub(super) fn normalized(x: Tensor<4>) -> Tensor<4> {
    let device = x.device();
    let [mean, deviation] = IMAGENET.map(|v| Tensor::<4>::from_data(TensorData::new(v.to_vec(), [1, 3, 1, 1]), &device));
    (x - mean) / deviation
}

/// A convolution without bias and its normalization.
#[derive(Debug)]
pub(super) struct Normed {
    pub(super) conv: Conv2d,
    pub(super) norm: BatchNorm,
}

impl Normed {
    pub(super) fn new(init: &mut Init, channels: [usize; 2], kernel: usize, stride: usize, activation: Activation) -> Normed {
        let conv = Conv2d::new(init, channels, kernel, Conv::same(kernel).stride(stride)).without_bias();
        Normed { conv, norm: BatchNorm::new(init, channels[1], activation) }
    }

    pub(super) fn forward(&self, x: Tensor<4>, mode: Mode) -> Result<Tensor<4>, OpError> {
        self.norm.forward(self.conv.forward(x, mode)?, mode)
    }
}

/// Named by their places, as in PyTorch's `Sequential`.
impl Module for Normed {
    fn visit(&self, v: &mut Visitor) {
        v.part("0", &self.conv);
        v.part("1", &self.norm);
    }
}

/// Two or three convolutions around which the input is added.
#[derive(Debug)]
pub(super) struct Block {
    pub(super) parts: Vec<Normed>,
    pub(super) downsample: Option<Normed>,
}

impl Block {
    fn new(init: &mut Init, s: &ResNetSettings, from: usize, width: usize, stride: usize) -> Block {
        let relu = Activation::Relu;
        let (parts, to) = if s.bottleneck {
            let narrow = Normed::new(init, [from, width], 1, 1, relu);
            let middle = Normed::new(init, [width, width], 3, stride, relu);
            (vec![narrow, middle, Normed::new(init, [width, 4 * width], 1, 1, Activation::None)], 4 * width)
        } else {
            let first = Normed::new(init, [from, width], 3, stride, relu);
            (vec![first, Normed::new(init, [width, width], 3, 1, Activation::None)], width)
        };
        let downsample = (stride != 1 || from != to).then(|| Normed::new(init, [from, to], 1, stride, Activation::None));
        Block { parts, downsample }
    }

    fn forward(&self, x: Tensor<4>, mode: Mode) -> Result<Tensor<4>, OpError> {
        let [mut x, mut skip] = ops::fork(x)?;
        for part in &self.parts {
            x = part.forward(x, mode)?;
        }
        if let Some(d) = &self.downsample {
            skip = d.forward(skip, mode)?;
        }
        ops::add_relu(x, skip)
    }
}

impl Module for Block {
    fn visit(&self, v: &mut Visitor) {
        for (i, part) in self.parts.iter().enumerate() {
            v.part(&format!("conv{}", i + 1), &part.conv);
            v.part(&format!("bn{}", i + 1), &part.norm);
        }
        if let Some(d) = &self.downsample {
            v.part("downsample.0", &d.conv);
            v.part("downsample.1", &d.norm);
        }
    }
}

/// Features at strides 4, 8, 16 and 32, `[N, Cᵢ, H / strideᵢ, W / strideᵢ]`.
pub type Features = [Tensor<4>; 4];

/// A residual network.
#[derive(Debug)]
pub struct ResNet {
    pub(super) stem: Normed,
    pub(super) layers: [Vec<Block>; 4],
    head: Option<Linear>,
}

impl ResNet {
    pub fn new(init: &mut Init, settings: ResNetSettings) -> ResNet {
        let s = settings;
        let stem = Normed::new(init, [3, s.width], 7, 2, Activation::Relu);
        let mut from = s.width;
        let layers = std::array::from_fn(|stage| {
            let blocks = (0..s.blocks[stage]).map(|i| {
                let block = Block::new(init, &s, from, s.width << stage, if stage > 0 && i == 0 { 2 } else { 1 });
                from = s.channels()[stage];
                block
            });
            blocks.collect()
        });
        let head = s.classes.map(|n| Linear::new(init, s.channels()[3], n, Activation::None));
        ResNet { stem, layers, head }
    }

    /// Features of images.
    ///
    /// # Shapes
    /// x `[N, 3, H, W]`.
    pub fn features(&self, x: Tensor<4>, mode: Mode) -> Result<Features, OpError> {
        let x = self.stem.forward(x, mode)?;
        let mut x = ops::max_pool(x, Pool { kernel: [3; 2], stride: [2; 2], padding: [1; 2], ceil_mode: false })?;
        let mut out = Vec::new();
        for (stage, blocks) in self.layers.iter().enumerate() {
            for block in blocks {
                x = block.forward(x, mode)?;
            }
            if stage < 3 {
                let [feature, next] = ops::fork(x)?;
                out.push(feature);
                x = next;
            }
        }
        out.push(x);
        Ok(out.try_into().unwrap_or_else(|_| unreachable!("four stages")))
    }

    /// Logits of classes.
    ///
    /// # Shapes
    /// x `[N, 3, H, W]`; result `[N, classes]`.
    ///
    /// # Errors
    /// When the network has no classes.
    pub fn classify(&self, x: Tensor<4>, mode: Mode) -> Result<Tensor<2>, OpError> {
        let head = self.head.as_ref().ok_or_else(|| OpError::settings("resnet", "a network without classes"))?;
        let [.., last] = self.features(x, mode)?;
        head.forward(ops::global_average_pool(last)?, mode)
    }
}

impl Module for ResNet {
    fn visit(&self, v: &mut Visitor) {
        v.part("conv1", &self.stem.conv);
        v.part("bn1", &self.stem.norm);
        for (i, blocks) in self.layers.iter().enumerate() {
            v.parts(&format!("layer{}", i + 1), blocks);
        }
        if let Some(head) = &self.head {
            v.part("fc", head);
        }
    }
}
