use super::*;
use diorama_testkit::{assert_close, random_unit, wide};

#[test]
fn matches_the_reference() {
    for (r, n, m) in [(0, 4, 3), (1, 1, 1), (50, 16, 33)] {
        let edges: Vec<f32> = (0..r).flat_map(|_| (0..=n).map(|i| i as f32 * 0.3 + 1.0)).collect();
        let mut w = random_unit(r * n, 1);
        w.iter_mut().step_by(3).for_each(|w| *w = 0.0);
        let u = random_unit(r * m, 2);
        let mut out = vec![9.0; r * m];
        cpu::sample(n, &edges, &w, m, &u, &mut out);
        assert_close("t", &out, &reference::sample(n, &wide(&edges), &wide(&w), m, &wide(&u)), 1e-4);
    }
}

#[test]
fn samples_gather_where_the_weight_is() {
    let edges = [0.0, 1.0, 2.0, 3.0];
    let u: Vec<f32> = (0..100).map(|i| i as f32 / 100.0).collect();
    let mut out = vec![0.0; 100];
    cpu::sample(3, &edges, &[0.0, 1.0, 0.0], 100, &u, &mut out);
    assert!(out.iter().filter(|t| (1.0..=2.0).contains(*t)).count() >= 99);
}
