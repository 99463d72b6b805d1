//! The mask that keeps structure: importance falls with how often a place is seen, and text is important wherever it is (Cui et al. 2024).

use crate::text::retouch::blur;
use diorama_geom::Image;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// Percentiles of importance that become 0 and 1.
const PERCENTILES: [f64; 2] = [0.05, 0.95];
/// Blur of the importance over the image's width.
const SMOOTHING: f32 = 1.0 / 160.0;

/// Which places keep their detail.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MaskMode {
    /// Rarely seen ones, and text.
    #[default]
    Text,
    /// Rarely seen ones, as published.
    Paper,
    /// None.
    Off,
}

impl MaskMode {
    /// The mode of a name: text, paper or off.
    pub fn named(name: &str) -> Option<MaskMode> {
        [("text", MaskMode::Text), ("paper", MaskMode::Paper), ("off", MaskMode::Off)].into_iter().find(|m| m.0 == name).map(|m| m.1)
    }
}

/// Importance of each pixel: 1/n, scaled by its 5th and 95th percentiles and smoothed; 0 where all counts are alike.
///
/// # Shapes
/// `counts` `[H, W]`, how many cameras see the pixel's surface, itself counted; the result `[H, W, 1]` from 0 to 1.
///
/// # Panics
/// When `counts` does not have as many values as the size.
pub fn importance(counts: &[u16], width: usize, height: usize) -> Image {
    assert_eq!(counts.len(), width * height, "the counts do not have the size of the image");
    let inverse: Vec<f32> = counts.iter().map(|n| 1.0 / (*n).max(1) as f32).collect();
    let mut ordered = inverse.clone();
    let mut at = |share: f64| {
        let k = (share * ordered.len().saturating_sub(1) as f64).round() as usize;
        if ordered.is_empty() { 0.0 } else { *ordered.select_nth_unstable_by(k, f32::total_cmp).1 }
    };
    let [low, high] = [at(PERCENTILES[0]), at(PERCENTILES[1])];
    let scaled = |v: &f32| if high > low { ((v - low) / (high - low)).clamp(0.0, 1.0) } else { 0.0 };
    let image = Image { width, height, channels: 1, data: inverse.iter().map(scaled).collect() };
    blur(&image, SMOOTHING * width as f32)
}

/// Largest value within a square of a radius, then blurred by half the radius, but nowhere below the values themselves.
///
/// # Shapes
/// `text` and the result `[H, W, 1]`.
pub fn dilated(text: &Image, radius_px: usize) -> Image {
    let (width, height) = (text.width, text.height);
    let near = |k: usize, n: usize| k.saturating_sub(radius_px)..(k + radius_px + 1).min(n);
    let row = |y: usize| &text.data[y * width..][..width];
    let across = |i: usize| row(i / width)[near(i % width, width)].iter().copied().fold(f32::NEG_INFINITY, f32::max);
    let across: Vec<f32> = (0..width * height).into_par_iter().map(across).collect();
    let both = |i: usize| near(i / width, height).map(|y| across[y * width + i % width]).fold(f32::NEG_INFINITY, f32::max);
    let both = (0..width * height).into_par_iter().map(both).collect();
    let mut out = blur(&Image { width, height, channels: 1, data: both }, 0.5 * radius_px as f32);
    out.data.iter_mut().zip(&text.data).for_each(|(o, t)| *o = o.max(*t));
    out
}

/// The mask `m = max(I, dilate(S_text))`, of one of them alone, or 0, by the mode.
///
/// # Shapes
/// `importance`, `text` (share of text) and the result `[H, W, 1]` from 0 to 1.
///
/// # Panics
/// When sizes differ.
pub fn protection(importance: &Image, text: &Image, radius_px: usize, mode: MaskMode) -> Image {
    assert_eq!(importance.data.len(), text.data.len(), "importance and text have different sizes");
    match mode {
        MaskMode::Text => {
            let mut out = dilated(text, radius_px);
            out.data.iter_mut().zip(&importance.data).for_each(|(m, i)| *m = m.max(*i));
            out
        }
        MaskMode::Paper => importance.clone(),
        MaskMode::Off => Image::zeros(importance.width, importance.height, 1),
    }
}

/// `(1 − m)·stylized + m·recolored`, limited to 0 to 1.
///
/// # Shapes
/// `stylized`, `recolored` and the result `[H, W, 3]`, `mask` `[H, W, 1]`.
///
/// # Panics
/// When sizes differ.
pub fn blend(stylized: &Image, recolored: &Image, mask: &Image) -> Image {
    assert_eq!(stylized.data.len(), recolored.data.len(), "the two images have different sizes");
    assert_eq!(stylized.data.len(), mask.data.len() * stylized.channels, "the mask does not have the size of the image");
    let channels = stylized.channels;
    let mut out = stylized.clone();
    out.data.par_iter_mut().zip(&recolored.data).enumerate().for_each(|(i, (color, kept))| {
        let m = mask.data[i / channels];
        *color = ((1.0 - m) * *color + m * kept).clamp(0.0, 1.0);
    });
    out
}
