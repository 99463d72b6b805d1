//! Words pasted onto photographs, like SynthText (Gupta et al. 2016) without depth: random words, fonts, sizes, rotations and colors, in
//! places of even color or anywhere. Cameras and surfaces play no part.

use crate::error::{PipelineError, Result};
use crate::text::detectors::polygon::intersection_area;
use crate::text::edit::ground::{dilated, encoded, linear};
use crate::text::lettering::{Face, Fonts, Lettering};
use crate::text::retouch::telea;
use crate::text::words::WORDS;
use diorama_data::text_set::{SetImage, SetWord};
use diorama_geom::color::{linear_from_srgb, luminance};
use diorama_geom::glam::{DMat2, DVec2, dvec2};
use diorama_geom::rng::Rng;
use diorama_geom::{Camera, Image, ImageU8, Pose};

/// Most words of an image.
const MOST_WORDS: u64 = 4;
/// Heights of words: least in pixels, as for labels that are to be read, and greatest over the image's height.
const LEAST_PX: f64 = 8.5;
const GREATEST: f64 = 0.3;
/// Share of the image's width that a word may take.
const WIDE: f64 = 0.9;
/// Largest rotation in radians.
const TURNED: f64 = 0.6;
/// Places that are tried, and share of the words that take the one of most even color, others the first.
const PLACES: u64 = 24;
const EVEN: f32 = 0.75;
/// Pixels between words, and between words and the border.
const APART_PX: f64 = 2.0;
/// Colors that are tried, and least ratio of the luminances of word and ground, with 0.05 added to both.
const COLORS: u64 = 12;
const CONTRAST: f64 = 2.0;
/// Sizes at which words are measured, in pixels per em, and pixels of their ink per pixel of the image.
const MEASURED: f32 = 96.0;
const FINE: f64 = 2.0;
/// Samples of a pixel along an axis.
const SAMPLES: usize = 3;
/// Pixels around ink that are erased with it.
const ERASED_PX: usize = 2;
/// Stream of random numbers, and those of a word.
const STREAM: u64 = 97;
const PER_WORD: u64 = 1000;

/// A photograph without its writing.
pub struct Ground {
    pub scene: String,
    pub picture: ImageU8,
    pub camera: Camera,
    pub world_from_camera: Pose,
}

/// An image with pasted words.
pub struct Pasted {
    pub picture: ImageU8,
    pub words: Vec<SetWord>,
    /// Share of each pixel that each word covers.
    #[cfg(test)]
    pub covers: Vec<Image>,
}

/// A photograph whose ink is filled from its surroundings (Telea 2004).
///
/// # Shapes
/// `photograph` `[H, W, 3]`, `ink` `[H, W, 1]`.
///
/// # Errors
/// When they differ in size, or ink is everywhere.
pub fn erased(photograph: &ImageU8, ink: &ImageU8) -> Result<ImageU8> {
    if (photograph.channels, ink.channels) != (3, 1) || (photograph.width, photograph.height) != (ink.width, ink.height) {
        let of = |i: &ImageU8| format!("{}×{}×{}", i.width, i.height, i.channels);
        let what = format!("a photograph of {} and ink of {}: expected colors and one channel of one size", of(photograph), of(ink));
        return Err(PipelineError::Usage(what));
    }
    let inked: Vec<bool> = ink.data.iter().map(|v| *v > 0).collect();
    let mask = dilated(&inked, [ink.width, ink.height], ERASED_PX);
    let filled = telea::fill(&linear(&photograph.to_f32()), &mask, telea::RADIUS_PX).map_err(|e| PipelineError::Usage(e.to_string()))?;
    Ok(encoded(&filled).to_u8())
}

/// A word at a place: its ink, its middle and its turn.
struct Placed {
    text: String,
    ink: ImageU8,
    /// Bounds of the word in the ink's pixels.
    low: DVec2,
    high: DVec2,
    middle: DVec2,
    turn: DMat2,
}

impl Placed {
    /// A place in the image of one in the ink.
    fn point(&self, at: DVec2) -> DVec2 {
        self.middle + self.turn * ((at - 0.5 * (self.low + self.high)) / FINE)
    }

    /// Corners clockwise from the upper left in reading order, so many pixels around the word.
    fn quad(&self, around: f64) -> [DVec2; 4] {
        let (low, high) = (self.low - around * FINE, self.high + around * FINE);
        [low, dvec2(high.x, low.y), high, dvec2(low.x, high.y)].map(|p| self.point(p))
    }

    /// Share of a pixel that is ink.
    fn cover(&self, x: usize, y: usize) -> f32 {
        let of = |k: usize| {
            let step = |v: usize| (v as f64 + 0.5) / SAMPLES as f64;
            let at = dvec2(x as f64 + step(k % SAMPLES), y as f64 + step(k / SAMPLES)) - self.middle;
            level(&self.ink, self.turn.transpose() * at * FINE + 0.5 * (self.low + self.high))
        };
        (0..SAMPLES * SAMPLES).map(of).sum::<f32>() / (SAMPLES * SAMPLES) as f32
    }

    /// Pixels of the box around the word in an image.
    fn pixels(&self, (w, h): (usize, usize)) -> impl Iterator<Item = (usize, usize)> + use<> {
        let quad = self.quad(1.0);
        let bound = |k: usize, most: usize| {
            let of = |f: fn(f64, f64) -> f64| quad.iter().map(|p| p[k]).reduce(f).expect("four corners");
            (of(f64::min).max(0.0) as usize)..(of(f64::max).ceil().max(0.0) as usize).min(most)
        };
        let (xs, ys) = (bound(0, w), bound(1, h));
        ys.flat_map(move |y| xs.clone().map(move |x| (x, y)))
    }
}

/// A gray image from 0 to 1 at a place, bilinear; 0 outside.
fn level(image: &ImageU8, p: DVec2) -> f32 {
    let at = |x: f64, y: f64| {
        let is_in = x >= 0.0 && y >= 0.0 && x < image.width as f64 && y < image.height as f64;
        if is_in { image.data[y as usize * image.width + x as usize] as f32 / 255.0 } else { 0.0 }
    };
    let (x, y) = ((p.x - 0.5).floor(), (p.y - 0.5).floor());
    let (u, v) = ((p.x - 0.5 - x) as f32, (p.y - 0.5 - y) as f32);
    (at(x, y) * (1.0 - u) + at(x + 1.0, y) * u) * (1.0 - v) + (at(x, y + 1.0) * (1.0 - u) + at(x + 1.0, y + 1.0) * u) * v
}

/// Pastes words onto a photograph. The same seed gives the same image.
///
/// # Shapes
/// `ground` `[H, W, 3]`.
///
/// # Errors
/// When a font cannot draw a word.
pub fn paste(ground: &ImageU8, fonts: &mut Fonts, faces: &[Face], seed: u64) -> Result<Pasted> {
    let rng = Rng::new(seed, STREAM);
    let mut light = linear(&ground.to_f32());
    let count = 1 + rng.below(0, MOST_WORDS);
    let mut placed: Vec<Placed> = Vec::new();
    let mut covers = Vec::new();
    for k in 1..=count {
        let Some(word) = place(&light, &placed, fonts, faces, (&rng, PER_WORD * k))? else { continue };
        covers.push(draw(&mut light, &word, (&rng, PER_WORD * k + 500)));
        placed.push(word);
    }
    let words = placed.iter().enumerate().map(|(id, w)| labelled(id, w)).collect();
    Ok(Pasted {
        picture: encoded(&light).to_u8(),
        words,
        #[cfg(test)]
        covers,
    })
}

/// Draws a word, and a place for it that is in the image and free; none where there is no such place.
fn place(light: &Image, others: &[Placed], fonts: &mut Fonts, faces: &[Face], (rng, at): (&Rng, u64)) -> Result<Option<Placed>> {
    let (w, h) = (light.width as f64, light.height as f64);
    let u = |k: u64| rng.uniform(at + k) as f64;
    let word = WORDS[rng.below(at, WORDS.len() as u64) as usize];
    let text = if u(1) < 0.5 { word.to_uppercase() } else { word.to_string() };
    let face = &faces[rng.below(at + 2, faces.len() as u64) as usize];
    let first = fonts.set(&text, face, MEASURED)?;
    let (low, high) = bounds(&first);
    let greatest = (GREATEST * h).max(LEAST_PX);
    let height = LEAST_PX * (greatest / LEAST_PX).powf(u(3));
    let scale = (height / (high.y - low.y)).min(WIDE * w / (high.x - low.x));
    let set = fonts.set(&text, face, (MEASURED as f64 * scale * FINE) as f32)?;
    let (low, high) = bounds(&set);
    if high.y - low.y < FINE * (LEAST_PX - 0.5) {
        return Ok(None);
    }
    let turn = DMat2::from_angle(TURNED * (2.0 * u(4) - 1.0));
    let mut word = Placed { text, ink: set.ink, low, high, middle: DVec2::ZERO, turn };
    let is_even = rng.uniform(at + 5) < EVEN;
    let mut best: Option<(f64, DVec2)> = None;
    for k in 0..PLACES {
        word.middle = dvec2(w * u(10 + 2 * k), h * u(11 + 2 * k));
        let quad = word.quad(APART_PX);
        let is_in = quad.iter().all(|p| p.x >= 0.0 && p.y >= 0.0 && p.x <= w && p.y <= h);
        if !is_in || others.iter().any(|o| intersection_area(&quad, &o.quad(0.0)) > 0.0) {
            continue;
        }
        let unevenness = unevenness(light, &word);
        if best.is_none_or(|b| unevenness < b.0) {
            best = Some((unevenness, word.middle));
        }
        if !is_even {
            break;
        }
    }
    Ok(best.map(|(_, middle)| Placed { middle, ..word }))
}

/// Bounds of the only word of a text in its ink.
fn bounds(set: &Lettering) -> (DVec2, DVec2) {
    let b = &set.words[0].bounds;
    (dvec2(b.low[0] as f64, b.low[1] as f64), dvec2(b.high[0] as f64, b.high[1] as f64))
}

/// Colors of the pixels around a word.
fn surroundings(light: &Image, word: &Placed) -> Vec<[f64; 3]> {
    let color = |(x, y): (usize, usize)| [0, 1, 2].map(|k| light.pixel(x, y)[k] as f64);
    word.pixels((light.width, light.height)).map(color).collect()
}

fn mean(colors: &[[f64; 3]]) -> [f64; 3] {
    [0, 1, 2].map(|k| colors.iter().map(|c| c[k]).sum::<f64>() / colors.len().max(1) as f64)
}

/// Variance of the color around a word.
fn unevenness(light: &Image, word: &Placed) -> f64 {
    let colors = surroundings(light, word);
    let mean = mean(&colors);
    let off = |c: &[f64; 3]| (0..3).map(|k| (c[k] - mean[k]).powi(2)).sum::<f64>();
    colors.iter().map(off).sum::<f64>() / colors.len().max(1) as f64
}

/// Draws a word in a color that differs from the ground's; the share of each pixel that it covers.
fn draw(light: &mut Image, word: &Placed, (rng, at): (&Rng, u64)) -> Image {
    let ground = luminance(mean(&surroundings(light, word))) + 0.05;
    let color = |k: u64| [0, 1, 2].map(|c| linear_from_srgb(rng.uniform(at + 3 * k + c)));
    let contrast = |c: &[f32; 3]| {
        let own = luminance(c.map(f64::from)) + 0.05;
        (own / ground).max(ground / own)
    };
    let plain = if ground > 0.23 { [0.0; 3] } else { [1.0; 3] };
    let color = (0..COLORS).map(color).find(|c| contrast(c) >= CONTRAST).unwrap_or(plain);
    let mut covers = Image::zeros(light.width, light.height, 1);
    for (x, y) in word.pixels((light.width, light.height)) {
        let i = y * light.width + x;
        let cover = word.cover(x, y);
        covers.data[i] = cover;
        for c in 0..3 {
            let v = &mut light.data[3 * i + c];
            *v += cover * (color[c] - *v);
        }
    }
    covers
}

fn labelled(id: usize, word: &Placed) -> SetWord {
    let quad = word.quad(0.0).map(|p| p.to_array());
    SetWord {
        id: id as u32,
        quad,
        polygon: quad.to_vec(),
        transcription: word.text.clone(),
        script: Some("Latin".into()),
        ignore: false,
        visibility: 1.0,
        pose: None,
        cluster: None,
        characters: Vec::new(),
    }
}

/// Record of an image with words on a ground.
pub fn record(name: &str, ground: &Ground, words: Vec<SetWord>, seed: u64) -> SetImage {
    let (c, r, t) = (&ground.camera, &ground.world_from_camera.rotation, ground.world_from_camera.translation);
    SetImage {
        image: format!("images/{name}.png"),
        width: c.width,
        height: c.height,
        intrinsic: [c.fx, c.fy, c.cx, c.cy],
        world_from_camera: std::array::from_fn(|k| [r.x_axis[k], r.y_axis[k], r.z_axis[k], t[k]]),
        scene: ground.scene.clone(),
        style: None,
        seed: Some(seed),
        words,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::text::detectors::polygon::{boundary_distance, contains};

    const SIZE: (usize, usize) = (160, 120);
    /// Share from which a pixel is seen as ink.
    const INKED: f32 = 0.3;

    fn gray(value: u8) -> ImageU8 {
        ImageU8 { width: SIZE.0, height: SIZE.1, channels: 3, data: vec![value; 3 * SIZE.0 * SIZE.1] }
    }

    fn pasted(ground: &ImageU8, seed: u64) -> Pasted {
        let mut fonts = Fonts::shipped();
        let faces = fonts.latin();
        paste(ground, &mut fonts, &faces, seed).unwrap()
    }

    #[test]
    fn labels_are_the_bounds_of_their_glyphs_pixels() {
        let mut words = 0;
        for seed in 0..12 {
            let image = pasted(&gray(120), seed);
            for (word, cover) in image.words.iter().zip(&image.covers) {
                let quad = word.quad.map(DVec2::from);
                let inked: Vec<DVec2> = (0..SIZE.0 * SIZE.1)
                    .filter(|i| cover.data[*i] > INKED)
                    .map(|i| dvec2((i % SIZE.0) as f64 + 0.5, (i / SIZE.0) as f64 + 0.5))
                    .collect();
                let is_own = |p: &DVec2| contains(&quad, *p) || boundary_distance(&quad, *p) < 0.75;
                assert!(inked.iter().all(is_own), "seed {seed}, {}: ink outside of its label", word.transcription);
                for k in 0..4 {
                    let (a, b) = (quad[k], quad[(k + 1) % 4]);
                    let inward = (b - a).perp().normalize();
                    let nearest = inked.iter().map(|p| inward.dot(*p - a)).fold(f64::INFINITY, f64::min);
                    assert!(nearest.abs() < 1.5, "seed {seed}, {}: no ink within 1.5 px of side {k}: {nearest}", word.transcription);
                }
                // The picture changes where there is ink, and there alone.
                let off = |i: usize| (image.picture.data[3 * i + 1] as i32 - 120).abs() > 2;
                let touched = |i: &usize| image.covers.iter().any(|c| c.data[*i] > 0.0);
                assert!((0..cover.data.len()).filter(|i| off(*i)).all(|i| touched(&i)));
                words += 1;
            }
        }
        assert!(words >= 20, "{words}");
    }

    #[test]
    fn the_same_seed_gives_the_same_image_and_words_do_not_meet() {
        let (a, b, c) = (pasted(&gray(90), 5), pasted(&gray(90), 5), pasted(&gray(90), 6));
        assert!(a.picture == b.picture && a.words == b.words);
        assert!(a.picture != c.picture);
        for seed in 0..8 {
            let words = pasted(&gray(90), seed).words;
            for (i, a) in words.iter().enumerate() {
                let quad = a.quad.map(DVec2::from);
                assert!(words[..i].iter().all(|b| intersection_area(&quad, &b.quad.map(DVec2::from)) == 0.0), "seed {seed}");
                let sides = [0, 1].map(|k| quad[k].distance(quad[k + 1]));
                assert!(sides[0].min(sides[1]) >= 8.0, "readable: {sides:?}");
            }
        }
    }

    #[test]
    fn words_prefer_places_of_even_color() {
        // The right half is a board of single pixels.
        let mut ground = gray(100);
        for (i, p) in ground.data.chunks_exact_mut(3).enumerate() {
            if i % SIZE.0 >= 80 {
                p.fill(if (i % SIZE.0 + i / SIZE.0).is_multiple_of(2) { 0 } else { 255 });
            }
        }
        let first = |seed: u64| pasted(&ground, seed).words.first().map(|w| w.quad.iter().map(|p| p[0]).sum::<f64>() / 4.0);
        let middles: Vec<f64> = (0..24).filter_map(first).collect();
        let left = middles.iter().filter(|x| **x < 80.0).count();
        assert!(left * 10 > middles.len() * 6 && left < middles.len(), "{left} of {}", middles.len());
    }

    #[test]
    fn erasing_leaves_the_ground() {
        let mut photograph = gray(150);
        let mut ink = ImageU8 { width: SIZE.0, height: SIZE.1, channels: 1, data: vec![0; SIZE.0 * SIZE.1] };
        for i in (0..ink.data.len()).filter(|i| (40..90).contains(&(i % SIZE.0)) && (50..60).contains(&(i / SIZE.0))) {
            ink.data[i] = 255;
            photograph.data[3 * i..3 * i + 3].fill(10);
        }
        let out = erased(&photograph, &ink).unwrap();
        assert!(out.data.iter().all(|v| v.abs_diff(150) <= 1));
        ink.data.fill(255);
        assert!(erased(&photograph, &ink).unwrap_err().is_input());
        assert!(erased(&photograph, &gray(0)).unwrap_err().to_string().contains("160×120×3"), "ink has one channel");
    }
}
