use super::cases::{Case, FILTERS};
use super::*;
use crate::simd::{Level, with_level};
use diorama_testkit::{assert_close, assert_gradient, random, wide};

fn check(c: &Case) {
    let (mut out, mut dx) = (vec![9.0; c.d.len()], vec![9.0; c.x.len()]);
    cpu::forward(&c.resample, c.planes, &c.x, &mut out);
    cpu::backward(&c.resample, c.planes, &c.d, &mut dx);
    assert_close(&format!("forward, {}", c.name), &out, &reference::forward(&c.resample, c.planes, &wide(&c.x)), 1e-5);
    assert_close(&format!("backward, {}", c.name), &dx, &reference::backward(&c.resample, c.planes, &wide(&c.d)), 1e-5);
}

#[test]
fn filters_match_the_reference_both_ways_at_every_level() {
    for level in Level::available() {
        cases::cases().iter().for_each(|c| with_level(level, || check(c)));
    }
}

#[test]
fn blurs_match_the_reference_both_ways_at_every_level() {
    let taps = [0.125, 0.375, 0.25, 0.5];
    for level in Level::available() {
        for (up, down, padding) in [(1, 1, [1, 2]), (1, 2, [1, 1]), (2, 1, [2, 1]), (3, 2, [0, 5])] {
            for from in [[4, 4], [9, 21], [1, 30]] {
                if from[0] * up + padding[0] + padding[1] >= 4 {
                    let blur = Resample::fir(&Fir { taps: &taps, up, down, padding }, from);
                    with_level(level, || check(&Case::new("blur".into(), blur, 2)));
                }
            }
        }
    }
}

#[test]
fn reference_gradients_match_central_differences() {
    for filter in FILTERS {
        for (from, to) in [([3, 4], [5, 2]), ([2, 5], [1, 7])] {
            let r = Resample::new(filter, from, to);
            let (x, d) = (wide(&random(from[0] * from[1], 1)), wide(&random(to[0] * to[1], 2)));
            let g = reference::backward(&r, 1, &d);
            assert_gradient("x", &g, &x, 1e-6, |x| reference::forward(&r, 1, x).iter().zip(&d).map(|(a, b)| a * b).sum());
        }
    }
}

#[test]
fn constants_stay_and_blurs_keep_their_gain() {
    for filter in FILTERS {
        let out = reference::forward(&Resample::new(filter, [7, 9], [4, 20]), 1, &[2.0; 63]);
        assert_close("constant", &vec![2.0; 80], &out, 1e-6);
    }
    let up = Fir { taps: &[0.25, 0.75, 0.75, 0.25], up: 2, down: 1, padding: [2, 1] };
    let out = reference::forward(&Resample::fir(&up, [6, 6]), 1, &[2.0; 36]);
    assert_eq!(out.len(), 144);
    assert!((out[5 * 12 + 6] - 2.0).abs() < 1e-6, "{}", out[66]);
}

#[test]
fn a_response_is_turned_round_and_placed_as_the_padding_says() {
    let fir = Fir { taps: &[1.0, 2.0, 3.0], up: 1, down: 1, padding: [2, 0] };
    let table = Weights::fir(&fir, 4);
    // Output o is x[o] · 1 + x[o − 1] · 2 + x[o − 2] · 3.
    let rows: Vec<Vec<f32>> = (0..4).map(|o| (0..4).map(|i| table.at(o, i)).collect()).collect();
    assert_eq!(rows, [[1.0, 0.0, 0.0, 0.0], [2.0, 1.0, 0.0, 0.0], [3.0, 2.0, 1.0, 0.0], [0.0, 3.0, 2.0, 1.0]]);
}

#[test]
fn pixel_shuffle_matches_the_reference_and_is_undone() {
    for level in Level::available() {
        for (n, c, size, r) in
            [(0, 1, [2, 2], 2), (1, 1, [1, 1], 1), (2, 3, [4, 5], 2), (1, 2, [3, 19], 3), (2, 1, [5, 40], 4), (1, 1, [2, 3], 5)]
        {
            let x = random(n * c * r * r * size[0] * size[1], 1);
            let (mut out, mut back) = (vec![9.0; x.len()], vec![9.0; x.len()]);
            with_level(level, || {
                shuffle::shuffle(n * c, size, r, &x, &mut out);
                shuffle::unshuffle(n * c, size, r, &out, &mut back);
            });
            assert_close("shuffle", &out, &reference::pixel_shuffle(n, c, size, r, &wide(&x)), 0.0);
            assert_eq!(back, x);
        }
    }
}
