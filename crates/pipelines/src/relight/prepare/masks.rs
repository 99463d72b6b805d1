//! Masks of what moved: 255 is static, 0 transient, 192 static glass.

use diorama_data::masks::GLASS;
use diorama_data::{DataError, Result, photo};
use diorama_geom::ImageU8;
use std::path::{Path, PathBuf};

/// A mask must leave at least this share of the photograph.
const LEAST: f64 = 0.05;
/// Masks that together leave less than this share seem inverted.
const INVERTED: f64 = 0.35;
/// Values from here on are static.
const STATIC: u8 = 128;

/// The file of the mask of each photograph in a folder: `NAME.png` or `NAME.jpg.png`.
///
/// # Errors
/// If a photograph has none; the first is named.
pub fn files(folder: &Path, photos: &[PathBuf]) -> Result<Vec<PathBuf>> {
    if !folder.is_dir() {
        return Err(DataError::input(folder, "is no folder; --masks needs one with a PNG for each photograph"));
    }
    let of = |photo: &PathBuf| {
        let (stem, whole) = (photo.file_stem().unwrap_or_default(), photo.file_name().unwrap_or_default());
        let named = [stem, whole].map(|n| folder.join(format!("{}.png", n.to_string_lossy())));
        named.into_iter().find(|f| f.is_file())
    };
    let found: Vec<Option<PathBuf>> = photos.iter().map(of).collect();
    let count = found.iter().flatten().count();
    match photos.iter().zip(&found).find(|(_, f)| f.is_none()) {
        Some((photo, _)) => Err(DataError::input(
            folder,
            format!(
                "has masks for {count} of {} photographs: none for {}; add {}.png, all 255 where nothing moves",
                photos.len(),
                photo.display(),
                photo.file_stem().unwrap_or_default().to_string_lossy()
            ),
        )),
        None => Ok(found.into_iter().flatten().collect()),
    }
}

/// A mask of the same shape as its photograph.
///
/// # Errors
/// If it cannot be decoded, has another shape, or leaves less than 5 % of the photograph.
pub fn read(file: &Path, image: &Path) -> Result<ImageU8> {
    let mut mask = photo::load_mask(file)?;
    let (own, size) = ((mask.width as u32, mask.height as u32), photo::size(image)?);
    if !photo::is_same_aspect(own, size) {
        let what = format!("the mask is {}×{} but {} is {}×{}", own.0, own.1, image.display(), size.0, size.1);
        return Err(DataError::input(file, format!("{what}; give the mask of this photograph")));
    }
    // Masks may hold class numbers instead of gray values: 1 is kept.
    if mask.data.iter().all(|v| *v <= 1) {
        mask.data.iter_mut().for_each(|v| *v *= 255);
    }
    let share = static_share(&mask);
    if share < LEAST {
        return Err(DataError::input(file, covers(share)));
    }
    Ok(mask)
}

/// Share of a mask that is static.
pub fn static_share(mask: &ImageU8) -> f64 {
    mask.data.iter().filter(|v| **v >= STATIC).count() as f64 / mask.data.len().max(1) as f64
}

/// Share of a mask that is glass.
pub fn glass_share(mask: &ImageU8) -> f64 {
    mask.data.iter().filter(|v| GLASS.contains(v)).count() as f64 / mask.data.len().max(1) as f64
}

fn covers(share: f64) -> String {
    let hint = "255 is static, 0 transient: invert the masks if they mark what moves with 255";
    format!("the mask covers {:.0} % of the photograph as transient; {hint}", 100.0 * (1.0 - share))
}

/// Checks that masks together are not inverted: what moves is the smaller part of photographs.
///
/// # Errors
/// If they leave less than 35 % on average; the one that leaves least is named.
pub fn check_together(masks: &[(PathBuf, f64)]) -> Result<()> {
    let mean = masks.iter().map(|m| m.1).sum::<f64>() / masks.len().max(1) as f64;
    match masks.iter().min_by(|a, b| a.1.total_cmp(&b.1)) {
        Some((file, share)) if mean < INVERTED => {
            let all = format!("all masks together cover {:.0} %, so they seem inverted", 100.0 * (1.0 - mean));
            Err(DataError::input(file, format!("{}; {all}", covers(*share))))
        }
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn folder(shares: &[f64]) -> (tempfile::TempDir, Vec<PathBuf>) {
        let dir = tempfile::tempdir().unwrap();
        std::fs::create_dir(dir.path().join("masks")).unwrap();
        let photos = shares.iter().enumerate().map(|(i, share)| {
            let image = dir.path().join(format!("p{i}.png"));
            photo::save_png(&image, &ImageU8 { width: 20, height: 10, channels: 3, data: vec![70; 600] }).unwrap();
            let data = (0..200).map(|k| if (k as f64) < 200.0 * share { 255 } else { 0 }).collect();
            photo::save_png(&dir.path().join(format!("masks/p{i}.png")), &ImageU8 { width: 20, height: 10, channels: 1, data }).unwrap();
            image
        });
        let photos = photos.collect();
        (dir, photos)
    }

    #[test]
    fn masks_that_cover_all_are_refused_with_file_and_share() {
        let (dir, photos) = folder(&[0.9, 0.02]);
        let files = files(&dir.path().join("masks"), &photos).unwrap();
        assert!((static_share(&read(&files[0], &photos[0]).unwrap()) - 0.9).abs() < 1e-9);
        let e = read(&files[1], &photos[1]).unwrap_err().to_string();
        assert!(e.contains("p1.png") && e.contains("98 %") && e.contains("255 is static"), "{e}");
    }

    #[test]
    fn inverted_masks_are_recognized_together() {
        let all =
            |shares: &[f64]| check_together(&shares.iter().enumerate().map(|(i, s)| (format!("m{i}.png").into(), *s)).collect::<Vec<_>>());
        assert!(all(&[0.9, 0.2, 0.8]).is_ok() && all(&[]).is_ok());
        let e = all(&[0.3, 0.12, 0.2]).unwrap_err().to_string();
        assert!(e.contains("m1.png") && e.contains("88 %") && e.contains("inverted"), "{e}");
    }

    #[test]
    fn the_first_photograph_without_a_mask_or_with_one_of_another_shape_is_named() {
        let (dir, mut photos) = folder(&[1.0, 1.0]);
        let masks = dir.path().join("masks");
        photos.push(dir.path().join("p2.png"));
        let e = files(&masks, &photos).unwrap_err().to_string();
        assert!(e.contains("2 of 3") && e.contains("p2.png"), "{e}");
        photo::save_png(&masks.join("p0.png"), &ImageU8 { width: 20, height: 20, channels: 1, data: vec![255; 400] }).unwrap();
        let e = read(&masks.join("p0.png"), &photos[0]).unwrap_err().to_string();
        assert!(e.contains("20×20") && e.contains("20×10"), "{e}");
    }
}
