//! Distant light as the path tracer draws from it: an environment map in proportion to its radiance (Pharr, Jakob and Humphreys 2023,
//! section 12.5), and the sun's disc.

use super::vector::{V3, along, arc_cosine, dot, frame, luminance, scale, sin_cos_turns, sub, turns_of};
use diorama_geom::daylight::Daylight;
use std::f32::consts::PI;

/// Share of draws that either light gets at least where there are two.
const LEAST: f32 = 0.1;

/// Light from all directions, and how it is drawn.
#[derive(Clone, Debug)]
pub struct DistantLight {
    width: usize,
    height: usize,
    /// Linear radiance, scaled by the strength, and density per steradian of drawing from the map, `[H, W]`.
    texels: Vec<[f32; 4]>,
    /// Angle by which sources are turned, in turns.
    turn: f32,
    rows: Steps,
    columns: Vec<Steps>,
    /// Cosine of the polar angle at the upper edge of each row, and at the lower one of the last, `[H + 1]`.
    edges: Vec<f32>,
    sun: Option<Disc>,
    /// Probability of drawing from the sun.
    sun_share: f32,
}

/// The sun's disc.
#[derive(Clone, Copy, Debug)]
struct Disc {
    direction: V3,
    /// `1 − cos` of its angular radius.
    cap: f32,
    radiance: V3,
    density: f32,
}

impl Disc {
    #[inline(always)]
    fn contains(&self, direction: V3) -> bool {
        // The squared chord is `2 (1 − cos)`, without cancellation.
        let chord = sub(self.direction, direction);
        dot(chord, chord) <= 2.0 * self.cap
    }
}

/// A direction toward light.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Drawn {
    pub direction: V3,
    /// Linear radiance from there.
    pub radiance: V3,
    /// Density per steradian with which [`DistantLight::draw`] draws it.
    pub density: f32,
}

/// A distribution that is constant within equal intervals, and for equal shares of it the interval to search from.
#[derive(Clone, Debug)]
struct Steps {
    /// Sums before each interval, from 0 to 1.
    sums: Vec<f32>,
    guide: Vec<u32>,
}

impl Steps {
    /// Even if all weights are 0.
    fn new(weights: &[f64]) -> Steps {
        let n = weights.len();
        let total: f64 = weights.iter().sum();
        let mut sums = vec![0.0f32; n + 1];
        let mut sum = 0.0;
        for (i, w) in weights.iter().enumerate() {
            sum += if total > 0.0 { w / total } else { 1.0 / n as f64 };
            sums[i + 1] = sum.min(1.0) as f32;
        }
        sums[n] = 1.0;
        let mut guide = vec![0; n];
        let mut at = 0;
        for (i, g) in guide.iter_mut().enumerate() {
            while at + 1 < n && sums[at + 1] <= i as f32 / n as f32 {
                at += 1;
            }
            *g = at as u32;
        }
        Steps { sums, guide }
    }

    #[inline(always)]
    fn share(&self, i: usize) -> f32 {
        self.sums[i + 1] - self.sums[i]
    }

    /// The interval that a number in `[0, 1)` falls into, and where in it.
    #[inline(always)]
    fn find(&self, random: f32) -> (usize, f32) {
        let n = self.guide.len();
        let k = ((random * n as f32) as usize).min(n - 1);
        let (mut i, mut last) = (self.guide[k] as usize, self.guide.get(k + 1).map_or(n - 1, |g| *g as usize));
        while i < last {
            let middle = (i + last) / 2;
            (i, last) = if self.sums[middle + 1] <= random { (middle + 1, last) } else { (i, middle) };
        }
        let size = self.share(i);
        (i, if size > 0.0 { ((random - self.sums[i]) / size).clamp(0.0, 1.0) } else { 0.5 })
    }
}

impl DistantLight {
    pub fn new(light: &Daylight) -> DistantLight {
        let environment = &light.environment;
        let image = environment.image();
        let (width, height) = (image.width, image.height);
        let strength = environment.strength as f32;
        let radiance: Vec<V3> = image.data.chunks_exact(3).map(|p| [p[0] * strength, p[1] * strength, p[2] * strength]).collect();
        let lum = |x: usize, y: usize| luminance(radiance[y * width + x]) as f64;
        // Radiance is bilinear between pixels, so a dark pixel beside a bright one gives light too.
        let weight = |x: usize, y: usize| -> f64 {
            let beside = [(x + width - 1) % width, x, (x + 1) % width];
            let rows = [y.saturating_sub(1), y, (y + 1).min(height - 1)];
            rows.iter().flat_map(|y| beside.iter().map(|x| lum(*x, *y))).sum()
        };
        let mut weights = vec![0.0; width * height];
        let (mut row_weights, mut columns) = (Vec::with_capacity(height), Vec::with_capacity(height));
        for (y, row) in weights.chunks_exact_mut(width).enumerate() {
            row.iter_mut().enumerate().for_each(|(x, w)| *w = weight(x, y));
            row_weights.push(row.iter().sum::<f64>() * environment.solid_angle(y));
            columns.push(Steps::new(row));
        }
        if row_weights.iter().sum::<f64>() == 0.0 {
            row_weights = (0..height).map(|y| environment.solid_angle(y)).collect();
        }
        let rows = Steps::new(&row_weights);
        let sun = light.sun.map(|s| {
            let solid_angle = s.solid_angle();
            Disc {
                direction: [s.direction.x as f32, s.direction.y as f32, s.direction.z as f32],
                cap: (solid_angle / std::f64::consts::TAU) as f32,
                radiance: s.irradiance.map(|e| (e / solid_angle) as f32),
                density: (1.0 / solid_angle) as f32,
            }
        });
        let from_map: f64 = (0..width * height).map(|i| lum(i % width, i / width) * environment.solid_angle(i / width)).sum();
        let sun_share = light.sun.map_or(0.0, |s| {
            let from_sun = luminance(s.irradiance.map(|e| e as f32));
            let share = from_sun / (from_sun + from_map as f32);
            if from_map > 0.0 { share.clamp(LEAST, 1.0 - LEAST) } else { 1.0 }
        });
        let texels = (0..width * height)
            .map(|i| {
                let share = rows.share(i / width) * columns[i / width].share(i % width);
                let [r, g, b] = radiance[i];
                [r, g, b, share * (1.0 - sun_share) / environment.solid_angle(i / width) as f32]
            })
            .collect();
        let edges = (0..=height).map(|y| (std::f64::consts::PI * y as f64 / height as f64).cos() as f32).collect();
        let turn = (environment.turn / std::f64::consts::TAU) as f32;
        DistantLight { width, height, texels, turn, rows, columns, edges, sun, sun_share }
    }

    /// Draws a direction from the sun's disc.
    #[inline(always)]
    pub fn draw_sun(&self, random: [f32; 2]) -> Option<V3> {
        self.sun.map(|sun| {
            let cosine = 1.0 - random[0] * sun.cap;
            let sine = (random[0] * sun.cap * (1.0 + cosine)).sqrt();
            let [s, t, n] = frame(sun.direction);
            let [y, x] = sin_cos_turns(random[1]);
            along(along(scale(n, cosine), sine * x, s), sine * y, t)
        })
    }

    /// Draws a direction from two numbers in `[0, 1)`.
    #[inline(always)]
    pub fn draw(&self, random: [f32; 2]) -> Drawn {
        let [mut a, b] = random;
        let is_sun = a < self.sun_share;
        a = if is_sun { a / self.sun_share } else { (a - self.sun_share) / (1.0 - self.sun_share) };
        match self.draw_sun([a, b]) {
            Some(direction) if is_sun => {
                let (radiance, density) = self.evaluate(direction);
                Drawn { direction, radiance, density }
            }
            _ => self.draw_map([a, b]),
        }
    }

    #[inline(always)]
    fn draw_map(&self, random: [f32; 2]) -> Drawn {
        let (y, fy) = self.rows.find(random[0]);
        let (x, fx) = self.columns[y].find(random[1]);
        // Even in solid angle, not in the polar angle.
        let z = self.edges[y] + fy * (self.edges[y + 1] - self.edges[y]);
        let sine = (1.0 - z * z).max(0.0).sqrt();
        let (column, row) = (x as f32 + fx, arc_cosine(z) / PI * self.height as f32);
        let [right, ahead] = sin_cos_turns(column / self.width as f32 - 0.5 - self.turn);
        let direction = [sine * right, sine * ahead, z];
        let (radiance, density) = self.with_sun(direction, self.bilinear(column, row, (x, y)));
        Drawn { direction, radiance, density }
    }

    /// Linear radiance from a direction of length 1, and the density per steradian with which it is drawn.
    #[inline(always)]
    pub fn evaluate(&self, direction: V3) -> (V3, f32) {
        let u = 0.5 + turns_of(direction[0], direction[1]) + self.turn;
        let v = arc_cosine(direction[2]) / PI;
        let (x, y) = ((u - u.floor()) * self.width as f32, v * self.height as f32);
        let (column, row) = ((x as usize).min(self.width - 1), (y as usize).min(self.height - 1));
        self.with_sun(direction, self.bilinear(x, y, (column, row)))
    }

    /// Adds the sun's radiance and density where a direction points into it.
    #[inline(always)]
    fn with_sun(&self, direction: V3, (radiance, density): (V3, f32)) -> (V3, f32) {
        match &self.sun {
            Some(sun) if sun.contains(direction) => (along(radiance, 1.0, sun.radiance), density + sun.density * self.sun_share),
            _ => (radiance, density),
        }
    }

    /// Radiance at pixel coordinates, and the density of the pixel that they lie in.
    #[inline(always)]
    fn bilinear(&self, x: f32, y: f32, (column, row): (usize, usize)) -> (V3, f32) {
        let (x, y) = (x - 0.5, y - 0.5);
        let (left, top) = (x.floor(), y.floor());
        let (fx, fy) = (x - left, y - top);
        let (left, top) = (left as isize, top as isize);
        let wrapped = |c: isize| {
            if c < 0 {
                self.width - 1
            } else if c as usize >= self.width {
                0
            } else {
                c as usize
            }
        };
        let columns = [wrapped(left), wrapped(left + 1)];
        let rows = [top, top + 1].map(|r| r.clamp(0, self.height as isize - 1) as usize * self.width);
        let p = |r: usize, c: usize| &self.texels[rows[r] + columns[c]];
        let [a, b, c, d] = [p(0, 0), p(0, 1), p(1, 0), p(1, 1)];
        let radiance = std::array::from_fn(|k| (1.0 - fy) * (a[k] * (1.0 - fx) + b[k] * fx) + fy * (c[k] * (1.0 - fx) + d[k] * fx));
        (radiance, self.texels[row * self.width + column][3])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_geom::daylight::Sun;
    use diorama_geom::environment::Environment;
    use diorama_geom::glam::{DVec2, DVec3};

    /// A dim sky, a small bright lamp, a black ground, and perhaps a sun.
    fn light(with_sun: bool) -> Daylight {
        let lamp = DVec3::new(0.3, 0.5, 0.6).normalize();
        let mut environment = Environment::from_fn(32, |d| match d.z {
            z if z < 0.0 => [0.0; 3],
            _ if d.dot(lamp) > 0.99 => [400.0, 300.0, 200.0],
            z => [0.2, 0.4, 1.0 - 0.5 * z],
        });
        (environment.turn, environment.strength) = (0.7, 1.3);
        let sun = Sun { direction: DVec3::new(-0.6, 0.0, 0.8), diameter: 0.02, irradiance: [9.0, 8.0, 7.0] };
        Daylight { environment, sun: with_sun.then_some(sun) }
    }

    fn random(n: usize) -> impl Iterator<Item = [f32; 2]> {
        (0..n).map(move |i| [((i as f64 + 0.5) / n as f64) as f32, (0.5 + 0.618_033_988_749_895 * i as f64).fract() as f32])
    }

    #[test]
    fn densities_are_those_of_the_draws() {
        let black = Daylight::of(Environment::uniform([0.0; 3], 8));
        for daylight in [light(false), light(true), black, Daylight::of(Environment::uniform([2.0; 3], 1))] {
            let light = DistantLight::new(&daylight);
            let n = 200_000;
            // The mean of 1 / density over the draws is the solid angle that they cover.
            let covered: f64 = random(n).map(|r| 1.0 / light.draw(r).density as f64).sum::<f64>() / n as f64;
            let lit: f64 = (0..light.height * light.width)
                .filter(|i| light.texels[*i][3] > 0.0)
                .map(|i| daylight.environment.solid_angle(i / light.width))
                .sum();
            assert!((covered / lit - 1.0).abs() < 0.02, "{covered} {lit}");
            for r in random(500) {
                let drawn = light.draw(r);
                let d = drawn.direction;
                assert!((dot(d, d) - 1.0).abs() < 1e-5 && drawn.density > 0.0);
            }
        }
    }

    #[test]
    fn few_draws_give_the_irradiance() {
        for with_sun in [false, true] {
            let daylight = light(with_sun);
            let light = DistantLight::new(&daylight);
            for k in 0..3 {
                let mut want = daylight.sun.map_or(0.0, |s| s.irradiance[k] * s.direction.z);
                // Ten times finer than the pixels.
                let (w, h) = (640, 320);
                for i in 0..w * h {
                    let uv = DVec2::new((i % w) as f64 + 0.5, (i / w) as f64 + 0.5) / DVec2::new(w as f64, h as f64);
                    let edge = |row: usize| (std::f64::consts::PI * row as f64 / h as f64).cos();
                    let d = daylight.environment.direction(uv);
                    let solid_angle = (edge(i / w) - edge(i / w + 1)) * std::f64::consts::TAU / w as f64;
                    want += daylight.environment.radiance(d)[k] * d.z.max(0.0) * solid_angle;
                }
                let n = 4000;
                let sum: f64 = random(n).map(|r| light.draw(r)).map(|d| (d.radiance[k] * d.direction[2].max(0.0) / d.density) as f64).sum();
                assert!((sum / n as f64 / want - 1.0).abs() < 0.02, "{} {want}", sum / n as f64);
            }
        }
    }

    #[test]
    fn radiance_is_the_map_s() {
        let daylight = light(false);
        let light = DistantLight::new(&daylight);
        for r in random(300) {
            let d = light.draw(r).direction;
            let (got, want) = (light.evaluate(d).0, daylight.environment.radiance(DVec3::from(d.map(f64::from))));
            assert!((0..3).all(|k| (got[k] as f64 - want[k]).abs() < 2e-2 + 1e-3 * want[k]), "{d:?} {got:?} {want:?}");
        }
    }
}
