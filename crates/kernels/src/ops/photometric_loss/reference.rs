//! The loss of a difference in f64, and its slope.

use super::ColorLoss;

pub fn forward(loss: ColorLoss, d: f64) -> f64 {
    match loss {
        ColorLoss::Mse => d * d,
        ColorLoss::Huber(delta) => {
            let delta = delta as f64;
            if d.abs() <= delta { d * d / (2.0 * delta) } else { d.abs() - 0.5 * delta }
        }
    }
}

pub fn backward(loss: ColorLoss, d: f64) -> f64 {
    match loss {
        ColorLoss::Mse => 2.0 * d,
        ColorLoss::Huber(delta) => (d / delta as f64).clamp(-1.0, 1.0),
    }
}
