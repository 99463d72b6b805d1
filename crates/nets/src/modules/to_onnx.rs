//! Detectors as ONNX graphs.

use super::east::MOST_PX;
use super::resnet::{Block, IMAGENET, Normed, ResNet};
use super::{Db, East, Fpn};
use crate::onnx::{Axis, Graph, Value};
use crate::ops::Activation;
use std::f32::consts::PI;

/// Axes of a map of some channels; height and width are called by the names given.
fn axes(channels: usize, [h, w]: [&'static str; 2]) -> [Axis; 4] {
    [Axis::Named("batch"), Axis::Is(channels), Axis::Named(h), Axis::Named(w)]
}

/// The input `image` with ImageNet's mean and variance.
fn image(g: &mut Graph) -> Value {
    let x = g.input("image", &axes(3, ["height", "width"]));
    let [mean, deviation] = IMAGENET;
    let scale = g.constant(&[1, 3, 1, 1], &deviation.map(|d| 1.0 / d));
    let shift = g.constant(&[1, 3, 1, 1], &[0, 1, 2].map(|k| -mean[k] / deviation[k]));
    let x = g.mul(&x, &scale);
    g.add(&x, &shift)
}

fn normed(g: &mut Graph, x: &Value, layer: &Normed) -> Value {
    let x = g.conv(x, &layer.conv);
    g.batch_norm(&x, &layer.norm)
}

fn block(g: &mut Graph, x: &Value, block: &Block) -> Value {
    let y = block.parts.iter().fold(x.clone(), |y, part| normed(g, &y, part));
    let skip = block.downsample.as_ref().map_or_else(|| x.clone(), |d| normed(g, x, d));
    let sum = g.add(&y, &skip);
    g.activation(&sum, Activation::Relu)
}

fn features(g: &mut Graph, x: &Value, net: &ResNet) -> [Value; 4] {
    let x = normed(g, x, &net.stem);
    let mut x = g.max_pool(&x, 3, 2, 1);
    net.layers.each_ref().map(|blocks| {
        x = blocks.iter().fold(x.clone(), |x, b| block(g, &x, b));
        x.clone()
    })
}

fn pyramid(g: &mut Graph, features: &[Value; 4], net: &Fpn) -> Vec<Value> {
    let mut out = Vec::new();
    let mut above: Option<Value> = None;
    for (level, x) in features.iter().enumerate().rev() {
        let mut x = g.conv(x, &net.inner[level]);
        if let Some(above) = &above {
            let large = g.enlarge(above, 2, false);
            x = g.add(&x, &large);
        }
        out.push(g.conv(&x, &net.layer[level]));
        above = Some(x);
    }
    out.reverse();
    out
}

impl East {
    /// The network in evaluation as an ONNX graph: from `image` (`[batch, 3, height, width]`, sRGB from 0 to 1, sizes multiples of 32) to
    /// `score` (`[batch, 1, rows, columns]`) and `geometry` (`[batch, 5, rows, columns]`).
    pub fn to_onnx(&self) -> Graph {
        let mut graph = Graph::new();
        let g = &mut graph;
        let x = image(g);
        let [c2, c3, c4, mut x] = features(g, &x, &self.backbone);
        for (feature, [reduce, smooth]) in [c4, c3, c2].iter().zip(&self.merges) {
            let above = g.enlarge(&x, 2, true);
            x = g.concat(&[&above, feature]);
            x = normed(g, &x, reduce);
            x = normed(g, &x, smooth);
        }
        x = normed(g, &x, &self.last);
        x = g.conv(&x, &self.head);
        x = g.activation(&x, Activation::Sigmoid);
        let score = g.channels(&x, 0, 1);
        let shares = g.channels(&x, 1, 6);
        let scale = g.constant(&[1, 5, 1, 1], &[MOST_PX, MOST_PX, MOST_PX, MOST_PX, PI]);
        let shift = g.constant(&[1, 5, 1, 1], &[0.0, 0.0, 0.0, 0.0, -0.5 * PI]);
        let scaled = g.mul(&shares, &scale);
        let geometry = g.add(&scaled, &shift);
        g.output("score", &score, &axes(1, ["rows", "columns"]));
        g.output("geometry", &geometry, &axes(5, ["rows", "columns"]));
        graph
    }
}

impl Db {
    /// The network in evaluation as an ONNX graph: from `image` (`[batch, 3, height, width]`, sRGB from 0 to 1, sizes multiples of 32) to
    /// `probability` (`[batch, 1, height, width]`).
    pub fn to_onnx(&self) -> Graph {
        let mut graph = Graph::new();
        let g = &mut graph;
        let x = image(g);
        let features = features(g, &x, &self.backbone);
        let levels = pyramid(g, &features, &self.pyramid);
        let same: Vec<Value> =
            levels.iter().enumerate().map(|(i, l)| if i == 0 { l.clone() } else { g.enlarge(l, 1 << i, false) }).collect();
        let mut x = g.concat(&same.iter().collect::<Vec<_>>());
        let head = &self.probability;
        x = normed(g, &x, &head.first);
        x = g.conv_transpose(&x, &head.grow);
        x = g.batch_norm(&x, &head.norm);
        x = g.conv_transpose(&x, &head.last);
        x = g.activation(&x, Activation::Sigmoid);
        g.output("probability", &x, &axes(1, ["height", "width"]));
        graph
    }
}
