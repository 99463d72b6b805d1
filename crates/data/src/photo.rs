//! Decoding photographs to 8-bit sRGB: JPEG with EXIF orientation, PNG (8, 16 bit, alpha), WebP, TIFF,
//! EXR and HDR (linear, encoded to sRGB and clamped).

use crate::error::{DataError, Result};
use diorama_geom::ImageU8;
use diorama_geom::color::{srgb_from_linear, u8_from_unit};
use image::{DynamicImage, ImageDecoder, ImageReader, Limits};
use std::path::Path;

/// Limits on what a photograph may claim to be.
#[derive(Clone, Copy, Debug)]
pub struct PhotoLimits {
    pub max_side: u32,
    pub max_bytes: u64,
}

impl Default for PhotoLimits {
    fn default() -> Self {
        PhotoLimits { max_side: 32_768, max_bytes: 2 << 30 }
    }
}

fn undecodable(path: &Path, e: impl std::fmt::Display) -> DataError {
    DataError::input(path, format!("cannot be decoded as an image: {e}"))
}

fn open(path: &Path, limits: &PhotoLimits) -> Result<impl ImageDecoder> {
    let size = std::fs::metadata(path).map_err(DataError::io(path, "read"))?.len();
    if size == 0 {
        return Err(DataError::input(path, "the image file is empty (0 bytes); copy it again"));
    }
    let reader = ImageReader::open(path).map_err(DataError::io(path, "read"))?;
    let mut reader = reader.with_guessed_format().map_err(DataError::io(path, "read"))?;
    let mut l = Limits::default();
    l.max_image_width = Some(limits.max_side);
    l.max_image_height = Some(limits.max_side);
    l.max_alloc = Some(limits.max_bytes);
    reader.limits(l);
    reader.into_decoder().map_err(|e| match e {
        image::ImageError::Limits(_) => too_large(path, limits),
        e => undecodable(path, e),
    })
}

fn too_large(path: &Path, limits: &PhotoLimits) -> DataError {
    DataError::input(
        path,
        format!("larger than the limit of {} pixels a side and {} MiB decoded; reduce it", limits.max_side, limits.max_bytes >> 20),
    )
}

/// Whether metadata say that the picture is to be turned or mirrored.
pub fn is_turned(path: &Path) -> Result<bool> {
    let limits = PhotoLimits::default();
    let mut d = open(path, &limits)?;
    Ok(d.orientation().is_ok_and(|o| o != image::metadata::Orientation::NoTransforms))
}

/// Width and height as shown, that is after EXIF orientation.
pub fn size(path: &Path) -> Result<(u32, u32)> {
    let limits = PhotoLimits::default();
    let mut d = open(path, &limits)?;
    let (w, h) = d.dimensions();
    if w > limits.max_side || h > limits.max_side {
        return Err(too_large(path, &limits));
    }
    let turned = d.orientation().is_ok_and(|o| {
        use image::metadata::Orientation::*;
        matches!(o, Rotate90 | Rotate270 | Rotate90FlipH | Rotate270FlipH)
    });
    Ok(if turned { (h, w) } else { (w, h) })
}

/// Decodes a photograph to 1, 3 or 4 channels of 8 bits.
pub fn load(path: &Path) -> Result<ImageU8> {
    let limits = PhotoLimits::default();
    let mut decoder = open(path, &limits)?;
    let (w, h) = decoder.dimensions();
    if w > limits.max_side || h > limits.max_side || decoder.total_bytes() > limits.max_bytes {
        return Err(too_large(path, &limits));
    }
    let orientation = decoder.orientation().unwrap_or(image::metadata::Orientation::NoTransforms);
    let mut im = DynamicImage::from_decoder(decoder).map_err(|e| undecodable(path, e))?;
    im.apply_orientation(orientation);
    let (width, height) = (im.width() as usize, im.height() as usize);
    let linear = matches!(im, DynamicImage::ImageRgb32F(_) | DynamicImage::ImageRgba32F(_));
    let alpha = im.color().has_alpha();
    let (channels, data) = if linear {
        let encode = |v: f32| u8_from_unit(srgb_from_linear(v.clamp(0.0, 1.0)));
        if alpha {
            let encoded = im.to_rgba32f().pixels().flat_map(|p| [encode(p[0]), encode(p[1]), encode(p[2]), u8_from_unit(p[3])]).collect();
            (4, encoded)
        } else {
            (3, im.to_rgb32f().into_raw().into_iter().map(encode).collect())
        }
    } else if alpha {
        (4, im.to_rgba8().into_raw())
    } else {
        (3, im.to_rgb8().into_raw())
    };
    Ok(ImageU8 { width, height, channels, data })
}

/// Decodes a photograph to RGB, its longer side at most `side`; what is clear is white.
pub fn load_small(path: &Path, side: usize) -> Result<ImageU8> {
    let full = load(path)?;
    let by = (side as f64 / full.width.max(full.height) as f64).min(1.0);
    let to = |v: usize| ((v as f64 * by) as usize).max(1);
    let small = full.downsampled(to(full.width), to(full.height));
    let rgb = |p: &[u8]| match *p {
        [r, g, b, a] => [r, g, b].map(|v| ((v as u32 * a as u32 + 255 * (255 - a as u32)) / 255) as u8),
        [r, g, b] => [r, g, b],
        [v, ..] => [v; 3],
        [] => [255; 3],
    };
    Ok(ImageU8 { channels: 3, data: small.data.chunks_exact(small.channels).flat_map(rgb).collect(), ..small })
}

/// How names of instant-ngp's masks begin; in them, what is not black is to be ignored.
pub const DYNAMIC_MASK: &str = "dynamic_mask_";

/// Decodes a mask to one channel: 0 where the pixel is to be ignored.
pub fn load_mask(path: &Path) -> Result<ImageU8> {
    let im = load(path)?;
    let marks_ignored = path.file_name().is_some_and(|n| n.to_string_lossy().starts_with(DYNAMIC_MASK));
    let counts = |p: &[u8]| if marks_ignored { 255 * p[..3.min(p.len())].iter().all(|v| *v == 0) as u8 } else { p[0] };
    let data = im.data.chunks_exact(im.channels).map(counts).collect();
    Ok(ImageU8 { width: im.width, height: im.height, channels: 1, data })
}

/// Encodes a PNG in memory.
pub fn encode_png(im: &ImageU8) -> Vec<u8> {
    use image::ImageEncoder;
    let kind = match im.channels {
        1 => image::ExtendedColorType::L8,
        3 => image::ExtendedColorType::Rgb8,
        _ => image::ExtendedColorType::Rgba8,
    };
    let mut out = Vec::new();
    let encoder = image::codecs::png::PngEncoder::new_with_quality(
        &mut out,
        image::codecs::png::CompressionType::Fast,
        image::codecs::png::FilterType::Adaptive,
    );
    encoder.write_image(&im.data, im.width as u32, im.height as u32, kind).expect("a Vec takes any bytes");
    out
}

/// Writes a PNG atomically.
pub fn save_png(path: &Path, im: &ImageU8) -> Result<()> {
    crate::atomic::write(path, &encode_png(im))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample(channels: usize) -> ImageU8 {
        ImageU8 { width: 5, height: 3, channels, data: (0..15 * channels).map(|i| (i * 7 % 256) as u8).collect() }
    }

    #[test]
    fn png_round_trips_with_and_without_alpha() {
        let dir = tempfile::tempdir().unwrap();
        for c in [3, 4] {
            let p = dir.path().join("a b ü.png");
            save_png(&p, &sample(c)).unwrap();
            assert_eq!(load(&p).unwrap(), sample(c));
            assert_eq!(size(&p).unwrap(), (5, 3));
        }
    }

    #[test]
    fn sixteen_bits_webp_tiff_exr_and_hdr_decode() {
        let dir = tempfile::tempdir().unwrap();
        let deep = image::ImageBuffer::<image::Rgb<u16>, _>::from_fn(4, 2, |x, _| image::Rgb([(x * 257 * 60) as u16, 65535, 0]));
        for name in ["a.png", "a.tiff"] {
            let p = dir.path().join(name);
            DynamicImage::ImageRgb16(deep.clone()).save(&p).unwrap();
            assert_eq!(load(&p).unwrap().pixel(2, 0), [120, 255, 0], "{name}");
        }
        let p = dir.path().join("a.webp");
        DynamicImage::ImageRgb8(deep_to_8()).save(&p).unwrap();
        assert_eq!(load(&p).unwrap().pixel(1, 1), [9, 8, 7]);
        let linear = image::ImageBuffer::<image::Rgb<f32>, _>::from_fn(4, 2, |_, _| image::Rgb([0.214_041, 1.0, 1.0]));
        for name in ["a.exr", "a.hdr"] {
            let p = dir.path().join(name);
            DynamicImage::ImageRgb32F(linear.clone()).save(&p).unwrap();
            let px = load(&p).unwrap().pixel(0, 0).to_vec();
            assert!(px[0].abs_diff(128) <= 1 && px[1..] == [255, 255], "{name} {px:?}");
        }
    }

    fn deep_to_8() -> image::RgbImage {
        image::ImageBuffer::from_fn(4, 2, |_, _| image::Rgb([9, 8, 7]))
    }

    #[test]
    fn exif_orientation_is_applied() {
        // A JPEG of 8×4 whose left half is white, tagged "rotate 90° clockwise to show".
        let im = image::ImageBuffer::<image::Luma<u8>, _>::from_fn(8, 4, |x, _| image::Luma([if x < 4 { 255 } else { 0 }]));
        let mut jpeg = Vec::new();
        image::codecs::jpeg::JpegEncoder::new_with_quality(&mut jpeg, 95).encode_image(&DynamicImage::ImageLuma8(im)).unwrap();
        let tiff = b"MM\0\x2a\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0";
        let mut tagged = jpeg[..2].to_vec();
        tagged.extend([0xff, 0xe1]);
        tagged.extend(((tiff.len() + 8) as u16).to_be_bytes());
        tagged.extend(b"Exif\0\0");
        tagged.extend(tiff);
        tagged.extend(&jpeg[2..]);
        let dir = tempfile::tempdir().unwrap();
        let p = dir.path().join("a.jpg");
        std::fs::write(&p, tagged).unwrap();
        let im = load(&p).unwrap();
        assert_eq!((im.width, im.height), (4, 8));
        assert_eq!(size(&p).unwrap(), (4, 8));
        assert!(im.pixel(1, 0)[0] > 200 && im.pixel(1, 7)[0] < 50, "left must have become top");
    }

    #[test]
    fn empty_truncated_and_foreign_files_are_named() {
        let dir = tempfile::tempdir().unwrap();
        let p = dir.path().join("a.png");
        std::fs::write(&p, b"").unwrap();
        assert!(load(&p).unwrap_err().to_string().contains("empty"));
        std::fs::write(&p, &encode_png(&sample(3))[..40]).unwrap();
        assert!(load(&p).unwrap_err().to_string().contains("cannot be decoded"));
        std::fs::write(&p, b"not an image at all").unwrap();
        assert!(load(&p).unwrap_err().is_input());
    }

    #[test]
    fn a_png_that_claims_to_be_huge_is_refused_before_allocating() {
        let mut png = encode_png(&sample(3));
        png[16..20].copy_from_slice(&100_000u32.to_be_bytes());
        png[20..24].copy_from_slice(&100_000u32.to_be_bytes());
        let crc = crc32(&png[12..29]);
        png[29..33].copy_from_slice(&crc.to_be_bytes());
        let dir = tempfile::tempdir().unwrap();
        let p = dir.path().join("bomb.png");
        std::fs::write(&p, png).unwrap();
        let e = load(&p).unwrap_err();
        assert!(e.is_input() && e.to_string().contains("limit"), "{e}");
    }

    fn crc32(data: &[u8]) -> u32 {
        !data.iter().fold(!0u32, |c, b| (0..8).fold(c ^ *b as u32, |c, _| if c & 1 == 1 { c >> 1 ^ 0xedb8_8320 } else { c >> 1 }))
    }
}
