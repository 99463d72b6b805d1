//! Directions drawn in proportion to the radiance of an environment.

use crate::environment::Environment;
use glam::{DVec2, DVec3};
use std::f64::consts::PI;

/// Densities by direction, constant within a pixel of the environment (Pharr, Jakob and Humphreys 2023, section 12.5).
#[derive(Clone, Debug)]
pub struct EnvironmentLight {
    width: usize,
    height: usize,
    /// Sums of the rows before each row, from 0 to 1.
    rows: Vec<f64>,
    /// Per row, sums of the pixels before each pixel, from 0 to 1.
    columns: Vec<f64>,
}

impl EnvironmentLight {
    /// Densities of an environment; uniform ones if it is black.
    pub fn new(environment: &Environment) -> EnvironmentLight {
        let image = environment.image();
        let (width, height) = (image.width, image.height);
        let luminance = |x: usize, y: usize| {
            let p = image.pixel(x, y);
            0.2126 * p[0] as f64 + 0.7152 * p[1] as f64 + 0.0722 * p[2] as f64
        };
        let (mut rows, mut columns) = (vec![0.0], Vec::with_capacity(height * (width + 1)));
        for y in 0..height {
            let first = columns.len();
            columns.push(0.0);
            let above_and_below = [y.saturating_sub(1), y, (y + 1).min(height - 1)];
            let mut sum = 0.0;
            for x in 0..width {
                // Radiance is bilinear, so a dark pixel beside a bright one gives light too.
                let beside = [(x + width - 1) % width, x, (x + 1) % width];
                sum += above_and_below.iter().flat_map(|y| beside.iter().map(|x| luminance(*x, *y))).sum::<f64>();
                columns.push(sum);
            }
            normalize(&mut columns[first..]);
            rows.push(rows[y] + sum * environment.solid_angle(y));
        }
        if rows[height] == 0.0 {
            rows = (0..=height).map(|y| 1.0 - (PI * y as f64 / height as f64).cos()).collect();
        }
        normalize(&mut rows);
        EnvironmentLight { width, height, rows, columns }
    }

    /// A direction, and its density per steradian, from two numbers in `[0, 1)`.
    pub fn draw(&self, environment: &Environment, random: [f64; 2]) -> (DVec3, f64) {
        let (y, fy) = find(&self.rows, random[0]);
        let (x, fx) = find(self.columns_of(y), random[1]);
        // Even in solid angle, not in the polar angle.
        let edge = |row: usize| (PI * row as f64 / self.height as f64).cos();
        let polar = (edge(y) + fy * (edge(y + 1) - edge(y))).clamp(-1.0, 1.0).acos();
        let direction = environment.direction(DVec2::new((x as f64 + fx) / self.width as f64, polar / PI));
        (direction, self.density_of(environment, x, y))
    }

    /// Density per steradian of a direction of length 1.
    pub fn density(&self, environment: &Environment, direction: DVec3) -> f64 {
        let uv = environment.uv(direction);
        let pixel = |t: f64, n: usize| ((t * n as f64) as usize).min(n - 1);
        self.density_of(environment, pixel(uv.x, self.width), pixel(uv.y, self.height))
    }

    fn density_of(&self, environment: &Environment, x: usize, y: usize) -> f64 {
        let columns = self.columns_of(y);
        (self.rows[y + 1] - self.rows[y]) * (columns[x + 1] - columns[x]) / environment.solid_angle(y)
    }

    fn columns_of(&self, row: usize) -> &[f64] {
        &self.columns[row * (self.width + 1)..][..self.width + 1]
    }
}

/// Scales sums to end at 1; even ones if they end at 0.
fn normalize(sums: &mut [f64]) {
    let last = sums.len() - 1;
    let end = sums[last];
    for (i, s) in sums.iter_mut().enumerate() {
        *s = if i == last {
            1.0
        } else if end > 0.0 {
            *s / end
        } else {
            i as f64 / last as f64
        };
    }
}

/// The interval of sums that a number falls into, and where in it.
fn find(sums: &[f64], random: f64) -> (usize, f64) {
    let i = sums.partition_point(|s| *s <= random).clamp(1, sums.len() - 1) - 1;
    let size = sums[i + 1] - sums[i];
    (i, if size > 0.0 { ((random - sums[i]) / size).clamp(0.0, 1.0) } else { 0.5 })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A dim sky, a small bright sun and a black ground.
    fn sunny() -> Environment {
        let sun = DVec3::new(0.3, 0.5, 0.6).normalize();
        let mut e = Environment::from_fn(32, |d| match d.z {
            z if z < 0.0 => [0.0; 3],
            _ if d.dot(sun) > 0.99 => [400.0, 300.0, 200.0],
            z => [0.2, 0.4, 1.0 - 0.5 * z],
        });
        (e.turn, e.strength) = (0.7, 1.3);
        e
    }

    fn random(n: usize) -> impl Iterator<Item = [f64; 2]> {
        (0..n).map(move |i| [(i as f64 + 0.5) / n as f64, (0.5 + 0.618_033_988_749_895 * i as f64).fract()])
    }

    #[test]
    fn the_densities_integrate_to_one_and_are_those_of_the_draws() {
        for environment in [sunny(), Environment::uniform([0.0; 3], 8), Environment::uniform([2.0; 3], 1)] {
            let light = EnvironmentLight::new(&environment);
            let (w, h) = (environment.image().width, environment.image().height);
            let centers = (0..w * h).map(|i| DVec2::new((i % w) as f64 + 0.5, (i / w) as f64 + 0.5) / DVec2::new(w as f64, h as f64));
            let sum: f64 = centers
                .enumerate()
                .map(|(i, uv)| light.density(&environment, environment.direction(uv)) * environment.solid_angle(i / w))
                .sum();
            assert!((sum - 1.0).abs() < 1e-9, "{sum}");
            for r in random(500) {
                let (direction, density) = light.draw(&environment, r);
                assert!((direction.length() - 1.0).abs() < 1e-9 && density > 0.0);
                assert!((light.density(&environment, direction) / density - 1.0).abs() < 1e-9, "{direction}");
            }
        }
    }

    #[test]
    fn few_draws_give_the_irradiance() {
        let environment = sunny();
        let light = EnvironmentLight::new(&environment);
        let irradiance = |d: DVec3, k: usize| environment.radiance(d)[k] * d.z.max(0.0);
        // Ten times finer than the pixels.
        let (w, h) = (640, 320);
        for k in 0..3 {
            let want: f64 = (0..w * h)
                .map(|i| {
                    let uv = DVec2::new((i % w) as f64 + 0.5, (i / w) as f64 + 0.5) / DVec2::new(w as f64, h as f64);
                    let edge = |row: usize| (PI * row as f64 / h as f64).cos();
                    irradiance(environment.direction(uv), k) * (edge(i / w) - edge(i / w + 1)) * 2.0 * PI / w as f64
                })
                .sum();
            let n = 4000;
            let drawn: f64 = random(n).map(|r| light.draw(&environment, r)).map(|(d, density)| irradiance(d, k) / density).sum();
            assert!((drawn / n as f64 / want - 1.0).abs() < 0.02, "{} {want}", drawn / n as f64);
        }
    }
}
