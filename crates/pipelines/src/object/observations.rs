//! Pixels of training photographs in which it is known how far away what they show is: by the capture's sparse points, or by comparing
//! the photographs.

use super::model::ObjectModel;
use super::nearest;
use diorama_engine::samplers::pixels::{Observation, PixelSource};
use diorama_engine::samplers::stereo;
use diorama_geom::capture::SparsePoint;

/// Fewest training photographs that show a point, and largest mean reprojection error in their pixels: else its distance is unsure.
const FEWEST: usize = 3;
pub(super) const LARGEST_ERROR: f32 = 2.0;

/// Most observations that are kept, evenly taken from all.
const MOST: usize = 1 << 20;

/// Where distances come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Source {
    Points,
    Photographs,
}

/// Finds distances as `loss.depth_from` says, and from them how near matter may be, where the configuration leaves that open.
pub(super) fn find(model: &mut ObjectModel, photographs: &dyn PixelSource) -> (Vec<Observation>, Source) {
    let from = &model.config.loss.depth_from[..];
    let is_wanted = model.depth() > 0.0;
    let mut found = if is_wanted && from != "stereo" { of_points(model) } else { Vec::new() };
    let source = if from == "stereo" || (from == "auto" && found.is_empty()) { Source::Photographs } else { Source::Points };
    if is_wanted && source == Source::Photographs {
        found = stereo::observe(photographs, &model.base_cameras(), model.viewing_distance());
    }
    let near = &mut model.config.sampling.near;
    if *near == 0.0 {
        *near = nearest::of_observations(&found).unwrap_or(nearest::UNKNOWN);
    }
    // Rays begin beyond what is closer, so that no sample could be there; and where memory holds a share of the pixels, another one would
    // be drawn in place of the observed one.
    found.retain(|o| o.distance > *near && photographs.snap(o.image as usize, o.x, o.y) == (o.x, o.y));
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

/// What a user should know of `n` observations.
pub(super) fn note(model: &ObjectModel, n: usize, source: Source) -> Option<String> {
    if model.depth() == 0.0 || (n == 0 && model.capture.points.is_empty() && source == Source::Points) {
        return None;
    }
    Some(match (n, source) {
        (0, Source::Points) => {
            let why = "nobody says which photographs see them (diorama prepare does), or fewer than three do";
            format!("the sparse points tell no distances: {why}")
        }
        (0, Source::Photographs) => "no distances were found by comparing photographs: too few overlap, or they show little texture".into(),
        (n, Source::Points) => format!("sparse points tell the distance of {n} pixels (--set loss.depth=0: do not use them)"),
        (n, Source::Photographs) => {
            format!("the distance of {n} pixels was found by comparing photographs (--set loss.depth=0: do not use it)")
        }
    })
}
