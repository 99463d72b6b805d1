//! The pixels of a capture in memory, in 8 bits, 16 bits or half floats, depending on the photographs. If all pixels exceed a budget, one
//! randomly chosen pixel of each square is kept. Training uses far fewer pixels than such captures have, and memory stays bounded for
//! captures of any size.

use crate::error::{DataError, Result};
use crate::masks::{self, COUNTS};
use crate::photo::{self, Depth, Photo};
use diorama_geom::capture::{ColorSpace, Frame, MaskMeaning, MaskRule};
use diorama_geom::color::{linear_from_srgb, srgb_from_linear, u8_from_unit, u16_from_unit};
use diorama_geom::rng::Rng;
use diorama_geom::{ImageU8, PixelFormat, Reduction};
use half::f16;
use rayon::prelude::*;

/// Default memory budget for pixels, in bytes.
pub const DEFAULT_BUDGET: u64 = 4 << 30;

/// Random stream that chooses the pixels to keep.
const KEPT: u64 = 15;

/// The largest half float.
const LARGEST: f32 = 65504.0;

/// Pixels of some frames, four values each: RGB and alpha (opaque if the photograph has none). Colors are sRGB, except in
/// [`PixelFormat::Half`], which holds linear light.
#[derive(Clone)]
pub struct PixelStore {
    values: Values,
    format: PixelFormat,
    /// One of each `stride × stride` pixels is kept.
    stride: u32,
    /// Index of the first value of each frame, and one past the last frame's values.
    offsets: Vec<usize>,
    sizes: Vec<(u32, u32)>,
    /// 0 for kept pixels that are masked out.
    masks: Vec<Option<Vec<u8>>>,
    pub has_alpha: bool,
}

/// Values of pixels, four each.
#[derive(Clone)]
enum Values {
    Bytes(Vec<u8>),
    Words(Vec<u16>),
}

/// Options for decoding.
pub struct StoreOptions {
    pub reduction: Reduction,
    pub budget: u64,
    pub masks: MaskRule,
    /// Radiance that is stored as 1, for linear light.
    pub white: f32,
}

impl PixelStore {
    /// Decodes and reduces `frames` in parallel; `progress` is called once per photograph.
    pub fn load(frames: &[&Frame], options: &StoreOptions, progress: &(dyn Fn() + Sync)) -> Result<PixelStore> {
        let sizes: Vec<(u32, u32)> = frames
            .iter()
            .map(|f| {
                let c = f.camera.reduced(options.reduction);
                (c.width, c.height)
            })
            .collect();
        let format = format_of(frames)?;
        let pixel = format.bytes() as u64;
        let squares = |stride: u32| sizes.iter().map(move |(w, h)| w.div_ceil(stride) as usize * h.div_ceil(stride) as usize);
        let stride = (1..).find(|s| squares(*s).sum::<usize>() as u64 * pixel <= options.budget || *s >= 64).expect("some stride");
        let mut offsets = vec![0usize];
        squares(stride).for_each(|n| offsets.push(offsets[offsets.len() - 1] + n * 4));
        let values = match format {
            PixelFormat::Unorm8 => Values::Bytes(vec![0; offsets[frames.len()]]),
            _ => Values::Words(vec![0; offsets[frames.len()]]),
        };
        let mut out = PixelStore { values, format, stride, offsets, sizes, masks: Vec::new(), has_alpha: false };
        // A few photographs at a time: decoded photographs are larger than the pixels that are kept.
        let batch = rayon::current_num_threads().max(1) * 2;
        for first in (0..frames.len()).step_by(batch) {
            let last = (first + batch).min(frames.len());
            let decoded: Vec<Result<Kept>> = (first..last)
                .into_par_iter()
                .map(|i| {
                    let (photo, mask) = decode(frames[i], &options.masks, out.sizes[i])?;
                    progress();
                    let mask = mask.map(|m| out.keep(i, |x, y| m.pixel(x, y)[0]));
                    let has_alpha = photo.channels() == 4;
                    Ok(Kept { values: out.values_of(i, photo, options.white), mask, has_alpha })
                })
                .collect();
            for (i, kept) in (first..last).zip(decoded) {
                let kept = kept?;
                out.has_alpha |= kept.has_alpha;
                out.masks.push(kept.mask);
                let own = out.offsets[i]..out.offsets[i + 1];
                match (&mut out.values, kept.values) {
                    (Values::Bytes(all), Values::Bytes(v)) => all[own].copy_from_slice(&v),
                    (Values::Words(all), Values::Words(v)) => all[own].copy_from_slice(&v),
                    _ => unreachable!("all frames are of the store's format"),
                }
            }
        }
        Ok(out)
    }

    /// The kept pixels of a photograph, in the store's format.
    fn values_of(&self, i: usize, photo: Photo, white: f32) -> Values {
        match (self.format, photo) {
            (PixelFormat::Half, Photo::Linear(im)) => {
                let stored = |[r, g, b, a]: [f32; 4]| {
                    [r / white, g / white, b / white, a].map(|v| f16::from_f32(v.clamp(-LARGEST, LARGEST)).to_bits())
                };
                Values::Words(self.keep(i, |x, y| stored(four(im.pixel(x, y), 1.0))).into_flattened())
            }
            (PixelFormat::Unorm8, photo) => {
                let im = photo.into_8_bits();
                Values::Bytes(self.keep(i, |x, y| four(im.pixel(x, y), 255)).into_flattened())
            }
            (_, photo) => {
                let im = photo.into_srgb();
                Values::Words(self.keep(i, |x, y| four(im.pixel(x, y), 1.0).map(u16_from_unit)).into_flattened())
            }
        }
    }

    /// Values of `at` for the kept pixels of a frame.
    fn keep<T>(&self, i: usize, at: impl Fn(usize, usize) -> T) -> Vec<T> {
        let ((w, h), s) = (self.sizes[i], self.stride);
        let places = (0..h.div_ceil(s)).flat_map(|by| (0..w.div_ceil(s)).map(move |bx| (bx, by)));
        places.map(|(bx, by)| self.snap(i, bx * s, by * s)).map(|(x, y)| at(x as usize, y as usize)).collect()
    }

    /// The pixel that is kept for the square that contains a given pixel.
    #[inline]
    pub fn snap(&self, i: usize, x: u32, y: u32) -> (u32, u32) {
        let s = self.stride;
        if s == 1 {
            return (x, y);
        }
        let ((w, h), (x0, y0)) = (self.sizes[i], (x / s * s, y / s * s));
        let random = self.kept_by(i).bits((y0 as u64) << 32 | x0 as u64);
        // Squares at the right and lower border are smaller.
        (x0 + random as u32 % s.min(w - x0), y0 + (random >> 32) as u32 % s.min(h - y0))
    }

    /// The random numbers that choose frame `i`'s kept pixels: number `y << 32 | x` of a square's corner gives the position in the square,
    /// x by the lower half of its bits, y by the upper.
    pub fn kept_by(&self, i: usize) -> Rng {
        Rng::new(i as u64, KEPT)
    }

    /// Multiplies the linear light of frame `i` per channel; results beyond the format's range are clamped.
    pub fn brighten(&mut self, i: usize, by: [f32; 3]) {
        let own = self.offsets[i]..self.offsets[i + 1];
        let srgb = |v: f32, k: usize| srgb_from_linear((linear_from_srgb(v) * by[k]).min(1.0));
        let half = |v: u16, k: usize| f16::from_f32((f16::from_bits(v).to_f32() * by[k]).clamp(-LARGEST, LARGEST)).to_bits();
        match (&mut self.values, self.format) {
            (Values::Bytes(v), _) => {
                let table = [0, 1, 2].map(|k| -> [u8; 256] { std::array::from_fn(|v| u8_from_unit(srgb(v as f32 / 255.0, k))) });
                v[own].as_chunks_mut::<4>().0.iter_mut().for_each(|p| (0..3).for_each(|k| p[k] = table[k][p[k] as usize]));
            }
            (Values::Words(v), PixelFormat::Half) => {
                v[own].as_chunks_mut::<4>().0.par_iter_mut().for_each(|p| (0..3).for_each(|k| p[k] = half(p[k], k)));
            }
            (Values::Words(v), _) => {
                let at = |v: u16, k: usize| u16_from_unit(srgb(v as f32 / 65535.0, k));
                v[own].as_chunks_mut::<4>().0.par_iter_mut().for_each(|p| (0..3).for_each(|k| p[k] = at(p[k], k)));
            }
        }
    }

    /// Number format of the values.
    pub fn format(&self) -> PixelFormat {
        self.format
    }

    /// Number of kept pixels of frame `i`.
    pub fn kept(&self, i: usize) -> usize {
        (self.offsets[i + 1] - self.offsets[i]) / 4
    }

    /// RGBA of frame `i`'s kept pixels, square by square: one word per pixel for 8-bit values, two for others; the first value is in the
    /// lowest bits.
    pub fn words(&self, i: usize) -> Vec<u32> {
        let own = self.offsets[i]..self.offsets[i + 1];
        match &self.values {
            Values::Bytes(v) => v[own].as_chunks().0.iter().map(|p| u32::from_le_bytes(*p)).collect(),
            Values::Words(v) => v[own].as_chunks().0.iter().map(|[low, high]| (*high as u32) << 16 | *low as u32).collect(),
        }
    }

    /// Which of the kept pixels the mask keeps; `None`: all.
    pub fn counting(&self, i: usize) -> Option<impl Iterator<Item = bool>> {
        self.masks[i].as_ref().map(|m| m.iter().map(|v| *v >= COUNTS))
    }

    /// Number of frames.
    pub fn len(&self) -> usize {
        self.sizes.len()
    }

    /// Whether there are no frames.
    pub fn is_empty(&self) -> bool {
        self.sizes.is_empty()
    }

    /// Width and height of frame `i`.
    pub fn size(&self, i: usize) -> (u32, u32) {
        self.sizes[i]
    }

    /// Index of the square that contains a pixel.
    #[inline]
    fn square(&self, i: usize, x: u32, y: u32) -> usize {
        (y / self.stride) as usize * self.sizes[i].0.div_ceil(self.stride) as usize + (x / self.stride) as usize
    }

    /// RGBA of a pixel returned by [`PixelStore::snap`], in the format of [`PixelStore::words`]; the second word is used only if a pixel
    /// has two.
    #[inline]
    pub fn pixel(&self, i: usize, x: u32, y: u32) -> [u32; 2] {
        let at = self.offsets[i] + self.square(i, x, y) * 4;
        match &self.values {
            Values::Bytes(v) => [u32::from_le_bytes(v[at..at + 4].try_into().expect("four values")), 0],
            Values::Words(v) => [0, 2].map(|k| (v[at + k + 1] as u32) << 16 | v[at + k] as u32),
        }
    }

    /// Whether such a pixel is kept by the mask.
    #[inline]
    pub fn counts(&self, i: usize, x: u32, y: u32) -> bool {
        self.masks[i].as_ref().is_none_or(|m| m[self.square(i, x, y)] >= COUNTS)
    }

    /// Whether such a pixel shows glass.
    pub fn is_glass(&self, i: usize, x: u32, y: u32) -> bool {
        self.masks[i].as_ref().is_some_and(|m| masks::GLASS.contains(&m[self.square(i, x, y)]))
    }

    /// Edge of the squares of which one pixel is kept; 1: all pixels are kept.
    pub fn stride(&self) -> u32 {
        self.stride
    }
}

/// The smallest format that can hold the values of all frames.
///
/// # Errors
/// If a photograph's header cannot be read.
pub fn format_of(frames: &[&Frame]) -> Result<PixelFormat> {
    if frames.iter().all(|f| f.color_space == ColorSpace::Linear) && !frames.is_empty() {
        return Ok(PixelFormat::Half);
    }
    let depths = frames.par_iter().map(|f| Ok(photo::header(&f.image)?.depth)).collect::<Result<Vec<_>>>()?;
    Ok(if depths.contains(&Depth::Sixteen) { PixelFormat::Unorm16 } else { PixelFormat::Unorm8 })
}

/// Kept pixels of one frame.
struct Kept {
    values: Values,
    mask: Option<Vec<u8>>,
    has_alpha: bool,
}

fn decode(frame: &Frame, rule: &MaskRule, size: (u32, u32)) -> Result<(Photo, Option<ImageU8>)> {
    let full = photo::load_full(&frame.image)?;
    let c = &frame.camera;
    let (w, h) = full.size();
    if (w as u32, h as u32) != (c.width, c.height) {
        let message = format!(
            "the photograph is {w}×{h} but its camera says {}×{}; it was changed since the capture was read: use the photographs as they were",
            c.width, c.height
        );
        return Err(DataError::input(&frame.image, message));
    }
    let (w, h) = (size.0 as usize, size.1 as usize);
    // An object's colors must not mix with those around it; the sky's, though transparent, are kept.
    let full = if rule.meaning == MaskMeaning::Classes { full.downsampled(w, h) } else { full };
    let (full, mask) = masks::apply(frame, rule, full)?;
    Ok((full.downsampled(w, h), mask.map(|m| m.downsampled(w, h))))
}

/// RGBA of a pixel with any number of channels.
fn four<T: Copy + Default>(pixel: &[T], opaque: T) -> [T; 4] {
    match *pixel {
        [r, g, b, a] => [r, g, b, a],
        [r, g, b] => [r, g, b, opaque],
        [v, ..] => [v, v, v, opaque],
        [] => [T::default(); 4],
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_geom::{Camera, Image, Pose};
    use std::path::Path;

    fn frame(dir: &Path, name: &str, w: usize, h: usize, value: u8) -> Frame {
        let image = dir.join(name);
        photo::save_png(&image, &ImageU8 { width: w, height: h, channels: 3, data: vec![value; w * h * 3] }).unwrap();
        Frame::new(name, image, Camera::pinhole(w as u32, h as u32, 1.0), Pose::IDENTITY)
    }

    /// A photograph whose pixel values encode their positions.
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
            PixelStore::load(
                &[&f, &f],
                &StoreOptions { reduction: Reduction::Times(1), budget, masks: MaskRule::default(), white: 1.0 },
                &|| {},
            )
            .unwrap()
        };
        assert_eq!(load(u64::MAX).stride(), 1);
        let budget = 2 * 101 * 67 * 4 / 10;
        let s = load(budget);
        assert!(s.stride() == 4 && s.kept(0) as u64 * 8 <= budget);
        let (mut sum, mut kept) = ([0.0; 2], std::collections::HashSet::new());
        for i in 0..2 {
            for (x, y) in (0..67).flat_map(|y| (0..101).map(move |x| (x, y))) {
                let (a, b) = s.snap(i, x, y);
                assert!(a / 4 == x / 4 && b / 4 == y / 4 && a < 101 && b < 67);
                assert_eq!(s.snap(i, a, b), (a, b), "what is kept stays");
                assert_eq!(s.pixel(i, x, y)[0].to_le_bytes(), [a as u8, b as u8, 7, 255]);
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
        let options = StoreOptions { reduction: Reduction::Times(1), budget: 1 << 20, masks: MaskRule::default(), white: 1.0 };
        let e = PixelStore::load(&[&f], &options, &|| {}).err().unwrap();
        assert!(e.is_input() && e.to_string().contains("8×6"), "{e}");
        f.camera.width = 8;
        let mask = dir.path().join("m.png");
        photo::save_png(&mask, &ImageU8 { width: 3, height: 4, channels: 1, data: vec![255; 12] }).unwrap();
        f.mask = Some(mask);
        assert!(PixelStore::load(&[&f], &options, &|| {}).err().unwrap().to_string().contains("mask"));
    }

    fn four_words(words: [u32; 2]) -> [u16; 4] {
        [0, 1, 2, 3].map(|k| (words[k / 2] >> (16 * (k % 2))) as u16)
    }

    #[test]
    fn sixteen_bits_and_light_brighter_than_white_stay() {
        let dir = tempfile::tempdir().unwrap();
        let options = StoreOptions { reduction: Reduction::Times(1), budget: 1 << 20, masks: MaskRule::default(), white: 1.0 };
        let value = |i: usize| (i * 40_503 % 65_536) as f32;
        let im = Image { width: 5, height: 4, channels: 3, data: (0..60).map(|i| value(i) / 65535.0).collect() };
        let mut f = frame(dir.path(), "a.png", 5, 4, 0);
        std::fs::write(&f.image, photo::encode_png_16(&im)).unwrap();
        // Together with an 8-bit photograph.
        let other = frame(dir.path(), "b.png", 5, 4, 77);
        let s = PixelStore::load(&[&f, &other], &options, &|| {}).unwrap();
        assert_eq!((s.format(), s.words(0).len(), s.kept(0)), (PixelFormat::Unorm16, 40, 20));
        for (i, want) in im.data.chunks_exact(3).enumerate() {
            let at = |photo: usize| four_words(s.pixel(photo, i as u32 % 5, i as u32 / 5));
            assert!((0..3).all(|k| at(0)[k] as f32 == (want[k] * 65535.0).round()) && at(0)[3] == 65535);
            assert_eq!(at(1), [77 * 257, 77 * 257, 77 * 257, 65535]);
        }
        let bright = Image { data: (0..60).map(|i| value(i) / 16.0).collect(), ..im };
        f.image.set_extension("exr");
        f.color_space = ColorSpace::Linear;
        photo::save_exr(&f.image, &bright).unwrap();
        let s = PixelStore::load(&[&f], &options, &|| {}).unwrap();
        assert_eq!(s.format(), PixelFormat::Half);
        for (i, want) in bright.data.chunks_exact(3).enumerate() {
            let got = four_words(s.pixel(0, i as u32 % 5, i as u32 / 5)).map(|v| f16::from_bits(v).to_f32());
            // Half floats have 11 bits.
            assert!((0..3).all(|k| (got[k] - want[k]).abs() <= want[k] / 2048.0 + 1e-7), "{got:?} {want:?}");
            assert_eq!(s.pixel(0, i as u32 % 5, i as u32 / 5), [s.words(0)[i * 2], s.words(0)[i * 2 + 1]]);
            assert_eq!(got[3], 1.0);
        }
        // A run that was started with an earlier version stays in sRGB.
        f.color_space = ColorSpace::Srgb;
        assert_eq!(PixelStore::load(&[&f], &options, &|| {}).unwrap().format(), PixelFormat::Unorm8);
    }

    #[test]
    fn light_is_multiplied_and_cut_off_at_the_formats_range() {
        let dir = tempfile::tempdir().unwrap();
        let options = StoreOptions { reduction: Reduction::Times(1), budget: 1 << 20, masks: MaskRule::default(), white: 1.0 };
        let by = [0.5, 1.0, 8.0];
        let want = |v: f32| by.map(|b| srgb_from_linear((linear_from_srgb(v) * b).min(1.0)));
        let (mut f, other) = (frame(dir.path(), "a.png", 2, 1, 120), frame(dir.path(), "b.png", 2, 1, 120));
        let mut s = PixelStore::load(&[&f, &other], &options, &|| {}).unwrap();
        s.brighten(0, by);
        let bytes = want(120.0 / 255.0).map(u8_from_unit);
        assert_eq!(s.pixel(0, 1, 0)[0].to_le_bytes(), [bytes[0], 120, 255, 255]);
        assert_eq!(s.pixel(1, 1, 0)[0].to_le_bytes(), [120, 120, 120, 255], "another photograph");
        let im = Image { width: 2, height: 1, channels: 3, data: vec![0.2; 6] };
        std::fs::write(&f.image, photo::encode_png_16(&im)).unwrap();
        let mut s = PixelStore::load(&[&f], &options, &|| {}).unwrap();
        s.brighten(0, by);
        let got = four_words(s.pixel(0, 1, 0)).map(|v| v as f32 / 65535.0);
        assert!(got.iter().zip(want(0.2)).all(|(g, w)| (g - w).abs() < 2e-5) && got[3] == 1.0, "{got:?}");
        f.image.set_extension("exr");
        f.color_space = ColorSpace::Linear;
        photo::save_exr(&f.image, &im).unwrap();
        let mut s = PixelStore::load(&[&f], &options, &|| {}).unwrap();
        s.brighten(0, by);
        let got = four_words(s.pixel(0, 1, 0)).map(|v| f16::from_bits(v).to_f32());
        assert!(got.iter().zip([0.1, 0.2, 1.6, 1.0]).all(|(g, w)| (g - w).abs() < 1e-3), "{got:?}");
    }

    #[test]
    fn an_objects_mask_makes_pixels_transparent() {
        let dir = tempfile::tempdir().unwrap();
        let mut f = frame(dir.path(), "a.png", 4, 1, 90);
        let mask = dir.path().join("m.png");
        photo::save_png(&mask, &ImageU8 { width: 4, height: 1, channels: 1, data: vec![0, 255, 0, 255] }).unwrap();
        f.mask = Some(mask);
        let masks = MaskRule { meaning: diorama_geom::capture::MaskMeaning::Object, inverted: false };
        let s =
            PixelStore::load(&[&f], &StoreOptions { reduction: Reduction::Times(1), budget: 1 << 20, masks, white: 1.0 }, &|| {}).unwrap();
        assert!(s.has_alpha && (0..4).all(|x| s.counts(0, x, 0)));
        assert_eq!([0, 1].map(|x| s.pixel(0, x, 0)[0].to_le_bytes()[3]), [0, 255]);
    }

    #[test]
    fn masks_decide_which_pixels_count() {
        let dir = tempfile::tempdir().unwrap();
        let mut f = frame(dir.path(), "a.png", 4, 1, 0);
        let mask = dir.path().join("m.png");
        photo::save_png(&mask, &ImageU8 { width: 4, height: 1, channels: 1, data: vec![0, 255, 100, 192] }).unwrap();
        f.mask = Some(mask);
        let s = PixelStore::load(
            &[&f],
            &StoreOptions { reduction: Reduction::Times(1), budget: 1 << 20, masks: MaskRule::default(), white: 1.0 },
            &|| {},
        )
        .unwrap();
        assert_eq!([0, 1, 2, 3].map(|x| s.counts(0, x, 0)), [false, true, false, true]);
        assert_eq!([0, 1, 2, 3].map(|x| s.is_glass(0, x, 0)), [false, false, false, true]);
    }
}
