//! Groups of parameters with their gradients, moments, rate and schedule, in buffers of our own.

use diorama_kernels::ops::adam::{Adam, cpu as adam};
use std::ops::Range;

/// Parameters that share a rate. Sparse groups update touched lines only.
#[derive(Clone, Debug)]
pub struct ParamGroup {
    pub name: &'static str,
    pub values: Vec<f32>,
    pub grads: Vec<f32>,
    pub moment1: Vec<f32>,
    pub moment2: Vec<f32>,
    /// Marks of touched lines; empty for a dense group.
    pub touched: Vec<u8>,
    pub adam: Adam,
    /// A frozen group takes no step, and its gradient is not computed.
    pub frozen: bool,
    /// Ranges that are trained; none: all. The others keep their values, and their gradients are not computed.
    pub trained: Option<Vec<Range<usize>>>,
}

impl ParamGroup {
    pub fn dense(name: &'static str, values: Vec<f32>, adam: Adam) -> Self {
        let n = values.len();
        ParamGroup {
            name,
            values,
            grads: vec![0.0; n],
            moment1: vec![0.0; n],
            moment2: vec![0.0; n],
            touched: Vec::new(),
            adam,
            frozen: false,
            trained: None,
        }
    }

    /// # Panics
    /// When the length is not a multiple of a line.
    pub fn sparse(name: &'static str, values: Vec<f32>, adam: Adam) -> Self {
        assert!(values.len().is_multiple_of(adam::LINE), "{name}: {} is no multiple of {}", values.len(), adam::LINE);
        let touched = vec![0; values.len() / adam::LINE];
        ParamGroup { touched, ..ParamGroup::dense(name, values, adam) }
    }

    /// One optimiser step `t ≥ 1` with the rate scaled, after which gradients are zero.
    pub fn step(&mut self, t: u32, rate_scale: f32) {
        if self.frozen {
            self.grads.fill(0.0);
            self.touched.fill(0);
            return;
        }
        let a = Adam { rate: self.adam.rate * rate_scale, ..self.adam };
        if self.touched.is_empty() {
            let all = std::iter::once(0..self.values.len()).collect();
            for r in self.trained.as_ref().unwrap_or(&all) {
                let (values, grads) = (&mut self.values[r.clone()], &self.grads[r.clone()]);
                adam::dense(&a, t, values, &mut self.moment1[r.clone()], &mut self.moment2[r.clone()], grads);
            }
            self.grads.fill(0.0);
        } else {
            adam::sparse(&a, t, &mut self.values, &mut self.moment1, &mut self.moment2, &mut self.grads, &mut self.touched);
        }
    }

    /// Marks the lines of a sparse group that have a gradient.
    pub fn touch(&mut self) {
        let lines = self.grads.chunks_exact(adam::LINE);
        self.touched.iter_mut().zip(lines).for_each(|(t, line)| *t |= line.iter().any(|g| *g != 0.0) as u8);
    }

    /// A copy to look at, which cannot be trained.
    pub fn values_only(&self) -> ParamGroup {
        ParamGroup {
            name: self.name,
            values: self.values.clone(),
            grads: Vec::new(),
            moment1: Vec::new(),
            moment2: Vec::new(),
            touched: Vec::new(),
            adam: self.adam,
            frozen: true,
            trained: None,
        }
    }

    /// Whether any value is not finite.
    pub fn is_broken(&self) -> bool {
        self.values.iter().any(|v| !v.is_finite())
    }
}

/// How the rate falls over a run, as a function of progress in [0, 1].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Schedule {
    /// Share of the run over which the rate rises from a tenth.
    pub warmup: f32,
    /// Rate at the end over the rate at the start; the fall is exponential.
    pub final_scale: f32,
    /// Progress at which the fall begins.
    pub decay_from: f32,
}

impl Schedule {
    pub const CONSTANT: Schedule = Schedule { warmup: 0.0, final_scale: 1.0, decay_from: 0.0 };

    /// Scale of the rate at `progress`.
    pub fn scale(&self, progress: f32) -> f32 {
        let p = progress.clamp(0.0, 1.0);
        let rise = if p < self.warmup { 0.1 + 0.9 * p / self.warmup } else { 1.0 };
        let fall = ((p - self.decay_from) / (1.0 - self.decay_from).max(1e-6)).clamp(0.0, 1.0);
        rise * self.final_scale.powf(fall)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_frozen_group_stays_where_it_is() {
        let mut g = ParamGroup::dense("w", vec![1.0, 2.0], Adam::default());
        g.frozen = true;
        g.grads = vec![1.0, -1.0];
        g.step(1, 1.0);
        assert_eq!((g.values.clone(), g.grads.clone()), (vec![1.0, 2.0], vec![0.0, 0.0]));
        g.frozen = false;
        g.grads = vec![1.0, -1.0];
        g.step(1, 1.0);
        assert!(g.values[0] < 1.0 && g.values[1] > 2.0);
    }

    #[test]
    fn only_trained_ranges_move() {
        let mut g = ParamGroup::dense("w", vec![1.0; 5], Adam { weight_decay: 0.1, ..Adam::default() });
        g.trained = Some(vec![0..1, 3..5]);
        g.grads = vec![1.0; 5];
        g.step(1, 1.0);
        assert!(g.values[1..3] == [1.0; 2] && [0, 3, 4].iter().all(|i| g.values[*i] < 1.0), "{:?}", g.values);
    }

    #[test]
    fn the_schedule_rises_then_falls_to_its_end() {
        let s = Schedule { warmup: 0.1, final_scale: 0.03, decay_from: 0.5 };
        assert!((s.scale(0.0) - 0.1).abs() < 1e-6 && (s.scale(0.3) - 1.0).abs() < 1e-6);
        assert!((s.scale(1.0) - 0.03).abs() < 1e-6 && s.scale(0.75) < 1.0);
        assert_eq!(Schedule::CONSTANT.scale(0.7), 1.0);
    }
}
