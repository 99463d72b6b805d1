use super::cpu::Gradients;
use super::reference::Layout;
use super::*;
use crate::simd::{Level, with_level};
use diorama_testkit::{assert_close, assert_gradient, random, wide};

const ACTIVATIONS: [Activation; 5] = [Activation::None, Activation::Relu, Activation::LeakyRelu(0.2), Activation::Silu, Activation::Gelu];

/// Numbers whose mean is not 0.
fn shifted(n: usize, seed: u64) -> Vec<f32> {
    random(n, seed).iter().map(|v| 3.0 + 2.0 * v).collect()
}

fn ones_and_zeros(norm_scale: Option<&[f32]>, norm_shift: Option<&[f32]>, n: usize) -> (Vec<f64>, Vec<f64>) {
    (norm_scale.map_or(vec![1.0; n], wide), norm_shift.map_or(vec![0.0; n], wide))
}

fn check_planes(norm: &Norm) {
    let n = norm.elements();
    let (x, d) = (shifted(n, 1), random(n, 2));
    let layout = Layout::of(norm);
    let (mut mean, mut variance) = (random(norm.sets(), 7), shifted(norm.sets(), 8));
    let statistics = if norm.over == Over::Given { (wide(&mean), wide(&variance)) } else { layout.statistics(&wide(&x)) };
    let (mut out, mut dx) = (vec![9.0; n], vec![9.0; n]);
    let (mut d_scale, mut d_shift) = (vec![9.0; norm.channels], vec![9.0; norm.channels]);
    cpu::forward(norm, &x, &mut mean, &mut variance, &mut out);
    let g = Gradients { x: &mut dx, scale: &mut d_scale, shift: &mut d_shift };
    cpu::backward(norm, &x, &mean, &variance, &d, g, &mut Vec::new());
    if n > 0 {
        assert_close("mean", &mean, &statistics.0, 1e-5);
        assert_close("variance", &variance, &statistics.1, 1e-5);
    }
    let (scale, shift) = ones_and_zeros(norm.scale, norm.shift, norm.channels);
    let at = (&statistics.0[..], &statistics.1[..]);
    assert_close("forward", &out, &layout.forward(&wide(&x), at, &scale, &shift), 1e-4);
    let (wx, ws, wb) = layout.backward(&wide(&x), at, &scale, &shift, &wide(&d));
    assert_close("dx", &dx, &wx, 1e-4);
    assert_close("d_scale", &d_scale, &ws, 1e-4);
    assert_close("d_shift", &d_shift, &wb, 1e-4);
}

#[test]
fn batches_and_groups_match_the_reference_both_ways_at_every_level() {
    for level in Level::available() {
        for (images, channels, places) in [(0, 4, 9), (3, 4, 0), (1, 2, 5), (2, 6, 49), (5, 4, 1), (2, 4, 5000)] {
            let (scale, shift) = (shifted(channels, 3), random(channels, 4));
            for over in [Over::Batch, Over::Given, Over::Groups(1), Over::Groups(2), Over::Groups(channels)] {
                // A set of one or two elements has no variance to speak of.
                if over != Over::Given && (1..3).contains(&(Norm { over, images, channels, places, ..plain() }.count())) {
                    continue;
                }
                for (k, activation) in ACTIVATIONS.into_iter().enumerate() {
                    let (scale, shift) = (Some(&scale[..]).filter(|_| k != 1), Some(&shift[..]).filter(|_| k != 2));
                    let norm = Norm { over, images, channels, places, scale, shift, activation, ..plain() };
                    with_level(level, || check_planes(&norm));
                }
            }
        }
    }
}

fn plain<'a>() -> Norm<'a> {
    Norm { over: Over::Batch, images: 0, channels: 0, places: 0, epsilon: 1e-5, scale: None, shift: None, activation: Activation::None }
}

#[test]
fn layers_match_the_reference_both_ways_at_every_level() {
    for level in Level::available() {
        for (rows, width) in [(0, 4), (3, 0), (1, 3), (7, 33), (70, 384), (1100, 20)] {
            let (scale, shift) = (shifted(width, 3), random(width, 4));
            let (x, d) = (shifted(rows * width, 1), random(rows * width, 2));
            for (k, activation) in ACTIVATIONS.into_iter().enumerate() {
                let (scale, shift) = (Some(&scale[..]).filter(|_| k % 2 == 0), Some(&shift[..]).filter(|_| k % 3 == 0));
                let norm = LayerNorm { width, epsilon: 1e-5, scale, shift, activation };
                let (mut mean, mut variance, mut out) = (vec![9.0; rows], vec![9.0; rows], vec![9.0; x.len()]);
                let (mut dx, mut d_scale, mut d_shift) = (vec![9.0; x.len()], vec![9.0; width], vec![9.0; width]);
                with_level(level, || {
                    layer::forward(&norm, &x, &mut mean, &mut variance, &mut out);
                    let g = Gradients { x: &mut dx, scale: &mut d_scale, shift: &mut d_shift };
                    layer::backward(&norm, &x, &mean, &variance, &d, g, &mut Vec::new());
                });
                let layout = Layout::of_layer(&norm, rows);
                let statistics = layout.statistics(&wide(&x));
                let at = (&statistics.0[..], &statistics.1[..]);
                let (scale, shift) = ones_and_zeros(scale, shift, width);
                assert_close("forward", &out, &layout.forward(&wide(&x), at, &scale, &shift), 1e-4);
                let (wx, ws, wb) = layout.backward(&wide(&x), at, &scale, &shift, &wide(&d));
                assert_close("dx", &dx, &wx, 1e-4);
                assert_close("d_scale", &d_scale, &ws, 1e-4);
                assert_close("d_shift", &d_shift, &wb, 1e-4);
            }
        }
    }
}

#[test]
fn reference_gradients_match_central_differences() {
    let (images, channels, places) = (2, 4, 3);
    let (x, d) = (wide(&random(24, 1)), wide(&random(24, 2)));
    let (scale, shift) = (wide(&shifted(4, 3)), wide(&random(4, 4)));
    for over in [Over::Batch, Over::Given, Over::Groups(2)] {
        for activation in ACTIVATIONS {
            let norm = Norm { over, images, channels, places, activation, ..plain() };
            let layout = Layout::of(&norm);
            let given = (wide(&random(4, 7)), wide(&shifted(4, 8)));
            let loss = |x: &[f64], scale: &[f64], shift: &[f64]| {
                let own = if layout.given { given.clone() } else { layout.statistics(x) };
                layout.forward(x, (&own.0, &own.1), scale, shift).iter().zip(&d).map(|(a, b)| a * b).sum::<f64>()
            };
            let own = if layout.given { given.clone() } else { layout.statistics(&x) };
            let (dx, ds, db) = layout.backward(&x, (&own.0, &own.1), &scale, &shift, &d);
            assert_gradient("x", &dx, &x, 1e-5, |x| loss(x, &scale, &shift));
            assert_gradient("scale", &ds, &scale, 1e-5, |s| loss(&x, s, &shift));
            assert_gradient("shift", &db, &shift, 1e-5, |b| loss(&x, &scale, b));
        }
    }
}

#[test]
fn a_mean_far_from_zero_costs_no_variance() {
    let x: Vec<f32> = random(9000, 1).iter().map(|v| 1000.0 + v).collect();
    let norm = Norm { images: 1, channels: 1, places: 9000, ..plain() };
    let (mut mean, mut variance, mut out) = ([0.0], [0.0], vec![0.0; 9000]);
    cpu::forward(&norm, &x, &mut mean, &mut variance, &mut out);
    let want = Layout::of(&norm).statistics(&wide(&x));
    assert_close("variance", &variance, &want.1, 1e-4);
}

#[test]
fn running_statistics_move_by_the_momentum() {
    let (mut mean, mut variance) = ([1.0], [2.0]);
    update_running(5, 0.1, &[3.0], &[4.0], &mut mean, &mut variance);
    assert_close("mean", &mean, &[1.2], 1e-6);
    // The unbiased variance is 5.
    assert_close("variance", &variance, &[2.3], 1e-6);
}

#[test]
fn results_too_large_for_caches_are_those_of_small_ones() {
    let (width, rows) = (1030, crate::vector::LARGE / 1030 + 1);
    let norm = LayerNorm { width, epsilon: 1e-5, scale: None, shift: None, activation: Activation::Relu };
    let (x, d) = (shifted(width * rows, 1), random(width * rows, 2));
    let run = |first: usize, last: usize| {
        let (x, d, rows) = (&x[first * width..last * width], &d[first * width..last * width], last - first);
        let (mut mean, mut variance, mut out, mut dx) = (vec![0.0; rows], vec![0.0; rows], vec![9.0; x.len()], vec![9.0; x.len()]);
        layer::forward(&norm, x, &mut mean, &mut variance, &mut out);
        let g = Gradients { x: &mut dx, scale: &mut [], shift: &mut [] };
        layer::backward(&norm, x, &mean, &variance, d, g, &mut Vec::new());
        (out, dx)
    };
    let (out, dx) = run(0, rows);
    for first in [0, rows - 7] {
        let (small, d_small) = run(first, first + 7);
        assert_eq!(out[first * width..(first + 7) * width], small);
        assert_eq!(dx[first * width..(first + 7) * width], d_small);
    }
}
