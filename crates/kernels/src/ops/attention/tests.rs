use super::*;
use crate::simd::{Level, with_level};
use diorama_testkit::{assert_close, assert_gradient, random, wide};

fn scaled(n: usize, seed: u64) -> Vec<f32> {
    random(n, seed).iter().map(|v| v * 3.0).collect()
}

fn check(a: &Attention) {
    let (queries, keys) = (a.batch * a.queries * a.width, a.batch * a.keys * a.width);
    let (q, k, v, d_out) = (scaled(queries, 1), scaled(keys, 2), random(keys, 3), random(queries, 4));
    let (mut out, mut log_sums) = (vec![9.0; queries], vec![9.0; a.batch * a.queries]);
    cpu::forward(a, &q, &k, &v, &mut out, &mut log_sums);
    let (want, want_sums) = reference::forward(a, &wide(&q), &wide(&k), &wide(&v));
    assert_close("forward", &out, &want, 1e-4);
    assert_close("log sums", &log_sums, &want_sums, 1e-5);
    let (mut dq, mut dk, mut dv) = (vec![9.0; queries], vec![9.0; keys], vec![9.0; keys]);
    let saved = cpu::Saved { q: &q, k: &k, v: &v, out: &out, log_sums: &log_sums, d_out: &d_out };
    cpu::backward(a, &saved, &mut dq, &mut dk, &mut dv, &mut vec![9.0; 10]);
    let (wq, wk, wv) = reference::backward(a, &wide(&q), &wide(&k), &wide(&v), &wide(&d_out));
    assert_close("dq", &dq, &wq, 1e-4);
    assert_close("dk", &dk, &wk, 1e-4);
    assert_close("dv", &dv, &wv, 1e-4);
}

#[test]
fn matches_the_reference_both_ways_at_every_level() {
    let shapes =
        [(0, 3, 3, 4), (2, 0, 3, 4), (1, 1, 1, 1), (3, 50, 50, 20), (1, 130, 70, 33), (2, 65, 600, 16), (9, 10, 5, 8), (1, 700, 1030, 5)];
    for level in Level::available() {
        for (batch, queries, keys, width) in shapes {
            for causal in [false, true] {
                with_level(level, || check(&Attention { causal, ..Attention::new(batch, queries, keys, width) }));
            }
        }
    }
}

#[test]
fn reference_gradients_match_central_differences() {
    for causal in [false, true] {
        let a = Attention { causal, ..Attention::new(2, 3, 4, 2) };
        let (q, k, v, d) = (wide(&random(12, 1)), wide(&random(16, 2)), wide(&random(16, 3)), wide(&random(12, 4)));
        let (dq, dk, dv) = reference::backward(&a, &q, &k, &v, &d);
        let loss = |q: &[f64], k: &[f64], v: &[f64]| reference::forward(&a, q, k, v).0.iter().zip(&d).map(|(a, b)| a * b).sum::<f64>();
        assert_gradient("q", &dq, &q, 1e-6, |q| loss(q, &k, &v));
        assert_gradient("k", &dk, &k, 1e-6, |k| loss(&q, k, &v));
        assert_gradient("v", &dv, &v, 1e-6, |v| loss(&q, &k, v));
    }
}

#[test]
fn large_scores_do_not_overflow() {
    let a = Attention { scale: 1.0, ..Attention::new(1, 2, 2, 1) };
    let (mut out, mut log_sums) = ([0.0; 2], [0.0; 2]);
    cpu::forward(&a, &[100.0, -100.0], &[100.0, -100.0], &[1.0, 2.0], &mut out, &mut log_sums);
    assert_eq!((out, log_sums), ([1.0, 2.0], [1e4, 1e4]));
}
