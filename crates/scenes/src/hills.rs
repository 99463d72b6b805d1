//! Hills with floaters above them: a surface with exact distances that every camera sees from above, to measure how meshes are cleaned and
//! reduced.

use diorama_geom::field_query::FieldQuery;
use diorama_geom::rng::Rng;
use diorama_geom::{Camera, Pose};
use glam::DVec3;

/// Half the edge of the square that the hills fill, and the height of the ground.
pub const HALF: f32 = 1.0;
pub const GROUND: f32 = -0.3;
/// Density at the surface, and its slope in inverse units: it is 0 from `1 / SLOPE` outside on.
pub const LEVEL: f32 = 1.0;
const SLOPE: f32 = 60.0;
/// Radii of hills, and how deep their centers lie, in radii: no slope is steeper than 60 degrees.
const HILL: (f32, f32) = (0.12, 0.5);
const DEPTH: f32 = 0.55;
/// Radii of floaters, and their heights.
const FLOATER: (f32, f32) = (0.006, 0.012);
const HEIGHT: (f32, f32) = (0.35, 0.6);
/// Cameras around.
const CAMERAS: usize = 16;

/// A ball.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ball {
    pub center: [f32; 3],
    pub radius: f32,
}

impl Ball {
    fn distance(&self, p: [f32; 3]) -> f32 {
        (0..3).map(|k| (p[k] - self.center[k]).powi(2)).sum::<f32>().sqrt() - self.radius
    }
}

/// The ground with hills, and floaters.
#[derive(Clone, Debug)]
pub struct Hills {
    pub hills: Vec<Ball>,
    pub floaters: Vec<Ball>,
}

impl Hills {
    /// Hills and so many floaters, drawn by a seed.
    pub fn new(hills: usize, floaters: usize, seed: u64) -> Hills {
        let rng = Rng::new(seed, 0x4177);
        let draw = |i: usize, k: u64, (a, b): (f32, f32)| a + (b - a) * rng.uniform(8 * i as u64 + k);
        let hill = |i: usize| {
            let radius = draw(i, 0, HILL);
            let center = [draw(i, 1, (-HALF, HALF)), draw(i, 2, (-HALF, HALF)), GROUND - DEPTH * radius];
            Ball { center, radius }
        };
        let inner = (-0.9 * HALF, 0.9 * HALF);
        let floater = |i: usize| {
            let i = hills + i;
            Ball { center: [draw(i, 1, inner), draw(i, 2, inner), draw(i, 3, HEIGHT)], radius: draw(i, 0, FLOATER) }
        };
        Hills { hills: (0..hills).map(hill).collect(), floaters: (0..floaters).map(floater).collect() }
    }

    /// Distance to the ground and its hills, without floaters, exact outside and near the surface; negative inside.
    pub fn distance(&self, p: [f32; 3]) -> f32 {
        self.hills.iter().map(|b| b.distance(p)).fold(p[2] - GROUND, f32::min)
    }

    /// Distance to the nearest floater; infinite without any.
    pub fn floater_distance(&self, p: [f32; 3]) -> f32 {
        self.floaters.iter().map(|b| b.distance(p)).fold(f32::INFINITY, f32::min)
    }

    /// Cameras in a ring above, which all see the whole square.
    pub fn cameras(&self) -> Vec<(Camera, Pose)> {
        let pose = |i: usize| {
            let a = i as f64 / CAMERAS as f64 * std::f64::consts::TAU;
            Pose::look_at(DVec3::new(1.6 * a.cos(), 1.6 * a.sin(), 3.0), DVec3::new(0.0, 0.0, GROUND as f64), DVec3::Z)
        };
        (0..CAMERAS).map(|i| (Camera::pinhole(800, 800, 0.95), pose(i))).collect()
    }

    /// Lowest and highest corner of the box that holds the ground and the floaters.
    pub fn bounds(&self) -> ([f32; 3], [f32; 3]) {
        ([-HALF, -HALF, GROUND - 0.1], [HALF, HALF, HEIGHT.1 + 2.0 * FLOATER.1])
    }
}

impl FieldQuery for Hills {
    fn density(&self, points: &[[f32; 3]], sigma: &mut [f32]) {
        use rayon::prelude::*;
        points.par_iter().zip(sigma).with_min_len(4096).for_each(|(p, s)| {
            *s = (LEVEL - SLOPE * self.distance(*p).min(self.floater_distance(*p))).max(0.0);
        });
    }

    /// Green below, white above.
    fn color(&self, points: &[[f32; 3]], _: &[[f32; 3]], rgb_srgb: &mut [[f32; 3]]) {
        points.iter().zip(rgb_srgb).for_each(|(p, c)| {
            let t = ((p[2] - GROUND) / 0.2).clamp(0.0, 1.0);
            *c = [0.2 + 0.7 * t, 0.5 + 0.4 * t, 0.2 + 0.7 * t];
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn floaters_hang_above_the_hills_and_cameras_see_the_square() {
        let h = Hills::new(30, 50, 0);
        assert!(h.floaters.iter().all(|b| h.distance(b.center) > 2.0 * b.radius));
        for (camera, pose) in h.cameras() {
            for corner in [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]] {
                let p = DVec3::new(corner[0], corner[1], GROUND as f64);
                let px = camera.project(pose.inverse().point(p)).unwrap();
                assert!(px.min_element() > 2.0 && px.max_element() < 798.0, "{px}");
            }
        }
        let at = h.hills[0].center;
        let mut sigma = [0.0; 2];
        h.density(&[at, [0.0, 0.0, 0.3]], &mut sigma);
        assert!(sigma[0] > LEVEL && sigma[1] == 0.0);
    }
}
