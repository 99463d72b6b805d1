//! Points moved onto the surface that they scatter about: a bilateral filter along normals (Digne and de Franchis 2017), then a projection on
//! moving least squares (Alexa et al. 2003).

use super::cloud::Cells;
use diorama_geom::glam::{DMat3, DVec3};
use nalgebra::{DMatrix, Matrix3, SymmetricEigen};
use rayon::prelude::*;

/// Radii over the points' spacing.
const BILATERAL: f64 = 4.0;
const LEAST_SQUARES: f64 = 8.0;
/// Passes of the bilateral filter.
const PASSES: usize = 3;
/// Radii of the neighborhood of least squares, in whose square its weight falls to 1/e.
const REACH: f64 = 2.0;
/// Terms of a polynomial of order 2.
const TERMS: usize = 6;

/// Eigenvectors of the points' covariance by ascending eigenvalue, with the mean: the first is the normal.
pub(in crate::text) fn principal(points: &[DVec3], weights: impl Fn(usize) -> f64) -> (DVec3, DMat3, DVec3) {
    let (mut sum, mut total) = (DVec3::ZERO, 0.0);
    points.iter().enumerate().for_each(|(i, p)| (sum, total) = (sum + weights(i) * *p, total + weights(i)));
    let mean = sum / total.max(1e-300);
    let mut covariance = Matrix3::<f64>::zeros();
    for (i, p) in points.iter().enumerate() {
        let d = (*p - mean).to_array();
        (0..3).for_each(|a| (0..3).for_each(|b| covariance[(a, b)] += weights(i) / total.max(1e-300) * d[a] * d[b]));
    }
    let eigen = SymmetricEigen::new(covariance);
    let mut order = [0, 1, 2];
    order.sort_by(|a, b| eigen.eigenvalues[*a].total_cmp(&eigen.eigenvalues[*b]));
    let vector = |k: usize| DVec3::from(std::array::from_fn(|a| eigen.eigenvectors[(a, order[k])]));
    let values = DVec3::from(order.map(|k| eigen.eigenvalues[k].max(0.0)));
    (mean, DMat3::from_cols(vector(0), vector(1), vector(2)), values)
}

/// The points, smoothed; `spacing` is their median distance to the nearest.
pub fn smoothed(points: &[DVec3], spacing: f64) -> Vec<DVec3> {
    let mut out = points.to_vec();
    for _ in 0..PASSES {
        out = bilateral(&out, BILATERAL * spacing);
    }
    projected(&out, LEAST_SQUARES * spacing)
}

/// `p + n Σ w_d w_n ⟨n, q − p⟩ / Σ w_d w_n` over neighbors `q`.
fn bilateral(points: &[DVec3], radius: f64) -> Vec<DVec3> {
    let cells = Cells::new(points, radius);
    let moved = |p: &DVec3| {
        let near = cells.within(*p, radius);
        if near.len() < 4 {
            return *p;
        }
        let normal = principal(&near, |_| 1.0).1.x_axis;
        let heights: Vec<f64> = near.iter().map(|q| normal.dot(*q - *p)).collect();
        let n = heights.len() as f64;
        let mean = heights.iter().sum::<f64>() / n;
        let deviation = (heights.iter().map(|h| (h - mean).powi(2)).sum::<f64>() / n).sqrt().max(1e-12);
        let spread = radius / 3.0;
        let (mut sum, mut total) = (0.0, 0.0);
        for (q, h) in near.iter().zip(&heights) {
            let w = (-q.distance_squared(*p) / (2.0 * spread * spread) - h * h / (2.0 * deviation * deviation)).exp();
            (sum, total) = (sum + w * h, total + w);
        }
        *p + normal * (sum / total)
    };
    points.par_iter().map(moved).collect()
}

/// Each point on a polynomial of order 2 over its neighborhood's plane, with weights `exp(−d² / R²)`.
fn projected(points: &[DVec3], radius: f64) -> Vec<DVec3> {
    let cells = Cells::new(points, radius);
    let moved = |p: &DVec3| {
        let near = cells.within(*p, REACH * radius);
        let weight = |q: &DVec3| (-q.distance_squared(*p) / (radius * radius)).exp();
        if near.len() < 2 * TERMS {
            return *p;
        }
        let (origin, axes, _) = principal(&near, |i| weight(&near[i]));
        let local = |q: &DVec3| axes.transpose() * (*q - origin);
        let terms = |u: f64, v: f64| [1.0, u, v, u * u, u * v, v * v];
        let (mut a, mut b) = (DMatrix::<f64>::zeros(TERMS, TERMS), DMatrix::<f64>::zeros(TERMS, 1));
        for q in &near {
            let (x, w) = (local(q) / radius, weight(q));
            let t = terms(x.y, x.z);
            for i in 0..TERMS {
                (0..TERMS).for_each(|j| a[(i, j)] += w * t[i] * t[j]);
                b[(i, 0)] += w * t[i] * x.x;
            }
        }
        let Some(c) = a.cholesky().map(|f| f.solve(&b)) else { return *p };
        let x = local(p) / radius;
        let height: f64 = terms(x.y, x.z).iter().enumerate().map(|(i, t)| t * c[(i, 0)]).sum();
        origin + axes * (radius * DVec3::new(height, x.y, x.z))
    };
    points.par_iter().map(moved).collect()
}
