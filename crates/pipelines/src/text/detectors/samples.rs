//! Training samples: windows of images under random rotation, scale and color, with the outlines of their writing.

use super::evaluation::Label;
use super::polygon::{intersection_area, signed_area};
use crate::error::Result;
use diorama_data::photo;
use diorama_data::text_set::detector_set::DetectorImage;
use diorama_geom::glam::{DMat2, DVec2, dvec2};
use diorama_geom::rng::Rng;
use diorama_geom::{Image, ImageU8};
use diorama_nets::train::augment::Draws;
use serde::{Deserialize, Serialize};
use std::sync::OnceLock;

/// What stands where there is no image: ImageNet's mean color, which networks see as 0.
pub const EMPTY: [f32; 3] = [0.485, 0.456, 0.406];
/// Windows that are drawn until one cuts no writing.
const TRIES: usize = 16;
/// Every so many windows, the first is taken whatever it shows.
const ANY_WINDOW: usize = 8;
/// Shares of an outline in the window from which it is learned, and below which it is not in the window at all.
const WHOLE: f64 = 0.97;
const ABSENT: f64 = 0.03;

/// How training images are changed.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AugmentConfig {
    /// Largest rotation in radians.
    pub rotation: f32,
    /// Range of factors of the size; their logarithms are drawn evenly.
    pub least_scale: f32,
    pub most_scale: f32,
    /// Most that brightness is changed by, and that contrast and saturation differ from 1.
    pub color: f32,
}

/// Images of a data set, decoded when they are needed first, and kept as far as memory allows.
pub struct Pictures {
    images: Vec<DetectorImage>,
    /// Pixels of the longer side that are not exceeded.
    most_px: usize,
    kept: Option<Vec<OnceLock<ImageU8>>>,
}

impl Pictures {
    /// # Errors
    /// When an image cannot be read.
    pub fn new(images: Vec<DetectorImage>, most_px: usize, memory_budget: u64) -> Result<Pictures> {
        let mut bytes = 0.0;
        for image in &images {
            let (w, h) = photo::size(&image.path)?;
            let scale = (most_px as f64 / w.max(h) as f64).min(1.0);
            bytes += 3.0 * w as f64 * h as f64 * scale * scale;
        }
        let kept = (bytes <= memory_budget as f64).then(|| images.iter().map(|_| OnceLock::new()).collect());
        Ok(Pictures { images, most_px, kept })
    }

    /// How many there are.
    pub fn len(&self) -> usize {
        self.images.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.images.is_empty()
    }

    /// Image number `i` and its labels, in pixels of the decoded image.
    ///
    /// # Errors
    /// When it cannot be decoded.
    pub fn get(&self, i: usize) -> Result<(ImageU8, Vec<Label>)> {
        let image = &self.images[i];
        let decoded = match self.kept.as_ref().and_then(|k| k[i].get()) {
            Some(kept) => kept.clone(),
            None => {
                let decoded = photo::load_small(&image.path, self.most_px)?;
                if let Some(kept) = &self.kept {
                    let _ = kept[i].set(decoded.clone());
                }
                decoded
            }
        };
        let (w, h) = photo::size(&image.path)?;
        let scale = dvec2(decoded.width as f64 / w as f64, decoded.height as f64 / h as f64);
        Ok((decoded, labels(image, scale)))
    }
}

/// Labels of an image, scaled.
pub fn labels(image: &DetectorImage, scale: DVec2) -> Vec<Label> {
    let of = |l: &diorama_data::text_set::detector_set::DetectorLabel| Label {
        polygon: l.region.polygon.iter().map(|p| DVec2::from(*p) * scale).collect(),
        ignore: l.region.ignore,
        cluster: l.cluster,
    };
    image.labels.iter().map(of).collect()
}

/// A window of an image: `window = turn · image + shift`.
#[derive(Clone, Copy, Debug)]
struct Window {
    turn: DMat2,
    shift: DVec2,
}

impl Window {
    /// A window of `side` pixels that holds as much of the image as it can: anywhere, or around `target`.
    fn draw(size: DVec2, side: f64, target: Option<DVec2>, config: &AugmentConfig, draws: &mut Draws) -> Window {
        let angle = draws.symmetric(config.rotation) as f64;
        let (low, high) = (config.least_scale.ln(), config.most_scale.ln());
        let scale = (low + draws.uniform() * (high - low)).exp() as f64;
        let half = 0.5 * side / scale;
        let mut place = |n: f64, target: Option<f64>| {
            // Where the image is smaller, it lies anywhere in the window.
            let (low, high) = (half.min(n - half), half.max(n - half));
            let near = |t: f64| ((t - half).clamp(low, high), (t + half).clamp(low, high));
            let (a, b) = target.map_or((low, high), near);
            a + draws.uniform() as f64 * (b - a)
        };
        let center = dvec2(place(size.x, target.map(|t| t.x)), place(size.y, target.map(|t| t.y)));
        let turn = DMat2::from_angle(angle) * scale;
        Window { turn, shift: DVec2::splat(0.5 * side) - turn * center }
    }

    /// Labels in a window of `side` pixels; those that it cuts are to be ignored. Also how many are whole and how many are cut.
    fn labels(&self, labels: &[Label], side: f64) -> (Vec<Label>, usize, usize) {
        let frame = [dvec2(0.0, 0.0), dvec2(side, 0.0), dvec2(side, side), dvec2(0.0, side)];
        let (mut out, mut whole, mut cut) = (Vec::new(), 0, 0);
        for label in labels {
            let polygon: Vec<DVec2> = label.polygon.iter().map(|p| self.turn * *p + self.shift).collect();
            let share = intersection_area(&polygon, &frame) / signed_area(&polygon).abs().max(f64::MIN_POSITIVE);
            if share < ABSENT {
                continue;
            }
            let is_cut = share < WHOLE && !label.ignore;
            (whole, cut) = (whole + (!is_cut && !label.ignore) as usize, cut + is_cut as usize);
            out.push(Label { polygon, ignore: label.ignore || is_cut, cluster: label.cluster });
        }
        (out, whole, cut)
    }

    /// The window's pixels, sampled bilinearly; where the window shrinks the image, means over its pixels' footprints are sampled.
    fn picture(&self, image: &ImageU8, side: usize) -> Image {
        let scale = self.turn.determinant().sqrt();
        let by = (1.0 / scale).floor().max(1.0);
        let (w, h) = ((image.width as f64 / by).max(1.0) as usize, (image.height as f64 / by).max(1.0) as usize);
        let source = if by > 1.0 { &image.downsampled(w, h) } else { image };
        let shrunk = dvec2(source.width as f64 / image.width as f64, source.height as f64 / image.height as f64);
        let back = self.turn.inverse();
        let mut out = Image::zeros(side, side, 3);
        for (i, pixel) in out.data.chunks_exact_mut(3).enumerate() {
            let at = dvec2((i % side) as f64 + 0.5, (i / side) as f64 + 0.5);
            let p = back * (at - self.shift) * shrunk;
            pixel.copy_from_slice(&bilinear(source, p));
        }
        out
    }
}

/// An image of three channels at a place; [`EMPTY`] outside.
fn bilinear(image: &ImageU8, p: DVec2) -> [f32; 3] {
    let (w, h) = (image.width as f64, image.height as f64);
    if p.x < 0.0 || p.y < 0.0 || p.x >= w || p.y >= h {
        return EMPTY;
    }
    let (x, y) = ((p.x - 0.5).clamp(0.0, w - 1.0), (p.y - 0.5).clamp(0.0, h - 1.0));
    let (x0, y0) = (x as usize, y as usize);
    let (x1, y1) = ((x0 + 1).min(image.width - 1), (y0 + 1).min(image.height - 1));
    let (u, v) = ((x - x0 as f64) as f32, (y - y0 as f64) as f32);
    let [a, b, c, d] = [(x0, y0), (x1, y0), (x0, y1), (x1, y1)].map(|(x, y)| image.pixel(x, y));
    std::array::from_fn(|k| {
        let [a, b, c, d] = [a, b, c, d].map(|p| p[k] as f32 / 255.0);
        (a * (1.0 - u) + b * u) * (1.0 - v) + (c * (1.0 - u) + d * u) * v
    })
}

/// Changes brightness, contrast and saturation.
fn recolor(image: &mut Image, most: f32, draws: &mut Draws) {
    let (add, contrast, saturation) = (draws.symmetric(most), 1.0 + draws.symmetric(most), 1.0 + draws.symmetric(most));
    let mean = image.data.iter().sum::<f32>() / image.data.len().max(1) as f32;
    for p in image.data.chunks_exact_mut(3) {
        let gray = (p[0] + p[1] + p[2]) / 3.0;
        p.iter_mut().for_each(|v| *v = ((gray + (*v - gray) * saturation - mean) * contrast + mean + add).clamp(0.0, 1.0));
    }
}

/// A random window of `side` pixels of an image of three channels, and the labels in it. Windows are around words that count, and those
/// that cut none are preferred; one of eight is anywhere.
pub fn draw(image: &ImageU8, labels: &[Label], side: usize, config: &AugmentConfig, rng: Rng) -> (Image, Vec<Label>) {
    let mut draws = Draws::new(rng);
    let size = dvec2(image.width as f64, image.height as f64);
    let is_any = draws.below(ANY_WINDOW) == 0;
    let words: Vec<&Label> = labels.iter().filter(|l| !l.ignore && !is_any).collect();
    let mut best: Option<(Window, Vec<Label>, (bool, usize))> = None;
    for _ in 0..TRIES {
        let word = (!words.is_empty()).then(|| words[draws.below(words.len())]);
        let target = word.map(|w| w.polygon.iter().sum::<DVec2>() / w.polygon.len() as f64);
        let window = Window::draw(size, side as f64, target, config, &mut draws);
        let (found, whole, cut) = window.labels(labels, side as f64);
        let fault = (whole == 0, cut);
        if best.as_ref().is_none_or(|b| fault < b.2) {
            best = Some((window, found, fault));
        }
        if is_any || fault == (false, 0) {
            break;
        }
    }
    let (window, found, _) = best.expect("at least one window was drawn");
    let mut picture = window.picture(image, side);
    recolor(&mut picture, config.color, &mut draws);
    (picture, found)
}

#[cfg(test)]
mod tests {
    use super::super::polygon::{contains, tests::rectangle};
    use super::*;

    const STILL: AugmentConfig = AugmentConfig { rotation: 0.0, least_scale: 1.0, most_scale: 1.0, color: 0.0 };

    /// White where a rectangle is, else black.
    fn image(polygon: &[DVec2]) -> ImageU8 {
        let inside = |i: usize| contains(polygon, dvec2((i % 200) as f64 + 0.5, (i / 200) as f64 + 0.5)) as u8 * 255;
        ImageU8 { width: 200, height: 150, channels: 3, data: (0..200 * 150).flat_map(|i| [inside(i); 3]).collect() }
    }

    #[test]
    fn outlines_follow_the_pixels() {
        let polygon = rectangle(70.0, 60.0, 50.0, 20.0);
        let (image, label) = (image(&polygon), Label { polygon, ignore: false, cluster: Some(3) });
        let config = AugmentConfig { rotation: 0.6, least_scale: 0.4, most_scale: 1.5, color: 0.0 };
        for i in 0..40 {
            let (picture, found) = draw(&image, std::slice::from_ref(&label), 128, &config, Rng::new(5, i));
            assert_eq!((picture.width, picture.height, picture.channels), (128, 128, 3));
            for l in &found {
                assert_eq!(l.cluster, Some(3));
                // Pixels well inside are white, pixels just outside are not.
                let off = |p: DVec2| super::super::polygon::boundary_distance(&l.polygon, p);
                for at in 0..128 * 128 {
                    let p = dvec2((at % 128) as f64 + 0.5, (at / 128) as f64 + 0.5);
                    if off(p) > 2.0 {
                        let is_white = picture.data[3 * at] > 0.9;
                        assert_eq!(is_white, contains(&l.polygon, p), "sample {i} at {p}");
                    }
                }
            }
        }
    }

    #[test]
    fn what_a_window_cuts_is_ignored_and_whole_writing_is_preferred() {
        let label = Label { polygon: rectangle(20.0, 10.0, 40.0, 20.0), ignore: false, cluster: None };
        let window = Window { turn: DMat2::IDENTITY, shift: dvec2(-40.0, 0.0) };
        let (found, whole, cut) = window.labels(std::slice::from_ref(&label), 64.0);
        assert!(found[0].ignore && (whole, cut) == (0, 1));
        assert!(Window { shift: dvec2(-59.5, 0.0), ..window }.labels(std::slice::from_ref(&label), 64.0).0.is_empty());
        let image = image(&label.polygon);
        let is_whole = |i: u64| draw(&image, std::slice::from_ref(&label), 64, &STILL, Rng::new(1, i)).1.iter().any(|l| !l.ignore);
        assert!((0..100).filter(|i| is_whole(*i)).count() > 75);
    }

    #[test]
    fn samples_repeat_and_small_images_are_surrounded() {
        let label = Label { polygon: rectangle(20.0, 10.0, 40.0, 20.0), ignore: false, cluster: None };
        let config = AugmentConfig { rotation: 0.2, least_scale: 0.5, most_scale: 2.0, color: 0.3 };
        let image = image(&label.polygon);
        let of = |i: u64| draw(&image, std::slice::from_ref(&label), 96, &config, Rng::new(9, i));
        assert_eq!(of(4), of(4));
        assert_ne!(of(4), of(5));
        let (picture, _) = draw(&image, &[], 256, &STILL, Rng::new(2, 2));
        let empty = picture.data.chunks_exact(3).filter(|p| **p == EMPTY).count();
        assert_eq!(empty, 256 * 256 - 200 * 150);
    }
}
