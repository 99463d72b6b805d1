//! Pixels of training photographs whose distance is known, from sparse points or from stereo.

use super::model::ObjectModel;
use crate::run::nearest;
use diorama_engine::samplers::pixels::{Observation, PixelSource};
use diorama_engine::samplers::stereo;
use diorama_geom::capture::SparsePoint;
use std::sync::atomic::{AtomicBool, Ordering};

/// Fewest training photographs that show a point, and largest mean reprojection error in their pixels: else its distance is unsure.
const FEWEST: usize = 3;
pub(super) const LARGEST_ERROR: f32 = 2.0;

/// Most observations that are kept, evenly taken from all.
const MOST: usize = 1 << 20;

/// Where distances come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Source {
    Points,
    Stereo,
}

/// Fewest observations of sparse points with which stereo is not asked.
const ENOUGH: usize = 1000;

/// Finds distances as `loss.depth_from` says and settles what the configuration leaves open: where they come from, and how near matter
/// may be.
pub(super) fn find(
    model: &mut ObjectModel,
    photographs: &dyn PixelSource,
    interrupt: &AtomicBool,
    note: &mut dyn FnMut(String),
) -> (Vec<Observation>, Source) {
    // Where memory holds a share of the pixels, another one would be drawn in place of the observed one.
    let is_stored = |o: &Observation| photographs.snap(o.image as usize, o.x, o.y) == (o.x, o.y);
    let is_wanted = model.depth() > 0.0;
    let from = model.config.loss.depth_from.clone();
    let mut found = if is_wanted && from != "stereo" { of_points(model) } else { Vec::new() };
    found.retain(is_stored);
    let source = if from == "stereo" || (from == "auto" && found.len() < ENOUGH) { Source::Stereo } else { Source::Points };
    let viewing_distance = model.viewing_distance();
    if is_wanted && source == Source::Stereo {
        note(format!("comparing {} photographs with their neighbors to find distances", photographs.images()));
        found = stereo::observe(photographs, &model.base_cameras(), viewing_distance, interrupt);
        found.retain(is_stored);
    }
    if is_wanted && from == "auto" && !interrupt.load(Ordering::Relaxed) {
        model.config.loss.depth_from = if source == Source::Points { "points" } else { "stereo" }.into();
    }
    nearest::settle(&mut model.config.sampling.near, &mut found, viewing_distance);
    (found, source)
}

/// What the training photographs show of the capture's sparse points.
pub(super) fn of_points(model: &ObjectModel) -> Vec<Observation> {
    let capture = &model.capture;
    let mut image_of = vec![None; capture.frames.len()];
    model.train.iter().enumerate().for_each(|(image, frame)| image_of[*frame] = Some(image));
    let scale = model.model_from_world.scale;
    let cameras: Vec<_> =
        capture.frames.iter().map(|f| (f.camera.reduced(model.config.reduction()), f.world_from_camera.inverse())).collect();
    let is_trained = |f: &&u32| image_of[**f as usize].is_some();
    let is_sure = |p: &&SparsePoint| p.frames.iter().filter(is_trained).count() >= FEWEST && p.error <= LARGEST_ERROR;
    let shown = || capture.points.iter().filter(is_sure).flat_map(|p| p.frames.iter().filter(is_trained).map(move |f| (p, *f as usize)));
    let step = shown().count().div_ceil(MOST).max(1);
    let seen = shown().step_by(step).filter_map(|(p, frame)| {
        let image = image_of[frame]?;
        let (camera, camera_from_world) = &cameras[frame];
        let q = camera_from_world.point(p.position);
        let px = camera.project(q)?;
        let is_inside = (0.0..camera.width as f64).contains(&px.x) && (0.0..camera.height as f64).contains(&px.y);
        let distance = (q.length() * scale) as f32;
        let observation = Observation { image: image as u32, x: px.x as u32, y: px.y as u32, distance };
        is_inside.then_some(observation)
    });
    seen.collect()
}

/// Message about `n` observations for the user.
pub(super) fn note(model: &ObjectModel, n: usize, source: Source) -> Option<String> {
    if model.depth() == 0.0 || (n == 0 && model.capture.points.is_empty() && source == Source::Points) {
        return None;
    }
    Some(match (n, source) {
        (0, Source::Points) => {
            let why = "nobody says which photographs see them (diorama prepare does), or fewer than three do";
            format!("the sparse points tell no distances: {why}")
        }
        (0, Source::Stereo) => {
            "no distances were found by comparing photographs: too few overlap, they show little texture, or all cameras look the same way"
                .into()
        }
        (n, Source::Points) => format!("sparse points tell the distance of {n} pixels (--set loss.depth=0: do not use them)"),
        (n, Source::Stereo) => {
            format!("the distance of {n} pixels was found by comparing photographs (--set loss.depth=0: do not use it)")
        }
    })
}
