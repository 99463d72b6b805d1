use super::*;
use diorama_testkit::{assert_close, assert_gradient, random, wide};

const ALL: [Activation; 7] = [
    Activation::None,
    Activation::Relu,
    Activation::Sigmoid,
    Activation::Softplus,
    Activation::TruncatedExp,
    Activation::LeakyRelu,
    Activation::Tanh,
];
const KINDS: [BiasKind; 3] = [BiasKind::None, BiasKind::Shared, BiasKind::PerRow];

#[test]
fn matches_the_reference_both_ways() {
    for (m, k, n) in [(0, 3, 4), (1, 1, 1), (7, 5, 3), (500, 64, 64), (385, 33, 257), (12, 256, 16), (1300, 8, 5), (5000, 9, 11)] {
        for kind in KINDS {
            for a in ALL {
                let (x, mut w, b) = (random(m * k, 1), random(k * n, 2), random(kind.len(m, n), 3));
                let fan = (k as f32).sqrt();
                w.iter_mut().for_each(|w| *w /= fan);
                let d = random(m * n, 4);
                let mut out = vec![9.0; m * n];
                let l = Linear { rows: m, inputs: k, outputs: n, bias: kind, activation: a };
                cpu::forward(&l, &x, &w, &b, &mut out);
                let (xd, wd, bd, dd) = (wide(&x), wide(&w), wide(&b), wide(&d));
                assert_close("forward", &out, &reference::forward(m, k, n, &xd, &wd, &bd, kind, a), 1e-4);
                let (mut dx, mut dw, mut db) = (vec![9.0; x.len()], vec![9.0; w.len()], vec![9.0; b.len()]);
                let gradients = Gradients { x: Some(&mut dx), w: Some(&mut dw), bias: Some(&mut db) };
                cpu::backward(&l, &x, &w, &out, &d, gradients);
                let (rx, rw, rb) = reference::backward(m, k, n, &xd, &wd, &bd, kind, a, &dd);
                assert_close("dx", &dx, &rx, 1e-4);
                assert_close("dw", &dw, &rw, 1e-4);
                assert_close("db", &db, &rb, 1e-4);
            }
        }
    }
}

#[test]
fn reference_gradients_match_central_differences() {
    let (m, k, n) = (2, 3, 2);
    for a in ALL.into_iter().chain([Activation::Silu]) {
        let (x, w, b, d) = (wide(&random(6, 1)), wide(&random(6, 2)), wide(&random(4, 3)), wide(&random(4, 4)));
        let (dx, dw, db) = reference::backward(m, k, n, &x, &w, &b, BiasKind::PerRow, a, &d);
        let loss = |x: &[f64], w: &[f64], b: &[f64]| {
            reference::forward(m, k, n, x, w, b, BiasKind::PerRow, a).iter().zip(&d).map(|(a, b)| a * b).sum::<f64>()
        };
        assert_gradient("x", &dx, &x, 1e-6, |x| loss(x, &w, &b));
        assert_gradient("w", &dw, &w, 1e-6, |w| loss(&x, w, &b));
        assert_gradient("b", &db, &b, 1e-6, |b| loss(&x, &w, b));
    }
}

#[test]
fn what_is_not_wanted_changes_nothing_else_and_threads_change_no_bit() {
    for (rows, activation) in [(50, Activation::Relu), (5000, Activation::Relu), (5000, Activation::None)] {
        let l = Linear { rows, inputs: 40, outputs: 56, bias: BiasKind::Shared, activation };
        let (x, w, b, d) = (random(rows * 40, 1), random(40 * 56, 2), random(56, 3), random(rows * 56, 4));
        let run = |threads: usize, wanted: [bool; 3]| {
            rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(|| {
                let mut out = vec![0.0; d.len()];
                cpu::forward(&l, &x, &w, &b, &mut out);
                let mut all = [vec![9.0; x.len()], vec![9.0; w.len()], vec![9.0; b.len()]];
                let [dx, dw, db] = &mut all;
                let [x_wanted, w_wanted, b_wanted] = wanted;
                let gradients = Gradients { x: x_wanted.then_some(dx), w: w_wanted.then_some(dw), bias: b_wanted.then_some(db) };
                cpu::backward(&l, &x, &w, &out, &d, gradients);
                (out, all)
            })
        };
        let want = run(1, [true; 3]);
        assert!(run(2, [true; 3]) == want && run(5, [true; 3]) == want);
        for i in 0..3 {
            let (_, got) = run(2, std::array::from_fn(|j| i == j));
            for j in 0..3 {
                assert!(if i == j { got[j] == want.1[j] } else { got[j].iter().all(|v| *v == 9.0) }, "{i} {j}");
            }
        }
    }
}
