//! Camera paths in nerfstudio's `camera_path.json`.

use crate::error::{DataError, Result};
use crate::json::{self, Object};
use diorama_geom::camera_path::PathView;
use diorama_geom::glam::{DMat3, DQuat, DVec3, EulerRot};
use diorama_geom::{Camera, Lens, OrientedBox, Pose, Similarity};
use serde_json::json;
use std::path::Path;

/// A path with its frame rate.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraPath {
    pub views: Vec<PathView>,
    pub fps: f64,
    pub crop: Option<PathCrop>,
}

/// The part of the scene that a path shows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PathCrop {
    /// Crop box in the world.
    pub within: OrientedBox,
    /// Color behind the box; `None`: the run's background.
    pub background_srgb: Option<[f32; 3]>,
}

/// Camera types that a path may have.
const TYPES: &str = "perspective, fisheye or equirectangular";

/// Reads a path whose cameras are in the capture's frame.
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
    let lens = match head.text("camera_type")? {
        None | Some("perspective") => Lens::Pinhole,
        Some("fisheye") => Lens::Fisheye { k: [0.0; 4], p: [0.0; 2], s: [0.0; 2] },
        Some("equirectangular") => Lens::Equirectangular,
        Some(other) => return Err(DataError::input(path, format!("camera_type: {other} is not supported; use {TYPES}"))),
    };
    let crop = read_crop(&head, world_from_capture)?;
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
        let camera = match lens {
            Lens::Equirectangular => Camera::equirectangular(width, height),
            lens => Camera { fx: f, fy: f, lens, ..Camera::pinhole(width, height, 1.0) },
        };
        out.push(PathView { camera, world_from_camera: world_from_capture.pose(&pose.flip_y_z()) });
    }
    if out.is_empty() {
        return Err(DataError::input(path, "camera_path: holds no cameras"));
    }
    Ok(CameraPath { views: out, fps: head.positive("fps")?.unwrap_or(24.0), crop })
}

/// nerfstudio's crop: a box given by center, sides and rotation (roll, pitch, yaw in radians), and the color behind it.
fn read_crop(head: &Object, world_from_capture: &Similarity) -> Result<Option<PathCrop>> {
    let path = head.path;
    let map = match head.map.get("crop") {
        None | Some(serde_json::Value::Null) => return Ok(None),
        Some(serde_json::Value::Object(map)) => map,
        Some(v) => return Err(DataError::input(path, format!("crop: expected an object or null, found {v:.40}"))),
    };
    let o = Object { path, place: "crop.", map };
    let three = |key: &str| o.numbers::<3>(key)?.ok_or_else(|| DataError::input(path, format!("crop.{key}: missing; expected 3 numbers")));
    let (center, sides) = (DVec3::from_array(three("crop_center")?), DVec3::from_array(three("crop_scale")?));
    if sides.min_element() <= 0.0 {
        return Err(DataError::input(path, format!("crop.crop_scale: {sides} must be greater than 0")));
    }
    let [roll, pitch, yaw] = o.numbers::<3>("crop_rot")?.unwrap_or_default();
    let rotation = DMat3::from_quat(DQuat::from_euler(EulerRot::ZYX, yaw, pitch, roll));
    let background_srgb = match map.get("crop_bg_color") {
        None | Some(serde_json::Value::Null) => None,
        Some(v) => {
            let channel = |k: &str| v.get(k).and_then(|c| c.as_f64()).filter(|c| (0.0..=255.0).contains(c)).map(|c| (c / 255.0) as f32);
            let color = [channel("r"), channel("g"), channel("b")];
            let [Some(r), Some(g), Some(b)] = color else {
                return Err(DataError::input(path, "crop.crop_bg_color: expected r, g and b from 0 to 255"));
            };
            Some([r, g, b])
        }
    };
    let place = world_from_capture.pose(&Pose { rotation, translation: center });
    Ok(Some(PathCrop { within: OrientedBox { place, sides: sides * world_from_capture.scale }, background_srgb }))
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
    let camera_type = match first.lens {
        Lens::Equirectangular => "equirectangular",
        Lens::Fisheye { .. } => "fisheye",
        _ => "perspective",
    };
    let json = json!({
        "camera_type": camera_type,
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

/// Transforms the cameras and keyframes of a path into another frame, for the viewer page; everything else is unchanged. Errors name
/// `file`.
///
/// # Errors
/// If the text is not a JSON object, a matrix is malformed, or the path uses features that the page does not show.
pub fn moved(text: &str, file: &Path, target_from_source: &Similarity) -> Result<String> {
    let map = json::parse(text.as_bytes(), file)?;
    let elsewhere = |what: String| DataError::input(file, format!("{what}; render such a path with diorama render --path FILE"));
    match map.get("camera_type").and_then(|v| v.as_str()) {
        None | Some("perspective") => {}
        Some(other) => return Err(elsewhere(format!("camera_type: the viewer shows perspective only, not {other}"))),
    }
    if map.get("crop").is_some_and(|c| !c.is_null()) {
        return Err(elsewhere("crop: the viewer does not show a path's own crop".into()));
    }
    let mut root = serde_json::Value::Object(map);
    let wrong = |place: &str| DataError::input(file, format!("{place}: expected 16 finite numbers"));
    for (list, key, by_columns) in [("camera_path", "camera_to_world", false), ("keyframes", "matrix", true)] {
        let Some(entries) = root.get_mut(list).and_then(|l| l.as_array_mut()) else { continue };
        for (i, entry) in entries.iter_mut().enumerate() {
            let place = format!("{list}[{i}].{key}");
            // nerfstudio keeps the matrices of keyframes as JSON within JSON.
            let (value, quoted) = match entry.get(key) {
                Some(serde_json::Value::String(s)) => (serde_json::from_str(s).map_err(|_| wrong(&place))?, true),
                Some(v) => (v.clone(), false),
                None => return Err(wrong(&place)),
            };
            let m: Vec<f64> = serde_json::from_value(value).map_err(|_| wrong(&place))?;
            if m.len() != 16 || m.iter().any(|v| !v.is_finite()) {
                return Err(wrong(&place));
            }
            let at = |row: usize, column: usize| if by_columns { m[column * 4 + row] } else { m[row * 4 + column] };
            let column = |c: usize| DVec3::new(at(0, c), at(1, c), at(2, c));
            let pose = Pose { rotation: DMat3::from_cols(column(0), column(1), column(2)), translation: column(3) };
            let to = target_from_source.pose(&pose);
            let (r, t) = (to.rotation, to.translation);
            let columns = [r.x_axis, r.y_axis, r.z_axis, t];
            let out: Vec<f64> = (0..16)
                .map(|k| {
                    let (row, column) = if by_columns { (k % 4, k / 4) } else { (k / 4, k % 4) };
                    if row == 3 { (column == 3) as u8 as f64 } else { columns[column][row] }
                })
                .collect();
            entry[key] = if quoted { json!(out).to_string().into() } else { json!(out) };
        }
    }
    Ok(format!("{root:#}\n"))
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
        let p = CameraPath { views: vec![view; 2], fps: 30.0, crop: None };
        write(&file, &p, &world_from_capture).unwrap();
        let q = read(&file, &world_from_capture).unwrap();
        assert_eq!((q.views.len(), q.fps), (2, 30.0));
        assert!((q.views[0].camera.fx - view.camera.fx).abs() < 1e-9);
        assert!((q.views[0].world_from_camera.translation - view.world_from_camera.translation).length() < 1e-9);
        assert!((q.views[0].world_from_camera.rotation.z_axis - view.world_from_camera.rotation.z_axis).length() < 1e-9);
    }

    /// A path of one camera at the origin, with some more keys.
    fn with(more: serde_json::Value) -> serde_json::Value {
        let m = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];
        let mut json = json!({ "render_width": 64, "render_height": 48, "camera_path": [{ "camera_to_world": m, "fov": 90 }] });
        json.as_object_mut().unwrap().extend(more.as_object().unwrap().clone());
        json
    }

    #[test]
    fn the_kind_of_camera_is_honored_or_refused() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("p.json");
        let camera = |kind: &str| {
            std::fs::write(&file, with(json!({ "camera_type": kind })).to_string()).unwrap();
            read(&file, &Similarity::IDENTITY).map(|p| p.views[0].camera)
        };
        let right_edge = |c: Camera| c.direction(64.0, 24.0).angle_between(DVec3::Z);
        // nerfstudio's focal length is half the height divided by the tangent of half the angle, for every lens.
        assert!((right_edge(camera("perspective").unwrap()) - (32.0f64 / 24.0).atan()).abs() < 1e-12);
        assert!((right_edge(camera("fisheye").unwrap()) - 32.0 / 24.0).abs() < 1e-12);
        assert!((right_edge(camera("equirectangular").unwrap()) - std::f64::consts::PI).abs() < 1e-12);
        let e = camera("omnidirectional").unwrap_err();
        assert!(e.is_input() && e.to_string().contains("camera_type") && e.to_string().contains("equirectangular"), "{e}");
        let text = with(json!({ "camera_type": "fisheye" })).to_string();
        assert!(moved(&text, &file, &Similarity::IDENTITY).unwrap_err().to_string().contains("camera_type"));
    }

    #[test]
    fn a_crop_is_a_box_of_the_world() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("p.json");
        let crop = |crop: serde_json::Value, s: &Similarity| {
            std::fs::write(&file, with(json!({ "crop": crop })).to_string()).unwrap();
            read(&file, s).map(|p| p.crop)
        };
        let quarter = std::f64::consts::FRAC_PI_2;
        let whole = json!({ "crop_center": [1, 2, 3], "crop_scale": [2, 4, 6], "crop_rot": [0, 0, quarter],
            "crop_bg_color": { "r": 255, "g": 51, "b": 0 } });
        let s = Similarity {
            scale: 2.0,
            rotation: diorama_geom::transform::rotation_between(DVec3::Z, DVec3::X),
            translation: DVec3::new(0.0, 0.0, 5.0),
        };
        let got = crop(whole.clone(), &s).unwrap().unwrap();
        assert_eq!(got.background_srgb, Some([1.0, 0.2, 0.0]));
        // A quarter turn about z swaps the box's first two sides.
        for (offset, is_in) in [([1.9, 0.0, 0.0], true), ([2.1, 0.0, 0.0], false), ([0.0, 0.9, 2.9], true), ([0.0, 1.1, 0.0], false)] {
            let p = s.point(DVec3::new(1.0, 2.0, 3.0) + DVec3::from_array(offset));
            assert_eq!(got.within.contains(p), is_in, "{offset:?}");
        }
        assert_eq!(crop(serde_json::Value::Null, &s).unwrap(), None);
        let set = |key: &str, value: serde_json::Value| {
            let mut bad = whole.clone();
            bad[key] = value;
            bad
        };
        for (bad, field) in [
            (set("crop_center", json!([1, 2])), "crop.crop_center"),
            (set("crop_scale", json!([1, 0, 2])), "crop.crop_scale"),
            (set("crop_bg_color", json!("red")), "crop.crop_bg_color"),
            (json!(7), "crop"),
        ] {
            let e = crop(bad, &s).unwrap_err().to_string();
            assert!(e.contains(field) && e.contains("p.json"), "{e}");
        }
        assert!(moved(&with(json!({ "crop": whole })).to_string(), &file, &s).unwrap_err().to_string().contains("crop"));
        assert!(moved(&with(json!({ "crop": null })).to_string(), &file, &s).is_ok());
    }

    #[test]
    fn moving_there_and_back_changes_nothing() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("p.json");
        let view = PathView {
            camera: Camera::pinhole(64, 48, 0.8),
            world_from_camera: Pose::look_at(DVec3::new(3.0, 2.0, 1.0), DVec3::ZERO, DVec3::Z),
        };
        write(&file, &CameraPath { views: vec![view; 2], fps: 30.0, crop: None }, &Similarity::IDENTITY).unwrap();
        let mut json: serde_json::Value = serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
        json["keyframes"] =
            json!([{ "matrix": json!([1.0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0, 1.0, 0, 7.0, 8.0, 9.0, 1.0]).to_string(), "fov": 50 }]);
        let s = Similarity {
            scale: 2.0,
            translation: DVec3::new(1.0, 0.0, 0.0),
            rotation: diorama_geom::transform::rotation_between(DVec3::Z, DVec3::X),
        };
        let there = moved(&json.to_string(), &file, &s).unwrap();
        let m: Vec<f64> =
            serde_json::from_str(serde_json::from_str::<serde_json::Value>(&there).unwrap()["keyframes"][0]["matrix"].as_str().unwrap())
                .unwrap();
        assert!((DVec3::new(m[12], m[13], m[14]) - s.point(DVec3::new(7.0, 8.0, 9.0))).length() < 1e-12);
        std::fs::write(&file, &there).unwrap();
        let p = read(&file, &s.inverse()).unwrap();
        assert!((p.views[0].world_from_camera.translation - view.world_from_camera.translation).length() < 1e-9);
        assert!(moved(r#"{"camera_path":[{"camera_to_world":[1]}]}"#, &file, &s).unwrap_err().to_string().contains("camera_path[0]"));
        assert!(moved("[", &file, &s).is_err());
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
