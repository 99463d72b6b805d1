//! What the report of a quickstart says before and after its figures.

use super::Made;
use crate::run::html::escaped;

/// What follows all figures.
pub const FOOT: &str = "<h2>Your own scene</h2>\n<pre>diorama text prepare walk.mp4 -o data/shop\n\
diorama text annotate data/shop labels/ --format labelme\ndiorama text train data/shop -o runs/shop\ndiorama text label runs/shop\n\
diorama text edit runs/shop --words 8\ndiorama text synth runs/shop --count 1000 -o data/set\n\
diorama text train-detector --data data/set -o runs/db</pre>\n";

/// The title, and the figures of all steps.
pub fn head(m: &Made) -> String {
    let row = |name: &str, value: String| format!("<tr><td>{name}</td><td>{value}</td></tr>\n");
    // A call that goes on with a complete set draws nothing.
    let rate = if m.images_per_s > 0.0 { format!(" at {:.1} per second", m.images_per_s) } else { String::new() };
    let table = [
        row("Held-out photographs", format!("{:.2} dB, SSIM {:.3}", m.psnr, m.ssim)),
        row("Classes of their pixels, mIoU", m.miou.map_or("unknown".into(), |v| format!("{v:.3}"))),
        row("Corners of labels of all photographs, median error", m.corner_error_px.map_or("unknown".into(), |v| format!("{v:.2} px"))),
        row("Text poses, median error", m.pose_error_deg.map_or("unknown".into(), |v| format!("{v:.1}°"))),
        row("Images drawn", m.images.to_string() + &rate),
        row("Labels of new words more than 2 px from their glyphs", format!("{} of {}", m.misfits, m.compared)),
        row("DB, F by instance on other images of the scene", format!("{:.1}", 100.0 * m.f_db)),
        row("EAST, the same", format!("{:.1}", 100.0 * m.f_east)),
    ];
    let notes: String = m.notes.iter().map(|n| format!("<p>{}</p>\n", escaped(n))).collect();
    format!(
        "<h1>diorama text quickstart</h1>\n<p>Fourteen photographs of a room, two of them labelled, became a data set: other words on its signs, seen \
from cameras of wanted text poses.</p>\n<table>{table}</table>\n{notes}\
<p><code>dataset/</code> has images, glyph masks and labels: <code>icdar15/</code>, <code>Label.txt</code> (PaddleOCR), <code>mmocr/textdet.json</code>, \
<code>coco/instances.json</code>.</p>\n",
        table = table.concat(),
    )
}
