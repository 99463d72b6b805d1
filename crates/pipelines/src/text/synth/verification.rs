//! Labels against the glyphs' own pixels.

use super::super::label::in_view::{self, InView, OnSurface};
use diorama_data::text_set::SetWord;
use diorama_geom::glam::{DVec2, dvec2};
use diorama_geom::{Camera, Image, Pose};

/// Share of the strongest pixel from which a pixel is a glyph.
const GLYPH: f32 = 0.35;
/// Pixels around a word in which glyphs are its own.
const AROUND_PX: f64 = 3.0;

/// Whether a word reaches beyond the picture.
fn leaves_picture(whole: &InView, camera: &Camera) -> bool {
    let size = [camera.width as f64, camera.height as f64];
    whole.quad.iter().any(|p| (0..2).any(|k| p[k] < 0.0 || p[k] > size[k]))
}

/// Largest distance between the corners of a word's label and of the bounding quadrilateral, in the word's frame, of the pixels of its
/// `glyphs`, also where something stands before them; none where the border cuts the word, or no pixel is one of its glyphs.
pub fn misfit_px(word: &OnSurface, label: &SetWord, glyphs: &Image, (camera, pose): (&Camera, &Pose)) -> Option<f64> {
    let whole = in_view::seen(word.rectangle, word.bounds, camera, pose)?;
    if leaves_picture(&whole, camera) {
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

#[cfg(test)]
mod tests {
    use super::super::super::surface::{self, Rectangle, Wanted};
    use super::*;
    use diorama_geom::glam::{DMat3, DVec3};

    /// A rectangle of 1 × 0.25 at z = 3 before a camera that looks along z, and glyphs that fill `bounds` of it.
    fn case(bounds: [DVec2; 2]) -> (Rectangle, Image, Camera, Pose) {
        let camera = Camera::pinhole(160, 120, 0.8);
        let pose = Pose { rotation: DMat3::IDENTITY, translation: DVec3::ZERO };
        let points: Vec<DVec3> =
            (0..400).map(|i| DVec3::new(((i % 20) as f64 - 9.5) / 19.0, ((i / 20) as f64 - 9.5) / 76.0, 3.0)).collect();
        let surface = surface::fit(&points, -DVec3::Z, Wanted::Plane).unwrap();
        let rectangle = surface::rectangle(&surface, &points, Some(DVec3::X), -DVec3::Y);
        let mut glyphs = Image::zeros(160, 120, 1);
        for i in 0..160 * 120 {
            let direction = camera.direction((i % 160) as f64 + 0.5, (i / 160) as f64 + 0.5);
            let at = rectangle.hit(DVec3::ZERO, direction, 1.0).map(|h| h.1);
            let inside = at.is_some_and(|p| p.cmpge(bounds[0]).all() && p.cmple(bounds[1]).all());
            glyphs.data[i] = inside as u8 as f32;
        }
        (rectangle, glyphs, camera, pose)
    }

    #[test]
    fn labels_are_as_far_from_the_glyphs_as_they_are_moved() {
        let bounds = [dvec2(-0.4, -0.1), dvec2(0.4, 0.1)];
        let (rectangle, glyphs, camera, pose) = case(bounds);
        let word = OnSurface { rectangle: &rectangle, bounds, id: 0, transcription: "A", script: None, front: 0.0, characters: &[] };
        let label = |by: f64| {
            let seen = in_view::seen(&rectangle, bounds, &camera, &pose).unwrap();
            SetWord {
                id: 0,
                quad: seen.quad.map(|p| [p[0] + by, p[1]]),
                polygon: seen.quad.to_vec(),
                transcription: "A".into(),
                script: None,
                ignore: false,
                visibility: 1.0,
                pose: None,
                cluster: None,
                characters: Vec::new(),
            }
        };
        let off = |by: f64| misfit_px(&word, &label(by), &glyphs, (&camera, &pose)).unwrap();
        assert!(off(0.0) < 0.8, "{}", off(0.0));
        assert!((off(3.0) - 3.0).abs() < 0.9 && off(3.0) > 2.0, "{}", off(3.0));
        let hidden = SetWord { visibility: 0.3, ..label(3.0) };
        assert_eq!(misfit_px(&word, &hidden, &glyphs, (&camera, &pose)), Some(off(3.0)), "what stands before a word does not matter");
        assert!(misfit_px(&word, &label(0.0), &Image::zeros(160, 120, 1), (&camera, &pose)).is_none());
    }
}
