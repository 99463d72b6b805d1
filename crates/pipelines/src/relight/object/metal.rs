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
    use diorama_geom::environment::Environment;
    use diorama_geom::glam::Vec3;
    use diorama_geom::rng::Rng;

    /// Balls of gold and brass under an uneven light, with a few sightings that are clipped and a few of something else before them.
    #[test]
    fn base_colors_become_those_that_mirror_the_light_as_it_is_seen() {
        let light = Environment::from_fn(16, |d| [0.4 + 0.3 * d.z, 0.3 + 0.2 * d.x, 0.2 + 0.1 * d.y].map(|v: f64| v.max(0.0)));
        let (probe, rng) = (Probe::given(32, &light), Rng::new(5, 0));
        let metal = Metal { is_metal: vec![true; 2], colors: vec![[0.5, 0.4, 0.15], [0.4, 0.35, 0.2]], roughness: vec![0.3, 0.5] };
        let n = 200;
        let unit = |of: [u64; 3]| Vec3::from(of.map(|k| rng.normal(k))).normalize();
        let normals: Vec<Vec3> = (0..n as u64).map(|i| unit([6 * i, 6 * i + 1, 6 * i + 2])).collect();
        let views = (0..n as u64).map(|i| (normals[i as usize] + 0.6 * unit([6 * i + 3, 6 * i + 4, 6 * i + 5])).normalize());
        let mut rows = Rows {
            vertex: vec![0, 1],
            ranges: vec![0..n / 2, n / 2..n],
            normal: normals.iter().flat_map(|v| v.to_array()).collect(),
            view: views.flat_map(|v| v.to_array()).collect(),
            color: Vec::new(),
        };
        let want = [1.6, 1.3, 2.0];
        let of = |i: usize| if i < n / 2 { 0 } else { 1 };
        let kd: Vec<f32> = (0..n).flat_map(|i| [0, 1, 2].map(|k| want[k] * metal.colors[of(i)][k])).collect();
        let ks: Vec<f32> = (0..n).flat_map(|i| [0.0, metal.roughness[of(i)], 1.0]).collect();
        let exact = probe.shade(&Points { normal: &rows.normal, view: &rows.view, kd: &kd, ks: &ks }, None).color;
        rows.color = exact.as_chunks::<3>().0.to_vec();
        rows.color.iter_mut().step_by(7).for_each(|c| *c = [1.0; 3]);
        rows.color.iter_mut().skip(3).step_by(11).for_each(|c| *c = [0.05; 3]);
        let found = metal.factor(&probe, &rows).unwrap();
        assert!((0..3).all(|k| (found[k] / want[k] - 1.0).abs() < 0.03), "{found:?}");
        (rows.ranges, rows.color) = (vec![0..10, 10..20], rows.color[..20].to_vec());
        assert!(metal.factor(&probe, &rows).is_none(), "too little is seen");
    }

    #[test]
    fn a_few_wrong_colors_are_not_the_brightest() {
        let colors = (0..40).map(|i| [if i < 3 { 9.0 } else { 0.01 * i as f32 }, 0.1, 0.1]).collect();
        let metal = Metal { is_metal: (0..40).map(|i| i != 39).collect(), colors, roughness: vec![0.5; 40] };
        assert!((0.3..0.39).contains(&metal.brightest()), "{}", metal.brightest());
    }

    #[test]
    fn outliers_hardly_change_the_factor() {
        let mut pairs: Vec<(f64, f64)> = (1..200).map(|i| (0.01 * i as f64, 0.017 * i as f64 + 0.003 * ((i * 7) % 5) as f64)).collect();
        pairs.iter_mut().step_by(9).for_each(|p| p.1 += 3.0);
        let f = least_difference(&pairs);
        assert!((f - 1.7).abs() < 0.05, "{f}");
    }
}
