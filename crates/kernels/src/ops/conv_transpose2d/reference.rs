//! Reference transposed convolution: plain loops in f64, in which every input pixel adds its kernel to the output.

use super::{ConvTranspose2d, Images};
use crate::ops::activation::reference as activation;

/// Calls `visit(weight, input, output)` with the indices of every product that a transposed convolution sums.
fn products(c: &ConvTranspose2d, images: &Images, mut visit: impl FnMut(usize, usize, usize)) {
    let out = c.output(images);
    let (per_in, per_out) = (c.channels_in / c.groups, c.channels_out / c.groups);
    for n in 0..images.batch {
        for i in 0..c.channels_in {
            for o in 0..per_out {
                let channel = n * c.channels_out + i / per_in * per_out + o;
                for y in 0..images.height {
                    for x in 0..images.width {
                        let input = ((n * c.channels_in + i) * images.height + y) * images.width + x;
                        for ky in 0..c.kernel[0] {
                            for kx in 0..c.kernel[1] {
                                let oy = (y * c.stride[0] + ky * c.dilation[0]).wrapping_sub(c.padding[0]);
                                let ox = (x * c.stride[1] + kx * c.dilation[1]).wrapping_sub(c.padding[1]);
                                if oy < out.height && ox < out.width {
                                    let weight = ((i * per_out + o) * c.kernel[0] + ky) * c.kernel[1] + kx;
                                    visit(weight, input, (channel * out.height + oy) * out.width + ox);
                                }
                            }
                        }
                    }
                }
            }
        }
    }
}

/// Values before the activation.
fn linear(c: &ConvTranspose2d, images: &Images, x: &[f64], w: &[f64], bias: &[f64]) -> Vec<f64> {
    let pixels = c.output(images).pixels();
    let mut out: Vec<f64> =
        (0..images.batch * c.channels_out * pixels).map(|i| bias.get(i / pixels % c.channels_out).copied().unwrap_or(0.0)).collect();
    products(c, images, |weight, input, output| out[output] += w[weight] * x[input]);
    out
}

/// `y = act(wᵀ ∗ x + b)`; an empty bias is zero.
pub fn forward(c: &ConvTranspose2d, images: &Images, x: &[f64], w: &[f64], bias: &[f64]) -> Vec<f64> {
    linear(c, images, x, w, bias).into_iter().map(|v| activation::value(c.activation, v)).collect()
}

/// Gradients of x, w and the bias, given the gradient `d` of y.
pub fn backward(c: &ConvTranspose2d, images: &Images, x: &[f64], w: &[f64], bias: &[f64], d: &[f64]) -> (Vec<f64>, Vec<f64>, Vec<f64>) {
    let before = linear(c, images, x, w, bias);
    let g: Vec<f64> = d.iter().zip(&before).map(|(d, v)| d * activation::slope(c.activation, *v)).collect();
    let (mut dx, mut dw, mut db) = (vec![0.0; x.len()], vec![0.0; w.len()], vec![0.0; c.channels_out]);
    products(c, images, |weight, input, output| {
        dx[input] += g[output] * w[weight];
        dw[weight] += g[output] * x[input];
    });
    let pixels = c.output(images).pixels();
    for (i, g) in g.iter().enumerate() {
        db[i / pixels % c.channels_out] += g;
    }
    (dx, dw, db)
}
