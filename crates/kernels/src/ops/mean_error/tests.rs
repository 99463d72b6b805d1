//! Means and gradients against the reference, and the reference against central differences.

use super::*;
use diorama_testkit::{assert_close, assert_gradient, random, wide};

const KINDS: [Error; 3] = [Error::Squared, Error::Absolute, Error::Huber(0.3)];

#[test]
fn means_and_gradients_equal_the_reference() {
    for (kind, n) in KINDS.into_iter().flat_map(|k| [(k, 0), (k, 1), (k, 35), (k, 30_001)]) {
        let (x, y) = (random(n, 1), random(n, 2));
        assert_close("mean", &[cpu::forward(kind, &x, &y)], &[reference::forward(kind, &wide(&x), &wide(&y))], 1e-5);
        let mut g = vec![f32::NAN; n];
        cpu::backward(kind, &x, &y, 0.7, &mut g);
        assert_close("gradient", &g, &reference::backward(kind, &wide(&x), &wide(&y), 0.7), 1e-5);
    }
}

#[test]
fn the_reference_is_the_derivative() {
    let (x, y) = (wide(&random(12, 1)), wide(&random(12, 2)));
    for kind in KINDS {
        assert_gradient("x", &reference::backward(kind, &x, &y, 1.0), &x, 1e-6, |x| reference::forward(kind, x, &y));
    }
}
