use super::*;
use crate::gemm::Precision;
use diorama_testkit::{assert_close, assert_gradient, random, wide};

#[test]
fn matches_the_reference_both_ways() {
    for cases::Case { m, layer, x, w, bias, d } in cases::cases() {
        let mut out = vec![9.0; d.len()];
        let l = layer.of_rows(m);
        cpu::forward(&l, &x, &w, &bias, &mut out);
        let (xd, wd, bd, dd) = (wide(&x), wide(&w), wide(&bias), wide(&d));
        assert_close("forward", &out, &reference::forward(m, &layer, &xd, &wd, &bd), 1e-4);
        let (mut dx, mut dw, mut db) = (vec![9.0; x.len()], vec![9.0; w.len()], vec![9.0; bias.len()]);
        let gradients = Gradients { x: Some(&mut dx), w: Some(&mut dw), bias: Some(&mut db) };
        cpu::backward(&l, &x, &w, &out, &d, gradients);
        let (rx, rw, rb) = reference::backward(m, &layer, &xd, &wd, &bd, &dd);
        assert_close("dx", &dx, &rx, 1e-4);
        assert_close("dw", &dw, &rw, 1e-4);
        assert_close("db", &db, &rb, 1e-4);
    }
}

#[test]
fn reference_gradients_match_central_differences() {
    let m = 2;
    for a in cases::ACTIVATIONS.into_iter().chain([Activation::Silu]) {
        let layer = Dense { k: 3, n: 2, bias: BiasKind::PerRow, activation: a };
        let (x, w, b, d) = (wide(&random(6, 1)), wide(&random(6, 2)), wide(&random(4, 3)), wide(&random(4, 4)));
        let (dx, dw, db) = reference::backward(m, &layer, &x, &w, &b, &d);
        let loss = |x: &[f64], w: &[f64], b: &[f64]| reference::forward(m, &layer, x, w, b).iter().zip(&d).map(|(a, b)| a * b).sum::<f64>();
        assert_gradient("x", &dx, &x, 1e-6, |x| loss(x, &w, &b));
        assert_gradient("w", &dw, &w, 1e-6, |w| loss(&x, w, &b));
        assert_gradient("b", &db, &b, 1e-6, |b| loss(&x, &w, b));
    }
}

#[test]
fn what_is_not_wanted_changes_nothing_else_and_threads_change_no_bit() {
    for (rows, activation) in [(50, Activation::Relu), (5000, Activation::Relu), (5000, Activation::None)] {
        let l = Linear { rows, inputs: 40, outputs: 56, bias: BiasKind::Shared, activation, precision: Precision::F32 };
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
