//! Reference convolution: plain loops in f64.

use super::{Conv2d, Images};
use crate::ops::activation::reference as activation;

/// Calls `visit(weight, input, output)` with the indices of every product that a convolution sums.
pub fn products(c: &Conv2d, images: &Images, mut visit: impl FnMut(usize, usize, usize)) {
    let out = c.output(images);
    let (per_in, per_out) = (c.channels_in / c.groups, c.channels_out / c.groups);
    for n in 0..images.batch {
        for o in 0..c.channels_out {
            for y in 0..out.height {
                for x in 0..out.width {
                    let output = ((n * c.channels_out + o) * out.height + y) * out.width + x;
                    for i in 0..per_in {
                        let channel = n * c.channels_in + o / per_out * per_in + i;
                        for ky in 0..c.kernel[0] {
                            for kx in 0..c.kernel[1] {
                                let iy = (y * c.stride[0] + ky * c.dilation[0]).wrapping_sub(c.padding[0]);
                                let ix = (x * c.stride[1] + kx * c.dilation[1]).wrapping_sub(c.padding[1]);
                                if iy < images.height && ix < images.width {
                                    let weight = ((o * per_in + i) * c.kernel[0] + ky) * c.kernel[1] + kx;
                                    visit(weight, (channel * images.height + iy) * images.width + ix, output);
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
fn linear(c: &Conv2d, images: &Images, x: &[f64], w: &[f64], bias: &[f64]) -> Vec<f64> {
    let pixels = c.output(images).pixels();
    let mut out: Vec<f64> =
        (0..images.batch * c.channels_out * pixels).map(|i| bias.get(i / pixels % c.channels_out).copied().unwrap_or(0.0)).collect();
    products(c, images, |weight, input, output| out[output] += w[weight] * x[input]);
    out
}

/// `y = act(w ∗ x + b)`; an empty bias is zero.
pub fn forward(c: &Conv2d, images: &Images, x: &[f64], w: &[f64], bias: &[f64]) -> Vec<f64> {
    linear(c, images, x, w, bias).into_iter().map(|v| activation::value(c.activation, v)).collect()
}

/// Gradients of x, w and the bias, given the gradient `d` of y.
pub fn backward(c: &Conv2d, images: &Images, x: &[f64], w: &[f64], bias: &[f64], d: &[f64]) -> (Vec<f64>, Vec<f64>, Vec<f64>) {
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
