//! The world of a scene: cameras in the unit sphere around their mean, up along +z, and a box that holds what they see.

use crate::run::prepare::cameras_up;
use diorama_geom::capture::Frame;
use diorama_geom::glam::DVec3;
use diorama_geom::transform::rotation_between;
use diorama_geom::{SceneBox, Similarity, SparsePoint};

/// Farthest camera from the mean camera, beyond the unit: the scale is `1 / (ROOM · distance)`.
const ROOM: f64 = 1.1;
/// Share of the points left out on either side of the box, photographs in which a point must be seen to count, and the margin.
const STRAYS: f64 = 0.02;
const FIRM: usize = 3;
const MARGIN: f64 = 0.05;
/// Fewest points that tell a box; without them it has this many times the unit.
const FEWEST: usize = 100;
const UNKNOWN: f64 = 2.0;

/// The up direction by cameras that are held level, though they may look up.
pub fn up(frames: &[Frame]) -> DVec3 {
    cameras_up(&frames.iter().map(|f| f.world_from_camera).collect::<Vec<_>>())
}

/// The first frame whose camera is outside of the unit sphere, with its distance from the origin.
pub fn outside(frames: &[Frame]) -> Option<(&Frame, f64)> {
    frames.iter().map(|f| (f, f.world_from_camera.translation.length())).find(|(_, r)| *r > 1.0)
}

/// Turns the world so that `up` is +z and, with `rescale`, moves the mean camera to the origin and all cameras into the unit sphere.
/// Returns the transform.
pub fn place(frames: &mut [Frame], points: &mut [SparsePoint], up: DVec3, rescale: bool) -> Similarity {
    let rotation = rotation_between(up.normalize_or(DVec3::Z), DVec3::Z);
    let n = frames.len().max(1) as f64;
    let center = frames.iter().map(|f| f.world_from_camera.translation).sum::<DVec3>() / n;
    let farthest = frames.iter().map(|f| (f.world_from_camera.translation - center).length()).fold(0.0, f64::max);
    let moved = match rescale && farthest > 0.0 {
        true => {
            let scale = 1.0 / (ROOM * farthest);
            Similarity { scale, rotation, translation: -(rotation * center) * scale }
        }
        false => Similarity { rotation, ..Similarity::IDENTITY },
    };
    frames.iter_mut().for_each(|f| f.world_from_camera = moved.pose(&f.world_from_camera));
    points.iter_mut().for_each(|p| p.position = moved.point(p.position));
    moved
}

/// A cube around the cameras and what they see.
pub fn scene(frames: &[Frame], points: &[SparsePoint]) -> SceneBox {
    let firm: Vec<DVec3> = points.iter().filter(|p| p.frames.len() >= FIRM.min(frames.len())).map(|p| p.position).collect();
    if firm.len() < FEWEST {
        return SceneBox { center: DVec3::ZERO, half: UNKNOWN, aabb_scale: 1 };
    }
    let side = |k: usize| {
        let mut v: Vec<f64> = firm.iter().map(|p| p[k]).collect();
        v.sort_by(f64::total_cmp);
        let strays = (v.len() as f64 * STRAYS) as usize;
        (v[strays], v[v.len() - 1 - strays])
    };
    let sides = [side(0), side(1), side(2)];
    let (mut low, mut high) = (DVec3::from(sides.map(|s| s.0)), DVec3::from(sides.map(|s| s.1)));
    let margin = MARGIN * (high - low).max_element();
    (low, high) = (low - margin, high + margin);
    for f in frames {
        (low, high) = (low.min(f.world_from_camera.translation), high.max(f.world_from_camera.translation));
    }
    SceneBox { center: 0.5 * (low + high), half: 0.505 * (high - low).max_element(), aabb_scale: 1 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_geom::{Camera, Pose};

    /// Cameras in a ring that look up a little.
    fn ring(radius: f64, tilt: DVec3) -> Vec<Frame> {
        let turn = rotation_between(DVec3::Z, tilt.normalize());
        let pose = |i: usize| {
            let a = i as f64;
            let eye = DVec3::new(5.0 + radius * a.cos(), radius * a.sin(), 2.0);
            let p = Pose::look_at(eye, DVec3::new(5.0, 0.0, 2.0 + 0.4 * radius), DVec3::Z);
            Pose { rotation: turn * p.rotation, translation: turn * p.translation }
        };
        (0..12).map(|i| Frame::new(format!("f{i}"), "", Camera::pinhole(8, 6, 1.0), pose(i))).collect()
    }

    #[test]
    fn cameras_fill_the_unit_sphere_and_stand_upright() {
        let mut frames = ring(3.0, DVec3::new(0.3, -0.8, 0.4));
        assert_eq!(outside(&frames).unwrap().0.name, "f0");
        let mut points = vec![SparsePoint { position: DVec3::ZERO, color: [0; 3], error: 0.0, frames: vec![0, 1, 2] }];
        let up = up(&frames);
        let moved = place(&mut frames, &mut points, up, true);
        let radii: Vec<f64> = frames.iter().map(|f| f.world_from_camera.translation.length()).collect();
        let farthest = radii.iter().copied().fold(0.0, f64::max);
        assert!((farthest - 1.0 / ROOM).abs() < 1e-9 && outside(&frames).is_none());
        assert!(frames.iter().all(|f| f.world_from_camera.rotation.x_axis.z.abs() < 1e-6));
        assert!(frames.iter().all(|f| f.world_from_camera.rotation.z_axis.z > 0.3));
        assert_eq!(points[0].position, moved.point(DVec3::ZERO));
    }

    #[test]
    fn up_is_told_by_cameras_that_look_up_to_one_side() {
        // All see one façade from below, so their mean up direction leans away from it.
        let frames: Vec<Frame> = ring(3.0, DVec3::Z).into_iter().filter(|f| f.world_from_camera.translation.y < -1.0).collect();
        assert!(frames.len() > 2);
        let mean: DVec3 = frames.iter().map(|f| -f.world_from_camera.rotation.y_axis).sum();
        assert!(mean.normalize().dot(DVec3::Z) < 0.97);
        let up = up(&frames);
        assert!(up.dot(DVec3::Z) > 0.9999, "{up}");
    }

    #[test]
    fn without_rescale_only_the_direction_of_up_changes() {
        let mut frames = ring(0.3, DVec3::X);
        let before: Vec<f64> = frames.iter().map(|f| f.world_from_camera.translation.length()).collect();
        let up = up(&frames);
        let moved = place(&mut frames, &mut [], up, false);
        assert_eq!((moved.scale, moved.translation), (1.0, DVec3::ZERO));
        assert!(frames.iter().zip(&before).all(|(f, r)| (f.world_from_camera.translation.length() - r).abs() < 1e-9));
    }

    #[test]
    fn the_box_holds_cameras_and_points_but_no_strays() {
        let mut frames = ring(3.0, DVec3::Z);
        place(&mut frames, &mut [], DVec3::Z, true);
        let at = |i: usize| DVec3::new(2.0 + (i % 10) as f64 * 0.1, (i / 10 % 10) as f64 * 0.1, (i / 100) as f64 * 0.1);
        let mut points: Vec<SparsePoint> =
            (0..1000).map(|i| SparsePoint { position: at(i), color: [0; 3], error: 0.0, frames: vec![0, 1, 2] }).collect();
        points[7].position = DVec3::splat(900.0);
        let b = scene(&frames, &points);
        let holds = |p: DVec3| (p - b.center).abs().max_element() <= b.half;
        assert!(frames.iter().all(|f| holds(f.world_from_camera.translation)) && holds(DVec3::new(2.9, 0.9, 0.9)));
        assert!(b.half < 3.0 && b.aabb_scale == 1);
        assert_eq!(scene(&frames, &[]).half, UNKNOWN);
    }
}
