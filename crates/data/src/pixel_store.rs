//! The pixels of a capture as 8-bit samples in memory: all of them while they fit a budget, else one of each square of some, drawn
//! at random. Training draws far fewer pixels than such captures have, and memory stays bounded however large they are.

use crate::error::{DataError, Result};
use crate::masks::{self, COUNTS};
use crate::photo;
use diorama_geom::capture::{Frame, MaskRule};
use diorama_geom::rng::Rng;
use diorama_geom::{ImageU8, Reduction};
use rayon::prelude::*;

/// Bytes that pixels may take.
pub const DEFAULT_BUDGET: u64 = 4 << 30;

/// Stream of the random numbers by which pixels are kept.
const KEPT: u64 = 15;

/// Pixels of some frames, four bytes each: RGB and alpha (255 where the photograph has none).
pub struct PixelStore {
    bytes: Vec<u8>,
    /// One of each `stride × stride` pixels is kept.
    stride: u32,
    /// First byte of each frame, and of the one after the last.
    offsets: Vec<usize>,
    sizes: Vec<(u32, u32)>,
    /// 0 where a kept pixel is masked away.
    masks: Vec<Option<Vec<u8>>>,
    pub has_alpha: bool,
}

/// What to decode.
pub struct StoreOptions {
    pub reduction: Reduction,
    pub budget: u64,
    pub masks: MaskRule,
}

impl PixelStore {
    /// Decodes `frames`, reduced, in parallel; `progress` is called once per photograph.
    pub fn load(frames: &[&Frame], options: &StoreOptions, progress: &(dyn Fn() + Sync)) -> Result<PixelStore> {
        let sizes: Vec<(u32, u32)> = frames
            .iter()
            .map(|f| {
                let c = f.camera.reduced(options.reduction);
                (c.width, c.height)
            })
            .collect();
        let squares = |stride: u32| sizes.iter().map(move |(w, h)| w.div_ceil(stride) as usize * h.div_ceil(stride) as usize);
        let stride = (1..).find(|s| squares(*s).sum::<usize>() as u64 * 4 <= options.budget || *s >= 64).expect("some stride");
        let mut offsets = vec![0usize];
        squares(stride).for_each(|n| offsets.push(offsets[offsets.len() - 1] + n * 4));
        let mut out = PixelStore { bytes: vec![0; offsets[frames.len()]], stride, offsets, sizes, masks: Vec::new(), has_alpha: false };
        // A few photographs at a time: decoded ones are larger than what is kept.
        let batch = rayon::current_num_threads().max(1) * 2;
        for first in (0..frames.len()).step_by(batch) {
            let last = (first + batch).min(frames.len());
            let decoded: Vec<Result<Kept>> = (first..last)
                .into_par_iter()
                .map(|i| {
                    let (image, mask) = decode(frames[i], &options.masks, out.sizes[i])?;
                    progress();
                    let mask = mask.map(|m| out.keep(i, |x, y| m.pixel(x, y)[0]));
                    Ok(Kept { rgba: out.keep(i, |x, y| rgba(&image, x, y)), mask, has_alpha: image.channels == 4 })
                })
                .collect();
            for (i, kept) in (first..last).zip(decoded) {
                let kept = kept?;
                out.has_alpha |= kept.has_alpha;
                out.masks.push(kept.mask);
                out.bytes[out.offsets[i]..out.offsets[i + 1]].copy_from_slice(kept.rgba.as_flattened());
            }
        }
        Ok(out)
    }

    /// What a frame has at the pixels that are kept of it.
    fn keep<T>(&self, i: usize, at: impl Fn(usize, usize) -> T) -> Vec<T> {
        let ((w, h), s) = (self.sizes[i], self.stride);
        let places = (0..h.div_ceil(s)).flat_map(|by| (0..w.div_ceil(s)).map(move |bx| (bx, by)));
        places.map(|(bx, by)| self.snap(i, bx * s, by * s)).map(|(x, y)| at(x as usize, y as usize)).collect()
    }

    /// The pixel that is kept of the square in which a pixel lies.
    #[inline]
    pub fn snap(&self, i: usize, x: u32, y: u32) -> (u32, u32) {
        let s = self.stride;
        if s == 1 {
            return (x, y);
        }
        let ((w, h), (x0, y0)) = (self.sizes[i], (x / s * s, y / s * s));
        let random = self.kept_by(i).bits((y0 as u64) << 32 | x0 as u64);
        // Squares at the right and lower edge are cut off.
        (x0 + random as u32 % s.min(w - x0), y0 + (random >> 32) as u32 % s.min(h - y0))
    }

    /// The random numbers by which frame `i`'s pixels were kept: number `y << 32 | x` of a square's corner gives the
    /// place in the square, x by the lower half, y by the upper.
    pub fn kept_by(&self, i: usize) -> Rng {
        Rng::new(i as u64, KEPT)
    }

    /// RGBA of frame `i`'s kept pixels, square by square.
    pub fn kept(&self, i: usize) -> &[[u8; 4]] {
        self.bytes[self.offsets[i]..self.offsets[i + 1]].as_chunks().0
    }

    /// Which of them count; none: all.
    pub fn counting(&self, i: usize) -> Option<impl Iterator<Item = bool>> {
        self.masks[i].as_ref().map(|m| m.iter().map(|v| *v >= COUNTS))
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

    /// Place of the square in which a pixel lies.
    #[inline]
    fn square(&self, i: usize, x: u32, y: u32) -> usize {
        (y / self.stride) as usize * self.sizes[i].0.div_ceil(self.stride) as usize + (x / self.stride) as usize
    }

    /// RGBA of a pixel that [`PixelStore::snap`] gave.
    #[inline]
    pub fn pixel(&self, i: usize, x: u32, y: u32) -> [u8; 4] {
        let at = self.offsets[i] + self.square(i, x, y) * 4;
        self.bytes[at..at + 4].try_into().expect("four bytes")
    }

    /// Whether such a pixel counts: not masked away.
    #[inline]
    pub fn counts(&self, i: usize, x: u32, y: u32) -> bool {
        self.masks[i].as_ref().is_none_or(|m| m[self.square(i, x, y)] >= COUNTS)
    }

    /// One of so many by so many pixels is kept; 1: all are.
    pub fn stride(&self) -> u32 {
        self.stride
    }
}

/// What is kept of a frame.
struct Kept {
    rgba: Vec<[u8; 4]>,
    mask: Option<Vec<u8>>,
    has_alpha: bool,
}

fn decode(frame: &Frame, rule: &MaskRule, size: (u32, u32)) -> Result<(ImageU8, Option<ImageU8>)> {
    let full = photo::load(&frame.image)?;
    let c = &frame.camera;
    if (full.width as u32, full.height as u32) != (c.width, c.height) {
        let message = format!(
            "the photograph is {}×{} but its camera says {}×{}; correct w and h (and the focal length) or use the original photographs",
            full.width, full.height, c.width, c.height
        );
        return Err(DataError::input(&frame.image, message));
    }
    let (full, mask) = masks::apply(frame, rule, full)?;
    let (w, h) = (size.0 as usize, size.1 as usize);
    Ok((full.downsampled(w, h), mask.map(|m| m.downsampled(w, h))))
}

fn rgba(im: &ImageU8, x: usize, y: usize) -> [u8; 4] {
    match *im.pixel(x, y) {
        [r, g, b, a] => [r, g, b, a],
        [r, g, b] => [r, g, b, 255],
        [v, ..] => [v, v, v, 255],
        [] => [0; 4],
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_geom::{Camera, Pose};
    use std::path::Path;

    fn frame(dir: &Path, name: &str, w: usize, h: usize, value: u8) -> Frame {
        let image = dir.join(name);
        photo::save_png(&image, &ImageU8 { width: w, height: h, channels: 3, data: vec![value; w * h * 3] }).unwrap();
        Frame::new(name, image, Camera::pinhole(w as u32, h as u32, 1.0), Pose::IDENTITY)
    }

    /// A photograph whose pixels tell where they are.
    fn places(dir: &Path, w: usize, h: usize) -> Frame {
        let data = (0..w * h).flat_map(|i| [(i % w) as u8, (i / w) as u8, 7]).collect();
        let f = frame(dir, "places.png", w, h, 0);
        photo::save_png(&f.image, &ImageU8 { width: w, height: h, channels: 3, data }).unwrap();
        f
    }

    #[test]
    fn a_small_budget_keeps_one_pixel_of_each_square() {
        let dir = tempfile::tempdir().unwrap();
        let mut f = places(dir.path(), 101, 67);
        let mask = dir.path().join("m.png");
        let half =
            ImageU8 { width: 101, height: 67, channels: 1, data: (0..101 * 67).map(|i| if i % 101 < 50 { 255 } else { 0 }).collect() };
        photo::save_png(&mask, &half).unwrap();
        f.mask = Some(mask);
        let load = |budget| {
            PixelStore::load(&[&f, &f], &StoreOptions { reduction: Reduction::Times(1), budget, masks: MaskRule::default() }, &|| {})
                .unwrap()
        };
        assert_eq!(load(u64::MAX).stride(), 1);
        let budget = 2 * 101 * 67 * 4 / 10;
        let s = load(budget);
        assert!(s.stride() == 4 && s.bytes.len() as u64 <= budget);
        let (mut sum, mut kept) = ([0.0; 2], std::collections::HashSet::new());
        for i in 0..2 {
            for (x, y) in (0..67).flat_map(|y| (0..101).map(move |x| (x, y))) {
                let (a, b) = s.snap(i, x, y);
                assert!(a / 4 == x / 4 && b / 4 == y / 4 && a < 101 && b < 67);
                assert_eq!(s.snap(i, a, b), (a, b), "what is kept stays");
                assert_eq!(s.pixel(i, x, y), [a as u8, b as u8, 7, 255]);
                assert_eq!(s.counts(i, x, y), a < 50);
                if x < 100 && y < 64 {
                    (sum[0], sum[1]) = (sum[0] + (a % 4) as f64, sum[1] + (b % 4) as f64);
                }
                kept.insert((i, a, b));
            }
        }
        assert_eq!(kept.len(), 2 * 26 * 17);
        assert!(sum.iter().all(|v| (v / (2.0 * 6400.0) - 1.5).abs() < 0.15), "{sum:?}");
    }

    #[test]
    fn wrong_sizes_are_named() {
        let dir = tempfile::tempdir().unwrap();
        let mut f = frame(dir.path(), "a.png", 8, 6, 0);
        f.camera.width = 9;
        let options = StoreOptions { reduction: Reduction::Times(1), budget: 1 << 20, masks: MaskRule::default() };
        let e = PixelStore::load(&[&f], &options, &|| {}).err().unwrap();
        assert!(e.is_input() && e.to_string().contains("8×6"), "{e}");
        f.camera.width = 8;
        let mask = dir.path().join("m.png");
        photo::save_png(&mask, &ImageU8 { width: 3, height: 4, channels: 1, data: vec![255; 12] }).unwrap();
        f.mask = Some(mask);
        assert!(PixelStore::load(&[&f], &options, &|| {}).err().unwrap().to_string().contains("mask"));
    }

    #[test]
    fn an_objects_mask_makes_pixels_transparent() {
        let dir = tempfile::tempdir().unwrap();
        let mut f = frame(dir.path(), "a.png", 4, 1, 90);
        let mask = dir.path().join("m.png");
        photo::save_png(&mask, &ImageU8 { width: 4, height: 1, channels: 1, data: vec![0, 255, 0, 255] }).unwrap();
        f.mask = Some(mask);
        let masks = MaskRule { meaning: diorama_geom::capture::MaskMeaning::Object, inverted: false };
        let s = PixelStore::load(&[&f], &StoreOptions { reduction: Reduction::Times(1), budget: 1 << 20, masks }, &|| {}).unwrap();
        assert!(s.has_alpha && (0..4).all(|x| s.counts(0, x, 0)));
        assert_eq!([0, 1].map(|x| s.pixel(0, x, 0)[3]), [0, 255]);
    }

    #[test]
    fn masks_decide_which_pixels_count() {
        let dir = tempfile::tempdir().unwrap();
        let mut f = frame(dir.path(), "a.png", 4, 1, 0);
        let mask = dir.path().join("m.png");
        photo::save_png(&mask, &ImageU8 { width: 4, height: 1, channels: 1, data: vec![0, 255, 0, 255] }).unwrap();
        f.mask = Some(mask);
        let s =
            PixelStore::load(&[&f], &StoreOptions { reduction: Reduction::Times(1), budget: 1 << 20, masks: MaskRule::default() }, &|| {})
                .unwrap();
        assert_eq!([0, 1, 2, 3].map(|x| s.counts(0, x, 0)), [false, true, false, true]);
    }
}
