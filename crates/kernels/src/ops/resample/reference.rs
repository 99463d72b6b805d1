//! Dense sums in f64 over the tables, and pixel shuffle by its definition.

use super::{Resample, Weights};

fn product(planes: usize, vertical: (&Weights, bool), horizontal: (&Weights, bool), x: &[f64]) -> Vec<f64> {
    let sizes = |(w, turned): (&Weights, bool)| if turned { (w.outputs(), w.inputs()) } else { (w.inputs(), w.outputs()) };
    let at = |(w, turned): (&Weights, bool), o: usize, i: usize| if turned { w.at(i, o) as f64 } else { w.at(o, i) as f64 };
    let ((h, oh), (w, ow)) = (sizes(vertical), sizes(horizontal));
    let mut out = vec![0.0; planes * oh * ow];
    for p in 0..planes {
        for oy in 0..oh {
            for ox in 0..ow {
                for y in (0..h).filter(|y| at(vertical, oy, *y) != 0.0) {
                    for x_idx in 0..w {
                        let weight = at(vertical, oy, y) * at(horizontal, ox, x_idx);
                        out[(p * oh + oy) * ow + ox] += weight * x[(p * h + y) * w + x_idx];
                    }
                }
            }
        }
    }
    out
}

/// `[P, H, W]` to `[P, H', W']`.
pub fn forward(r: &Resample, planes: usize, x: &[f64]) -> Vec<f64> {
    product(planes, (&r.vertical, false), (&r.horizontal, false), x)
}

/// Gradient `[P, H, W]` from that of the output.
pub fn backward(r: &Resample, planes: usize, d: &[f64]) -> Vec<f64> {
    product(planes, (&r.vertical, true), (&r.horizontal, true), d)
}

/// `[N, C r², H, W]` to `[N, C, H r, W r]`.
pub fn pixel_shuffle(n: usize, c: usize, [h, w]: [usize; 2], r: usize, x: &[f64]) -> Vec<f64> {
    let mut out = vec![0.0; x.len()];
    for (i, v) in x.iter().enumerate() {
        let (image, channel, y, column) = (i / (c * r * r * h * w), i / (h * w) % (c * r * r), i / w % h, i % w);
        let (to, dy, dx) = (channel / (r * r), channel / r % r, channel % r);
        debug_assert!(image < n);
        out[((image * c + to) * h * r + y * r + dy) * w * r + column * r + dx] = *v;
    }
    out
}
