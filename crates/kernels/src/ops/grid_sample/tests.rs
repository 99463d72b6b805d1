use super::cases::{grid, modes};
use super::*;
use crate::simd::{Level, with_level};
use diorama_testkit::{assert_close, assert_gradient, random, wide};

#[test]
fn matches_the_reference_both_ways_at_every_level() {
    for level in Level::available() {
        for cases::Case { sample: s, x, grid, d } in cases::cases() {
            let (mut out, mut dx, mut d_grid) = (vec![9.0; d.len()], vec![9.0; x.len()], vec![9.0; grid.len()]);
            with_level(level, || {
                cpu::forward(&s, &x, &grid, &mut out);
                cpu::backward_input(&s, &grid, &d, &mut dx);
                cpu::backward_grid(&s, &x, &grid, &d, &mut d_grid);
            });
            assert_close("forward", &out, &reference::forward(&s, &wide(&x), &wide(&grid)), 1e-4);
            let (want_x, want_grid) = reference::backward(&s, &wide(&x), &wide(&grid), &wide(&d));
            assert_close("dx", &dx, &want_x, 1e-4);
            assert_close("d_grid", &d_grid, &want_grid, 1e-4);
        }
    }
}

#[test]
fn reference_gradients_match_central_differences() {
    for s in modes() {
        let s = GridSample { images: 2, channels: 2, from: [4, 5], points: 6, ..s };
        let (x, g, d) = (wide(&random(80, 1)), wide(&grid(12, 2)), wide(&random(24, 3)));
        let (dx, d_grid) = reference::backward(&s, &x, &g, &d);
        let loss = |x: &[f64], g: &[f64]| reference::forward(&s, x, g).iter().zip(&d).map(|(a, b)| a * b).sum::<f64>();
        assert_gradient("x", &dx, &x, 1e-6, |x| loss(x, &g));
        assert_gradient("grid", &d_grid, &g, 1e-5, |g| loss(&x, g));
    }
}

#[test]
fn coordinates_that_are_no_numbers_or_far_away_read_nothing_outside() {
    for s in modes() {
        let s = GridSample { images: 1, channels: 1, from: [3, 3], points: 4, ..s };
        let grid = [f32::NAN, 0.0, 1e30, -1e30, f32::INFINITY, f32::NEG_INFINITY, 0.0, f32::NAN];
        let (mut out, mut dx, mut d_grid) = ([0.0; 4], [0.0; 9], [0.0; 8]);
        cpu::forward(&s, &[1.0; 9], &grid, &mut out);
        cpu::backward_input(&s, &grid, &[1.0; 4], &mut dx);
        cpu::backward_grid(&s, &[1.0; 9], &grid, &[1.0; 4], &mut d_grid);
        let wanted = if s.outside == Outside::Border { 1.0 } else { 0.0 };
        assert_eq!(out[1], wanted, "{s:?}");
    }
}
