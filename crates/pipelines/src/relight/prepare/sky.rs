//! The sky in a photograph, found without learned weights: bright, blue and smooth pixels at the top begin a model of its colors, which is
//! refined with a model of the rest in turn. Points of the place tell what is no sky, and so does the horizon.

use diorama_geom::ImageU8;
use diorama_geom::glam::{DMat3, DVec2, DVec3};
use diorama_geom::image::box_means;

/// Longer side in pixels at which the sky is looked for.
const WORKING: usize = 320;
/// What a pixel is told by: color, texture, height in the picture.
const FEATURES: usize = 5;
/// Scale of texture and height beside color, and the deviation of brightness that counts as none.
const TEXTURE: f64 = 0.15;
const HEIGHT: f64 = 0.25;
const SMOOTH: f64 = 0.004;
/// Gaussians of the sky's model and of that of the rest, their least variance, and pixels that they are fitted to.
const GAUSSIANS: usize = 3;
const LEAST_VARIANCE: f64 = 4e-4;
const FITTED: usize = 6000;
/// Rounds of the refinement, those of each fit, and the share of changed pixels below which it has settled.
const ROUNDS: usize = 8;
const MEANS: usize = 10;
const FITS: usize = 8;
const SETTLED: f64 = 1e-3;
/// Log odds that count as certain, and the radius and regularizer of the guided filter (He et al. 2010) through which they pass.
const CERTAIN: f64 = 10.0;
const GUIDED: (usize, f64) = (6, 1e-4);
/// Gradient of color that the sky does not have, and pixels by which it then grows back to its border.
const BORDER: f64 = 0.15;
const REGROWN: usize = 2;
/// Radius in pixels around a point of the place that is no sky.
const AROUND_POINT: isize = 2;
/// Density of points of the place in what seems to be sky, over that of the whole picture, beyond which the photograph shows none.
const POINTS_IN_SKY: f64 = 0.3;
/// Fewest points and the least share of the picture that tell anything.
const FEWEST: usize = 20;
const LEAST: f64 = 0.003;

/// What is known of a photograph apart from its colors.
pub struct Known<'a> {
    /// Pixels that show points of the place.
    pub points: &'a [DVec2],
    /// Whether the ray of a pixel rises above the horizon.
    pub rises: &'a dyn Fn(DVec2) -> bool,
}

/// Which pixels of a photograph show sky, at its own size.
pub fn find(photo: &ImageU8, known: &Known) -> Vec<bool> {
    let by = (WORKING as f64 / photo.width.max(photo.height) as f64).min(1.0);
    let side = |n: usize| ((n as f64 * by).round() as usize).max(8);
    let small = photo.downsampled(side(photo.width), side(photo.height));
    let (w, h) = (small.width, small.height);
    let scale = DVec2::new(photo.width as f64 / w as f64, photo.height as f64 / h as f64);
    let picture = Picture::new(&small);
    let mut open: Vec<bool> = (0..w * h).map(|i| (known.rises)(scale * (DVec2::new((i % w) as f64, (i / w) as f64) + 0.5))).collect();
    let at: Vec<(isize, isize)> = known.points.iter().map(|p| ((p.x / scale.x) as isize, (p.y / scale.y) as isize)).collect();
    let is_sky = picture.refined(picture.begun(&open), &open);
    let inside = at.iter().filter(|(x, y)| picture.index(*x, *y).is_some_and(|i| is_sky[i])).count();
    let area = share(&is_sky);
    if area < LEAST || at.len() >= FEWEST && inside as f64 > POINTS_IN_SKY * area * at.len() as f64 {
        return vec![false; photo.width * photo.height];
    }
    for (x, y) in at {
        let around = (-AROUND_POINT..=AROUND_POINT).flat_map(|dy| (-AROUND_POINT..=AROUND_POINT).map(move |dx| (x + dx, y + dy)));
        around.filter_map(|(x, y)| picture.index(x, y)).for_each(|i| open[i] = false);
    }
    let is_sky = picture.bordered(&picture.refined(is_sky, &open));
    (0..photo.width * photo.height)
        .map(|i| {
            let (x, y) = ((i % photo.width) as f64 / scale.x, (i / photo.width) as f64 / scale.y);
            is_sky[(y as usize).min(h - 1) * w + (x as usize).min(w - 1)]
        })
        .collect()
}

fn share(mask: &[bool]) -> f64 {
    mask.iter().filter(|v| **v).count() as f64 / mask.len().max(1) as f64
}

/// A small photograph and what its pixels are told by.
struct Picture {
    w: usize,
    h: usize,
    colors: Vec<DVec3>,
    features: Vec<[f64; FEATURES]>,
}

impl Picture {
    fn new(photo: &ImageU8) -> Picture {
        let (w, h, c) = (photo.width, photo.height, photo.channels);
        let color = |p: &[u8]| DVec3::from([0, 1, 2].map(|k| p[if c >= 3 { k } else { 0 }] as f64 / 255.0));
        let colors: Vec<DVec3> = photo.data.chunks_exact(c).map(color).collect();
        let gray: Vec<f64> = colors.iter().map(|c| luma(*c)).collect();
        let squares: Vec<f64> = gray.iter().map(|g| g * g).collect();
        let (mean, mean_square) = (box_means(&gray, w, h, 2), box_means(&squares, w, h, 2));
        let texture = mean.iter().zip(&mean_square).map(|(m, s)| (s - m * m).max(0.0).sqrt());
        let features = colors.iter().zip(texture).enumerate().map(|(i, (c, t))| {
            let y = (i / w) as f64 / (h - 1) as f64;
            [c.x, c.y, c.z, TEXTURE * (t + SMOOTH).ln(), HEIGHT * y]
        });
        Picture { w, h, features: features.collect(), colors }
    }

    fn index(&self, x: isize, y: isize) -> Option<usize> {
        ((0..self.w as isize).contains(&x) && (0..self.h as isize).contains(&y)).then_some(y as usize * self.w + x as usize)
    }

    /// The upper of the two classes into which brightness, blue, smoothness and height part the pixels best (Otsu 1979).
    fn begun(&self, open: &[bool]) -> Vec<bool> {
        let standard = |of: &dyn Fn(&DVec3) -> f64| -> Vec<f64> {
            let values: Vec<f64> = self.colors.iter().map(of).collect();
            let mut sorted = values.clone();
            sorted.sort_by(f64::total_cmp);
            let (median, n) = (sorted[sorted.len() / 2], values.len() as f64);
            let mean = values.iter().sum::<f64>() / n;
            let deviation = (values.iter().map(|v| (v - mean) * (v - mean)).sum::<f64>() / n).sqrt();
            values.into_iter().map(|v| (v - median) / (deviation + 1e-3)).collect()
        };
        let (bright, blue) = (standard(&|c| luma(*c)), standard(&|c| c.z - c.x));
        let score: Vec<f64> = (0..self.colors.len())
            .map(|i| {
                let (texture, height) = (self.features[i][3] / TEXTURE, self.features[i][4] / HEIGHT);
                bright[i] + 0.7 * blue[i] - 0.7 * texture + 4.0 * (0.5 - height)
            })
            .collect();
        let score = self.guided(&score, 4, 1e-3);
        let mut sorted = score.clone();
        sorted.sort_by(f64::total_cmp);
        let (n, total) = (sorted.len(), sorted.iter().sum::<f64>());
        let (mut below, mut best) = (0.0, (0.0, sorted[n - 1]));
        for (i, v) in sorted.iter().enumerate() {
            if i > n / 50 && i < n - n / 50 {
                let apart = below / i as f64 - (total - below) / (n - i) as f64;
                let between = i as f64 * (n - i) as f64 * apart * apart;
                if between > best.0 {
                    best = (between, *v);
                }
            }
            below += v;
        }
        self.connected(score.iter().zip(open).map(|(s, o)| *s > best.1 && *o).collect())
    }

    /// Fits the colors of the sky and of the rest, and tells both apart by them, in turn.
    fn refined(&self, mut is_sky: Vec<bool>, open: &[bool]) -> Vec<bool> {
        for _ in 0..ROUNDS {
            let (Some(sky), Some(rest)) = (self.mixture(&is_sky, true), self.mixture(&is_sky, false)) else { break };
            let odds: Vec<f64> = self.features.iter().map(|f| ((sky.density(f) - rest.density(f)) / CERTAIN).clamp(-1.0, 1.0)).collect();
            let smooth = self.guided(&odds, GUIDED.0, GUIDED.1);
            let next = self.connected(smooth.iter().zip(open).map(|(v, o)| *v > 0.0 && *o).collect());
            let changed = next.iter().zip(&is_sky).filter(|(a, b)| a != b).count();
            is_sky = next;
            if (changed as f64) < SETTLED * is_sky.len() as f64 {
                break;
            }
        }
        is_sky
    }

    /// What of a mask hangs together with the upper border of the picture.
    fn connected(&self, mask: Vec<bool>) -> Vec<bool> {
        let mut out = vec![false; mask.len()];
        let mut open: Vec<usize> = (0..self.w).filter(|i| mask[*i]).collect();
        open.iter().for_each(|i| out[*i] = true);
        while let Some(i) = open.pop() {
            for j in self.around(i) {
                if mask[j] && !out[j] {
                    out[j] = true;
                    open.push(j);
                }
            }
        }
        out
    }

    fn around(&self, i: usize) -> impl Iterator<Item = usize> + '_ {
        let (x, y) = ((i % self.w) as isize, (i / self.w) as isize);
        [(1, 0), (-1, 0), (0, 1), (0, -1)].into_iter().filter_map(move |(dx, dy)| self.index(x + dx, y + dy))
    }

    /// Takes out what only hangs together with the sky across an edge.
    fn bordered(&self, is_sky: &[bool]) -> Vec<bool> {
        let smooth: [Vec<f64>; 3] =
            std::array::from_fn(|k| box_means(&self.colors.iter().map(|c| c[k]).collect::<Vec<_>>(), self.w, self.h, 1));
        let gradient = |i: usize| -> f64 {
            let (x, y) = ((i % self.w) as isize, (i / self.w) as isize);
            let at = |dx: isize, dy: isize| {
                let (x, y) = ((x + dx).clamp(0, self.w as isize - 1), (y + dy).clamp(0, self.h as isize - 1));
                y as usize * self.w + x as usize
            };
            let (l, r, u, d) = (at(-1, 0), at(1, 0), at(0, -1), at(0, 1));
            smooth.iter().map(|s| (s[r] - s[l]).powi(2) + (s[d] - s[u]).powi(2)).sum::<f64>().sqrt()
        };
        let mut out = self.connected((0..is_sky.len()).map(|i| is_sky[i] && gradient(i) < BORDER).collect());
        for _ in 0..REGROWN {
            let grown: Vec<usize> = (0..out.len()).filter(|i| !out[*i] && is_sky[*i] && self.around(*i).any(|j| out[j])).collect();
            grown.into_iter().for_each(|i| out[i] = true);
        }
        out
    }

    /// Guided filter of values by the colors.
    fn guided(&self, values: &[f64], radius: usize, regularizer: f64) -> Vec<f64> {
        let mean = |of: &dyn Fn(usize) -> f64| box_means(&(0..values.len()).map(of).collect::<Vec<_>>(), self.w, self.h, radius);
        let color: [Vec<f64>; 3] = std::array::from_fn(|k| mean(&|i| self.colors[i][k]));
        let cross: [Vec<f64>; 3] = std::array::from_fn(|k| mean(&|i| self.colors[i][k] * values[i]));
        let squares: [[Vec<f64>; 3]; 3] =
            std::array::from_fn(|j| std::array::from_fn(|k| mean(&|i| self.colors[i][j] * self.colors[i][k])));
        let value = mean(&|i| values[i]);
        let lines: Vec<(DVec3, f64)> = (0..values.len())
            .map(|i| {
                let c = DVec3::from([0, 1, 2].map(|k| color[k][i]));
                let column = |k: usize| DVec3::from([0, 1, 2].map(|j| squares[j][k][i] - c[j] * c[k]));
                let covariance = DMat3::from_cols(column(0), column(1), column(2)) + DMat3::from_diagonal(DVec3::splat(regularizer));
                let slope = covariance.inverse() * (DVec3::from([0, 1, 2].map(|k| cross[k][i])) - c * value[i]);
                (slope, value[i] - slope.dot(c))
            })
            .collect();
        let slopes: [Vec<f64>; 3] = std::array::from_fn(|k| mean(&|i| lines[i].0[k]));
        let offsets = mean(&|i| lines[i].1);
        (0..values.len()).map(|i| (0..3).map(|k| slopes[k][i] * self.colors[i][k]).sum::<f64>() + offsets[i]).collect()
    }

    /// Gaussians fitted to the pixels that are sky, or to the others, by expectation maximization; none where there are too few.
    fn mixture(&self, is_sky: &[bool], of: bool) -> Option<Mixture> {
        let all: Vec<&[f64; FEATURES]> = self.features.iter().zip(is_sky).filter(|(_, s)| **s == of).map(|(f, _)| f).collect();
        let x: Vec<[f64; FEATURES]> = all.iter().step_by(all.len().div_ceil(FITTED).max(1)).map(|f| **f).collect();
        (x.len() > 10 * GAUSSIANS).then(|| Mixture::fitted(&x))
    }
}

fn luma(c: DVec3) -> f64 {
    c.dot(DVec3::new(0.299, 0.587, 0.114))
}

/// A weighted sum of Gaussians.
struct Mixture(Vec<Gaussian>);

struct Gaussian {
    log_weight: f64,
    mean: [f64; FEATURES],
    /// Lower triangle of the covariance's Cholesky factor.
    factor: [[f64; FEATURES]; FEATURES],
}

impl Gaussian {
    /// Of points, each as far as it belongs.
    fn of(x: &[[f64; FEATURES]], belongs: &dyn Fn(usize) -> f64) -> Gaussian {
        let (mut n, mut mean, mut a) = (1e-9, [0.0; FEATURES], [[0.0; FEATURES]; FEATURES]);
        for (i, p) in x.iter().enumerate() {
            n += belongs(i);
            (0..FEATURES).for_each(|k| mean[k] += belongs(i) * p[k]);
        }
        mean.iter_mut().for_each(|m| *m /= n);
        for (i, p) in x.iter().enumerate() {
            let d: [f64; FEATURES] = std::array::from_fn(|k| p[k] - mean[k]);
            (0..FEATURES).for_each(|j| (0..=j).for_each(|k| a[j][k] += belongs(i) * d[j] * d[k] / n));
        }
        (0..FEATURES).for_each(|k| a[k][k] += LEAST_VARIANCE);
        let mut factor = [[0.0; FEATURES]; FEATURES];
        for j in 0..FEATURES {
            for k in 0..=j {
                let rest: f64 = a[j][k] - (0..k).map(|i| factor[j][i] * factor[k][i]).sum::<f64>();
                factor[j][k] = if j == k { rest.sqrt() } else { rest / factor[k][k] };
            }
        }
        Gaussian { log_weight: (n / x.len() as f64).ln(), mean, factor }
    }

    /// Logarithm of weight times density, but for a constant.
    fn density(&self, p: &[f64; FEATURES]) -> f64 {
        let (mut z, mut out) = ([0.0; FEATURES], self.log_weight);
        for j in 0..FEATURES {
            let below: f64 = (0..j).map(|k| self.factor[j][k] * z[k]).sum();
            z[j] = (p[j] - self.mean[j] - below) / self.factor[j][j];
            out -= 0.5 * z[j] * z[j] + self.factor[j][j].ln();
        }
        out
    }
}

impl Mixture {
    fn fitted(x: &[[f64; FEATURES]]) -> Mixture {
        // The means begin at pixels of the lowest, the middle and the highest part of the picture.
        let mut means: Vec<[f64; FEATURES]> = (0..GAUSSIANS).map(|k| x[(2 * k + 1) * x.len() / (2 * GAUSSIANS)]).collect();
        let mut nearest = vec![0; x.len()];
        for _ in 0..MEANS {
            let squared = |p: &[f64; FEATURES], m: &[f64; FEATURES]| p.iter().zip(m).map(|(a, b)| (a - b) * (a - b)).sum::<f64>();
            for (n, p) in nearest.iter_mut().zip(x) {
                *n = (0..GAUSSIANS).min_by(|a, b| squared(p, &means[*a]).total_cmp(&squared(p, &means[*b]))).expect("some");
            }
            for (k, mean) in means.iter_mut().enumerate() {
                let own: Vec<&[f64; FEATURES]> = x.iter().zip(&nearest).filter(|(_, n)| **n == k).map(|(p, _)| p).collect();
                if !own.is_empty() {
                    *mean = std::array::from_fn(|f| own.iter().map(|p| p[f]).sum::<f64>() / own.len() as f64);
                }
            }
        }
        let mut mixture = Mixture((0..GAUSSIANS).map(|k| Gaussian::of(x, &|i| (nearest[i] == k) as u8 as f64)).collect());
        for _ in 0..FITS {
            let belongs: Vec<[f64; GAUSSIANS]> = x
                .iter()
                .map(|p| {
                    let all = mixture.density(p);
                    std::array::from_fn(|k| (mixture.0[k].density(p) - all).exp())
                })
                .collect();
            mixture = Mixture((0..GAUSSIANS).map(|k| Gaussian::of(x, &|i| belongs[i][k])).collect());
        }
        mixture
    }

    fn density(&self, p: &[f64; FEATURES]) -> f64 {
        let each: [f64; GAUSSIANS] = std::array::from_fn(|k| self.0[k].density(p));
        let most = each.iter().copied().fold(f64::MIN, f64::max);
        most + each.iter().map(|v| (v - most).exp()).sum::<f64>().ln()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_geom::rng::Rng;

    /// A gray building with windows before a bluish sky with noise, the building's top as a share of the height.
    fn street(top: f64) -> ImageU8 {
        let (w, h) = (160, 120);
        let rng = Rng::new(3, 3);
        let data = (0..w * h).flat_map(|i| {
            let (x, y) = (i % w, i / w);
            let is_building = (40..120).contains(&x) && y as f64 > top * h as f64 || y > 90;
            let noise = (8.0 * rng.normal(i as u64)) as i32;
            let base: [i32; 3] = match (is_building, (x / 8 + y / 8) % 2) {
                (false, _) => [150 + y as i32 / 3, 180 + y as i32 / 4, 225],
                (true, 0) => [110, 105, 95],
                (true, _) => [150, 140, 120],
            };
            base.map(|v| (v + if is_building { noise } else { noise / 4 }).clamp(0, 255) as u8)
        });
        ImageU8 { width: w, height: h, channels: 3, data: data.collect() }
    }

    fn is_building(i: usize, top: f64) -> bool {
        let (x, y) = (i % 160, i / 160);
        (40..120).contains(&x) && y as f64 > top * 120.0 || y > 90
    }

    #[test]
    fn the_sky_is_found_around_a_building_of_any_height() {
        for top in [0.3, 0.0] {
            let found = find(&street(top), &Known { points: &[], rises: &|_| true });
            let wrong = (0..found.len()).filter(|i| found[*i] == is_building(*i, top)).count();
            assert!(wrong < found.len() / 50, "top {top}: {wrong} of {} pixels are wrong", found.len());
        }
    }

    #[test]
    fn points_and_the_horizon_say_what_is_no_sky() {
        let photo = street(0.3);
        // A smooth wall at the top of the picture on which points were found everywhere.
        let points: Vec<DVec2> = (0..200).map(|i| DVec2::new((i * 37 % 160) as f64, (i * 11 % 60) as f64)).collect();
        assert!(!find(&photo, &Known { points: &points, rises: &|_| true }).contains(&true));
        let found = find(&photo, &Known { points: &[], rises: &|p| p.x < 80.0 });
        assert!((0..found.len()).all(|i| !found[i] || i % 160 < 80) && share(&found) > 0.1);
        // Few points on the building leave the sky as it is.
        let points: Vec<DVec2> = (0..100).map(|i| DVec2::new(45.0 + (i % 70) as f64, 60.0 + (i % 40) as f64)).collect();
        assert!(share(&find(&photo, &Known { points: &points, rises: &|_| true })) > 0.3);
    }
}
