use super::*;
use diorama_testkit::{assert_close, assert_gradient, random, wide};

#[test]
fn matches_the_reference_both_ways() {
    for cases::Case { m, layer, x, w, bias, d } in cases::cases() {
        let mut out = vec![9.0; d.len()];
        cpu::forward(m, &layer, &x, &w, &bias, &mut out);
        let (xd, wd, bd, dd) = (wide(&x), wide(&w), wide(&bias), wide(&d));
        assert_close("forward", &out, &reference::forward(m, &layer, &xd, &wd, &bd), 1e-4);
        let (mut dx, mut dw, mut db) = (vec![9.0; x.len()], vec![9.0; w.len()], vec![9.0; bias.len()]);
        cpu::backward(m, &layer, &x, &w, &out, &d, [&mut dx, &mut dw, &mut db]);
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
