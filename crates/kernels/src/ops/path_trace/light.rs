//! Distant light as the path tracer draws from it: an environment map in proportion to its radiance (Pharr, Jakob and Humphreys 2023,
//! section 12.5), and the sun's disc.

use super::vector::{V3, along, arc_cosine, dot, frame, luminance, scale, sin_cos_turns, sub, turns_of};
use crate::tasks::prefetch;
use diorama_geom::daylight::Daylight;
use std::f32::consts::PI;

/// Share of draws that either light gets at least where there are two.
const LEAST: f32 = 0.1;

/// Light from all directions, and how it is drawn.
#[derive(Clone, Debug)]
pub struct DistantLight {
    pub width: usize,
    pub height: usize,
    /// Linear radiance, scaled by the strength, and density per steradian of drawing from the map, `[H, W]`.
    pub texels: Vec<[f32; 4]>,
    /// Angle by which sources are turned, in turns.
    pub turn: f32,
    /// One distribution, and one for each row.
    pub rows: Steps,
    pub columns: Steps,
    /// Cosine of the polar angle at the upper edge of each row, and at the lower one of the last, `[H + 1]`.
    pub edges: Vec<f32>,
    pub sun: Option<Disc>,
    /// Probability of drawing from the sun.
    pub sun_share: f32,
}

/// The sun's disc.
#[derive(Clone, Copy, Debug)]
pub struct Disc {
    pub direction: V3,
    /// `1 − cos` of its angular radius.
    pub cap: f32,
    pub radiance: V3,
    pub density: f32,
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

impl Drawn {
    /// No light.
    pub const NONE: Drawn = Drawn { direction: [0.0; 3], radiance: [0.0; 3], density: 0.0 };
}

/// Draws that are computed together, in lanes.
pub const LANES: usize = 32;

type Floats = [f32; LANES];
type Indices = [u32; LANES];

/// Distributions that are constant within equal intervals, and for equal shares of each the interval to search from.
#[derive(Clone, Debug)]
pub struct Steps {
    /// Intervals of each.
    n: usize,
    /// Sums before each interval, from 0 to 1, `[rows, n + 1]`.
    pub sums: Vec<f32>,
    /// `[rows, n]`
    pub guide: Vec<u32>,
}

impl Steps {
    /// Even where all weights of a row are 0.
    fn new(weights: &[f64], n: usize) -> Steps {
        let mut steps = Steps { n, sums: Vec::new(), guide: Vec::new() };
        weights.chunks_exact(n).for_each(|row| steps.push(row));
        // Room for one more step beyond the last interval.
        steps.sums.push(2.0);
        steps
    }

    fn push(&mut self, weights: &[f64]) {
        let n = self.n;
        let total: f64 = weights.iter().sum();
        let mut sums = vec![0.0f32; n + 1];
        let mut sum = 0.0;
        for (i, w) in weights.iter().enumerate() {
            sum += if total > 0.0 { w / total } else { 1.0 / n as f64 };
            sums[i + 1] = sum.min(1.0) as f32;
        }
        sums[n] = 1.0;
        let mut at = 0;
        for i in 0..n {
            while at + 1 < n && sums[at + 1] <= i as f32 / n as f32 {
                at += 1;
            }
            self.guide.push(at as u32);
        }
        self.sums.extend(sums);
    }

    fn share(&self, row: usize, i: usize) -> f32 {
        let at = row * (self.n + 1) + i;
        self.sums[at + 1] - self.sums[at]
    }

    /// Starts to fetch what [`Steps::find`] reads.
    #[inline(always)]
    fn prefetch(&self, row: usize, random: f32) {
        let bucket = ((random * self.n as f32) as usize).min(self.n - 1);
        prefetch(&self.guide[row * self.n + bucket]);
        prefetch(&self.sums[row * (self.n + 1) + bucket]);
    }

    /// The intervals that numbers in `[0, 1)` fall into in rows, and where in them.
    #[inline(always)]
    fn find(&self, rows: &Indices, random: &Floats) -> (Indices, Floats) {
        let (n, last) = (self.n as u32, self.n as u32 - 1);
        let height = self.guide.len() as u32 / n;
        let (mut found, mut places) = ([0; LANES], [0.0; LANES]);
        let (sums, guide) = (self.sums.as_ptr(), self.guide.as_ptr());
        for i in 0..LANES {
            let row = rows[i].min(height - 1);
            // SAFETY: the product is brought within the guide, also if it is no number; the row is inside, and so is what the guide says.
            // The last sum of a row is above every number, where the steps end.
            let (at, below, above) = unsafe {
                let bucket = (random[i] * n as f32).max(0.0).min(last as f32).to_int_unchecked::<u32>();
                let start = row * (n + 1);
                let at = *guide.add((row * n + bucket) as usize);
                let at = at + (*sums.add((start + at + 1) as usize) <= random[i]) as u32;
                let at = (at + (*sums.add((start + at.min(last) + 1) as usize) <= random[i]) as u32).min(last);
                (at, *sums.add((start + at) as usize), *sums.add((start + at + 1) as usize))
            };
            let size = above - below;
            found[i] = at;
            places[i] = if size > 0.0 { (random[i] - below) / size } else { 0.5 };
        }
        for i in 0..LANES {
            // Rarely, a third interval or more.
            let start = rows[i].min(height - 1) as usize * (self.n + 1);
            while self.sums[start + found[i] as usize + 1] <= random[i] && found[i] < last {
                found[i] += 1;
                let at = start + found[i] as usize;
                let size = self.sums[at + 1] - self.sums[at];
                places[i] = if size > 0.0 { (random[i] - self.sums[at]) / size } else { 0.5 };
            }
            places[i] = places[i].clamp(0.0, 1.0);
        }
        (found, places)
    }
}

/// Where directions meet the map: texels around a point with its place between them, and the texel that it lies in.
#[derive(Clone, Copy)]
struct Places {
    /// Indices of the upper left, upper right, lower left and lower right texel.
    texels: [Indices; 4],
    fraction: [Floats; 2],
    inside: Indices,
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
        let mut row_weights = Vec::with_capacity(height);
        for (y, row) in weights.chunks_exact_mut(width).enumerate() {
            row.iter_mut().enumerate().for_each(|(x, w)| *w = weight(x, y));
            row_weights.push(row.iter().sum::<f64>() * environment.solid_angle(y));
        }
        if row_weights.iter().sum::<f64>() == 0.0 {
            row_weights = (0..height).map(|y| environment.solid_angle(y)).collect();
        }
        let (rows, columns) = (Steps::new(&row_weights, height), Steps::new(&weights, width));
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
                let share = rows.share(0, i / width) * columns.share(i / width, i % width);
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
        self.draw_lanes(&random.map(|v| [v; LANES]), 1)[0]
    }

    /// Draws a direction from each of the first `n` pairs of numbers in `[0, 1)`; what follows are any.
    #[inline(always)]
    pub fn draw_lanes(&self, [first, second]: &[Floats; 2], n: usize) -> [Drawn; LANES] {
        let mut from_map = [0.0; LANES];
        for i in 0..LANES {
            // Those that draw from the sun draw from the map as well, for nothing.
            from_map[i] = ((first[i] - self.sun_share) / (1.0 - self.sun_share)).clamp(0.0, 1.0 - f32::EPSILON);
        }
        let (rows, fy) = self.rows.find(&[0; LANES], &from_map);
        (0..n).for_each(|i| self.columns.prefetch(rows[i] as usize, second[i]));
        let (columns, fx) = self.columns.find(&rows, second);
        for i in 0..n {
            self.prefetch_texels(rows[i], columns[i], fy[i]);
        }
        let (mut directions, mut x, mut y) = ([[0.0; LANES]; 3], [0.0; LANES], [0.0; LANES]);
        let edges = self.edges.as_ptr();
        for i in 0..LANES {
            // SAFETY: there is an edge more than rows.
            let (above, below) = unsafe { (*edges.add(rows[i] as usize), *edges.add(rows[i] as usize + 1)) };
            // Even in solid angle, not in the polar angle.
            let z = above + fy[i] * (below - above);
            let sine = (1.0 - z * z).max(0.0).sqrt();
            x[i] = columns[i] as f32 + fx[i];
            y[i] = arc_cosine(z) / PI * self.height as f32;
            let [right, ahead] = sin_cos_turns(x[i] / self.width as f32 - 0.5 - self.turn);
            (directions[0][i], directions[1][i], directions[2][i]) = (sine * right, sine * ahead, z);
        }
        let places = self.places(&x, &y, |i| rows[i] * self.width as u32 + columns[i]);
        let mut drawn = [Drawn::NONE; LANES];
        for (i, drawn) in drawn.iter_mut().enumerate().take(n) {
            let is_sun = first[i] < self.sun_share;
            *drawn = match self.draw_sun([first[i] / self.sun_share, second[i]]) {
                Some(direction) if is_sun => {
                    let (radiance, density) = self.evaluate(direction);
                    Drawn { direction, radiance, density }
                }
                _ => {
                    let direction = directions.map(|axis| axis[i]);
                    let (radiance, density) = self.with_sun(direction, self.bilinear(&places, i));
                    Drawn { direction, radiance, density }
                }
            };
        }
        drawn
    }

    /// Linear radiance from a direction of length 1, and the density per steradian with which it is drawn.
    #[inline(always)]
    pub fn evaluate(&self, direction: V3) -> (V3, f32) {
        self.evaluate_lanes(&direction.map(|v| [v; LANES]), 1)[0]
    }

    /// Linear radiance from the first `n` directions of length 1, `[axis][lane]`, and the densities per steradian with which they are drawn;
    /// what follows are any.
    #[inline(always)]
    pub fn evaluate_lanes(&self, directions: &[Floats; 3], n: usize) -> [(V3, f32); LANES] {
        let (mut x, mut y) = ([0.0; LANES], [0.0; LANES]);
        for i in 0..LANES {
            let u = 0.5 + turns_of(directions[0][i], directions[1][i]) + self.turn;
            (x[i], y[i]) = ((u - u.floor()) * self.width as f32, arc_cosine(directions[2][i]) / PI * self.height as f32);
        }
        let last = [self.width as u32 - 1, self.height as u32 - 1];
        // SAFETY: coordinates are brought within the map, whose size fits, also if they are no numbers.
        let inside = |v: f32, last: u32| unsafe { v.max(0.0).min(last as f32).to_int_unchecked::<u32>() };
        let places = self.places(&x, &y, |i| inside(y[i], last[1]) * self.width as u32 + inside(x[i], last[0]));
        for i in 0..n {
            prefetch(&self.texels[places.texels[0][i] as usize]);
            prefetch(&self.texels[places.texels[2][i] as usize]);
        }
        let mut values = [([0.0; 3], 0.0); LANES];
        for (i, value) in values.iter_mut().enumerate().take(n) {
            *value = self.with_sun(directions.map(|axis| axis[i]), self.bilinear(&places, i));
        }
        values
    }

    /// Starts to fetch a texel and the one above or below it that is nearer to a place in it.
    #[inline(always)]
    fn prefetch_texels(&self, row: u32, column: u32, place: f32) {
        let at = row as usize * self.width + column as usize;
        let beside = if place < 0.5 { at.saturating_sub(self.width) } else { (at + self.width).min(self.texels.len() - 1) };
        prefetch(&self.texels[at]);
        prefetch(&self.texels[beside]);
    }

    /// Texels around pixel coordinates, which lie within the map.
    #[inline(always)]
    fn places(&self, x: &Floats, y: &Floats, inside: impl Fn(usize) -> u32) -> Places {
        let (width, height) = (self.width as i32, self.height as i32);
        let mut places = Places { texels: [[0; LANES]; 4], fraction: [[0.0; LANES]; 2], inside: [0; LANES] };
        for i in 0..LANES {
            let (x, y) = (x[i] - 0.5, y[i] - 0.5);
            let (left, top) = (x.floor(), y.floor());
            (places.fraction[0][i], places.fraction[1][i]) = (x - left, y - top);
            // SAFETY: coordinates within the map, whose size fits; clamped, and NaN becomes the lowest.
            let [left, top] = unsafe {
                [left.max(-1.0).min(width as f32).to_int_unchecked::<i32>(), top.max(-1.0).min(height as f32).to_int_unchecked::<i32>()]
            };
            let right = if left + 1 >= width { 0 } else { left + 1 };
            let left = if left < 0 { width - 1 } else { left.min(width - 1) };
            let (upper, lower) = (top.max(0).min(height - 1) * width, (top + 1).min(height - 1) * width);
            places.texels[0][i] = (upper + left) as u32;
            places.texels[1][i] = (upper + right) as u32;
            places.texels[2][i] = (lower + left) as u32;
            places.texels[3][i] = (lower + right) as u32;
            places.inside[i] = inside(i);
        }
        places
    }

    /// Radiance at a place, and the density of the texel that it lies in.
    #[inline(always)]
    fn bilinear(&self, places: &Places, i: usize) -> (V3, f32) {
        let [a, b, c, d] = places.texels.map(|t| self.texels[t[i] as usize]);
        let [fx, fy] = places.fraction.map(|f| f[i]);
        let mut sum = [0.0; 4];
        for k in 0..4 {
            sum[k] = (1.0 - fy) * (a[k] * (1.0 - fx) + b[k] * fx) + fy * (c[k] * (1.0 - fx) + d[k] * fx);
        }
        ([sum[0], sum[1], sum[2]], self.texels[places.inside[i] as usize][3])
    }

    /// Adds the sun's radiance and density where a direction points into it.
    #[inline(always)]
    fn with_sun(&self, direction: V3, (radiance, density): (V3, f32)) -> (V3, f32) {
        match &self.sun {
            Some(sun) if sun.contains(direction) => (along(radiance, 1.0, sun.radiance), density + sun.density * self.sun_share),
            _ => (radiance, density),
        }
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
