//! Pixels in which training photographs show sparse points: what stands there is as far away as the point.

use super::model::ObjectModel;
use diorama_engine::samplers::pixels::Observation;
use diorama_geom::capture::SparsePoint;

/// Fewest photographs that show a point, and largest mean reprojection error in their pixels: else its distance is unsure.
const FEWEST: usize = 3;
const LARGEST_ERROR: f32 = 2.0;

/// Most observations that are kept, evenly taken from all.
const MOST: usize = 1 << 20;

/// What the training photographs show of the capture's sparse points.
pub(super) fn of(model: &ObjectModel) -> Vec<Observation> {
    let capture = &model.capture;
    let mut image_of = vec![None; capture.frames.len()];
    model.train.iter().enumerate().for_each(|(image, frame)| image_of[*frame] = Some(image));
    let scale = model.model_from_world.scale;
    let is_sure = |p: &&SparsePoint| p.frames.len() >= FEWEST && p.error <= LARGEST_ERROR;
    let shown = capture.points.iter().filter(is_sure).flat_map(|p| p.frames.iter().map(move |f| (p, *f as usize)));
    let seen = shown.filter_map(|(p, frame)| {
        let image = image_of[frame]?;
        let f = &capture.frames[frame];
        let camera = f.camera.reduced(model.config.reduction());
        let q = f.world_from_camera.inverse().point(p.position);
        let px = camera.project(q)?;
        let is_inside = (0.0..camera.width as f64).contains(&px.x) && (0.0..camera.height as f64).contains(&px.y);
        let distance = (q.length() * scale) as f32;
        let observation = Observation { image: image as u32, x: px.x as u32, y: px.y as u32, distance };
        (is_inside && distance > 0.0).then_some(observation)
    });
    let all: Vec<Observation> = seen.collect();
    let step = all.len().div_ceil(MOST).max(1);
    all.into_iter().step_by(step).collect()
}
