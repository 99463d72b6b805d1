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
    for (m, k, n) in [(0, 3, 4), (1, 1, 1), (7, 5, 3), (500, 64, 64), (385, 33, 257), (12, 256, 16), (1300, 8, 5)] {
        for kind in KINDS {
            for a in ALL {
                let layer = Dense { k, n, bias: kind, activation: a };
                let (x, mut w, b) = (random(m * k, 1), random(k * n, 2), random(kind.numbers(m, n), 3));
                let fan = (k as f32).sqrt();
                w.iter_mut().for_each(|w| *w /= fan);
                let d = random(m * n, 4);
                let mut out = vec![9.0; m * n];
                cpu::forward(m, &layer, &x, &w, &b, &mut out);
                let (xd, wd, bd, dd) = (wide(&x), wide(&w), wide(&b), wide(&d));
                assert_close("forward", &out, &reference::forward(m, &layer, &xd, &wd, &bd), 1e-4);
                let (mut dx, mut dw, mut db) = (vec![9.0; x.len()], vec![9.0; w.len()], vec![9.0; b.len()]);
                cpu::backward(m, &layer, &x, &w, &out, &d, [&mut dx, &mut dw, &mut db]);
                let (rx, rw, rb) = reference::backward(m, &layer, &xd, &wd, &bd, &dd);
                assert_close("dx", &dx, &rx, 1e-4);
                assert_close("dw", &dw, &rw, 1e-4);
                assert_close("db", &db, &rb, 1e-4);
            }
        }
    }
}

#[test]
fn reference_gradients_match_central_differences() {
    let m = 2;
    for a in ALL.into_iter().chain([Activation::Silu]) {
        let layer = Dense { k: 3, n: 2, bias: BiasKind::PerRow, activation: a };
        let (x, w, b, d) = (wide(&random(6, 1)), wide(&random(6, 2)), wide(&random(4, 3)), wide(&random(4, 4)));
        let (dx, dw, db) = reference::backward(m, &layer, &x, &w, &b, &d);
        let loss = |x: &[f64], w: &[f64], b: &[f64]| reference::forward(m, &layer, x, w, b).iter().zip(&d).map(|(a, b)| a * b).sum::<f64>();
        assert_gradient("x", &dx, &x, 1e-6, |x| loss(x, &w, &b));
        assert_gradient("w", &dw, &w, 1e-6, |w| loss(&x, w, &b));
        assert_gradient("b", &db, &b, 1e-6, |b| loss(&x, &w, b));
    }
}
