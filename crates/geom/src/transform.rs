//! Rigid and similarity transforms, named `target_from_source`.

use glam::{DMat3, DVec3};
use serde::{Deserialize, Serialize};

/// A rigid transform `world_from_camera`: `x_in_world = rotation * x_in_camera + translation`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Pose {
    /// Columns are the camera's axes (right, down, forward) in the world.
    pub rotation: DMat3,
    /// The camera center in the world.
    pub translation: DVec3,
}

impl Pose {
    /// No rotation, no translation.
    pub const IDENTITY: Pose = Pose { rotation: DMat3::IDENTITY, translation: DVec3::ZERO };

    /// Maps a point from the camera to the world.
    pub fn point(&self, x_in_camera: DVec3) -> DVec3 {
        self.rotation * x_in_camera + self.translation
    }

    /// The transform `camera_from_world`.
    pub fn inverse(&self) -> Pose {
        let rotation = self.rotation.transpose();
        Pose { rotation, translation: -(rotation * self.translation) }
    }

    /// The pose of a camera at `eye` that looks at `target`, with the image's up direction close to `up`.
    pub fn look_at(eye: DVec3, target: DVec3, up: DVec3) -> Pose {
        let forward = (target - eye).normalize();
        let mut right = forward.cross(up);
        if right.length_squared() < 1e-12 {
            right = forward.cross(if forward.x.abs() < 0.9 { DVec3::X } else { DVec3::Y });
        }
        let right = right.normalize();
        Pose { rotation: DMat3::from_cols(right, forward.cross(right), forward), translation: eye }
    }

    /// Converts a camera whose axes are (right, up, back), as in OpenGL and Blender, and back.
    pub fn flip_y_z(&self) -> Pose {
        let r = self.rotation;
        Pose { rotation: DMat3::from_cols(r.x_axis, -r.y_axis, -r.z_axis), translation: self.translation }
    }

    /// Deviation of the rotation from orthonormal and right-handed: `max |RᵀR − I|`, plus 2 if mirrored.
    pub fn rigidity_error(&self) -> f64 {
        let d = self.rotation.transpose() * self.rotation - DMat3::IDENTITY;
        let worst = d.to_cols_array().iter().fold(0.0f64, |m, v| m.max(v.abs()));
        if self.rotation.determinant() < 0.0 { worst + 2.0 } else { worst }
    }
}

/// `x_target = scale * rotation * x_source + translation`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Similarity {
    pub scale: f64,
    pub rotation: DMat3,
    pub translation: DVec3,
}

impl Similarity {
    /// No scale, rotation or translation.
    pub const IDENTITY: Similarity = Similarity { scale: 1.0, rotation: DMat3::IDENTITY, translation: DVec3::ZERO };
    /// Maps a point from the source to the target.
    pub fn point(&self, x: DVec3) -> DVec3 {
        self.scale * (self.rotation * x) + self.translation
    }

    /// The transform `source_from_target`.
    pub fn inverse(&self) -> Similarity {
        let rotation = self.rotation.transpose();
        Similarity { scale: 1.0 / self.scale, rotation, translation: -(rotation * self.translation) / self.scale }
    }

    /// Composition: `first` is applied first, then this transform.
    pub fn after(&self, first: &Similarity) -> Similarity {
        Similarity { scale: self.scale * first.scale, rotation: self.rotation * first.rotation, translation: self.point(first.translation) }
    }

    /// Moves a camera: the center as a point, the axes by the rotation only.
    pub fn pose(&self, pose: &Pose) -> Pose {
        Pose { rotation: self.rotation * pose.rotation, translation: self.point(pose.translation) }
    }
}

/// Rotation matrix of a unit quaternion (w, x, y, z), normalized first.
pub fn rotation_from_quaternion(wxyz: [f64; 4]) -> DMat3 {
    let [w, x, y, z] = wxyz;
    DMat3::from_quat(glam::DQuat::from_xyzw(x, y, z, w).normalize())
}

/// Rotation by the axis-angle vector `omega` (Rodrigues).
pub fn rotation_from_axis_angle(omega: DVec3) -> DMat3 {
    let angle = omega.length();
    if angle < 1e-12 { DMat3::IDENTITY } else { DMat3::from_axis_angle(omega / angle, angle) }
}

/// The rotation that maps unit vector `a` to unit vector `b`.
pub fn rotation_between(a: DVec3, b: DVec3) -> DMat3 {
    DMat3::from_quat(glam::DQuat::from_rotation_arc(a.normalize(), b.normalize()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn look_at_sees_its_target_straight_ahead() {
        let p = Pose::look_at(DVec3::new(3.0, 1.0, 2.0), DVec3::ZERO, DVec3::Z);
        let t = p.inverse().point(DVec3::ZERO);
        assert!(t.x.abs() < 1e-12 && t.y.abs() < 1e-12 && t.z > 0.0);
        assert!(p.rigidity_error() < 1e-12);
        assert!(p.rotation.y_axis.z < 0.0, "image down must point to world down");
    }

    #[test]
    fn inverses_undo() {
        let s = Similarity {
            scale: 2.5,
            rotation: rotation_from_axis_angle(DVec3::new(0.3, -0.2, 0.9)),
            translation: DVec3::new(1.0, 2.0, 3.0),
        };
        let x = DVec3::new(-0.4, 0.7, 1.9);
        assert!((s.inverse().point(s.point(x)) - x).length() < 1e-12);
    }

    #[test]
    fn a_mirror_is_not_rigid() {
        let mirrored = Pose { rotation: DMat3::from_diagonal(DVec3::new(-1.0, 1.0, 1.0)), translation: DVec3::ZERO };
        assert!(mirrored.rigidity_error() >= 2.0);
    }
}
