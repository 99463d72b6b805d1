//! How the learning rate changes over a run.

/// A rate's scale as a function of the step, after a linear warm-up.
#[derive(Clone, Debug, PartialEq)]
pub struct Schedule {
    /// Steps over which the rate rises linearly from `1 / warmup` of itself.
    pub warmup: u64,
    pub shape: Shape,
}

/// The course after the warm-up.
#[derive(Clone, Debug, PartialEq)]
pub enum Shape {
    Constant,
    /// Half a cosine from 1 to `end` over `steps` steps, warm-up included; constant thereafter.
    Cosine {
        steps: u64,
        end: f32,
    },
    /// Multiplied by `factor` at each of the steps of `at`, in rising order.
    Step {
        at: Vec<u64>,
        factor: f32,
    },
}

impl Schedule {
    pub const CONSTANT: Schedule = Schedule { warmup: 0, shape: Shape::Constant };

    pub fn cosine(warmup: u64, steps: u64) -> Schedule {
        Schedule { warmup, shape: Shape::Cosine { steps, end: 0.0 } }
    }

    /// Scale of the rate at `step`, counted from 0.
    pub fn scale(&self, step: u64) -> f32 {
        if step < self.warmup {
            return (step + 1) as f32 / self.warmup as f32;
        }
        match &self.shape {
            Shape::Constant => 1.0,
            Shape::Cosine { steps, end } => {
                let length = steps.saturating_sub(self.warmup).max(1);
                let progress = ((step - self.warmup) as f64 / length as f64).min(1.0);
                let fall = 0.5 * (1.0 + (std::f64::consts::PI * progress).cos());
                end + (1.0 - end) * fall as f32
            }
            Shape::Step { at, factor } => factor.powi(at.iter().filter(|s| **s <= step).count() as i32),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_rate_rises_and_falls_as_told() {
        let s = Schedule::cosine(4, 104);
        assert_eq!([s.scale(0), s.scale(1), s.scale(3), s.scale(4)], [0.25, 0.5, 1.0, 1.0]);
        assert!((s.scale(54) - 0.5).abs() < 1e-6);
        assert_eq!([s.scale(104), s.scale(1000)], [0.0, 0.0]);
        let s = Schedule { warmup: 0, shape: Shape::Step { at: vec![10, 20], factor: 0.5 } };
        assert_eq!([s.scale(9), s.scale(10), s.scale(19), s.scale(20)], [1.0, 0.5, 0.5, 0.25]);
        assert_eq!(Schedule::CONSTANT.scale(7), 1.0);
    }
}
