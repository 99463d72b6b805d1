//! Camera paths in nerfstudio's `camera_path.json`.

use crate::error::{DataError, Result};
use crate::json::{self, Object};
use diorama_geom::camera_path::PathView;
use diorama_geom::glam::{DMat3, DVec3};
use diorama_geom::{Camera, Pose, Similarity};
use serde_json::json;
use std::path::Path;

/// A path with its frame rate.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraPath {
    pub views: Vec<PathView>,
    pub fps: f64,
}

/// Reads a path whose cameras are given in the capture's frame.
pub fn read(path: &Path, world_from_capture: &Similarity) -> Result<CameraPath> {
    let map = json::read(path)?;
    let head = Object { path, place: "", map: &map };
    let side = |key: &str| -> Result<u32> {
        match head.positive(key)? {
            Some(v) if v <= 16384.0 => Ok(v as u32),
            Some(v) => Err(DataError::input(path, format!("{key}: {v} is more than 16384 pixels"))),
            None => Err(DataError::input(path, format!("{key}: missing"))),
        }
    };
    let (width, height) = (side("render_width")?, side("render_height")?);
    let views = head.array("camera_path")?.ok_or_else(|| DataError::input(path, "camera_path: missing; expected a list of cameras"))?;
    let mut out = Vec::new();
    for (i, v) in views.iter().enumerate() {
        let place = format!("camera_path[{i}].");
        let map = v.as_object().ok_or_else(|| DataError::input(path, format!("camera_path[{i}]: expected an object")))?;
        let o = Object { path, place: &place, map };
        let m = o.matrix("camera_to_world", 3)?.ok_or_else(|| DataError::input(path, format!("{place}camera_to_world: missing")))?;
        let column = |c: usize| DVec3::new(m[c], m[4 + c], m[8 + c]);
        let pose = Pose { rotation: DMat3::from_cols(column(0), column(1), column(2)), translation: column(3) };
        let pose = crate::transforms_json::rigid(pose).map_err(|e| DataError::input(path, format!("{place}camera_to_world: {e}")))?;
        // nerfstudio's field of view is vertical, in degrees.
        let fov = o.positive("fov")?.unwrap_or(50.0);
        if fov >= 179.0 {
            return Err(DataError::input(path, format!("{place}fov: {fov} is not below 179 degrees")));
        }
        let f = 0.5 * height as f64 / (0.5 * fov.to_radians()).tan();
        let camera = Camera { fx: f, fy: f, ..Camera::pinhole(width, height, 1.0) };
        out.push(PathView { camera, world_from_camera: world_from_capture.pose(&pose.flip_y_z()) });
    }
    if out.is_empty() {
        return Err(DataError::input(path, "camera_path: holds no cameras"));
    }
    Ok(CameraPath { views: out, fps: head.positive("fps")?.unwrap_or(24.0) })
}

/// Writes a path in the capture's frame.
pub fn write(path: &Path, p: &CameraPath, world_from_capture: &Similarity) -> Result<()> {
    let to_capture = world_from_capture.inverse();
    let first = p.views.first().ok_or_else(|| DataError::input(path, "a camera path needs at least one camera"))?.camera;
    let views: Vec<serde_json::Value> = p
        .views
        .iter()
        .map(|v| {
            let pose = to_capture.pose(&v.world_from_camera).flip_y_z();
            let (r, t) = (pose.rotation, pose.translation);
            let row = |k: usize| [r.x_axis[k], r.y_axis[k], r.z_axis[k], t[k]];
            let matrix: Vec<f64> = [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]].concat();
            let c = v.camera;
            let fov = 2.0 * (0.5 * c.height as f64 / c.fy).atan().to_degrees();
            json!({ "camera_to_world": matrix, "fov": fov, "aspect": c.width as f64 / c.height as f64 })
        })
        .collect();
    let json = json!({
        "camera_type": "perspective",
        "render_width": first.width,
        "render_height": first.height,
        "fps": p.fps,
        "seconds": p.views.len() as f64 / p.fps,
        "is_cycle": false,
        "smoothness_value": 0.5,
        "keyframes": [],
        "camera_path": views,
    });
    crate::atomic::write(path, format!("{json:#}\n").as_bytes())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_path_round_trips_through_the_file() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("p.json");
        let world_from_capture = Similarity { scale: 2.0, translation: DVec3::new(1.0, 0.0, 0.0), ..Similarity::IDENTITY };
        let view = PathView {
            camera: Camera::pinhole(64, 48, 0.8),
            world_from_camera: Pose::look_at(DVec3::new(3.0, 2.0, 1.0), DVec3::ZERO, DVec3::Z),
        };
        let p = CameraPath { views: vec![view; 2], fps: 30.0 };
        write(&file, &p, &world_from_capture).unwrap();
        let q = read(&file, &world_from_capture).unwrap();
        assert_eq!((q.views.len(), q.fps), (2, 30.0));
        assert!((q.views[0].camera.fx - view.camera.fx).abs() < 1e-9);
        assert!((q.views[0].world_from_camera.translation - view.world_from_camera.translation).length() < 1e-9);
        assert!((q.views[0].world_from_camera.rotation.z_axis - view.world_from_camera.rotation.z_axis).length() < 1e-9);
    }

    #[test]
    fn wrong_files_name_their_field() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("p.json");
        for (text, field) in [
            ("{}", "render_width"),
            (r#"{"render_width":64,"render_height":48}"#, "camera_path"),
            (r#"{"render_width":64,"render_height":48,"camera_path":[{"camera_to_world":[1,2]}]}"#, "camera_path[0].camera_to_world"),
            (r#"{"render_width":1e9,"render_height":48}"#, "render_width"),
        ] {
            std::fs::write(&file, text).unwrap();
            let e = read(&file, &Similarity::IDENTITY).unwrap_err().to_string();
            assert!(e.contains(field), "{e}");
        }
    }
}
