//! Compares CPU ops whose conventions differ between libraries with outputs and gradients that PyTorch wrote
//! (`benches/peers/ops_reference.py`).

use super::activation::{self, Activation};
use super::attention::{self, Attention};
use super::grid_sample::{self, GridSample, Mode, Outside};
use super::norm::{self, LayerNorm, Norm, Over};
use super::pool::{self, Pool};
use super::resample::{self, Filter, Fir, Resample, shuffle};
use super::softmax::{self, Targets};
use diorama_testkit::{assert_close, wide};
use std::collections::HashMap;

/// Arrays by name.
struct Cases(HashMap<String, Vec<f32>>);

impl Cases {
    fn read() -> Cases {
        let mut rest = &include_bytes!("../../tests/data/ops_torch.bin")[..];
        let mut out = HashMap::new();
        let mut take = |n: usize| {
            let (own, tail) = rest.split_at(n.min(rest.len()));
            rest = tail;
            own
        };
        while let Ok(length) = take(4).try_into() {
            let name = String::from_utf8(take(u32::from_le_bytes(length) as usize).to_vec()).unwrap();
            let count = u32::from_le_bytes(take(4).try_into().unwrap()) as usize;
            out.insert(name, take(4 * count).chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect());
        }
        Cases(out)
    }

    fn get(&self, case: &str, array: &str) -> &[f32] {
        self.0.get(&format!("{case}.{array}")).unwrap_or_else(|| panic!("no {case}.{array}"))
    }

    #[track_caller]
    fn check(&self, case: &str, array: &str, ours: &[f32]) {
        assert_close(&format!("{case}.{array}"), ours, &wide(self.get(case, array)), 1e-5);
    }

    /// Zeros as long as an array.
    fn room(&self, case: &str, array: &str) -> Vec<f32> {
        vec![0.0; self.get(case, array).len()]
    }
}

fn check_resample(cases: &Cases, case: &str, r: &Resample) {
    let (mut out, mut dx) = (cases.room(case, "out"), cases.room(case, "x"));
    resample::cpu::forward(r, 1, cases.get(case, "x"), &mut out);
    resample::cpu::backward(r, 1, cases.get(case, "d"), &mut dx);
    cases.check(case, "out", &out);
    cases.check(case, "dx", &dx);
}

#[test]
fn resampling_is_that_of_torch() {
    let cases = Cases::read();
    let filters = [
        ("nearest", Filter::Nearest),
        ("bilinear", Filter::Bilinear { align_corners: false }),
        ("corners", Filter::Bilinear { align_corners: true }),
        ("bilinear_antialiased", Filter::BilinearAntialiased),
        ("bicubic_antialiased", Filter::BicubicAntialiased),
        ("area", Filter::Area),
    ];
    for (i, (from, to)) in [([3, 4], [6, 8]), ([9, 7], [4, 3]), ([5, 11], [4, 13]), ([1, 29], [1, 43])].into_iter().enumerate() {
        for (name, filter) in filters {
            check_resample(&cases, &format!("resample.{name}.{i}"), &Resample::new(filter, from, to));
        }
    }
    let taps = &[0.1, 0.2, 0.3, 0.5];
    check_resample(&cases, "blur.down", &Resample::fir(&Fir { taps, up: 1, down: 2, padding: [1, 2] }, [5, 6]));
    check_resample(&cases, "blur.up", &Resample::fir(&Fir { taps, up: 2, down: 1, padding: [2, 1] }, [4, 3]));
    let mut out = vec![0.0; 48];
    shuffle::shuffle(2, [3, 2], 2, cases.get("pixel_shuffle", "x"), &mut out);
    cases.check("pixel_shuffle", "out", &out);
    shuffle::unshuffle(2, [3, 2], 2, cases.get("pixel_shuffle", "d"), &mut out);
    cases.check("pixel_shuffle", "dx", &out);
}

fn check_norm(cases: &Cases, case: &str, over: Over, activation: Activation) -> (Vec<f32>, Vec<f32>) {
    let parameter = |name| cases.0.get(&format!("{case}.{name}")).map(|v| &v[..]);
    let (scale, shift) = (parameter("w"), parameter("b"));
    let norm = Norm { over, images: 3, channels: 4, places: 6, epsilon: 1e-5, scale, shift, activation };
    let (mut mean, mut variance) = match over {
        Over::Given => (cases.get(case, "mean").to_vec(), cases.get(case, "variance").to_vec()),
        _ => (vec![0.0; norm.sets()], vec![0.0; norm.sets()]),
    };
    let (x, mut out, mut dx) = (cases.get(case, "x"), cases.room(case, "out"), cases.room(case, "x"));
    let (mut d_scale, mut d_shift) = (vec![0.0; scale.map_or(0, <[f32]>::len)], vec![0.0; shift.map_or(0, <[f32]>::len)]);
    norm::cpu::forward(&norm, x, &mut mean, &mut variance, &mut out);
    let g = norm::cpu::Gradients { x: &mut dx, scale: &mut d_scale, shift: &mut d_shift };
    norm::cpu::backward(&norm, x, &mean, &variance, cases.get(case, "d"), g, &mut Vec::new());
    cases.check(case, "out", &out);
    cases.check(case, "dx", &dx);
    if scale.is_some() {
        cases.check(case, "dw", &d_scale);
        cases.check(case, "db", &d_shift);
    }
    (mean, variance)
}

#[test]
fn normalization_is_that_of_torch() {
    let cases = Cases::read();
    let case = "norm.batch";
    let (mean, variance) = check_norm(&cases, case, Over::Batch, Activation::LeakyRelu(0.2));
    let (mut running_mean, mut running_variance) = (cases.get(case, "before_mean").to_vec(), cases.get(case, "before_variance").to_vec());
    norm::update_running(18, 0.1, &mean, &variance, &mut running_mean, &mut running_variance);
    cases.check(case, "after_mean", &running_mean);
    cases.check(case, "after_variance", &running_variance);
    check_norm(&cases, "norm.given", Over::Given, Activation::Relu);
    check_norm(&cases, "norm.group", Over::Groups(2), Activation::Silu);
    check_norm(&cases, "norm.instance", Over::Groups(4), Activation::None);
    let case = "norm.layer";
    let (scale, shift) = (Some(cases.get(case, "w")), Some(cases.get(case, "b")));
    let norm = LayerNorm { width: 6, epsilon: 1e-5, scale, shift, activation: Activation::Gelu };
    let (mut mean, mut variance, mut out) = (vec![0.0; 4], vec![0.0; 4], vec![0.0; 24]);
    let (mut dx, mut dw, mut db) = (vec![0.0; 24], vec![0.0; 6], vec![0.0; 6]);
    norm::layer::forward(&norm, cases.get(case, "x"), &mut mean, &mut variance, &mut out);
    let g = norm::cpu::Gradients { x: &mut dx, scale: &mut dw, shift: &mut db };
    norm::layer::backward(&norm, cases.get(case, "x"), &mean, &variance, cases.get(case, "d"), g, &mut Vec::new());
    cases.check(case, "out", &out);
    cases.check(case, "dx", &dx);
    cases.check(case, "dw", &dw);
    cases.check(case, "db", &db);
}

#[test]
fn pooling_is_that_of_torch() {
    let cases = Cases::read();
    let windows = [(3, 2, 1, false, [6, 7]), (2, 2, 0, true, [5, 5]), (3, 2, 1, true, [5, 6]), (2, 3, 1, true, [4, 7])];
    for (i, (kernel, stride, padding, ceil_mode, from)) in windows.into_iter().enumerate() {
        let pool = Pool { kernel: [kernel; 2], stride: [stride; 2], padding: [padding; 2], ceil_mode };
        let case = &format!("pool.max.{i}");
        let (mut out, mut dx) = (cases.room(case, "out"), cases.room(case, "x"));
        let mut indices = vec![0; out.len()];
        pool::cpu::max(&pool, 1, from, cases.get(case, "x"), &mut out, &mut indices);
        pool::cpu::max_backward(1, from[0] * from[1], &indices, cases.get(case, "d"), &mut dx);
        cases.check(case, "out", &out);
        cases.check(case, "indices", &indices.iter().map(|i| *i as f32).collect::<Vec<_>>());
        cases.check(case, "dx", &dx);
        for count_padding in [false, true] {
            check_resample(&cases, &format!("pool.average.{i}.{}", count_padding as u8), &pool.average(from, count_padding));
        }
    }
}

#[test]
fn grid_sampling_is_that_of_torch() {
    let cases = Cases::read();
    for (mode, mode_name) in [(Mode::Bilinear, "bilinear"), (Mode::Nearest, "nearest")] {
        for (outside, outside_name) in [(Outside::Zeros, "zeros"), (Outside::Border, "border")] {
            for align_corners in [false, true] {
                let case = &format!("grid_sample.{mode_name}.{outside_name}.{}", align_corners as u8);
                let s = GridSample { mode, outside, align_corners, images: 1, channels: 2, from: [3, 4], points: 8 };
                let (x, grid, d) = (cases.get(case, "x"), cases.get(case, "g"), cases.get(case, "d"));
                let (mut out, mut dx, mut d_grid) = (vec![0.0; 16], vec![0.0; 24], vec![0.0; 16]);
                grid_sample::cpu::forward(&s, x, grid, &mut out);
                grid_sample::cpu::backward_input(&s, grid, d, &mut dx);
                grid_sample::cpu::backward_grid(&s, x, grid, d, &mut d_grid);
                cases.check(case, "out", &out);
                cases.check(case, "dx", &dx);
                cases.check(case, "dg", &d_grid);
            }
        }
    }
}

#[test]
fn losses_activations_and_attention_are_those_of_torch() {
    let cases = Cases::read();
    let case = "cross_entropy";
    let classes: Vec<i64> = cases.get(case, "classes").iter().map(|c| *c as i64).collect();
    let targets = Targets { classes: &classes, smoothing: 0.1, ignored: -100 };
    let (mut l, mut dx) = (vec![0.0; 30], vec![0.0; 30]);
    let loss = softmax::cpu::cross_entropy(5, cases.get(case, "x"), &targets, &mut l, &mut [0.0; 6]);
    softmax::cpu::cross_entropy_backward(5, &l, &targets, cases.get(case, "d")[0], &mut dx);
    cases.check(case, "out", &[loss]);
    cases.check(case, "dx", &dx);
    for (name, a) in [
        ("leaky_relu", Activation::LeakyRelu(0.2)),
        ("softplus", Activation::Softplus),
        ("silu", Activation::Silu),
        ("gelu", Activation::Gelu),
        ("gelu_tanh", Activation::GeluTanh),
    ] {
        let case = &format!("activation.{name}");
        let mut out = vec![0.0; 30];
        activation::cpu::forward(a, cases.get(case, "x"), &mut out);
        cases.check(case, "out", &out);
        activation::cpu::backward(a, cases.get(case, "x"), cases.get(case, "d"), &mut out);
        cases.check(case, "dx", &out);
    }
    for causal in [false, true] {
        let case = &format!("attention.{}", causal as u8);
        let a = Attention { causal, ..Attention::new(2, 3, 3, 4) };
        let (q, k, v) = (cases.get(case, "q"), cases.get(case, "k"), cases.get(case, "v"));
        let (mut out, mut log_sums) = (vec![0.0; 24], vec![0.0; 6]);
        attention::cpu::forward(&a, q, k, v, &mut out, &mut log_sums);
        let (mut dq, mut dk, mut dv) = (vec![0.0; 24], vec![0.0; 24], vec![0.0; 24]);
        let saved = attention::cpu::Saved { q, k, v, out: &out, log_sums: &log_sums, d_out: cases.get(case, "d") };
        attention::cpu::backward(&a, &saved, &mut dq, &mut dk, &mut dv, &mut Vec::new());
        cases.check(case, "out", &out);
        cases.check(case, "dq", &dq);
        cases.check(case, "dk", &dk);
        cases.check(case, "dv", &dv);
    }
}

#[test]
fn a_wrong_convention_is_noticed() {
    let cases = Cases::read();
    let wrong = Resample::new(Filter::Bilinear { align_corners: true }, [3, 4], [6, 8]);
    assert!(std::panic::catch_unwind(|| check_resample(&cases, "resample.bilinear.0", &wrong)).is_err());
}
