use super::*;
use crate::ops::march::Marched;
use cases::{M, N, ends, side};
use diorama_testkit::assert_close;

#[test]
fn matches_the_reference() {
    for c in cases::cases() {
        let want = c.want();
        let (mut coarse, mut fine) = (Marched::default(), Marched::default());
        cpu::stratified(&c.near_far, N, c.jitter, &mut coarse);
        cpu::refine(&coarse, &c.weights, N, M, c.jitter, &mut fine);
        for (got, edges, n) in [(&coarse, &want.coarse, N), (&fine, &want.fine, N + M)] {
            assert_eq!(got.offsets, (0..=c.near_far.len() / 2).map(|r| (r * n) as u32).collect::<Vec<u32>>());
            assert_close("starts", &got.t, &side(edges, n, false), 1e-4);
            assert_close("ends", &ends(&got.t, &got.dt), &side(edges, n, true), 1e-4);
        }
    }
}

#[test]
fn intervals_cover_near_to_far_without_gaps() {
    let near_far = [1.0, 2.0, 0.5, 4.0, 0.0, 0.0];
    let mut coarse = Marched::default();
    cpu::stratified(&near_far, 8, Some((Rng::new(1, 1), 0)), &mut coarse);
    let mut fine = Marched::default();
    let mut w = vec![0.0; 24];
    w[11] = 1.0;
    cpu::refine(&coarse, &w, 8, 16, Some((Rng::new(1, 2), 0)), &mut fine);
    for (m, n) in [(&coarse, 8), (&fine, 24)] {
        for r in 0..2 {
            let span = r * n..(r + 1) * n;
            let total: f32 = m.dt[span.clone()].iter().sum();
            let (near, far) = (near_far[r * 2], near_far[r * 2 + 1]);
            assert!((m.t[r * n] - near).abs() < 1e-6 && (total - (far - near)).abs() < 1e-4);
            assert!(m.dt[span].iter().all(|d| *d >= 0.0));
        }
    }
    // Most new samples of ray 1 fall into its fourth interval.
    let (a, b) = (coarse.t[11], coarse.t[11] + coarse.dt[11]);
    assert!(fine.t[24..48].iter().filter(|t| (a..=b).contains(*t)).count() >= 14);
}
