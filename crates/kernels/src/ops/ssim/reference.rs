//! Window by window in f64.

use super::{C1, C2, WINDOW, gaussian};

/// Calls `f(μx, μy, σx², σy², σxy, window pixels with weights)` for each window and channel.
fn windows(w: usize, h: usize, c: usize, x: &[f64], y: &[f64], mut f: impl FnMut([f64; 5], &[(usize, f64)])) {
    let g = gaussian();
    for oy in 0..(h + 1).saturating_sub(WINDOW) {
        for ox in 0..(w + 1).saturating_sub(WINDOW) {
            for k in 0..c {
                let mut pixels = Vec::with_capacity(WINDOW * WINDOW);
                for j in 0..WINDOW {
                    for i in 0..WINDOW {
                        pixels.push((((oy + j) * w + ox + i) * c + k, g[i] * g[j]));
                    }
                }
                let mean = |a: &[f64], b: &dyn Fn(f64) -> f64| pixels.iter().map(|(p, w)| w * b(a[*p])).sum::<f64>();
                let (mx, my) = (mean(x, &|v| v), mean(y, &|v| v));
                let vx = pixels.iter().map(|(p, w)| w * (x[*p] - mx).powi(2)).sum();
                let vy = pixels.iter().map(|(p, w)| w * (y[*p] - my).powi(2)).sum();
                let xy = pixels.iter().map(|(p, w)| w * (x[*p] - mx) * (y[*p] - my)).sum();
                f([mx, my, vx, vy, xy], &pixels);
            }
        }
    }
}

/// Mean SSIM; NaN when no window fits.
pub fn ssim(w: usize, h: usize, c: usize, x: &[f64], y: &[f64]) -> f64 {
    let (mut sum, mut n) = (0.0, 0);
    windows(w, h, c, x, y, |[mx, my, vx, vy, xy], _| {
        sum += (2.0 * mx * my + C1) * (2.0 * xy + C2) / ((mx * mx + my * my + C1) * (vx + vy + C2));
        n += 1;
    });
    sum / n as f64
}

/// Gradient of the mean SSIM with respect to x.
pub fn gradient(w: usize, h: usize, c: usize, x: &[f64], y: &[f64]) -> Vec<f64> {
    let mut g = vec![0.0; x.len()];
    let mut n = 0;
    windows(w, h, c, x, y, |[mx, my, vx, vy, xy], pixels| {
        let (a1, a2) = (2.0 * mx * my + C1, 2.0 * xy + C2);
        let (b1, b2) = (mx * mx + my * my + C1, vx + vy + C2);
        let s = a1 * a2 / (b1 * b2);
        for (p, weight) in pixels {
            let d_mean = s * (2.0 * my / a1 - 2.0 * mx / b1);
            let d_var = -s / b2 * 2.0 * (x[*p] - mx);
            let d_cov = s * 2.0 / a2 * (y[*p] - my);
            g[*p] += weight * (d_mean + d_var + d_cov);
        }
        n += 1;
    });
    g.iter().map(|v| v / n as f64).collect()
}
