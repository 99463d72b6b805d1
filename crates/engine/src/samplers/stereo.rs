//! Distances of corners in photographs with known poses: a sweep over depths that compares patches of neighbouring views by normalized
//! cross-correlation (plane sweep, Collins 1996; for single corners instead of whole planes).

use super::pixels::{Observation, PixelSource};
use diorama_geom::Camera;
use diorama_geom::glam::{DVec2, DVec3};
use diorama_kernels::ops::ray_generation::PosedCamera;
use rayon::prelude::*;

/// Photographs are compared at this many pixels along their longer side, or less.
const LONGEST: u32 = 800;
/// Corners in all photographs together, and fewest and most in one.
const CORNERS: usize = 60_000;
const CORNERS_OF_ONE: (usize, usize) = (200, 2000);
/// Smallest eigenvalue of the mean structure tensor at a corner, in squared brightness (1: white) per pixel.
const TEXTURE: f32 = 2e-5;
/// Pixels beside a patch's middle.
const RADIUS: i32 = 3;
const PATCH: usize = (2 * RADIUS as usize + 1).pow(2);

/// Angles in degrees, at what is looked at, between a photograph and those that it is compared with; and the least and the greatest.
const ANGLES: [f64; 4] = [6.0, 10.0, 16.0, 24.0];
const ANGLE_RANGE: (f64, f64) = (1.5, 40.0);
/// Nothing is looked for nearer than this share of the distance at which cameras look.
const NEAREST: f64 = 0.2;
/// Most depths of a sweep; neighbouring ones are a pixel apart in the first neighbour.
const DEPTHS: usize = 400;
/// Depths that are looked at more closely, in parts of a step to either side.
const PEAKS: usize = 4;
const PARTS: i32 = 8;

/// Least correlation of a depth that is looked at more closely, of a neighbour that agrees, and of all that agree in the mean.
const PEAK: f32 = 0.7;
const AGREES: f32 = 0.75;
const SURE: f32 = 0.85;
/// How much worse any other depth must be.
const MARGIN: f32 = 0.06;
/// Neighbours that must agree.
const FEWEST: usize = 3;

/// A photograph's brightness, reduced, with the camera that took it.
struct Gray {
    width: usize,
    height: usize,
    /// Pixels of the photograph per pixel, along each side.
    by: u32,
    data: Vec<f32>,
    posed: PosedCamera,
    camera_from_world: diorama_geom::Pose,
}

impl Gray {
    fn of(source: &dyn PixelSource, image: usize, posed: &PosedCamera) -> Gray {
        let (w, h) = source.size(image);
        let by = w.max(h).div_ceil(LONGEST).max(1);
        let (width, height) = ((w / by).max(1), (h / by).max(1));
        let mut data = Vec::with_capacity((width * height) as usize);
        for y in 0..height {
            for x in 0..width {
                let mut sum = 0.0;
                for k in 0..by * by {
                    let (x, y) = source.snap(image, x * by + k % by, y * by + k / by);
                    let [r, g, b, _] = source.rgba(image, x, y);
                    sum += 0.3 * r + 0.6 * g + 0.1 * b;
                }
                data.push(sum / (by * by) as f32);
            }
        }
        let camera = Camera { width, height, ..posed.camera.resized(width * by, height * by).downscaled(by) };
        let posed = PosedCamera { camera, pose: posed.pose };
        Gray { width: width as usize, height: height as usize, by, data, camera_from_world: posed.pose.inverse(), posed }
    }

    /// Where a point in the world is seen, pixel centers at halves.
    fn project(&self, p: DVec3) -> Option<DVec2> {
        self.posed.camera.project(self.camera_from_world.point(p))
    }

    /// Brightness between pixel centers; the caller stays half a pixel away from the rim.
    #[inline(always)]
    fn at(&self, x: f32, y: f32) -> f32 {
        let (x, y) = (x - 0.5, y - 0.5);
        let (i, j) = (x as usize, y as usize);
        let (u, v) = (x - i as f32, y - j as f32);
        let row = j * self.width + i;
        let (a, b) = (self.data[row], self.data[row + 1]);
        let (c, d) = (self.data[row + self.width], self.data[row + self.width + 1]);
        let (top, bottom) = (a + u * (b - a), c + u * (d - c));
        top + v * (bottom - top)
    }

    /// The strongest corner of each cell of a grid, away from the rim.
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
                let gx = 0.5 * (self.data[at + 1] - self.data[at - 1]);
                let gy = 0.5 * (self.data[at + self.width] - self.data[at - self.width]);
                (a, b, c) = (a + gx * gx, b + gx * gy, c + gy * gy);
            }
        }
        (0.5 * (a + c) - (0.25 * (a - c).powi(2) + b * b).sqrt()) / 25.0
    }
}

/// Brightness without its mean, of unit length.
fn normalized(mut patch: [f32; PATCH]) -> Option<[f32; PATCH]> {
    let mean = patch.iter().sum::<f32>() / PATCH as f32;
    patch.iter_mut().for_each(|v| *v -= mean);
    let length = patch.iter().map(|v| v * v).sum::<f32>().sqrt();
    (length > 1e-3).then(|| patch.map(|v| v / length))
}

/// A corner of a photograph with the rays through it and beside it.
struct Corner<'a> {
    patch: [f32; PATCH],
    eye: DVec3,
    /// Through the corner's middle, one pixel to the right, one pixel below; on a plane at distance one.
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
            *p = own.data[(y as i32 + j) as usize * own.width + (x as i32 + i) as usize];
        }
        let rays = [middle, beside(ray(cx + 1.0, cy)), beside(ray(cx, cy + 1.0))];
        Some(Corner { patch: normalized(patch)?, eye: pose.translation, rays, others })
    }

    /// Where a neighbour sees the patch at a distance: its middle, and how it moves with the patch's pixels.
    fn seen(&self, other: usize, distance: f64) -> Option<[DVec2; 3]> {
        let other = self.others[other];
        let [m, x, y] = self.rays.map(|r| other.project(self.eye + r * distance));
        let (m, x, y) = (m?, x? - m?, y? - m?);
        let reach = RADIUS as f64 * (x.abs() + y.abs()) + 1.5;
        let fits = m.x > reach.x && m.y > reach.y && m.x < other.width as f64 - reach.x && m.y < other.height as f64 - reach.y;
        // A patch that is seen from the side, or much larger, is not the same patch.
        let size = x.perp_dot(y);
        (fits && (0.2..5.0).contains(&size)).then_some([m, x, y])
    }

    /// Normalized cross-correlation with a neighbour at a distance; none where it does not see the patch.
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

    /// How many neighbours agree on a distance, and their mean correlation.
    fn agreement(&self, distance: f64) -> (usize, f32) {
        let agreeing = (0..self.others.len()).filter_map(|o| self.correlation(o, distance)).filter(|c| *c > AGREES);
        let (n, sum) = agreeing.fold((0, 0.0), |(n, sum), c| (n + 1, sum + c));
        (n, sum / n.max(1) as f32)
    }

    /// The distance at which neighbours show the same patch, if they agree on one.
    fn distance(&self, nearest: f64) -> Option<f64> {
        let most = 1.0 / nearest;
        let steps = self.steps(most);
        let inverse = |k: f64| (most * k / steps as f64).max(1e-4 * most);
        let sweep: Vec<f32> = (0..=steps).map(|k| self.correlation(0, 1.0 / inverse(k as f64)).unwrap_or(-1.0)).collect();
        let of = |k: usize| sweep.get(k).copied().unwrap_or(-1.0);
        let is_peak = |k: &usize| of(*k) > PEAK && of(*k) >= of(k + 1) && (*k == 0 || of(*k) > of(k - 1));
        let mut peaks: Vec<usize> = (0..=steps).filter(is_peak).collect();
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
        // What lies at the end of the sweep may lie beyond it.
        let is_within = best.1 > 1.0 && best.1 < steps as f64 - 1.0;
        (is_unique && is_within && best.0.0 >= FEWEST.min(self.others.len()) && best.0.1 > SURE).then(|| 1.0 / inverse(best.1))
    }

    /// Depths from the horizon to the nearest, a pixel apart in the first neighbour.
    fn steps(&self, most: f64) -> usize {
        let at = |k: f64| self.others[0].project(self.eye + self.rays[0] / (most * k));
        // The near end may be outside of the neighbour's picture, or behind it: what the far half moves is doubled.
        let moved = [(1.0, 1.0), (0.5, 2.0), (0.25, 4.0)].into_iter().find_map(|(k, by)| Some((at(k)? - at(1e-3)?).length() * by));
        (moved.unwrap_or(DEPTHS as f64) as usize).clamp(16, DEPTHS)
    }
}

/// Pixels from a patch's middle to its `k`th.
#[inline(always)]
fn offset(k: usize) -> (i32, i32) {
    let side = 2 * RADIUS as usize + 1;
    ((k % side) as i32 - RADIUS, (k / side) as i32 - RADIUS)
}

/// The photographs that photograph `i` is compared with, the closest first.
fn neighbours(views: &[Gray], i: usize, looks_at: f64) -> Vec<&Gray> {
    let own = &views[i];
    let target = own.posed.pose.point(DVec3::Z * looks_at);
    let to_own = own.posed.pose.translation - target;
    let sees = |v: &Gray| v.project(target).is_some_and(|p| p.x > 0.0 && p.y > 0.0 && p.x < v.width as f64 && p.y < v.height as f64);
    let mut all: Vec<(f64, usize)> = (0..views.len())
        .filter(|j| *j != i && sees(&views[*j]))
        .map(|j| (to_own.angle_between(views[j].posed.pose.translation - target).to_degrees(), j))
        .filter(|(angle, _)| (ANGLE_RANGE.0..ANGLE_RANGE.1).contains(angle))
        .collect();
    let mut chosen = Vec::new();
    for wanted in ANGLES {
        let closest = (0..all.len()).min_by(|a, b| (all[*a].0 / wanted).ln().abs().total_cmp(&(all[*b].0 / wanted).ln().abs()));
        chosen.extend(closest.map(|k| all.swap_remove(k)));
    }
    chosen.sort_by(|a, b| a.0.total_cmp(&b.0));
    chosen.into_iter().map(|(_, j)| &views[j]).collect()
}

/// Pixels of photographs and how far away what they show is, where neighbouring photographs agree on it. `looks_at` is how far away
/// cameras look, in model space; cameras belong to the photographs, in their order.
pub fn observe(source: &dyn PixelSource, cameras: &[PosedCamera], looks_at: f64) -> Vec<Observation> {
    let views: Vec<Gray> = cameras.par_iter().enumerate().map(|(i, c)| Gray::of(source, i, c)).collect();
    let count = (CORNERS / views.len().max(1)).clamp(CORNERS_OF_ONE.0, CORNERS_OF_ONE.1);
    let of_view = |i: usize| -> Vec<Observation> {
        let (own, others) = (&views[i], neighbours(&views, i, looks_at));
        if others.len() < 2 {
            return Vec::new();
        }
        let found = own.corners(count).into_par_iter().filter_map(|(x, y)| {
            let (px, py) = (x as u32 * own.by + own.by / 2, y as u32 * own.by + own.by / 2);
            let (px, py) = source.snap(i, px, py);
            if !source.counts(i, px, py) {
                return None;
            }
            let distance = Corner::new(own, (x, y), &others)?.distance(NEAREST * looks_at)?;
            Some(Observation { image: i as u32, x: px, y: py, distance: distance as f32 })
        });
        found.collect()
    };
    (0..views.len()).into_par_iter().flat_map(of_view).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_geom::Pose;
    use diorama_geom::rng::Rng;

    const SIZE: u32 = 96;

    /// The plane z = 0, as bright as `texture` says, before cameras on an arc.
    struct Wall {
        texture: fn(f64, f64) -> f64,
        cameras: Vec<PosedCamera>,
    }

    impl Wall {
        fn new(texture: fn(f64, f64) -> f64) -> Wall {
            let posed = |i: usize| {
                let turn = (i as f64 - 3.0) * 0.12;
                let eye = DVec3::new(3.0 * turn.sin(), 0.2 * (i % 2) as f64, 3.0 * turn.cos());
                PosedCamera { camera: Camera::pinhole(SIZE, SIZE, 0.7), pose: Pose::look_at(eye, DVec3::ZERO, DVec3::Y) }
            };
            Wall { texture, cameras: (0..7).map(posed).collect() }
        }

        fn distance(&self, image: usize, x: f64, y: f64) -> (DVec3, f64) {
            let PosedCamera { camera, pose } = &self.cameras[image];
            let d = pose.rotation * camera.direction(x, y);
            let t = -pose.translation.z / d.z;
            (pose.translation + d * t, t)
        }

        /// Observations, and those of them that are wrong by more than two hundredths.
        fn observed(&self) -> (usize, usize) {
            let all = observe(self, &self.cameras, 3.0);
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
            (SIZE, SIZE)
        }
        fn rgba(&self, image: usize, x: u32, y: u32) -> [f32; 4] {
            let (p, _) = self.distance(image, x as f64 + 0.5, y as f64 + 0.5);
            let v = (self.texture)(p.x, p.y) as f32;
            // Exposure differs.
            let v = v * (1.0 + 0.1 * image as f32);
            [v, v, v, 1.0]
        }
        fn counts(&self, _: usize, x: u32, _: u32) -> bool {
            x < SIZE / 2
        }
    }

    /// Random brightness between points of a lattice.
    fn irregular(x: f64, y: f64) -> f64 {
        let (x, y) = (14.0 * x, 14.0 * y);
        let at = |i: i64, j: i64| Rng::new(3, 0).uniform((((x.floor() as i64 + i) << 20) + y.floor() as i64 + j) as u64) as f64;
        let (u, v) = (x - x.floor(), y - y.floor());
        let row = |j| at(0, j) * (1.0 - u) + at(1, j) * u;
        0.1 + 0.4 * (row(0) * (1.0 - v) + row(1) * v)
    }

    #[test]
    fn distances_of_texture_are_right_and_only_where_pixels_count() {
        let wall = Wall::new(irregular);
        let (found, wrong) = wall.observed();
        assert!(found > 300 && wrong * 50 < found, "{wrong} of {found} are wrong");
        assert!(observe(&wall, &wall.cameras, 3.0).iter().all(|o| o.x < SIZE / 2));
    }

    #[test]
    fn plain_walls_regular_patterns_and_wrong_poses_tell_nothing() {
        let (plain, _) = Wall::new(|_, _| 0.5).observed();
        let (pattern, wrong) = Wall::new(|x, y| 0.4 + 0.2 * (40.0 * x).sin() * (40.0 * y).sin()).observed();
        let mut mixed = Wall::new(irregular);
        let (right, _) = mixed.observed();
        let turned = |(i, c): (usize, &PosedCamera)| {
            let target = DVec3::new(0.5 * (2.3 * i as f64).sin(), 0.5 * (3.1 * i as f64).cos(), 0.0);
            PosedCamera { camera: c.camera, pose: Pose::look_at(c.pose.translation, target, DVec3::Y) }
        };
        let turned: Vec<PosedCamera> = mixed.cameras.iter().enumerate().map(turned).collect();
        let wrong_poses = observe(&mixed, &turned, 3.0).len();
        mixed.cameras.truncate(2);
        let too_few = observe(&mixed, &mixed.cameras, 3.0).len();
        println!("plain {plain}, pattern {wrong} wrong of {pattern}, turned {wrong_poses} of {right}, two views {too_few}");
        assert_eq!((plain, too_few), (0, 0));
        assert!(wrong * 20 < right && wrong_poses * 20 < right);
    }
}
