//! Shards of a data set as tar archives in WebDataset's layout: `NAME.png` and `NAME.json` of each image, one after the other.

use super::SetImage;
use crate::error::{DataError, Result};
use crate::{atomic, tar};
use rayon::prelude::*;
use std::num::NonZeroUsize;
use std::path::Path;

/// Folder of the shards in the data set's folder.
pub const SHARDS: &str = "shards";

/// Name of a shard's file.
fn file_name(shard: usize) -> String {
    format!("{shard:06}.tar")
}

/// Whether a file is a shard by its name.
fn is_shard(name: &str) -> bool {
    name.strip_suffix(".tar").is_some_and(|n| n.len() >= 6 && n.bytes().all(|b| b.is_ascii_digit()))
}

/// Writes `shards/000000.tar` and so on, of so many images each, and removes shards beyond; returns their number. Equal sets give equal
/// bytes.
///
/// The JSON of an image is its line of `annotations.jsonl`.
///
/// # Errors
/// When an image is missing, its name has another dot than that of its extension, which WebDataset ends keys at, or a file cannot be written.
pub fn write(folder: &Path, images: &[SetImage], per_shard: NonZeroUsize) -> Result<usize> {
    for image in images {
        let path = folder.join(&image.image);
        if image.stem().contains('.') {
            return Err(DataError::input(&path, "WebDataset ends names at the first dot; rename it without other dots"));
        }
        if !path.is_file() {
            return Err(DataError::input(&path, "is missing; make the data set again, which goes on with what is missing"));
        }
    }
    let own = folder.join(SHARDS);
    std::fs::create_dir_all(&own).map_err(DataError::io(&own, "create"))?;
    let shards: Vec<&[SetImage]> = images.chunks(per_shard.get()).collect();
    shards.par_iter().enumerate().try_for_each(|(k, images)| {
        atomic::write_with(&own.join(file_name(k)), |out| {
            for image in *images {
                let bytes = std::fs::read(folder.join(&image.image))?;
                tar::append(out, image.file_name(), &bytes)?;
                tar::append(out, &format!("{}.json", image.stem()), &serde_json::to_vec(image)?)?;
            }
            tar::end(out)
        })
    })?;
    remove_from(folder, shards.len())?;
    Ok(shards.len())
}

/// Removes all shards; what else is in their folder stays.
///
/// # Errors
/// When a file cannot be removed.
pub fn remove(folder: &Path) -> Result<()> {
    remove_from(folder, 0)
}

fn remove_from(folder: &Path, first: usize) -> Result<()> {
    let own = folder.join(SHARDS);
    if !own.is_dir() {
        return Ok(());
    }
    for entry in std::fs::read_dir(&own).map_err(DataError::io(&own, "read"))? {
        let path = entry.map_err(DataError::io(&own, "read"))?.path();
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        if is_shard(&name) && !(0..first).any(|k| name == file_name(k)) {
            std::fs::remove_file(&path).map_err(DataError::io(&path, "remove"))?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::super::{put, remove as remove_set, save};
    use super::*;

    fn image(name: &str) -> SetImage {
        SetImage {
            image: format!("images/{name}.png"),
            width: 4,
            height: 3,
            intrinsic: [5.0, 5.0, 2.0, 1.5],
            world_from_camera: [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]],
            scene: "s".into(),
            style: None,
            seed: None,
            words: Vec::new(),
        }
    }

    /// Names of an archive's files.
    fn names(bytes: &[u8]) -> Vec<String> {
        let mut at = 0;
        let mut out = Vec::new();
        while bytes[at] != 0 {
            let text = |from: usize, n: usize| String::from_utf8_lossy(&bytes[at + from..at + from + n]).trim_end_matches('\0').to_string();
            out.push(text(0, 100));
            at += 512 + usize::from_str_radix(&text(124, 12), 8).unwrap().next_multiple_of(512);
        }
        out
    }

    #[test]
    fn shards_hold_images_and_their_annotations_in_order() {
        let dir = tempfile::tempdir().unwrap();
        let folder = dir.path();
        let images: Vec<SetImage> = (0..5).map(|k| image(&format!("{k:08}"))).collect();
        images.iter().enumerate().for_each(|(k, i)| put(folder, &i.image, &vec![k as u8; 700]).unwrap());
        save(folder, &images).unwrap();
        let of = |n: usize| NonZeroUsize::new(n).unwrap();
        let read = |k: usize| std::fs::read(folder.join(SHARDS).join(file_name(k)));
        assert_eq!(write(folder, &images, of(2)).unwrap(), 3);
        assert_eq!(names(&read(0).unwrap()), ["00000000.png", "00000000.json", "00000001.png", "00000001.json"]);
        assert_eq!(names(&read(2).unwrap()), ["00000004.png", "00000004.json"]);
        let line = serde_json::to_vec(&images[4]).unwrap();
        assert!(read(2).unwrap().windows(line.len()).any(|w| w == line));
        let before = read(1).unwrap();
        write(folder, &images, of(2)).unwrap();
        assert_eq!(read(1).unwrap(), before);
        // Larger shards are fewer, and other files stay.
        put(folder, "shards/mine.tar", b"mine").unwrap();
        assert_eq!(write(folder, &images, of(4)).unwrap(), 2);
        assert!(read(1).is_ok() && read(2).is_err());
        remove_set(folder, &images).unwrap();
        assert!(read(0).is_err() && folder.join("shards/mine.tar").exists());
    }

    #[test]
    fn images_that_are_missing_or_have_dots_are_named() {
        let dir = tempfile::tempdir().unwrap();
        let one = NonZeroUsize::MIN;
        let e = write(dir.path(), &[image("a")], one).unwrap_err();
        assert!(e.is_input() && e.to_string().contains("images/a.png: is missing"), "{e}");
        let e = write(dir.path(), &[image("a.b")], one).unwrap_err().to_string();
        assert!(e.contains("ends names at the first dot"), "{e}");
        assert!(!dir.path().join(SHARDS).exists());
    }
}
