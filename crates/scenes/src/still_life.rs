//! The capture of `diorama quickstart`: a textured still life on a round table, photographed from two rings.

use crate::ray_caster::{Object, Scene, Shape, Texture};
use diorama_geom::glam::DVec3;
use diorama_geom::{Camera, ImageU8, Pose, SceneBox};
use rayon::prelude::*;

/// Edge of the photographs in pixels.
pub const SIZE: u32 = 160;

/// Number of views on both rings together; every eighth is held out.
pub const VIEWS: usize = 48;

/// A photograph of the capture.
pub struct Photo {
    pub name: String,
    pub camera: Camera,
    pub world_from_camera: Pose,
    pub image: ImageU8,
}

/// The objects of the scene, all within the unit ball.
pub fn scene() -> Scene {
    let rgb = DVec3::new;
    let objects = vec![
        Object {
            shape: Shape::Cylinder { center: rgb(0.0, 0.0, -0.42), radius: 0.92, half_height: 0.06 },
            texture: Texture::Checker { a: rgb(0.9, 0.88, 0.8), b: rgb(0.02, 0.02, 0.03), size: 0.17 },
            gloss: 0.0,
        },
        Object {
            shape: Shape::Sphere { center: rgb(0.3, 0.28, -0.08), radius: 0.28 },
            texture: Texture::Stripes { a: rgb(0.75, 0.05, 0.04), b: rgb(0.9, 0.8, 0.6), axis: rgb(0.6, 0.0, 0.8), size: 0.09 },
            gloss: 0.25,
        },
        Object {
            shape: Shape::Box { center: rgb(-0.34, 0.2, -0.11), half: rgb(0.2, 0.16, 0.25), angle: 0.5 },
            texture: Texture::Dots { a: rgb(0.95, 0.75, 0.05), b: rgb(0.02, 0.06, 0.3), size: 0.11 },
            gloss: 0.0,
        },
        Object {
            shape: Shape::Cylinder { center: rgb(-0.05, -0.42, -0.14), radius: 0.17, half_height: 0.22 },
            texture: Texture::Stripes { a: rgb(0.02, 0.3, 0.08), b: rgb(0.8, 0.85, 0.8), axis: rgb(0.0, 0.0, 1.0), size: 0.07 },
            gloss: 0.1,
        },
        Object {
            shape: Shape::Sphere { center: rgb(-0.05, -0.42, 0.2), radius: 0.13 },
            texture: Texture::Checker { a: rgb(0.5, 0.02, 0.4), b: rgb(0.95, 0.95, 0.95), size: 0.08 },
            gloss: 0.2,
        },
        Object {
            shape: Shape::Box { center: rgb(0.48, -0.3, -0.24), half: rgb(0.17, 0.12, 0.12), angle: -0.7 },
            texture: Texture::Rings { a: rgb(0.02, 0.02, 0.02), b: rgb(0.1, 0.6, 0.7), center: rgb(0.48, -0.3, 0.0), size: 0.05 },
            gloss: 0.0,
        },
    ];
    Scene { objects, sun: rgb(0.4, -0.5, 0.77).normalize(), ambient: 0.45 }
}

/// The scene box for training.
pub fn scene_box() -> SceneBox {
    SceneBox { center: DVec3::ZERO, half: 1.0, aabb_scale: 1 }
}

/// Pose of view `i` of `views`, alternating between the lower and the upper ring.
pub fn pose(i: usize, views: usize) -> Pose {
    let (ring, k) = (i % 2, i / 2);
    let angle = (k as f64 + 0.5 * ring as f64) / views.div_ceil(2) as f64 * std::f64::consts::TAU;
    let elevation: f64 = [0.35, 0.85][ring];
    let direction = DVec3::new(angle.cos() * elevation.cos(), angle.sin() * elevation.cos(), elevation.sin());
    Pose::look_at(direction * 3.0 + DVec3::new(0.0, 0.0, -0.12), DVec3::new(0.0, 0.0, -0.12), DVec3::Z)
}

/// Horizontal field of view in radians.
pub const FOV: f64 = 0.75;

/// Renders `views` photographs of `size × size` pixels with exact poses.
pub fn photographs(views: usize, size: u32) -> Vec<Photo> {
    let scene = scene();
    let camera = Camera::pinhole(size, size, FOV);
    (0..views)
        .into_par_iter()
        .map(|i| {
            let pose = pose(i, views);
            Photo { name: format!("view_{i:02}"), camera, world_from_camera: pose, image: scene.render(&camera, &pose, 4) }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_constant_image_scores_at_most_twelve_decibels() {
        let photos = photographs(VIEWS, SIZE / 2);
        let on_white = |p: &[u8]| -> [f64; 3] {
            let a = p[3] as f64 / 255.0;
            std::array::from_fn(|k| p[k] as f64 / 255.0 * a + 1.0 - a)
        };
        let pixels: Vec<[f64; 3]> = photos.iter().flat_map(|p| p.image.data.chunks_exact(4)).map(on_white).collect();
        let n = pixels.len() as f64;
        let mean: [f64; 3] = std::array::from_fn(|k| pixels.iter().map(|p| p[k]).sum::<f64>() / n);
        let mse = pixels.iter().map(|p| (0..3).map(|k| (p[k] - mean[k]).powi(2)).sum::<f64>() / 3.0).sum::<f64>() / n;
        let psnr = -10.0 * mse.log10();
        assert!(psnr <= 12.0, "{psnr}");
    }

    #[test]
    fn every_view_shows_the_still_life_whole() {
        for p in photographs(16, SIZE) {
            let border = |x: usize, y: usize| p.image.pixel(x, y)[3];
            let n = SIZE as usize;
            assert!((0..n).all(|i| border(i, 0) == 0 && border(i, n - 1) == 0 && border(0, i) == 0 && border(n - 1, i) == 0), "{}", p.name);
            assert!(p.image.pixel(n / 2, n / 2)[3] == 255);
        }
    }
}
