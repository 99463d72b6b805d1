//! The report page of a quickstart: one HTML file beside the files that it shows.

use super::Made;
use crate::error::Result;
use diorama_data::{photo, text_set};
use diorama_geom::ImageU8;
use diorama_geom::glam::DVec2;
use std::path::Path;

/// Images of the picture, along both sides, and the pixels of one of theirs.
const GRID: [usize; 2] = [4, 6];
const SCALE: usize = 2;
const READ: [u8; 3] = [255, 40, 30];
const UNREAD: [u8; 3] = [255, 220, 40];
const STYLE: &str = "body{font:16px sans-serif;max-width:60em;margin:2em auto;padding:0 1em}img{max-width:100%}\
td,th{padding:.2em 1em;text-align:left}pre{background:#eee;padding:1em;overflow:auto}";

/// Images of a data set with the outlines of their labels.
pub fn pictures(set: &Path) -> Result<ImageU8> {
    let images = text_set::read(set)?;
    let [columns, rows] = GRID;
    let n = (columns * rows).min(images.len()).max(1);
    let (w, h) = (SCALE * images[0].width as usize, SCALE * images[0].height as usize);
    let mut out = ImageU8 { width: columns * w, height: n.div_ceil(columns) * h, channels: 3, data: Vec::new() };
    out.data = vec![0; 3 * out.width * out.height];
    for k in 0..n {
        let image = &images[k * images.len() / n];
        let picture = photo::load(&set.join(&image.image))?;
        let at = [(k % columns) * w, (k / columns) * h];
        for (x, y) in (0..h).flat_map(|y| (0..w).map(move |x| (x, y))) {
            let from = picture.channels * ((y / SCALE) * picture.width + x / SCALE);
            let to = 3 * ((at[1] + y) * out.width + at[0] + x);
            let pixel = [0, 1, 2].map(|c| picture.data[from + c.min(picture.channels - 1)]);
            out.data[to..to + 3].copy_from_slice(&pixel);
        }
        for word in &image.words {
            let color = if word.ignore { UNREAD } else { READ };
            let corner = |k: usize| DVec2::from(word.quad[k % 4]) * SCALE as f64;
            (0..4).for_each(|k| line(&mut out, [at, [w, h]], [corner(k), corner(k + 1)], color));
        }
    }
    Ok(out)
}

/// A line within a window of an image.
fn line(image: &mut ImageU8, [at, size]: [[usize; 2]; 2], [from, to]: [DVec2; 2], color: [u8; 3]) {
    let steps = (to - from).length().ceil().max(1.0) as usize;
    for k in 0..=steps {
        let p = from.lerp(to, k as f64 / steps as f64);
        let clamp = |v: f64, most: usize| (v.max(0.0) as usize).min(most - 1);
        let (x, y) = (at[0] + clamp(p.x, size[0]), at[1] + clamp(p.y, size[1]));
        let i = 3 * (y * image.width + x);
        image.data[i..i + 3].copy_from_slice(&color);
    }
}

/// The page.
pub fn html(m: &Made) -> String {
    let row = |name: &str, value: String| format!("<tr><td>{name}</td><td>{value}</td></tr>\n");
    let table = [
        row("Held-out photographs", format!("{:.2} dB, SSIM {:.3}", m.psnr, m.ssim)),
        row("Classes of their pixels, mIoU", m.miou.map_or("unknown".into(), |v| format!("{v:.3}"))),
        row("Corners of labels of all photographs, median error", format!("{:.2} px", m.corner_error_px)),
        row("Text poses, median error", format!("{:.1}°", m.pose_error_deg)),
        row("Images drawn", format!("{} at {:.1} per second", m.images, m.images_per_s)),
        row("Labels more than 2 px from their glyphs", m.misfits.to_string()),
        row("DB, F by instance on other images of the scene", format!("{:.1}", 100.0 * m.f_db)),
        row("EAST, the same", format!("{:.1}", 100.0 * m.f_east)),
    ];
    let notes: String = m.notes.iter().map(|n| format!("<p>{}</p>\n", n.replace('&', "&amp;").replace('<', "&lt;"))).collect();
    format!(
        "<!doctype html>\n<html lang=\"en\"><meta charset=\"utf-8\"><title>diorama text quickstart</title>\n<style>{STYLE}</style>\n\
<h1>diorama text quickstart</h1>\n<p>Fourteen photographs of a room, two of them labelled, became this data set: other words on its signs, seen from \
cameras of wanted text poses. Red outlines are labels to be read, yellow ones are not.</p>\n\
<img src=\"labels.png\" alt=\"labelled images\">\n<table>{table}</table>\n{notes}\
<p><code>dataset/</code> has images, glyph masks and labels: <code>icdar15/</code>, <code>Label.txt</code> (PaddleOCR), <code>mmocr/textdet.json</code>, \
<code>coco/instances.json</code>.</p>\n<h2>Your own scene</h2>\n<pre>diorama prepare walk.mp4 -o data/shop\n\
diorama text annotate data/shop labels/ --format labelme\ndiorama text train data/shop -o runs/shop\ndiorama text label runs/shop\n\
diorama text edit runs/shop --words 8\ndiorama text synth runs/shop --count 1000 -o data/set\n\
diorama text train-detector --data data/set -o runs/db</pre>\n</html>\n",
        table = table.concat(),
    )
}
