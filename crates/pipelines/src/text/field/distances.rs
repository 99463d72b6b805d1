//! Pixels of the training photographs whose distance is known, from sparse points or from stereo, and how near matter may be.

use super::model::TextModel;
use crate::run::{nearest, sparse_points};
use diorama_engine::samplers::pixels::{Observation, PixelSource};
use diorama_engine::samplers::stereo;
use diorama_geom::Reduction;
use std::sync::atomic::AtomicBool;

/// Finds distances, of sparse points where there are enough, else by comparing photographs, and settles the least distance where the
/// configuration leaves it open.
pub(super) fn find(
    model: &mut TextModel,
    photographs: &dyn PixelSource,
    interrupt: &AtomicBool,
    note: &mut dyn FnMut(String),
) -> Vec<Observation> {
    // Where memory holds a share of the pixels, another one would be drawn in place of the observed one.
    let is_stored = |o: &Observation| photographs.snap(o.image as usize, o.x, o.y) == (o.x, o.y);
    let reduction = Reduction::Times(model.config.data.downscale);
    let mut found = sparse_points::observe(&model.capture, &model.train, reduction, model.model_from_world.scale);
    found.retain(is_stored);
    let viewing_distance = model.capture.viewing_distance();
    if found.len() < sparse_points::ENOUGH {
        note(format!("comparing {} photographs with their neighbors to find distances", photographs.images()));
        found = stereo::observe(photographs, &model.cameras(), &[], viewing_distance, interrupt);
        found.retain(is_stored);
    }
    nearest::settle(&mut model.config.sampling.near, &mut found, viewing_distance);
    note(format!("the distance of {} pixels is known", found.len()));
    found
}
