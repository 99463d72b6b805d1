//! Seasons and climates for the images of a scene (Cui et al. 2024): statistics once per scene and style, then each image by its mask.

use super::super::field::label_maps;
use super::super::styling::style::Style;
use super::super::styling::{self, MaskMode, Moments, Transfer};
use super::scene::{COARSE, SynthScene, coarse_size};
use diorama_engine::renderers::view::View;
use diorama_engine::renderers::volume::Quality;
use diorama_geom::glam::dvec2;
use diorama_geom::rng::Rng;
use diorama_geom::{Camera, Image, Pose};
use diorama_kernels::ops::ray_generation::PosedCamera;
use rayon::prelude::*;

/// Photographs of which the scene's statistics are, evenly spaced.
const PHOTOGRAPHS: usize = 6;
/// Nearest photographs in which a pixel's surface is looked for.
const NEAREST: usize = 16;
/// Pixels along the longer side of the map of text, at least, and those of the image for one of them in large images.
const TEXT_SIDE: u32 = 64;
const TEXT_SHRINK: u32 = 4;
/// Margin around text over the longer side.
const MARGIN: f64 = 1.0 / 80.0;
/// Stream of random numbers of the style that an image takes.
const STYLES: u64 = 84;

/// Looks that images of a scene take.
pub struct Appearance {
    /// Names, and maps from the scene's statistics; none: images stay as they are.
    styles: Vec<(String, Option<Transfer>)>,
    mask: MaskMode,
}

impl Appearance {
    /// Looks of images of a size; none where all stay as they are.
    pub fn new(scene: &SynthScene, size: (u32, u32), styles: &[Style], mask: MaskMode) -> Option<Appearance> {
        if styles.iter().all(|s| s.moments.is_none()) {
            return None;
        }
        let content = Moments::of(&photographs(scene, size)).expect("a scene has training photographs");
        let of = |s: &Style| (s.name.clone(), s.moments.as_ref().map(|m| Transfer::new(&content, m)));
        Some(Appearance { styles: styles.iter().map(of).collect(), mask })
    }

    /// The style of an image and the image in it; none where it stays as it is.
    ///
    /// # Shapes
    /// `view.rgb` `[H, W, 3]`, `glyphs` `[H, W, 1]`, the share of each pixel that is a visible letter; the result `[H, W, 3]` from 0 to 1.
    pub fn changed(&self, scene: &SynthScene, at: (&Camera, &Pose), shown: (&View, &Image), seed: u64) -> Option<(String, Image)> {
        let (view, glyphs) = shown;
        let (name, transfer) = &self.styles[Rng::new(seed, STYLES).below(0, self.styles.len() as u64) as usize];
        let transfer = transfer.as_ref()?;
        let stylized = transfer.stylized(&view.rgb);
        if self.mask == MaskMode::Off {
            let free = Image::zeros(glyphs.width, glyphs.height, 1);
            return Some((name.clone(), styling::blend(&stylized, &stylized, &free)));
        }
        let importance = importance(scene, at, view);
        let text = match self.mask {
            MaskMode::Text => text_share(scene, at, glyphs),
            _ => Image::zeros(glyphs.width, glyphs.height, 1),
        };
        let margin = (MARGIN * glyphs.width.max(glyphs.height) as f64).ceil() as usize;
        let mask = styling::protection(&importance, &text, margin, self.mask);
        Some((name.clone(), styling::blend(&stylized, &transfer.recolored(&view.rgb), &mask)))
    }
}

/// What some of the training photographs show, at the size of the images.
fn photographs(scene: &SynthScene, size: (u32, u32)) -> Vec<Image> {
    let (camera, train) = (scene.camera(size), &scene.model.train);
    let n = train.len().min(PHOTOGRAPHS);
    let shown = |k: usize| {
        let frame = &scene.model.capture.frames[train[(2 * k + 1) * train.len() / (2 * n)]];
        scene.model.tracer(Quality::Fast).view(&scene.posed(&camera, &frame.world_from_camera), &mut |_| ()).rgb
    };
    (0..n).map(shown).collect()
}

/// Importance of each pixel of a view, counted on a coarse copy of it whose pixels are those of the photographs' coarse views.
fn importance(scene: &SynthScene, (camera, pose): (&Camera, &Pose), view: &View) -> Image {
    let coarse = scene.posed(&reduced(camera, COARSE), pose);
    let counts = counts(scene, &coarse, &picked(view, &coarse.camera));
    let of = styling::importance(&counts, coarse.camera.width as usize, coarse.camera.height as usize);
    enlarged(&of, view.rgb.width, view.rgb.height)
}

/// In how many of a coarse view and the photographs nearest to it each of its pixels is seen, by the way there and back.
fn counts(scene: &SynthScene, camera: &PosedCamera, view: &View) -> Vec<u16> {
    let eye = camera.pose.translation;
    let distance = |k: &usize| scene.photographs[*k].1.pose.translation.distance(eye);
    let mut near: Vec<usize> = (0..scene.photographs.len()).collect();
    near.sort_by(|a, b| distance(a).total_cmp(&distance(b)));
    near.truncate(NEAREST);
    let w = view.depth.width;
    let count = |i: usize| {
        let p = dvec2((i % w) as f64 + 0.5, (i / w) as f64 + 0.5);
        let shows = |k: &&usize| {
            let (_, other, seen) = &scene.photographs[**k];
            label_maps::round_trip((camera, view), (other, seen), p).is_some()
        };
        1 + near.iter().filter(shows).count() as u16
    };
    (0..view.depth.data.len()).into_par_iter().map(count).collect()
}

/// Share of each pixel of an image that is text: a region by the field's classes, or a letter that was written.
fn text_share(scene: &SynthScene, (camera, pose): (&Camera, &Pose), glyphs: &Image) -> Image {
    let longer = camera.width.max(camera.height);
    let coarse = scene.posed(&reduced(camera, (longer / TEXT_SHRINK).max(TEXT_SIDE)), pose);
    let Some(tracer) = scene.model.label_tracer(Quality::Fast) else { return glyphs.clone() };
    let shares = tracer.layers(&coarse, &[], &mut |_| ()).values;
    let data = shares.data.chunks_exact(shares.channels).map(|row| row[1..].iter().sum::<f32>().clamp(0.0, 1.0)).collect();
    let regions = Image { width: coarse.camera.width as usize, height: coarse.camera.height as usize, channels: 1, data };
    let mut out = enlarged(&regions, glyphs.width, glyphs.height);
    out.data.iter_mut().zip(&glyphs.data).for_each(|(o, g)| *o = o.max(*g));
    out
}

/// A camera of the same view with at most so many pixels along the longer side.
fn reduced(camera: &Camera, side: u32) -> Camera {
    let [w, h] = coarse_size((camera.width, camera.height), side);
    camera.resized(w, h)
}

/// Depth and opacity of a view at the middles of the pixels of a smaller camera: means would lie between surfaces at their edges.
fn picked(view: &View, camera: &Camera) -> View {
    let (w, h) = (camera.width as usize, camera.height as usize);
    let at = |i: usize| {
        let (x, y) = ((2 * (i % w) + 1) * view.depth.width / (2 * w), (2 * (i / w) + 1) * view.depth.height / (2 * h));
        y * view.depth.width + x
    };
    let layer = |of: &Image| Image { width: w, height: h, channels: 1, data: (0..w * h).map(|i| of.data[at(i)]).collect() };
    View { rgb: Image::zeros(0, 0, 3), opacity: layer(&view.opacity), depth: layer(&view.depth) }
}

/// A map of one channel at a larger size, linear between the middles of its pixels.
fn enlarged(map: &Image, width: usize, height: usize) -> Image {
    let places = |n: usize, of: usize| -> Vec<(usize, usize, f32)> {
        let place = |k: usize| {
            let p = ((k as f32 + 0.5) * of as f32 / n as f32 - 0.5).clamp(0.0, of as f32 - 1.0);
            (p as usize, (p as usize + 1).min(of - 1), p.fract())
        };
        (0..n).map(place).collect()
    };
    let (columns, rows) = (places(width, map.width), places(height, map.height));
    let mix = |a: f32, b: f32, share: f32| a + share * (b - a);
    let value = |(y0, y1, fy): (usize, usize, f32), (x0, x1, fx): (usize, usize, f32)| {
        let across = |y: usize| mix(map.data[y * map.width + x0], map.data[y * map.width + x1], fx);
        mix(across(y0), across(y1), fy)
    };
    let data = rows.iter().flat_map(|y| columns.iter().map(move |x| (*y, *x))).map(|(y, x)| value(y, x)).collect();
    Image { width, height, channels: 1, data }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn maps_are_picked_and_enlarged_at_the_middles_of_pixels() {
        let ramp = |w: usize, h: usize| {
            let data = (0..w * h).map(|i| ((i % w) as f32 + 0.5) / w as f32 + 10.0 * ((i / w) as f32 + 0.5) / h as f32).collect();
            Image { width: w, height: h, channels: 1, data }
        };
        let large = enlarged(&ramp(8, 6), 32, 24);
        let exact = ramp(32, 24);
        for y in 2..22 {
            for x in 2..30 {
                assert!((large.pixel(x, y)[0] - exact.pixel(x, y)[0]).abs() < 1e-5, "{x}, {y}");
            }
        }
        assert_eq!(large.pixel(0, 0), ramp(8, 6).pixel(0, 0));
        let view = View { rgb: Image::zeros(15, 9, 3), opacity: ramp(15, 9), depth: ramp(15, 9) };
        let small = picked(&view, &Camera::pinhole(5, 3, 0.8));
        assert_eq!(small.depth, small.opacity);
        assert!(small.depth.data.iter().zip(&ramp(5, 3).data).all(|(a, b)| (a - b).abs() < 1e-5));
    }
}
