use super::*;
use diorama_testkit::{assert_close, wide};

#[test]
fn matches_the_reference() {
    for cases::Case { rays, n, m, edges, weights, u } in cases::cases() {
        let mut out = vec![9.0; rays * m];
        cpu::sample(n, &edges, &weights, m, &u, &mut out);
        assert_close("t", &out, &reference::sample(n, &wide(&edges), &wide(&weights), m, &wide(&u)), 1e-4);
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
