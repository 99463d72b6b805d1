//! Outputs whose channels are shares, by a softmax over them.

use super::FieldNet;
use crate::ops::fused_mlp::Head;
use crate::ops::fused_mlp::cpu::Activations;

/// Some columns of a matrix: values, row length, first column, columns.
pub type Columns<T> = (T, usize, usize, usize);

/// Logits to shares whose sum is 1, in place.
pub fn softmax(row: &mut [f32]) {
    let most = row.iter().fold(f32::MIN, |m, v| m.max(*v));
    row.iter_mut().for_each(|v| *v = (*v - most).exp());
    let sum: f32 = row.iter().sum();
    row.iter_mut().for_each(|v| *v /= sum);
}

/// Adds the gradient of shares to that of their logits' layer.
pub fn write(net: &FieldNet, head: Head, acts: &mut Activations, out: &[f32], (d, stride, first, channels): Columns<&[f32]>) {
    let width = net.mlp.layers[head.layer].width;
    let g = acts.seed(head.layer);
    for ((g, y), d) in g.chunks_exact_mut(width).zip(out.chunks_exact(stride)).zip(d.chunks_exact(stride)) {
        let (y, d) = (&y[first..first + channels], &d[first..first + channels]);
        let mean: f32 = y.iter().zip(d).map(|(y, d)| y * d).sum();
        for ((g, y), d) in g[head.channel..].iter_mut().zip(y).zip(d) {
            *g += y * (d - mean);
        }
    }
}

/// The same on a device: one unit per row.
#[cfg(feature = "gpu")]
pub mod gpu {
    use crate::gpu::{Buffer, Gpu, Rows, launch};
    use cubecl::prelude::*;

    /// Logits `[S, channels]` to shares, in place.
    pub fn forward(gpu: &Gpu, rows: &Rows, channels: usize, values: &Buffer) {
        launch!(gpu, softmax, rows.most, [rows.live => rows.at + 1, values => values.len()], rows.place(), channels as u32);
    }

    /// Gradient of logits from that of their shares.
    pub fn backward(gpu: &Gpu, rows: &Rows, channels: usize, shares: &Buffer, d: &Buffer) -> Buffer {
        let (n, out) = (rows.most * channels, gpu.empty(rows.most * channels));
        launch!(
            gpu,
            slope,
            rows.most,
            [rows.live => rows.at + 1, shares => n, d => n, out => n],
            rows.place(),
            channels as u32,
        );
        out
    }

    #[cube(launch_unchecked)]
    fn softmax(live: &[u32], values: &mut [f32], at: u32, channels: u32) {
        let row = ABSOLUTE_POS;
        if row >= live[at as usize] as usize {
            terminate!();
        }
        let first = row * channels as usize;
        let mut most = values[first];
        for k in 1..channels as usize {
            most = f32::max(most, values[first + k]);
        }
        let mut sum = 0.0f32;
        for k in 0..channels as usize {
            let e = (values[first + k] - most).exp();
            values[first + k] = e;
            sum += e;
        }
        for k in 0..channels as usize {
            values[first + k] /= sum;
        }
    }

    #[cube(launch_unchecked)]
    fn slope(live: &[u32], shares: &[f32], d: &[f32], out: &mut [f32], at: u32, channels: u32) {
        let row = ABSOLUTE_POS;
        if row >= live[at as usize] as usize {
            terminate!();
        }
        let first = row * channels as usize;
        let mut mean = 0.0f32;
        for k in 0..channels as usize {
            mean += shares[first + k] * d[first + k];
        }
        for k in 0..channels as usize {
            out[first + k] = shares[first + k] * (d[first + k] - mean);
        }
    }
}
