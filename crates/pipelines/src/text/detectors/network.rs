//! A detector of either kind: its network, what it learns from a batch, and the boxes that it finds in an image.

use super::boxes::{self, Detection};
use super::config::{Backbone, DecodeConfig, Kind};
use super::evaluation::Label;
use super::samples::EMPTY;
use super::targets;
use crate::error::Result;
use diorama_geom::{Image, ImageU8};
use diorama_nets::layers::Init;
use diorama_nets::modules::{Db, DbSettings, DbTruth, East, EastSettings, EastTruth, db_loss, east_loss};
use diorama_nets::onnx::Graph;
use diorama_nets::train::stack;
use diorama_nets::{Device, Mode, Module, OpError, Tensor, TensorData, Visitor, on_pool, read_values};

/// Sizes of what networks take are multiples of this.
const MULTIPLE: usize = 32;

/// A network that detects writing.
#[derive(Debug)]
pub enum Detector {
    East(Box<East>),
    Db(Box<Db>),
}

impl Module for Detector {
    fn visit(&self, v: &mut Visitor) {
        match self {
            Detector::East(net) => net.visit(v),
            Detector::Db(net) => net.visit(v),
        }
    }
}

/// A training image and the maps that its detector should predict, `[C, H, W]` one after the other.
pub struct Sample {
    pub picture: Image,
    pub maps: Vec<f32>,
}

/// Loss of a batch and the values of its three parts by name.
pub struct BatchLoss {
    pub total: Tensor<1>,
    pub parts: [(&'static str, f64); 3],
}

impl Detector {
    /// A network with random weights.
    pub fn new(kind: Kind, backbone: Backbone, seed: u64) -> Detector {
        let init = &mut Init::new(seed, &Device::flex());
        match (kind, backbone) {
            (Kind::East, Backbone::Tiny) => Detector::East(Box::new(East::new(init, EastSettings::TINY))),
            (Kind::East, Backbone::Resnet50) => Detector::East(Box::new(East::new(init, EastSettings::RESNET_50))),
            (Kind::Db, Backbone::Tiny) => Detector::Db(Box::new(Db::new(init, DbSettings::TINY))),
            (Kind::Db, Backbone::Resnet50) => Detector::Db(Box::new(Db::new(init, DbSettings::RESNET_50))),
        }
    }

    /// What a detector learns of a picture.
    pub fn sample(kind: Kind, picture: Image, labels: &[Label], least_px: f64) -> Sample {
        let size = [picture.height, picture.width];
        let maps = match kind {
            Kind::East => {
                let t = targets::east(labels, size, least_px);
                [t.score, t.weight, t.geometry].concat()
            }
            Kind::Db => {
                let t = targets::db(labels, size, least_px);
                [t.shrunk, t.weight, t.threshold, t.threshold_weight].concat()
            }
        };
        Sample { picture, maps }
    }

    /// The loss of a batch of samples of one size.
    ///
    /// # Errors
    /// When sizes differ or are no multiples of 32.
    pub fn loss(&self, batch: &[Sample]) -> Result<BatchLoss> {
        let device = Device::flex();
        let pictures: Vec<Image> = batch.iter().map(|s| s.picture.clone()).collect();
        let x = stack(&pictures, &device)?;
        let [n, _, h, w] = x.dims();
        let planes = |channels: std::ops::Range<usize>, [h, w]: [usize; 2]| {
            let values: Vec<f32> = batch.iter().flat_map(|s| &s.maps[channels.start * h * w..channels.end * h * w]).copied().collect();
            Tensor::<4>::from_data(TensorData::new(values, [n, channels.len(), h, w]), &device)
        };
        let value = |t: &Tensor<1>| read_values(t.clone())[0] as f64;
        let of = || -> std::result::Result<BatchLoss, OpError> {
            Ok(match self {
                Detector::East(net) => {
                    let size = [h / targets::EAST_STRIDE, w / targets::EAST_STRIDE];
                    let truth = EastTruth { score: planes(0..1, size), weight: planes(1..2, size), geometry: planes(2..7, size) };
                    let l = east_loss(&net.forward(x.clone(), Mode::Train)?, &truth);
                    let parts = [("dice", value(&l.dice)), ("iou_loss", value(&l.iou)), ("angle_loss", value(&l.angle))];
                    BatchLoss { total: l.total, parts }
                }
                Detector::Db(net) => {
                    let map = |k: usize| planes(k..k + 1, [h, w]);
                    let truth = DbTruth { shrunk: map(0), weight: map(1), threshold: map(2), threshold_weight: map(3) };
                    let l = db_loss(&net.forward(x.clone(), Mode::Train)?, &truth)?;
                    let parts = [("dice", value(&l.binary)), ("threshold_loss", value(&l.threshold)), ("entropy", value(&l.probability))];
                    BatchLoss { total: l.total, parts }
                }
            })
        };
        Ok(on_pool(of)?)
    }

    /// Boxes around writing in an image of three channels, in its pixels, best first.
    ///
    /// # Errors
    /// When the network refuses it.
    pub fn detect(&self, image: &ImageU8, decode: &DecodeConfig) -> Result<Vec<Detection>> {
        let x = stack(&[padded(image)], &Device::flex())?;
        let [_, _, h, w] = x.dims();
        Ok(match self {
            Detector::East(net) => {
                let maps = on_pool(|| net.forward(x.clone(), Mode::Eval))?;
                let size = [h / targets::EAST_STRIDE, w / targets::EAST_STRIDE];
                boxes::east(&read_values(maps.score), &read_values(maps.geometry), size, &decode.east)
            }
            Detector::Db(net) => {
                let probability = on_pool(|| net.probability(x.clone()))?;
                boxes::db(&read_values(probability), [h, w], &decode.db)
            }
        })
    }

    /// The network as an ONNX graph.
    pub fn to_onnx(&self) -> Graph {
        match self {
            Detector::East(net) => net.to_onnx(),
            Detector::Db(net) => net.to_onnx(),
        }
    }
}

/// The image with a border on the right and below, so that its sides are multiples of 32.
fn padded(image: &ImageU8) -> Image {
    let to = |n: usize| n.max(1).next_multiple_of(MULTIPLE);
    let (w, h) = (to(image.width), to(image.height));
    let mut out = Image { width: w, height: h, channels: 3, data: EMPTY.repeat(w * h) };
    for (row, from) in out.data.chunks_exact_mut(3 * w).zip(image.data.chunks_exact(3 * image.width.max(1))) {
        row.iter_mut().zip(from).for_each(|(o, v)| *o = *v as f32 / 255.0);
    }
    out
}
