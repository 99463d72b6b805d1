use super::*;
use crate::ops::composite::{Packed, cases::scene};
use diorama_testkit::{assert_close, assert_gradient, random_unit, wide};

#[test]
fn matches_the_reference_both_ways() {
    for cases::Case { rays, scene, weights: w, d } in cases::cases() {
        let (p, mut g) = (scene.packed(), vec![0.0; w.len()]);
        let loss: Vec<f32> = (0..rays).map(|r| cpu::ray(&p, r, &w[p.range(r)], d[r], &mut g[p.range(r)])).collect();
        assert_close("loss", &loss, &reference::forward(&p, &wide(&w)), 1e-4);
        assert_close("weights", &g, &reference::backward(&p, &wide(&w), &wide(&d)), 1e-4);
    }
}

#[test]
fn normalized_distance_is_finite_and_keeps_order() {
    let (offsets, t, dt) = ([0u32, 3], [0.1f32, 3.0, 500.0], [0.4f32, 2.0, 1e6]);
    let p = Packed { offsets: &offsets, t: &t, dt: &dt };
    let (mut s, mut ds) = (Vec::new(), Vec::new());
    cpu::normalize(&p, &mut s, &mut ds);
    for i in 0..3 {
        let at = |t: f64| 4.0 * t / (1.0 + t);
        let (from, to) = (at(t[i] as f64), at(t[i] as f64 + dt[i] as f64));
        assert!((s[i] as f64 - from).abs() < 4e-6 && (ds[i] as f64 - (to - from)).abs() < 4e-6);
        assert!(s[i] + ds[i] <= 4.0);
    }
}

#[test]
fn reference_gradient_matches_central_differences() {
    let s = scene(4, 6);
    let p = s.packed();
    let w = wide(&random_unit(s.t.len(), 1));
    let g = reference::backward(&p, &w, &[1.0; 4]);
    assert_gradient("weights", &g, &w, 1e-5, |w| reference::forward(&p, w).iter().sum());
}
