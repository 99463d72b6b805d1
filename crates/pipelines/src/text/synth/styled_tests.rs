//! Data sets of a trained scene with and without styles.

use super::super::styling::MaskMode;
use super::dataset::{self, Synthesized};
use super::journal::glyphs;
use super::plan::{Scenes, Shard, SynthOptions};
use crate::error::Result;
use diorama_data::{photo, text_set};
use diorama_engine::metrics;
use diorama_geom::Image;
use std::path::Path;
use std::sync::atomic::AtomicBool;

static ON: AtomicBool = AtomicBool::new(false);

/// Least share of a pixel from which it belongs to a letter, and pixels around an edge between letter and ground.
const LETTER: f32 = 0.5;
const AROUND: usize = 1;

fn set(out: &Path, run: &Path, o: &SynthOptions) -> Result<Synthesized> {
    dataset::synthesize(out, (&Scenes::read(run)?, o, Shard::WHOLE), false, &ON, &mut |_, _| ())
}

/// Mean structural similarity of a set's images with those of the plain one, over the edges of letters, after the linear map of each channel
/// that fits best there: a style is to change colors.
fn edge_similarity(set: &Path, plain: &Path) -> f64 {
    let load = |folder: &Path, file: &str| photo::load(&folder.join(file)).unwrap().to_f32();
    let of = |image: &str| {
        let (mut found, wanted, letters) = (load(set, image), load(plain, image), load(plain, &glyphs(image)));
        let at = |i: usize| is_edge(&letters, i % letters.width, i / letters.width);
        let edges: Vec<usize> = (0..letters.data.len()).filter(|i| at(*i)).collect();
        (0..3).for_each(|k| fit(&mut found, &wanted, k, &edges));
        let scores = metrics::compare(&found, &wanted, |x, y| is_edge(&letters, x, y));
        scores.ssim.is_finite().then_some(scores.ssim)
    };
    let all: Vec<f64> = text_set::read(plain).unwrap().iter().filter_map(|i| of(&i.image)).collect();
    assert!(all.len() >= 3, "edges in {} images", all.len());
    all.iter().sum::<f64>() / all.len() as f64
}

/// Maps a channel to what is wanted, least squares over some pixels.
fn fit(found: &mut Image, wanted: &Image, channel: usize, pixels: &[usize]) {
    let mean = |of: &dyn Fn(usize) -> f32| pixels.iter().map(|i| of(3 * i + channel) as f64).sum::<f64>() / pixels.len().max(1) as f64;
    let (from, to) = (mean(&|e| found.data[e]), mean(&|e| wanted.data[e]));
    let product = mean(&|e| found.data[e] * wanted.data[e]) - from * to;
    let square = mean(&|e| found.data[e] * found.data[e]) - from * from;
    let gain = product / square.max(1e-9);
    found.data.iter_mut().skip(channel).step_by(3).for_each(|v| *v = (to + gain * (*v as f64 - from)) as f32);
}

/// Whether there are both letters and ground around a pixel.
fn is_edge(letters: &Image, x: usize, y: usize) -> bool {
    let near = |k: usize, n: usize| k.saturating_sub(AROUND)..(k + AROUND + 1).min(n);
    let mut around = near(y, letters.height).flat_map(|y| near(x, letters.width).map(move |x| letters.pixel(x, y)[0] > LETTER));
    let first = around.next();
    around.any(|v| Some(v) != first)
}

/// Styles change pixels and nothing of the labels, and the mask keeps the edges of letters.
pub fn check(dir: &Path, run: &Path, plain: &SynthOptions) {
    let style_file = dir.join("sea.png");
    let blue = |i: usize| if i.is_multiple_of(3) { [20, 60, 120] } else { [60, 140, 200] };
    let data = (0..64 * 48).flat_map(blue).collect();
    photo::save_png(&style_file, &diorama_geom::ImageU8 { width: 64, height: 48, channels: 3, data }).unwrap();
    let styles = vec!["winter".to_string(), style_file.display().to_string()];
    let options = |mask| SynthOptions { styles: styles.clone(), mask, ..plain.clone() };
    let folders = ["plain", "text", "off"].map(|name| dir.join(format!("styles-{name}")));
    let all = [plain.clone(), options(MaskMode::Text), options(MaskMode::Off)];
    let made: Vec<Synthesized> = folders.iter().zip(&all).map(|(f, o)| set(f, run, o).unwrap()).collect();
    assert!((made[0].styled, made[0].styling_share) == (0, 0.0) && made[1].styled == plain.count, "{made:?}");
    let sets = folders.each_ref().map(|f| text_set::read(f).unwrap());
    let drawn: Vec<Option<&str>> = sets[1].iter().map(|i| i.style.as_deref()).collect();
    assert!(["winter", "sea"].iter().all(|s| drawn.contains(&Some(s))), "{drawn:?}");
    for (folder, styled) in folders.iter().zip(&sets).skip(1) {
        let without = |i: &text_set::SetImage| text_set::SetImage { style: None, ..i.clone() };
        assert_eq!(styled.iter().map(without).collect::<Vec<_>>(), sets[0], "labels are the same");
        for image in &sets[0] {
            let read = |folder: &Path, file: &str| std::fs::read(folder.join(file)).unwrap();
            assert!(read(folder, &image.image) != read(&folders[0], &image.image), "{}", image.image);
            assert!(read(folder, &glyphs(&image.image)) == read(&folders[0], &glyphs(&image.image)));
        }
    }
    let [with, without] = [1, 2].map(|k| edge_similarity(&folders[k], &folders[0]));
    assert!(with > without && with > 0.85, "similarity at the edges of letters: {with} with the mask, {without} without");
    // What makes another set is named.
    let told = |o: &SynthOptions| set(&folders[1], run, o).unwrap_err().to_string();
    assert!(told(plain).contains("of other options.styles, styles;"), "{}", told(plain));
    assert!(told(&options(MaskMode::Paper)).contains("of other options.mask;"));
    photo::save_png(&style_file, &diorama_geom::ImageU8 { width: 8, height: 8, channels: 3, data: vec![90; 192] }).unwrap();
    assert!(told(&options(MaskMode::Text)).contains("of other styles;"), "{}", told(&options(MaskMode::Text)));
    let unknown = SynthOptions { styles: vec!["spring".into()], ..plain.clone() };
    assert!(told(&unknown).contains("autumn, winter, night, rain, evening, none"));
}
