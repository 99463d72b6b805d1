//! Pixels of training photographs whose distance is known, from sparse points or from stereo.

use super::model::ObjectModel;
use crate::run::{nearest, sparse_points};
use diorama_engine::samplers::pixels::{Observation, PixelSource};
use diorama_engine::samplers::stereo;
use std::sync::atomic::{AtomicBool, Ordering};

/// Where distances come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Source {
    Points,
    Stereo,
}

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
    let source = if from == "stereo" || (from == "auto" && found.len() < sparse_points::ENOUGH) { Source::Stereo } else { Source::Points };
    let viewing_distance = model.viewing_distance();
    if is_wanted && source == Source::Stereo {
        note(format!("comparing {} photographs with their neighbors to find distances", photographs.images()));
        found = stereo::observe(photographs, &model.base_cameras(), &[], viewing_distance, interrupt);
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
    sparse_points::observe(&model.capture, &model.train, model.config.reduction(), model.model_from_world.scale)
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
