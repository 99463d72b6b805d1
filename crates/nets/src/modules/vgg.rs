//! VGG (Simonyan and Zisserman 2015) as features for perceptual losses: the values after chosen ReLUs.

use crate::bridge::OpError;
use crate::layers::{Conv2d, Init};
use crate::ops::{self, Activation, Conv, Pool};
use crate::param::{Mode, Module, Visitor};
use burn::tensor::Tensor;

/// Size of a VGG.
#[derive(Clone, Copy, Debug)]
pub struct VggSettings {
    /// Convolutions of each stage.
    pub convs: [usize; 5],
    /// Channels of the first stage: 64.
    pub width: usize,
}

impl VggSettings {
    pub const VGG_16: VggSettings = VggSettings { convs: [2, 2, 3, 3, 3], width: 64 };
    pub const VGG_19: VggSettings = VggSettings { convs: [2, 2, 4, 4, 4], width: 64 };
}

/// The convolutions of a VGG.
#[derive(Debug)]
pub struct Vgg {
    stages: Vec<Vec<Conv2d>>,
}

impl Vgg {
    pub fn new(init: &mut Init, s: VggSettings) -> Vgg {
        let mut from = 3;
        let stage = |(i, n): (usize, &usize)| {
            let to = s.width << i.min(3);
            let convs = (0..*n).map(|_| {
                let conv = Conv2d::new(init, [from, to], 3, Conv::same(3).activation(Activation::Relu));
                from = to;
                conv
            });
            convs.collect()
        };
        Vgg { stages: s.convs.iter().enumerate().map(stage).collect() }
    }

    /// The values after the ReLUs `(stage, conv)`, both from 1, in rising order, as `(3, 3)` for `relu3_3`. Stages beyond the last one
    /// are not computed.
    ///
    /// # Shapes
    /// x `[N, 3, H, W]`, normalized by ImageNet's mean and deviation.
    pub fn features(&self, mut x: Tensor<4>, wanted: &[(usize, usize)], mode: Mode) -> Result<Vec<Tensor<4>>, OpError> {
        let mut out = Vec::new();
        for (stage, convs) in self.stages.iter().enumerate() {
            for (i, conv) in convs.iter().enumerate() {
                if out.len() == wanted.len() {
                    return Ok(out);
                }
                x = conv.forward(x, mode)?;
                if wanted[out.len()] == (stage + 1, i + 1) {
                    let [here, next] = ops::fork(x)?;
                    out.push(here);
                    x = next;
                }
            }
            if out.len() < wanted.len() {
                x = ops::max_pool(x, Pool { kernel: [2; 2], stride: [2; 2], padding: [0; 2], ceil_mode: false })?;
            }
        }
        if out.len() == wanted.len() { Ok(out) } else { Err(OpError::settings("vgg", format!("no layer {:?}", wanted[out.len()]))) }
    }
}

impl Module for Vgg {
    fn visit(&self, v: &mut Visitor) {
        // Each convolution is followed by a ReLU, each stage by a pool.
        let mut index = 0;
        for convs in &self.stages {
            for conv in convs {
                v.part(&format!("features.{index}"), conv);
                index += 2;
            }
            index += 1;
        }
    }
}
