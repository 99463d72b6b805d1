use super::*;
use crate::simd::{Level, with_level};
use diorama_testkit::{assert_close, assert_gradient, random, wide};

#[test]
fn matches_the_reference_at_every_level() {
    for level in Level::available() {
        for n in [0, 1, 33, 40_001] {
            for p in [0.0, 0.1, 0.75] {
                let dropout = Dropout { rng: Rng::new(3, 4), first: u64::MAX - 5, p };
                let (x, mut out) = (random(n, 1), vec![9.0; n]);
                with_level(level, || cpu::apply(&dropout, &x, &mut out));
                assert_close("dropout", &out, &reference::apply(&dropout, &wide(&x)), 1e-6);
            }
        }
    }
}

#[test]
fn the_reference_is_its_own_derivative() {
    let dropout = Dropout { rng: Rng::new(3, 4), first: 7, p: 0.4 };
    let (x, d) = (wide(&random(40, 1)), wide(&random(40, 2)));
    let loss = |x: &[f64]| reference::apply(&dropout, x).iter().zip(&d).map(|(y, d)| y * d).sum();
    assert_gradient("x", &reference::apply(&dropout, &d), &x, 1e-6, loss);
}

#[test]
fn the_mean_stays_and_the_share_of_zeros_is_p() {
    let n = 200_000;
    let dropout = Dropout { rng: Rng::new(1, 2), first: 0, p: 0.3 };
    let out = reference::apply(&dropout, &vec![1.0; n]);
    let zeros = out.iter().filter(|v| **v == 0.0).count() as f64 / n as f64;
    let mean = out.iter().sum::<f64>() / n as f64;
    // Three standard deviations are 0.0031 and 0.0044.
    assert!((zeros - 0.3).abs() < 0.0031 && (mean - 1.0).abs() < 0.0044, "{zeros} {mean}");
}

#[test]
fn counters_continue_where_the_last_call_ended() {
    let rng = Rng::new(5, 6);
    let x = vec![1.0; 100];
    let whole = reference::apply(&Dropout { rng, first: 0, p: 0.5 }, &x);
    let tail = reference::apply(&Dropout { rng, first: 60, p: 0.5 }, &x[60..]);
    assert_eq!(whole[60..], tail);
    assert_ne!(whole[..40], tail, "counters must matter");
}
