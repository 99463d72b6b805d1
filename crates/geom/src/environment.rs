//! Light from all directions as an equirectangular image.

use crate::color::luminance;
use crate::image::Image;
use glam::{DVec2, DVec3};
use std::f64::consts::PI;

/// Linear radiance by direction: an equirectangular image `[H, 2 H, 3]`, the zenith (+z) at its top, +y in its center and +x a quarter to
/// the right, turned about the vertical and scaled.
///
/// In texture coordinates `u = ½ + atan2(x, y) / 2π`, `v = acos(z) / π`; pixel centers are at +0.5.
#[derive(Clone, Debug, PartialEq)]
pub struct Environment {
    image: Image,
    /// Angle in radians about +z by which the sources are turned.
    pub turn: f64,
    /// Factor of the radiance.
    pub strength: f64,
}

/// What is wrong with an image of an environment.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum BadEnvironment {
    /// Width and height, of which the first is not twice the second.
    Size(usize, usize),
    /// Number of channels, which is not 3.
    Channels(usize),
}

impl std::fmt::Display for BadEnvironment {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        match self {
            BadEnvironment::Size(w, h) => {
                let ratio = *w as f64 / (*h).max(1) as f64;
                write!(f, "an environment map is twice as wide as high; this one is {w}×{h} ({ratio:.2} : 1)")
            }
            BadEnvironment::Channels(c) => write!(f, "an environment map has 3 channels, this one {c}"),
        }
    }
}

impl std::error::Error for BadEnvironment {}

/// Pixels that held no radiance (NaN, infinite or negative), and are black now.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Blackened {
    pub count: usize,
    /// Column and row of the first.
    pub first: (usize, usize),
}

impl Environment {
    /// An environment of an image, and which of its pixels had to be made black.
    ///
    /// # Errors
    /// When the image is not `[H, 2 H, 3]`.
    pub fn new(mut image: Image) -> Result<(Environment, Blackened), BadEnvironment> {
        if image.height == 0 || image.width != 2 * image.height {
            return Err(BadEnvironment::Size(image.width, image.height));
        }
        if image.channels != 3 {
            return Err(BadEnvironment::Channels(image.channels));
        }
        let mut black = Blackened::default();
        for (i, pixel) in image.data.chunks_exact_mut(3).enumerate() {
            if pixel.iter().any(|v| !v.is_finite() || *v < 0.0) {
                pixel.fill(0.0);
                if black.count == 0 {
                    black.first = (i % image.width, i / image.width);
                }
                black.count += 1;
            }
        }
        Ok((Environment { image, turn: 0.0, strength: 1.0 }, black))
    }

    /// An environment `[height, 2 height, 3]` of the radiance at the centers of its pixels.
    pub fn from_fn(height: usize, radiance: impl Fn(DVec3) -> [f64; 3]) -> Environment {
        let mut image = Image::zeros(2 * height, height, 3);
        for (i, pixel) in image.data.chunks_exact_mut(3).enumerate() {
            let (x, y) = (i % (2 * height), i / (2 * height));
            let uv = DVec2::new((x as f64 + 0.5) / (2 * height) as f64, (y as f64 + 0.5) / height as f64);
            pixel.copy_from_slice(&radiance(direction_of(uv)).map(|r| r as f32));
        }
        Environment { image, turn: 0.0, strength: 1.0 }
    }

    /// The same radiance from all directions.
    pub fn uniform(radiance: [f64; 3], height: usize) -> Environment {
        Environment::from_fn(height, |_| radiance)
    }

    /// This light above the horizon, and below it the radiance `albedo E / π` of level, diffuse ground that it lights.
    pub fn above_ground(&self, albedo: f64) -> Environment {
        let ground = self.irradiance(DVec3::Z).map(|e| albedo / PI * e);
        Environment::from_fn(self.image.height, |d| if d.z < 0.0 { ground } else { self.radiance(d) })
    }

    /// Irradiance of a surface without shadows, by its normal.
    pub fn irradiance(&self, normal: DVec3) -> [f64; 3] {
        let mut sum = [0.0; 3];
        self.for_each_pixel(|d, solid_angle, radiance| {
            let weight = solid_angle * d.dot(normal).max(0.0);
            (0..3).for_each(|k| sum[k] += weight * radiance[k]);
        });
        sum
    }

    pub fn image(&self) -> &Image {
        &self.image
    }

    /// Linear radiance from a direction of length 1, bilinear between pixels.
    pub fn radiance(&self, direction: DVec3) -> [f64; 3] {
        let (w, h) = (self.image.width, self.image.height);
        let uv = self.uv(direction);
        let (x, y) = (uv.x * w as f64 - 0.5, uv.y * h as f64 - 0.5);
        let (left, top) = (x.floor(), y.floor());
        let (fx, fy) = (x - left, y - top);
        let column = |i: f64| (i.rem_euclid(w as f64)) as usize % w;
        let row = |i: f64| i.clamp(0.0, (h - 1) as f64) as usize;
        let mut sum = [0.0; 3];
        for (dx, wx) in [(0.0, 1.0 - fx), (1.0, fx)] {
            for (dy, wy) in [(0.0, 1.0 - fy), (1.0, fy)] {
                let pixel = self.image.pixel(column(left + dx), row(top + dy));
                (0..3).for_each(|k| sum[k] += wx * wy * self.strength * pixel[k] as f64);
            }
        }
        sum
    }

    /// Texture coordinates of a direction of length 1, both in 0 to 1.
    pub fn uv(&self, direction: DVec3) -> DVec2 {
        let u = 0.5 + (direction.x.atan2(direction.y) + self.turn) / (2.0 * PI);
        DVec2::new(u.rem_euclid(1.0), direction.z.clamp(-1.0, 1.0).acos() / PI)
    }

    /// Direction of texture coordinates.
    pub fn direction(&self, uv: DVec2) -> DVec3 {
        direction_of(DVec2::new(uv.x - self.turn / (2.0 * PI), uv.y))
    }

    /// Solid angle of a pixel in a row, in steradians.
    pub fn solid_angle(&self, row: usize) -> f64 {
        let edge = |row: usize| (PI * row as f64 / self.image.height as f64).cos();
        (edge(row) - edge(row + 1)) * 2.0 * PI / self.image.width as f64
    }

    /// Adds a disc of even radiance that gives a surface facing it `irradiance`; `diameter` in radians. Each pixel gets its share.
    pub fn add_disc(&mut self, center: DVec3, diameter: f64, irradiance: [f64; 3]) {
        const POINTS: usize = 1024;
        let (side, up) = center.any_orthonormal_pair();
        let (w, h) = (self.image.width, self.image.height);
        for i in 0..POINTS {
            // Vogel's spiral, even in area.
            let (t, azimuth) = ((i as f64 + 0.5) / POINTS as f64, i as f64 * PI * (3.0 - 5f64.sqrt()));
            let sine = (0.5 * diameter).sin() * t.sqrt();
            let direction = center * (1.0 - sine * sine).sqrt() + sine * (side * azimuth.cos() + up * azimuth.sin());
            let uv = self.uv(direction);
            let (x, y) = (((uv.x * w as f64) as usize).min(w - 1), ((uv.y * h as f64) as usize).min(h - 1));
            let share = 1.0 / (POINTS as f64 * self.solid_angle(y) * self.strength);
            let pixel = &mut self.image.data[3 * (y * w + x)..][..3];
            (0..3).for_each(|k| pixel[k] += (irradiance[k] * share) as f32);
        }
    }

    /// Calls `visit` with direction, solid angle and linear radiance of each pixel.
    pub fn for_each_pixel(&self, mut visit: impl FnMut(DVec3, f64, [f64; 3])) {
        let (w, h) = (self.image.width, self.image.height);
        for y in 0..h {
            let solid_angle = self.solid_angle(y);
            for x in 0..w {
                let uv = DVec2::new((x as f64 + 0.5) / w as f64, (y as f64 + 0.5) / h as f64);
                let pixel = self.image.pixel(x, y);
                visit(self.direction(uv), solid_angle, std::array::from_fn(|k| self.strength * pixel[k] as f64));
            }
        }
    }
}

/// A rectangle of pixels: columns and rows, first and one past the last.
type Region = ([usize; 2], [usize; 2]);

impl Environment {
    /// What is brighter than `above` times the mean as at most `n` directional lights (direction, irradiance of a surface that faces it), by median
    /// cuts of energy (Debevec 2005), and the map without it. `n` is a power of two.
    pub fn with_lamps(&self, above: f64, n: usize) -> (Environment, Vec<(DVec3, [f64; 3])>) {
        let (w, h) = (self.image.width, self.image.height);
        let mut pixels = Vec::with_capacity(w * h);
        self.for_each_pixel(|d, solid_angle, radiance| pixels.push((d, solid_angle, radiance)));
        let limit = above * pixels.iter().map(|p| p.1 * luminance(p.2)).sum::<f64>() / (4.0 * PI);
        let mut rest = self.clone();
        for (i, (_, solid_angle, radiance)) in pixels.iter_mut().enumerate() {
            let kept = (limit / luminance(*radiance).max(1e-12)).min(1.0);
            (0..3).for_each(|k| rest.image.data[3 * i + k] *= kept as f32);
            *radiance = radiance.map(|v| v * (1.0 - kept) * *solid_angle);
        }
        let energy = |x: usize, y: usize| luminance(pixels[y * w + x].2);
        let mut regions: Vec<Region> = vec![([0, w], [0, h])];
        while regions.len() < n {
            regions = regions.into_iter().flat_map(|r| halves(r, h, &energy)).collect();
        }
        let lamps = regions.into_iter().filter_map(|(columns, rows)| {
            let (mut toward, mut irradiance) = (DVec3::ZERO, [0.0; 3]);
            for (d, _, flux) in (rows[0]..rows[1]).flat_map(|y| &pixels[y * w + columns[0]..y * w + columns[1]]) {
                toward += *d * luminance(*flux);
                (0..3).for_each(|k| irradiance[k] += flux[k]);
            }
            Some((toward.try_normalize()?, irradiance))
        });
        let lamps = lamps.collect();
        (rest, lamps)
    }
}

/// A region cut across its longer side such that both parts have the same energy.
fn halves((columns, rows): Region, height: usize, energy: &dyn Fn(usize, usize) -> f64) -> [Region; 2] {
    let middle = 0.5 * (rows[0] + rows[1]) as f64 / height as f64;
    let is_wide = (columns[1] - columns[0]) as f64 * (PI * middle).sin() > (rows[1] - rows[0]) as f64;
    let [from, to] = if is_wide { columns } else { rows };
    let line = |k: usize| -> f64 {
        if is_wide { (rows[0]..rows[1]).map(|y| energy(k, y)).sum() } else { (columns[0]..columns[1]).map(|x| energy(x, k)).sum() }
    };
    let lines: Vec<f64> = (from..to).map(line).collect();
    let (half, mut below, mut cut) = (0.5 * lines.iter().sum::<f64>(), 0.0, from);
    while cut < to && below + 0.5 * lines[cut - from] < half {
        below += lines[cut - from];
        cut += 1;
    }
    if is_wide { [([from, cut], rows), ([cut, to], rows)] } else { [(columns, [from, cut]), (columns, [cut, to])] }
}

fn direction_of(uv: DVec2) -> DVec3 {
    let (azimuth, polar) = ((uv.x - 0.5) * 2.0 * PI, uv.y * PI);
    DVec3::new(polar.sin() * azimuth.sin(), polar.sin() * azimuth.cos(), polar.cos())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ground_sends_what_it_receives_from_above() {
        let sky =
            Environment { turn: 0.4, strength: 2.0, ..Environment::from_fn(64, |d| [1.0, if d.z > 0.0 { 0.5 + d.x } else { 9.0 }, 0.0]) };
        let whole = sky.above_ground(0.3);
        for (d, want) in [(DVec3::new(0.6, 0.0, -0.8), [0.6, 0.3, 0.0]), (DVec3::NEG_Z, [0.6, 0.3, 0.0])] {
            (0..3).for_each(|k| assert!((whole.radiance(d)[k] - want[k]).abs() < 1e-3, "{:?}", whole.radiance(d)));
        }
        let up = DVec3::new(0.36, 0.48, 0.8);
        (0..3).for_each(|k| assert!((whole.radiance(up)[k] - sky.radiance(up)[k]).abs() < 1e-2));
    }

    #[test]
    fn lamps_and_the_rest_are_the_whole_light() {
        let glow = DVec3::new(0.6, 0.3, 0.5).normalize();
        let map = Environment::from_fn(64, |d| {
            let lobe = 6.0 * (12.0 * (d.dot(glow) - 1.0)).exp();
            [0.2 + lobe, 0.25 + lobe, 0.4 + 0.5 * lobe]
        });
        let map = Environment { turn: 0.7, strength: 1.5, ..map };
        let (rest, lamps) = map.with_lamps(2.0, 16);
        assert!((8..=16).contains(&lamps.len()), "{}", lamps.len());
        let flux = |e: &Environment| {
            let mut sum = [0.0; 3];
            e.for_each_pixel(|_, solid_angle, radiance| (0..3).for_each(|k| sum[k] += solid_angle * radiance[k]));
            sum
        };
        for k in 0..3 {
            let both = flux(&rest)[k] + lamps.iter().map(|l| l.1[k]).sum::<f64>();
            assert!((both / flux(&map)[k] - 1.0).abs() < 1e-5, "channel {k}");
        }
        // What they give a surface is what the map gives.
        for n in [glow, DVec3::Z, DVec3::X, DVec3::NEG_Y] {
            let mut whole = 0.0;
            map.for_each_pixel(|d, solid_angle, radiance| whole += solid_angle * radiance[1] * d.dot(n).max(0.0));
            let mut parts = lamps.iter().map(|l| l.1[1] * l.0.dot(n).max(0.0)).sum::<f64>();
            rest.for_each_pixel(|d, solid_angle, radiance| parts += solid_angle * radiance[1] * d.dot(n).max(0.0));
            assert!((parts / whole - 1.0).abs() < 0.02, "{n}: {parts} {whole}");
        }
        // An even sky has none.
        assert!(Environment::uniform([1.0; 3], 16).with_lamps(2.0, 8).1.is_empty());
    }

    #[test]
    fn directions_lie_where_the_convention_says() {
        let map = Environment::uniform([1.0; 3], 4);
        for (direction, uv) in [
            (DVec3::Y, DVec2::new(0.5, 0.5)),
            (DVec3::X, DVec2::new(0.75, 0.5)),
            (DVec3::NEG_X, DVec2::new(0.25, 0.5)),
            (DVec3::new(0.0, 0.6, 0.8), DVec2::new(0.5, 0.8f64.acos() / PI)),
        ] {
            assert!((map.uv(direction) - uv).length() < 1e-12, "{direction}: {}", map.uv(direction));
            assert!((map.direction(uv) - direction).length() < 1e-12, "{uv}");
        }
        assert_eq!((map.uv(DVec3::Z).y, map.uv(DVec3::NEG_Z).y), (0.0, 1.0));
    }

    #[test]
    fn pixels_cover_the_sphere() {
        let mut sum = 0.0;
        Environment::uniform([1.0; 3], 16).for_each_pixel(|_, solid_angle, _| sum += solid_angle);
        assert!((sum - 4.0 * PI).abs() < 1e-12, "{sum}");
    }

    #[test]
    fn radiance_passes_the_seam_and_keeps_to_the_poles() {
        let map = Environment::from_fn(64, |d| [2.0 + d.x, 2.0 + d.y, 2.0 + d.z]);
        for d in [DVec3::NEG_Y, DVec3::new(-1e-4, -1.0, 0.0).normalize(), DVec3::new(0.3, -0.9, 0.2).normalize(), DVec3::Z, DVec3::NEG_Z] {
            let got = map.radiance(d);
            let want = [2.0 + d.x, 2.0 + d.y, 2.0 + d.z];
            assert!((0..3).all(|k| (got[k] - want[k]).abs() < 0.05), "{d}: {got:?}, not {want:?}");
        }
    }

    #[test]
    fn a_turn_moves_sources_about_the_vertical_and_strength_scales_them() {
        let mut map = Environment::from_fn(64, |d| [1.0 + d.y, 1.0, 1.0 + d.x]);
        let before = map.radiance(DVec3::Y);
        // A quarter turn counterclockwise, seen from above, takes +y to −x.
        (map.turn, map.strength) = (PI / 2.0, 2.0);
        let after = map.radiance(DVec3::NEG_X);
        assert!((0..3).all(|k| (after[k] - 2.0 * before[k]).abs() < 1e-6), "{before:?}, {after:?}");
        let uv = map.uv(DVec3::new(0.6, 0.0, 0.8));
        assert!((map.direction(uv) - DVec3::new(0.6, 0.0, 0.8)).length() < 1e-12);
    }

    #[test]
    fn images_that_are_no_environment_are_refused_and_pixels_without_radiance_are_black() {
        assert_eq!(Environment::new(Image::zeros(3, 2, 3)), Err(BadEnvironment::Size(3, 2)));
        assert_eq!(Environment::new(Image::zeros(0, 0, 3)), Err(BadEnvironment::Size(0, 0)));
        assert_eq!(Environment::new(Image::zeros(4, 2, 4)), Err(BadEnvironment::Channels(4)));
        let mut image = Image::zeros(4, 2, 3);
        image.data.fill(1.0);
        (image.data[15], image.data[20]) = (f32::NAN, -1.0);
        let (map, black) = Environment::new(image).unwrap();
        assert_eq!(black, Blackened { count: 2, first: (1, 1) });
        assert_eq!(
            (map.image().pixel(1, 1), map.image().pixel(2, 1), map.image().pixel(0, 1)),
            (&[0.0; 3][..], &[0.0; 3][..], &[1.0; 3][..])
        );
    }
}
