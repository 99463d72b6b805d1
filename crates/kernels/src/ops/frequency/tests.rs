use super::*;
use diorama_testkit::{assert_close, assert_gradient, random, wide};

fn variants() -> Vec<Frequency> {
    let f = Frequency { dims: 3, bands: 10, include_input: false, pi: true, window: None };
    vec![
        f,
        Frequency { include_input: true, pi: false, ..f },
        Frequency { window: Some(4.3), bands: 6, ..f },
        Frequency { dims: 2, bands: 0, include_input: true, ..f },
    ]
}

#[test]
fn matches_the_reference_both_ways() {
    for f in variants() {
        for n in [0, 1, 17] {
            let x = random(n * f.dims, 1);
            let d = random(n * f.output_dims(), 2);
            let mut out = vec![9.0; d.len()];
            cpu::forward(&f, &x, &mut out);
            assert_close("forward", &out, &reference::forward(&f, &wide(&x)), 1e-5);
            let mut dx = vec![9.0; x.len()];
            cpu::backward(&f, &x, &d, &mut dx);
            assert_close("backward", &dx, &reference::backward(&f, &wide(&x), &wide(&d)), 1e-4);
        }
    }
}

#[test]
fn reference_gradient_matches_central_differences() {
    for mut f in variants() {
        f.bands = f.bands.min(4);
        let (x, d) = (wide(&random(2 * f.dims, 3)), wide(&random(2 * f.output_dims(), 4)));
        let g = reference::backward(&f, &x, &d);
        assert_gradient("x", &g, &x, 1e-6, |x| reference::forward(&f, x).iter().zip(&d).map(|(a, b)| a * b).sum());
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
