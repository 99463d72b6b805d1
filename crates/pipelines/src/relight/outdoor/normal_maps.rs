//! Normals of the learned surfaces as the training cameras see them: planes through the distances around each pixel.
//!
//! Seen by a camera, the inverse depth of a plane is linear in the image, `1/z = a x + b y + c`, and its normal is along `(a, b, c)`. Fits are
//! robust, so that what stands before or behind does not count. Where a plane along one of the place's main directions, which are those that
//! most fits agree on, explains the distances as well, it is taken instead: it has less freedom to follow noise. Level ground is told by its
//! height, as its distances are too noisy for a plane.

use super::config::Stage;
use super::model::SceneModel;
use super::visibility::spread;
use diorama_engine::renderers::volume::{Quality, Tracer};
use diorama_engine::samplers::pixels::Observation;
use diorama_geom::Image;
use diorama_geom::glam::{DMat3, DVec3, Vec3};
use diorama_kernels::ops::ray_generation::PosedCamera;
use levels::{Levels, Sight};
use rayon::prelude::*;

mod levels;

/// Pixels along the longer side at most, and pixels of all maps together.
const LONGEST: u32 = 320;
const PIXELS: f64 = 3e6;
/// Reach of a window to each side and distance of the pixels in it that are used: a plane must be larger than the noise of its distances.
const REACH: i32 = 8;
const STRIDE: usize = 2;
/// Relative difference of inverse depths beyond which a pixel is of something else, and rounds of the robust fit.
const APART: f64 = 0.005;
const ROUNDS: usize = 4;
/// Opacity from which there is a surface, and the mean weight in a window from which it is plane enough.
const SURFACE: f32 = 0.5;
const PLANE: f64 = 0.15;
/// Share of the free fit's support from which a plane along a main direction is taken.
const SUPPORTED: f64 = 0.55;
/// Mean weight in a window from which its plane tells distances, and by how much at most it moves them.
const FLAT: f64 = 0.4;
const FLATTENED: f64 = 0.005;
/// Where ground may be uneven: sine of the angle below the horizon, relative difference of its distances, cosine between up and upright
/// planes, and share of the support that these may have.
const DOWN: f64 = 0.04;
const UNEVEN: f64 = 0.06;
const UPRIGHT: f64 = 0.5;
const LESS: f64 = 0.9;
/// Least cosine between up and a plane that is fitted to them freely.
const LEVEL: f64 = 0.97;
/// Relative difference of distances that is none.
const SAME: f64 = 0.05;
/// Normals of which the main directions are found, directions that are tried, and most that are kept.
const SAMPLED: usize = 50_000;
const TRIED: usize = 3000;
const MOST: usize = 12;
/// Angles in radians within which normals support a direction, and within which they support no other; and the least share of all.
const NEAR: f32 = 0.14;
const OWN: f32 = 0.26;
const SHARE: f32 = 0.02;

/// Maps of the training cameras.
pub struct NormalMaps {
    maps: Vec<Map>,
    /// Map of each camera that has one, and its width and height.
    of: Vec<Option<(usize, [f32; 2])>>,
}

struct Map {
    width: usize,
    height: usize,
    /// In model space; 0 where it is not known.
    normals: Vec<Vec3>,
    /// Distance along the ray to the plane; 0 where few distances lie on it.
    distances: Vec<f32>,
    camera: PosedCamera,
    /// Distances of the surface.
    depth: Image,
}

/// Distances of a view.
struct Seen {
    width: usize,
    height: usize,
    camera: PosedCamera,
    depth: Image,
    to_model: DMat3,
    /// Rays whose component along the view axis is 1.
    rays: Vec<DVec3>,
    /// 0 where there is no surface.
    inverse: Vec<f64>,
}

/// A plane in a camera's space, `n · p = 1` scaled to `(a, b, c)` of `1/z`, and the sum of the weights of what lies on it.
#[derive(Clone, Copy)]
struct Plane {
    of: DVec3,
    support: f64,
}

impl NormalMaps {
    /// Of a model's surfaces. Cameras that stand alike share a map; so many that their maps would be large together get smaller ones.
    pub fn of(model: &SceneModel, cameras: &[PosedCamera]) -> NormalMaps {
        let (shown, of) = apart(cameras);
        let by = (PIXELS / pixels(&shown)).sqrt().min(1.0);
        let of = of.iter().zip(cameras).map(|(map, c)| Some((*map, size(c)))).collect();
        NormalMaps::shown(model, shown.iter().map(|c| shrunk(c, by)).collect(), of)
    }

    /// Of some of the cameras, as many as have large maps; `turn` says which of them, so that each has its turn.
    pub fn of_some(model: &SceneModel, cameras: &[PosedCamera], turn: usize) -> NormalMaps {
        let (shown, of) = apart(cameras);
        let every = ((pixels(&shown) / PIXELS).ceil() as usize).max(1);
        let is_used = |map: usize| map % every == turn % every;
        let place = |map: usize| is_used(map).then(|| map / every);
        let of = of.iter().zip(cameras).map(|(map, c)| Some((place(*map)?, size(c)))).collect();
        let used = shown.iter().enumerate().filter(|(map, _)| is_used(*map)).map(|(_, c)| shrunk(c, 1.0));
        NormalMaps::shown(model, used.collect(), of)
    }

    fn shown(model: &SceneModel, shown: Vec<PosedCamera>, of: Vec<Option<(usize, [f32; 2])>>) -> NormalMaps {
        let seen: Vec<Seen> = shown.iter().map(|c| Seen::of(model, c)).collect();
        let free: Vec<Vec<Option<Plane>>> = seen.iter().map(Seen::free_planes).collect();
        let main = main_directions(&seen, &free);
        let every = seen.iter().map(|s| s.rays.len()).sum::<usize>().div_ceil(SAMPLED).max(1);
        let levels = Levels::of(seen.iter().flat_map(|s| (0..s.rays.len()).filter_map(|i| s.sight(i))).step_by(every));
        let maps = seen.iter().zip(&free).map(|(s, f)| s.map(f, &main, &levels));
        NormalMaps { maps: maps.collect(), of }
    }

    /// Normal at a pixel of a training camera; 0 where it is not known.
    pub fn at(&self, image: usize, x: f32, y: f32) -> Vec3 {
        self.pixel(image, x, y).map_or(Vec3::ZERO, |(map, i)| map.normals[i])
    }

    /// The map of a training camera, and the index in it of a pixel.
    fn pixel(&self, image: usize, x: f32, y: f32) -> Option<(&Map, usize)> {
        let (map, [w, h]) = self.of[image]?;
        let map = &self.maps[map];
        let at = |v: f32, of: f32, n: usize| ((v / of * n as f32) as usize).min(n - 1);
        Some((map, at(y, h, map.height) * map.width + at(x, w, map.width)))
    }

    /// Whether a pixel of a training camera lies on a plane: edges, steps and lumps do not.
    pub fn is_flat(&self, image: usize, x: f32, y: f32) -> bool {
        self.pixel(image, x, y).is_some_and(|(map, i)| map.distances[i] > 0.0)
    }

    /// Whether a training camera sees a point.
    pub fn shows(&self, image: usize, point: Vec3) -> bool {
        self.of[image].is_some_and(|(map, _)| sees(&self.maps[map].camera, &self.maps[map].depth, point.as_dvec3()))
    }

    /// Distances to the planes, of about `count` pixels of the cameras' photographs.
    pub fn observations(&self, count: usize) -> Vec<Observation> {
        let known = |m: &Map| m.distances.iter().filter(|d| **d > 0.0).count();
        let all: usize = self.of.iter().flatten().map(|(map, _)| known(&self.maps[*map])).sum();
        let every = all.div_ceil(count).max(1);
        let of_one = |(image, (map, size)): (usize, &(usize, [f32; 2]))| {
            let map = &self.maps[*map];
            let at = move |i: usize, n: usize, full: f32| ((i as f32 + 0.5) * full / n as f32) as u32;
            let size = *size;
            let all = map.distances.iter().enumerate().filter(|(_, d)| **d > 0.0);
            all.skip(image % every).step_by(every).map(move |(i, distance)| {
                let (x, y) = (at(i % map.width, map.width, size[0]), at(i / map.width, map.height, size[1]));
                Observation { image: image as u32, x, y, distance: *distance }
            })
        };
        self.of.iter().enumerate().filter_map(|(i, of)| Some((i, of.as_ref()?))).flat_map(of_one).collect()
    }
}

impl Seen {
    fn of(model: &SceneModel, small: &PosedCamera) -> Seen {
        // The same surfaces whether light is about to be told apart or has been.
        let tracer = Tracer { cube: model.cube_in(Stage::Light), ..model.tracer(Quality::Full) };
        let view = tracer.layers(small, &model.unlit_codes(), &mut |_| {});
        let (w, h) = (view.depth.width, view.depth.height);
        let rays: Vec<DVec3> = (0..w * h).map(|i| small.camera.direction((i % w) as f64 + 0.5, (i / w) as f64 + 0.5)).collect();
        let inverse = |i: usize| {
            let (d, r) = (view.depth.data[i] as f64, rays[i]);
            // Depth along the view axis is the distance times the ray's third component.
            if view.opacity.data[i] > SURFACE && d > 0.0 && r.z > 0.0 { r.length() / (d * r.z) } else { 0.0 }
        };
        let inverse = (0..w * h).map(inverse).collect();
        let rays = rays.iter().map(|r| *r / r.z).collect();
        Seen { width: w, height: h, camera: *small, depth: view.depth, to_model: small.pose.rotation, rays, inverse }
    }

    /// The ray of a pixel that shows a surface.
    fn sight(&self, i: usize) -> Option<Sight> {
        let (ray, length) = (self.rays[i], self.rays[i].length());
        let sight =
            || Sight { eye: self.camera.pose.translation.z, down: -(self.to_model * ray).z / length, distance: length / self.inverse[i] };
        (self.inverse[i] > 0.0).then(sight)
    }

    /// Rays and inverse depths around a pixel, and how many there would be in a full window.
    fn window(&self, i: usize) -> (Vec<(DVec3, f64)>, usize) {
        let (px, py) = ((i % self.width) as i32, (i / self.width) as i32);
        let (mut near, mut all) = (Vec::with_capacity(81), 0);
        for dy in (-REACH..=REACH).step_by(STRIDE) {
            for dx in (-REACH..=REACH).step_by(STRIDE) {
                let (x, y) = (px + dx, py + dy);
                if x < 0 || y < 0 || x >= self.width as i32 || y >= self.height as i32 {
                    continue;
                }
                all += 1;
                let at = y as usize * self.width + x as usize;
                if self.inverse[at] > 0.0 {
                    near.push((self.rays[at], self.inverse[at]));
                }
            }
        }
        (near, all)
    }

    /// The plane through the distances around each pixel.
    fn free_planes(&self) -> Vec<Option<Plane>> {
        (0..self.inverse.len()).into_par_iter().map(|i| self.free_plane(i)).collect()
    }

    fn free_plane(&self, i: usize) -> Option<Plane> {
        if self.inverse[i] <= 0.0 {
            return None;
        }
        let (near, all) = self.window(i);
        self.plane_through(i, (&near, all), APART)
    }

    /// The plane through distances, of which those that differ more do not count.
    fn plane_through(&self, i: usize, (near, all): (&[(DVec3, f64)], usize), apart: f64) -> Option<Plane> {
        let own = self.inverse[i];
        let center = DVec3::new(self.rays[i].x, self.rays[i].y, 0.0);
        let (mut plane, mut support) = (DVec3::new(0.0, 0.0, own), 0.0);
        for round in 0..ROUNDS {
            let (mut m, mut v) = (DMat3::from_diagonal(DVec3::splat(1e-12)), DVec3::ZERO);
            support = 0.0;
            for (ray, value) in near {
                let row = *ray - center;
                // At first, all that is as far away counts alike, whatever its slope.
                let (off, wide) = if round == 0 { (value - own, 10.0) } else { (row.dot(plane) - value, 1.0) };
                let weight = agreement(off / (wide * apart * own));
                support += weight;
                m += DMat3::from_cols(weight * row.x * row, weight * row.y * row, weight * row.z * row);
                v += weight * value * row;
            }
            plane = m.inverse() * v;
        }
        let of = DVec3::new(plane.x, plane.y, plane.z - plane.x * center.x - plane.y * center.y);
        (of.is_finite() && support >= PLANE * all as f64).then_some(Plane { of, support })
    }

    /// The plane of a given normal, in the camera's space, that most distances around a pixel agree on; none where it faces away.
    fn plane_along(&self, i: usize, near: &[(DVec3, f64)], normal: DVec3, apart: f64) -> Option<Plane> {
        let offset = |ray: DVec3, inverse: f64| normal.dot(ray) / inverse;
        let mut at = offset(self.rays[i], self.inverse[i]);
        if at * self.inverse[i] > -0.05 * self.rays[i].length() {
            return None;
        }
        let mut support = 0.0;
        for _ in 0..ROUNDS {
            let (mut sum, mut weights) = (0.0, 0.0);
            for (ray, inverse) in near {
                let own = offset(*ray, *inverse);
                let weight = if own < 0.0 { agreement((at / own - 1.0) / apart) } else { 0.0 };
                (sum, weights) = (sum + weight * own, weights + weight);
            }
            if weights <= 0.0 {
                return None;
            }
            (at, support) = (sum / weights, weights);
        }
        Some(Plane { of: normal / at, support })
    }

    /// The level plane through uneven distances below the camera; none where an upright one explains them as well. Ground is seen from close
    /// above it and has little texture, so that its distances are those of lumps.
    fn level(&self, i: usize, (near, all): (&[(DVec3, f64)], usize), (up, main): (DVec3, &[DVec3])) -> Option<Plane> {
        if self.rays[i].dot(up) > -DOWN * self.rays[i].length() {
            return None;
        }
        let level = self.plane_along(i, near, up, UNEVEN).filter(|p| p.support > FLAT * all as f64)?;
        // Stairs and slopes are not level.
        let free = self.plane_through(i, (near, all), UNEVEN)?;
        if free.of.normalize_or_zero().dot(up).abs() < LEVEL {
            return None;
        }
        let mut upright = main.iter().filter(|m| m.dot(up).abs() < UPRIGHT).filter_map(|m| self.plane_along(i, near, *m, UNEVEN));
        upright.all(|p| p.support < LESS * level.support).then_some(level)
    }

    /// The normals, each of level ground, of the free plane or of one along a main direction.
    fn map(&self, free: &[Option<Plane>], main: &[Vec3], levels: &Levels) -> Map {
        let main: Vec<DVec3> = main.iter().map(|m| self.to_model.transpose() * m.as_dvec3()).collect();
        let up = self.to_model.transpose() * DVec3::Z;
        let of = |i: usize| {
            let Some(sight) = self.sight(i) else { return (Vec3::ZERO, 0.0) };
            if let Some(distance) = levels.distance(&sight) {
                return (Vec3::Z, distance as f32);
            }
            let (near, all) = self.window(i);
            let along = main.iter().filter_map(|m| self.plane_along(i, &near, *m, APART));
            let best = along.max_by(|a, b| a.support.total_cmp(&b.support));
            let best = free[i].map(|own| best.filter(|b| b.support >= SUPPORTED * own.support).unwrap_or(own));
            let (plane, flattened) = match best.filter(|p| p.support > FLAT * all as f64) {
                Some(plane) => (plane, FLATTENED),
                None => match (self.level(i, (&near, all), (up, &main)), best) {
                    (Some(level), _) => (level, UNEVEN),
                    (None, Some(plane)) => (plane, 0.0),
                    (None, None) => return (Vec3::ZERO, 0.0),
                },
            };
            let inverse = plane.of.dot(self.rays[i]);
            let is_on = (inverse / self.inverse[i] - 1.0).abs() < flattened;
            (self.normal(i, plane), if is_on { (self.rays[i].length() / inverse) as f32 } else { 0.0 })
        };
        let (normals, distances) = (0..free.len()).into_par_iter().map(of).unzip();
        Map { width: self.width, height: self.height, normals, distances, camera: self.camera, depth: self.depth.clone() }
    }

    /// Normal of a plane in model space, toward the camera.
    fn normal(&self, i: usize, plane: Plane) -> Vec3 {
        let sign = if plane.of.dot(self.rays[i]) > 0.0 { -1.0 } else { 1.0 };
        (sign * (self.to_model * plane.of).normalize_or_zero()).as_vec3()
    }
}

/// The cameras that stand apart, and which of them each camera stands like.
fn apart(cameras: &[PosedCamera]) -> (Vec<PosedCamera>, Vec<usize>) {
    let mut shown: Vec<PosedCamera> = Vec::new();
    let is_same = |a: &PosedCamera, b: &PosedCamera| a.pose == b.pose && a.camera == b.camera;
    let of = cameras.iter().map(|c| {
        shown.iter().position(|s| is_same(s, c)).unwrap_or_else(|| {
            shown.push(*c);
            shown.len() - 1
        })
    });
    let of = of.collect();
    (shown, of)
}

/// Width and height of a camera's photographs.
fn size(camera: &PosedCamera) -> [f32; 2] {
    [camera.camera.width as f32, camera.camera.height as f32]
}

/// Pixels of the largest maps of cameras.
fn pixels(cameras: &[PosedCamera]) -> f64 {
    cameras.iter().map(|c| shrunk(c, 1.0).camera).map(|c| c.width as f64 * c.height as f64).sum()
}

/// A camera of at most [`LONGEST`] pixels along its longer side, times a factor.
fn shrunk(camera: &PosedCamera, by: f64) -> PosedCamera {
    let c = &camera.camera;
    let shrink = by * (LONGEST as f64 / c.width.max(c.height) as f64).min(1.0);
    let size = |n: u32| ((n as f64 * shrink).round() as u32).max(1);
    PosedCamera { camera: c.resized(size(c.width), size(c.height)), pose: camera.pose }
}

/// Whether a camera sees a point at its distance, or a neighboring pixel does.
pub fn sees(camera: &PosedCamera, depth: &Image, point: DVec3) -> bool {
    let local = camera.pose.inverse().point(point);
    let Some(at) = camera.camera.project(local).filter(|_| local.z > 0.0) else { return false };
    let (x, y, distance) = (at.x.floor() as isize, at.y.floor() as isize, local.length());
    let is_inside = |x: isize, y: isize| (0..depth.width as isize).contains(&x) && (0..depth.height as isize).contains(&y);
    is_inside(x, y)
        && (-1..=1).any(|dy| {
            (-1..=1).any(|dx| {
                let (x, y) = (x + dx, y + dy);
                is_inside(x, y) && (depth.data[y as usize * depth.width + x as usize] as f64 / distance - 1.0).abs() < SAME
            })
        })
}

/// How much a relative difference counts (Geman–McClure).
fn agreement(off: f64) -> f64 {
    1.0 / (1.0 + off * off).powi(2)
}

/// Directions that many normals share, the most frequent first.
fn main_directions(seen: &[Seen], free: &[Vec<Option<Plane>>]) -> Vec<Vec3> {
    let count: usize = free.iter().map(Vec::len).sum();
    let all = seen.iter().zip(free).flat_map(|(s, f)| f.iter().enumerate().map(move |(i, p)| p.map(|p| s.normal(i, p))));
    let mut normals: Vec<Vec3> = all.step_by(count.div_ceil(SAMPLED).max(1)).flatten().filter(|n| *n != Vec3::ZERO).collect();
    let least = SHARE * normals.len() as f32;
    let mut main = Vec::new();
    while main.len() < MOST {
        let within = |d: Vec3, angle: f32| normals.iter().filter(move |n| n.dot(d) > angle.cos());
        let tried = (0..TRIED).into_par_iter().map(|i| spread(i, TRIED).as_vec3());
        let Some((votes, mut best)) = tried.map(|d| (within(d, NEAR).count(), d)).max_by_key(|t| t.0) else { break };
        if (votes as f32) < least {
            break;
        }
        for _ in 0..5 {
            best = within(best, NEAR).sum::<Vec3>().normalize_or(best);
        }
        main.push(best);
        normals.retain(|n| n.dot(best) < OWN.cos());
    }
    main
}
