//! Times convolutions and matrix products of common networks: `bench_conv [--threads N] [NAME...]`, one line per layer.
//!
//! `benches/peers/nets_torch.py` prints the same lines for PyTorch.

use diorama_kernels::ops::conv_transpose2d::{self, ConvTranspose2d};
use diorama_kernels::ops::conv2d::{Conv2d, Gradients, Images, cpu};
use diorama_kernels::ops::matmul::{Matmul, cpu::matmul};
use diorama_kernels::probe;
use std::time::Instant;

#[derive(Clone, Copy)]
enum Kind {
    Conv,
    Transpose,
}

/// Name, kind, batch, channels in, channels out, height = width, kernel, stride, padding, groups.
type Layer = (&'static str, Kind, usize, usize, usize, usize, usize, usize, usize, usize);

const LAYERS: &[Layer] = &[
    ("conv3x3_64_128", Kind::Conv, 1, 64, 64, 128, 3, 1, 1, 1),
    ("conv3x3_64_128_b8", Kind::Conv, 8, 64, 64, 128, 3, 1, 1, 1),
    ("conv1x1_64_128_b8", Kind::Conv, 8, 64, 64, 128, 1, 1, 0, 1),
    ("conv1x1_256_40_b4", Kind::Conv, 4, 256, 256, 40, 1, 1, 0, 1),
    ("conv3x3s2_64_128_b8", Kind::Conv, 8, 64, 64, 128, 3, 2, 1, 1),
    ("conv7x7s2_3_320_b4", Kind::Conv, 4, 3, 64, 320, 7, 2, 3, 1),
    ("conv7x7_16_128_b8", Kind::Conv, 8, 16, 16, 128, 7, 1, 3, 1),
    ("dw3x3_64_128_b8", Kind::Conv, 8, 64, 64, 128, 3, 1, 1, 64),
    ("dw3x3s2_64_128_b8", Kind::Conv, 8, 64, 64, 128, 3, 2, 1, 64),
    ("tconv4x4s2_64_64_b8", Kind::Transpose, 8, 64, 64, 64, 4, 2, 1, 1),
    ("tconv2x2s2_128_32_b8", Kind::Transpose, 8, 128, 64, 32, 2, 2, 0, 1),
    ("resnet_64_80_b4", Kind::Conv, 4, 64, 64, 80, 3, 1, 1, 1),
    ("resnet_64_128_80s2_b4", Kind::Conv, 4, 64, 128, 80, 3, 2, 1, 1),
    ("resnet_128_40_b4", Kind::Conv, 4, 128, 128, 40, 3, 1, 1, 1),
    ("resnet_256_20_b4", Kind::Conv, 4, 256, 256, 20, 3, 1, 1, 1),
    ("resnet_512_10_b4", Kind::Conv, 4, 512, 512, 10, 3, 1, 1, 1),
    ("vgg_3_64_224", Kind::Conv, 1, 3, 64, 224, 3, 1, 1, 1),
    ("vgg_64_224", Kind::Conv, 1, 64, 64, 224, 3, 1, 1, 1),
    ("vgg_128_112", Kind::Conv, 1, 128, 128, 112, 3, 1, 1, 1),
    ("vgg_256_56", Kind::Conv, 1, 256, 256, 56, 3, 1, 1, 1),
    ("vgg_512_28", Kind::Conv, 1, 512, 512, 28, 3, 1, 1, 1),
    ("vgg_512_14", Kind::Conv, 1, 512, 512, 14, 3, 1, 1, 1),
];

/// Name, batch, m, k, n, whether the second operand is transposed.
type Product = (&'static str, usize, usize, usize, usize, bool);

const PRODUCTS: &[Product] = &[
    ("linear_384_65536", 1, 65536, 384, 384, false),
    ("linear_768_3072_b4x50", 1, 200, 768, 3072, false),
    ("vgg_fc_25088_4096", 1, 1, 25088, 4096, false),
    ("attention_qk_12x50", 48, 50, 64, 50, true),
    ("attention_pv_12x50", 48, 50, 50, 64, false),
    ("attention_qk_12x577", 12, 577, 64, 577, true),
];

/// Shortest time of a call, after one that warms up.
fn seconds(mut work: impl FnMut()) -> f64 {
    work();
    let begin = Instant::now();
    work();
    let times = (0.4 / begin.elapsed().as_secs_f64().max(1e-6)) as usize;
    (0..times.max(5)).fold(f64::INFINITY, |best, _| {
        let begin = Instant::now();
        work();
        best.min(begin.elapsed().as_secs_f64())
    })
}

fn numbers(n: usize) -> Vec<f32> {
    let mut state = 1u32;
    (0..n)
        .map(|_| {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 8) as f32 / (1 << 23) as f32 - 1.0
        })
        .collect()
}

fn print(name: &str, flops: f64, forward: f64, training: f64) {
    let threads = rayon::current_num_threads() as f64;
    let (f, t) = (flops / forward / threads / 1e9, 3.0 * flops / training / threads / 1e9);
    let (forward, training) = (forward * 1e3, training * 1e3);
    println!("{name:24} forward {forward:9.3} ms {f:7.1}  training {training:9.3} ms {t:7.1} GFLOP/s per core");
}

fn conv(layer: &Layer) {
    let (name, _, batch, channels_in, channels_out, size, kernel, stride, padding, groups) = *layer;
    let c = Conv2d { stride: [stride; 2], padding: [padding; 2], groups, ..Conv2d::new(channels_in, channels_out, kernel) };
    let images = Images { batch, height: size, width: size };
    let outputs = batch * channels_out * c.output(&images).pixels();
    let (x, w, b, d) = (numbers(batch * channels_in * images.pixels()), numbers(c.weights_len()), numbers(channels_out), numbers(outputs));
    let mut out = vec![0.0; outputs];
    let forward = seconds(|| cpu::forward(&c, &images, &x, &w, &b, &mut out, None));
    let (mut dx, mut dw, mut db) = (vec![0.0; x.len()], vec![0.0; w.len()], vec![0.0; channels_out]);
    let training = seconds(|| {
        cpu::forward(&c, &images, &x, &w, &b, &mut out, None);
        let gradients = Gradients { input: Some(&mut dx), weights: Some(&mut dw), bias: Some(&mut db) };
        cpu::backward(&c, &images, &x, &w, &out, &d, gradients);
    });
    let flops = 2.0 * (outputs * channels_in / groups * kernel * kernel) as f64;
    print(name, flops, forward, training);
}

fn transposed(layer: &Layer) {
    let (name, _, batch, channels_in, channels_out, size, kernel, stride, padding, groups) = *layer;
    let c = ConvTranspose2d { padding: [padding; 2], groups, ..ConvTranspose2d::new(channels_in, channels_out, kernel, stride) };
    let images = Images { batch, height: size, width: size };
    let outputs = batch * channels_out * c.output(&images).pixels();
    let (x, w, b, d) = (numbers(batch * channels_in * images.pixels()), numbers(c.weights_len()), numbers(channels_out), numbers(outputs));
    let mut out = vec![0.0; outputs];
    let forward = seconds(|| conv_transpose2d::cpu::forward(&c, &images, &x, &w, &b, &mut out, None));
    let (mut dx, mut dw, mut db) = (vec![0.0; x.len()], vec![0.0; w.len()], vec![0.0; channels_out]);
    let training = seconds(|| {
        conv_transpose2d::cpu::forward(&c, &images, &x, &w, &b, &mut out, None);
        let gradients = Gradients { input: Some(&mut dx), weights: Some(&mut dw), bias: Some(&mut db) };
        conv_transpose2d::cpu::backward(&c, &images, &x, &w, &out, &d, gradients);
    });
    let flops = 2.0 * (batch * images.pixels() * channels_in * channels_out / groups * kernel * kernel) as f64;
    print(name, flops, forward, training);
}

fn product(&(name, batch, m, k, n, b_transposed): &Product) {
    let s = Matmul { batch, b_transposed, ..Matmul::new(m, n, k) };
    let (a, b, d) = (numbers(batch * m * k), numbers(batch * k * n), numbers(batch * m * n));
    let (mut c, mut da, mut db) = (vec![0.0; d.len()], vec![0.0; a.len()], vec![0.0; b.len()]);
    let forward = seconds(|| matmul(&s, &a, &b, &mut c));
    let training = seconds(|| {
        matmul(&s, &a, &b, &mut c);
        matmul(&s.gradient_a(), &d, &b, &mut da);
        let (first, second) = if b_transposed { (&d, &a) } else { (&a, &d) };
        matmul(&s.gradient_b(), first, second, &mut db);
    });
    print(name, 2.0 * (batch * m * k * n) as f64, forward, training);
}

fn main() {
    let mut args: Vec<String> = std::env::args().skip(1).collect();
    let mut threads = 2;
    if let Some(i) = args.iter().position(|a| a == "--threads") {
        threads = args[i + 1].parse().expect("--threads takes a number");
        args.drain(i..i + 2);
    }
    rayon::ThreadPoolBuilder::new().num_threads(threads).build_global().expect("no other pool");
    println!("multiply-adds: {:.1} GFLOP/s per core", (0..5).map(|_| probe::fma_peak(1 << 24)).fold(0.0, f64::max) / 1e9);
    let wanted = |name: &str| args.is_empty() || args.iter().any(|a| name.contains(&a[..]));
    for layer in LAYERS.iter().filter(|l| wanted(l.0)) {
        match layer.1 {
            Kind::Conv => conv(layer),
            Kind::Transpose => transposed(layer),
        }
    }
    PRODUCTS.iter().filter(|p| wanted(p.0)).for_each(product);
}
