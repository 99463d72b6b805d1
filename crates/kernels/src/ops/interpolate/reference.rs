//! Pixel by pixel in f64.

use super::Interpolate;

/// Offsets of the attributes of a pixel's three corners, if it shows a triangle.
fn corners(s: &Interpolate, triangles: &[[u32; 3]], ids: &[u32], p: usize) -> Option<[usize; 3]> {
    let image = if s.per_image { p / s.pixels } else { 0 };
    let triangle = triangles[ids[p].checked_sub(1)? as usize];
    Some(triangle.map(|v| (image * s.vertices + v as usize) * s.attributes))
}

/// `[N, H, W, A]`
pub fn forward(s: &Interpolate, attributes: &[f64], triangles: &[[u32; 3]], ids: &[u32], uv: &[f64]) -> Vec<f64> {
    let mut out = vec![0.0; ids.len() * s.attributes];
    for p in 0..ids.len() {
        let Some([a, b, c]) = corners(s, triangles, ids, p) else { continue };
        let (u, v) = (uv[2 * p], uv[2 * p + 1]);
        for k in 0..s.attributes {
            out[p * s.attributes + k] = u * attributes[a + k] + v * attributes[b + k] + (1.0 - u - v) * attributes[c + k];
        }
    }
    out
}

/// Gradients of attributes and of barycentrics.
pub fn backward(
    s: &Interpolate,
    attributes: &[f64],
    triangles: &[[u32; 3]],
    ids: &[u32],
    uv: &[f64],
    d_out: &[f64],
) -> (Vec<f64>, Vec<f64>) {
    let (mut d_attributes, mut d_uv) = (vec![0.0; attributes.len()], vec![0.0; uv.len()]);
    for p in 0..ids.len() {
        let Some([a, b, c]) = corners(s, triangles, ids, p) else { continue };
        let (u, v) = (uv[2 * p], uv[2 * p + 1]);
        for k in 0..s.attributes {
            let d = d_out[p * s.attributes + k];
            d_attributes[a + k] += u * d;
            d_attributes[b + k] += v * d;
            d_attributes[c + k] += (1.0 - u - v) * d;
            d_uv[2 * p] += (attributes[a + k] - attributes[c + k]) * d;
            d_uv[2 * p + 1] += (attributes[b + k] - attributes[c + k]) * d;
        }
    }
    (d_attributes, d_uv)
}

/// `∂/∂X, ∂/∂Y` of the `chosen` attributes, `[N, H, W, chosen, 2]`, from the barycentrics' screen derivatives `[N, H, W, 4]`.
pub fn derivatives(s: &Interpolate, chosen: &[usize], attributes: &[f64], triangles: &[[u32; 3]], ids: &[u32], slopes: &[f64]) -> Vec<f64> {
    let mut out = vec![0.0; ids.len() * chosen.len() * 2];
    for p in 0..ids.len() {
        let Some([a, b, c]) = corners(s, triangles, ids, p) else { continue };
        for (i, k) in chosen.iter().enumerate() {
            for axis in 0..2 {
                let (du, dv) = (slopes[4 * p + axis], slopes[4 * p + 2 + axis]);
                out[(p * chosen.len() + i) * 2 + axis] =
                    du * (attributes[a + k] - attributes[c + k]) + dv * (attributes[b + k] - attributes[c + k]);
            }
        }
    }
    out
}

/// Gradients of attributes and of the barycentrics' screen derivatives.
pub fn derivatives_backward(
    s: &Interpolate,
    chosen: &[usize],
    attributes: &[f64],
    triangles: &[[u32; 3]],
    ids: &[u32],
    slopes: &[f64],
    d_out: &[f64],
) -> (Vec<f64>, Vec<f64>) {
    let (mut d_attributes, mut d_slopes) = (vec![0.0; attributes.len()], vec![0.0; slopes.len()]);
    for p in 0..ids.len() {
        let Some([a, b, c]) = corners(s, triangles, ids, p) else { continue };
        for (i, k) in chosen.iter().enumerate() {
            for axis in 0..2 {
                let d = d_out[(p * chosen.len() + i) * 2 + axis];
                let (du, dv) = (slopes[4 * p + axis], slopes[4 * p + 2 + axis]);
                d_attributes[a + k] += du * d;
                d_attributes[b + k] += dv * d;
                d_attributes[c + k] -= (du + dv) * d;
                d_slopes[4 * p + axis] += (attributes[a + k] - attributes[c + k]) * d;
                d_slopes[4 * p + 2 + axis] += (attributes[b + k] - attributes[c + k]) * d;
            }
        }
    }
    (d_attributes, d_slopes)
}
