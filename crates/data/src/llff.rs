//! `poses_bounds.npy` of LLFF (Mildenhall et al. 2019): per image a 3×5 matrix (axes down, right, back; center; height, width, focal
//! length) and the nearest and farthest depth.

use crate::error::{DataError, Result};
use crate::imported::{self, Imported};
use crate::npy;
use diorama_geom::capture::Frame;
use diorama_geom::glam::{DMat3, DVec3};
use diorama_geom::{Camera, Lens, Pose};
use std::path::{Path, PathBuf};

/// Reads `poses_bounds.npy` and the photographs in `images` (or reduced in `images_2` and so on), matched in the order of their names.
pub fn read(root: &Path) -> Result<Imported> {
    let file = root.join("poses_bounds.npy");
    let (shape, values) = npy::read(&file)?;
    if shape.len() != 2 || shape[1] != 17 {
        return Err(DataError::input(&file, format!("has shape {shape:?}; expected [images, 17]")));
    }
    let mut folders = imported::IMAGE_FOLDERS.iter().filter(|f| **f != ".").map(|f| root.join(f));
    let folder = folders.find(|f| f.is_dir()).unwrap_or(root.join("images"));
    let mut images: Vec<PathBuf> = folder
        .read_dir()
        .map_err(DataError::io(&folder, "read"))?
        .flatten()
        .map(|e| e.path())
        .filter(|p| !p.file_name().is_some_and(|n| n.to_string_lossy().starts_with(crate::photo::DYNAMIC_MASK)))
        .filter(|p| {
            p.extension().and_then(|e| e.to_str()).is_some_and(|e| ["png", "jpg", "jpeg"].contains(&e.to_ascii_lowercase().as_str()))
        })
        .collect();
    images.sort();
    if images.len() != shape[0] {
        return Err(DataError::input(
            &file,
            format!(
                "holds {} poses but {}/ holds {} photographs; they must match",
                shape[0],
                folder.file_name().unwrap_or_default().to_string_lossy(),
                images.len()
            ),
        ));
    }
    let mut out = Imported { unknown_up: true, ..Imported::default() };
    for (i, (v, image)) in values.chunks_exact(17).zip(images).enumerate() {
        let column = |c: usize| DVec3::new(v[c], v[5 + c], v[10 + c]);
        let (down, right, back) = (column(0), column(1), column(2));
        let pose = Pose { rotation: DMat3::from_cols(right, down, -back), translation: column(3) };
        let pose = crate::transforms_json::rigid(pose).map_err(|e| DataError::input(&file, format!("pose {i}: {e}")))?;
        let (h, w, f) = (v[4], v[9], v[14]);
        if !(h >= 1.0 && w >= 1.0 && f > 0.0 && h < 1e6 && w < 1e6) {
            return Err(DataError::input(&file, format!("pose {i}: height {h}, width {w}, focal length {f} are not plausible")));
        }
        let camera = Camera { width: w as u32, height: h as u32, fx: f, fy: f, cx: 0.5 * w, cy: 0.5 * h, lens: Lens::Pinhole };
        let name = image.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        out.frames.push(Frame::new(name, image, camera, pose));
    }
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn npy(shape: &str, values: &[f64]) -> Vec<u8> {
        let header = format!("{{'descr': '<f8', 'fortran_order': False, 'shape': ({shape}), }}\n");
        let mut out = b"\x93NUMPY\x01\0".to_vec();
        out.extend((header.len() as u16).to_le_bytes());
        out.extend(header.as_bytes());
        values.iter().for_each(|v| out.extend(v.to_le_bytes()));
        out
    }

    #[test]
    fn axes_are_turned_from_down_right_back() {
        let dir = tempfile::tempdir().unwrap();
        std::fs::create_dir(dir.path().join("images")).unwrap();
        for n in ["0.png", "1.png"] {
            std::fs::write(dir.path().join("images").join(n), b"x").unwrap();
        }
        // A camera whose right, down and forward are the world's x, y and z.
        let pose = [0.0, 1.0, 0.0, 5.0, 48.0, 1.0, 0.0, 0.0, 6.0, 64.0, 0.0, 0.0, -1.0, 7.0, 50.0, 0.1, 9.0];
        std::fs::write(dir.path().join("poses_bounds.npy"), npy("2, 17", &[pose, pose].concat())).unwrap();
        let got = read(dir.path()).unwrap();
        assert_eq!(got.frames.len(), 2);
        let f = &got.frames[0];
        assert_eq!((f.camera.width, f.camera.height, f.camera.fx), (64, 48, 50.0));
        assert!((f.world_from_camera.rotation.x_axis - DVec3::X).length() < 1e-12);
        assert!((f.world_from_camera.rotation.z_axis - DVec3::Z).length() < 1e-12);
        assert_eq!(f.world_from_camera.translation, DVec3::new(5.0, 6.0, 7.0));
    }

    #[test]
    fn other_numbers_of_poses_and_photographs_are_refused() {
        let dir = tempfile::tempdir().unwrap();
        std::fs::create_dir(dir.path().join("images")).unwrap();
        std::fs::write(dir.path().join("images/0.png"), b"x").unwrap();
        std::fs::write(dir.path().join("poses_bounds.npy"), npy("2, 17", &[1.0; 34])).unwrap();
        let e = read(dir.path()).unwrap_err();
        assert!(e.is_input() && e.to_string().contains("2 poses") && e.to_string().contains("1 photographs"), "{e}");
    }

    #[test]
    fn another_shape_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        std::fs::write(dir.path().join("poses_bounds.npy"), npy("2, 15", &[1.0; 30])).unwrap();
        let e = read(dir.path()).unwrap_err();
        assert!(e.is_input() && e.to_string().contains("[2, 15]") && e.to_string().contains("[images, 17]"), "{e}");
    }

    #[test]
    fn a_header_that_claims_too_much_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("a.npy");
        for shape in ["1000000000000, 17", "99999999999999999999, 2", "3, 17"] {
            std::fs::write(&file, npy(shape, &[1.0; 17])).unwrap();
            assert!(npy::read(&file).unwrap_err().is_input(), "{shape}");
        }
        std::fs::write(&file, b"\x93NUMPY\x01\0\xff\xff{").unwrap();
        assert!(npy::read(&file).is_err());
    }
}
