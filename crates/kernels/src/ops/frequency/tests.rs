use super::*;
use diorama_testkit::{assert_close, assert_gradient, random, wide};

#[test]
fn matches_the_reference_both_ways() {
    for cases::Case { encoding: f, x, d } in cases::cases() {
        let mut out = vec![9.0; d.len()];
        cpu::forward(&f, &x, &mut out);
        assert_close("forward", &out, &reference::forward(&f, &wide(&x)), 1e-5);
        let mut dx = vec![9.0; x.len()];
        cpu::backward(&f, &x, &d, &mut dx);
        assert_close("backward", &dx, &reference::backward(&f, &wide(&x), &wide(&d)), 1e-4);
        let (v, mut along) = (random(x.len(), 8), vec![9.0; d.len()]);
        cpu::tangent(&f, &x, &v, &mut along);
        assert_close("tangent", &along, &reference::tangent(&f, &wide(&x), &wide(&v)), 1e-4);
    }
}

#[test]
fn reference_gradient_matches_central_differences() {
    for mut f in cases::encodings() {
        f.bands = f.bands.min(4);
        let (x, d) = (wide(&random(2 * f.dims, 3)), wide(&random(2 * f.output_dims(), 4)));
        let g = reference::backward(&f, &x, &d);
        assert_gradient("x", &g, &x, 1e-6, |x| reference::forward(&f, x).iter().zip(&d).map(|(a, b)| a * b).sum());
        let v = wide(&random(x.len(), 5));
        let along: f64 = reference::tangent(&f, &x, &v).iter().zip(&d).map(|(t, d)| t * d).sum();
        let want: f64 = g.iter().zip(&v).map(|(g, v)| g * v).sum();
        assert!((along - want).abs() < 1e-9 * want.abs().max(1.0), "tangent: {along} {want}");
    }
}

#[test]
fn the_window_changes_the_encoding() {
    let full = Frequency { dims: 1, bands: 4, include_input: false, pi: true, window: None };
    let x = [0.3];
    let none = reference::forward(&Frequency { window: Some(0.0), ..full }, &x);
    assert!(none.iter().all(|v| *v == 0.0));
    assert_eq!(reference::forward(&Frequency { window: Some(4.0), ..full }, &x), reference::forward(&full, &x));
}
