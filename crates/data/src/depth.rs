//! Sequences of depth maps: 16-bit PNG with one step for the whole sequence, or EXR or NumPy's `.npy` with 32-bit floats. `depth.json`
//! beside them gives unit and step.

use crate::error::{DataError, Result};
use crate::{atomic, photo};
use diorama_geom::Image;
use image::{DynamicImage, ImageEncoder};
use serde::Serialize;
use std::io::{Cursor, Write};
use std::path::{Path, PathBuf};

/// File format of a depth map.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum DepthFormat {
    /// 16 bits; the distance is the pixel value times the sequence's step.
    #[default]
    Png,
    /// OpenEXR with one channel `Z`.
    Exr,
    /// NumPy, `[H, W]`.
    Npy,
}

impl std::str::FromStr for DepthFormat {
    type Err = String;

    fn from_str(s: &str) -> std::result::Result<Self, String> {
        match s {
            "png" => Ok(DepthFormat::Png),
            "exr" => Ok(DepthFormat::Exr),
            "npy" => Ok(DepthFormat::Npy),
            _ => Err(format!("depth {s:?}: expected png, exr or npy")),
        }
    }
}

/// Content of `depth.json`.
#[derive(Serialize)]
struct Meaning {
    files: &'static str,
    frames: usize,
    /// `m`, or `units of the capture` if no length was measured.
    unit: &'static str,
    /// Length of one step, in units.
    step: f64,
    /// Pixel value where the ray meets no surface.
    unknown: u8,
    distance: &'static str,
}

/// A sequence that is being written into a folder.
pub struct DepthSequence {
    folder: PathBuf,
    format: DepthFormat,
    unit: &'static str,
    step: f64,
    frames: usize,
}

/// Free range above the longest distance so far, as a factor, so that slightly longer ones fit.
const ROOM: f64 = 1.5;

impl DepthSequence {
    /// Starts a sequence. Distances are in meters if the scale of the capture is known, else in its own units.
    pub fn new(folder: &Path, format: DepthFormat, is_measured: bool) -> DepthSequence {
        let unit = if is_measured { "m" } else { "units of the capture" };
        DepthSequence { folder: folder.to_path_buf(), format, unit, step: 1.0, frames: 0 }
    }

    /// Adds the next frame: distances along the rays, 0 where a ray meets no surface, `[H, W, 1]`. If a distance exceeds 16 bits at the
    /// present step, the earlier frames are written again with a larger step.
    pub fn push(&mut self, depth: &Image) -> Result<()> {
        match self.format {
            DepthFormat::Png => {
                let longest = depth.data.iter().copied().filter(|d| d.is_finite()).fold(0.0, f32::max) as f64;
                let (before, fits) = (self.step, longest <= self.step * u16::MAX as f64);
                if self.frames == 0 || !fits {
                    self.step = round_step(ROOM * longest / u16::MAX as f64);
                    (0..self.frames).try_for_each(|i| self.rescale(i, before / self.step))?;
                }
                let numbers: Vec<u16> = depth.data.iter().map(|d| steps(*d as f64 / self.step)).collect();
                save_png(&self.file(self.frames), depth.width, depth.height, &numbers)?;
            }
            DepthFormat::Exr => save_exr(&self.file(self.frames), depth)?,
            DepthFormat::Npy => save_npy(&self.file(self.frames), depth)?,
        }
        self.frames += 1;
        let meaning = Meaning {
            files: match self.format {
                DepthFormat::Png => "depth16_NNNN.png",
                DepthFormat::Exr => "depth_NNNN.exr",
                DepthFormat::Npy => "depth_NNNN.npy",
            },
            frames: self.frames,
            unit: self.unit,
            step: self.step,
            unknown: 0,
            distance: "from the camera's center along each pixel's ray",
        };
        let json = serde_json::to_vec_pretty(&meaning).expect("plain values");
        atomic::write(&self.folder.join("depth.json"), &json)
    }

    fn file(&self, i: usize) -> PathBuf {
        self.folder.join(match self.format {
            DepthFormat::Png => format!("depth16_{i:04}.png"),
            DepthFormat::Exr => format!("depth_{i:04}.exr"),
            DepthFormat::Npy => format!("depth_{i:04}.npy"),
        })
    }

    /// Multiplies the values of a frame.
    fn rescale(&self, i: usize, by: f64) -> Result<()> {
        let file = self.file(i);
        let (width, height) = photo::size(&file)?;
        let numbers: Vec<u16> = read_png(&file)?.into_iter().map(|v| steps(v as f64 * by)).collect();
        save_png(&file, width as usize, height as usize, &numbers)
    }
}

/// Nearest number of steps; at least 1 for a nonzero distance.
fn steps(distance: f64) -> u16 {
    if distance > 0.0 { distance.round().clamp(1.0, u16::MAX as f64) as u16 } else { 0 }
}

/// Smallest of 1, 2, 5, 10, … times a power of ten that is not below a value.
fn round_step(least: f64) -> f64 {
    if least <= 0.0 || !least.is_finite() {
        return 1e-3;
    }
    let exponent = least.log10().floor() as i32;
    let power = |e: i32| if e < 0 { 1.0 / 10f64.powi(-e) } else { 10f64.powi(e) };
    [1.0, 2.0, 5.0].map(|m| m * power(exponent)).into_iter().find(|s| *s >= least).unwrap_or(power(exponent + 1))
}

/// Reads the values of a 16-bit PNG, row by row.
///
/// # Errors
/// If the file is not a 16-bit PNG with one channel.
pub fn read_png(path: &Path) -> Result<Vec<u16>> {
    let bytes = std::fs::read(path).map_err(DataError::io(path, "read"))?;
    match photo::as_stored(&bytes) {
        Ok(DynamicImage::ImageLuma16(im)) => Ok(im.into_raw()),
        Ok(_) => Err(DataError::input(path, "is not a 16-bit depth map: expected a PNG of 16-bit distances with one channel")),
        Err(e) => Err(DataError::input(path, format!("cannot be decoded: {e}"))),
    }
}

fn save_png(path: &Path, width: usize, height: usize, numbers: &[u16]) -> Result<()> {
    let bytes: Vec<u8> = numbers.iter().flat_map(|v| v.to_ne_bytes()).collect();
    let mut out = Vec::new();
    image::codecs::png::PngEncoder::new(&mut out)
        .write_image(&bytes, width as u32, height as u32, image::ExtendedColorType::L16)
        .expect("a Vec takes any bytes");
    atomic::write(path, &out)
}

fn save_exr(path: &Path, depth: &Image) -> Result<()> {
    use exr::prelude::{SpecificChannels, Vec2, WritableImage};
    let at = |p: Vec2<usize>| (depth.data[p.y() * depth.width + p.x()],);
    let channels = SpecificChannels::build().with_channel("Z").with_pixel_fn(at);
    let mut out = Cursor::new(Vec::new());
    exr::prelude::Image::from_channels((depth.width, depth.height), channels)
        .write()
        .to_buffered(&mut out)
        .map_err(|e| DataError::failed(path, format!("cannot be encoded as EXR: {e}")))?;
    atomic::write(path, out.get_ref())
}

fn save_npy(path: &Path, depth: &Image) -> Result<()> {
    atomic::write_with(path, |w| {
        let mut header = format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({}, {}), }}", depth.height, depth.width);
        // The data begin at a multiple of 64 bytes.
        let used = 10 + header.len() + 1;
        header.push_str(&" ".repeat(used.next_multiple_of(64) - used));
        header.push('\n');
        w.write_all(b"\x93NUMPY\x01\x00")?;
        w.write_all(&(header.len() as u16).to_le_bytes())?;
        w.write_all(header.as_bytes())?;
        depth.data.iter().try_for_each(|v| w.write_all(&v.to_le_bytes()))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn map(values: [f32; 4]) -> Image {
        Image { width: 2, height: 2, channels: 1, data: values.into() }
    }

    fn meaning(folder: &Path) -> serde_json::Value {
        serde_json::from_slice(&std::fs::read(folder.join("depth.json")).unwrap()).unwrap()
    }

    #[test]
    fn no_distance_is_cut_off_and_all_frames_have_one_step() {
        let dir = tempfile::tempdir().unwrap();
        let mut s = DepthSequence::new(dir.path(), DepthFormat::Png, true);
        // The third frame reaches a thousand times farther than the first.
        let frames = [[0.0, 1.0, 2.5, 3.0], [0.5, 4.0, 0.0, 3.9], [3000.0, 1.0, 80.0, 0.0]];
        for (i, f) in frames.iter().enumerate() {
            s.push(&map(*f)).unwrap();
            assert_eq!(meaning(dir.path())["frames"], i + 1);
        }
        let m = meaning(dir.path());
        let step = m["step"].as_f64().unwrap();
        assert_eq!((m["unit"].as_str(), step), (Some("m"), 0.1));
        for (i, f) in frames.iter().enumerate() {
            let read = read_png(&dir.path().join(format!("depth16_{i:04}.png"))).unwrap();
            for (n, d) in read.iter().zip(f) {
                assert!((*n as f64 * step - *d as f64).abs() <= 0.51 * step && (*n == 0) == (*d == 0.0), "{i}: {n} {d}");
            }
        }
    }

    #[test]
    fn what_holds_no_distances_is_named() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("depth16_0000.png");
        let mut s = DepthSequence::new(dir.path(), DepthFormat::Png, true);
        s.push(&map([0.0, 1.0, 2.0, 3.0])).unwrap();
        let whole = std::fs::read(&path).unwrap();
        let of_photograph = photo::encode_png(&diorama_geom::ImageU8 { width: 1, height: 1, channels: 3, data: vec![9; 3] });
        for (bytes, why) in [(&whole[..whole.len() / 2], "decoded"), (&[][..], "decoded"), (&of_photograph, "16-bit distances")] {
            std::fs::write(&path, bytes).unwrap();
            let e = read_png(&path).unwrap_err();
            assert!(e.is_input() && e.to_string().contains("depth16_0000.png") && e.to_string().contains(why), "{e}");
        }
    }

    #[test]
    fn small_scenes_have_small_steps() {
        let dir = tempfile::tempdir().unwrap();
        let mut s = DepthSequence::new(dir.path(), DepthFormat::Png, false);
        s.push(&map([0.0, 0.01, 0.02, 0.03])).unwrap();
        let m = meaning(dir.path());
        assert_eq!((m["unit"].as_str(), m["step"].as_f64()), (Some("units of the capture"), Some(1e-6)));
        for (least, step) in [(1.0, 1.0), (1.1, 2.0), (4.9e-5, 5e-5), (5.1e-5, 1e-4), (0.0, 1e-3)] {
            assert!((round_step(least) / step - 1.0).abs() < 1e-12, "{least}");
        }
    }

    #[test]
    fn floats_keep_every_bit() {
        let dir = tempfile::tempdir().unwrap();
        let values = [0.0, 0.123_456_7, 65.6, 1e6];
        DepthSequence::new(dir.path(), DepthFormat::Exr, true).push(&map(values)).unwrap();
        let read = exr::prelude::read_first_flat_layer_from_file(dir.path().join("depth_0000.exr")).unwrap();
        let channel = &read.layer_data.channel_data.list[0];
        assert_eq!(channel.name.to_string(), "Z");
        assert_eq!(channel.sample_data.values_as_f32().collect::<Vec<_>>(), values);
        DepthSequence::new(dir.path(), DepthFormat::Npy, true).push(&map(values)).unwrap();
        let bytes = std::fs::read(dir.path().join("depth_0000.npy")).unwrap();
        assert_eq!(bytes.len(), 128 + 16);
        assert!(String::from_utf8_lossy(&bytes[..128]).contains("'shape': (2, 2)"));
        let read: Vec<f32> = bytes[128..].as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
        assert_eq!(read, values);
    }
}
