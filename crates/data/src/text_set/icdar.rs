//! The formats of ICDAR's challenges, a file per image and a line per word: ICDAR 2013, ICDAR 2015 and MLT 2017.
//!
//! Their evaluation wants integers in the image and clockwise corners. Corners are rounded to the nearest integer; a word that has no
//! area then (thinner than a pixel) is left out. Images without words have an empty file, as the evaluation wants one for each.

use super::geometry::{bounds, crossing, signed_area};
use super::{SetFormat, SetImage, SetWord, put};
use crate::error::Result;
use crate::text_labels::UNREADABLE;
use rayon::prelude::*;
use std::path::Path;

/// Writes `gt_NAME.txt` of each image into the format's folder.
pub fn write(folder: &Path, images: &[SetImage], format: SetFormat) -> Result<()> {
    images.par_iter().try_for_each(|image| {
        let lines: String = image.words.iter().filter_map(|w| line(image, w, format)).collect();
        put(folder, &format!("{}/gt_{}.txt", format.name(), image.stem()), lines.as_bytes())
    })
}

/// The line of a word, if its corners enclose an area as integers.
fn line(image: &SetImage, word: &SetWord, format: SetFormat) -> Option<String> {
    let text = line_text(word);
    if format == SetFormat::Icdar13 {
        // Readers end the text at the last quotation mark, so quotation marks in it stay as they are.
        let [left, top, right, bottom] = bounds(&rounded(image, &word.polygon));
        return (left < right && top < bottom).then(|| format!("{left} {top} {right} {bottom} \"{text}\"\n"));
    }
    let quad = rounded(image, &word.quad);
    if !is_quad(&quad) {
        return None;
    }
    let numbers: String = quad.iter().flatten().map(|v| format!("{v},")).collect();
    let script = if format == SetFormat::Mlt17 { format!("{},", script(word)) } else { String::new() };
    // The text is the rest of the line: readers split off a fixed count of fields, so commas in it stay.
    Some(format!("{numbers}{script}{text}\n"))
}

/// Corners as integers inside of the image.
fn rounded(image: &SetImage, points: &[[f64; 2]]) -> Vec<[f64; 2]> {
    image.clamped(points).into_iter().map(|p| p.map(f64::round)).collect()
}

/// Whether four corners differ and enclose an area clockwise.
fn is_quad(quad: &[[f64; 2]]) -> bool {
    let differ = (0..quad.len()).all(|i| !quad[i + 1..].contains(&quad[i]));
    differ && crossing(quad).is_none() && signed_area(quad) > 0.0
}

/// The transcription in one line: breaks of lines and other control characters become spaces.
fn line_text(word: &SetWord) -> String {
    let is_break = |c: char| c.is_control() || matches!(c, '\u{2028}' | '\u{2029}');
    let text: String = word.text().chars().map(|c| if is_break(c) { ' ' } else { c }).collect();
    let text = text.trim();
    if text.is_empty() { UNREADABLE.into() } else { text.into() }
}

/// MLT's name of the word's script; `None` for scripts that it does not know.
fn script(word: &SetWord) -> &'static str {
    match word.script.as_deref().unwrap_or_default() {
        "Latin" => "Latin",
        "Arabic" => "Arabic",
        "Han" | "Chinese" => "Chinese",
        "Hiragana" | "Katakana" | "Japanese" => "Japanese",
        "Hangul" | "Korean" => "Korean",
        "Bengali" | "Bangla" => "Bangla",
        "Devanagari" | "Hindi" => "Hindi",
        "Common" | "Symbols" => "Symbols",
        "Mixed" => "Mixed",
        _ => "None",
    }
}
