//! Sums and their gradients against the reference.

use super::*;
use diorama_testkit::{assert_close, assert_gradient, random, wide};

#[test]
fn sums_and_gradients_equal_the_reference() {
    for (n, relu) in [(0, true), (1, false), (1, true), (20_011, false), (20_011, true)] {
        let (a, b, d) = (random(n, 1), random(n, 2), random(n, 3));
        let mut out = vec![f32::NAN; n];
        cpu::forward(&a, &b, relu, &mut out);
        assert_close("sum", &out, &reference::forward(&wide(&a), &wide(&b), relu), 1e-6);
        if relu {
            let mut g = vec![f32::NAN; n];
            cpu::backward_relu(&out, &d, &mut g);
            assert_close("gradient", &g, &reference::backward(&wide(&a), &wide(&b), true, &wide(&d)), 1e-6);
        }
    }
}

#[test]
fn the_reference_is_the_derivative() {
    let (a, b, d) = (wide(&random(9, 1)), wide(&random(9, 2)), wide(&random(9, 3)));
    for relu in [false, true] {
        let g = reference::backward(&a, &b, relu, &d);
        assert_gradient("a", &g, &a, 1e-6, |a| reference::forward(a, &b, relu).iter().zip(&d).map(|(y, d)| y * d).sum());
    }
}
