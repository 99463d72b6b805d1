//! Estimates the exposure and white balance of each photograph from the colors of shared points, with the model log color = photograph's
//! gain + point's log color. Alternating medians solve it, because outliers do not affect them.

use diorama_data::colmap::Observed;
use diorama_geom::ImageU8;
use diorama_geom::color::{linear_from_srgb, srgb_from_linear, u8_from_unit};
use std::collections::HashMap;

/// Range of usable pixel values: brighter ones may be clipped, darker ones are too noisy.
const DARKEST: u8 = 8;
const BRIGHTEST: u8 = 247;
/// Alternating rounds, fewest shared points that determine a photograph's gain, and the largest gain (natural logarithm).
const ROUNDS: usize = 20;
const FEWEST: usize = 20;
const LARGEST: f32 = 1.4;

/// Number and log linear color of each observed point of a photograph, averaged over 3 × 3 pixels; skips clipped and dark pixels.
pub fn colors(image: &ImageU8, observed: &Observed) -> Vec<(u64, [f32; 3])> {
    let at = |[x, y]: [f64; 2]| {
        let (x, y) = (x as i64, y as i64);
        if x < 1 || y < 1 || x + 1 >= image.width as i64 || y + 1 >= image.height as i64 || image.channels < 3 {
            return None;
        }
        let mut sum = [0.0f32; 3];
        for k in 0..9 {
            let p = &image.pixel((x + k % 3 - 1) as usize, (y + k / 3 - 1) as usize)[..3];
            if p.iter().any(|v| !(DARKEST..=BRIGHTEST).contains(v)) {
                return None;
            }
            (0..3).for_each(|c| sum[c] += linear_from_srgb(p[c] as f32 / 255.0) / 9.0);
        }
        Some(sum.map(f32::ln))
    };
    observed.points.iter().filter_map(|(px, id)| at(*px).map(|c| (*id, c))).collect()
}

/// Log gains of the photographs, `[N][3]`, relative to the median photograph; not estimated where a photograph shares too few points.
pub fn gains(colors: &[Vec<(u64, [f32; 3])>]) -> Vec<[f32; 3]> {
    let mut index = HashMap::new();
    for (id, _) in colors.iter().flatten() {
        let n = index.len();
        index.entry(*id).or_insert(n);
    }
    let mut seen: Vec<Vec<(usize, [f32; 3])>> = vec![Vec::new(); index.len()];
    for (i, photo) in colors.iter().enumerate() {
        photo.iter().for_each(|(id, c)| seen[index[id]].push((i, *c)));
    }
    let mut gains = vec![[0.0f32; 3]; colors.len()];
    for k in 0..3 {
        for _ in 0..ROUNDS {
            let points: Vec<f32> = seen.iter().map(|s| median(s.iter().map(|(i, c)| c[k] - gains[*i][k]))).collect();
            for (i, photo) in colors.iter().enumerate() {
                // A point that only one photograph shows carries no information.
                let shared = photo.iter().filter(|(id, _)| seen[index[id]].len() > 1);
                let differences: Vec<f32> = shared.map(|(id, c)| c[k] - points[index[id]]).collect();
                if differences.len() >= FEWEST {
                    gains[i][k] = median(differences.into_iter());
                }
            }
            let middle = median(gains.iter().map(|g| g[k]));
            gains.iter_mut().for_each(|g| g[k] -= middle);
        }
    }
    gains.iter().map(|g| g.map(|v| v.clamp(-LARGEST, LARGEST))).collect()
}

/// Divides a photograph's linear color by `exp(gain)`.
pub fn apply(image: &mut ImageU8, gain: [f32; 3]) {
    let table = gain.map(|g| -> [u8; 256] {
        let by = (-g).exp();
        std::array::from_fn(|v| u8_from_unit(srgb_from_linear((linear_from_srgb(v as f32 / 255.0) * by).min(1.0))))
    });
    let c = image.channels;
    if c >= 3 {
        image.data.chunks_exact_mut(c).for_each(|p| (0..3).for_each(|k| p[k] = table[k][p[k] as usize]));
    }
}

fn median(values: impl Iterator<Item = f32>) -> f32 {
    let mut v: Vec<f32> = values.collect();
    if v.is_empty() {
        return 0.0;
    }
    let n = v.len();
    let (low, middle, _) = v.select_nth_unstable_by(n / 2, f32::total_cmp);
    let middle = *middle;
    if n % 2 == 1 { middle } else { 0.5 * (middle + low.iter().copied().fold(f32::NEG_INFINITY, f32::max)) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_geom::rng::Rng;

    #[test]
    fn gains_are_found_among_strays_and_taken_away() {
        let rng = Rng::new(1, 0);
        let truth: Vec<[f32; 3]> = (0..9).map(|i| [0.1 * (i as f32 - 4.0), -0.05 * (i as f32 - 4.0), 0.0]).collect();
        let colors: Vec<Vec<(u64, [f32; 3])>> = (0..9u64)
            .map(|i| {
                let seen = (0..200u64).filter(|p| (p + i) % 3 != 0);
                seen.map(|p| {
                    let stray = if (p * 7 + i) % 11 == 0 { 1.5 } else { 0.0 };
                    let at = |k: usize| -2.0 + rng.uniform(p * 3 + k as u64) + truth[i as usize][k] + stray;
                    (p, std::array::from_fn(at))
                })
                .collect()
            })
            .collect();
        for (found, true_gain) in gains(&colors).iter().zip(&truth) {
            assert!((0..3).all(|k| (found[k] - true_gain[k]).abs() < 0.02), "{found:?} {true_gain:?}");
        }
        let mut im = ImageU8 { width: 1, height: 1, channels: 3, data: vec![100, 100, 100] };
        apply(&mut im, [0.5, 0.0, -0.5]);
        assert!(im.data[0] < 85 && im.data[1] == 100 && im.data[2] > 118);
    }

    #[test]
    fn photographs_with_few_points_stay_as_they_are() {
        let colors = vec![vec![(1, [0.0; 3])], vec![(1, [1.0; 3])]];
        assert_eq!(gains(&colors), [[0.0; 3]; 2]);
    }
}
