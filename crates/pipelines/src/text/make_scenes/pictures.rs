//! Pictures of boards: words in fonts and colors, and the exact rectangles of their words and characters.

use super::super::lettering::{Bounds, Face, Fonts, Lettering};
use super::super::regions::{Rect, Region};
use super::super::truth::character;
use super::super::words::{NUMBERED, WORDS};
use crate::error::Result;
use diorama_geom::ImageU8;
use diorama_geom::color::{luminance, srgb_from_linear, u8_from_unit};
use diorama_geom::rng::Rng;
use diorama_scenes::signs::Board;

/// Pixels along the longer edge of a picture.
const LONGER: f64 = 1024.0;
/// Shares of a board's width and height that writing may take.
const WIDE: f64 = 0.86;
const HIGH: f64 = 0.7;
/// Size in which writing is measured, in pixels per em.
const MEASURED: f32 = 96.0;
/// Least ratio of the luminances of ink and ground, with 0.05 added to both.
const CONTRAST: f64 = 3.0;
/// Bounds of linear colors: paint is neither darker nor brighter.
const PAINT: [f64; 2] = [0.03, 0.8];
/// Texts that are tried; the one with the largest letters is taken.
const TRIES: u64 = 3;

/// A painted board.
pub struct Painted {
    pub picture: ImageU8,
    /// Share of ink of each pixel of the picture, one channel.
    pub ink: ImageU8,
    pub regions: Vec<Region>,
    pub font: String,
}

/// Paints a board of a number with at most so many words; ids of its regions go on from another.
///
/// # Errors
/// When a font cannot draw a word.
pub fn paint(board: &Board, (k, first_id, words): (usize, usize, usize), fonts: &mut Fonts, faces: &[Face], rng: &Rng) -> Result<Painted> {
    let face = &faces[rng.below(0, faces.len() as u64) as usize];
    let scale = LONGER / board.size.max_element();
    let [w, h] = board.size.to_array().map(|v| (v * scale).round().max(1.0) as usize);
    let room = [WIDE * w as f64, HIGH * h as f64];
    let fitting = |set: &Lettering| (room[0] / set.ink.width as f64).min(room[1] / set.ink.height as f64);
    let mut best: Option<(f64, String)> = None;
    for attempt in 0..TRIES {
        let text = text(rng, 16 * attempt, (w as f64 / h as f64, words));
        let fits = fitting(&fonts.set(&text, face, MEASURED)?);
        if best.as_ref().is_none_or(|b| fits > b.0) {
            best = Some((fits, text));
        }
    }
    let (fits, text) = best.expect("some words");
    let set = fonts.set(&text, face, MEASURED * fits as f32)?;
    let corner = [(w.saturating_sub(set.ink.width)) / 2, (h.saturating_sub(set.ink.height)) / 2];
    let mut ink = ImageU8 { width: w, height: h, channels: 1, data: vec![0; w * h] };
    for (i, v) in set.ink.data.iter().enumerate() {
        let (x, y) = (corner[0] + i % set.ink.width, corner[1] + i / set.ink.width);
        if x < w && y < h {
            ink.data[y * w + x] = *v;
        }
    }
    let rect = |b: Bounds| {
        let at = |x: f32, y: f32| {
            let share = [(corner[0] as f64 + x as f64) / w as f64, (corner[1] as f64 + y as f64) / h as f64];
            [(share[0] - 0.5) * board.size.x, (0.5 - share[1]) * board.size.y]
        };
        let ([x0, y1], [x1, y0]) = (at(b.low[0], b.low[1]), at(b.high[0], b.high[1]));
        Rect { low: [x0, y0], high: [x1, y1] }
    };
    let region = |(n, word): (usize, &super::super::lettering::Piece)| {
        let own = set.characters.iter().filter(|c| word.bytes.contains(&c.bytes.start));
        Region {
            id: first_id + n,
            board: k,
            transcription: word.text.clone(),
            script: "Latin".into(),
            rect: rect(word.bounds),
            characters: own.map(|c| character(&c.text, rect(c.bounds))).collect(),
        }
    };
    let regions = set.words.iter().enumerate().map(region).collect();
    Ok(Painted { picture: colored(&ink, rng), ink, regions, font: face.name() })
}

/// Words for a board of so many times its height, at most so many; a line break where that is low.
fn text(rng: &Rng, at: u64, (ratio, words): (f64, usize)) -> String {
    let word = |k: u64| WORDS[rng.below(100 + at + k, WORDS.len() as u64) as usize].to_string();
    let numbered = words > 1 && rng.uniform(101 + at) < 0.15;
    let first = if numbered { NUMBERED[rng.below(102 + at, NUMBERED.len() as u64) as usize].to_string() } else { word(3) };
    let second = if numbered { (1 + rng.below(104 + at, 98)).to_string() } else { word(5) };
    let line = match (words == 1 || rng.uniform(106 + at) < 0.5, ratio > 2.6) {
        (true, _) if !numbered => first,
        (_, true) => format!("{first} {second}"),
        (_, false) => format!("{first}\n{second}"),
    };
    if rng.uniform(107 + at) < 0.45 { line.to_uppercase() } else { line }
}

/// A linear color of a hue, as saturated and bright as two numbers from 0 to 1 say.
fn color(hue: f64, saturation: f64, value: f64) -> [f64; 3] {
    let channel = |shift: f64| {
        let wave = 0.5 + 0.5 * (std::f64::consts::TAU * (hue + shift)).cos();
        (value * (1.0 - saturation + saturation * wave)).clamp(PAINT[0], PAINT[1])
    };
    [channel(0.0), channel(1.0 / 3.0), channel(2.0 / 3.0)]
}

/// Ink and a border on a ground, in colors that are far enough apart.
fn colored(ink: &ImageU8, rng: &Rng) -> ImageU8 {
    let of = |k: u64| {
        let u = |c: u64| rng.uniform(10 + 4 * k + c) as f64;
        color(u(0), 0.9 * u(1), PAINT[0] + (PAINT[1] - PAINT[0]) * u(2))
    };
    let contrast = |a: [f64; 3], b: [f64; 3]| {
        let [a, b] = [a, b].map(|c| luminance(c) + 0.05);
        (a / b).max(b / a)
    };
    let ground = of(0);
    let plain = if luminance(ground) > 0.2 { [PAINT[0]; 3] } else { [PAINT[1]; 3] };
    let letters = (1..12).map(of).find(|c| contrast(*c, ground) >= CONTRAST).unwrap_or(plain);
    let has_border = rng.uniform(1) < 0.6;
    let (w, h) = (ink.width, ink.height);
    let (inset, thick) = (h as f64 * 0.04, h as f64 * 0.025);
    let pixel = |i: usize| {
        let (x, y) = ((i % w) as f64 + 0.5, (i / w) as f64 + 0.5);
        let edge = x.min(y).min(w as f64 - x).min(h as f64 - y);
        let border = if has_border && (inset..inset + thick).contains(&edge) { 1.0 } else { 0.0 };
        let share = (ink.data[i] as f64 / 255.0).max(border);
        [0, 1, 2].map(|k| u8_from_unit(srgb_from_linear((ground[k] + share * (letters[k] - ground[k])) as f32)))
    };
    ImageU8 { width: w, height: h, channels: 3, data: (0..w * h).flat_map(pixel).collect() }
}
