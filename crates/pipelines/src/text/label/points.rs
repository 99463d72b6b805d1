//! Points of a text region, back-projected from the views that show it largest: `X = P [d K⁻¹ (x, y, 1)ᵀ; 1]`.

use super::super::field::model::TextModel;
use super::super::surface::principal;
use diorama_engine::renderers::layers::Layers;
use diorama_geom::glam::DVec3;
use diorama_kernels::ops::ray_generation::PosedCamera;
use std::collections::HashMap;

/// Most views whose points are taken.
const VIEWS: usize = 12;
/// Share of a region's class from which a pixel is its own, and opacity from which it has a surface.
const OWN: f32 = 0.5;
const SURFACE: f32 = 0.9;

/// Views of the training cameras with classes, rendered when first asked for.
pub struct ViewCache<'a> {
    model: &'a TextModel,
    views: HashMap<usize, Layers>,
}

/// Points of a region in the world.
pub struct Cloud {
    pub points: Vec<DVec3>,
    /// Views that show some of them.
    pub views: usize,
    /// Mean of these views' eyes.
    pub eye: DVec3,
}

impl<'a> ViewCache<'a> {
    pub fn new(model: &'a TextModel) -> ViewCache<'a> {
        ViewCache { model, views: HashMap::new() }
    }

    fn layers(&mut self, frame: usize) -> &Layers {
        let model = self.model;
        self.views.entry(frame).or_insert_with(|| {
            let tracer = model.label_tracer(super::QUALITY).expect("a run with classes");
            tracer.layers(&model.posed(frame), &[], &mut |_| ())
        })
    }

    /// Points in the world of the pixels of a frame for which `is_own` holds and that have a surface.
    fn points(&mut self, frame: usize, is_own: impl Fn(&Layers, usize) -> bool) -> Vec<DVec3> {
        let (camera, world_from_model) = (self.model.posed(frame), self.model.model_from_world.inverse());
        let layers = self.layers(frame);
        let is_chosen = |i: &usize| layers.opacity.data[*i] > SURFACE && is_own(layers, *i);
        let opaque: Vec<usize> = (0..layers.opacity.data.len()).filter(is_chosen).collect();
        let about: Vec<f32> = opaque.iter().map(|i| layers.depth.data[*i]).collect();
        let found = self.model.surfaces(&camera, &opaque, &about);
        let on_surfaces = opaque.iter().zip(found).filter(|(_, d)| *d > 0.0);
        on_surfaces.map(|(i, d)| world_from_model.point(point(&camera, *i, d))).collect()
    }

    /// Points of a class.
    pub fn cloud(&mut self, class: u8) -> Cloud {
        let model = self.model;
        let mut labelled = Vec::new();
        for frame in &model.train {
            let Some(image) = &model.labels.of_frame[*frame] else { continue };
            let (own, of) = (model.posed(*frame).camera, &model.capture.frames[*frame].camera);
            let map = model.labels.map(image, (own.width, own.height), (of.width, of.height));
            labelled.extend(self.points(*frame, |_, i| map[i] == class));
        }
        let count = model.labels.count();
        let (mut points, mut views, mut eyes) = (Vec::new(), 0, DVec3::ZERO);
        for frame in nearest(model, &labelled) {
            let own = self.points(frame, |l, i| l.values.data[i * count + class as usize] > OWN);
            if !own.is_empty() {
                (views, eyes) = (views + 1, eyes + model.capture.frames[frame].world_from_camera.translation);
            }
            points.extend(own);
        }
        Cloud { points, views, eye: eyes / views.max(1) as f64 }
    }
}

/// Point in model space of pixel `i` at a distance along its ray.
fn point(camera: &PosedCamera, i: usize, distance: f32) -> DVec3 {
    let w = camera.camera.width as usize;
    let direction = camera.camera.direction((i % w) as f64 + 0.5, (i / w) as f64 + 0.5).normalize();
    camera.pose.translation + camera.pose.rotation * direction * distance as f64
}

/// Training frames that show a patch of points largest: by the area of its plane that a pixel sees.
fn nearest(model: &TextModel, points: &[DVec3]) -> Vec<usize> {
    if points.len() < 3 {
        return Vec::new();
    }
    let (middle, axes, _) = principal(points, |_| 1.0);
    let area = |frame: usize| {
        let f = &model.capture.frames[frame];
        let seen = f.world_from_camera.inverse().point(middle);
        let toward = (f.world_from_camera.translation - middle).normalize();
        let of = f.camera.fx * f.camera.fy / seen.z.powi(2) * axes.x_axis.dot(toward).abs();
        f.camera.shows(seen).then_some(of)
    };
    let mut seen: Vec<(usize, f64)> = model.train.iter().filter_map(|i| Some((*i, area(*i)?))).collect();
    seen.sort_by(|a, b| b.1.total_cmp(&a.1));
    seen.into_iter().take(VIEWS).map(|(i, _)| i).collect()
}
