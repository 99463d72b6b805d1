//! New writing on the ground of a region.

use super::super::label::in_view::Lettered;
use super::super::lettering::{Bounds, Face, Fonts, Lettering, Piece};
use super::super::retouch::{blur, poisson, with_noise};
use super::super::surface::Rectangle;
use super::ground::{Ground, dilated, encoded};
use super::{Edit, EditedWord};
use crate::error::Result;
use diorama_geom::Image;
use diorama_geom::glam::{DVec2, dvec2};
use serde::{Deserialize, Serialize};

/// Size in which writing is measured, in pixels per em.
const MEASURED: f32 = 96.0;
/// Coverage from which a pixel is written on.
const WRITTEN: f32 = 0.004;
/// Pixels over which the replaced part fades out.
const FEATHER_PX: usize = 2;
/// Largest blur of new edges over the height of the region.
const SOFTEST: f64 = 0.05;

/// How new writing is joined to the surface.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Blend {
    #[default]
    Alpha,
    /// Mixed gradients.
    Poisson,
}

/// What to write.
#[derive(Clone, Debug)]
pub struct Writing<'a> {
    /// Empty: the region is erased.
    pub text: &'a str,
    pub face: &'a Face,
    pub blend: Blend,
    /// Linear; none: that of the ink that was there.
    pub color: Option<[f32; 3]>,
    pub seed: u64,
}

/// Writes on a region of an id.
///
/// # Errors
/// When no font has a character of the text.
pub fn written(id: u32, ground: &Ground, rectangle: &Rectangle, fonts: &mut Fonts, writing: &Writing) -> Result<Edit> {
    let [w, h] = ground.frontal.size();
    let set = if writing.text.is_empty() { None } else { Some(placed(ground, rectangle, fonts, writing)?) };
    let soft = (SOFTEST * rectangle.reading_size().y / texel(ground)) as f32;
    let glyphs = set.as_ref().map_or(Image::zeros(w, h, 1), |s| blur(&s.ink, ground.edge_px.min(soft)));
    let colors = (0..ground.erased.len()).map(|k| colored(ground, k, &glyphs, writing)).collect();
    let touched: Vec<bool> = glyphs.data.iter().zip(&ground.mask).map(|(g, m)| *g > WRITTEN || *m).collect();
    let replaced = faded(&touched, [w, h]);
    let shares = replaced.iter().zip(&glyphs.data).flat_map(|(a, g)| [*a, *g]).collect();
    Ok(Edit {
        region: id,
        text: writing.text.into(),
        font: writing.face.name(),
        blend: writing.blend,
        words: set.map(|s| s.words).unwrap_or_default(),
        frame: ground.frontal.frame.map(|p| p.to_array()),
        directions: ground.frontal.directions.clone(),
        colors,
        shares: Image { width: w, height: h, channels: 2, data: shares },
    })
}

/// Length of a pixel of the frontal views.
fn texel(ground: &Ground) -> f64 {
    let [low, high] = ground.frontal.frame;
    (high.x - low.x) / ground.frontal.size()[0] as f64
}

/// Writing in the place of the region: coverage in pixels of the frontal views, and its words.
struct Set {
    ink: Image,
    words: Vec<EditedWord>,
}

/// Sets text as large as fits the region, in its middle.
fn placed(ground: &Ground, rectangle: &Rectangle, fonts: &mut Fonts, writing: &Writing) -> Result<Set> {
    let ([w, h], texel) = (ground.frontal.size(), texel(ground));
    let room = rectangle.reading_size() / texel;
    let first = fonts.set(writing.text, writing.face, MEASURED)?;
    let fits = (room.x / first.ink.width as f64).min(room.y / first.ink.height as f64);
    let set = fonts.set(writing.text, writing.face, (MEASURED as f64 * fits) as f32)?;
    let corner = [(w as i64 - set.ink.width as i64) / 2, (h as i64 - set.ink.height as i64) / 2];
    let mut ink = Image::zeros(w, h, 1);
    for (i, v) in set.ink.data.iter().enumerate() {
        let (x, y) = (corner[0] + (i % set.ink.width) as i64, corner[1] + (i / set.ink.width) as i64);
        if (0..w as i64).contains(&x) && (0..h as i64).contains(&y) {
            ink.data[y as usize * w + x as usize] = *v as f32 / 255.0;
        }
    }
    let [low, high] = ground.frontal.frame;
    let at = |x: f32, y: f32| {
        let share = dvec2((corner[0] as f64 + x as f64) / w as f64, 1.0 - (corner[1] as f64 + y as f64) / h as f64);
        low + share * (high - low)
    };
    let bounds = |b: &Bounds| -> [DVec2; 2] { [at(b.low[0], b.high[1]), at(b.high[0], b.low[1])] };
    Ok(Set { ink, words: words(&set, &bounds) })
}

fn words(set: &Lettering, bounds: &dyn Fn(&Bounds) -> [DVec2; 2]) -> Vec<EditedWord> {
    let lettered = |p: &Piece| Lettered { text: p.text.clone(), bounds: bounds(&p.bounds) };
    let word = |w: &Piece| EditedWord {
        whole: lettered(w),
        characters: set.characters.iter().filter(|c| w.bytes.contains(&c.bytes.start)).map(lettered).collect(),
    };
    set.words.iter().map(word).collect()
}

/// The region from one direction with the writing, sRGB.
fn colored(ground: &Ground, k: usize, glyphs: &Image, writing: &Writing) -> Image {
    let (w, h) = (glyphs.width, glyphs.height);
    let ink = writing.color.unwrap_or(ground.ink_linear);
    let flat = Image { width: w, height: h, channels: 3, data: ink.repeat(w * h) };
    let lit = ground.shading.lit(&flat);
    let mut out = ground.erased[k].clone();
    for (i, share) in glyphs.data.iter().enumerate() {
        for c in 0..3 {
            let v = &mut out.data[3 * i + c];
            *v += share * (lit.data[3 * i + c] - *v);
        }
    }
    let out = encoded(&with_noise(&out, &ground.noise, writing.seed));
    match writing.blend {
        Blend::Alpha => out,
        Blend::Poisson => poisson::blend(&out, &encoded(&ground.erased[k]), poisson::Gradients::Mixed),
    }
}

/// 1 in a mask, and falling to 0 over [`FEATHER_PX`] pixels around it.
fn faded(mask: &[bool], size: [usize; 2]) -> Vec<f32> {
    let mut out: Vec<f32> = mask.iter().map(|m| *m as u8 as f32).collect();
    let mut grown = mask.to_vec();
    for k in 1..=FEATHER_PX {
        grown = dilated(&grown, size, 1);
        let share = 1.0 - k as f32 / (FEATHER_PX + 1) as f32;
        out.iter_mut().zip(&grown).filter(|(o, g)| **g && **o == 0.0).for_each(|(o, _)| *o = share);
    }
    out
}
