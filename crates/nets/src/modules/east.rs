//! EAST (Zhou et al. 2017): a score and a rotated box for each cell of four by four pixels, from features merged from coarse to fine.

use super::resnet::{Normed, ResNet, ResNetSettings, normalized};
use crate::bridge::OpError;
use crate::layers::{Conv2d, Init};
use crate::ops::{self, Activation, Conv, Filter};
use crate::param::{Mode, Module, Visitor};
use burn::tensor::Tensor;
use std::f32::consts::PI;

/// Largest distance to a side that is predicted, in pixels.
pub(super) const MOST_PX: f32 = 512.0;
/// Weight of the angle's loss.
const ANGLE_WEIGHT: f32 = 10.0;
const EPSILON: f32 = 1e-5;

/// Size of an EAST network.
#[derive(Clone, Copy, Debug)]
pub struct EastSettings {
    pub backbone: ResNetSettings,
    /// Channels after merging the features at strides 16, 8 and 4.
    pub widths: [usize; 3],
}

impl EastSettings {
    pub const RESNET_50: EastSettings = EastSettings { backbone: ResNetSettings::RESNET_50, widths: [128, 64, 32] };
    pub const TINY: EastSettings = EastSettings { backbone: ResNetSettings::TINY, widths: [64, 32, 16] };
}

/// What EAST predicts.
#[derive(Clone, Debug)]
pub struct EastMaps {
    /// From 0 to 1, `[N, 1, H / 4, W / 4]`.
    pub score: Tensor<4>,
    /// Distances to the upper, right, lower and left side from 0 to 512 pixels, and the angle in `(−π/2, π/2)`, `[N, 5, H / 4, W / 4]`.
    pub geometry: Tensor<4>,
}

/// An EAST network.
#[derive(Debug)]
pub struct East {
    pub(super) backbone: ResNet,
    /// Of each merge a 1×1 and a 3×3 convolution.
    pub(super) merges: Vec<[Normed; 2]>,
    pub(super) last: Normed,
    /// Score, four distances, angle.
    pub(super) head: Conv2d,
}

impl East {
    pub fn new(init: &mut Init, settings: EastSettings) -> East {
        let backbone = ResNet::new(init, ResNetSettings { classes: None, ..settings.backbone });
        let channels = settings.backbone.channels();
        let mut from = channels[3];
        let mut merge = |i: usize| {
            let width = settings.widths[i];
            let reduce = Normed::new(init, [from + channels[2 - i], width], 1, 1, Activation::Relu);
            from = width;
            [reduce, Normed::new(init, [width, width], 3, 1, Activation::Relu)]
        };
        let merges = (0..3).map(&mut merge).collect();
        let last = Normed::new(init, [from, from], 3, 1, Activation::Relu);
        let head = Conv2d::new(init, [from, 6], 1, Conv::default());
        East { backbone, merges, last, head }
    }

    /// Maps of images.
    ///
    /// # Shapes
    /// x `[N, 3, H, W]`: sRGB from 0 to 1, H and W multiples of 32.
    pub fn forward(&self, x: Tensor<4>, mode: Mode) -> Result<EastMaps, OpError> {
        let [c2, c3, c4, mut x] = self.backbone.features(normalized(x), mode)?;
        for (feature, [reduce, smooth]) in [c4, c3, c2].into_iter().zip(&self.merges) {
            let [_, _, h, w] = feature.dims();
            let above = ops::resize(x, Filter::Bilinear { align_corners: false }, [h, w])?;
            x = smooth.forward(reduce.forward(ops::concat_channels(vec![above, feature])?, mode)?, mode)?;
        }
        let raw = self.head.forward(self.last.forward(x, mode)?, mode)?;
        let shares = ops::activation(raw, Activation::Sigmoid)?;
        let distances = shares.clone().narrow(1, 1, 4) * MOST_PX;
        let angle = (shares.clone().narrow(1, 5, 1) - 0.5) * PI;
        Ok(EastMaps { score: shares.narrow(1, 0, 1), geometry: Tensor::cat(vec![distances, angle], 1) })
    }
}

impl Module for East {
    fn visit(&self, v: &mut Visitor) {
        v.part("backbone", &self.backbone);
        for (i, [reduce, smooth]) in self.merges.iter().enumerate() {
            v.part(&format!("merges.{i}.0"), reduce);
            v.part(&format!("merges.{i}.1"), smooth);
        }
        v.part("last", &self.last);
        v.part("head", &self.head);
    }
}

/// What EAST should predict, in maps of four by four pixels.
#[derive(Clone, Debug)]
pub struct EastTruth {
    /// 1 where there is writing, else 0, `[N, 1, h, w]`.
    pub score: Tensor<4>,
    /// 0 where nothing is to be learned, else 1, `[N, 1, h, w]`.
    pub weight: Tensor<4>,
    /// As [`EastMaps::geometry`], `[N, 5, h, w]`.
    pub geometry: Tensor<4>,
}

/// The loss and its parts, each `[1]`.
#[derive(Clone, Debug)]
pub struct EastLoss {
    /// `dice + iou + 10 angle`.
    pub total: Tensor<1>,
    pub dice: Tensor<1>,
    pub iou: Tensor<1>,
    pub angle: Tensor<1>,
}

/// `1 − 2 Σ s g / (Σ s + Σ g)` of the score, plus the means over writing of `−ln((I + 1) / (U + 1))`, with intersection and union of
/// the boxes at one angle, and of `10 (1 − cos Δθ)`.
pub fn east_loss(maps: &EastMaps, truth: &EastTruth) -> EastLoss {
    let score = maps.score.clone() * truth.weight.clone();
    let wanted = truth.score.clone() * truth.weight.clone();
    let sum = wanted.clone().sum();
    let dice = dice(score, wanted.clone());
    let side = |g: &Tensor<4>, k: usize| g.clone().narrow(1, k, 1);
    let (p, g) = (&maps.geometry, &truth.geometry);
    let area = |m: &Tensor<4>| (side(m, 0) + side(m, 2)) * (side(m, 1) + side(m, 3));
    let shared = |k: usize| side(p, k).min_pair(side(g, k));
    let intersection = (shared(0) + shared(2)) * (shared(1) + shared(3));
    let union = area(p) + area(g) - intersection.clone();
    // Nothing is learned of boxes where there is none.
    let count = sum.clamp_min(1.0);
    let iou = (((union + 1.0).log() - (intersection + 1.0).log()) * wanted.clone()).sum() / count.clone();
    let angle = ((side(p, 4) - side(g, 4)).cos().neg().add_scalar(1.0) * wanted).sum() / count;
    EastLoss { total: dice.clone() + iou.clone() + angle.clone() * ANGLE_WEIGHT, dice, iou, angle }
}

/// `1 − 2 Σ a b / (Σ a + Σ b)`
pub(super) fn dice(a: Tensor<4>, b: Tensor<4>) -> Tensor<1> {
    let both = (a.clone() * b.clone()).sum() * 2.0;
    (both / (a.sum() + b.sum() + EPSILON)).neg() + 1.0
}
