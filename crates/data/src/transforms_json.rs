//! `transforms.json` of instant-ngp and nerfstudio, and `transforms_{train,val,test}.json` of the Blender
//! set: camera-to-world matrices with OpenGL axes (x right, y up, looking along −z), world z up.

use crate::error::{DataError, Result};
use crate::imported::{Imported, locate};
use crate::json::{self, Object};
use crate::sparse_ply;
use diorama_geom::capture::{Frame, Split};
use diorama_geom::glam::{DMat3, DVec3};
use diorama_geom::{Camera, Lens, Pose, SceneBox, Similarity, SparsePoint};
use std::path::Path;

/// Supported camera models.
const MODELS: &str = "PINHOLE, SIMPLE_PINHOLE, OPENCV, OPENCV_FISHEYE, EQUIRECTANGULAR";

/// Most sparse points that are kept.
const MOST_POINTS: usize = 2_000_000;

/// Half the edge of the box of Blender scenes: the cube that instant-ngp's scale of 0.33 maps to [0, 1].
const BLENDER_HALF: f64 = 0.5 / 0.33;

/// Reads one `transforms.json`.
pub fn read(file: &Path, root: &Path) -> Result<Imported> {
    let map = json::read(file)?;
    let head = Object { path: file, place: "", map: &map };
    let mut out = Imported { scene: ngp_scene(&head)?, frames_from_capture: applied(&head)?, ..Imported::default() };
    read_frames(&head, root, Split::Train, &mut out)?;
    out.has_own_split = apply_file_lists(&head, &mut out.frames)?;
    read_points(&head, root, &mut out)?;
    if let Some(text) = head.text("mask_meaning")? {
        out.mask_meaning = crate::masks::parse_meaning(text).map_err(|e| DataError::input(file, format!("mask_meaning: {e}")))?;
    }
    Ok(out)
}

/// nerfstudio's `ply_file_path`: points in the frames' world. Only files written by this program say which photographs see them.
fn read_points(head: &Object, root: &Path, out: &mut Imported) -> Result<()> {
    let Some(name) = head.text("ply_file_path")? else { return Ok(()) };
    let Some(file) = locate(root, name, head.path, "ply_file_path")? else {
        out.notes.push(format!("ply_file_path: {name} does not exist, so there are no sparse points"));
        return Ok(());
    };
    let cloud = crate::splat_ply::read(&file)?;
    let step = cloud.len().div_ceil(MOST_POINTS).max(1);
    if step > 1 {
        out.notes.push(format!("{name} holds {} points; one of {step} is kept", cloud.len()));
    }
    let mut points: Vec<SparsePoint> = cloud
        .positions
        .iter()
        .zip(&cloud.rgb_srgb)
        .map(|(p, c)| SparsePoint {
            position: DVec3::from_array(p.map(f64::from)),
            color: c.map(diorama_geom::color::u8_from_unit),
            error: 0.0,
            frames: Vec::new(),
        })
        .collect();
    sparse_ply::observe(&file, root, &crate::error::read(&file, u64::MAX)?, &out.frames, &mut points)?;
    let points: Vec<SparsePoint> = points.into_iter().step_by(step).collect();
    out.points = points;
    Ok(())
}

/// Reads a Blender set: `transforms_train.json`, and those of `val` and `test` if they exist.
pub fn read_blender(root: &Path) -> Result<Imported> {
    let mut out = Imported::default();
    for (name, split) in [("train", Split::Train), ("val", Split::Val), ("test", Split::Test)] {
        let file = root.join(format!("transforms_{name}.json"));
        if !file.exists() {
            continue;
        }
        let map = json::read(&file)?;
        let head = Object { path: &file, place: "", map: &map };
        if out.scene.is_none() {
            out.scene = ngp_scene(&head)?;
        }
        if out.frames_from_capture.is_none() {
            out.frames_from_capture = applied(&head)?;
        }
        let first = out.frames.len();
        read_frames(&head, root, split, &mut out)?;
        for f in &mut out.frames[first..] {
            if !f.name.contains(name) {
                f.name = format!("{name}/{}", f.name);
            }
        }
    }
    out.scene.get_or_insert(SceneBox { center: DVec3::ZERO, half: BLENDER_HALF, aabb_scale: 1 });
    out.has_own_split = out.frames.iter().any(|f| f.split == Split::Test);
    Ok(out)
}

/// instant-ngp's box, if `aabb_scale` is given: `x_model = x · scale + offset`.
fn ngp_scene(head: &Object) -> Result<Option<SceneBox>> {
    let Some(aabb) = head.positive("aabb_scale")? else { return Ok(None) };
    if aabb.fract() != 0.0 || !(aabb as u64).is_power_of_two() || aabb > 128.0 {
        return Err(DataError::input(head.path, format!("aabb_scale: {aabb} must be a power of two up to 128")));
    }
    let scale = head.positive("scale")?.unwrap_or(0.33);
    let offset = match head.map.get("offset") {
        Some(v) if v.is_number() => [head.number("offset")?.unwrap_or(0.5); 3],
        _ => head.numbers::<3>("offset")?.unwrap_or([0.5; 3]),
    };
    let center = (DVec3::splat(0.5) - DVec3::from_array(offset)) / scale;
    Ok(Some(SceneBox { center, half: 0.5 / scale, aabb_scale: aabb as u32 }))
}

/// nerfstudio's `applied_transform` and `applied_scale`: what was applied to the poses after structure from motion. It is inverted when
/// results are written in the input's frame.
fn applied(head: &Object) -> Result<Option<Similarity>> {
    let (matrix, scale) = (head.matrix("applied_transform", 3)?, head.positive("applied_scale")?);
    if matrix.is_none() && scale.is_none() {
        return Ok(None);
    }
    let mut out = Similarity { scale: scale.unwrap_or(1.0), ..Similarity::IDENTITY };
    if let Some(m) = matrix {
        let column = |c: usize| DVec3::new(m[c], m[4 + c], m[8 + c]);
        let turned = DMat3::from_cols(column(0), column(1), column(2));
        let own = turned.determinant().abs().cbrt();
        let pose = Pose { rotation: turned * if own > 0.0 { 1.0 / own } else { 0.0 }, translation: column(3) };
        let pose = rigid(pose).map_err(|what| {
            DataError::input(head.path, format!("applied_transform: {what}; correct it, or remove it to keep the poses' own frame"))
        })?;
        out = Similarity { scale: out.scale * own, rotation: pose.rotation, translation: out.scale * pose.translation };
    }
    Ok(Some(out))
}

fn read_frames(head: &Object, root: &Path, split: Split, out: &mut Imported) -> Result<()> {
    let frames =
        head.array("frames")?.ok_or_else(|| DataError::input(head.path, "frames: missing; expected a list of photographs with poses"))?;
    let mut sizes = None;
    for (i, value) in frames.iter().enumerate() {
        let place = format!("frames[{i}].");
        let map = value.as_object().ok_or_else(|| DataError::input(head.path, format!("frames[{i}]: expected an object")))?;
        let frame = Object { path: head.path, place: &place, map };
        let name = frame.text("file_path")?.ok_or_else(|| DataError::input(head.path, format!("{place}file_path: missing")))?;
        let pose = read_pose(&frame)?;
        let Some(image) = locate(root, name, head.path, &format!("{place}file_path"))? else {
            out.missing.push(name.to_string());
            continue;
        };
        let mask = optional_file(&frame, "mask_path", root)?;
        let depth = optional_file(&frame, "depth_file_path", root)?;
        let camera = read_camera(head, &frame, &image, &mut sizes)?;
        let title = Path::new(name).with_extension("").to_string_lossy().trim_start_matches("./").to_string();
        let (time, session) = (frame.number("time")?, frame.number("session")?.map(|s| s as u32));
        out.frames.push(Frame { mask, depth, time, session, split, ..Frame::new(title, image, camera, pose) });
    }
    Ok(())
}

fn optional_file(frame: &Object, key: &str, root: &Path) -> Result<Option<std::path::PathBuf>> {
    let Some(name) = frame.text(key)? else { return Ok(None) };
    let found = locate(root, name, frame.path, &format!("{}{key}", frame.place))?;
    found.map(Some).ok_or_else(|| {
        DataError::input(frame.path, format!("{}{key}: {name} does not exist; remove the field or add the file", frame.place))
    })
}

fn read_pose(frame: &Object) -> Result<Pose> {
    let m = frame
        .matrix("transform_matrix", 3)?
        .ok_or_else(|| DataError::input(frame.path, format!("{}transform_matrix: missing", frame.place)))?;
    let column = |c: usize| DVec3::new(m[c], m[4 + c], m[8 + c]);
    let pose = Pose { rotation: DMat3::from_cols(column(0), column(1), column(2)), translation: column(3) };
    rigid(pose).map(|p| p.flip_y_z()).map_err(|what| {
        DataError::input(frame.path, format!("{}transform_matrix: {what}; estimate this pose again or remove the frame", frame.place))
    })
}

/// Checks that a pose is nearly rigid and makes it exactly rigid.
pub fn rigid(pose: Pose) -> std::result::Result<Pose, String> {
    let error = pose.rigidity_error();
    if pose.rotation == DMat3::ZERO {
        return Err("the rotation is zero".into());
    }
    if error > 1.98 && error < 2.02 {
        return Err("the rotation mirrors (determinant −1)".into());
    }
    if error.is_nan() || error > 0.02 {
        return Err(format!("not rigid: its axes are not unit and orthogonal (error {error:.3})"));
    }
    let x = pose.rotation.x_axis.normalize();
    let z = x.cross(pose.rotation.y_axis).normalize();
    Ok(Pose { rotation: DMat3::from_cols(x, z.cross(x), z), translation: pose.translation })
}

fn read_camera(head: &Object, frame: &Object, image: &Path, sizes: &mut Option<(u32, u32)>) -> Result<Camera> {
    // A frame's own value takes precedence over the file's.
    let number = |key: &str| -> Result<Option<f64>> { Ok(frame.number(key)?.or(head.number(key)?)) };
    let positive = |key: &str| -> Result<Option<f64>> { Ok(frame.positive(key)?.or(head.positive(key)?)) };
    let (width, height) = match (positive("w")?, positive("h")?) {
        (Some(w), Some(h)) => (w as u32, h as u32),
        _ => match sizes {
            Some(s) => *s,
            None => *sizes.insert(crate::photo::size(image)?),
        },
    };
    let flag = |key: &str| -> Result<bool> { Ok(head.flag(key)?.unwrap_or(false)) };
    let model = frame.text("camera_model")?.or(head.text("camera_model")?);
    if model == Some("EQUIRECTANGULAR") || (model.is_none() && !flag("is_fisheye")? && flag("equirectangular")?) {
        return Ok(Camera::equirectangular(width, height));
    }
    let from_angle = |angle: f64, side: u32| 0.5 * side as f64 / (0.5 * angle).tan();
    let fx = match (positive("fl_x")?, positive("camera_angle_x")?) {
        (Some(f), _) => f,
        (None, Some(a)) if a < std::f64::consts::PI => from_angle(a, width),
        (None, Some(a)) => return Err(DataError::input(head.path, format!("camera_angle_x: {a} is not an angle below π radians"))),
        (None, None) => positive("fl_y")?
            .ok_or_else(|| DataError::input(head.path, "fl_x: missing; give fl_x in pixels or camera_angle_x in radians"))?,
    };
    let fy = match (positive("fl_y")?, positive("camera_angle_y")?, positive("fl_x")?) {
        (Some(f), _, _) => f,
        (None, Some(a), None) => from_angle(a, height),
        _ => fx,
    };
    let k = [number("k1")?, number("k2")?, number("k3")?, number("k4")?].map(|k| k.unwrap_or(0.0));
    let p = [number("p1")?, number("p2")?].map(|p| p.unwrap_or(0.0));
    let fisheye = Lens::Fisheye { k, p: [0.0; 2], s: [0.0; 2] };
    let lens = match model {
        Some("OPENCV_FISHEYE") => fisheye,
        Some("PINHOLE" | "SIMPLE_PINHOLE") => Lens::Pinhole,
        None if flag("is_fisheye")? => fisheye,
        None | Some("OPENCV" | "SIMPLE_RADIAL" | "RADIAL") => {
            if k[3] != 0.0 {
                return Err(DataError::input(head.path, "k4: only the OPENCV_FISHEYE model has it; set camera_model or remove k4"));
            }
            if k == [0.0; 4] && p == [0.0; 2] { Lens::Pinhole } else { Lens::Brown { k: [k[0], k[1], k[2], 0.0, 0.0, 0.0], p } }
        }
        Some(other) => {
            return Err(DataError::input(head.path, format!("camera_model: {other} is not supported; use one of {MODELS}")));
        }
    };
    let (cx, cy) = (number("cx")?.unwrap_or(0.5 * width as f64), number("cy")?.unwrap_or(0.5 * height as f64));
    Ok(Camera { width, height, fx, fy, cx, cy, lens })
}

/// nerfstudio's `train_filenames`, `val_filenames`, `test_filenames`; returns whether any of them exists.
fn apply_file_lists(head: &Object, frames: &mut [Frame]) -> Result<bool> {
    let mut any = false;
    for (key, split) in [("train_filenames", Split::Train), ("val_filenames", Split::Val), ("test_filenames", Split::Test)] {
        let Some(list) = head.array(key)? else { continue };
        any = true;
        let stems: std::collections::HashSet<String> = list
            .iter()
            .filter_map(|v| v.as_str())
            .map(|n| Path::new(n.trim_start_matches("./")).with_extension("").to_string_lossy().into_owned())
            .collect();
        for f in frames.iter_mut().filter(|f| stems.contains(&f.name)) {
            f.split = split;
        }
    }
    Ok(any)
}

/// Writes a capture as `transforms.json`, in the capture's frame, with image paths relative to `root`; `points` is the name of a PLY file
/// in `root`, if there is one.
pub fn write(path: &Path, root: &Path, capture: &diorama_geom::Capture, points: Option<&str>) -> Result<()> {
    let to_capture: Similarity = capture.world_from_capture.inverse();
    let frames: Vec<serde_json::Value> = capture
        .frames
        .iter()
        .map(|f| {
            let c = &f.camera;
            let pose = to_capture.pose(&f.world_from_camera).flip_y_z();
            let (r, t) = (pose.rotation, pose.translation);
            let row = |k: usize| [r.x_axis[k], r.y_axis[k], r.z_axis[k], t[k]];
            let (model, k, p) = match c.lens {
                Lens::Pinhole => ("PINHOLE", [0.0; 4], [0.0; 2]),
                Lens::Brown { k, p } => ("OPENCV", [k[0], k[1], k[2], 0.0], p),
                Lens::Fisheye { k, .. } => ("OPENCV_FISHEYE", k, [0.0; 2]),
                Lens::Equirectangular => ("EQUIRECTANGULAR", [0.0; 4], [0.0; 2]),
                Lens::Fov { .. } => ("FOV", [0.0; 4], [0.0; 2]),
            };
            let mut frame = serde_json::json!({
                "file_path": f.image.strip_prefix(root).unwrap_or(&f.image).to_string_lossy(),
                "transform_matrix": [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]],
                "w": c.width, "h": c.height, "fl_x": c.fx, "fl_y": c.fy, "cx": c.cx, "cy": c.cy,
                "camera_model": model, "k1": k[0], "k2": k[1], "k3": k[2], "k4": k[3], "p1": p[0], "p2": p[1],
            });
            if let Some(m) = &f.mask {
                frame["mask_path"] = m.strip_prefix(root).unwrap_or(m).to_string_lossy().into();
            }
            if let Some(session) = f.session {
                frame["session"] = session.into();
            }
            frame
        })
        .collect();
    let names = |split: Split| -> Vec<String> {
        capture
            .frames
            .iter()
            .filter(|f| f.split == split)
            .map(|f| f.image.strip_prefix(root).unwrap_or(&f.image).to_string_lossy().into_owned())
            .collect()
    };
    let s = capture.scene;
    let scale = 0.5 / s.half;
    let center = to_capture.point(s.center);
    let mut json = serde_json::json!({
        "aabb_scale": s.aabb_scale,
        "scale": scale,
        "offset": (DVec3::splat(0.5) - center * scale).to_array(),
        "train_filenames": names(Split::Train),
        "val_filenames": names(Split::Val),
        "test_filenames": names(Split::Test),
        "frames": frames,
    });
    if capture.frames.iter().any(|f| f.mask.is_some()) {
        json["mask_meaning"] = serde_json::to_value(capture.masks.meaning).expect("a name");
    }
    if let Some(points) = points {
        json["ply_file_path"] = points.into();
    }
    crate::atomic::write(path, format!("{json:#}\n").as_bytes())
}
