//! Single layers, straight through their kernels.

use super::{LayerFigures, Wanted};
use diorama_geom::rng::Rng;
use diorama_kernels::ops::conv_transpose2d::{self, ConvTranspose2d};
use diorama_kernels::ops::conv2d::{self, Conv2d, Gradients, Images};
use diorama_kernels::ops::linear::{self, Activation, BiasKind, Linear};
use diorama_nets::on_pool;
use std::convert::Infallible;

#[derive(Clone, Copy)]
enum Kind {
    Conv,
    Transpose,
    /// Rows in place of images.
    Linear,
}

/// A layer and its images.
pub struct Layer {
    name: &'static str,
    kind: Kind,
    batch: usize,
    channels: [usize; 2],
    /// Height and width.
    size: usize,
    kernel: usize,
    stride: usize,
    padding: usize,
    groups: usize,
}

const fn conv(name: &'static str, batch: usize, channels: [usize; 2], size: usize, kernel: usize, stride: usize) -> Layer {
    let padding = if kernel == 1 { 0 } else { kernel / 2 };
    Layer { name, kind: Kind::Conv, batch, channels, size, kernel, stride, padding, groups: 1 }
}

const fn depthwise(name: &'static str, batch: usize, channels: usize, size: usize, stride: usize) -> Layer {
    Layer { groups: channels, ..conv(name, batch, [channels; 2], size, 3, stride) }
}

const fn transpose(name: &'static str, channels: [usize; 2], size: usize, kernel: usize) -> Layer {
    Layer { kind: Kind::Transpose, padding: (kernel - 2) / 2, ..conv(name, 8, channels, size, kernel, 2) }
}

const fn linear(name: &'static str, rows: usize, channels: [usize; 2]) -> Layer {
    Layer { kind: Kind::Linear, ..conv(name, rows, channels, 1, 1, 1) }
}

/// Kinds of layers, and those of ResNet-18, VGG16, an MLP and ViT-B/32.
pub const ALL: [Layer; 25] = [
    conv("conv3x3_64_128", 1, [64; 2], 128, 3, 1),
    conv("conv3x3_64_128", 8, [64; 2], 128, 3, 1),
    conv("conv1x1_64_128", 8, [64; 2], 128, 1, 1),
    conv("conv1x1_256_40", 4, [256; 2], 40, 1, 1),
    conv("conv3x3s2_64_128", 8, [64; 2], 128, 3, 2),
    conv("conv7x7_16_128", 8, [16; 2], 128, 7, 1),
    conv("conv7x7s2_3_320", 4, [3, 64], 320, 7, 2),
    depthwise("dw3x3_64_128", 8, 64, 128, 1),
    depthwise("dw3x3s2_64_128", 8, 64, 128, 2),
    transpose("tconv4x4s2_64_64", [64; 2], 64, 4),
    transpose("tconv2x2s2_128_32", [128, 64], 32, 2),
    conv("resnet_64_80", 4, [64; 2], 80, 3, 1),
    conv("resnet_64_80s2", 4, [64, 128], 80, 3, 2),
    conv("resnet_128_40", 4, [128; 2], 40, 3, 1),
    conv("resnet_256_20", 4, [256; 2], 20, 3, 1),
    conv("resnet_512_10", 4, [512; 2], 10, 3, 1),
    conv("vgg_3_224", 1, [3, 64], 224, 3, 1),
    conv("vgg_64_224", 1, [64; 2], 224, 3, 1),
    conv("vgg_128_112", 1, [128; 2], 112, 3, 1),
    conv("vgg_256_56", 1, [256; 2], 56, 3, 1),
    conv("vgg_512_28", 1, [512; 2], 28, 3, 1),
    conv("vgg_512_14", 1, [512; 2], 14, 3, 1),
    linear("linear_384_384", 65_536, [384; 2]),
    linear("linear_768_3072", 50, [768, 3072]),
    linear("linear_3072_768", 50, [3072, 768]),
];

fn numbers(stream: u64, n: usize) -> Vec<f32> {
    let rng = Rng::new(1, stream);
    (0..n as u64).map(|i| rng.uniform(i) * 2.0 - 1.0).collect()
}

impl Layer {
    /// `name_batch`.
    pub fn label(&self) -> String {
        format!("{}_b{}", self.name, self.batch)
    }

    pub fn measure(&self, wanted: &Wanted, threads: usize) -> LayerFigures {
        let (flops, [forward, train]) = on_pool(|| match self.kind {
            Kind::Conv => self.conv(wanted),
            Kind::Transpose => self.transpose(wanted),
            Kind::Linear => self.linear(wanted),
        });
        let rate = |flops: f64, seconds: f64| flops / seconds / threads as f64 / 1e9;
        LayerFigures {
            name: self.name,
            batch: self.batch,
            forward_gflops: rate(flops, forward),
            train_gflops: rate(3.0 * flops, train),
            forward_ms: forward * 1e3,
            train_ms: train * 1e3,
        }
    }

    fn images(&self) -> Images {
        Images { batch: self.batch, height: self.size, width: self.size }
    }

    /// FLOP of a forward pass, seconds forward and in training.
    fn conv(&self, wanted: &Wanted) -> (f64, [f64; 2]) {
        let [from, to] = self.channels;
        let c = Conv2d {
            stride: [self.stride; 2],
            padding: [self.padding; 2],
            groups: self.groups,
            precision: wanted.precision,
            ..Conv2d::new(from, to, self.kernel)
        };
        let images = self.images();
        let outputs = self.batch * to * c.output(&images).pixels();
        let [x, w, b, d] = [self.batch * from * images.pixels(), c.weights_len(), to, outputs].map(|n| numbers(n as u64, n));
        let (mut out, mut dx, mut dw, mut db) = (d.clone(), x.clone(), w.clone(), b.clone());
        let forward = median(wanted, || conv2d::cpu::forward(&c, &images, &x, &w, &b, &mut out, None));
        let train = median(wanted, || {
            conv2d::cpu::forward(&c, &images, &x, &w, &b, &mut out, None);
            let gradients = Gradients { input: Some(&mut dx), weights: Some(&mut dw), bias: Some(&mut db) };
            conv2d::cpu::backward(&c, &images, &x, &w, &out, &d, gradients);
        });
        (2.0 * (self.batch * c.output(&images).pixels() * c.weights_len()) as f64, [forward, train])
    }

    fn transpose(&self, wanted: &Wanted) -> (f64, [f64; 2]) {
        let [from, to] = self.channels;
        let c = ConvTranspose2d {
            padding: [self.padding; 2],
            groups: self.groups,
            precision: wanted.precision,
            ..ConvTranspose2d::new(from, to, self.kernel, self.stride)
        };
        let images = self.images();
        let outputs = self.batch * to * c.output(&images).pixels();
        let [x, w, b, d] = [self.batch * from * images.pixels(), c.weights_len(), to, outputs].map(|n| numbers(n as u64, n));
        let (mut out, mut dx, mut dw, mut db) = (d.clone(), x.clone(), w.clone(), b.clone());
        let forward = median(wanted, || conv_transpose2d::cpu::forward(&c, &images, &x, &w, &b, &mut out, None));
        let train = median(wanted, || {
            conv_transpose2d::cpu::forward(&c, &images, &x, &w, &b, &mut out, None);
            let gradients = Gradients { input: Some(&mut dx), weights: Some(&mut dw), bias: Some(&mut db) };
            conv_transpose2d::cpu::backward(&c, &images, &x, &w, &out, &d, gradients);
        });
        (2.0 * (self.batch * images.pixels() * c.weights_len()) as f64, [forward, train])
    }

    fn linear(&self, wanted: &Wanted) -> (f64, [f64; 2]) {
        let (m, [k, n]) = (self.batch, self.channels);
        let l =
            Linear { rows: m, inputs: k, outputs: n, bias: BiasKind::Shared, activation: Activation::None, precision: wanted.precision };
        let [x, w, b, d] = [m * k, k * n, n, m * n].map(|n| numbers(n as u64, n));
        let (mut out, mut dx, mut dw, mut db) = (d.clone(), x.clone(), w.clone(), b.clone());
        let forward = median(wanted, || linear::cpu::forward(&l, &x, &w, &b, &mut out));
        let train = median(wanted, || {
            linear::cpu::forward(&l, &x, &w, &b, &mut out);
            let gradients = linear::Gradients { x: Some(&mut dx), w: Some(&mut dw), bias: Some(&mut db) };
            linear::cpu::backward(&l, &x, &w, &out, &d, gradients);
        });
        (2.0 * (m * k * n) as f64, [forward, train])
    }
}

fn median(wanted: &Wanted, mut call: impl FnMut()) -> f64 {
    let seconds = wanted.median(|| {
        call();
        Ok::<(), Infallible>(())
    });
    seconds.unwrap_or_else(|never| match never {})
}
