//! The pixels of a capture as 8-bit samples: in memory while they fit a budget, else in a scratch file
//! that is mapped, so that anonymous memory stays bounded however large the capture is.

use crate::error::{DataError, Result};
use crate::photo;
use diorama_geom::ImageU8;
use diorama_geom::capture::Frame;
use rayon::prelude::*;
use std::io::{Seek, SeekFrom, Write};
use std::path::Path;

/// Bytes that are kept in memory before a scratch file is used.
pub const DEFAULT_BUDGET: u64 = 4 << 30;

enum Bytes {
    Memory(Vec<u8>),
    Mapped(memmap2::Mmap),
}

/// Pixels of some frames, four bytes each: RGB and alpha (255 where the photograph has none).
pub struct PixelStore {
    bytes: Bytes,
    /// First byte of each frame, and of the one after the last.
    offsets: Vec<usize>,
    sizes: Vec<(u32, u32)>,
    masks: Vec<Option<ImageU8>>,
    pub has_alpha: bool,
}

/// What to decode.
pub struct StoreOptions<'a> {
    pub downscale: u32,
    pub budget: u64,
    /// Where a scratch file may be put.
    pub scratch: &'a Path,
}

impl PixelStore {
    /// Decodes `frames`, reduced `downscale` times, in parallel; `progress` is called once per photograph.
    pub fn load(frames: &[&Frame], options: &StoreOptions, progress: &(dyn Fn() + Sync)) -> Result<PixelStore> {
        let sizes: Vec<(u32, u32)> = frames
            .iter()
            .map(|f| {
                let c = f.camera.downscaled(options.downscale);
                (c.width, c.height)
            })
            .collect();
        let mut offsets = vec![0usize];
        for (w, h) in &sizes {
            offsets.push(offsets[offsets.len() - 1] + *w as usize * *h as usize * 4);
        }
        let total = offsets[frames.len()] as u64;
        let in_memory = total <= options.budget;
        let mut memory = vec![0u8; if in_memory { total as usize } else { 0 }];
        let mut file = if in_memory { None } else { Some(scratch_file(options.scratch, total)?) };
        let mut masks = Vec::with_capacity(frames.len());
        let mut has_alpha = false;
        // A few photographs at a time: decoded ones are larger than what is kept.
        let batch = rayon::current_num_threads().max(1) * 2;
        for first in (0..frames.len()).step_by(batch) {
            let last = (first + batch).min(frames.len());
            let decoded: Vec<Result<(ImageU8, Option<ImageU8>)>> = (first..last)
                .into_par_iter()
                .map(|i| {
                    let out = decode(frames[i], sizes[i]);
                    progress();
                    out
                })
                .collect();
            for (i, d) in (first..last).zip(decoded) {
                let (image, mask) = d?;
                has_alpha |= image.channels == 4;
                masks.push(mask);
                let rgba = to_rgba(&image);
                match &mut file {
                    None => memory[offsets[i]..offsets[i + 1]].copy_from_slice(&rgba),
                    Some(f) => f.write_all(&rgba).map_err(DataError::io(options.scratch, "write the pixel cache"))?,
                }
            }
        }
        let bytes = match file {
            None => Bytes::Memory(memory),
            Some(mut f) => {
                f.seek(SeekFrom::Start(0)).map_err(DataError::io(options.scratch, "write the pixel cache"))?;
                // SAFETY: the file has no name any more, so nobody else can shorten it.
                Bytes::Mapped(unsafe { memmap2::Mmap::map(&f) }.map_err(DataError::io(options.scratch, "map the pixel cache"))?)
            }
        };
        Ok(PixelStore { bytes, offsets, sizes, masks, has_alpha })
    }

    pub fn len(&self) -> usize {
        self.sizes.len()
    }

    pub fn is_empty(&self) -> bool {
        self.sizes.is_empty()
    }

    /// Width and height of frame `i`.
    pub fn size(&self, i: usize) -> (u32, u32) {
        self.sizes[i]
    }

    /// Pixels of frame `i`, `[H, W, 4]`.
    pub fn frame(&self, i: usize) -> &[u8] {
        let all: &[u8] = match &self.bytes {
            Bytes::Memory(v) => v,
            Bytes::Mapped(m) => m,
        };
        &all[self.offsets[i]..self.offsets[i + 1]]
    }

    /// RGBA of a pixel.
    #[inline]
    pub fn pixel(&self, i: usize, x: u32, y: u32) -> [u8; 4] {
        let at = (y as usize * self.sizes[i].0 as usize + x as usize) * 4;
        self.frame(i)[at..at + 4].try_into().expect("four bytes")
    }

    /// Whether a pixel counts: not masked away.
    #[inline]
    pub fn counts(&self, i: usize, x: u32, y: u32) -> bool {
        self.masks[i].as_ref().is_none_or(|m| m.pixel(x as usize, y as usize)[0] >= 128)
    }

    /// Whether the pixels lie in a mapped scratch file.
    pub fn is_mapped(&self) -> bool {
        matches!(self.bytes, Bytes::Mapped(_))
    }
}

/// An unnamed file of the right size in `folder`.
fn scratch_file(folder: &Path, bytes: u64) -> Result<std::fs::File> {
    let path = folder.join("pixels.partial");
    let file = std::fs::OpenOptions::new().read(true).write(true).create(true).truncate(true).open(&path);
    let file = file.map_err(DataError::io(&path, "create the pixel cache"))?;
    file.set_len(bytes).map_err(DataError::io(&path, "reserve the pixel cache"))?;
    std::fs::remove_file(&path).map_err(DataError::io(&path, "hide the pixel cache"))?;
    Ok(file)
}

fn decode(frame: &Frame, size: (u32, u32)) -> Result<(ImageU8, Option<ImageU8>)> {
    let full = photo::load(&frame.image)?;
    let c = &frame.camera;
    if (full.width as u32, full.height as u32) != (c.width, c.height) {
        let message = format!(
            "the photograph is {}×{} but its camera says {}×{}; correct w and h (and the focal length) or use the original photographs",
            full.width, full.height, c.width, c.height
        );
        return Err(DataError::input(&frame.image, message));
    }
    let mask = match &frame.mask {
        None => None,
        Some(path) => {
            let m = photo::load_mask(path)?;
            if (m.width, m.height) != (full.width, full.height) {
                let message =
                    format!("the mask is {}×{} but the photograph is {}×{}; make them equal", m.width, m.height, full.width, full.height);
                return Err(DataError::input(path, message));
            }
            Some(m.downsampled(size.0 as usize, size.1 as usize))
        }
    };
    Ok((full.downsampled(size.0 as usize, size.1 as usize), mask))
}

fn to_rgba(im: &ImageU8) -> Vec<u8> {
    match im.channels {
        4 => im.data.clone(),
        3 => im.data.chunks_exact(3).flat_map(|p| [p[0], p[1], p[2], 255]).collect(),
        _ => im.data.iter().flat_map(|v| [*v, *v, *v, 255]).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    use diorama_geom::{Camera, Pose};

    fn frame(dir: &Path, name: &str, w: usize, h: usize, value: u8) -> Frame {
        let image = dir.join(name);
        photo::save_png(&image, &ImageU8 { width: w, height: h, channels: 3, data: vec![value; w * h * 3] }).unwrap();
        Frame::new(name, image, Camera::pinhole(w as u32, h as u32, 1.0), Pose::IDENTITY)
    }

    #[test]
    fn memory_and_mapped_file_hold_the_same_pixels() {
        let dir = tempfile::tempdir().unwrap();
        let frames: Vec<Frame> = (0..5).map(|i| frame(dir.path(), &format!("{i}.png"), 8 + i, 6, 40 * i as u8)).collect();
        let refs: Vec<&Frame> = frames.iter().collect();
        let load = |budget| PixelStore::load(&refs, &StoreOptions { downscale: 2, budget, scratch: dir.path() }, &|| {}).unwrap();
        let (a, b) = (load(u64::MAX), load(0));
        assert!(!a.is_mapped() && b.is_mapped());
        for i in 0..5 {
            assert_eq!(a.frame(i), b.frame(i));
            assert_eq!(a.pixel(i, 1, 2), [40 * i as u8, 40 * i as u8, 40 * i as u8, 255]);
        }
        assert!(!dir.path().join("pixels.partial").exists());
    }

    #[test]
    fn wrong_sizes_are_named() {
        let dir = tempfile::tempdir().unwrap();
        let mut f = frame(dir.path(), "a.png", 8, 6, 0);
        f.camera.width = 9;
        let options = StoreOptions { downscale: 1, budget: 1 << 20, scratch: dir.path() };
        let e = PixelStore::load(&[&f], &options, &|| {}).err().unwrap();
        assert!(e.is_input() && e.to_string().contains("8×6"), "{e}");
        f.camera.width = 8;
        let mask = dir.path().join("m.png");
        photo::save_png(&mask, &ImageU8 { width: 4, height: 3, channels: 1, data: vec![255; 12] }).unwrap();
        f.mask = Some(mask);
        assert!(PixelStore::load(&[&f], &options, &|| {}).err().unwrap().to_string().contains("mask"));
    }

    #[test]
    fn masks_decide_which_pixels_count() {
        let dir = tempfile::tempdir().unwrap();
        let mut f = frame(dir.path(), "a.png", 4, 1, 0);
        let mask = dir.path().join("m.png");
        photo::save_png(&mask, &ImageU8 { width: 4, height: 1, channels: 1, data: vec![0, 255, 0, 255] }).unwrap();
        f.mask = Some(mask);
        let s = PixelStore::load(&[&f], &StoreOptions { downscale: 1, budget: 1 << 20, scratch: dir.path() }, &|| {}).unwrap();
        assert_eq!([0, 1, 2, 3].map(|x| s.counts(0, x, 0)), [false, true, false, true]);
    }
}
