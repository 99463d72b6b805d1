//! Animated GIFs: 256 colors per frame, delays in hundredths of a second.

use crate::atomic;
use crate::error::{DataError, Result};
use diorama_geom::ImageU8;
use image::codecs::gif::{GifEncoder, Repeat};
use std::cell::RefCell;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::rc::Rc;

/// Highest frame rate; browsers slow down faster GIFs.
const FASTEST: u32 = 50;
const LARGEST: usize = 65_535;
/// The encoder's trade-off between time and color quality: 1 is best, 30 fastest.
const SPEED: i32 = 10;

/// Byte buffer that the encoder and its owner share.
#[derive(Clone, Default)]
struct Bytes(Rc<RefCell<Vec<u8>>>);

impl Write for Bytes {
    fn write(&mut self, data: &[u8]) -> std::io::Result<usize> {
        self.0.borrow_mut().write(data)
    }
    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

/// A GIF being written, which loops forever; no file appears before [`Gif::finish`].
pub struct Gif {
    path: PathBuf,
    encoder: GifEncoder<Bytes>,
    bytes: Bytes,
    size: (usize, usize),
    fps: u32,
    frames: u32,
}

impl Gif {
    /// Starts a GIF with frames of one size.
    ///
    /// # Errors
    /// If the format does not support the size or frame rate.
    pub fn create(path: &Path, width: usize, height: usize, fps: u32) -> Result<Gif> {
        if width == 0 || height == 0 || width > LARGEST || height > LARGEST {
            return Err(DataError::input(
                path,
                format!("a GIF of {width}×{height}: sides can have at most 65535 pixels; choose a smaller --size"),
            ));
        }
        if !(1..=FASTEST).contains(&fps) {
            let message = format!("a GIF of {fps} frames per second: programs show at most {FASTEST}; choose --fps {FASTEST} or .mp4");
            return Err(DataError::input(path, message));
        }
        let bytes = Bytes::default();
        let mut encoder = GifEncoder::new_with_speed(bytes.clone(), SPEED);
        encoder.set_repeat(Repeat::Infinite).map_err(|e| failed(path, &e))?;
        Ok(Gif { path: path.to_path_buf(), encoder, bytes, size: (width, height), fps, frames: 0 })
    }

    /// Adds a frame `[H, W, 3]`.
    ///
    /// # Errors
    /// If the frame has another size.
    pub fn push(&mut self, frame: &ImageU8) -> Result<()> {
        let rgba = frame.data.chunks_exact(3).flat_map(|p| [p[0], p[1], p[2], 255]).collect();
        let image = image::RgbaImage::from_raw(self.size.0 as u32, self.size.1 as u32, rgba)
            .ok_or_else(|| DataError::input(&self.path, "frames of a GIF must have one size"))?;
        // Delays in hundredths of a second whose sum follows the frame rate.
        let until = |n: u32| (n as f64 * 100.0 / self.fps as f64).round() as u32;
        let delay = image::Delay::from_numer_denom_ms((until(self.frames + 1) - until(self.frames)) * 10, 1);
        self.frames += 1;
        self.encoder.encode_frame(image::Frame::from_parts(image, 0, 0, delay)).map_err(|e| failed(&self.path, &e))
    }

    /// Writes the file.
    ///
    /// # Errors
    /// If there is no frame, or the file cannot be written.
    pub fn finish(self) -> Result<()> {
        if self.frames == 0 {
            return Err(DataError::input(&self.path, "a GIF needs at least one frame"));
        }
        // The encoder writes the trailer when it is dropped.
        drop(self.encoder);
        let bytes = self.bytes.0.take();
        atomic::write(&self.path, &bytes)
    }
}

fn failed(path: &Path, e: &image::ImageError) -> DataError {
    DataError::failed(path, format!("cannot be encoded: {e}"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::AnimationDecoder;

    #[test]
    fn a_gif_has_its_frames_colors_and_times() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("a.gif");
        let mut gif = Gif::create(&file, 20, 10, 30).unwrap();
        for i in 0..6u8 {
            gif.push(&ImageU8 { width: 20, height: 10, channels: 3, data: [i * 40, 200, 7].repeat(200) }).unwrap();
        }
        assert!(!file.exists());
        gif.finish().unwrap();
        let bytes = std::fs::read(&file).unwrap();
        assert!(bytes.starts_with(b"GIF89a"));
        let frames = image::codecs::gif::GifDecoder::new(std::io::Cursor::new(bytes)).unwrap().into_frames().collect_frames().unwrap();
        assert_eq!(frames.len(), 6);
        let milliseconds: f32 = frames.iter().map(|f| f.delay().numer_denom_ms()).map(|(n, d)| n as f32 / d as f32).sum();
        assert_eq!(milliseconds, 200.0);
        for (i, f) in frames.iter().enumerate() {
            let p = f.buffer().get_pixel(3, 3).0;
            assert!((p[0] as i32 - i as i32 * 40).abs() < 8 && (p[1] as i32 - 200).abs() < 8, "{p:?}");
        }
        assert!(Gif::create(&file, 20, 10, 60).err().unwrap().to_string().contains("--fps"));
    }
}
