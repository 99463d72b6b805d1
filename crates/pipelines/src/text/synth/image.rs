//! One image of a data set: a view with edits, its labels, and the glyphs that it shows.

use super::super::edit::Edit;
use super::super::edit::replacement::Overlay;
use super::super::label::in_view::{self, OnSurface};
use super::super::placed::from_rows;
use super::appearance::Appearance;
use super::sampling::{Clustering, Drawn};
use super::scene::SynthScene;
use super::verification;
use diorama_data::text_set::{SetImage, SetWord};
use diorama_engine::renderers::volume::Quality;
use diorama_geom::rng::Rng;
use diorama_geom::{Camera, Image, ImageU8};
use std::time::{Duration, Instant};

/// Distance in pixels from which a label does not fit its glyphs.
pub const MISFIT_PX: f64 = 2.0;
/// Stream of random numbers of edits.
const EDITS: u64 = 83;

/// An image and what it shows.
pub struct Drawing {
    pub picture: ImageU8,
    /// Share of each pixel that is a visible glyph of an edit, one channel.
    pub glyphs: ImageU8,
    pub record: SetImage,
    /// Labels of edited words that were compared with their glyphs, those more than [`MISFIT_PX`] off, and the largest distance in pixels
    /// between a label's corner and that of the glyphs' own pixels.
    pub compared: usize,
    pub misfits: usize,
    pub misfit_px: f64,
    /// Time that the change of its look took.
    pub styling: Duration,
}

/// Edits of a scene, ready to be seen, by region.
pub struct SceneEdits {
    of_region: Vec<Vec<Overlay>>,
    /// Whether the writing that was filmed is one of the choices.
    original: bool,
}

impl SceneEdits {
    pub fn new(scene: &SynthScene, edits: Vec<Edit>, original: bool) -> SceneEdits {
        let mut of_region: Vec<Vec<Overlay>> = scene.regions.iter().map(|_| Vec::new()).collect();
        for edit in edits {
            if let Some(k) = scene.regions.iter().position(|r| r.id == edit.region) {
                of_region[k].extend(Overlay::new(edit, &scene.regions[k]));
            }
        }
        SceneEdits { of_region, original }
    }

    /// The edit of a region that an image shows; none: the writing that was filmed.
    fn chosen(&self, region: usize, seed: u64) -> Option<&Overlay> {
        let all = &self.of_region[region];
        let choices = all.len() + (self.original || all.is_empty()) as usize;
        all.get(Rng::new(seed, EDITS).below(region as u64, choices as u64) as usize)
    }
}

/// Draws the image of a camera; its look changes nothing of its labels.
pub fn draw(
    scene: &SynthScene,
    (edits, appearance): (&SceneEdits, Option<&Appearance>),
    clustering: &Clustering,
    (camera, drawn): (&Camera, &Drawn),
    (name, seed): (&str, u64),
) -> Drawing {
    let (model, pose) = (&scene.model, &drawn.pose);
    let mut view = model.tracer(Quality::Fast).view(&scene.posed(camera, pose), &mut |_| ());
    let mut glyphs = Image::zeros(camera.width as usize, camera.height as usize, 1);
    let mut words: Vec<SetWord> = Vec::new();
    let (mut compared, mut misfits, mut misfit_px) = (0, 0, 0.0f64);
    for (k, region) in scene.regions.iter().enumerate() {
        let Some(overlay) = edits.chosen(k, seed) else {
            words.extend(OnSurface::of(region).and_then(|w| in_view::labelled(model, &w, camera, pose)));
            continue;
        };
        let own = overlay.put(model, camera, pose, &mut view);
        for word in overlay.edit.words.iter().filter_map(|w| w.on(region)) {
            let Some(label) = in_view::labelled(model, &word, camera, pose) else { continue };
            if let Some(off) = verification::misfit_px(&word, &label, &own.whole, (camera, pose)) {
                (compared, misfits) = (compared + 1, misfits + (off > MISFIT_PX) as usize);
                misfit_px = misfit_px.max(off);
            }
            words.push(label);
        }
        glyphs.data.iter_mut().zip(&own.visible.data).for_each(|(g, v)| *g = g.max(*v));
    }
    for word in &mut words {
        word.cluster = word.pose.as_ref().map(|p| clustering.nearest(&from_rows(&p.text_pose).0));
    }
    let began = Instant::now();
    let changed = appearance.and_then(|a| a.changed(scene, (camera, pose), (&view, &glyphs), seed));
    let styling = appearance.map(|_| began.elapsed()).unwrap_or_default();
    let (style, picture) = changed.map_or((None, view.rgb), |(name, image)| (Some(name), image));
    let (r, t) = (&pose.rotation, pose.translation);
    let record = SetImage {
        image: format!("images/{name}.png"),
        width: camera.width,
        height: camera.height,
        intrinsic: [camera.fx, camera.fy, camera.cx, camera.cy],
        world_from_camera: std::array::from_fn(|k| [r.x_axis[k], r.y_axis[k], r.z_axis[k], t[k]]),
        scene: scene.name.clone(),
        style,
        seed: Some(seed),
        words,
    };
    Drawing { picture: picture.to_u8(), glyphs: glyphs.to_u8(), record, compared, misfits, misfit_px, styling }
}
