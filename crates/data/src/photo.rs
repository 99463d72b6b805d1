//! Decodes photographs: JPEG with EXIF orientation, PNG (8 and 16 bits, alpha), WebP, TIFF, and linear EXR and HDR. Truncated files of
//! every format are refused.

use crate::error::{DataError, Result};
use crate::jpeg;
use diorama_geom::capture::ColorSpace;
use diorama_geom::color::{srgb_from_linear, u16_from_unit};
use diorama_geom::{Image, ImageU8};
use image::metadata::Orientation;
use image::{DynamicImage, ExtendedColorType, ImageDecoder, ImageEncoder, ImageReader, Limits};
use std::io::{BufRead, Cursor, Seek};
use std::path::Path;

/// Limits on the size that a photograph may claim to have.
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

/// Number format in which a photograph's values are stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Depth {
    Eight,
    Sixteen,
    /// Floating point, linear light.
    Linear,
}

/// What a photograph's header says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Header {
    /// Width and height as displayed, after EXIF orientation.
    pub size: (u32, u32),
    /// Whether metadata ask to rotate or mirror the picture.
    pub is_turned: bool,
    pub depth: Depth,
}

impl Header {
    /// Whether the values are sRGB or linear light.
    pub fn color_space(&self) -> ColorSpace {
        if self.depth == Depth::Linear { ColorSpace::Linear } else { ColorSpace::Srgb }
    }
}

/// A decoded photograph with 1, 3 or 4 channels, alpha not premultiplied.
#[derive(Clone, Debug, PartialEq)]
pub enum Photo {
    /// sRGB in 8 bits.
    Eight(ImageU8),
    /// sRGB of 16 bits, as values in [0, 1].
    Sixteen(Image),
    /// Linear light; white is 1, and brighter values are larger.
    Linear(Image),
}

impl Photo {
    /// Width and height.
    pub fn size(&self) -> (usize, usize) {
        match self {
            Photo::Eight(im) => (im.width, im.height),
            Photo::Sixteen(im) | Photo::Linear(im) => (im.width, im.height),
        }
    }

    /// 1, 3 or 4.
    pub fn channels(&self) -> usize {
        match self {
            Photo::Eight(im) => im.channels,
            Photo::Sixteen(im) | Photo::Linear(im) => im.channels,
        }
    }

    /// Area average over the exact pixel footprint, in the photograph's own color space.
    pub fn downsampled(&self, width: usize, height: usize) -> Photo {
        match self {
            Photo::Eight(im) => Photo::Eight(im.downsampled(width, height)),
            Photo::Sixteen(im) => Photo::Sixteen(im.downsampled(width, height)),
            Photo::Linear(im) => Photo::Linear(im.downsampled(width, height)),
        }
    }

    /// sRGB in 8 bits; values brighter than white become white.
    pub fn into_8_bits(self) -> ImageU8 {
        match self {
            Photo::Eight(im) => im,
            Photo::Sixteen(im) => im.to_u8(),
            Photo::Linear(im) => encoded(&im).to_u8(),
        }
    }

    /// sRGB as floats; values brighter than white continue along the curve.
    pub fn into_srgb(self) -> Image {
        match self {
            Photo::Eight(im) => im.to_f32(),
            Photo::Sixteen(im) => im,
            Photo::Linear(im) => encoded(&im),
        }
    }
}

/// Maps linear colors to sRGB; alpha is unchanged.
fn encoded(im: &Image) -> Image {
    let mut out = im.clone();
    for p in out.data.chunks_exact_mut(im.channels) {
        p.iter_mut().take(3).for_each(|v| *v = srgb_from_linear(*v));
    }
    out
}

/// Whether two sizes have the same aspect ratio, except for the rounding of sides.
pub fn is_same_aspect(a: (u32, u32), b: (u32, u32)) -> bool {
    let ([aw, ah], [bw, bh]) = ([a.0, a.1].map(f64::from), [b.0, b.1].map(f64::from));
    // The larger size, scaled to the smaller one, differs by less than a pixel.
    let ((w, h), (large_w, large_h)) = if aw * ah <= bw * bh { ((aw, ah), (bw, bh)) } else { ((bw, bh), (aw, ah)) };
    (large_h * w / large_w - h).abs() <= 1.0 || (large_w * h / large_h - w).abs() <= 1.0
}

/// Remedy for damaged files.
const CURE: &str = "copy it again, or leave such photographs out with --skip-broken";

/// A file that is decoded, and the remedy that messages name.
#[derive(Clone, Copy)]
pub(crate) struct Origin<'a> {
    pub path: &'a Path,
    pub cure: &'a str,
}

impl Origin<'_> {
    fn undecodable(self, e: impl std::fmt::Display) -> DataError {
        DataError::input(self.path, format!("cannot be decoded as an image: {e}; {}", self.cure))
    }

    fn ends_early(self) -> DataError {
        DataError::input(self.path, format!("the image file ends early, as if it was truncated; {}", self.cure))
    }
}

/// Describes the error of a decoder.
fn failed(origin: Origin, limits: &PhotoLimits, e: image::ImageError) -> DataError {
    let mut cause: Option<&dyn std::error::Error> = Some(&e);
    while let Some(c) = cause {
        if c.downcast_ref::<std::io::Error>().is_some_and(|e| e.kind() == std::io::ErrorKind::UnexpectedEof) {
            return origin.ends_early();
        }
        cause = c.source();
    }
    // Some decoders return the error only as text.
    let text = e.to_string();
    if ["unexpected end of file", "failed to fill whole buffer", "unexpected EOF"].iter().any(|t| text.contains(t)) {
        return origin.ends_early();
    }
    match e {
        image::ImageError::Limits(_) => too_large(origin.path, limits),
        e => origin.undecodable(e),
    }
}

/// Reader of an image file or of bytes in memory. It is one type, so that decoders are compiled only once.
trait Source: BufRead + Seek {}
impl<T: BufRead + Seek> Source for T {}

fn decoder<'a>(origin: Origin, limits: &PhotoLimits, file: Box<dyn Source + 'a>) -> Result<impl ImageDecoder + use<'a>> {
    let mut reader = ImageReader::new(file).with_guessed_format().map_err(DataError::io(origin.path, "read"))?;
    let mut l = Limits::default();
    l.max_image_width = Some(limits.max_side);
    l.max_image_height = Some(limits.max_side);
    l.max_alloc = Some(limits.max_bytes);
    reader.limits(l);
    let decoder = reader.into_decoder().map_err(|e| failed(origin, limits, e))?;
    let (w, h) = decoder.dimensions();
    if w > limits.max_side || h > limits.max_side || decoder.total_bytes() > limits.max_bytes {
        return Err(too_large(origin.path, limits));
    }
    Ok(decoder)
}

fn too_large(path: &Path, limits: &PhotoLimits) -> DataError {
    DataError::input(
        path,
        format!("larger than the limit of {} pixels a side and {} MiB decoded; reduce it", limits.max_side, limits.max_bytes >> 20),
    )
}

fn turns_sides(o: Orientation) -> bool {
    matches!(o, Orientation::Rotate90 | Orientation::Rotate270 | Orientation::Rotate90FlipH | Orientation::Rotate270FlipH)
}

/// Reads a photograph's header, not its pixels.
pub fn header(path: &Path) -> Result<Header> {
    let limits = PhotoLimits::default();
    let file = std::fs::File::open(path).map_err(DataError::io(path, "read"))?;
    if file.metadata().map_err(DataError::io(path, "read"))?.len() == 0 {
        return Err(DataError::input(path, format!("the image file is empty (0 bytes); {CURE}")));
    }
    let mut file = std::io::BufReader::new(file);
    let (w, h, orientation, depth) = match jpeg::header(&mut file).map_err(DataError::io(path, "read"))? {
        Some(j) => (j.width, j.height, Orientation::from_exif(j.orientation).unwrap_or(Orientation::NoTransforms), Depth::Eight),
        None => {
            file.rewind().map_err(DataError::io(path, "read"))?;
            let mut d = decoder(Origin { path, cure: CURE }, &limits, Box::new(file))?;
            let (w, h) = d.dimensions();
            (w, h, d.orientation().unwrap_or(Orientation::NoTransforms), depth_of(d.color_type()))
        }
    };
    if w > limits.max_side || h > limits.max_side {
        return Err(too_large(path, &limits));
    }
    if w == 0 || h == 0 {
        return Err(Origin { path, cure: CURE }.undecodable(format!("it has {w}×{h} pixels")));
    }
    let size = if turns_sides(orientation) { (h, w) } else { (w, h) };
    Ok(Header { size, is_turned: orientation != Orientation::NoTransforms, depth })
}

fn depth_of(color: image::ColorType) -> Depth {
    use image::ColorType::*;
    match color {
        Rgb32F | Rgba32F => Depth::Linear,
        L16 | La16 | Rgb16 | Rgba16 => Depth::Sixteen,
        _ => Depth::Eight,
    }
}

/// Whether metadata ask to rotate or mirror the picture.
pub fn is_turned(path: &Path) -> Result<bool> {
    Ok(header(path)?.is_turned)
}

/// Width and height as displayed, after EXIF orientation.
pub fn size(path: &Path) -> Result<(u32, u32)> {
    Ok(header(path)?.size)
}

/// Decodes a picture as stored: not rotated, with its own channels.
pub(crate) fn as_stored(bytes: &[u8]) -> image::ImageResult<DynamicImage> {
    let source: Box<dyn Source + '_> = Box::new(Cursor::new(bytes));
    ImageReader::new(source).with_guessed_format()?.decode()
}

/// Decodes a photograph at its full range of values.
///
/// # Errors
/// If the file is not an image, ends early, or contains a value that is not a number.
pub fn load_full(path: &Path) -> Result<Photo> {
    let bytes = std::fs::read(path).map_err(DataError::io(path, "read"))?;
    let is_exr = bytes.starts_with(&[0x76, 0x2f, 0x31, 0x01]);
    let im = decode(Origin { path, cure: CURE }, &bytes)?;
    let (width, height) = (im.width() as usize, im.height() as usize);
    let channels = if im.color().has_alpha() { 4 } else { 3 };
    let floats = |im: DynamicImage| {
        let data = if channels == 4 { im.into_rgba32f().into_raw() } else { im.into_rgb32f().into_raw() };
        Image { width, height, channels, data }
    };
    Ok(match depth_of(im.color()) {
        Depth::Eight => {
            let data = if channels == 4 { im.into_rgba8().into_raw() } else { im.into_rgb8().into_raw() };
            Photo::Eight(ImageU8 { width, height, channels, data })
        }
        Depth::Sixteen => Photo::Sixteen(floats(im)),
        Depth::Linear => {
            let mut im = floats(im);
            check_range(path, &im)?;
            if is_exr && channels == 4 {
                unpremultiply(&mut im);
            }
            Photo::Linear(im)
        }
    })
}

/// The largest value of 16-bit floats.
const LARGEST: f32 = 65504.0;

/// Decodes the bytes of a picture, turned as its metadata ask, with its own channels and numbers.
pub(crate) fn decode(origin: Origin, bytes: &[u8]) -> Result<DynamicImage> {
    let limits = PhotoLimits::default();
    if bytes.is_empty() {
        return Err(DataError::input(origin.path, format!("the image file is empty (0 bytes); {}", origin.cure)));
    }
    // The decoder fills missing JPEG data with gray.
    let bytes = if bytes.starts_with(&[0xff, 0xd8]) { jpeg::whole(bytes).ok_or_else(|| origin.ends_early())? } else { bytes.into() };
    let mut decoder = decoder(origin, &limits, Box::new(Cursor::new(&*bytes)))?;
    let orientation = decoder.orientation().unwrap_or(Orientation::NoTransforms);
    let mut im = DynamicImage::from_decoder(decoder).map_err(|e| failed(origin, &limits, e))?;
    im.apply_orientation(orientation);
    Ok(im)
}

fn check_range(path: &Path, im: &Image) -> Result<()> {
    let Some(at) = im.data.iter().position(|v| v.is_nan() || v.abs() > LARGEST) else { return Ok(()) };
    let (pixel, value) = (at / im.channels, im.data[at]);
    let channel = ["red", "green", "blue", "alpha"][at % im.channels];
    let (x, y) = (pixel % im.width, pixel / im.width);
    Err(DataError::input(
        path,
        if value.is_nan() {
            format!("pixel ({x}, {y}) is not a number (NaN, {channel}); repair it, or {}", "leave such photographs out with --skip-broken")
        } else {
            format!("pixel ({x}, {y}) is {value} ({channel}), beyond ±{LARGEST}; scale or clamp the photograph's values")
        },
    ))
}

/// EXR stores colors premultiplied by alpha.
fn unpremultiply(im: &mut Image) {
    for p in im.data.chunks_exact_mut(4).filter(|p| p[3] > 0.0) {
        let alpha = p[3];
        p.iter_mut().take(3).for_each(|v| *v = (*v / alpha).clamp(-LARGEST, LARGEST));
    }
}

/// Decodes a photograph to 1, 3 or 4 channels of 8 bits, sRGB.
pub fn load(path: &Path) -> Result<ImageU8> {
    load_full(path).map(Photo::into_8_bits)
}

/// Decodes a photograph to RGB with at most `side` pixels along its longer side; transparent pixels become white.
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

/// Prefix of instant-ngp's mask files; their non-black pixels are to be ignored.
pub const DYNAMIC_MASK: &str = "dynamic_mask_";

/// Decodes a mask to one channel; pixels with 0 are to be ignored.
pub fn load_mask(path: &Path) -> Result<ImageU8> {
    let im = load(path)?;
    let marks_ignored = path.file_name().is_some_and(|n| n.to_string_lossy().starts_with(DYNAMIC_MASK));
    let counts = |p: &[u8]| if marks_ignored { 255 * p[..3.min(p.len())].iter().all(|v| *v == 0) as u8 } else { p[0] };
    let data = im.data.chunks_exact(im.channels).map(counts).collect();
    Ok(ImageU8 { width: im.width, height: im.height, channels: 1, data })
}

/// Encodes a PNG in memory.
pub fn encode_png(im: &ImageU8) -> Vec<u8> {
    let kind = match im.channels {
        1 => ExtendedColorType::L8,
        3 => ExtendedColorType::Rgb8,
        _ => ExtendedColorType::Rgba8,
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

/// Writes linear light as EXR, atomically.
pub fn save_exr(path: &Path, im: &Image) -> Result<()> {
    crate::atomic::write(path, &encode_exr(im))
}

/// Encodes EXR in memory, with colors premultiplied by alpha.
pub(crate) fn encode_exr(im: &Image) -> Vec<u8> {
    let bytes = |v: f32| v.to_ne_bytes();
    let (bytes, color): (Vec<u8>, _) = if im.channels == 4 {
        let pixels = im.data.chunks_exact(4);
        (pixels.flat_map(|p| [p[0] * p[3], p[1] * p[3], p[2] * p[3], p[3]]).flat_map(bytes).collect(), ExtendedColorType::Rgba32F)
    } else {
        (im.data.iter().copied().flat_map(bytes).collect(), ExtendedColorType::Rgb32F)
    };
    let mut out = Cursor::new(Vec::new());
    let encoder = image::codecs::openexr::OpenExrEncoder::new(&mut out);
    encoder.write_image(&bytes, im.width as u32, im.height as u32, color).expect("a Vec takes any bytes");
    out.into_inner()
}

/// Encodes values in [0, 1] as a 16-bit PNG in memory.
pub(crate) fn encode_png_16(im: &Image) -> Vec<u8> {
    let bytes: Vec<u8> = im.data.iter().flat_map(|v| u16_from_unit(*v).to_ne_bytes()).collect();
    let color = if im.channels == 4 { ExtendedColorType::Rgba16 } else { ExtendedColorType::Rgb16 };
    let mut out = Vec::new();
    let encoder = image::codecs::png::PngEncoder::new(&mut out);
    encoder.write_image(&bytes, im.width as u32, im.height as u32, color).expect("a Vec takes any bytes");
    out
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
        let e = load(&p).unwrap_err().to_string();
        assert!(e.contains("ends early") && e.contains("--skip-broken"), "{e}");
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
