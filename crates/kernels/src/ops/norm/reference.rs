//! Element by element in f64, for any assignment of elements to sets of statistics and to parameters.

use super::super::activation::{Activation, reference as activation};
use super::{LayerNorm, Norm, Over};

/// Which statistics and which parameter each element has.
pub struct Layout {
    pub sets: usize,
    pub parameters: usize,
    pub set: Vec<usize>,
    pub parameter: Vec<usize>,
    /// Whether statistics are given rather than taken of x.
    pub given: bool,
    pub epsilon: f64,
    pub activation: Activation,
}

impl Layout {
    pub fn of(norm: &Norm) -> Layout {
        let channel = |i: usize| i / norm.places % norm.channels;
        let set = |i: usize| match norm.over {
            Over::Batch | Over::Given => channel(i),
            Over::Groups(groups) => i / norm.places / norm.channels * groups + channel(i) / (norm.channels / groups),
        };
        let n = norm.elements();
        Layout {
            sets: norm.sets(),
            parameters: norm.channels,
            set: (0..n).map(set).collect(),
            parameter: (0..n).map(channel).collect(),
            given: norm.over == Over::Given,
            epsilon: norm.epsilon as f64,
            activation: norm.activation,
        }
    }

    pub fn of_layer(norm: &LayerNorm, rows: usize) -> Layout {
        let n = rows * norm.width;
        Layout {
            sets: rows,
            parameters: norm.width,
            set: (0..n).map(|i| i / norm.width).collect(),
            parameter: (0..n).map(|i| i % norm.width).collect(),
            given: false,
            epsilon: norm.epsilon as f64,
            activation: norm.activation,
        }
    }

    /// Mean and biased variance of each set.
    pub fn statistics(&self, x: &[f64]) -> (Vec<f64>, Vec<f64>) {
        let (mut count, mut mean, mut variance) = (vec![0.0; self.sets], vec![0.0; self.sets], vec![0.0; self.sets]);
        for (x, s) in x.iter().zip(&self.set) {
            count[*s] += 1.0;
            mean[*s] += x;
        }
        mean.iter_mut().zip(&count).for_each(|(m, n)| *m /= n);
        for (x, s) in x.iter().zip(&self.set) {
            variance[*s] += (x - mean[*s]).powi(2) / count[*s];
        }
        (mean, variance)
    }

    fn normalized(&self, x: &[f64], (mean, variance): (&[f64], &[f64])) -> Vec<f64> {
        x.iter().zip(&self.set).map(|(x, s)| (x - mean[*s]) / (variance[*s] + self.epsilon).sqrt()).collect()
    }

    /// Output for statistics that [`Layout::statistics`] or the caller gives.
    pub fn forward(&self, x: &[f64], statistics: (&[f64], &[f64]), scale: &[f64], shift: &[f64]) -> Vec<f64> {
        let normalized = self.normalized(x, statistics);
        normalized.iter().zip(&self.parameter).map(|(v, c)| activation::value(self.activation, scale[*c] * v + shift[*c])).collect()
    }

    /// Gradients of x, scale and shift.
    pub fn backward(
        &self,
        x: &[f64],
        statistics: (&[f64], &[f64]),
        scale: &[f64],
        shift: &[f64],
        d: &[f64],
    ) -> (Vec<f64>, Vec<f64>, Vec<f64>) {
        let normalized = self.normalized(x, statistics);
        let (mut d_scale, mut d_shift) = (vec![0.0; self.parameters], vec![0.0; self.parameters]);
        let (mut count, mut sum, mut along) = (vec![0.0; self.sets], vec![0.0; self.sets], vec![0.0; self.sets]);
        let mut g = vec![0.0; x.len()];
        for i in 0..x.len() {
            let (s, c) = (self.set[i], self.parameter[i]);
            let before = d[i] * activation::slope(self.activation, scale[c] * normalized[i] + shift[c]);
            d_scale[c] += before * normalized[i];
            d_shift[c] += before;
            g[i] = before * scale[c];
            count[s] += 1.0;
            sum[s] += g[i];
            along[s] += g[i] * normalized[i];
        }
        let own = |i: usize| {
            let s = self.set[i];
            let through = if self.given { 0.0 } else { (sum[s] + normalized[i] * along[s]) / count[s] };
            (g[i] - through) / (statistics.1[s] + self.epsilon).sqrt()
        };
        ((0..x.len()).map(own).collect(), d_scale, d_shift)
    }
}
