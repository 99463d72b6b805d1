//! One view: its render, its photograph, and how far they are apart.

use super::model::ObjectModel;
use crate::error::Result;
use diorama_data::masks;
use diorama_data::photo::Photo;
use diorama_engine::metrics::{self, ImageScores};
use diorama_engine::renderers::volume::{Quality, View};
use diorama_geom::{Image, ImageU8};
use diorama_kernels::ops::photometric_loss::shown;

/// One view's render and scores.
pub struct ScoredView {
    pub view: View,
    pub photo: Image,
    /// 255 where pixels count; none: all do.
    pub counts: Option<ImageU8>,
    /// Not numbers where no pixel counts.
    pub scores: ImageScores,
}

/// What an evaluation does to a view.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Doing {
    Drawing,
    Scoring,
    PerceptualDistance,
}

impl Doing {
    pub fn name(self) -> &'static str {
        match self {
            Doing::Drawing => "drawing",
            Doing::Scoring => "scoring",
            Doing::PerceptualDistance => "perceptual distance",
        }
    }
}

/// A photograph at the run's resolution, transparent pixels on the model's backdrop: sRGB up to white.
fn reference_photo(model: &ObjectModel, full: &Photo) -> Image {
    let (w, h) = full.size();
    let (w, h) = model.config.reduction().size((w as u32, h as u32));
    let small = full.downsampled(w as usize, h as usize);
    // What a field of linear light was trained on is blended there, too.
    let (small, is_linear) = match small {
        Photo::Linear(mut im) if model.is_linear() => {
            let white = model.config.data.white;
            im.data.chunks_exact_mut(im.channels).for_each(|p| p.iter_mut().take(3).for_each(|v| *v /= white));
            (im, true)
        }
        other => (other.into_srgb(), false),
    };
    let back = model.backdrop_color();
    let mut out = Image::zeros(small.width, small.height, 3);
    for (o, p) in out.data.chunks_exact_mut(3).zip(small.data.chunks_exact(small.channels)) {
        let a = if small.channels == 4 { p[3] } else { 1.0 };
        for k in 0..3 {
            let v = p[k.min(small.channels - 1)] * a + back[k] * (1.0 - a);
            o[k] = if is_linear { shown(v) } else { v.clamp(0.0, 1.0) };
        }
    }
    out
}

/// What frame `i`'s render is compared with, and the mask of the pixels that count, where there is one.
pub(crate) fn reference(model: &ObjectModel, i: usize, full: Photo) -> Result<(Image, Option<ImageU8>)> {
    let (full, mask) = masks::apply(&model.capture.frames[i], &model.capture.masks, full)?;
    let photo = reference_photo(model, &full);
    let counts = mask.map(|m| m.downsampled(photo.width, photo.height));
    Ok((photo, counts))
}

/// Renders frame `i` and scores it against `full`, its photograph at full size, where its mask says that pixels count.
/// `progress` receives the share that is drawn, and when scoring begins.
///
/// # Errors
/// When the mask cannot be decoded, or is not that of the photograph; or when the device that was named failed.
pub fn score_view(
    model: &ObjectModel,
    i: usize,
    full: Photo,
    quality: Quality,
    progress: &mut dyn FnMut(f64, Doing),
) -> Result<ScoredView> {
    let (photo, counts) = reference(model, i, full)?;
    let (mut rows, all) = (0, photo.height.max(1));
    progress(0.0, Doing::Drawing);
    let view = model.tracer(quality).view(&model.posed(i), &mut |more| {
        rows = (rows + more).min(all);
        progress(rows as f64 / all as f64, Doing::Drawing);
    });
    model.check_device()?;
    progress(1.0, Doing::Scoring);
    let scores = scores(&view, &photo, &counts);
    Ok(ScoredView { view, photo, counts, scores })
}

/// Scores of a view against its reference.
pub(crate) fn scores(view: &View, photo: &Image, counts: &Option<ImageU8>) -> ImageScores {
    let mut shown = view.rgb.clone();
    shown.data.iter_mut().for_each(|v| *v = v.clamp(0.0, 1.0));
    metrics::compare(&shown, photo, admits(counts))
}

/// Whether a pixel counts.
pub(super) fn admits(counts: &Option<ImageU8>) -> impl Fn(usize, usize) -> bool + Sync {
    move |x, y| counts.as_ref().is_none_or(|m| m.pixel(x, y)[0] >= masks::COUNTS)
}

/// The render, with the photograph where pixels do not count.
pub(super) fn where_it_counts(scored: &ScoredView) -> Image {
    let mut out = scored.view.rgb.clone();
    let counts = admits(&scored.counts);
    let width = out.width;
    for (i, (o, p)) in out.data.chunks_exact_mut(3).zip(scored.photo.data.chunks_exact(3)).enumerate() {
        if !counts(i % width, i / width) {
            o.copy_from_slice(p);
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_perceptual_distance_sees_the_photograph_where_pixels_do_not_count() {
        let image = |data: &[f32]| Image { width: 2, height: 1, channels: 3, data: data.to_vec() };
        let none = Image::zeros(2, 1, 1);
        let mask = ImageU8 { width: 2, height: 1, channels: 1, data: vec![255, 0] };
        let mut scored = ScoredView {
            view: View { rgb: image(&[0.1, 0.2, 0.3, 0.4, 0.5, 0.6]), opacity: none.clone(), depth: none },
            photo: image(&[0.9; 6]),
            counts: Some(mask),
            scores: ImageScores { mse: 0.0, psnr: 0.0, ssim: 0.0, psnr_affine: 0.0 },
        };
        assert_eq!(where_it_counts(&scored).data, [0.1, 0.2, 0.3, 0.9, 0.9, 0.9]);
        scored.counts = None;
        assert_eq!(where_it_counts(&scored), scored.view.rgb);
    }
}
