//! Metal when the third stage begins: which vertices the second stage classifies as metal, and their base color in a light that was found anew.
//!
//! A metal sends `c = a S + B` with the mirrored light `S` and `B` of the split sum, so that a factor `f` from base colors in the light before
//! to those in this one follows from `c − B = f a S` by least absolute differences over all sightings.

use super::albedo_entropy::CLIPPED;
use super::gloss::Rows;
use super::probe::Probe;
use diorama_kernels::ops::split_sum::Points;

/// Metalness above which a surface counts as metal: what is not metal stays far below.
pub const METAL: f32 = 0.6;
/// Sightings that are needed.
const LEAST: usize = 100;
/// Share of the brightest base colors that may exceed those of any metal, as they are wrong.
const WRONG: f32 = 0.1;

/// Metal at the vertices.
pub struct Metal {
    pub is_metal: Vec<bool>,
    pub colors: Vec<[f32; 3]>,
    pub roughness: Vec<f32>,
}

impl Metal {
    /// Base color, by channel, that all but a few vertices stay below.
    pub fn brightest(&self) -> f32 {
        let colors = self.colors.iter().zip(&self.is_metal).filter(|(_, m)| **m);
        let mut all: Vec<f32> = colors.map(|(c, _)| c[0].max(c[1]).max(c[2])).collect();
        all.sort_by(f32::total_cmp);
        all.get(((1.0 - WRONG) * all.len() as f32) as usize).copied().unwrap_or(1.0)
    }

    /// Factor of the base colors by channel in the light of a probe; none where too little is seen.
    pub fn factor(&self, probe: &Probe, rows: &Rows) -> Option<[f32; 3]> {
        let n = rows.color.len();
        if n < LEAST {
            return None;
        }
        let of: Vec<usize> = rows.vertex.iter().zip(&rows.ranges).flat_map(|(v, r)| std::iter::repeat_n(*v as usize, r.len())).collect();
        let ks: Vec<f32> = of.iter().flat_map(|v| [0.0, self.roughness[*v], 1.0]).collect();
        let lit = |kd: &[f32]| probe.shade(&Points { normal: &rows.normal, view: &rows.view, kd, ks: &ks }, None).color;
        let colored: Vec<f32> = of.iter().flat_map(|v| self.colors[*v]).collect();
        let (all, black) = (lit(&colored), lit(&vec![0.0; 3 * n]));
        Some([0, 1, 2].map(|k| {
            let pairs: Vec<(f64, f64)> = (0..n)
                .filter(|i| rows.color[*i].iter().all(|c| *c < CLIPPED))
                .map(|i| ((all[3 * i + k] - black[3 * i + k]) as f64, (rows.color[i][k] - black[3 * i + k]) as f64))
                .collect();
            least_difference(&pairs) as f32
        }))
    }
}

/// The factor from the first numbers of pairs to the second that leaves the least absolute differences: the weighted median of their ratios.
fn least_difference(pairs: &[(f64, f64)]) -> f64 {
    let mut ratios: Vec<(f64, f64)> = pairs.iter().filter(|p| p.0 > 0.0).map(|(s, c)| (c / s, *s)).collect();
    ratios.sort_by(|a, b| a.0.total_cmp(&b.0));
    let half = 0.5 * ratios.iter().map(|r| r.1).sum::<f64>();
    let mut sum = 0.0;
    let middle = ratios.iter().find(|r| {
        sum += r.1;
        sum >= half
    });
    middle.map_or(1.0, |r| r.0.max(0.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn outliers_hardly_change_the_factor() {
        let mut pairs: Vec<(f64, f64)> = (1..200).map(|i| (0.01 * i as f64, 0.017 * i as f64 + 0.003 * ((i * 7) % 5) as f64)).collect();
        pairs.iter_mut().step_by(9).for_each(|p| p.1 += 3.0);
        let f = least_difference(&pairs);
        assert!((f - 1.7).abs() < 0.05, "{f}");
    }
}
