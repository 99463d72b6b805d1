//! NeRF-OSR's layout: `{train,validation,test}/{rgb,pose,intrinsics,mask}`, one text file with a 4 × 4 matrix (row by row) per photograph:
//! camera to world with x right, y down, z forward, and the intrinsics.

use crate::error::{self, DataError, Result};
use crate::transforms_json::rigid;
use crate::{photo, photo_import};
use diorama_geom::capture::{Frame, Split};
use diorama_geom::glam::{DMat3, DVec3};
use diorama_geom::{Camera, Pose};
use std::path::{Path, PathBuf};

/// Folders of the parts.
const PARTS: [(&str, Split); 3] = [("train", Split::Train), ("validation", Split::Val), ("test", Split::Test)];
/// Largest text file that is read, in bytes.
const LIMIT: u64 = 1 << 16;

/// Whether a folder has this layout.
pub fn is_layout(root: &Path) -> bool {
    root.join("train/rgb").is_dir() && root.join("train/pose").is_dir()
}

/// Reads all parts; the world is as the files have it, and its up direction unknown. Frames have masks where `mask/` has any.
///
/// # Errors
/// If a photograph lacks its pose, intrinsics or mask, one of these belongs to no photograph, sizes differ, or a matrix is none.
pub fn read(root: &Path) -> Result<Vec<Frame>> {
    let mut frames = Vec::new();
    for (name, split) in PARTS {
        let part = root.join(name);
        if part.join("rgb").is_dir() {
            read_part(&part, name, split, &mut frames)?;
        }
    }
    Ok(frames)
}

fn read_part(part: &Path, name: &str, split: Split, frames: &mut Vec<Frame>) -> Result<()> {
    let photos = photo_import::list(&part.join("rgb"))?;
    for folder in ["pose", "intrinsics"] {
        same_names(&photos, &part.join(folder), &["txt"])?;
    }
    let masks = part.join("mask");
    if masks.is_dir() {
        same_names(&photos, &masks, &["png", "jpg"])?;
    }
    for image in photos {
        let stem = stem(&image);
        let pose_file = part.join("pose").join(format!("{stem}.txt"));
        let m = matrix(&pose_file)?;
        let column = |c: usize| DVec3::new(m[c], m[4 + c], m[8 + c]);
        let pose = Pose { rotation: DMat3::from_cols(column(0), column(1), column(2)), translation: column(3) };
        let pose = rigid(pose).map_err(|what| DataError::input(&pose_file, format!("{what}; estimate this pose again")))?;
        let file = part.join("intrinsics").join(format!("{stem}.txt"));
        let k = matrix(&file)?;
        let (width, height) = photo::size(&image)?;
        let camera = Camera { fx: k[0], fy: k[5], cx: k[2], cy: k[6], ..Camera::pinhole(width, height, 1.0) };
        let in_image = |c: f64, n: u32| (0.0..=n as f64).contains(&c);
        if !(camera.fx > 0.0 && camera.fy > 0.0 && in_image(camera.cx, width) && in_image(camera.cy, height)) {
            let what = format!("focal lengths must be above 0 and the center lie in the photograph of {width}×{height} pixels");
            return Err(DataError::input(&file, what));
        }
        let mask = masks.is_dir().then(|| mask_of(&masks, &stem, &image, (width, height))).transpose()?;
        frames.push(Frame { mask, split, ..Frame::new(format!("{name}/{stem}"), image, camera, pose) });
    }
    Ok(())
}

fn stem(file: &Path) -> String {
    file.file_stem().unwrap_or_default().to_string_lossy().into_owned()
}

/// The mask of a photograph, whose size must be the same.
fn mask_of(masks: &Path, stem: &str, image: &Path, size: (u32, u32)) -> Result<PathBuf> {
    let file = ["png", "jpg"].map(|e| masks.join(format!("{stem}.{e}"))).into_iter().find(|f| f.is_file());
    let file = file.ok_or_else(|| DataError::input(masks, format!("has no mask named {stem}")))?;
    let own = photo::size(&file)?;
    if own != size {
        let what = format!("the mask is {}×{} but {} is {}×{}", own.0, own.1, image.display(), size.0, size.1);
        return Err(DataError::input(&file, format!("{what}; give the mask of this photograph")));
    }
    Ok(file)
}

/// Checks that a folder has one file for each photograph and no others.
fn same_names(photos: &[PathBuf], folder: &Path, extensions: &[&str]) -> Result<()> {
    let entries = folder.read_dir().map_err(DataError::io(folder, "read"))?;
    let is_one = |p: &PathBuf| p.extension().is_some_and(|e| extensions.contains(&&*e.to_string_lossy().to_lowercase()));
    let mut there: Vec<String> = entries.flatten().map(|e| e.path()).filter(is_one).map(|p| stem(&p)).collect();
    there.sort();
    let counts = format!("{} files for {} photographs", there.len(), photos.len());
    if let Some(missing) = photos.iter().find(|p| there.binary_search(&stem(p)).is_err()) {
        return Err(DataError::input(folder, format!("has {counts}: none for {}; add it or remove the photograph", missing.display())));
    }
    let mut known: Vec<String> = photos.iter().map(|p| stem(p)).collect();
    known.sort();
    match there.iter().find(|s| known.binary_search(s).is_err()) {
        Some(more) => Err(DataError::input(folder, format!("has {counts}: {more} belongs to none; remove it or add the photograph"))),
        None => Ok(()),
    }
}

/// Reads 16 finite numbers.
fn matrix(file: &Path) -> Result<[f64; 16]> {
    parse_matrix(&error::read(file, LIMIT)?, file)
}

/// Parses 16 finite numbers between blanks; `file` is named in errors.
///
/// # Errors
/// If there are more or fewer, or one is no finite number.
pub fn parse_matrix(bytes: &[u8], file: &Path) -> Result<[f64; 16]> {
    let text = String::from_utf8_lossy(bytes);
    let words: Vec<&str> = text.split_whitespace().collect();
    if words.len() != 16 {
        return Err(DataError::input(file, format!("holds {} numbers, not the 16 of a 4 × 4 matrix", words.len())));
    }
    let mut out = [0.0; 16];
    for (i, word) in words.iter().enumerate() {
        let number = word.parse::<f64>().ok().filter(|v| v.is_finite());
        out[i] = number
            .ok_or_else(|| DataError::input(file, format!("row {}, column {}: {word:.40} is not a finite number", i / 4 + 1, i % 4 + 1)))?;
    }
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_geom::ImageU8;

    /// Two photographs to train on and one to test on.
    fn write(root: &Path) {
        for (part, names) in [("train", &["a_01", "a_02"][..]), ("test", &["b_01"])] {
            for folder in ["rgb", "pose", "intrinsics", "mask"] {
                std::fs::create_dir_all(root.join(part).join(folder)).unwrap();
            }
            for (i, name) in names.iter().enumerate() {
                let at = |folder: &str, extension: &str| root.join(part).join(folder).join(format!("{name}.{extension}"));
                let im = ImageU8 { width: 8, height: 6, channels: 3, data: vec![90; 144] };
                photo::save_png(&at("rgb", "png"), &im).unwrap();
                photo::save_png(&at("mask", "png"), &ImageU8 { channels: 1, data: vec![255; 48], ..im }).unwrap();
                std::fs::write(at("pose", "txt"), format!("1 0 0 {i}\n0 1 0 0.5\n0 0 1 0\n0 0 0 1\n")).unwrap();
                std::fs::write(at("intrinsics", "txt"), "10 0 4 0 0 11 3 0 0 0 1 0 0 0 0 1").unwrap();
            }
        }
    }

    #[test]
    fn parts_poses_intrinsics_and_masks_are_read() {
        let dir = tempfile::tempdir().unwrap();
        write(dir.path());
        assert!(is_layout(dir.path()));
        let frames = read(dir.path()).unwrap();
        assert_eq!(frames.iter().map(|f| &f.name[..]).collect::<Vec<_>>(), ["train/a_01", "train/a_02", "test/b_01"]);
        assert_eq!(frames.iter().map(|f| f.split).collect::<Vec<_>>(), [Split::Train, Split::Train, Split::Test]);
        assert_eq!(frames[1].world_from_camera.translation, DVec3::new(1.0, 0.5, 0.0));
        let c = frames[0].camera;
        assert_eq!((c.width, c.height, c.fx, c.fy, c.cx, c.cy), (8, 6, 10.0, 11.0, 4.0, 3.0));
        assert!(frames.iter().all(|f| f.mask.is_some()));
    }

    #[test]
    fn the_first_mismatch_is_named() {
        let fault = |change: &dyn Fn(&Path)| {
            let dir = tempfile::tempdir().unwrap();
            write(dir.path());
            change(&dir.path().join("train"));
            let e = read(dir.path()).unwrap_err();
            assert!(e.is_input(), "{e}");
            e.to_string()
        };
        let e = fault(&|p| std::fs::remove_file(p.join("pose/a_02.txt")).unwrap());
        assert!(e.contains("1 files for 2 photographs") && e.contains("a_02.png"), "{e}");
        let e = fault(&|p| std::fs::write(p.join("intrinsics/c.txt"), "").unwrap());
        assert!(e.contains("c belongs to none"), "{e}");
        let e = fault(&|p| {
            let small = ImageU8 { width: 4, height: 3, channels: 1, data: vec![255; 12] };
            photo::save_png(&p.join("mask/a_01.png"), &small).unwrap();
        });
        assert!(e.contains("mask/a_01.png") && e.contains("4×3") && e.contains("8×6"), "{e}");
        let e = fault(&|p| std::fs::write(p.join("pose/a_01.txt"), "1 0 0").unwrap());
        assert!(e.contains("3 numbers, not the 16"), "{e}");
        let e = fault(&|p| std::fs::write(p.join("pose/a_01.txt"), "1 0 0 0 0 x 0 0 0 0 1 0 0 0 0 1").unwrap());
        assert!(e.contains("row 2, column 2"), "{e}");
        let e = fault(&|p| std::fs::write(p.join("pose/a_01.txt"), "2 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1").unwrap());
        assert!(e.contains("not rigid"), "{e}");
        let e = fault(&|p| std::fs::write(p.join("intrinsics/a_01.txt"), "0 0 4 0 0 11 3 0 0 0 1 0 0 0 0 1").unwrap());
        assert!(e.contains("focal lengths"), "{e}");
    }
}
