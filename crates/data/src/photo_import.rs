//! Copies photographs into a data set: upright, limited in size, without metadata.

use crate::atomic;
use crate::error::{DataError, Result};
use crate::photo::{self, Photo};
use diorama_geom::ImageU8;
use std::path::{Path, PathBuf};

/// File extensions of photographs.
pub const EXTENSIONS: [&str; 8] = ["jpg", "jpeg", "png", "webp", "tif", "tiff", "exr", "hdr"];
/// JPEG quality of photographs that are encoded again.
const JPEG_QUALITY: u8 = 96;

/// Lists the photographs of a folder in the order of their names; numbers in names are compared as numbers.
///
/// # Errors
/// If the folder cannot be read or contains none.
pub fn list(folder: &Path) -> Result<Vec<PathBuf>> {
    let found = found(folder)?;
    if found.is_empty() {
        return Err(DataError::input(
            folder,
            format!("holds no photographs ({}); give the folder that contains them", EXTENSIONS.join(", ")),
        ));
    }
    Ok(found)
}

/// [`list`], but an empty result is no error.
pub(crate) fn found(folder: &Path) -> Result<Vec<PathBuf>> {
    let entries = folder.read_dir().map_err(DataError::io(folder, "read"))?;
    let is_photo = |p: &PathBuf| {
        let hidden =
            p.file_name().is_some_and(|n| n.to_string_lossy().starts_with('.') || n.to_string_lossy().starts_with(photo::DYNAMIC_MASK));
        let extension = p.extension().map(|e| e.to_string_lossy().to_ascii_lowercase());
        !hidden && p.is_file() && extension.is_some_and(|e| EXTENSIONS.contains(&&*e))
    };
    let mut found: Vec<PathBuf> = entries.flatten().map(|e| e.path()).filter(is_photo).collect();
    found.sort_by_cached_key(|p| natural(&p.file_name().unwrap_or_default().to_string_lossy()));
    Ok(found)
}

/// Sort key by which IMG_9 comes before IMG_10: pairs of a text and the number that follows it.
fn natural(name: &str) -> Vec<(String, Option<u64>)> {
    let mut key = vec![(String::new(), None)];
    for c in name.chars() {
        let last = key.last_mut().expect("begins with one");
        match (c.to_digit(10), last.1) {
            (Some(d), n) => last.1 = Some(n.unwrap_or(0u64).saturating_mul(10).saturating_add(d as u64)),
            (None, Some(_)) => key.push((c.to_string(), None)),
            (None, None) => last.0.push(c),
        }
    }
    key
}

/// Focal length divided by the longer side, both in pixels, from the photograph's EXIF data (35 mm equivalent focal length, which refers
/// to the diagonal).
pub fn focal_ratio(photo: &Path) -> Option<f64> {
    /// Diagonal of 35 mm film in millimeters.
    const FILM: f64 = 43.267;
    let mut file = std::io::BufReader::new(std::fs::File::open(photo).ok()?);
    let exif = exif::Reader::new().read_from_container(&mut file).ok()?;
    let field = exif.get_field(exif::Tag::FocalLengthIn35mmFilm, exif::In::PRIMARY)?;
    let mm = field.value.get_uint(0).filter(|v| (5..2000).contains(v))? as f64;
    let (w, h) = photo::size(photo).ok()?;
    let (w, h) = (w as f64, h as f64);
    Some(mm / FILM * w.hypot(h) / w.max(h))
}

/// Writes a photograph as `folder/stem` with its extension. A JPEG that needs no change keeps its coded pixels bit for bit. Lossless
/// photographs stay lossless, at their full range of values. Metadata are always removed.
///
/// # Errors
/// If the photograph cannot be decoded, or the file cannot be written.
pub fn import(source: &Path, folder: &Path, stem: &str, max_side: u32) -> Result<PathBuf> {
    let header = photo::header(source)?;
    let (w, h) = header.size;
    let shrink = w.max(h) > max_side;
    let bytes = std::fs::read(source).map_err(DataError::io(source, "read"))?;
    if !shrink && bytes.starts_with(&[0xff, 0xd8]) && !header.is_turned {
        // Decoding shows whether the file is complete.
        photo::load_full(source)?;
        if let Some(clean) = without_metadata(&bytes) {
            let target = folder.join(format!("{stem}.jpg"));
            atomic::write(&target, &clean)?;
            return Ok(target);
        }
    }
    let keeps_all = is_lossless(&bytes);
    drop(bytes);
    let mut photo = photo::load_full(source)?;
    if shrink {
        let by = max_side as f64 / w.max(h) as f64;
        photo = photo.downsampled(((w as f64 * by).round() as usize).max(1), ((h as f64 * by).round() as usize).max(1));
    }
    let (target, encoded) = match photo {
        Photo::Eight(image) => return write_as(&image, folder, stem, keeps_all),
        Photo::Sixteen(image) => (folder.join(format!("{stem}.png")), photo::encode_png_16(&image)),
        Photo::Linear(image) => (folder.join(format!("{stem}.exr")), photo::encode_exr(&image)),
    };
    atomic::write(&target, &encoded)?;
    Ok(target)
}

/// Whether a photograph was stored losslessly.
fn is_lossless(file: &[u8]) -> bool {
    if file.get(8..12) != Some(b"WEBP") {
        return !file.starts_with(&[0xff, 0xd8]);
    }
    // Finds the chunk that contains the picture.
    let mut at = 12;
    while let (Some(name), Some(length)) = (file.get(at..at + 4), file.get(at + 4..at + 8)) {
        if matches!(name, b"VP8 " | b"VP8L") {
            return name == b"VP8L";
        }
        let length = u32::from_le_bytes(length.try_into().expect("four bytes")) as usize;
        at = at.saturating_add(8 + length.next_multiple_of(2));
    }
    false
}

/// Writes pixels computed from a photograph: as PNG if the photograph was stored losslessly or has alpha, else as JPEG.
pub fn write_like(source: &Path, image: &ImageU8, folder: &Path, stem: &str) -> Result<PathBuf> {
    let bytes = std::fs::read(source).map_err(DataError::io(source, "read"))?;
    write_as(image, folder, stem, is_lossless(&bytes))
}

/// Writes pixels as JPEG, or as PNG if there is alpha.
pub fn write(image: &ImageU8, folder: &Path, stem: &str) -> Result<PathBuf> {
    write_as(image, folder, stem, false)
}

fn write_as(image: &ImageU8, folder: &Path, stem: &str, keeps_all: bool) -> Result<PathBuf> {
    if keeps_all || image.channels != 3 {
        let target = folder.join(format!("{stem}.png"));
        photo::save_png(&target, image)?;
        return Ok(target);
    }
    let target = folder.join(format!("{stem}.jpg"));
    let mut out = Vec::new();
    image::codecs::jpeg::JpegEncoder::new_with_quality(&mut out, JPEG_QUALITY)
        .encode(&image.data, image.width as u32, image.height as u32, image::ExtendedColorType::Rgb8)
        .map_err(|e| DataError::input(&target, format!("cannot be encoded ({e})")))?;
    atomic::write(&target, &out)?;
    Ok(target)
}

/// Removes EXIF, XMP, comments, previews and data after the end from a JPEG; color profiles stay. `None` if it is malformed.
pub fn without_metadata(jpeg: &[u8]) -> Option<Vec<u8>> {
    let mut out = jpeg.strip_prefix(&[0xff, 0xd8]).map(|_| vec![0xff, 0xd8])?;
    let mut at = 2;
    loop {
        if *jpeg.get(at)? != 0xff {
            return None;
        }
        let marker = *jpeg.get(at + 1)?;
        match marker {
            0xff => {
                at += 1;
                continue;
            }
            0xd9 => {
                out.extend([0xff, 0xd9]);
                return Some(out);
            }
            // Stuffed bytes and markers without a length are not allowed between segments.
            0x00 | 0x01 | 0xd0..=0xd8 => return None,
            _ => {}
        }
        let length = u16::from_be_bytes(jpeg.get(at + 2..at + 4)?.try_into().ok()?) as usize;
        let segment = jpeg.get(at..at + 2 + length)?;
        let body = segment.get(4..)?;
        let keep = match marker {
            0xe0 => body.starts_with(b"JFIF\0"),
            0xe2 => body.starts_with(b"ICC_PROFILE\0"),
            0xee => body.starts_with(b"Adobe"),
            0xe1..=0xef | 0xfe => false,
            _ => true,
        };
        if keep {
            out.extend(segment);
        }
        at += 2 + length;
        if marker == 0xda {
            let end = crate::jpeg::end_of_scan(jpeg, at)?;
            out.extend(&jpeg[at..end]);
            at = end;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn picture() -> ImageU8 {
        let data = (0..32 * 24).flat_map(|i| [(i % 32 * 8) as u8, (i / 32 * 10) as u8, 90]).collect();
        ImageU8 { width: 32, height: 24, channels: 3, data }
    }

    /// A test picture as JPEG, with a position in EXIF, a comment, and a second image after the end.
    fn with_metadata(dir: &Path) -> PathBuf {
        let plain = write(&picture(), dir, "plain").unwrap();
        let bytes = std::fs::read(&plain).unwrap();
        let mut out = bytes[..2].to_vec();
        for (marker, body) in [(0xe1u8, &b"Exif\0\0GPS 48.1 11.6"[..]), (0xfe, b"serial 1234")] {
            out.extend([0xff, marker]);
            out.extend((body.len() as u16 + 2).to_be_bytes());
            out.extend(body);
        }
        out.extend(&bytes[2..]);
        out.extend(b"GPS again");
        let path = dir.join("secret.jpg");
        std::fs::write(&path, out).unwrap();
        path
    }

    #[test]
    fn metadata_goes_and_pixels_stay() {
        let dir = tempfile::tempdir().unwrap();
        let source = with_metadata(dir.path());
        let out = dir.path().join("out");
        std::fs::create_dir(&out).unwrap();
        let made = import(&source, &out, "a", 100).unwrap();
        let bytes = std::fs::read(&made).unwrap();
        for secret in [&b"GPS"[..], b"Exif", b"serial"] {
            assert!(!bytes.windows(secret.len()).any(|w| w == secret), "{}", String::from_utf8_lossy(secret));
        }
        assert_eq!(photo::load(&made).unwrap(), photo::load(&source).unwrap());
        let small = photo::load(&import(&source, &out, "b", 16).unwrap()).unwrap();
        assert_eq!((small.width, small.height), (16, 12));
    }

    #[test]
    fn the_focal_length_is_read_before_it_goes() {
        let dir = tempfile::tempdir().unwrap();
        let plain = write(&picture(), dir.path(), "plain").unwrap();
        assert_eq!(focal_ratio(&plain), None);
        // A TIFF head, one entry that points to the EXIF directory, and there one entry: 26 mm on 35 mm film.
        let entry = |tag: u16, kind: u16, value: [u8; 4]| [&tag.to_be_bytes()[..], &kind.to_be_bytes(), &[0, 0, 0, 1], &value].concat();
        let mut tiff = b"MM\0\x2a\0\0\0\x08".to_vec();
        tiff.extend([&[0, 1][..], &entry(0x8769, 4, [0, 0, 0, 26]), &[0; 4]].concat());
        tiff.extend([&[0, 1][..], &entry(0xa405, 3, [0, 26, 0, 0]), &[0; 4]].concat());
        let bytes = std::fs::read(&plain).unwrap();
        let length = (tiff.len() as u16 + 8).to_be_bytes();
        let tagged = [&bytes[..2], &[0xff, 0xe1], &length, b"Exif\0\0", &tiff, &bytes[2..]].concat();
        let path = dir.path().join("tagged.jpg");
        std::fs::write(&path, tagged).unwrap();
        // 32 × 24 pixels have a diagonal of 40.
        assert!((focal_ratio(&path).unwrap() - 26.0 / 43.267 * 40.0 / 32.0).abs() < 1e-9);
    }

    #[test]
    fn what_was_stored_without_loss_stays_so() {
        use diorama_geom::Image;
        let dir = tempfile::tempdir().unwrap();
        let out = dir.path().join("out");
        std::fs::create_dir(&out).unwrap();
        let values: Vec<f32> = (0..32 * 24 * 3).map(|i| (i * 40_503 % 65_536) as f32 / 65_535.0).collect();
        let deep = Image { width: 32, height: 24, channels: 3, data: values };
        let light = Image { data: deep.data.iter().map(|v| v * 900.0).collect(), ..deep.clone() };
        let encode = |im: image::DynamicImage, format| {
            let mut bytes = std::io::Cursor::new(Vec::new());
            im.write_to(&mut bytes, format).unwrap();
            bytes.into_inner()
        };
        let eight = || image::RgbImage::from_raw(32, 24, picture().data).unwrap().into();
        let floats = image::Rgb32FImage::from_raw(32, 24, light.data.clone()).unwrap().into();
        for (name, bytes, made) in [
            ("8.png", photo::encode_png(&picture()), "png"),
            ("8.tiff", encode(eight(), image::ImageFormat::Tiff), "png"),
            ("8.webp", encode(eight(), image::ImageFormat::WebP), "png"),
            ("16.png", photo::encode_png_16(&deep), "png"),
            ("a.exr", photo::encode_exr(&light), "exr"),
            ("a.hdr", encode(floats, image::ImageFormat::Hdr), "exr"),
        ] {
            let source = dir.path().join(name);
            std::fs::write(&source, bytes).unwrap();
            let target = import(&source, &out, "a", 100).unwrap();
            assert_eq!(target.extension().unwrap(), made, "{name}");
            assert!(photo::load_full(&target).unwrap() == photo::load_full(&source).unwrap(), "{name}");
            // The reduced copy is encoded again, but not as JPEG.
            assert_eq!(import(&source, &out, "b", 16).unwrap().extension().unwrap(), made, "{name}");
            assert_eq!(write_like(&source, &picture(), &out, "c").unwrap().extension().unwrap(), "png", "{name}");
        }
        let jpeg = write(&picture(), dir.path(), "a").unwrap();
        assert_eq!(import(&jpeg, &out, "d", 16).unwrap().extension().unwrap(), "jpg");
        assert_eq!(write_like(&jpeg, &picture(), &out, "e").unwrap().extension().unwrap(), "jpg");
    }

    #[test]
    fn truncated_jpegs_are_not_copied() {
        let dir = tempfile::tempdir().unwrap();
        let out = dir.path().join("out");
        std::fs::create_dir(&out).unwrap();
        let source = with_metadata(dir.path());
        let bytes = std::fs::read(&source).unwrap();
        let whole = without_metadata(&bytes).unwrap();
        let end = bytes.len() - b"GPS again".len();
        assert_eq!(&bytes[end - 2..end], [0xff, 0xd9]);
        for n in 0..end {
            // Without the end marker the file is refused, and nothing is written.
            assert_eq!(without_metadata(&bytes[..n]), None, "{n}");
        }
        for n in [10, 200, end / 2, end - 40] {
            std::fs::write(&source, &bytes[..n]).unwrap();
            assert!(import(&source, &out, "a", 100).unwrap_err().is_input(), "{n}");
            assert!(out.read_dir().unwrap().next().is_none());
        }
        for n in [end, end + 3] {
            assert_eq!(without_metadata(&bytes[..n]).as_ref(), Some(&whole));
        }
    }

    #[test]
    fn a_stuffed_byte_after_a_fill_byte_is_no_segment() {
        let head = [0xff, 0xd8, 0xff, 0xda, 0, 2, 7];
        let fill = [&head[..], &[0xff, 0xff, 0, 8, 0xff, 0xd9]].concat();
        let clean = without_metadata(&fill).unwrap();
        assert_eq!(without_metadata(&clean).as_ref(), Some(&clean));
        assert_eq!(without_metadata(&[&head[..2], &[0xff, 0, 0, 2, 0xff, 0xd9]].concat()), None);
        assert_eq!(without_metadata(&[0xdc, 0xff, 0xff, 0xd9]), None);
    }

    #[test]
    fn numbers_in_names_count() {
        let mut names = ["IMG_10.jpg", "IMG_9.jpg", "a2.jpg", "IMG_009b.jpg"];
        names.sort_by_cached_key(|n| natural(n));
        assert_eq!(names, ["IMG_9.jpg", "IMG_009b.jpg", "IMG_10.jpg", "a2.jpg"]);
    }
}
