//! GrabCut: alternates between fitting Gaussian mixtures to the colors of foreground and background, and a minimum cut (Rother, Kolmogorov
//! and Blake, "GrabCut: interactive foreground extraction using iterated graph cuts", 2004).

use super::graph_cut::{GridCut, NEIGHBOURS};
use diorama_geom::ImageU8;
use diorama_geom::glam::{Mat3, Vec3};

/// Prior label of a pixel; the cut may change only the `Maybe` labels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Seed {
    Background,
    MaybeBackground,
    MaybeForeground,
    Foreground,
}

/// Gaussians per mixture, rounds, and weight γ of the smoothness term.
const PARTS: usize = 5;
const ROUNDS: usize = 4;
const GAMMA: f32 = 50.0;
/// Integer capacity per unit of energy, and the energy of a certain seed.
const UNITS: f32 = 64.0;
const CERTAIN: f32 = 1e4;
/// Variance that is added to every Gaussian, in squared 8-bit steps.
const LEAST_VARIANCE: f32 = 4.0;

/// One weighted Gaussian; `log_weight` is `ln(share / √det covariance)`.
struct Part {
    mean: Vec3,
    inverse: Mat3,
    log_weight: f32,
}

/// Gaussian mixture over RGB colors in 8-bit steps.
struct Mixture(Vec<Part>);

impl Mixture {
    /// Fits one Gaussian to each of the `PARTS` groups of colors.
    fn fit(colors: &[Vec3], groups: &[u8]) -> Mixture {
        let fit = |k: u8| {
            let of = || colors.iter().zip(groups).filter(|c| *c.1 == k).map(|c| *c.0);
            let n = of().count();
            if n < 4 {
                return None;
            }
            let mean = of().sum::<Vec3>() / n as f32;
            let outer = |d: Vec3| Mat3::from_cols(d * d.x, d * d.y, d * d.z);
            let covariance =
                of().map(|c| outer(c - mean)).fold(Mat3::ZERO, |a, b| a + b) * (1.0 / n as f32) + Mat3::IDENTITY * LEAST_VARIANCE;
            let log_weight = (n as f32 / colors.len() as f32).ln() - 0.5 * covariance.determinant().ln();
            Some(Part { mean, inverse: covariance.inverse(), log_weight })
        };
        Mixture((0..PARTS as u8).filter_map(fit).collect())
    }

    /// Energy of a color under its likeliest Gaussian, and the index of that Gaussian.
    fn energy(&self, c: Vec3) -> (f32, u8) {
        let of = |p: &Part| 0.5 * (c - p.mean).dot(p.inverse * (c - p.mean)) - p.log_weight;
        let mut best = (f32::INFINITY, 0);
        for (k, p) in self.0.iter().enumerate() {
            let e = of(p);
            if e < best.0 {
                best = (e, k as u8);
            }
        }
        best
    }
}

/// Groups similar colors by k-means, starting from quantiles of brightness.
fn groups(colors: &[Vec3]) -> Vec<u8> {
    let mut sorted: Vec<Vec3> = colors.to_vec();
    sorted.sort_by(|a, b| a.element_sum().total_cmp(&b.element_sum()));
    let mut means: Vec<Vec3> = (0..PARTS).map(|k| sorted[(2 * k + 1) * sorted.len() / (2 * PARTS)]).collect();
    let mut out = vec![0; colors.len()];
    for _ in 0..10 {
        let nearest = |c: &Vec3| (0..PARTS).min_by(|a, b| (*c - means[*a]).length().total_cmp(&(*c - means[*b]).length())).unwrap_or(0);
        out = colors.iter().map(|c| nearest(c) as u8).collect();
        let mut sums = [(Vec3::ZERO, 0.0f32); PARTS];
        colors.iter().zip(&out).for_each(|(c, g)| {
            let s = &mut sums[*g as usize];
            *s = (s.0 + *c, s.1 + 1.0);
        });
        (0..PARTS).filter(|k| sums[*k].1 > 0.0).for_each(|k| means[k] = sums[k].0 / sums[k].1);
    }
    out
}

/// Whether each pixel is foreground. If no seed is foreground, all pixels are background, and vice versa.
pub fn grab_cut(image: &ImageU8, seeds: &[Seed]) -> Vec<bool> {
    let (w, h) = (image.width, image.height);
    let colors: Vec<Vec3> = image.data.chunks_exact(image.channels).map(|p| Vec3::new(p[0] as f32, p[1] as f32, p[2] as f32)).collect();
    let edges = borders(&colors, w, h);
    let mut inside: Vec<bool> = seeds.iter().map(|s| matches!(s, Seed::Foreground | Seed::MaybeForeground)).collect();
    for _ in 0..ROUNDS {
        let of = |side: bool| colors.iter().zip(&inside).filter(|c| *c.1 == side).map(|c| *c.0).collect::<Vec<Vec3>>();
        let (front, back) = (of(true), of(false));
        if front.len() < 16 || back.len() < 16 {
            break;
        }
        let mixture = |colors: &[Vec3]| {
            let first = Mixture::fit(colors, &groups(colors));
            // Reassign each pixel to its likeliest Gaussian and refit.
            let again: Vec<u8> = colors.iter().map(|c| first.energy(*c).1).collect();
            Mixture::fit(colors, &again)
        };
        let (front, back) = (mixture(&front), mixture(&back));
        let terminal = |(c, s): (&Vec3, &Seed)| {
            let e = match s {
                Seed::Foreground => CERTAIN,
                Seed::Background => -CERTAIN,
                _ => (back.energy(*c).0 - front.energy(*c).0).clamp(-CERTAIN, CERTAIN),
            };
            (e * UNITS) as i32
        };
        let terminals = colors.iter().zip(seeds).map(terminal).collect();
        let next = GridCut::new(w, h, edges.clone(), terminals).solve();
        let settled = next == inside;
        inside = next;
        if settled {
            break;
        }
    }
    inside
}

/// Capacity between neighbors: `γ exp(−β |Δ|²) / distance`, with `β = 1 / (2 · mean |Δ|²)`.
fn borders(colors: &[Vec3], w: usize, h: usize) -> Vec<[i32; 8]> {
    let neighbour = |i: usize, d: usize| {
        let (x, y) = ((i % w) as i32 + NEIGHBOURS[d].0, (i / w) as i32 + NEIGHBOURS[d].1);
        (x >= 0 && y >= 0 && x < w as i32 && y < h as i32).then(|| y as usize * w + x as usize)
    };
    let pairs = || (0..w * h).flat_map(|i| (4..8).filter_map(move |d| neighbour(i, d).map(|j| (i, d, j))));
    let (sum, n) = pairs().fold((0.0f64, 0.0f64), |(s, n), (i, _, j)| (s + (colors[i] - colors[j]).length_squared() as f64, n + 1.0));
    let beta = (n / (2.0 * sum).max(1e-9)) as f32;
    let mut out = vec![[0; 8]; w * h];
    for (i, d, j) in pairs() {
        let apart = if NEIGHBOURS[d].0 != 0 && NEIGHBOURS[d].1 != 0 { std::f32::consts::SQRT_2 } else { 1.0 };
        let cost = (GAMMA / apart * (-beta * (colors[i] - colors[j]).length_squared()).exp() * UNITS) as i32;
        (out[i][d], out[j][7 - d]) = (cost, cost);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_geom::rng::Rng;

    #[test]
    fn a_patterned_disc_is_cut_from_a_patterned_ground() {
        let (w, h) = (96, 72);
        let rng = Rng::new(2, 0);
        let is_disc = |x: usize, y: usize| (x as f32 - 48.0).hypot(y as f32 - 36.0) < 22.0;
        let color = |i: usize| {
            let (x, y) = (i % w, i / w);
            let n = |k: u64| (rng.uniform(i as u64 * 3 + k) * 30.0) as u8;
            match (is_disc(x, y), (x / 4 + y / 4) % 2) {
                (true, 0) => [200 + n(0), 40 + n(1), 40 + n(2)],
                (true, _) => [220 + n(0), 180 + n(1), 60 + n(2)],
                (false, 0) => [40 + n(0), 90 + n(1), 160 + n(2)],
                (false, _) => [120 + n(0), 130 + n(1), 130 + n(2)],
            }
        };
        let image = ImageU8 { width: w, height: h, channels: 3, data: (0..w * h).flat_map(color).collect() };
        let seed = |i: usize| {
            let r = ((i % w) as f32 - 48.0).hypot((i / w) as f32 - 36.0);
            match r {
                r if r < 6.0 => Seed::Foreground,
                r if r < 30.0 => Seed::MaybeForeground,
                r if r < 34.0 => Seed::MaybeBackground,
                _ => Seed::Background,
            }
        };
        let seeds: Vec<Seed> = (0..w * h).map(seed).collect();
        let found = grab_cut(&image, &seeds);
        let wrong = (0..w * h).filter(|i| found[*i] != is_disc(i % w, i / w)).count();
        assert!(wrong < w * h / 100, "{wrong} pixels");
    }

    #[test]
    fn certain_seeds_stay() {
        let image = ImageU8 { width: 8, height: 8, channels: 3, data: vec![128; 192] };
        let seeds: Vec<Seed> = (0..64).map(|i| if i < 32 { Seed::Foreground } else { Seed::Background }).collect();
        assert_eq!(grab_cut(&image, &seeds), (0..64).map(|i| i < 32).collect::<Vec<_>>());
        assert!(grab_cut(&image, &[Seed::Background; 64]).iter().all(|v| !v));
    }
}
