use super::*;
use diorama_testkit::{assert_close, assert_gradient, random, wide};

#[test]
fn matches_the_reference_both_ways() {
    for cases::Case { degree, dirs, d } in cases::cases() {
        let mut out = vec![9.0; d.len()];
        cpu::forward(degree, &dirs, &mut out);
        assert_close("forward", &out, &reference::forward(degree, &wide(&dirs)), 1e-5);
        let mut g = vec![9.0; dirs.len()];
        cpu::backward(degree, &dirs, &d, &mut g);
        assert_close("backward", &g, &reference::backward(degree, &wide(&dirs), &wide(&d)), 1e-4);
    }
}

#[test]
fn reference_gradient_matches_central_differences() {
    let (x, d) = (wide(&random(9, 3)), wide(&random(48, 4)));
    let g = reference::backward(4, &x, &d);
    assert_gradient("directions", &g, &x, 1e-6, |x| reference::forward(4, x).iter().zip(&d).map(|(a, b)| a * b).sum());
}

#[test]
fn the_basis_is_orthonormal_over_the_sphere() {
    // A Fibonacci sphere integrates these polynomials closely.
    let n = 20_000;
    let mut gram = [[0.0f64; 16]; 16];
    for i in 0..n {
        let z = 1.0 - (2.0 * i as f64 + 1.0) / n as f64;
        let a = i as f64 * 2.399_963_229_728_653;
        let r = (1.0 - z * z).sqrt();
        let y = reference::forward(4, &[r * a.cos(), r * a.sin(), z]);
        for p in 0..16 {
            for q in 0..16 {
                gram[p][q] += y[p] * y[q] * 4.0 * std::f64::consts::PI / n as f64;
            }
        }
    }
    for (p, row) in gram.iter().enumerate() {
        for (q, v) in row.iter().enumerate() {
            assert!((v - (p == q) as u8 as f64).abs() < 1e-3, "{p} {q} {v}");
        }
    }
}
