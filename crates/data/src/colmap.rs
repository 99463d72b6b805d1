//! Reads captures from COLMAP models, and writes them.

pub use crate::colmap_model::{Observed, Point, find_model, observations, points, registered};

use crate::colmap_model::{MODELS, read_cameras, read_images};
use crate::error::{DataError, Result};
use crate::imported::{self, Imported, locate};
use crate::sparse::Sparse;
use diorama_geom::capture::Frame;
use diorama_geom::{Camera, Capture, Lens};
use std::path::Path;

/// Reads the largest model under `root`. Its photographs are in `root/images`, in `root`, or reduced in `root/images_2` and so on.
pub fn read(root: &Path) -> Result<Imported> {
    let model = find_model(root)
        .ok_or_else(|| DataError::input(root, "holds no COLMAP model (images.bin or images.txt, in sparse/0 for example)"))?;
    let file = ["images.bin", "images.txt"].map(|n| model.join(n)).into_iter().find(|f| f.exists()).unwrap_or_else(|| model.clone());
    let cameras = read_cameras(&model)?;
    let mut sparse = Sparse::read(&model)?;
    let mut images = read_images(&model, &mut |image, keypoints| {
        sparse.observe(cameras.get(&image.camera), &image.world_from_camera, keypoints);
    })?;
    sparse.check_tracks(&model, &images, |image| cameras.get(&image.camera))?;
    let mut out = Imported { unknown_up: true, ..Imported::default() };
    let mut order: Vec<usize> = (0..images.len()).collect();
    order.sort_by(|a, b| images[*a].name.cmp(&images[*b].name));
    let mut frame_of = vec![None; images.len()];
    for i in order {
        let im = &mut images[i];
        let camera = *cameras.get(&im.camera).ok_or_else(|| {
            DataError::input(&file, format!("image {} names camera {}, which is not in the cameras file", im.name, im.camera))
        })?;
        let pose = crate::transforms_json::rigid(im.world_from_camera)
            .map_err(|e| DataError::input(&file, format!("image {}: {e}; run COLMAP again", im.name)))?;
        let mut found = None;
        for folder in imported::IMAGE_FOLDERS {
            found = locate(root, &format!("{folder}/{}", im.name), &file, "name")?;
            if found.is_some() {
                break;
            }
        }
        let Some(image) = found else {
            out.missing.push(std::mem::take(&mut im.name));
            continue;
        };
        let name = Path::new(&im.name).with_extension("").to_string_lossy().into_owned();
        frame_of[i] = Some(out.frames.len() as u32);
        out.frames.push(Frame::new(name, image, camera, pose));
    }
    (out.points, out.agreement) = sparse.finish(&frame_of, &out.frames);
    out.model = Some(model);
    out.notes.extend(imported::without_pose(root, &out.frames)?);
    Ok(out)
}

/// Writes a capture as a text model: `cameras.txt`, `images.txt`, an empty `points3D.txt`.
pub fn write_text(folder: &Path, capture: &Capture) -> Result<()> {
    std::fs::create_dir_all(folder).map_err(DataError::io(folder, "create"))?;
    let to_capture = capture.world_from_capture.inverse();
    let (mut cameras, mut images) = (String::new(), String::new());
    for (i, f) in capture.frames.iter().enumerate() {
        let c = &f.camera;
        let (model, params) = model_of(c);
        let numbers: Vec<String> = params.iter().map(|p| format!("{p:?}")).collect();
        cameras += &format!("{} {} {} {} {}\n", i + 1, MODELS[model].0, c.width, c.height, numbers.join(" "));
        let p = to_capture.pose(&f.world_from_camera).inverse();
        let q = diorama_geom::glam::DQuat::from_mat3(&p.rotation);
        let t = p.translation;
        let name = f.image.file_name().unwrap_or_default().to_string_lossy();
        images += &format!("{} {:?} {:?} {:?} {:?} {:?} {:?} {:?} {} {name}\n\n", i + 1, q.w, q.x, q.y, q.z, t.x, t.y, t.z, i + 1);
    }
    crate::atomic::write(&folder.join("cameras.txt"), cameras.as_bytes())?;
    crate::atomic::write(&folder.join("images.txt"), images.as_bytes())?;
    crate::atomic::write(&folder.join("points3D.txt"), b"")
}

/// COLMAP's model id and parameters for a camera.
fn model_of(c: &Camera) -> (usize, Vec<f64>) {
    let mut p = vec![c.fx, c.fy, c.cx, c.cy];
    let model = match c.lens {
        Lens::Pinhole | Lens::Equirectangular => 1,
        Lens::Brown { k, p: t } => {
            p.extend([k[0], k[1], t[0], t[1], k[2], k[3], k[4], k[5]]);
            6
        }
        Lens::Fov { omega } => {
            p.push(omega);
            7
        }
        Lens::Fisheye { k, p: t, s } => {
            p.extend([k[0], k[1], t[0], t[1], k[2], k[3], s[0], s[1]]);
            10
        }
    };
    (model, p)
}

#[cfg(test)]
#[path = "colmap_tests.rs"]
mod tests;
