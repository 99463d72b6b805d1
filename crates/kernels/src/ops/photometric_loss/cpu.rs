//! One difference at a time, for losses that go ray by ray.

use super::ColorLoss;

/// Value and slope of a difference.
#[inline(always)]
pub fn color_error(loss: ColorLoss, d: f32) -> (f32, f32) {
    match loss {
        ColorLoss::Mse => (d * d, 2.0 * d),
        ColorLoss::Huber(delta) if d.abs() <= delta => (d * d / (2.0 * delta), d / delta),
        ColorLoss::Huber(delta) => (d.abs() - 0.5 * delta, d.signum()),
    }
}
