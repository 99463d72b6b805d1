//! Labels against the glyphs' own pixels.

use super::super::label::in_view::{self, OnSurface};
use diorama_data::text_set::SetWord;
use diorama_geom::glam::{DVec2, dvec2};
use diorama_geom::{Camera, Image, Pose};

/// Visibility from which a word's glyphs are wholly seen.
const WHOLE: f64 = 0.999;
/// Share of the strongest pixel from which a pixel is a glyph.
const GLYPH: f32 = 0.35;
/// Pixels around a word in which glyphs are its own.
const AROUND_PX: f64 = 3.0;

/// Largest distance between the corners of a word's label and of the bounding quadrilateral, in the word's frame, of the glyphs that a view
/// shows; none where the word is partly hidden or cut, or no glyph of it is seen.
pub fn misfit_px(word: &OnSurface, label: &SetWord, glyphs: &Image, (camera, pose): (&Camera, &Pose)) -> Option<f64> {
    if label.visibility < WHOLE {
        return None;
    }
    let [from, to] = [f64::min, f64::max].map(|f| [0, 1].map(|k| label.quad.iter().map(|p| p[k]).reduce(f).expect("four corners")));
    let clamp = |v: f64, most: usize| v.clamp(0.0, most as f64) as usize;
    let (x0, y0) = (clamp(from[0] - AROUND_PX, glyphs.width), clamp(from[1] - AROUND_PX, glyphs.height));
    let (x1, y1) = (clamp(to[0] + AROUND_PX + 1.0, glyphs.width), clamp(to[1] + AROUND_PX + 1.0, glyphs.height));
    let pixels = || (y0..y1).flat_map(|y| (x0..x1).map(move |x| (x, y)));
    let share = |x: usize, y: usize| glyphs.data[y * glyphs.width + x];
    let strongest = pixels().map(|(x, y)| share(x, y)).fold(0.0, f32::max);
    if strongest < GLYPH {
        return None;
    }
    let size = word.bounds[1] - word.bounds[0];
    let at = |x: f64, y: f64| {
        let direction = pose.rotation * camera.direction(x, y).normalize();
        word.rectangle.hit(pose.translation, direction, size.max_element()).map(|(_, at)| at)
    };
    let (mut low, mut high) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
    // A margin in the word's frame keeps glyphs of its neighbors out.
    let margin = 0.5 * size.y;
    for (x, y) in pixels().filter(|(x, y)| share(*x, *y) > GLYPH * strongest) {
        let Some(p) = at(x as f64 + 0.5, y as f64 + 0.5) else { continue };
        let is_near = p.cmpge(word.bounds[0] - margin).all() && p.cmple(word.bounds[1] + margin).all();
        if is_near {
            (low, high) = (low.min(p), high.max(p));
        }
    }
    let found = (low.cmplt(high).all()).then(|| in_view::seen(word.rectangle, [low, high], camera, pose)).flatten()?;
    // Pixels reach half a pixel beyond their middles.
    let middle = (0..4).map(|k| DVec2::from(found.quad[k])).sum::<DVec2>() / 4.0;
    let grown = |k: usize| {
        let p = DVec2::from(found.quad[k]);
        p + dvec2((p.x - middle.x).signum(), (p.y - middle.y).signum()) * 0.5
    };
    Some((0..4).map(|k| grown(k).distance(DVec2::from(label.quad[k]))).fold(0.0, f64::max))
}
