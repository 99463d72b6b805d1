use super::*;
use crate::simd::{Level, with_level};
use diorama_testkit::{assert_close, assert_gradient, random, random_unit, wide};

#[test]
fn matches_the_reference_both_ways_at_every_level() {
    for level in Level::available() {
        for (rows, d, n) in [(3, 4, 0), (1, 1, 1), (5, 0, 3), (7, 3, 40), (100, 33, 900), (1000, 64, 300)] {
            let indices: Vec<i64> = random_unit(n, 5).iter().map(|u| (u * rows as f32) as i64).collect();
            let (table, g) = (random(rows * d, 1), random(n * d, 2));
            let (mut out, mut d_table) = (vec![9.0; n * d], vec![9.0; rows * d]);
            with_level(level, || {
                cpu::forward(rows, d, &table, &indices, &mut out);
                cpu::backward(rows, d, &indices, &g, &mut d_table);
            });
            assert_close("forward", &out, &reference::forward(d, &wide(&table), &indices), 0.0);
            assert_close("backward", &d_table, &reference::backward(rows, d, &indices, &wide(&g)), 1e-5);
        }
    }
}

#[test]
fn reference_gradient_matches_central_differences() {
    let indices = [2, 0, 2, 1];
    let (table, g) = (wide(&random(12, 1)), wide(&random(12, 2)));
    let gradient = reference::backward(4, 3, &indices, &g);
    assert_gradient("table", &gradient, &table, 1e-6, |t| reference::forward(3, t, &indices).iter().zip(&g).map(|(a, b)| a * b).sum());
}

#[test]
#[should_panic(expected = "row -1 of 4")]
fn an_index_outside_is_refused() {
    cpu::forward(4, 2, &[0.0; 8], &[-1], &mut [0.0; 2]);
}
