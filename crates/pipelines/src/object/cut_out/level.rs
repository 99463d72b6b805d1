//! Density at the surface, chosen so that the mesh covers in small views what the field does.

use super::super::export;
use super::super::model::ObjectModel;
use super::view::{flat, in_model, small};
use crate::run::viewer_files::Crop;
use diorama_engine::renderers::volume::Quality;
use diorama_geom::field_query::FieldQuery;
use diorama_geom::{Camera, Mesh, Pose};
use diorama_mesh::bake::DepthMap;
use diorama_mesh::extract::{self, Grid};
use rayon::prelude::*;

/// Most cells along the longest side of the meshes that are compared, training views, and pixels along their longest side.
const RESOLUTION: usize = 192;
const VIEWS: usize = 12;
const VIEW_PX: f64 = 128.0;
/// Levels that are compared, over the level of `diorama export`: fields that were trained before a background have fog around the object.
const FACTORS: [f32; 6] = [1.0, 2.0, 4.0, 8.0, 16.0, 32.0];

/// A small view, and where the field in the box is opaque in it.
struct OpaqueView {
    camera: Camera,
    pose: Pose,
    is_opaque: Vec<bool>,
}

/// The level, of [`FACTORS`], whose mesh agrees best with the field. `density` is the model's; `progress` receives (done, total).
pub fn choose(
    model: &ObjectModel,
    density: &dyn FieldQuery,
    (min, max): Crop,
    resolution: usize,
    progress: &mut dyn FnMut(usize, usize),
) -> f32 {
    let grid = Grid { min, max, resolution: resolution.min(RESOLUTION) };
    let first = export::automatic_level(model, &grid);
    let sigma = extract::sample(density, &grid, progress);
    let views = opaque_views(model, (min, max));
    let agreement = |factor: &f32| -> f64 {
        let mesh = extract::from_densities(&sigma, &grid, first * factor);
        views.par_iter().map(|v| overlap(&mesh, v)).collect::<Vec<_>>().iter().sum()
    };
    let best = FACTORS.iter().map(|f| (agreement(f), *f)).fold((0.0, 1.0), |best, next| if next.0 > best.0 { next } else { best });
    first * best.1
}

fn opaque_views(model: &ObjectModel, (lo, hi): Crop) -> Vec<OpaqueView> {
    let n = model.train.len();
    let mut tracer = model.tracer(Quality::Fast);
    tracer.clip = Some((in_model(model, lo), in_model(model, hi)));
    let of = |i: usize| {
        let f = &model.capture.frames[model.train[i * n / n.min(VIEWS)]];
        let camera = small(&flat(&f.camera)?, VIEW_PX);
        let pose = f.world_from_camera;
        let view = tracer.view(&model.to_model(camera, &pose), &mut |_| {});
        Some(OpaqueView { camera, pose, is_opaque: view.opacity.data.iter().map(|o| *o > 0.5).collect() })
    };
    (0..n.min(VIEWS)).filter_map(of).collect()
}

/// Pixels of both over pixels of either.
fn overlap(mesh: &Mesh, view: &OpaqueView) -> f64 {
    let depth = DepthMap::new(mesh, view.camera, &view.pose);
    let (mut both, mut either) = (0usize, 0usize);
    for (d, is_opaque) in depth.depth().iter().zip(&view.is_opaque) {
        both += (d.is_finite() && *is_opaque) as usize;
        either += (d.is_finite() || *is_opaque) as usize;
    }
    both as f64 / either.max(1) as f64
}
