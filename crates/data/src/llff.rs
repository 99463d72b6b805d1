//! `poses_bounds.npy` of LLFF (Mildenhall et al. 2019): per image a 3×5 matrix (axes down, right, back; center; height, width, focal
//! length) and the nearest and farthest depth.

use crate::error::{self, DataError, Result};
use crate::imported::{self, Imported};
use diorama_geom::capture::Frame;
use diorama_geom::glam::{DMat3, DVec3};
use diorama_geom::{Camera, Lens, Pose};
use std::path::{Path, PathBuf};

/// Reads `poses_bounds.npy` and the photographs in `images` (or reduced in `images_2` and so on), matched in the order of their names.
pub fn read(root: &Path) -> Result<Imported> {
    let file = root.join("poses_bounds.npy");
    let (shape, values) = read_npy(&file)?;
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

/// Shape and values of a little-endian f4 or f8 array in C order. The size is compared with the file before anything is allocated.
pub fn read_npy(file: &Path) -> Result<(Vec<usize>, Vec<f64>)> {
    let data = error::read(file, 1 << 30)?;
    let bad = |what: &str| DataError::input(file, format!("is not a usable .npy file: {what}"));
    if data.len() < 12 || &data[..6] != b"\x93NUMPY" {
        return Err(bad("the magic bytes are missing"));
    }
    let (length, start): (usize, usize) = if data[6] == 1 {
        (u16::from_le_bytes([data[8], data[9]]) as usize, 10)
    } else {
        (u32::from_le_bytes([data[8], data[9], data[10], data[11]]) as usize, 12)
    };
    let header = data.get(start..start.saturating_add(length)).ok_or_else(|| bad("the header ends too early"))?;
    let header = String::from_utf8_lossy(header);
    let field = |key: &str| header.split_once(key).map(|h| h.1.trim_start_matches([':', ' ', '\'', '"']));
    let size = match field("'descr'") {
        Some(d) if d.starts_with("<f8") => 8,
        Some(d) if d.starts_with("<f4") => 4,
        _ => return Err(bad("only little-endian f4 and f8 are read")),
    };
    if field("'fortran_order'").is_none_or(|f| !f.starts_with("False")) {
        return Err(bad("only C order is read"));
    }
    let shape = field("'shape'").and_then(|s| s.strip_prefix('(')).and_then(|s| s.split_once(')')).ok_or_else(|| bad("no shape"))?.0;
    let shape: Vec<usize> = shape
        .split(',')
        .map(str::trim)
        .filter(|s| !s.is_empty())
        .map(|s| s.parse().map_err(|_| bad("the shape is malformed")))
        .collect::<Result<_>>()?;
    let count = shape.iter().try_fold(1usize, |a, b| a.checked_mul(*b));
    let bytes = count.and_then(|c| c.checked_mul(size));
    let body = &data[start + length..];
    if bytes.is_none_or(|b| body.len() < b) {
        return Err(bad(&format!("shape {shape:?} needs more bytes than the file has")));
    }
    let body = &body[..bytes.unwrap_or(0)];
    let values = if size == 8 {
        body.chunks_exact(8).map(|b| f64::from_le_bytes(b.try_into().expect("eight bytes"))).collect()
    } else {
        body.chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().expect("four bytes")) as f64).collect()
    };
    Ok((shape, values))
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
    fn a_header_that_claims_too_much_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("a.npy");
        for shape in ["1000000000000, 17", "99999999999999999999, 2", "3, 17"] {
            std::fs::write(&file, npy(shape, &[1.0; 17])).unwrap();
            assert!(read_npy(&file).unwrap_err().is_input(), "{shape}");
        }
        std::fs::write(&file, b"\x93NUMPY\x01\0\xff\xff{").unwrap();
        assert!(read_npy(&file).is_err());
    }
}
