//! A region ready for other writing: its ink is found and erased from the frontal views, its light and colors are measured.

use super::super::field::model::TextModel;
use super::super::retouch::{self, Shading, patch_match, telea};
use super::super::surface::Rectangle;
use super::frontal::{self, Frontal};
use crate::error::{PipelineError, Result};
use diorama_geom::Image;
use diorama_geom::color::{linear_from_srgb, luminance, srgb_from_linear};
use diorama_geom::glam::DVec2;

/// Logarithm of albedo by which ink differs from the ground at least, and by how many of the ground's median deviations.
const LEAST_CONTRAST: f32 = 0.2;
const DEVIATIONS: f32 = 5.0;
/// Shares of the region that ink may be; beyond them the whole region is erased.
const INK: [f64; 2] = [0.02, 0.65];
/// Pixels around ink that are erased with it, over the region's height.
const AROUND: f64 = 0.1;
/// Share of the ink, the pixels that differ most from the ground, that tells its color.
const PUREST: f64 = 0.25;
/// Least albedo whose logarithm is taken.
const DARKEST: f32 = 0.005;
/// Colors of ink where there was none, on a bright and on a dark ground.
const DARK: [f32; 3] = [0.02; 3];
const BRIGHT: [f32; 3] = [0.85; 3];
/// Radius of Telea's neighborhood in pixels.
const TELEA_PX: f32 = 5.0;

/// What fills the place of erased ink.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Eraser {
    #[default]
    PatchMatch,
    Telea,
}

impl Eraser {
    /// # Errors
    /// When the name is none.
    pub fn named(name: &str) -> Result<Eraser> {
        match name {
            "patchmatch" => Ok(Eraser::PatchMatch),
            "telea" => Ok(Eraser::Telea),
            other => Err(PipelineError::Usage(format!("--eraser {other:?}: expected patchmatch or telea"))),
        }
    }
}

/// A region without its writing.
pub struct Ground {
    pub frontal: Frontal,
    /// Without ink, linear, of each direction.
    pub erased: Vec<Image>,
    /// Pixels that were erased.
    pub mask: Vec<bool>,
    pub shading: Shading,
    pub ink_linear: [f32; 3],
    /// Blur of the edges of the ink as the sigma of a Gaussian, in pixels; 0 where there was none.
    pub edge_px: f32,
    pub noise: Vec<f32>,
    pub notes: Vec<String>,
}

/// Erases a region.
///
/// # Errors
/// When no photograph shows its front, or there is nothing to fill it with.
pub fn erased(model: &TextModel, rectangle: &Rectangle, eraser: Eraser, seed: u64) -> Result<Ground> {
    let wrong = |what: String| PipelineError::Usage(what);
    let frontal = frontal::frontal(model, rectangle).ok_or_else(|| wrong("no training photograph shows the region's front".into()))?;
    let mut notes = Vec::new();
    let mean = mean(&frontal.views);
    let inside = inside(&frontal, rectangle);
    let found = ink(&mean, &inside, &frontal.known);
    if found.is_whole {
        notes.push("its ink could not be told from the ground: the whole region is erased".into());
    }
    let radius = (AROUND * rectangle.reading_size().y / (frontal.frame[1].y - frontal.frame[0].y) * mean.height as f64).ceil() as usize;
    let mask = dilated(&found.ink, [mean.width, mean.height], radius.max(1));
    let unknown: Vec<bool> = mask.iter().zip(&frontal.known).map(|(m, k)| *m || !k).collect();
    let shading = Shading::fit(&mean, &unknown);
    let unlit: Vec<Image> = frontal.views.iter().map(|v| shading.unlit(&linear(v))).collect();
    let filled = match eraser {
        Eraser::PatchMatch => patch_match::fill(&unlit, &unknown, seed),
        Eraser::Telea => unlit.iter().map(|v| telea::fill(v, &unknown, TELEA_PX)).collect(),
    };
    let filled = filled.map_err(|e| wrong(e.to_string()))?;
    let ink_linear = ink_color(&shading.unlit(&mean), &found, &mask);
    Ok(Ground {
        erased: filled.iter().map(|v| shading.lit(v)).collect(),
        edge_px: if found.is_whole { 0.0 } else { retouch::edge_width(&mean, &found.ink).unwrap_or(0.0) },
        noise: retouch::noise_level(&mean, &unknown),
        frontal,
        mask,
        shading,
        ink_linear,
        notes,
    })
}

/// An image of sRGB values as linear light.
pub fn linear(image: &Image) -> Image {
    Image { data: image.data.iter().map(|v| linear_from_srgb(*v)).collect(), ..image.clone() }
}

/// The inverse.
pub fn encoded(image: &Image) -> Image {
    Image { data: image.data.iter().map(|v| srgb_from_linear(v.clamp(0.0, 1.0))).collect(), ..image.clone() }
}

/// Mean of the views, linear.
fn mean(views: &[Image]) -> Image {
    let mut out = Image::zeros(views[0].width, views[0].height, 3);
    for view in views {
        out.data.iter_mut().zip(&linear(view).data).for_each(|(o, v)| *o += v / views.len() as f32);
    }
    out
}

/// Which pixels are of the region itself, not of its margin.
fn inside(frontal: &Frontal, rectangle: &Rectangle) -> Vec<bool> {
    let ([low, high], [w, h]) = (frontal.frame, frontal.size());
    let half = 0.5 * rectangle.reading_size();
    let at =
        |i: usize| low + DVec2::new((i % w) as f64 + 0.5, h as f64 - (i / w) as f64 - 0.5) / DVec2::new(w as f64, h as f64) * (high - low);
    (0..w * h).map(|i| at(i).abs().cmple(half).all()).collect()
}

/// Pixels of ink.
struct Found {
    ink: Vec<bool>,
    /// Distance of the logarithm of each pixel's albedo from the ground's.
    contrast: Vec<f32>,
    is_whole: bool,
}

/// Finds ink in a region: pixels whose albedo differs from the ground's, which is the median of all.
fn ink(mean: &Image, inside: &[bool], known: &[bool]) -> Found {
    let other: Vec<bool> = inside.iter().zip(known).map(|(i, k)| !(*i && *k)).collect();
    let albedo = Shading::fit(mean, &other).unlit(mean);
    let own: Vec<usize> = (0..other.len()).filter(|i| !other[*i]).collect();
    let log = |i: usize| [0, 1, 2].map(|k| albedo.data[3 * i + k].max(DARKEST).ln());
    let ground = [0, 1, 2].map(|k| median(own.iter().map(|i| log(*i)[k]).collect()));
    let off = |i: usize| (0..3).map(|k| (log(i)[k] - ground[k]).powi(2)).sum::<f32>().sqrt();
    let contrast: Vec<f32> = (0..other.len()).map(off).collect();
    let deviation = median(own.iter().map(|i| contrast[*i]).collect());
    let limit = (DEVIATIONS * deviation).max(LEAST_CONTRAST);
    // The larger the ink's share, the larger the median: half of the strongest contrast is ink in any case.
    let mut sorted: Vec<f32> = own.iter().map(|i| contrast[*i]).collect();
    sorted.sort_by(f32::total_cmp);
    let strongest = sorted.get(sorted.len() * 49 / 50).copied().unwrap_or(0.0);
    let limit = limit.min((0.5 * strongest).max(LEAST_CONTRAST));
    let ink: Vec<bool> = (0..other.len()).map(|i| !other[i] && contrast[i] > limit).collect();
    let share = ink.iter().filter(|v| **v).count() as f64 / own.len().max(1) as f64;
    let is_whole = !(INK[0]..=INK[1]).contains(&share);
    Found { ink: if is_whole { inside.to_vec() } else { ink }, contrast, is_whole }
}

/// Color of the pixels of ink that differ most from the ground; a contrasting one where there is no ink.
fn ink_color(albedo: &Image, found: &Found, mask: &[bool]) -> [f32; 3] {
    let color = |i: usize| [0, 1, 2].map(|k| albedo.data[3 * i + k]);
    if found.is_whole {
        let ground: Vec<f32> = (0..mask.len()).filter(|i| !mask[*i]).map(|i| luminance(color(i).map(f64::from)) as f32).collect();
        return if median(ground) > 0.18 { DARK } else { BRIGHT };
    }
    let mut ink: Vec<usize> = (0..found.ink.len()).filter(|i| found.ink[*i]).collect();
    ink.sort_by(|a, b| found.contrast[*b].total_cmp(&found.contrast[*a]));
    ink.truncate(((PUREST * ink.len() as f64) as usize).max(1));
    [0, 1, 2].map(|k| median(ink.iter().map(|i| color(*i)[k]).collect()))
}

/// 0 of nothing.
fn median(mut values: Vec<f32>) -> f32 {
    values.sort_by(f32::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(0.0)
}

/// Pixels within a distance of those of a mask.
pub fn dilated(mask: &[bool], [w, h]: [usize; 2], radius: usize) -> Vec<bool> {
    let across: Vec<bool> = (0..w * h)
        .map(|i| {
            let (x, y) = (i % w, i / w);
            mask[y * w + x.saturating_sub(radius)..y * w + (x + radius + 1).min(w)].contains(&true)
        })
        .collect();
    (0..w * h)
        .map(|i| (i / w).saturating_sub(radius)..(i / w + radius + 1).min(h))
        .enumerate()
        .map(|(i, rows)| rows.into_iter().any(|y| across[y * w + i % w]))
        .collect()
}
