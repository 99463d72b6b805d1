use super::*;
use diorama_testkit::{assert_close, assert_gradient, random, wide};

#[test]
fn matches_the_reference_both_ways() {
    for cases::Case { dims, bands, x, d } in cases::cases() {
        let mut out = vec![9.0; d.len()];
        cpu::forward(dims, bands, &x, &mut out);
        assert_close("forward", &out, &reference::forward(bands, &wide(&x)), 1e-5);
        let mut g = vec![9.0; x.len()];
        cpu::backward(dims, bands, &x, &d, &mut g);
        assert_close("backward", &g, &reference::backward(bands, &wide(&x), &wide(&d)), 1e-4);
        let (v, mut along) = (random(x.len(), 8), vec![9.0; d.len()]);
        cpu::tangent(dims, bands, &x, &v, &mut along);
        assert_close("tangent", &along, &reference::tangent(bands, &wide(&x), &wide(&v)), 1e-4);
    }
}

#[test]
fn reference_gradient_matches_central_differences() {
    let (x, d) = (vec![0.13, -0.37, 0.81], wide(&random(12, 2)));
    let g = reference::backward(4, &x, &d);
    assert_gradient("x", &g, &x, 1e-6, |x| reference::forward(4, x).iter().zip(&d).map(|(a, b)| a * b).sum());
    let v = [0.4, -1.2, 0.7];
    let along: f64 = reference::tangent(4, &x, &v).iter().zip(&d).map(|(t, d)| t * d).sum();
    assert!((along - g.iter().zip(&v).map(|(g, v)| g * v).sum::<f64>()).abs() < 1e-9, "tangent: {along}");
}

#[test]
fn waves_are_continuous_and_bounded() {
    let x: Vec<f64> = (0..4000).map(|i| i as f64 * 1e-3 - 2.0).collect();
    let y = reference::forward(1, &x);
    assert!(y.windows(2).all(|w| (w[1] - w[0]).abs() <= 2.1e-3) && y.iter().all(|v| v.abs() <= 1.0));
}
