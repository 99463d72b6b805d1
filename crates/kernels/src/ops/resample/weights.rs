//! Tables of weights along an axis.

use super::{Filter, Fir};

/// A sparse matrix `[outputs, inputs]`: output `o` is `Σ_t weights[t, o] · input[first[o] + t]`.
#[derive(Clone, Debug)]
pub struct Weights {
    inputs: usize,
    pub(super) taps: usize,
    pub(super) first: Vec<u32>,
    /// `[taps, outputs]`
    pub(super) weights: Vec<f32>,
}

impl Weights {
    pub fn inputs(&self) -> usize {
        self.inputs
    }

    pub fn outputs(&self) -> usize {
        self.first.len()
    }

    /// Table of rows of the matrix, each (first input, weights from there on).
    fn from_rows(inputs: usize, rows: &[(usize, Vec<f64>)]) -> Weights {
        let taps = rows.iter().map(|r| r.1.len()).max().unwrap_or(0);
        let mut out = Weights { inputs, taps, first: Vec::with_capacity(rows.len()), weights: vec![0.0; taps * rows.len()] };
        for (o, (first, weights)) in rows.iter().enumerate() {
            // Every row reads as many inputs: a short one at the end begins earlier.
            let moved = (*first).min(inputs - taps);
            out.first.push(moved as u32);
            for (t, w) in weights.iter().enumerate() {
                out.weights[(first - moved + t) * rows.len() + o] = *w as f32;
            }
        }
        out
    }

    /// Weight of input `i` in output `o`.
    pub fn at(&self, o: usize, i: usize) -> f32 {
        let t = i.wrapping_sub(self.first[o] as usize);
        if t < self.taps { self.weights[t * self.outputs() + o] } else { 0.0 }
    }

    /// The matrix's transpose.
    pub fn transposed(&self) -> Weights {
        let mut rows: Vec<(usize, Vec<f64>)> = vec![(0, Vec::new()); self.inputs];
        for o in 0..self.outputs() {
            for t in 0..self.taps {
                let w = self.weights[t * self.outputs() + o];
                if w == 0.0 {
                    continue;
                }
                let (first, row) = &mut rows[self.first[o] as usize + t];
                if row.is_empty() {
                    *first = o;
                }
                row.resize(o - *first, 0.0);
                row.push(w as f64);
            }
        }
        Weights::from_rows(self.outputs(), &rows)
    }

    /// Table of a filter from `inputs` to `outputs` pixels.
    ///
    /// # Panics
    /// When there are outputs, but no inputs.
    pub fn filter(filter: Filter, inputs: usize, outputs: usize) -> Weights {
        assert!(inputs > 0 || outputs == 0, "resample: nothing to make {outputs} pixels of");
        let rows: Vec<_> = (0..outputs).map(|o| row(filter, inputs, outputs, o)).collect();
        Weights::from_rows(inputs, &rows)
    }

    /// Table of means over windows `(kernel, stride, padding)`; padding counts as zeros, or does not count.
    pub(crate) fn windows((kernel, stride, padding): (usize, usize, usize), count_padding: bool, inputs: usize, outputs: usize) -> Weights {
        let row = |o: usize| {
            let (from, to) = (o * stride, (o * stride + kernel).min(inputs + 2 * padding));
            let (first, last) = (from.max(padding) - padding, to.clamp(padding, inputs + padding) - padding);
            let count = if count_padding { to - from } else { last - first };
            (first, vec![1.0 / count as f64; last - first])
        };
        Weights::from_rows(inputs, &(0..outputs).map(row).collect::<Vec<_>>())
    }

    /// Table of a finite impulse response.
    ///
    /// # Panics
    /// When the padded signal is shorter than the filter.
    pub fn fir(fir: &Fir, inputs: usize) -> Weights {
        let length = inputs * fir.up + fir.padding[0] + fir.padding[1];
        assert!(length >= fir.taps.len() && fir.up > 0 && fir.down > 0, "resample: {} taps on {length} values", fir.taps.len());
        let mut rows = Vec::new();
        for o in 0..(length - fir.taps.len()) / fir.down + 1 {
            let mut row: (usize, Vec<f64>) = (0, Vec::new());
            // A convolution: the filter is reversed.
            for (k, w) in fir.taps.iter().rev().enumerate() {
                let Some(at) = (o * fir.down + k).checked_sub(fir.padding[0]) else { continue };
                if at % fir.up == 0 && at / fir.up < inputs {
                    if row.1.is_empty() {
                        row.0 = at / fir.up;
                    }
                    row.1.push(*w as f64);
                }
            }
            rows.push(row);
        }
        Weights::from_rows(inputs, &rows)
    }
}

/// Row `o` of a filter's matrix.
fn row(filter: Filter, inputs: usize, outputs: usize, o: usize) -> (usize, Vec<f64>) {
    let scale = inputs as f64 / outputs as f64;
    match filter {
        // In f32 as PyTorch does it, since rounding decides which pixel it is.
        Filter::Nearest => (((o as f32 * (inputs as f32 / outputs as f32)) as usize).min(inputs - 1), vec![1.0]),
        Filter::Bilinear { align_corners } => {
            let at = match align_corners {
                true if outputs > 1 => o as f64 * (inputs - 1) as f64 / (outputs - 1) as f64,
                true => 0.0,
                false => ((o as f64 + 0.5) * scale - 0.5).max(0.0),
            };
            let first = (at as usize).min(inputs - 1);
            let share = at - first as f64;
            if first + 1 < inputs { (first, vec![1.0 - share, share]) } else { (first, vec![1.0]) }
        }
        Filter::Area => {
            let (from, to) = (o * inputs / outputs, ((o + 1) * inputs).div_ceil(outputs));
            (from, vec![1.0 / (to - from) as f64; to - from])
        }
        Filter::BilinearAntialiased => windowed(inputs, scale, o, 1.0, |x| (1.0 - x).max(0.0)),
        Filter::BicubicAntialiased => windowed(inputs, scale, o, 2.0, |x| {
            const A: f64 = -0.5;
            match x {
                x if x < 1.0 => ((A + 2.0) * x - (A + 3.0)) * x * x + 1.0,
                x if x < 2.0 => (((x - 5.0) * x + 8.0) * x - 4.0) * A,
                _ => 0.0,
            }
        }),
    }
}

/// A kernel of `|x|`, zero beyond `radius`, stretched where the image becomes smaller, with weights that sum to 1.
fn windowed(inputs: usize, scale: f64, o: usize, radius: f64, kernel: impl Fn(f64) -> f64) -> (usize, Vec<f64>) {
    let stretch = scale.max(1.0);
    let center = (o as f64 + 0.5) * scale;
    let first = (center - radius * stretch + 0.5).max(0.0) as usize;
    let last = ((center + radius * stretch + 0.5) as usize).min(inputs);
    let raw: Vec<f64> = (first..last).map(|i| kernel((i as f64 + 0.5 - center).abs() / stretch)).collect();
    let sum: f64 = raw.iter().sum();
    (first, raw.iter().map(|w| w / sum).collect())
}
