//! Every pair of texels, in f64.

use super::{CubePrefilter, Filtered, center, parts};

/// Means of four texels, down to faces of `to`.
fn reduced(base: &[f64], size: usize, to: usize) -> Vec<f64> {
    if size == to {
        return base.to_vec();
    }
    let half = size / 2;
    let at = |i: usize| {
        let (k, x, y, face) = (i % 3, i / 3 % half, i / 3 / half % half, i / 3 / half / half);
        let of = |dx: usize, dy: usize| base[3 * ((face * size + 2 * y + dy) * size + 2 * x + dx) + k];
        0.25 * (of(0, 0) + of(1, 0) + of(0, 1) + of(1, 1))
    };
    reduced(&(0..18 * half * half).map(at).collect::<Vec<_>>(), half, to)
}

/// Adds gradients of [`reduced`] to those of the base.
fn spread(d: &[f64], size: usize, d_base: &mut [f64], base_size: usize) {
    let ratio = base_size / size;
    for (i, to) in d_base.iter_mut().enumerate() {
        let (k, x, y, face) = (i % 3, i / 3 % base_size, i / 3 / base_size % base_size, i / 3 / base_size / base_size);
        *to += d[3 * ((face * size + y / ratio) * size + x / ratio) + k] / (ratio * ratio) as f64;
    }
}

/// Normalized weights of an output's texel.
fn weights(f: &Filtered, texel: usize) -> Vec<f64> {
    let n = center(texel, f.to);
    let of = |j: usize| {
        let of_part = |(d, solid): ([f64; 3], f64)| f.kernel((0..3).map(|k| n[k] * d[k]).sum()) * solid;
        parts(j, f.from).into_iter().map(of_part).sum::<f64>()
    };
    let all: Vec<f64> = (0..6 * f.from * f.from).map(of).collect();
    let sum: f64 = all.iter().sum();
    all.into_iter().map(|w| w / sum).collect()
}

/// Outputs `[6, to, to, 3]` of each filter.
pub fn forward(p: &CubePrefilter, base: &[f64]) -> Vec<Vec<f64>> {
    let of = |f: &Filtered| {
        let input = reduced(base, p.size, f.from);
        let texel = |i: usize| {
            let w = weights(f, i);
            (0..3).map(|k| w.iter().enumerate().map(|(j, w)| w * input[3 * j + k]).sum()).collect::<Vec<f64>>()
        };
        (0..6 * f.to * f.to).flat_map(texel).collect()
    };
    p.filters().iter().map(of).collect()
}

/// Gradient of the base for gradients of the outputs.
pub fn backward(p: &CubePrefilter, d: &[Vec<f64>]) -> Vec<f64> {
    let mut d_base = vec![0.0; p.base_len()];
    for (f, d) in p.filters().iter().zip(d) {
        let mut d_input = vec![0.0; 18 * f.from * f.from];
        for i in 0..6 * f.to * f.to {
            for (j, w) in weights(f, i).into_iter().enumerate() {
                (0..3).for_each(|k| d_input[3 * j + k] += w * d[3 * i + k]);
            }
        }
        spread(&d_input, f.from, &mut d_base, p.size);
    }
    d_base
}
