use super::*;
use crate::simd::{Level, with_level};
use diorama_testkit::{assert_close, assert_gradient, random, wide};

const SHAPES: [(usize, usize); 7] = [(0, 5), (1, 1), (3, 7), (33, 10), (5, 1000), (700, 65), (4, 0)];

fn scaled(n: usize, seed: u64) -> Vec<f32> {
    random(n, seed).iter().map(|v| v * 8.0).collect()
}

#[test]
fn rows_match_the_reference_both_ways_at_every_level() {
    for level in Level::available() {
        for (m, n) in SHAPES {
            let (x, d) = (scaled(m * n, 1), random(m * n, 2));
            let (mut y, mut l, mut dy, mut dl) = (vec![9.0; m * n], vec![9.0; m * n], vec![9.0; m * n], vec![9.0; m * n]);
            with_level(level, || {
                cpu::softmax(n, &x, &mut y);
                cpu::log_softmax(n, &x, &mut l);
                cpu::softmax_backward(n, &y, &d, &mut dy);
                cpu::log_softmax_backward(n, &l, &d, &mut dl);
            });
            let (wy, wl) = (reference::softmax(n, &wide(&x)), reference::log_softmax(n, &wide(&x)));
            assert_close("softmax", &y, &wy, 1e-5);
            assert_close("log softmax", &l, &wl, 1e-5);
            assert_close("softmax backward", &dy, &reference::softmax_backward(n, &wy, &wide(&d)), 1e-5);
            assert_close("log softmax backward", &dl, &reference::log_softmax_backward(n, &wl, &wide(&d)), 1e-5);
        }
    }
}

/// Classes of `m` rows, of which every fourth is ignored.
fn classes(m: usize, n: usize) -> Vec<i64> {
    (0..m).map(|i| if i % 4 == 3 { -100 } else { (i * 7 % n) as i64 }).collect()
}

#[test]
fn cross_entropy_matches_the_reference_both_ways_at_every_level() {
    for level in Level::available() {
        for (m, n) in [(1, 1), (3, 7), (33, 10), (5, 1000), (700, 65)] {
            for smoothing in [0.0, 0.1] {
                let (x, classes) = (scaled(m * n, 1), classes(m, n));
                let targets = Targets { classes: &classes, smoothing, ignored: -100 };
                let (mut l, mut dx, mut losses) = (vec![9.0; m * n], vec![9.0; m * n], vec![9.0; m]);
                let loss = with_level(level, || {
                    let loss = cpu::cross_entropy(n, &x, &targets, &mut l, &mut losses);
                    cpu::cross_entropy_backward(n, &l, &targets, 3.0, &mut dx);
                    loss
                });
                assert_close("loss", &[loss], &[reference::cross_entropy(n, &wide(&x), &targets)], 1e-5);
                let want: Vec<f64> = reference::cross_entropy_backward(n, &wide(&x), &targets).iter().map(|v| v * 3.0).collect();
                assert_close("gradient", &dx, &want, 1e-5);
            }
        }
    }
}

#[test]
fn reference_gradients_match_central_differences() {
    let (m, n) = (5, 4);
    let (x, d) = (wide(&random(m * n, 1)), wide(&random(m * n, 2)));
    let dot = |a: Vec<f64>| a.iter().zip(&d).map(|(a, b)| a * b).sum::<f64>();
    let g = reference::softmax_backward(n, &reference::softmax(n, &x), &d);
    assert_gradient("softmax", &g, &x, 1e-6, |x| dot(reference::softmax(n, x)));
    let g = reference::log_softmax_backward(n, &reference::log_softmax(n, &x), &d);
    assert_gradient("log softmax", &g, &x, 1e-6, |x| dot(reference::log_softmax(n, x)));
    let classes = classes(m, n);
    let targets = Targets { classes: &classes, smoothing: 0.2, ignored: -100 };
    let g = reference::cross_entropy_backward(n, &x, &targets);
    assert_gradient("cross entropy", &g, &x, 1e-6, |x| reference::cross_entropy(n, x, &targets));
}

#[test]
fn large_logits_neither_overflow_nor_lose_their_order() {
    let (mut y, mut l) = ([0.0; 3], [0.0; 3]);
    cpu::softmax(3, &[1e4, 1e4 - 1.0, -1e4], &mut y);
    cpu::log_softmax(3, &[1e4, 1e4 - 1.0, -1e4], &mut l);
    let e = (-1.0f64).exp();
    assert_close("softmax", &y, &[1.0 / (1.0 + e), e / (1.0 + e), 0.0], 1e-6);
    assert_close("log softmax", &l, &[-(1.0 + e).ln(), -1.0 - (1.0 + e).ln(), -2e4 - (1.0 + e).ln()], 1e-6);
}

#[test]
fn a_loss_of_no_rows_is_no_number() {
    let targets = Targets { classes: &[-100, -100], smoothing: 0.0, ignored: -100 };
    assert!(cpu::cross_entropy(2, &[1.0; 4], &targets, &mut [0.0; 4], &mut [0.0; 2]).is_nan());
}

#[test]
#[should_panic(expected = "class 7 of 3")]
fn a_class_outside_is_refused() {
    cpu::cross_entropy(3, &[0.0; 3], &Targets { classes: &[7], smoothing: 0.0, ignored: -100 }, &mut [0.0; 3], &mut [0.0]);
}
