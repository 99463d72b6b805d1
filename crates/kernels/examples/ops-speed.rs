//! Times the CPU ops of networks: one line `name milliseconds` per op, the median of some calls.
//! `benches/peers/ops_torch.py` runs it beside PyTorch.

use diorama_geom::rng::Rng;
use diorama_kernels::ops::activation::{self, Activation};
use diorama_kernels::ops::attention::{self, Attention};
use diorama_kernels::ops::dropout::{self, Dropout};
use diorama_kernels::ops::embedding;
use diorama_kernels::ops::grid_sample::{self, GridSample, Mode, Outside};
use diorama_kernels::ops::norm::{self, LayerNorm, Norm, Over};
use diorama_kernels::ops::pool::{self, Pool};
use diorama_kernels::ops::resample::{self, Filter, Fir, Resample, shuffle};
use diorama_kernels::ops::softmax::{self, Targets};
use std::time::Instant;

fn random(n: usize, seed: u64) -> Vec<f32> {
    let rng = Rng::new(seed, 1);
    (0..n as u64).map(|i| rng.uniform(i) * 2.0 - 1.0).collect()
}

/// Prints the median time of a call.
fn time(name: &str, mut call: impl FnMut()) {
    if std::env::args().nth(1).is_some_and(|only| !name.contains(&only)) {
        return;
    }
    call();
    let begin = Instant::now();
    let mut times = Vec::new();
    while times.len() < 5 || (begin.elapsed().as_secs_f64() < 0.3 && times.len() < 200) {
        let start = Instant::now();
        call();
        times.push(start.elapsed().as_secs_f64() * 1e3);
    }
    times.sort_by(f64::total_cmp);
    println!("{name} {:.4}", times[times.len() / 2]);
}

fn norms() {
    let (images, channels, places) = (8, 64, 128 * 128);
    let n = images * channels * places;
    let (x, d, mut out, mut dx) = (random(n, 1), random(n, 2), vec![0.0; n], vec![0.0; n]);
    let (scale, shift) = (random(channels, 3), random(channels, 4));
    let (mut d_scale, mut d_shift, mut scratch) = (vec![0.0; channels], vec![0.0; channels], Vec::new());
    for (name, over, activation) in [
        ("batch_norm_relu", Over::Batch, Activation::Relu),
        ("batch_norm_silu", Over::Batch, Activation::Silu),
        ("given_norm_relu", Over::Given, Activation::Relu),
        ("group_norm", Over::Groups(8), Activation::None),
    ] {
        let norm = Norm { over, images, channels, places, epsilon: 1e-5, scale: Some(&scale), shift: Some(&shift), activation };
        let (mut mean, mut variance) = (vec![0.0; norm.sets()], vec![1.0; norm.sets()]);
        time(&format!("{name}.forward"), || norm::cpu::forward(&norm, &x, &mut mean, &mut variance, &mut out));
        time(&format!("{name}.backward"), || {
            let g = norm::cpu::Gradients { x: &mut dx, scale: &mut d_scale, shift: &mut d_shift };
            norm::cpu::backward(&norm, &x, &mean, &variance, &d, g, &mut scratch);
        });
    }
    let (rows, width) = (65536, 384);
    let (x, d, mut out, mut dx) = (random(rows * width, 1), random(rows * width, 2), vec![0.0; rows * width], vec![0.0; rows * width]);
    let (scale, shift) = (random(width, 3), random(width, 4));
    let norm = LayerNorm { width, epsilon: 1e-5, scale: Some(&scale), shift: Some(&shift), activation: Activation::None };
    let (mut mean, mut variance) = (vec![0.0; rows], vec![0.0; rows]);
    let (mut d_scale, mut d_shift) = (vec![0.0; width], vec![0.0; width]);
    time("layer_norm.forward", || norm::layer::forward(&norm, &x, &mut mean, &mut variance, &mut out));
    time("layer_norm.backward", || {
        let g = norm::cpu::Gradients { x: &mut dx, scale: &mut d_scale, shift: &mut d_shift };
        norm::layer::backward(&norm, &x, &mean, &variance, &d, g, &mut scratch);
    });
}

fn resample(name: &str, r: &Resample, planes: usize) {
    let ([h, w], [oh, ow]) = (r.from(), r.to());
    let (x, d) = (random(planes * h * w, 1), random(planes * oh * ow, 2));
    let (mut out, mut dx) = (vec![0.0; d.len()], vec![0.0; x.len()]);
    time(&format!("{name}.forward"), || resample::cpu::forward(r, planes, &x, &mut out));
    time(&format!("{name}.backward"), || resample::cpu::backward(r, planes, &d, &mut dx));
}

fn images() {
    let bilinear = Filter::Bilinear { align_corners: false };
    resample("bilinear_x2", &Resample::new(bilinear, [40, 40], [80, 80]), 512);
    resample("bilinear_corners_40_to_100", &Resample::new(Filter::Bilinear { align_corners: true }, [40, 40], [100, 100]), 256);
    resample("nearest_x2", &Resample::new(Filter::Nearest, [40, 40], [80, 80]), 512);
    resample("bicubic_antialiased_512_to_224", &Resample::new(Filter::BicubicAntialiased, [512, 512], [224, 224]), 12);
    resample("bicubic_antialiased_128_to_256", &Resample::new(Filter::BicubicAntialiased, [128, 128], [256, 256]), 12);
    resample("area_160_to_7", &Resample::new(Filter::Area, [160, 160], [7, 7]), 256);
    let taps = [0.125, 0.375, 0.375, 0.125];
    resample("blur_down", &Resample::fir(&Fir { taps: &taps, up: 1, down: 2, padding: [1, 1] }, [128, 128]), 256);
    let pool = Pool { kernel: [2; 2], stride: [2; 2], padding: [0; 2], ceil_mode: false };
    resample("average_pool_2", &pool.average([160, 160], true), 256);
    let (x, mut out) = (random(4 * 256 * 40 * 40, 1), vec![0.0; 4 * 256 * 40 * 40]);
    time("pixel_shuffle.forward", || shuffle::shuffle(256, [40, 40], 2, &x, &mut out));
    time("pixel_shuffle.backward", || shuffle::unshuffle(256, [40, 40], 2, &x, &mut out));
    let pool = Pool { kernel: [3; 2], stride: [2; 2], padding: [1; 2], ceil_mode: false };
    let (x, d) = (random(256 * 160 * 160, 1), random(256 * 80 * 80, 2));
    let (mut out, mut indices, mut dx) = (vec![0.0; d.len()], vec![0; d.len()], vec![0.0; x.len()]);
    time("max_pool_3.forward", || pool::cpu::max(&pool, 256, [160, 160], &x, &mut out, &mut indices));
    time("max_pool_3.backward", || pool::cpu::max_backward(256, 160 * 160, &indices, &d, &mut dx));
    let mut means = vec![0.0; 256];
    time("global_average.forward", || pool::cpu::global_average(160 * 160, &x, &mut means));
    time("global_average.backward", || pool::cpu::global_average_backward(160 * 160, &means, &mut dx));
    let s = GridSample {
        mode: Mode::Bilinear,
        outside: Outside::Zeros,
        align_corners: false,
        images: 4,
        channels: 32,
        from: [64, 64],
        points: 128 * 128,
    };
    let (x, grid, d) = (random(4 * 32 * 64 * 64, 1), random(4 * 2 * s.points, 2), random(4 * 32 * s.points, 3));
    let (mut out, mut dx, mut d_grid) = (vec![0.0; d.len()], vec![0.0; x.len()], vec![0.0; grid.len()]);
    time("grid_sample.forward", || grid_sample::cpu::forward(&s, &x, &grid, &mut out));
    time("grid_sample.backward", || {
        grid_sample::cpu::backward_input(&s, &grid, &d, &mut dx);
        grid_sample::cpu::backward_grid(&s, &x, &grid, &d, &mut d_grid);
    });
}

fn rows() {
    let n = 8192 * 1000;
    let (x, d, mut out, mut dx) = (random(n, 1), random(n, 2), vec![0.0; n], vec![0.0; n]);
    time("softmax_1000.forward", || softmax::cpu::softmax(1000, &x, &mut out));
    time("softmax_1000.backward", || softmax::cpu::softmax_backward(1000, &out, &d, &mut dx));
    let classes: Vec<i64> = (0..8192).map(|i| i * 7 % 1000).collect();
    let targets = Targets { classes: &classes, smoothing: 0.1, ignored: -100 };
    let mut losses = vec![0.0; classes.len()];
    time("cross_entropy_1000.forward", || {
        softmax::cpu::cross_entropy(1000, &x, &targets, &mut out, &mut losses);
    });
    time("cross_entropy_1000.backward", || softmax::cpu::cross_entropy_backward(1000, &out, &targets, 1.0, &mut dx));
    for (name, a) in [
        ("relu", Activation::Relu),
        ("softplus", Activation::Softplus),
        ("sigmoid", Activation::Sigmoid),
        ("tanh", Activation::Tanh),
        ("silu", Activation::Silu),
        ("gelu", Activation::Gelu),
        ("gelu_tanh", Activation::GeluTanh),
    ] {
        time(&format!("{name}.forward"), || activation::cpu::forward(a, &x, &mut out));
        time(&format!("{name}.backward"), || activation::cpu::backward(a, &x, &d, &mut dx));
    }
    let dropout = Dropout { rng: Rng::new(1, 2), first: 0, p: 0.1 };
    time("dropout.forward", || dropout::cpu::apply(&dropout, &x, &mut out));
    let indices: Vec<i64> = (0..8192).map(|i| i * 7919 % 32000).collect();
    let (table, g) = (random(32000 * 256, 1), random(8192 * 256, 2));
    let (mut out, mut d_table) = (vec![0.0; g.len()], vec![0.0; table.len()]);
    time("embedding.forward", || embedding::cpu::forward(32000, 256, &table, &indices, &mut out));
    time("embedding.backward", || embedding::cpu::backward(32000, 256, &indices, &g, &mut d_table));
}

fn attentions() {
    for (batch, tokens) in [(12, 50), (192, 50), (12, 197), (12, 1024)] {
        let a = Attention::new(batch, tokens, tokens, 64);
        let n = batch * tokens * 64;
        let [q, k, v, d_out] = [1, 2, 3, 4].map(|seed| random(n, seed));
        let (mut out, mut log_sums) = (vec![0.0; n], vec![0.0; batch * tokens]);
        time(&format!("attention_{batch}x{tokens}.forward"), || attention::cpu::forward(&a, &q, &k, &v, &mut out, &mut log_sums));
        attention::cpu::forward(&a, &q, &k, &v, &mut out, &mut log_sums);
        let saved = attention::cpu::Saved { q: &q, k: &k, v: &v, out: &out, log_sums: &log_sums, d_out: &d_out };
        let (mut dq, mut dk, mut dv, mut scratch) = (vec![0.0; n], vec![0.0; n], vec![0.0; n], Vec::new());
        time(&format!("attention_{batch}x{tokens}.backward"), || {
            attention::cpu::backward(&a, &saved, &mut dq, &mut dk, &mut dv, &mut scratch)
        });
    }
}

fn main() {
    norms();
    images();
    rows();
    attentions();
}
