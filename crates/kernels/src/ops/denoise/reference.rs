//! The filter in double precision, pixel by pixel.

use super::{ALBEDO, DARK, DEPTH, NOISE, NORMAL, OPACITY, PASSES, SPLINE};
use crate::ops::path_trace::Film;

type Texel = super::Texel<f64>;

/// Filtered colors `[H, W]` of a film.
pub fn run(film: &Film) -> Vec<[f64; 3]> {
    let (w, h) = (film.width as i64, film.height as i64);
    let lum = |c: [f64; 3]| 0.2126 * c[0] + 0.7152 * c[1] + 0.0722 * c[2];
    let wide = |v: [f32; 3]| v.map(f64::from);
    let over: Vec<[f64; 3]> = film.pixels.iter().map(|p| p.albedo.map(|a| (a + DARK + 1.0 - p.opacity) as f64)).collect();
    let mut texels: Vec<Texel> = (0..film.pixels.len())
        .map(|i| {
            let p = &film.pixels[i];
            let l = lum(wide(p.color));
            Texel {
                normal: wide(p.normal),
                albedo: wide(p.albedo),
                opacity: p.opacity as f64,
                depth: p.depth as f64,
                light: std::array::from_fn(|k| p.color[k] as f64 / over[i][k]),
                variance: (p.square as f64 - l * l).max(0.0) / film.samples.max(1) as f64 / lum(over[i]).powi(2),
            }
        })
        .collect();
    for pass in 0..PASSES {
        let before = texels.clone();
        let at = |x: i64, y: i64| (x >= 0 && y >= 0 && x < w && y < h).then(|| before[(y * w + x) as usize]);
        for y in 0..h {
            for x in 0..w {
                let center = before[(y * w + x) as usize];
                let (mut noise, mut count) = (0.0, 0.0);
                for (dx, dy) in (-1..=1).flat_map(|dy| (-1..=1).map(move |dx| (dx, dy))) {
                    if let Some(t) = at(x + dx, y + dy) {
                        let weight = ((2 - dx.abs()) * (2 - dy.abs())) as f64;
                        noise += weight * t.variance;
                        count += weight;
                    }
                }
                let noise = (noise / count).sqrt() * NOISE as f64 + 1e-4;
                let (mut light, mut variance, mut total) = ([0.0; 3], 0.0, 0.0);
                for (dx, dy) in (-2..=2).flat_map(|dy| (-2..=2).map(move |dx| (dx, dy))) {
                    let Some(t) = at(x + (dx << pass), y + (dy << pass)) else { continue };
                    let squared = |a: [f64; 3], b: [f64; 3]| (0..3).map(|k| (a[k] - b[k]).powi(2)).sum::<f64>();
                    let far = ((dx * dx + dy * dy) as f64).sqrt() * (1i64 << pass) as f64;
                    let exponent = squared(t.normal, center.normal) / (NORMAL * NORMAL) as f64
                        + squared(t.albedo, center.albedo) / (ALBEDO * ALBEDO) as f64
                        + ((t.opacity - center.opacity) / OPACITY as f64).powi(2)
                        + (t.depth - center.depth).abs() / (DEPTH as f64 * center.depth * far + 1e-6)
                        + (lum(t.light) - lum(center.light)).abs() / noise;
                    let spline = |d: i64| SPLINE[d.unsigned_abs() as usize] as f64;
                    let weight = spline(dx) * spline(dy) * (-exponent).exp();
                    (0..3).for_each(|k| light[k] += weight * t.light[k]);
                    variance += weight * weight * t.variance;
                    total += weight;
                }
                let out = &mut texels[(y * w + x) as usize];
                (out.light, out.variance) = (light.map(|l| l / total), variance / (total * total));
            }
        }
    }
    texels.iter().zip(&over).map(|(t, o)| std::array::from_fn(|k| t.light[k] * o[k])).collect()
}
