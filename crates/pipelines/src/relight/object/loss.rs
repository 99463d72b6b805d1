//! Loss of a picture: squared error of the opacity, and absolute error of colors along `sRGB(ln(1 + x))` before a random background (Hasselgren
//! et al. 2021).

use diorama_geom::color::srgb_from_linear;
use diorama_geom::rng::Rng;
use rayon::prelude::*;

/// Pixels per task.
const CHUNK: usize = 4096;
/// Values of photographs from here on are clipped: what is brighter is not wrong.
const CLIPPED: f32 = 0.995;

/// Losses of a picture.
#[derive(Clone, Copy, Debug, Default)]
pub struct PictureLoss {
    pub color: f64,
    pub mask: f64,
    /// Squared error of colors from 0 to 1 in sRGB, for the log.
    pub mse: f64,
}

/// A color value as it is compared, and its slope.
fn toned(x: f32) -> (f32, f32) {
    let x = x.max(0.0);
    let y = x.ln_1p();
    let slope = if y <= 0.003_130_8 { 12.92 } else { 1.055 / 2.4 * y.powf(1.0 / 2.4 - 1.0) };
    (srgb_from_linear(y), slope / (1.0 + x))
}

/// Losses of a picture `[H, W, 4]` against a photograph, both linear light times opacity, and its gradient `d`, overwritten. Pixels have
/// backgrounds of their own, from `rng`.
pub fn picture(rgba: &[f32], photo: &[f32], mask_weight: f32, rng: Rng, d: &mut [f32]) -> PictureLoss {
    let n = rgba.len() / 4;
    let (per_color, per_mask) = (1.0 / (3 * n) as f32, mask_weight / n as f32);
    let of = |(c, d): (usize, &mut [f32])| {
        let mut sum = PictureLoss::default();
        for (j, d) in d.as_chunks_mut::<4>().0.iter_mut().enumerate() {
            let i = c * CHUNK + j;
            let (p, t) = (&rgba[4 * i..4 * i + 4], &photo[4 * i..4 * i + 4]);
            let off = p[3] - t[3];
            sum.mask += (off * off) as f64;
            let mut d_alpha = 2.0 * per_mask * off;
            for k in 0..3 {
                let background = rng.uniform((3 * i + k) as u64);
                let (a, b) = (p[k] + (1.0 - p[3]) * background, t[k] + (1.0 - t[3]) * background);
                let clipped = t[k] >= CLIPPED * t[3] && t[3] > 0.5 && a > b;
                let ((x, slope), (y, _)) = (toned(a), toned(b));
                let e = (srgb_from_linear(a.clamp(0.0, 1.0)) - srgb_from_linear(b.clamp(0.0, 1.0))) as f64;
                sum.mse += e * e;
                if clipped || x == y || a < 0.0 {
                    d[k] = 0.0;
                    continue;
                }
                sum.color += (x - y).abs() as f64;
                d[k] = per_color * slope * (x - y).signum();
                d_alpha -= d[k] * background;
            }
            d[3] = d_alpha;
        }
        sum
    };
    let parts: Vec<PictureLoss> = d.par_chunks_mut(4 * CHUNK).enumerate().map(of).collect();
    let total = |f: fn(&PictureLoss) -> f64| parts.iter().map(f).sum::<f64>();
    PictureLoss {
        color: total(|p| p.color) / (3 * n) as f64,
        mask: mask_weight as f64 * total(|p| p.mask) / n as f64,
        mse: total(|p| p.mse) / (3 * n) as f64,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_testkit::random_unit;

    #[test]
    fn the_gradient_matches_central_differences() {
        let (a, b) = (random_unit(40, 1), random_unit(40, 2));
        let times_alpha =
            |v: &[f32]| -> Vec<f32> { v.as_chunks::<4>().0.iter().flat_map(|p| [p[0] * p[3], p[1] * p[3], p[2] * p[3], p[3]]).collect() };
        let (p, t) = (times_alpha(&a), times_alpha(&b));
        let mut d = vec![0.0; 40];
        picture(&p, &t, 1.5, Rng::new(3, 3), &mut d);
        let wide: Vec<f64> = p.iter().map(|v| *v as f64).collect();
        // Single precision inside: a wide step.
        for (i, want) in (0..40).map(|i| {
            let mut q = p.clone();
            let at = |v: f64, q: &mut Vec<f32>| {
                q[i] = v as f32;
                let l = picture(q, &t, 1.5, Rng::new(3, 3), &mut [0.0; 40]);
                l.color + l.mask
            };
            (i, (at(wide[i] + 1e-3, &mut q) - at(wide[i] - 1e-3, &mut q)) / 2e-3)
        }) {
            assert!((d[i] as f64 - want).abs() < 2e-3, "{i}: {} {want}", d[i]);
        }
    }

    #[test]
    fn what_is_brighter_than_white_is_not_wrong() {
        let mut d = vec![9.0; 4];
        let l = picture(&[3.0, 1.0, 1.0, 1.0], &[1.0; 4], 1.0, Rng::new(0, 0), &mut d);
        assert!(l.color == 0.0 && d == [0.0; 4], "{l:?} {d:?}");
    }
}
