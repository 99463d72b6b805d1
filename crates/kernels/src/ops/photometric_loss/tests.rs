use super::*;
use diorama_testkit::{assert_close, assert_gradient};

const LOSSES: [ColorLoss; 3] = [ColorLoss::Mse, ColorLoss::Huber(0.1), ColorLoss::Huber(2.0)];
const DIFFERENCES: [f32; 6] = [-0.7, -0.05, 0.0, 0.03, 0.4, 3.0];

#[test]
fn matches_the_reference_both_ways() {
    for loss in LOSSES {
        let (values, slopes): (Vec<f32>, Vec<f32>) = DIFFERENCES.iter().map(|d| cpu::color_error(loss, *d)).unzip();
        assert_close("value", &values, &DIFFERENCES.map(|d| reference::forward(loss, d as f64)), 1e-6);
        assert_close("slope", &slopes, &DIFFERENCES.map(|d| reference::backward(loss, d as f64)), 1e-6);
    }
}

#[test]
fn reference_slopes_match_central_differences() {
    for loss in LOSSES {
        let d = DIFFERENCES.map(f64::from);
        let slopes = d.map(|d| reference::backward(loss, d));
        assert_gradient("d", &slopes, &d, 1e-6, |d| d.iter().map(|d| reference::forward(loss, *d)).sum());
    }
}
