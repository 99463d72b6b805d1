//! Checks of annotations: what no file of the data set may hold.

use super::geometry::{bounds, crossing, overlap, signed_area};
use super::{SetImage, SetWord, WordPose, rotation};
use crate::text_labels::UNREADABLE;
use diorama_geom::glam::{DMat3, DVec3};
use diorama_geom::transform::{Pose, rotation_from_axis_angle, rotation_from_quaternion};
use std::collections::HashMap;

/// Distance in pixels by which a corner may leave its image: rounding of projections.
const MARGIN_PX: f64 = 1e-6;
/// Area in square pixels that a quad or polygon exceeds.
const LEAST_AREA: f64 = 1e-6;
/// Largest deviation of an entry of a rotation: matrices are written with all digits, so this is rounding and more.
const ROTATION_TOLERANCE: f64 = 1e-6;

type Checked = std::result::Result<(), String>;

/// Checks all images and that their names differ; `at` says where an image stands.
pub fn check_all(images: &[SetImage], at: impl Fn(usize) -> String) -> Checked {
    // Names that differ in case only are one file on some systems.
    let mut known: HashMap<String, usize> = HashMap::new();
    for (k, image) in images.iter().enumerate() {
        check(image).map_err(|e| format!("{}: {}: {e}", at(k), image.image))?;
        if let Some(first) = known.insert(image.stem().to_lowercase(), k) {
            let (one, other) = (&image.image, &images[first].image);
            return Err(format!("{}: {one} has the name of {other} at {}; give each image a name of its own", at(k), at(first)));
        }
    }
    Ok(())
}

/// Checks an image: its name, camera and words. Quads and polygons are finite, inside of the image within 1e-6 px, without crossing
/// sides, and clockwise around an area.
///
/// # Errors
/// With the word, the corner and what to do.
pub fn check(image: &SetImage) -> Checked {
    check_name(&image.image)?;
    if image.width == 0 || image.height == 0 {
        return Err(format!("an image of {}×{} has no pixels; give its size", image.width, image.height));
    }
    let [fx, fy, cx, cy] = image.intrinsic;
    if ![fx, fy, cx, cy].iter().all(|v| v.is_finite()) || fx <= 0.0 || fy <= 0.0 {
        return Err(format!("intrinsic {:?} is no camera; give fx, fy > 0 and cx, cy in pixels", image.intrinsic));
    }
    check_rigid(&image.world_from_camera).map_err(|e| format!("world_from_camera {e}"))?;
    for (k, word) in image.words.iter().enumerate() {
        check_word(word, (image.width, image.height)).map_err(|e| format!("word {k}: {e}"))?;
    }
    Ok(())
}

/// Whether a path is relative, stays in the data set's folder and can stand in a line.
fn check_name(path: &str) -> Checked {
    let is_part = |p: &str| !p.is_empty() && p != "." && p != "..";
    if !path.split('/').all(is_part) || path.contains(|c: char| c.is_control() || "\\:\u{2028}\u{2029}".contains(c)) {
        return Err(format!("{path:?} is no path in the data set's folder; name it like images/000000.png"));
    }
    match path.rsplit('/').next().and_then(|name| name.rsplit_once('.')) {
        Some((stem, extension)) if !stem.is_empty() && !extension.is_empty() => Ok(()),
        _ => Err(format!("{path:?} has no name and extension; name it like images/000000.png")),
    }
}

fn check_word(word: &SetWord, size: (u32, u32)) -> Checked {
    check_shape(&word.quad, size).map_err(|e| format!("quad: {e}"))?;
    check_shape(&word.polygon, size).map_err(|e| format!("polygon: {e}"))?;
    let around_word = bounds(&word.polygon);
    if !overlap(bounds(&word.quad), around_word) {
        return Err("its quad and its polygon are apart; give both in pixels of this image".into());
    }
    if word.transcription.trim().is_empty() {
        return Err(format!("its transcription is empty; write {UNREADABLE} for what nobody can read"));
    }
    if !(0.0..=1.0).contains(&word.visibility) {
        return Err(format!("visibility {} is no share; give 0 to 1", word.visibility));
    }
    if let Some(pose) = &word.pose {
        check_pose(pose).map_err(|e| format!("pose: {e}"))?;
    }
    for (k, character) in word.characters.iter().enumerate() {
        check_shape(&character.quad, size).map_err(|e| format!("character {k}: {e}"))?;
        if !overlap(bounds(&character.quad), around_word) {
            return Err(format!("character {k} is apart from its word; give both in pixels of this image"));
        }
    }
    Ok(())
}

fn check_shape(polygon: &[[f64; 2]], (w, h): (u32, u32)) -> Checked {
    if polygon.len() < 3 {
        return Err(format!("{} corners; a polygon has at least 3", polygon.len()));
    }
    if let Some(k) = polygon.iter().position(|p| p.iter().any(|v| !v.is_finite())) {
        return Err(format!("corner {k} is not a number; leave out words behind the camera"));
    }
    let is_in = |v: f64, size: u32| (-MARGIN_PX..=size as f64 + MARGIN_PX).contains(&v);
    if let Some(k) = polygon.iter().position(|p| !is_in(p[0], w) || !is_in(p[1], h)) {
        let [x, y] = polygon[k];
        return Err(format!("corner {k} at {x}, {y} is outside of the image of {w}×{h}; clip it at the image's border"));
    }
    if let Some((i, j)) = crossing(polygon) {
        return Err(format!("the side after corner {i} crosses the side after corner {j}; order the corners clockwise"));
    }
    let area = signed_area(polygon);
    if area < -LEAST_AREA {
        return Err("its corners are counterclockwise; order them clockwise from the upper left in reading order".into());
    }
    if area <= LEAST_AREA {
        return Err("its corners enclose no area; leave it out".into());
    }
    Ok(())
}

fn check_rigid(transform: &[[f64; 4]; 3]) -> Checked {
    if transform.iter().flatten().any(|v| !v.is_finite()) {
        return Err("holds what is not a number; give rotation and center".into());
    }
    let error = Pose { rotation: rotation(transform), translation: DVec3::ZERO }.rigidity_error();
    if error > ROTATION_TOLERANCE {
        return Err(format!("is no rotation by {error:e}; remove scale, shear and mirroring"));
    }
    Ok(())
}

fn check_pose(pose: &WordPose) -> Checked {
    check_rigid(&pose.text_pose).map_err(|e| format!("text_pose {e}"))?;
    if !pose.size.iter().all(|v| v.is_finite() && *v > 0.0) {
        return Err(format!("size {:?} is no width and height; give both > 0", pose.size));
    }
    let expected = rotation(&pose.text_pose);
    let is_same = |r: DMat3| (r - expected).to_cols_array().iter().all(|d| d.abs() <= ROTATION_TOLERANCE);
    let length = pose.quaternion.iter().map(|v| v * v).sum::<f64>().sqrt();
    // The rotation of a quaternion is that of its unit length.
    if (length - 1.0).abs() > ROTATION_TOLERANCE || !is_same(rotation_from_quaternion(pose.quaternion)) {
        return Err("its quaternion is not the rotation of text_pose; derive it with WordPose::new".into());
    }
    if !is_same(rotation_from_axis_angle(DVec3::from_array(pose.axis_angle))) {
        return Err("its axis_angle is not the rotation of text_pose; derive it with WordPose::new".into());
    }
    Ok(())
}
