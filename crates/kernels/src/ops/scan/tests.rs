use super::*;
use diorama_testkit::{assert_close, assert_gradient, random, wide};

#[test]
fn matches_the_reference_both_ways() {
    for cases::Case { counts, offsets: want, x } in cases::cases() {
        let mut offsets = vec![];
        cpu::exclusive(&counts, &mut offsets);
        assert_eq!(offsets, want);
        if counts.len() < 1000 {
            assert_eq!(offsets, reference::exclusive(&counts));
        }
        let mut out = vec![9.0; x.len()];
        cpu::inclusive(&offsets, &x, &mut out);
        assert_close("inclusive", &out, &reference::inclusive(&offsets, &wide(&x)), 1e-5);
        cpu::inclusive_backward(&offsets, &x, &mut out);
        assert_close("backward", &out, &reference::inclusive_backward(&offsets, &wide(&x)), 1e-5);
    }
}

#[test]
fn reference_gradient_matches_central_differences() {
    let (offsets, x, d) = ([0, 3, 3, 8], wide(&random(8, 1)), wide(&random(8, 2)));
    let g = reference::inclusive_backward(&offsets, &d);
    assert_gradient("x", &g, &x, 1e-6, |x| reference::inclusive(&offsets, x).iter().zip(&d).map(|(a, b)| a * b).sum());
}
