//! DB (Liao et al. 2020), differentiable binarization: a probability and a threshold for each pixel, from a feature pyramid.

use super::Fpn;
use super::east::dice;
use super::resnet::{Normed, ResNet, ResNetSettings, normalized};
use crate::bridge::OpError;
use crate::layers::{BatchNorm, ConvTranspose2d, Init};
use crate::ops::{self, Activation, Conv, Filter};
use crate::param::{Mode, Module, Visitor};
use burn::tensor::{Tensor, TensorData};

/// Steepness of the binarization.
const STEEPNESS: f32 = 50.0;
/// Weights of the thresholds' and of the probabilities' loss.
const THRESHOLD_WEIGHT: f32 = 10.0;
const PROBABILITY_WEIGHT: f32 = 5.0;
/// Pixels without writing that are learned of, for each with writing.
const NEGATIVES: f64 = 3.0;
const EPSILON: f32 = 1e-6;

/// Size of a DB network.
#[derive(Clone, Copy, Debug)]
pub struct DbSettings {
    pub backbone: ResNetSettings,
    /// Channels at which the pyramid sums.
    pub inner: usize,
    /// Channels of each of the pyramid's four levels, and of the heads.
    pub level: usize,
}

impl DbSettings {
    pub const RESNET_50: DbSettings = DbSettings { backbone: ResNetSettings::RESNET_50, inner: 256, level: 64 };
    pub const TINY: DbSettings = DbSettings { backbone: ResNetSettings::TINY, inner: 64, level: 16 };
}

/// What DB predicts, `[N, 1, H, W]` each.
#[derive(Clone, Debug)]
pub struct DbMaps {
    /// Logits of the probability.
    pub logits: Tensor<4>,
    /// From 0 to 1; none where it was not asked for.
    pub threshold: Option<Tensor<4>>,
}

/// From features at a quarter of the size to one channel at full size.
#[derive(Debug)]
pub(super) struct Head {
    pub(super) first: Normed,
    pub(super) grow: ConvTranspose2d,
    pub(super) norm: BatchNorm,
    pub(super) last: ConvTranspose2d,
}

impl Head {
    fn new(init: &mut Init, from: usize, width: usize) -> Head {
        let first = Normed::new(init, [from, width], 3, 1, Activation::Relu);
        let double = Conv::default().stride(2);
        let grow = ConvTranspose2d::new(init, [width, width], 2, double).without_bias();
        let norm = BatchNorm::new(init, width, Activation::Relu);
        Head { first, grow, norm, last: ConvTranspose2d::new(init, [width, 1], 2, double) }
    }

    fn forward(&self, x: Tensor<4>, mode: Mode) -> Result<Tensor<4>, OpError> {
        let x = self.grow.forward(self.first.forward(x, mode)?, mode)?;
        self.last.forward(self.norm.forward(x, mode)?, mode)
    }
}

impl Module for Head {
    fn visit(&self, v: &mut Visitor) {
        v.part("first", &self.first);
        v.part("grow", &self.grow);
        v.part("norm", &self.norm);
        v.part("last", &self.last);
    }
}

/// A DB network.
#[derive(Debug)]
pub struct Db {
    pub(super) backbone: ResNet,
    pub(super) pyramid: Fpn,
    pub(super) probability: Head,
    threshold: Head,
}

impl Db {
    pub fn new(init: &mut Init, s: DbSettings) -> Db {
        let backbone = ResNet::new(init, ResNetSettings { classes: None, ..s.backbone });
        let pyramid = Fpn::narrowing(init, s.backbone.channels(), s.inner, s.level);
        let [probability, threshold] = std::array::from_fn(|_| Head::new(init, 4 * s.level, s.level));
        Db { backbone, pyramid, probability, threshold }
    }

    /// Maps of images; the threshold only in training.
    ///
    /// # Shapes
    /// x `[N, 3, H, W]`: sRGB from 0 to 1, H and W multiples of 32.
    pub fn forward(&self, x: Tensor<4>, mode: Mode) -> Result<DbMaps, OpError> {
        let levels = self.pyramid.forward(self.backbone.features(normalized(x), mode)?, mode)?;
        let [_, _, h, w] = levels[0].dims();
        let mut same = Vec::new();
        for level in levels {
            same.push(if level.dims()[2..] == [h, w] { level } else { ops::resize(level, Filter::Nearest, [h, w])? });
        }
        let [a, b] = ops::fork(ops::concat_channels(same)?)?;
        let threshold = match mode {
            Mode::Train => Some(ops::activation(self.threshold.forward(b, mode)?, Activation::Sigmoid)?),
            Mode::Eval => None,
        };
        Ok(DbMaps { logits: self.probability.forward(a, mode)?, threshold })
    }

    /// Probabilities of images.
    ///
    /// # Shapes
    /// As [`Db::forward`]; result `[N, 1, H, W]`.
    pub fn probability(&self, x: Tensor<4>) -> Result<Tensor<4>, OpError> {
        ops::activation(self.forward(x, Mode::Eval)?.logits, Activation::Sigmoid)
    }
}

impl Module for Db {
    fn visit(&self, v: &mut Visitor) {
        v.part("backbone", &self.backbone);
        v.part("pyramid", &self.pyramid);
        v.part("probability", &self.probability);
        v.part("threshold", &self.threshold);
    }
}

/// What DB should predict, `[N, 1, H, W]` each.
#[derive(Clone, Debug)]
pub struct DbTruth {
    /// 1 in shrunk outlines, else 0.
    pub shrunk: Tensor<4>,
    /// 0 where nothing is to be learned, else 1.
    pub weight: Tensor<4>,
    pub threshold: Tensor<4>,
    /// 1 where the threshold is to be learned, else 0.
    pub threshold_weight: Tensor<4>,
}

/// The loss and its parts, each `[1]`.
#[derive(Clone, Debug)]
pub struct DbLoss {
    /// `binary + 10 threshold + 5 probability`.
    pub total: Tensor<1>,
    /// Dice of the binarized map.
    pub binary: Tensor<1>,
    /// Mean absolute error.
    pub threshold: Tensor<1>,
    /// Cross entropy.
    pub probability: Tensor<1>,
}

/// Dice of `B = 1 / (1 + exp(−50 (P − T)))`, plus ten times the mean of `|T − T'|`, plus five times the binary cross entropy of `P` over
/// all writing and the hardest other pixels, three for each with writing (Shrivastava et al. 2016).
///
/// # Errors
/// When the maps hold no threshold.
pub fn db_loss(maps: &DbMaps, truth: &DbTruth) -> Result<DbLoss, OpError> {
    let threshold = maps.threshold.clone().ok_or_else(|| OpError::settings("db loss", "maps without a threshold"))?;
    let [logits, for_entropy] = ops::fork(maps.logits.clone())?;
    let p = ops::activation(logits, Activation::Sigmoid)?;
    let binarized = ops::activation((p - threshold.clone()) * STEEPNESS, Activation::Sigmoid)?;
    let binary = dice(binarized * truth.weight.clone(), truth.shrunk.clone() * truth.weight.clone());
    let off = (threshold - truth.threshold.clone()).abs() * truth.threshold_weight.clone();
    let threshold = off.sum() / (truth.threshold_weight.clone().sum() + EPSILON);
    // −ln P where there is writing and −ln(1 − P) elsewhere, in terms of the logits.
    let [a, b] = ops::fork(for_entropy)?;
    let entropy = ops::activation(a, Activation::Softplus)? - b * truth.shrunk.clone();
    let (chosen, count) = hard_pixels(&entropy, truth);
    let probability = (entropy * chosen).sum() / (count as f32 + EPSILON);
    let total = binary.clone() + threshold.clone() * THRESHOLD_WEIGHT + probability.clone() * PROBABILITY_WEIGHT;
    Ok(DbLoss { total, binary, threshold, probability })
}

/// 1 at the pixels that the cross entropy is learned of, and their number.
fn hard_pixels(entropy: &Tensor<4>, truth: &DbTruth) -> (Tensor<4>, usize) {
    let shape = entropy.dims();
    let device = truth.shrunk.device();
    let losses = crate::read_values(entropy.clone());
    let [shrunk, weight] = [&truth.shrunk, &truth.weight].map(|t| crate::read_values(t.clone()));
    let is_writing = |i: usize| shrunk[i] * weight[i] > 0.5;
    let mut chosen: Vec<f32> = (0..losses.len()).map(|i| is_writing(i) as u8 as f32).collect();
    let positives = chosen.iter().filter(|c| **c > 0.0).count();
    let mut others: Vec<u32> = (0..losses.len()).filter(|i| weight[*i] > 0.5 && !is_writing(*i)).map(|i| i as u32).collect();
    let negatives = others.len().min((positives as f64 * NEGATIVES) as usize);
    if negatives > 0 && negatives < others.len() {
        let harder = |a: &u32, b: &u32| losses[*b as usize].total_cmp(&losses[*a as usize]).then(a.cmp(b));
        others.select_nth_unstable_by(negatives - 1, harder);
    }
    others[..negatives].iter().for_each(|i| chosen[*i as usize] = 1.0);
    (Tensor::from_data(TensorData::new(chosen, shape), &device), positives + negatives)
}
