//! Images of a data set that stand in the page, with the outlines of their words.

use super::svg::{VERMILION, YELLOW};
use crate::error::Result;
use crate::run::html::{escaped, png_uri};
use diorama_data::photo;
use diorama_data::text_set::{SetImage, SetWord};
use std::fmt::Write;
use std::path::Path;

/// An image of a data set with at most `side` pixels along its longer side, and the outlines of `words`: drawn through where a word is to be
/// read, dashed where it is not.
///
/// # Errors
/// When the image cannot be read.
pub fn labelled<'a>(set: &Path, image: &SetImage, words: impl IntoIterator<Item = &'a SetWord>, side: usize) -> Result<String> {
    let picture = photo::load_small(&set.join(&image.image), side)?;
    let (w, h, uri) = (image.width, image.height, png_uri(&picture));
    let name = escaped(&image.image);
    let mut out = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {w} {h}\" width=\"{}\" height=\"{}\" role=\"img\" aria-label=\"{name}\">\n\
<image href=\"{uri}\" width=\"{w}\" height=\"{h}\" preserveAspectRatio=\"none\"/>\n",
        picture.width, picture.height
    );
    for word in words {
        let points: Vec<String> = word.quad.iter().map(|p| format!("{:.1},{:.1}", p[0], p[1])).collect();
        let (color, dashes) = if word.ignore { (YELLOW, " stroke-dasharray=\"3 2\"") } else { (VERMILION, "") };
        let (points, said) = (points.join(" "), escaped(&word.transcription));
        writeln!(
            out,
            "<polygon fill=\"none\" stroke=\"{color}\" stroke-width=\"1.5\"{dashes} vector-effect=\"non-scaling-stroke\" points=\"{points}\">\
<title>{said}</title></polygon>"
        )
        .expect("a String takes any text");
    }
    Ok(out + "</svg>\n")
}
