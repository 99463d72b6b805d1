//! Metal when the third stage begins: which vertices the second stage classifies as metal, and their base color in a light that was found anew.
//!
//! A metal sends `c = a S + B` with the mirrored light `S` and `B` of the split sum, so that a factor `f` from base colors in the light before
//! to those in this one follows from `Σ c = Σ (B + f a S)` over the sightings of each vertex, and is the median over the vertices.

use super::albedo_entropy::{CLIPPED, luminance};
use super::config::CHANNELS;
use super::gloss::Rows;
use super::probe::Probe;
use diorama_kernels::ops::split_sum::Points;
use std::ops::Range;

/// Metalness above which a surface counts as metal, and above which it does where it is bright enough.
const METAL: f32 = 0.6;
const MAYBE: f32 = 0.3;
/// Luminance that is bright enough, over the median of what is surely metal: what looks like metal by mistake is dark.
const BRIGHT: f32 = 0.5;
/// Sightings that are needed.
const LEAST: usize = 100;
/// Share of the brightest base colors that may exceed those of any metal, as they are wrong.
const WRONG: f32 = 0.1;
/// Largest factor of a base color, and halvings of the interval in which it is looked for.
const LARGEST: f32 = 8.0;
const HALVINGS: usize = 20;

/// Metal at the vertices.
pub struct Metal {
    pub is_metal: Vec<bool>,
    pub colors: Vec<[f32; 3]>,
    pub roughness: Vec<f32>,
}

/// Tells metal by texels of the second stage, whose brightness is relative.
pub struct Classifier {
    /// Least luminance of metal where metalness is middling.
    bright: f32,
}

impl Classifier {
    pub fn of(texels: &[[f32; CHANNELS]]) -> Classifier {
        let mut all: Vec<f32> = texels.iter().filter(|t| t[5] > METAL).map(brightness).collect();
        let middle = all.len() / 2;
        let bright = if all.is_empty() { f32::INFINITY } else { BRIGHT * *all.select_nth_unstable_by(middle, f32::total_cmp).1 };
        Classifier { bright }
    }

    pub fn is_metal(&self, t: &[f32; CHANNELS]) -> bool {
        t[5] > METAL || t[5] > MAYBE && brightness(t) > self.bright
    }
}

fn brightness(t: &[f32; CHANNELS]) -> f32 {
    luminance([t[0], t[1], t[2]])
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
            let of_vertex = |range: &Range<usize>| {
                let pairs: Vec<[f32; 3]> =
                    range.clone().map(|i| [all[3 * i + k] - black[3 * i + k], black[3 * i + k], rows.color[i][k]]).collect();
                (balance(&pairs), range.len())
            };
            median(rows.ranges.iter().map(of_vertex).collect())
        }))
    }
}

/// The factor of the first of three numbers under which the sum of what is seen, the second being added and what is brighter than white
/// clipped, is that of the third. A mirrored light that is off by a direction changes single sightings, and hardly their sum.
fn balance(sightings: &[[f32; 3]]) -> f32 {
    let seen: f32 = sightings.iter().map(|s| s[2].min(CLIPPED)).sum();
    let missing = |f: f32| seen - sightings.iter().map(|s| (f * s[0] + s[1]).min(CLIPPED)).sum::<f32>();
    let (mut low, mut high) = (0.0, LARGEST);
    for _ in 0..HALVINGS {
        let middle = 0.5 * (low + high);
        *(if missing(middle) > 0.0 { &mut low } else { &mut high }) = middle;
    }
    0.5 * (low + high)
}

/// Median of values with weights.
fn median(mut values: Vec<(f32, usize)>) -> f32 {
    values.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut left = values.iter().map(|v| v.1).sum::<usize>() / 2;
    let middle = values.iter().find(|v| {
        let is_here = v.1 > left;
        left = left.saturating_sub(v.1);
        is_here
    });
    middle.map_or(1.0, |v| v.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_geom::environment::Environment;
    use diorama_geom::glam::Vec3;
    use diorama_geom::rng::Rng;

    /// Points of gold and brass under an uneven light, some of it clipped, and one of ten that sends something else.
    #[test]
    fn base_colors_become_those_that_mirror_the_light_as_it_is_seen() {
        let light = Environment::from_fn(16, |d| [0.4 + 0.3 * d.z, 1.0 + 0.6 * d.x, 0.2 + 0.1 * d.y].map(|v: f64| v.max(0.0)));
        let (probe, rng) = (Probe::given(32, &light), Rng::new(5, 0));
        let colors: Vec<[f32; 3]> = (0..10).map(|v| if v % 2 == 0 { [0.5, 0.6, 0.15] } else { [0.4, 0.5, 0.2] }).collect();
        let metal = Metal { is_metal: vec![true; 10], colors, roughness: vec![0.4; 10] };
        let (n, each) = (400, 40);
        let unit = |of: [u64; 3]| Vec3::from(of.map(|k| rng.normal(k))).normalize();
        let normals: Vec<Vec3> = (0..n as u64).map(|i| unit([6 * i, 6 * i + 1, 6 * i + 2])).collect();
        let views = (0..n as u64).map(|i| (normals[i as usize] + 0.6 * unit([6 * i + 3, 6 * i + 4, 6 * i + 5])).normalize());
        let mut rows = Rows {
            vertex: (0..10).collect(),
            ranges: (0..10).map(|v| v * each..(v + 1) * each).collect(),
            normal: normals.iter().flat_map(|v| v.to_array()).collect(),
            view: views.flat_map(|v| v.to_array()).collect(),
            color: Vec::new(),
        };
        let want = [1.6, 1.5, 2.0];
        let kd: Vec<f32> = (0..n).flat_map(|i| [0, 1, 2].map(|k| want[k] * metal.colors[i / each][k])).collect();
        let ks = [0.0, 0.4, 1.0].repeat(n);
        let exact = probe.shade(&Points { normal: &rows.normal, view: &rows.view, kd: &kd, ks: &ks }, None).color;
        rows.color = exact.as_chunks::<3>().0.iter().map(|c| c.map(|c| c.min(1.0))).collect();
        let clipped = rows.color.iter().filter(|c| c[1] >= CLIPPED).count();
        assert!((20..200).contains(&clipped), "{clipped} of {n} are clipped");
        rows.color[..each].fill([0.05; 3]);
        let found = metal.factor(&probe, &rows).unwrap();
        assert!((0..3).all(|k| (found[k] / want[k] - 1.0).abs() < 0.03), "{found:?}");
        (rows.ranges, rows.color) = (vec![0..10, 10..20], rows.color[..20].to_vec());
        rows.vertex.truncate(2);
        assert!(metal.factor(&probe, &rows).is_none(), "too little is seen");
    }

    #[test]
    fn a_few_wrong_colors_are_not_the_brightest() {
        let colors = (0..40).map(|i| [if i < 3 { 9.0 } else { 0.01 * i as f32 }, 0.1, 0.1]).collect();
        let metal = Metal { is_metal: (0..40).map(|i| i != 39).collect(), colors, roughness: vec![0.5; 40] };
        assert!((0.3..0.39).contains(&metal.brightest()), "{}", metal.brightest());
    }

    #[test]
    fn clipped_sightings_and_wrong_directions_leave_the_balance() {
        // Mirrored light that is seen in another order than it is expected, some of it brighter than white.
        let expected = |i: usize| 0.02 * i as f32;
        let sightings: Vec<[f32; 3]> = (0..60).map(|i| [expected(i), 0.01, (0.01 + 1.7 * expected((7 * i + 3) % 60)).min(1.0)]).collect();
        let f = balance(&sightings);
        assert!((f - 1.7).abs() < 0.01, "{f}");
    }

    #[test]
    fn half_of_the_weights_lie_below_the_median() {
        assert_eq!(median(vec![(3.0, 1), (1.0, 2), (2.0, 2), (9.0, 1)]), 2.0);
        assert_eq!(median(vec![(3.0, 5), (1.0, 2), (2.0, 2)]), 3.0);
        assert_eq!(median(Vec::new()), 1.0);
    }

    #[test]
    fn middling_metalness_is_metal_where_it_is_bright() {
        let texel = |color: f32, metalness: f32| [color, color, color, 0.0, 0.3, metalness, 0.0, 0.0, 1.0];
        let sure = [texel(1.4, 0.9), texel(1.0, 0.8), texel(0.2, 0.7), texel(0.5, 0.1)];
        let of = Classifier::of(&sure);
        let is = |color, metalness| of.is_metal(&texel(color, metalness));
        assert!(is(0.2, 0.7) && is(0.6, 0.4) && !is(0.4, 0.4) && !is(0.9, 0.2));
        assert!(!Classifier::of(&sure[3..]).is_metal(&texel(3.0, 0.5)), "nothing is surely metal");
    }
}
