//! Labels of regions that are on no surface: the outline of the pixels of their class, view by view.

use super::super::field::model::TextModel;
use super::super::placed::PlacedRegion;
use super::super::regions::shortest_side;
use super::super::surface::plane_rectangle;
use super::in_view::{READABLE_PX, area};
use diorama_data::text_labels::UNREADABLE;
use diorama_data::text_set::SetWord;
use diorama_geom::Camera;
use diorama_geom::glam::DVec2;

/// Pixels below which a class is not seen.
const LEAST_PIXELS: usize = 12;

/// Labels of the regions without a rectangle in a view whose pixels have `shares` of the classes; `camera` is that of the label, whose
/// picture may be larger than the shares'.
pub fn words(model: &TextModel, regions: &[PlacedRegion], shares: (&[f32], [usize; 2]), camera: &Camera) -> Vec<SetWord> {
    let (shares, [width, height]) = shares;
    let count = model.labels.count();
    let to_picture = DVec2::new(camera.width as f64 / width as f64, camera.height as f64 / height as f64);
    let word = |region: &PlacedRegion| {
        let class = model.labels.class_of(region.id)? as usize;
        let own = (0..width * height).filter(|i| shares[i * count + class] > 0.5);
        let pixels: Vec<DVec2> = own.map(|i| DVec2::new((i % width) as f64, (i / width) as f64)).collect();
        if pixels.len() < LEAST_PIXELS {
            return None;
        }
        // All corners of the pixels, with y up, so that reading order is that of a page.
        let corners = pixels.iter().flat_map(|p| [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)].map(|(x, y)| *p + DVec2::new(x, y)));
        let quad = plane_rectangle(corners.map(|p| p * to_picture * DVec2::new(1.0, -1.0)).collect(), DVec2::X);
        let size = [camera.width as f64, camera.height as f64];
        let quad = quad.map(|p| [p.x.clamp(0.0, size[0]), (-p.y).clamp(0.0, size[1])]);
        let ignore = shortest_side(&quad) < READABLE_PX;
        (area(&quad) > 0.0).then(|| SetWord {
            id: region.id,
            quad,
            polygon: quad.to_vec(),
            transcription: if ignore { UNREADABLE.into() } else { region.transcription.clone() },
            script: region.script.clone(),
            ignore,
            visibility: 1.0,
            pose: None,
            cluster: None,
            characters: Vec::new(),
        })
    };
    regions.iter().filter(|r| r.rectangle.is_none()).filter_map(word).collect()
}
