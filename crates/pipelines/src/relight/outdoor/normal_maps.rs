//! Normals of the learned surfaces as the training cameras see them: planes through the distances around each pixel.
//!
//! Seen by a camera, the inverse depth of a plane is linear in the image, `1/z = a x + b y + c`, and its normal is along `(a, b, c)`. Fits are
//! robust, so that what stands before or behind does not count.

use super::config::Stage;
use super::model::SceneModel;
use diorama_engine::renderers::volume::{Quality, Tracer};
use diorama_geom::glam::{DMat3, DVec3, Vec3};
use diorama_kernels::ops::ray_generation::PosedCamera;
use rayon::prelude::*;

/// Pixels along the longer side at most: a plane must be larger than the noise of its distances.
const LONGEST: u32 = 200;
/// Reach of a window to each side and distance of the pixels in it that are used.
const REACH: i32 = 6;
const STRIDE: usize = 2;
/// Relative difference of inverse depths beyond which a pixel is of something else, and rounds of the robust fit.
const APART: f64 = 0.01;
const ROUNDS: usize = 4;
/// Opacity from which there is a surface, and the mean weight in a window from which it is plane enough.
const SURFACE: f32 = 0.5;
const PLANE: f64 = 0.15;

/// Maps of the training cameras.
pub struct NormalMaps {
    maps: Vec<Map>,
    /// Map of each camera, and its width and height.
    of: Vec<(usize, [f32; 2])>,
}

struct Map {
    width: usize,
    height: usize,
    /// In model space; 0 where it is not known.
    normals: Vec<Vec3>,
}

impl NormalMaps {
    /// Of a model's surfaces. Cameras that stand alike share a map.
    pub fn of(model: &SceneModel, cameras: &[PosedCamera]) -> NormalMaps {
        let mut shown: Vec<PosedCamera> = Vec::new();
        let is_same = |a: &PosedCamera, b: &PosedCamera| a.pose == b.pose && a.camera == b.camera;
        let of = cameras.iter().map(|c| {
            let at = shown.iter().position(|s| is_same(s, c)).unwrap_or_else(|| {
                shown.push(*c);
                shown.len() - 1
            });
            (at, [c.camera.width as f32, c.camera.height as f32])
        });
        let of = of.collect();
        NormalMaps { maps: shown.iter().map(|c| map(model, c)).collect(), of }
    }

    /// Normal at a pixel of a training camera; 0 where it is not known.
    pub fn at(&self, image: usize, x: f32, y: f32) -> Vec3 {
        let (map, [w, h]) = self.of[image];
        let map = &self.maps[map];
        let at = |v: f32, of: f32, n: usize| ((v / of * n as f32) as usize).min(n - 1);
        map.normals[at(y, h, map.height) * map.width + at(x, w, map.width)]
    }
}

/// Depth of a view and its normals.
fn map(model: &SceneModel, camera: &PosedCamera) -> Map {
    let c = &camera.camera;
    let shrink = (LONGEST as f64 / c.width.max(c.height) as f64).min(1.0);
    let size = |n: u32| ((n as f64 * shrink).round() as u32).max(1);
    let small = PosedCamera { camera: c.resized(size(c.width), size(c.height)), pose: camera.pose };
    // The same surfaces whether light is about to be told apart or has been.
    let tracer = Tracer { cube: model.cube_in(Stage::Light), ..model.tracer(Quality::Full) };
    let codes: &[&[f32]] = if model.stage == Stage::Light { &[&[0.0; 9]] } else { &[] };
    let view = tracer.layers(&small, codes, &mut |_| {});
    let (w, h) = (view.depth.width, view.depth.height);
    let rays: Vec<DVec3> = (0..w * h).map(|i| small.camera.direction((i % w) as f64 + 0.5, (i / w) as f64 + 0.5)).collect();
    let inverse = |i: usize| {
        let (d, r) = (view.depth.data[i] as f64, rays[i]);
        // Depth along the view axis is the distance times the ray's third component.
        if view.opacity.data[i] > SURFACE && d > 0.0 { 1.0 / (d * r.z / r.length()) } else { 0.0 }
    };
    let inverse: Vec<f64> = (0..w * h).map(inverse).collect();
    let to_model = small.pose.rotation;
    let normals = (0..w * h).into_par_iter().map(|i| normal_at(i, w, h, &rays, &inverse, &to_model));
    Map { width: w, height: h, normals: normals.collect() }
}

/// Normal at one pixel.
fn normal_at(i: usize, w: usize, h: usize, rays: &[DVec3], inverse: &[f64], to_model: &DMat3) -> Vec3 {
    if inverse[i] <= 0.0 || rays[i].z <= 0.0 {
        return Vec3::ZERO;
    }
    let on_plane = |r: DVec3| [r.x / r.z, r.y / r.z];
    let [x0, y0] = on_plane(rays[i]);
    let (px, py) = ((i % w) as i32, (i / w) as i32);
    let mut near: Vec<([f64; 3], f64)> = Vec::with_capacity(49);
    let mut all = 0;
    for dy in (-REACH..=REACH).step_by(STRIDE) {
        for dx in (-REACH..=REACH).step_by(STRIDE) {
            let (x, y) = (px + dx, py + dy);
            if x < 0 || y < 0 || x >= w as i32 || y >= h as i32 {
                continue;
            }
            all += 1;
            let at = y as usize * w + x as usize;
            if inverse[at] > 0.0 && rays[at].z > 0.0 {
                let [x, y] = on_plane(rays[at]);
                near.push(([x - x0, y - y0, 1.0], inverse[at]));
            }
        }
    }
    let (mut plane, mut weights) = (DVec3::new(0.0, 0.0, inverse[i]), 0.0);
    for round in 0..ROUNDS {
        let (mut m, mut v) = (DMat3::from_diagonal(DVec3::splat(1e-12)), DVec3::ZERO);
        weights = 0.0;
        for (row, value) in &near {
            let row = DVec3::from(*row);
            // At first, all that is as far away counts alike, whatever its slope.
            let (off, wide) = if round == 0 { (value - inverse[i], 10.0) } else { (row.dot(plane) - value, 1.0) };
            let s = off / (wide * APART * inverse[i]);
            let weight = 1.0 / (1.0 + s * s).powi(2);
            weights += weight;
            m += DMat3::from_cols(weight * row.x * row, weight * row.y * row, weight * row.z * row);
            v += weight * value * row;
        }
        plane = m.inverse() * v;
    }
    if !plane.is_finite() || weights < PLANE * all as f64 {
        return Vec3::ZERO;
    }
    let facing = -DVec3::new(plane.x, plane.y, plane.z - plane.x * x0 - plane.y * y0);
    let normal = (*to_model * facing).normalize_or_zero();
    // Surfaces face the camera.
    let sign = if facing.dot(rays[i]) > 0.0 { -1.0 } else { 1.0 };
    (sign * normal).as_vec3()
}
