//! Which cameras see a point of a mesh, with their lens models and occlusion by the rest of the mesh.

use crate::bake::DepthMap;
use diorama_geom::{Camera, Mesh, Pose};
use glam::{DMat3, DVec2, DVec3};

/// Longest side of the depth maps, in pixels.
const MAP_PX: f64 = 400.0;
/// If a lens sees directions whose component along the axis is less than this, six depth maps on the sides of a cube are used.
const NARROW: f64 = 0.25;

/// Visibility of a mesh from one camera.
pub struct CameraVisibility {
    camera: Camera,
    camera_from_world: Pose,
    eye: DVec3,
    /// Pinhole depth maps that cover the camera's image: one, or the six sides of a cube.
    maps: Vec<DepthMap>,
}

impl CameraVisibility {
    /// Renders the depth maps of a camera.
    pub fn new(mesh: &Mesh, camera: &Camera, world_from_camera: &Pose) -> CameraVisibility {
        let maps = match reach(camera) {
            Some(reach) => {
                let f = 0.5 * MAP_PX / reach.max_element();
                let side = |r: f64| (2.0 * r * f).ceil().max(3.0) as u32;
                let (width, height) = (side(reach.x), side(reach.y));
                let pinhole =
                    Camera { fx: f, fy: f, cx: 0.5 * width as f64, cy: 0.5 * height as f64, ..Camera::pinhole(width, height, 1.0) };
                vec![DepthMap::new(mesh, pinhole, world_from_camera)]
            }
            None => sides()
                .map(|side| {
                    // Slightly more than a right angle, so that border pixels are covered.
                    let pinhole = Camera::pinhole(MAP_PX as u32, MAP_PX as u32, 1.6);
                    let pose = Pose { rotation: world_from_camera.rotation * side, translation: world_from_camera.translation };
                    DepthMap::new(mesh, pinhole, &pose)
                })
                .into(),
        };
        CameraVisibility { camera: *camera, camera_from_world: world_from_camera.inverse(), eye: world_from_camera.translation, maps }
    }

    /// Distance of a point that projects into the image, whether or not it is occluded.
    pub fn distance(&self, p_in_world: [f32; 3]) -> Option<f64> {
        let p = DVec3::from(p_in_world.map(f64::from));
        let q = self.camera_from_world.point(p);
        let px = self.camera.project(q)?;
        let (w, h) = (self.camera.width as f64, self.camera.height as f64);
        if !((0.0..=w).contains(&px.x) && (0.0..=h).contains(&px.y)) {
            return None;
        }
        // Far from the axis, a lens polynomial may fold back into the image.
        let d = (p - self.eye).length();
        (self.camera.direction(px.x, px.y).dot(q / q.length().max(1e-300)) > 0.999).then_some(d)
    }

    /// Whether the camera sees a point, that is, no surface is nearer by more than `slack`.
    pub fn sees(&self, p_in_world: [f32; 3], slack: f32) -> bool {
        self.maps.iter().any(|m| m.sees(p_in_world, slack)) && self.distance(p_in_world).is_some()
    }
}

/// Extent of the image beside the axis at distance 1, with a small margin; `None` for wide lenses.
fn reach(camera: &Camera) -> Option<DVec2> {
    const STEPS: usize = 16;
    let (w, h) = (camera.width as f64, camera.height as f64);
    let mut most = DVec2::ZERO;
    for i in 0..=STEPS {
        let s = i as f64 / STEPS as f64;
        for (x, y) in [(s * w, 0.0), (s * w, h), (0.0, s * h), (w, s * h)] {
            let d = camera.direction(x, y);
            if d.z < NARROW {
                return None;
            }
            most = most.max(DVec2::new(d.x, d.y).abs() / d.z);
        }
    }
    Some(most * 1.03)
}

/// Rotations that map the axis to each side of a cube.
fn sides() -> [DMat3; 6] {
    use std::f64::consts::{FRAC_PI_2, PI};
    [
        DMat3::IDENTITY,
        DMat3::from_rotation_y(FRAC_PI_2),
        DMat3::from_rotation_y(PI),
        DMat3::from_rotation_y(-FRAC_PI_2),
        DMat3::from_rotation_x(FRAC_PI_2),
        DMat3::from_rotation_x(-FRAC_PI_2),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_geom::Lens;

    /// A square across each of the six axes, at distance 2 from the origin, facing the origin or not.
    fn squares() -> Mesh {
        let mut m = Mesh::default();
        for k in 0..3 {
            for at in [-2.0, 2.0] {
                let first = m.positions.len() as u32;
                for (a, b) in [(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)] {
                    let mut p = [0.0; 3];
                    (p[k], p[(k + 1) % 3], p[(k + 2) % 3]) = (at, a, b);
                    m.positions.push(p);
                }
                m.faces.extend([[first, first + 1, first + 2], [first, first + 2, first + 3]]);
            }
        }
        m
    }

    fn seen(camera: Camera) -> Vec<[f32; 3]> {
        let pose = Pose { rotation: DMat3::IDENTITY, translation: DVec3::ZERO };
        let sight = CameraVisibility::new(&squares(), &camera, &pose);
        let axes = (0..6).map(|i| {
            let mut p = [0.0; 3];
            p[i / 2] = if i % 2 == 0 { 2.0 } else { -2.0 };
            p
        });
        axes.filter(|p| sight.sees(*p, 0.01)).collect()
    }

    #[test]
    fn each_lens_sees_what_its_picture_reaches() {
        let lens = |lens, f: f64| Camera { fx: f, fy: f, lens, ..Camera::pinhole(200, 200, 1.0) };
        assert_eq!(seen(lens(Lens::Pinhole, 100.0)), [[0.0, 0.0, 2.0]]);
        // 200 degrees: everything except what lies behind.
        let fisheye = Lens::Fisheye { k: [0.0; 4], p: [0.0; 2], s: [0.0; 2] };
        assert_eq!(seen(lens(fisheye, 100.0 / 100f64.to_radians())).len(), 5);
        assert_eq!(seen(lens(Lens::Equirectangular, 1.0)).len(), 6);
    }

    #[test]
    fn a_lens_that_folds_back_does_not_see_what_lies_beside_it() {
        // At 63 degrees from the axis the polynomial has returned to the center of the image.
        let lens = Lens::Brown { k: [0.058, -0.08, 0.0, 0.0, 0.0, 0.0], p: [0.0; 2] };
        let camera = Camera { fx: 150.0, fy: 150.0, lens, ..Camera::pinhole(200, 200, 1.0) };
        let beside = [3.96, 0.0, 2.0];
        let q = DVec3::from(beside.map(f64::from));
        assert!(camera.project(q).is_some_and(|px| (0.0..200.0).contains(&px.x)), "the test case is invalid");
        let sight = CameraVisibility::new(&squares(), &camera, &Pose { rotation: DMat3::IDENTITY, translation: DVec3::ZERO });
        assert!(sight.distance(beside).is_none() && !sight.sees(beside, 0.01));
        assert!(sight.sees([0.1, 0.1, 2.0], 0.01));
    }

    #[test]
    fn what_stands_before_hides() {
        let mut m = squares();
        m.positions.iter_mut().filter(|p| p[2] == -2.0).for_each(|p| p[2] = 1.0);
        let pose = Pose { rotation: DMat3::IDENTITY, translation: DVec3::ZERO };
        let sight = CameraVisibility::new(&m, &Camera::pinhole(200, 200, 1.0), &pose);
        assert!(sight.sees([0.0, 0.0, 1.0], 0.01) && !sight.sees([0.0, 0.0, 2.0], 0.01));
        assert_eq!(sight.distance([0.0, 0.0, 2.0]), Some(2.0));
    }
}
