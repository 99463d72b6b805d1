//! Cameras of a person who films while walking.

use diorama_geom::glam::{DVec3, dvec3};
use diorama_geom::rng::Rng;
use diorama_geom::{Camera, Pose};

/// Field of view over the longer side of the image in radians.
const FOV: f64 = 1.1;

/// Points at which the camera's path begins and ends, and from where to where it looks. Halfway, the path is as far from the straight line as
/// `bulge` says.
pub struct CameraPath {
    pub from: [f64; 3],
    pub to: [f64; 3],
    pub bulge: [f64; 3],
    pub looks_from: [f64; 3],
    pub looks_to: [f64; 3],
    /// Standard deviations of the eye and of where it looks.
    pub sway: f64,
    pub glance: f64,
}

impl CameraPath {
    /// Cameras along the path; eyes are moved toward a point by a share of the distance, and what they look at by more, so that the point
    /// stays in sight.
    pub fn cameras(&self, n: usize, (width, height): (u32, u32), toward: (DVec3, f64), rng: &Rng) -> Vec<(Camera, Pose)> {
        let fov_x = if width >= height { FOV } else { 2.0 * ((0.5 * FOV).tan() * width as f64 / height as f64).atan() };
        let camera = Camera::pinhole(width, height, fov_x);
        let random = |i: usize, k: u64| {
            let v = |axis: u64| (rng.normal(64 * i as u64 + 8 * k + axis) as f64).clamp(-2.0, 2.0);
            dvec3(v(0), v(1), v(2))
        };
        let pose = |i: usize| {
            let t = (i as f64 + 0.5) / n as f64;
            let swing = (std::f64::consts::PI * t).sin();
            let line = |a: [f64; 3], b: [f64; 3]| DVec3::from(a).lerp(DVec3::from(b), t);
            let eye = line(self.from, self.to) + swing * DVec3::from(self.bulge) + self.sway * random(i, 0);
            let target = line(self.looks_from, self.looks_to) + self.glance * random(i, 1);
            let (toward, share) = toward;
            let (eye, target) = (eye.lerp(toward, share), target.lerp(toward, 1.0 - (1.0 - share).powi(2)));
            (camera, Pose::look_at(eye, target, DVec3::Z))
        };
        (0..n).map(pose).collect()
    }
}
