//! Separable windows in f64, parallel over channels.

use super::{C1, C2, WINDOW, gaussian};
use rayon::prelude::*;

/// Windowed means of a plane, `[h − 10, w − 10]`.
fn blur(w: usize, h: usize, plane: &[f64]) -> Vec<f64> {
    let g = gaussian();
    let (ow, oh) = (w + 1 - WINDOW, h + 1 - WINDOW);
    let mut rows = vec![0.0; ow * h];
    for (r, p) in rows.chunks_exact_mut(ow).zip(plane.chunks_exact(w)) {
        for (i, o) in r.iter_mut().enumerate() {
            *o = g.iter().zip(&p[i..]).map(|(g, v)| g * v).sum();
        }
    }
    let mut out = vec![0.0; ow * oh];
    for (y, o) in out.chunks_exact_mut(ow).enumerate() {
        for (j, g) in g.iter().enumerate() {
            o.iter_mut().zip(&rows[(y + j) * ow..]).for_each(|(o, v)| *o += g * v);
        }
    }
    out
}

/// Transpose of [`blur`]: spreads window values over the plane.
fn spread(w: usize, h: usize, windows: &[f64]) -> Vec<f64> {
    let g = gaussian();
    let (ow, oh) = (w + 1 - WINDOW, h + 1 - WINDOW);
    let mut rows = vec![0.0; ow * h];
    for y in 0..oh {
        for (j, g) in g.iter().enumerate() {
            let r = &mut rows[(y + j) * ow..(y + j + 1) * ow];
            r.iter_mut().zip(&windows[y * ow..]).for_each(|(r, v)| *r += g * v);
        }
    }
    let mut out = vec![0.0; w * h];
    for (o, r) in out.chunks_exact_mut(w).zip(rows.chunks_exact(ow)) {
        for (i, v) in r.iter().enumerate() {
            o[i..i + WINDOW].iter_mut().zip(&g).for_each(|(o, g)| *o += g * v);
        }
    }
    out
}

struct Maps {
    x: Vec<f64>,
    y: Vec<f64>,
    means: [Vec<f64>; 5],
}

fn maps(w: usize, h: usize, c: usize, k: usize, x: &[f32], y: &[f32]) -> Maps {
    let plane = |a: &[f32]| a.iter().skip(k).step_by(c).map(|v| *v as f64).collect::<Vec<f64>>();
    let (x, y) = (plane(x), plane(y));
    let product = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).collect::<Vec<f64>>();
    let means = [blur(w, h, &x), blur(w, h, &y), blur(w, h, &product(&x, &x)), blur(w, h, &product(&y, &y)), blur(w, h, &product(&x, &y))];
    Maps { x, y, means }
}

impl Maps {
    /// SSIM of window `i`.
    fn at(&self, i: usize) -> f64 {
        let [a1, a2, b1, b2] = self.factors(i);
        a1 * a2 / (b1 * b2)
    }

    /// The two factors above and below the fraction bar at window `i`.
    fn factors(&self, i: usize) -> [f64; 4] {
        let [mx, my, xx, yy, xy] = [0, 1, 2, 3, 4].map(|m: usize| self.means[m][i]);
        [2.0 * mx * my + C1, 2.0 * (xy - mx * my) + C2, mx * mx + my * my + C1, (xx - mx * mx) + (yy - my * my) + C2]
    }
}

/// Mean SSIM; NaN for images smaller than the window.
///
/// # Shapes
/// x, y `[h, w, c]`.
pub fn ssim(w: usize, h: usize, c: usize, x: &[f32], y: &[f32]) -> f64 {
    if w < WINDOW || h < WINDOW {
        return f64::NAN;
    }
    let n = (w + 1 - WINDOW) * (h + 1 - WINDOW);
    let sums: Vec<f64> = (0..c)
        .into_par_iter()
        .map(|k| {
            let m = maps(w, h, c, k, x, y);
            (0..n).map(|i| m.at(i)).sum()
        })
        .collect();
    sums.iter().sum::<f64>() / (n * c) as f64
}

/// Mean SSIM of the windows in whose middle a pixel counts, by the pixels in them that count; NaN where there is none.
///
/// # Shapes
/// x, y `[h, w, c]`; counts `[h, w]`.
pub fn ssim_where(w: usize, h: usize, c: usize, x: &[f32], y: &[f32], counts: &[bool]) -> f64 {
    if w < WINDOW || h < WINDOW {
        return f64::NAN;
    }
    let (across, down) = (w + 1 - WINDOW, h + 1 - WINDOW);
    let middle = |i: usize| (i / across + WINDOW / 2) * w + i % across + WINDOW / 2;
    let windows: Vec<usize> = (0..across * down).filter(|i| counts[middle(*i)]).collect();
    let weights = blur(w, h, &counts.iter().map(|v| *v as u8 as f64).collect::<Vec<f64>>());
    let admitted = |a: &[f32]| a.iter().enumerate().map(|(i, v)| if counts[i / c] { *v } else { 0.0 }).collect::<Vec<f32>>();
    let (x, y) = (admitted(x), admitted(y));
    let sums: Vec<f64> = (0..c)
        .into_par_iter()
        .map(|k| {
            let mut m = maps(w, h, c, k, &x, &y);
            m.means.iter_mut().for_each(|p| windows.iter().for_each(|i| p[*i] /= weights[*i]));
            windows.iter().map(|i| m.at(*i)).sum()
        })
        .collect();
    sums.iter().sum::<f64>() / (windows.len() * c) as f64
}

/// Gradient of [`ssim`] with respect to x, `[h, w, c]`; zero for images smaller than the window.
pub fn gradient(w: usize, h: usize, c: usize, x: &[f32], y: &[f32]) -> Vec<f32> {
    let mut out = vec![0.0; x.len()];
    if w < WINDOW || h < WINDOW {
        return out;
    }
    let n = (w + 1 - WINDOW) * (h + 1 - WINDOW);
    let planes: Vec<Vec<f64>> = (0..c)
        .into_par_iter()
        .map(|k| {
            let m = maps(w, h, c, k, x, y);
            // ∂S/∂x_p = Σ_windows g_p (α + β x_p + γ y_p)
            let (mut alpha, mut beta, mut gamma) = (vec![0.0; n], vec![0.0; n], vec![0.0; n]);
            for i in 0..n {
                let [a1, a2, b1, b2] = m.factors(i);
                let s = a1 * a2 / (b1 * b2);
                let (mx, my) = (m.means[0][i], m.means[1][i]);
                beta[i] = -2.0 * s / b2;
                gamma[i] = 2.0 * s / a2;
                alpha[i] = s * (2.0 * my / a1 - 2.0 * mx / b1) - beta[i] * mx - gamma[i] * my;
            }
            let (alpha, beta, gamma) = (spread(w, h, &alpha), spread(w, h, &beta), spread(w, h, &gamma));
            (0..w * h).map(|p| (alpha[p] + beta[p] * m.x[p] + gamma[p] * m.y[p]) / (n * c) as f64).collect()
        })
        .collect();
    for (k, plane) in planes.iter().enumerate() {
        out.iter_mut().skip(k).step_by(c).zip(plane).for_each(|(o, v)| *o = *v as f32);
    }
    out
}
