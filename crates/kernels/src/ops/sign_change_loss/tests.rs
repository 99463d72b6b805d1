use super::*;
use crate::ops::tetrahedral_surface::{self, Surface};
use diorama_testkit::{assert_close, assert_gradient, random, wide};

#[test]
fn matches_the_reference_both_ways() {
    for (n, scale) in [(1, 1.0), (5, 30.0), (20, 0.1)] {
        let (t, positions) = tetrahedral_surface::tests::grid(n, 3);
        let s: Vec<f32> = random(t.vertices(), 4).iter().map(|s| s * scale).collect();
        let mut surface = Surface::default();
        tetrahedral_surface::cpu::extract(&t, &s, &positions, &mut surface);
        let (want, want_d) = reference::loss(t.edges(), &wide(&s));
        assert_close("value", &[cpu::value(&t, &surface, &s) as f32], &[want], 1e-5);
        let mut d_s = vec![1.0; s.len()];
        cpu::backward(&t, &surface, &s, 2.0, &mut d_s);
        let want_d: Vec<f64> = want_d.iter().map(|d| 1.0 + 2.0 * d).collect();
        assert_close("gradient", &d_s, &want_d, 1e-5);
    }
}

#[test]
fn reference_gradient_matches_central_differences() {
    let (t, _) = tetrahedral_surface::tests::grid(2, 3);
    let s = wide(&random(t.vertices(), 5));
    assert_gradient("d_s", &reference::loss(t.edges(), &s).1, &s, 1e-6, |s| reference::loss(t.edges(), s).0);
}

#[test]
fn ends_near_zero_cost_ln_2_each_and_no_surface_nothing() {
    let (t, positions) = tetrahedral_surface::tests::grid(1, 0);
    let mut s = vec![-1e-6; t.vertices()];
    s[0] = 1e-6;
    let mut surface = Surface::default();
    tetrahedral_surface::cpu::extract(&t, &s, &positions, &mut surface);
    assert!((cpu::value(&t, &surface, &s) - 2.0 * std::f64::consts::LN_2).abs() < 1e-5);
    s[0] = -1.0;
    tetrahedral_surface::cpu::extract(&t, &s, &positions, &mut surface);
    assert_eq!(cpu::value(&t, &surface, &s), 0.0);
}
