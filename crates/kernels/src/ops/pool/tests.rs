use super::super::resample;
use super::cases::pools;
use super::*;
use crate::simd::{Level, with_level};
use diorama_testkit::{assert_close, assert_gradient, random, wide};

#[test]
fn max_matches_the_reference_both_ways_at_every_level() {
    for level in Level::available() {
        for (pool, from) in pools() {
            for planes in [0, 1, 3] {
                let [oh, ow] = pool.output(from);
                let (size, places) = (from[0] * from[1], oh * ow);
                let (x, d) = (random(planes * size, 1), random(planes * places, 2));
                let (mut out, mut indices, mut dx) = (vec![9.0; d.len()], vec![9; d.len()], vec![9.0; x.len()]);
                with_level(level, || {
                    cpu::max(&pool, planes, from, &x, &mut out, &mut indices);
                    cpu::max_backward(planes, size, &indices, &d, &mut dx);
                });
                let (want, at) = reference::max(&pool, planes, from, &wide(&x));
                assert_close("forward", &out, &want, 0.0);
                assert_eq!(indices, at, "{pool:?} {from:?}");
                assert_close("backward", &dx, &reference::max_backward(&pool, planes, from, &wide(&x), &wide(&d)), 1e-6);
            }
        }
    }
}

#[test]
fn averages_match_the_reference_both_ways_at_every_level() {
    for level in Level::available() {
        for (pool, from) in pools() {
            for count_padding in [false, true] {
                let (planes, table) = (2, pool.average(from, count_padding));
                let [oh, ow] = table.to();
                let (x, d) = (random(planes * from[0] * from[1], 1), random(planes * oh * ow, 2));
                let (mut out, mut dx) = (vec![9.0; d.len()], vec![9.0; x.len()]);
                with_level(level, || {
                    resample::cpu::forward(&table, planes, &x, &mut out);
                    resample::cpu::backward(&table, planes, &d, &mut dx);
                });
                assert_close("forward", &out, &reference::average(&pool, count_padding, planes, from, &wide(&x)), 1e-5);
                assert_close("backward", &dx, &reference::average_backward(&pool, count_padding, planes, from, &wide(&d)), 1e-5);
            }
        }
    }
}

#[test]
fn means_of_planes_match_the_reference_both_ways_at_every_level() {
    for level in Level::available() {
        for (planes, places) in [(0, 4), (1, 1), (3, 49), (5, 5000)] {
            let (x, d) = (random(planes * places, 1), random(planes, 2));
            let (mut out, mut dx) = (vec![9.0; planes], vec![9.0; x.len()]);
            with_level(level, || {
                cpu::global_average(places, &x, &mut out);
                cpu::global_average_backward(places, &d, &mut dx);
            });
            assert_close("forward", &out, &reference::global_average(places, &wide(&x)), 1e-5);
            let want: Vec<f64> = (0..x.len()).map(|i| d[i / places] as f64 / places as f64).collect();
            assert_close("backward", &dx, &want, 1e-6);
        }
    }
}

#[test]
fn reference_gradients_match_central_differences() {
    let (pool, from) = (Pool { kernel: [3, 2], stride: [2, 1], padding: [1, 1], ceil_mode: true }, [4, 3]);
    let [oh, ow] = pool.output(from);
    let (x, d) = (wide(&random(24, 1)), wide(&random(2 * oh * ow, 2)));
    let dot = |y: Vec<f64>| y.iter().zip(&d).map(|(a, b)| a * b).sum::<f64>();
    let g = reference::max_backward(&pool, 2, from, &x, &d);
    assert_gradient("max", &g, &x, 1e-6, |x| dot(reference::max(&pool, 2, from, x).0));
    for count_padding in [false, true] {
        let g = reference::average_backward(&pool, count_padding, 2, from, &d);
        assert_gradient("average", &g, &x, 1e-6, |x| dot(reference::average(&pool, count_padding, 2, from, x)));
    }
}

#[test]
fn nan_wins_and_windows_of_nothing_but_minus_infinity_have_an_index() {
    let pool = Pool { kernel: [1, 2], stride: [1, 2], padding: [0, 0], ceil_mode: false };
    let (mut out, mut indices) = ([0.0; 2], [9; 2]);
    cpu::max(&pool, 1, [1, 4], &[f32::NAN, 1.0, f32::NEG_INFINITY, f32::NEG_INFINITY], &mut out, &mut indices);
    assert!(out[0].is_nan() && out[1] == f32::NEG_INFINITY);
    assert_eq!(indices, [0, 2]);
}
