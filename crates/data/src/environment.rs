//! Environment maps in files: Radiance `.hdr` (RGBE), `.exr`, and photographs of 8 or 16 bits as probes.
//!
//! The image is equirectangular, the zenith at its top and +y in its center (z up). Worlds whose y points up have −z in the center of the
//! same image, `u = ½ + atan2(x, −z) / 2π`, `v = acos(y) / π`, since (x, y, z) there is (x, −z, y) here.

use crate::error::{DataError, Result};
use crate::photo::{self, Origin};
use crate::{atomic, error};
use diorama_geom::Image;
use diorama_geom::color::linear_from_srgb;
use diorama_geom::environment::{Blackened, Environment};
use image::DynamicImage;
use std::path::Path;

/// Largest file that is read, in bytes.
const LIMIT: u64 = 4 << 30;

/// An environment, and what was changed when it was read, in plain words.
#[derive(Clone, Debug, PartialEq)]
pub struct LoadedEnvironment {
    pub environment: Environment,
    pub notes: Vec<String>,
}

/// Encoded values above this are taken as clipped in photographs.
const CLIPPED: f32 = 0.999;
/// Estimate of how much brighter than white clipped values are, as Gaussian-splat relighting benchmarks assume (Kaleta et al. 2025).
const CLIPPED_GAIN: f32 = 10.0;

/// Reads an environment map. Photographs (PNG, JPEG, WebP, TIFF) are decoded from sRGB, and their clipped values made ten times as bright.
///
/// # Errors
/// If the file cannot be decoded, ends early, or is not twice as wide as high.
pub fn read(path: &Path) -> Result<LoadedEnvironment> {
    let bytes = error::read(path, LIMIT)?;
    let cure = format!("{} bytes are there; copy it again", bytes.len());
    let decoded = photo::decode(Origin { path, cure: &cure }, &bytes)?;
    drop(bytes);
    let is_linear = matches!(decoded, DynamicImage::ImageRgb32F(_) | DynamicImage::ImageRgba32F(_));
    let (width, height) = (decoded.width() as usize, decoded.height() as usize);
    let mut image = Image { width, height, channels: 3, data: decoded.into_rgb32f().into_raw() };
    let mut notes = Vec::new();
    if !is_linear {
        let clipped = brighten_clipped(&mut image);
        notes.push(format!(
            "{}: a photograph shows no more than white: {clipped} of its values are above {CLIPPED} and were made {CLIPPED_GAIN} times as bright",
            path.display()
        ));
    }
    let (environment, Blackened { count, first: (x, y) }) = Environment::new(image)
        .map_err(|e| DataError::input(path, format!("{e}; give an equirectangular panorama of the whole sphere")))?;
    if count > 0 {
        notes.push(format!(
            "{}: {count} pixels are negative or not finite, the first at column {x}, row {y}: they were made black",
            path.display()
        ));
    }
    Ok(LoadedEnvironment { environment, notes })
}

/// Makes values linear; returns how many of them were clipped.
fn brighten_clipped(image: &mut Image) -> usize {
    let mut count = 0;
    for v in &mut image.data {
        let is_clipped = *v > CLIPPED;
        *v = linear_from_srgb(*v) * if is_clipped { CLIPPED_GAIN } else { 1.0 };
        count += is_clipped as usize;
    }
    count
}

/// Writes `.hdr` atomically, with the environment's turn and strength applied.
pub fn save_hdr(path: &Path, environment: &Environment) -> Result<()> {
    atomic::write(path, &encode_hdr(&applied(environment)))
}

/// Writes `.exr` atomically, with the environment's turn and strength applied.
pub fn save_exr(path: &Path, environment: &Environment) -> Result<()> {
    photo::save_exr(path, &applied(environment))
}

/// The image that gives the same light without turn and with a strength of 1.
fn applied(environment: &Environment) -> Image {
    let mut image = environment.image().clone();
    if environment.turn != 0.0 {
        return Environment::from_fn(image.height, |d| environment.radiance(d)).image().clone();
    }
    image.data.iter_mut().for_each(|v| *v *= environment.strength as f32);
    image
}

/// Encodes linear RGB as Radiance's RGBE (Ward 1991), without compression.
fn encode_hdr(image: &Image) -> Vec<u8> {
    let mut out = format!("#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {} +X {}\n", image.height, image.width).into_bytes();
    out.extend(image.data.chunks_exact(3).flat_map(|p| rgbe([p[0], p[1], p[2]])));
    out
}

/// Three mantissas and their common exponent: `v = m · 2^(e − 136)`.
fn rgbe(rgb: [f32; 3]) -> [u8; 4] {
    let rgb = rgb.map(|v| v.max(0.0) as f64);
    let largest = rgb.into_iter().fold(0.0, f64::max);
    if largest < 2f64.powi(-127) {
        return [0; 4];
    }
    let exponent = |v: f64| v.log2().floor() as i32 + 1;
    let mantissas = |e: i32| rgb.map(|v| (v * 2f64.powi(8 - e)).round());
    let mut e = exponent(largest);
    if mantissas(e).contains(&256.0) {
        e += 1;
    }
    let [r, g, b] = mantissas(e).map(|v| v as u8);
    [r, g, b, (e + 128).clamp(0, 255) as u8]
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_geom::ImageU8;
    use diorama_geom::glam::DVec3;
    use std::f64::consts::PI;

    fn sky() -> Environment {
        Environment::from_fn(16, |d| [1.0 + d.x, 40.0 * (1.0 + d.y) + 1e-3, 3e4 * (1.0 + d.z).powi(8) + 1e-4])
    }

    #[test]
    fn hdr_keeps_the_largest_channel_to_a_256th_and_exr_all() {
        let dir = tempfile::tempdir().unwrap();
        let (hdr, exr) = (dir.path().join("a.hdr"), dir.path().join("a.exr"));
        let sky = sky();
        save_hdr(&hdr, &sky).unwrap();
        save_exr(&exr, &sky).unwrap();
        assert_eq!(read(&exr).unwrap(), LoadedEnvironment { environment: sky.clone(), notes: vec![] });
        let read = read(&hdr).unwrap();
        assert!(read.notes.is_empty());
        for (a, b) in read.environment.image().data.chunks(3).zip(sky.image().data.chunks(3)) {
            let step = b.iter().fold(0.0f32, |m, v| m.max(*v)) / 256.0;
            assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() <= step * 1.0001), "{a:?} and {b:?}");
        }
    }

    #[test]
    fn what_rgbe_can_say_it_says_exactly() {
        for (rgb, bytes) in [
            ([1.0, 0.5, 0.0], [128, 64, 0, 129]),
            ([0.0; 3], [0; 4]),
            ([0.999_999, 0.25, 0.125], [128, 32, 16, 129]),
            ([65536.0, 0.0, 512.0], [128, 0, 1, 145]),
        ] {
            assert_eq!(rgbe(rgb), bytes, "{rgb:?}");
        }
    }

    #[test]
    fn turn_and_strength_are_written_into_the_image() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.exr");
        let mut sky = Environment::from_fn(64, |d| [2.0 + d.x, 2.0 + d.y, 2.0 + d.z]);
        (sky.turn, sky.strength) = (PI / 2.0, 3.0);
        save_exr(&path, &sky).unwrap();
        let again = read(&path).unwrap().environment;
        for d in [DVec3::X, DVec3::NEG_Y, DVec3::new(0.6, 0.0, 0.8)] {
            let (a, b) = (again.radiance(d), sky.radiance(d));
            assert!((0..3).all(|k| (a[k] - b[k]).abs() < 2e-2), "{d}: {a:?} and {b:?}");
        }
    }

    #[test]
    fn y_up_worlds_see_the_same_picture() {
        let map = Environment::uniform([1.0; 3], 4);
        for (x, y, z) in [(0.0, 0.0, -1.0), (0.6, 0.0, -0.8), (0.48, 0.6, 0.64), (-0.36, -0.48, 0.8)] {
            let (u, v) = (0.5 + f64::atan2(x, -z) / (2.0 * PI), f64::acos(y) / PI);
            let uv = map.uv(DVec3::new(x, -z, y));
            assert!((uv.x - u).abs() < 1e-12 && (uv.y - v).abs() < 1e-12, "{uv}, not ({u}, {v})");
        }
    }

    #[test]
    fn photographs_are_linear_and_ten_times_brighter_where_they_clip() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.png");
        let data = [[255, 128, 0], [10, 20, 254]].concat();
        photo::save_png(&path, &ImageU8 { width: 2, height: 1, channels: 3, data }).unwrap();
        let LoadedEnvironment { environment, notes } = read(&path).unwrap();
        // IEC 61966-2-1: 128 is 0.2158605, 254 is 0.9911021.
        let want = [10.0, 0.215_860_5, 0.0, 10.0 / 255.0 / 12.92, 0.006_995_41, 0.991_102_1];
        assert!(environment.image().data.iter().zip(want).all(|(a, b)| (a - b).abs() < 1e-5), "{:?}", environment.image().data);
        assert!(notes[0].contains("1 of its values"), "{notes:?}");
    }

    #[test]
    fn bad_maps_name_the_file_and_what_is_wrong() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("square.exr");
        photo::save_exr(&path, &Image::zeros(6, 4, 3)).unwrap();
        let e = read(&path).unwrap_err().to_string();
        assert!(e.contains("square.exr") && e.contains("6×4 (1.50 : 1)"), "{e}");

        let mut image = Image::zeros(4, 2, 3);
        image.data.fill(1.0);
        (image.data[15], image.data[20]) = (f32::NAN, -1.0);
        let path = dir.path().join("nan.exr");
        photo::save_exr(&path, &image).unwrap();
        let read_again = read(&path).unwrap();
        let want = "2 pixels are negative or not finite, the first at column 1, row 1: they were made black";
        assert!(read_again.notes[0].contains(want) && read_again.notes[0].contains("nan.exr"), "{:?}", read_again.notes);
        assert_eq!(read_again.environment.image().pixel(1, 1), [0.0; 3]);
    }

    #[test]
    fn cut_files_are_errors_that_say_how_much_is_there() {
        let dir = tempfile::tempdir().unwrap();
        let sky = sky();
        for name in ["a.hdr", "a.exr"] {
            let path = dir.path().join(name);
            if name == "a.hdr" { save_hdr(&path, &sky) } else { save_exr(&path, &sky) }.unwrap();
            let whole = std::fs::read(&path).unwrap();
            for keep in [20, whole.len() / 2, whole.len() - 1] {
                std::fs::write(&path, &whole[..keep]).unwrap();
                let e = read(&path).unwrap_err().to_string();
                assert!(e.contains(name) && e.contains(&format!("{keep} bytes are there")), "{e}");
            }
        }
    }
}
