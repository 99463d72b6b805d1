//! Estimates the distances of corners in photographs with known poses by a sweep over inverse depths that compares patches of neighboring
//! views by normalized cross-correlation (plane sweep, Collins 1996; for single corners instead of whole planes).

use super::pixels::{Observation, PixelSource};
use diorama_geom::Pose;
use diorama_geom::glam::{DVec2, DVec3};
use diorama_kernels::ops::ray_generation::PosedCamera;
use rayon::prelude::*;
use std::sync::atomic::{AtomicBool, Ordering};

/// Most pixels along the longer side of the reduced photographs that are compared.
const LONGEST: u32 = 800;
/// Stored value of white.
const WHITE: f32 = 65535.0;
/// Target number of corners in all photographs together, and its least and greatest value per photograph.
const CORNERS: usize = 60_000;
const CORNERS_OF_ONE: (usize, usize) = (200, 2000);
/// Smallest eigenvalue of the mean structure tensor at a corner, in squared brightness (1: white) per pixel.
const TEXTURE: f32 = 2e-5;
/// Radius of a patch in pixels.
const RADIUS: i32 = 3;
const PATCH: usize = (2 * RADIUS as usize + 1).pow(2);

/// Preferred parallax angles in degrees between a photograph and its neighbors, seen from the viewed point; and the allowed range.
const ANGLES: [f64; 4] = [6.0, 10.0, 16.0, 24.0];
const ANGLE_RANGE: (f64, f64) = (1.5, 40.0);
/// Nearest distance that is searched, as a share of the viewing distance.
pub const NEAREST: f64 = 0.2;
/// Most depths of a sweep; successive ones are about a pixel apart in the first neighbor.
const DEPTHS: usize = 400;
/// Most peaks of the sweep that are refined, and sub-steps per step.
const PEAKS: usize = 4;
const PARTS: i32 = 8;

/// Least correlation of a peak of the sweep, of a neighbor that agrees, and least mean correlation of the agreeing neighbors.
const PEAK: f32 = 0.7;
const AGREES: f32 = 0.75;
const SURE: f32 = 0.85;
/// Least relative lead of the best peak, in the sum of agreeing correlations. More peaks than [`MOST_PEAKS`] indicate a repeating pattern.
const MARGIN: f32 = 0.06;
const MOST_PEAKS: usize = 2 * PEAKS;
/// Neighbors that must agree, or all if there are fewer.
const FEWEST: usize = 3;

/// Reduced grayscale version of a photograph, with its camera.
struct Gray {
    width: usize,
    height: usize,
    /// White is 65,535.
    data: Vec<u16>,
    posed: PosedCamera,
    camera_from_world: Pose,
}

impl Gray {
    fn of(source: &dyn PixelSource, image: usize, posed: &PosedCamera, longest: u32) -> Gray {
        let (w, h) = source.size(image);
        // Only one pixel of each `stride` × `stride` square is stored.
        let stride = source.stride().max(1);
        let reduction = w.max(h).div_ceil(longest).max(1).next_multiple_of(stride);
        let (width, height) = ((w / reduction).max(1), (h / reduction).max(1));
        let parts = reduction / stride;
        let at = |k: u32, full: u32, n: u32| (((2 * k as u64 + 1) * full as u64 / (2 * n as u64 * parts as u64)) as u32).min(full - 1);
        let mut data = Vec::with_capacity((width * height) as usize);
        for y in 0..height {
            for x in 0..width {
                let mut sum = 0.0;
                for k in 0..parts * parts {
                    let (x, y) = source.snap(image, at(x * parts + k % parts, w, width), at(y * parts + k / parts, h, height));
                    let [r, g, b, _] = source.rgba(image, x, y);
                    sum += (0.3 * r + 0.6 * g + 0.1 * b).clamp(0.0, 1.0);
                }
                data.push((sum / (parts * parts) as f32 * WHITE).round() as u16);
            }
        }
        let posed = PosedCamera { camera: posed.camera.resized(width, height), pose: posed.pose };
        Gray { width: width as usize, height: height as usize, data, camera_from_world: posed.pose.inverse(), posed }
    }

    /// Brightness of a pixel; 1 is white.
    #[inline(always)]
    fn pixel(&self, at: usize) -> f32 {
        self.data[at] as f32 * (1.0 / WHITE)
    }

    /// Projects a point in the world to pixels, with pixel centers at halves.
    fn project(&self, p: DVec3) -> Option<DVec2> {
        self.posed.camera.project(self.camera_from_world.point(p))
    }

    /// Bilinearly interpolated brightness; the caller keeps half a pixel away from the border.
    #[inline(always)]
    fn at(&self, x: f32, y: f32) -> f32 {
        let (x, y) = (x - 0.5, y - 0.5);
        let (i, j) = (x as usize, y as usize);
        let (u, v) = (x - i as f32, y - j as f32);
        let row = j * self.width + i;
        let (a, b) = (self.pixel(row), self.pixel(row + 1));
        let (c, d) = (self.pixel(row + self.width), self.pixel(row + self.width + 1));
        let (top, bottom) = (a + u * (b - a), c + u * (d - c));
        top + v * (bottom - top)
    }

    /// The strongest corner of each grid cell, away from the image border.
    fn corners(&self, count: usize) -> Vec<(usize, usize)> {
        let rim = RADIUS as usize + 2;
        if self.width <= 2 * rim + 1 || self.height <= 2 * rim + 1 {
            return Vec::new();
        }
        let cell = (((self.width * self.height) as f64 / count as f64).sqrt() as usize).max(4);
        let mut best = Vec::new();
        for y0 in (rim..self.height - rim).step_by(cell) {
            for x0 in (rim..self.width - rim).step_by(cell) {
                let ys = y0..(y0 + cell).min(self.height - rim);
                let places = ys.flat_map(|y| (x0..(x0 + cell).min(self.width - rim)).map(move |x| (x, y)));
                let strongest = places.map(|p| (self.cornerness(p), p)).max_by(|a, b| a.0.total_cmp(&b.0));
                best.extend(strongest.filter(|b| b.0 > TEXTURE).map(|b| b.1));
            }
        }
        best
    }

    /// Smaller eigenvalue of the structure tensor (Shi and Tomasi 1994).
    fn cornerness(&self, (x, y): (usize, usize)) -> f32 {
        let (mut a, mut b, mut c) = (0.0, 0.0, 0.0);
        for j in y - 2..=y + 2 {
            for i in x - 2..=x + 2 {
                let at = j * self.width + i;
                let gx = 0.5 * (self.pixel(at + 1) - self.pixel(at - 1));
                let gy = 0.5 * (self.pixel(at + self.width) - self.pixel(at - self.width));
                (a, b, c) = (a + gx * gx, b + gx * gy, c + gy * gy);
            }
        }
        (0.5 * (a + c) - (0.25 * (a - c).powi(2) + b * b).sqrt()) / 25.0
    }
}

/// The patch minus its mean, scaled to unit length; none for a uniform patch.
fn normalized(mut patch: [f32; PATCH]) -> Option<[f32; PATCH]> {
    let mean = patch.iter().sum::<f32>() / PATCH as f32;
    patch.iter_mut().for_each(|v| *v -= mean);
    let length = patch.iter().map(|v| v * v).sum::<f32>().sqrt();
    (length > 1e-3).then(|| patch.map(|v| v / length))
}

/// A corner of a photograph, with its patch, its rays and the neighbors that it is compared with.
struct Corner<'a> {
    patch: [f32; PATCH],
    eye: DVec3,
    /// Rays through the corner, one pixel to the right and one pixel below; the latter two scaled to end on the plane at distance 1.
    rays: [DVec3; 3],
    others: &'a [&'a Gray],
}

impl<'a> Corner<'a> {
    fn new(own: &Gray, (x, y): (usize, usize), others: &'a [&'a Gray]) -> Option<Corner<'a>> {
        let (cx, cy) = (x as f64 + 0.5, y as f64 + 0.5);
        let pose = &own.posed.pose;
        let ray = |x: f64, y: f64| pose.rotation * own.posed.camera.direction(x, y);
        let middle = ray(cx, cy);
        let beside = |r: DVec3| r / r.dot(middle);
        let mut patch = [0.0; PATCH];
        for (k, p) in patch.iter_mut().enumerate() {
            let (i, j) = offset(k);
            *p = own.pixel((y as i32 + j) as usize * own.width + (x as i32 + i) as usize);
        }
        let rays = [middle, beside(ray(cx + 1.0, cy)), beside(ray(cx, cy + 1.0))];
        Some(Corner { patch: normalized(patch)?, eye: pose.translation, rays, others })
    }

    /// Affine projection of the patch at a distance into a neighbor: its center, and its shift per pixel in x and in y.
    fn seen(&self, other: usize, distance: f64) -> Option<[DVec2; 3]> {
        let other = self.others[other];
        let [m, x, y] = self.rays.map(|r| other.project(self.eye + r * distance));
        let (m, x, y) = (m?, x? - m?, y? - m?);
        let reach = RADIUS as f64 * (x.abs() + y.abs()) + 1.5;
        let fits = m.x > reach.x && m.y > reach.y && m.x < other.width as f64 - reach.x && m.y < other.height as f64 - reach.y;
        // Reject patches that appear at a very different size or at a grazing angle.
        let size = x.perp_dot(y);
        (fits && (0.2..5.0).contains(&size)).then_some([m, x, y])
    }

    /// Normalized cross-correlation with a neighbor at a distance; none if the neighbor does not see the patch.
    fn correlation(&self, other: usize, distance: f64) -> Option<f32> {
        let [m, x, y] = self.seen(other, distance)?.map(|v| v.as_vec2());
        let gray = self.others[other];
        let mut patch = [0.0; PATCH];
        for (k, p) in patch.iter_mut().enumerate() {
            let (i, j) = offset(k);
            let at = m + x * i as f32 + y * j as f32;
            *p = gray.at(at.x, at.y);
        }
        Some(normalized(patch)?.iter().zip(&self.patch).map(|(a, b)| a * b).sum())
    }

    /// Number of neighbors that agree on a distance, and their mean correlation.
    fn agreement(&self, distance: f64) -> (usize, f32) {
        let agreeing = (0..self.others.len()).filter_map(|o| self.correlation(o, distance)).filter(|c| *c > AGREES);
        let (n, sum) = agreeing.fold((0, 0.0), |(n, sum), c| (n + 1, sum + c));
        (n, sum / n.max(1) as f32)
    }

    /// The distance at which the neighbors show the same patch; none unless it is unique and enough neighbors agree.
    fn distance(&self, nearest: f64) -> Option<f64> {
        let most = 1.0 / nearest;
        let steps = self.steps(most);
        let inverse = |k: f64| (most * k / steps as f64).max(1e-4 * most);
        let sweep: Vec<f32> = (0..=steps).map(|k| self.correlation(0, 1.0 / inverse(k as f64)).unwrap_or(-1.0)).collect();
        let of = |k: usize| sweep.get(k).copied().unwrap_or(-1.0);
        let is_peak = |k: &usize| of(*k) > PEAK && of(*k) >= of(k + 1) && (*k == 0 || of(*k) > of(k - 1));
        let mut peaks: Vec<usize> = (0..=steps).filter(is_peak).collect();
        if peaks.len() > MOST_PEAKS {
            return None;
        }
        peaks.sort_by(|a, b| of(*b).total_cmp(&of(*a)));
        let closely = |k: &usize| {
            let parts = (-PARTS..=PARTS).map(|part| *k as f64 + part as f64 / PARTS as f64).filter(|k| *k >= 0.0);
            let all = parts.map(|k| (self.agreement(1.0 / inverse(k)), k));
            all.max_by(|a, b| (a.0.0 as f32 * a.0.1).total_cmp(&(b.0.0 as f32 * b.0.1)))
        };
        let mut found: Vec<((usize, f32), f64)> = peaks.iter().take(PEAKS).filter_map(closely).collect();
        let strength = |f: &((usize, f32), f64)| f.0.0 as f32 * f.0.1;
        found.sort_by(|a, b| strength(b).total_cmp(&strength(a)));
        let best = *found.first()?;
        let is_unique = found[1..].iter().all(|f| (f.1 - best.1).abs() < 2.0 || strength(f) < strength(&best) * (1.0 - MARGIN));
        // A peak at an end of the sweep may belong to a point beyond it.
        let is_within = best.1 > 1.0 && best.1 < steps as f64 - 1.0;
        (is_unique && is_within && best.0.0 >= FEWEST.min(self.others.len()) && best.0.1 > SURE).then(|| 1.0 / inverse(best.1))
    }

    /// Number of sweep steps from infinity to inverse depth `most`, so that they are about a pixel apart in the first neighbor.
    fn steps(&self, most: f64) -> usize {
        let at = |k: f64| self.others[0].project(self.eye + self.rays[0] / (most * k));
        // If the near end lies behind the neighbor, extrapolate from the far half or quarter.
        let moved = [(1.0, 1.0), (0.5, 2.0), (0.25, 4.0)].into_iter().find_map(|(k, by)| Some((at(k)? - at(1e-3)?).length() * by));
        (moved.unwrap_or(DEPTHS as f64) as usize).clamp(16, DEPTHS)
    }
}

/// Offset (x, y) of a patch's `k`th pixel from its center.
#[inline(always)]
fn offset(k: usize) -> (i32, i32) {
    let side = 2 * RADIUS as usize + 1;
    ((k % side) as i32 - RADIUS, (k / side) as i32 - RADIUS)
}

/// The neighbors of photograph `i`: those closest to the preferred angles, by ascending angle; of the same light where enough of them are, as
/// shadows differ otherwise. `lights` is empty where all photographs have one.
fn neighbors<'a>(views: &'a [Gray], lights: &[u32], i: usize, viewing_distance: f64) -> Vec<&'a Gray> {
    let own = &views[i];
    let target = own.posed.pose.point(DVec3::Z * viewing_distance);
    let to_own = own.posed.pose.translation - target;
    let sees = |v: &Gray| v.project(target).is_some_and(|p| p.x > 0.0 && p.y > 0.0 && p.x < v.width as f64 && p.y < v.height as f64);
    let mut all: Vec<(f64, usize)> = (0..views.len())
        .filter(|j| *j != i && sees(&views[*j]))
        .map(|j| (to_own.angle_between(views[j].posed.pose.translation - target).to_degrees(), j))
        .filter(|(angle, _)| (ANGLE_RANGE.0..ANGLE_RANGE.1).contains(angle))
        .collect();
    if !lights.is_empty() {
        let alike: Vec<(f64, usize)> = all.iter().copied().filter(|(_, j)| lights[*j] == lights[i]).collect();
        if alike.len() >= FEWEST {
            all = alike;
        }
    }
    let mut chosen = Vec::new();
    for wanted in ANGLES {
        let closest = (0..all.len()).min_by(|a, b| (all[*a].0 / wanted).ln().abs().total_cmp(&(all[*b].0 / wanted).ln().abs()));
        chosen.extend(closest.map(|k| all.swap_remove(k)));
    }
    chosen.sort_by(|a, b| a.0.total_cmp(&b.0));
    chosen.into_iter().map(|(_, j)| &views[j]).collect()
}

/// Bytes of the reduced photographs for photographs of these (width, height).
pub fn bytes(sizes: impl Iterator<Item = (u32, u32)>) -> u64 {
    sizes.map(|(w, h)| (w as u64 * h as u64) / (w.max(h).div_ceil(LONGEST).max(1) as u64).pow(2) * 2).sum()
}

/// Observes the distances of corner pixels that neighboring photographs agree on; returns nothing if `interrupt` is set. `cameras` are in the
/// order of the photographs, as is `lights`, the light of each, which is empty where all have one; `viewing_distance` is the distance from the
/// cameras to what they view, in model space.
pub fn observe(
    source: &dyn PixelSource,
    cameras: &[PosedCamera],
    lights: &[u32],
    viewing_distance: f64,
    interrupt: &AtomicBool,
) -> Vec<Observation> {
    observe_at(source, (cameras, lights), viewing_distance, interrupt, LONGEST)
}

fn observe_at(
    source: &dyn PixelSource,
    (cameras, lights): (&[PosedCamera], &[u32]),
    viewing_distance: f64,
    interrupt: &AtomicBool,
    longest: u32,
) -> Vec<Observation> {
    let is_over = || interrupt.load(Ordering::Relaxed);
    let gray = |(i, camera)| (!is_over()).then(|| Gray::of(source, i, camera, longest));
    let Some(views) = cameras.par_iter().enumerate().map(gray).collect::<Option<Vec<Gray>>>() else { return Vec::new() };
    let count = (CORNERS / views.len().max(1)).clamp(CORNERS_OF_ONE.0, CORNERS_OF_ONE.1);
    let of_view = |i: usize| -> Vec<Observation> {
        let (own, others) = (&views[i], neighbors(&views, lights, i, viewing_distance));
        if others.len() < 2 || is_over() {
            return Vec::new();
        }
        let (w, h) = source.size(i);
        let full = |k: usize, full: u32, n: usize| ((2 * k as u64 + 1) * full as u64 / (2 * n as u64)) as u32;
        let found = own.corners(count).into_par_iter().filter_map(|(x, y)| {
            let (px, py) = source.snap(i, full(x, w, own.width), full(y, h, own.height));
            if !source.counts(i, px, py) {
                return None;
            }
            let distance = Corner::new(own, (x, y), &others)?.distance(NEAREST * viewing_distance)?;
            Some(Observation { image: i as u32, x: px, y: py, distance: distance as f32 })
        });
        found.collect()
    };
    let found: Vec<Observation> = (0..views.len()).into_par_iter().flat_map(of_view).collect();
    if is_over() { Vec::new() } else { found }
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_geom::Camera;
    use diorama_geom::rng::Rng;

    /// The plane z = 0 with brightness `texture`, in front of cameras on an arc.
    struct Wall {
        texture: fn(f64, f64) -> f64,
        cameras: Vec<PosedCamera>,
        size: (u32, u32),
        stride: u32,
    }

    impl Wall {
        fn new(texture: fn(f64, f64) -> f64) -> Wall {
            Wall::sized(texture, (96, 96), 1)
        }

        fn sized(texture: fn(f64, f64) -> f64, size: (u32, u32), stride: u32) -> Wall {
            let posed = |i: usize| {
                let turn = (i as f64 - 3.0) * 0.12;
                let eye = DVec3::new(3.0 * turn.sin(), 0.2 * (i % 2) as f64, 3.0 * turn.cos());
                PosedCamera { camera: Camera::pinhole(size.0, size.1, 0.7), pose: Pose::look_at(eye, DVec3::ZERO, DVec3::Y) }
            };
            Wall { texture, cameras: (0..7).map(posed).collect(), size, stride }
        }

        fn distance(&self, image: usize, x: f64, y: f64) -> (DVec3, f64) {
            let PosedCamera { camera, pose } = &self.cameras[image];
            let d = pose.rotation * camera.direction(x, y);
            let t = -pose.translation.z / d.z;
            (pose.translation + d * t, t)
        }

        /// Number of observations, and how many of them are wrong by more than 2 %.
        fn observed(&self, longest: u32) -> (usize, usize) {
            let all = observe_at(self, (&self.cameras, &[]), 3.0, &AtomicBool::new(false), longest);
            let is_wrong = |o: &&Observation| {
                let (_, t) = self.distance(o.image as usize, o.x as f64 + 0.5, o.y as f64 + 0.5);
                (o.distance as f64 / t - 1.0).abs() > 0.02
            };
            (all.len(), all.iter().filter(is_wrong).count())
        }
    }

    impl PixelSource for Wall {
        fn images(&self) -> usize {
            self.cameras.len()
        }
        fn size(&self, _: usize) -> (u32, u32) {
            self.size
        }
        fn stride(&self) -> u32 {
            self.stride
        }
        fn snap(&self, _: usize, x: u32, y: u32) -> (u32, u32) {
            let s = self.stride;
            ((x / s * s + s / 2).min(self.size.0 - 1), (y / s * s + s / 2).min(self.size.1 - 1))
        }
        fn rgba(&self, image: usize, x: u32, y: u32) -> [f32; 4] {
            let (p, _) = self.distance(image, x as f64 + 0.5, y as f64 + 0.5);
            let v = (self.texture)(p.x, p.y) as f32;
            // Each image has its own exposure.
            let v = v * (1.0 + 0.1 * image as f32);
            [v, v, v, 1.0]
        }
        fn counts(&self, _: usize, x: u32, _: u32) -> bool {
            x < self.size.0 / 2
        }
    }

    /// Random brightness at lattice points, interpolated between them.
    fn irregular(x: f64, y: f64) -> f64 {
        let (x, y) = (14.0 * x, 14.0 * y);
        let at = |i: i64, j: i64| Rng::new(3, 0).uniform((((x.floor() as i64 + i) << 20) + y.floor() as i64 + j) as u64) as f64;
        let (u, v) = (x - x.floor(), y - y.floor());
        let row = |j| at(0, j) * (1.0 - u) + at(1, j) * u;
        0.1 + 0.4 * (row(0) * (1.0 - v) + row(1) * v)
    }

    #[test]
    fn photographs_of_one_light_are_compared() {
        let wall = Wall::new(irregular);
        let cameras: Vec<PosedCamera> = (0..2).flat_map(|_| wall.cameras.iter().copied()).collect();
        let views: Vec<Gray> = cameras.iter().enumerate().map(|(i, c)| Gray::of(&wall, i % 7, c, 800)).collect();
        let at = |v: &Gray| views.iter().position(|w| std::ptr::eq(w, v)).unwrap();
        let chosen = |lights: &[u32]| neighbors(&views, lights, 3, 3.0).into_iter().map(at).collect::<Vec<usize>>();
        let of_two: Vec<u32> = (0..14).map(|i| i / 7).collect();
        assert!(chosen(&of_two).len() > 2 && chosen(&of_two).iter().all(|i| *i < 7));
        // A light of two photographs has too few neighbors of its own.
        let of_many: Vec<u32> = (0..14).map(|i| if i == 3 || i == 4 { 9 } else { 0 }).collect();
        assert!(chosen(&of_many).iter().any(|i| *i != 4) && chosen(&of_many) == chosen(&[]));
    }

    #[test]
    fn distances_of_texture_are_right_and_only_where_pixels_count() {
        // Full size; reduced by two and by three, which do not divide the sides; and with one stored pixel in four.
        for (size, stride, longest) in [((96, 96), 1, 800), ((195, 193), 1, 98), ((290, 289), 1, 97), ((193, 195), 2, 98)] {
            let wall = Wall::sized(irregular, size, stride);
            let (found, wrong) = wall.observed(longest);
            println!("{size:?} stride {stride}: {wrong} of {found} are wrong");
            assert!(found > 300 && wrong * 30 < found, "{size:?}: {wrong} of {found} are wrong");
            let all = observe_at(&wall, (&wall.cameras, &[]), 3.0, &AtomicBool::new(false), longest);
            assert!(all.iter().all(|o| o.x < size.0 / 2));
        }
        let wall = Wall::new(irregular);
        assert_eq!(observe(&wall, &wall.cameras, &[], 3.0, &AtomicBool::new(true)), [], "interrupted");
    }

    #[test]
    fn odd_pictures_tell_nothing() {
        for size in [(1, 1), (3, 200), (4000, 4)] {
            assert_eq!(Wall::sized(irregular, size, 1).observed(800).0, 0, "{size:?}");
        }
    }

    #[test]
    fn plain_walls_regular_patterns_and_wrong_poses_tell_nothing() {
        let (plain, _) = Wall::new(|_, _| 0.5).observed(800);
        let (pattern, wrong) = Wall::new(|x, y| 0.4 + 0.2 * (40.0 * x).sin() * (40.0 * y).sin()).observed(800);
        let mut mixed = Wall::new(irregular);
        let (right, _) = mixed.observed(800);
        let turned = |(i, c): (usize, &PosedCamera)| {
            let target = DVec3::new(0.5 * (2.3 * i as f64).sin(), 0.5 * (3.1 * i as f64).cos(), 0.0);
            PosedCamera { camera: c.camera, pose: Pose::look_at(c.pose.translation, target, DVec3::Y) }
        };
        let turned: Vec<PosedCamera> = mixed.cameras.iter().enumerate().map(turned).collect();
        let wrong_poses = observe(&mixed, &turned, &[], 3.0, &AtomicBool::new(false)).len();
        mixed.cameras.truncate(2);
        let too_few = observe(&mixed, &mixed.cameras, &[], 3.0, &AtomicBool::new(false)).len();
        println!("plain {plain}, pattern {wrong} wrong of {pattern}, turned {wrong_poses} of {right}, two views {too_few}");
        assert_eq!((plain, too_few), (0, 0));
        assert!(wrong * 20 < right && wrong_poses * 20 < right);
    }
}
