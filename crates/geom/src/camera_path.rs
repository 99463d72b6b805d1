//! Camera paths for novel views.

use crate::{Camera, Pose};
use glam::{DMat3, DQuat, DVec3};

/// One camera of a path.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PathView {
    pub camera: Camera,
    pub world_from_camera: Pose,
}

/// A full turn around `center` at the median height and distance of the given cameras.
pub fn orbit(poses: &[Pose], center: DVec3, up: DVec3, frames: usize) -> Vec<Pose> {
    let median = |mut v: Vec<f64>| {
        v.sort_by(f64::total_cmp);
        v[v.len() / 2]
    };
    let up = up.normalize();
    let offsets: Vec<DVec3> = poses.iter().map(|p| p.translation - center).collect();
    let height = median(offsets.iter().map(|o| o.dot(up)).collect());
    let radius = median(offsets.iter().map(|o| (*o - up * o.dot(up)).length()).collect());
    let start = offsets[0] - up * offsets[0].dot(up);
    let x = if start.length() > 1e-9 { start.normalize() } else { up.any_orthonormal_vector() };
    let y = up.cross(x);
    (0..frames)
        .map(|i| {
            let a = i as f64 / frames as f64 * std::f64::consts::TAU;
            let eye = center + up * height + (x * a.cos() + y * a.sin()) * radius;
            Pose::look_at(eye, center, up)
        })
        .collect()
}

/// A forward-facing spiral around the mean camera (Mildenhall et al. 2019, LLFF), looking at `center`.
pub fn spiral(poses: &[Pose], center: DVec3, up: DVec3, frames: usize) -> Vec<Pose> {
    let n = poses.len() as f64;
    let mean = poses.iter().map(|p| p.translation).sum::<DVec3>() / n;
    let base = Pose::look_at(mean, center, up);
    let camera_from_world = base.inverse();
    let spread = poses.iter().fold(DVec3::ZERO, |m, p| {
        let o = camera_from_world.point(p.translation).abs();
        m + o / n
    });
    (0..frames)
        .map(|i| {
            let a = i as f64 / frames as f64 * std::f64::consts::TAU;
            let offset = DVec3::new(spread.x * (2.0 * a).cos(), spread.y * (2.0 * a).sin(), spread.z * a.sin());
            Pose::look_at(base.point(offset), center, up)
        })
        .collect()
}

/// Visits the given poses in order: centers by Catmull–Rom splines, rotations by slerp.
pub fn interpolate(poses: &[Pose], frames: usize) -> Vec<Pose> {
    let n = poses.len();
    if n < 2 || frames < 2 {
        return poses.iter().take(1).cycle().take(frames).copied().collect();
    }
    (0..frames)
        .map(|i| {
            let s = i as f64 / (frames - 1) as f64 * (n - 1) as f64;
            let k = (s as usize).min(n - 2);
            let u = s - k as f64;
            let at = |j: isize| poses[(k as isize + j).clamp(0, n as isize - 1) as usize].translation;
            let (p0, p1, p2, p3) = (at(-1), at(0), at(1), at(2));
            let translation = 0.5
                * (2.0 * p1 + (p2 - p0) * u + (2.0 * p0 - 5.0 * p1 + 4.0 * p2 - p3) * u * u + (3.0 * p1 - p0 - 3.0 * p2 + p3) * u * u * u);
            let q = DQuat::from_mat3(&poses[k].rotation).slerp(DQuat::from_mat3(&poses[k + 1].rotation), u);
            Pose { rotation: DMat3::from_quat(q), translation }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ring() -> Vec<Pose> {
        (0..6)
            .map(|i| {
                let a = i as f64;
                Pose::look_at(DVec3::new(2.0 * a.cos(), 2.0 * a.sin(), 1.0), DVec3::ZERO, DVec3::Z)
            })
            .collect()
    }

    #[test]
    fn orbit_keeps_distance_and_looks_at_the_center() {
        for p in orbit(&ring(), DVec3::ZERO, DVec3::Z, 12) {
            assert!((p.translation.length() - 5f64.sqrt()).abs() < 1e-9);
            let c = p.inverse().point(DVec3::ZERO);
            assert!(c.x.abs() < 1e-9 && c.y.abs() < 1e-9 && c.z > 0.0);
        }
    }

    #[test]
    fn interpolation_passes_through_its_ends() {
        let r = ring();
        let p = interpolate(&r, 31);
        assert!((p[0].translation - r[0].translation).length() < 1e-9);
        assert!((p[30].translation - r[5].translation).length() < 1e-9);
        assert!(p.iter().all(|p| p.rigidity_error() < 1e-9));
    }

    #[test]
    fn spiral_returns_to_its_start() {
        let p = spiral(&ring(), DVec3::ZERO, DVec3::Z, 40);
        assert_eq!(p.len(), 40);
        assert!((p[0].translation - p[39].translation).length() < 1.0);
    }
}
