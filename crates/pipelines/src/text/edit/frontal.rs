//! A region as seen from its front, in a few directions: the geometry is that of a camera on its normal, only the direction that colors are
//! seen in changes.

use super::super::field::model::TextModel;
use super::super::surface::Rectangle;
use super::directions;
use diorama_engine::fields::FieldBuffers;
use diorama_engine::renderers::volume::{Quality, Tracer};
use diorama_engine::samplers::RayBatch;
use diorama_geom::Image;
use diorama_geom::glam::{DVec2, DVec3, dvec2};

/// Margin around the region, over its height.
pub const MARGIN: f64 = 0.25;
/// Most pixels along the width.
const WIDEST: usize = 1024;
/// Where rays begin and end, over the distance of the surface: beyond what stands before it, and behind its matter.
const BAND: [f64; 2] = [0.7, 1.15];
/// Least pixels along the height, so that patches find room beside the writing.
const LEAST_HEIGHT: f64 = 56.0;
/// Opacity below which a pixel of the surface is unknown.
const KNOWN: f32 = 0.3;

/// Views of a region and its margin.
pub struct Frontal {
    /// Reading coordinates of the lower left and the upper right corner.
    pub frame: [DVec2; 2],
    /// Unit directions of sight in the world.
    pub directions: Vec<DVec3>,
    /// One of each direction, in the field's colors, of equal size.
    pub views: Vec<Image>,
    /// Whether each pixel has a surface.
    pub known: Vec<bool>,
}

impl Frontal {
    /// Pixels of the views.
    pub fn size(&self) -> [usize; 2] {
        [self.views[0].width, self.views[0].height]
    }
}

/// What photographs that face a region say of it.
struct Facing {
    /// Distance between points of the surface that neighboring pixels of the nearest one see.
    pixel: f64,
    /// Median distance.
    distance: f64,
    directions: Vec<DVec3>,
}

fn photographs(model: &TextModel, rectangle: &Rectangle) -> Facing {
    let middle = rectangle.reading_point(DVec2::ZERO);
    let (mut pixel, mut distances, mut directions) = (f64::INFINITY, Vec::new(), Vec::new());
    for frame in &model.train {
        let f = &model.capture.frames[*frame];
        let seen = f.world_from_camera.inverse().point(middle);
        let way = middle - f.world_from_camera.translation;
        if rectangle.reading_frame(DVec2::ZERO).z_axis.dot(way) >= 0.0 || !f.camera.shows(seen) {
            continue;
        }
        pixel = pixel.min(seen.length() / model.posed(*frame).camera.fx);
        distances.push(way.length());
        directions.push(way.normalize());
    }
    distances.sort_by(f64::total_cmp);
    Facing { pixel, distance: distances.get(distances.len() / 2).copied().unwrap_or(0.0), directions }
}

/// Renders a region from its front; none where no photograph shows it.
pub fn frontal(model: &TextModel, rectangle: &Rectangle) -> Option<Frontal> {
    let facing = photographs(model, rectangle);
    let directions = directions::clustered(&facing.directions);
    if directions.is_empty() {
        return None;
    }
    let half = 0.5 * rectangle.reading_size();
    let half = half + 2.0 * MARGIN * half.y;
    let pixel = facing.pixel.min(2.0 * half.y / LEAST_HEIGHT);
    let width = ((2.0 * half.x / pixel).ceil() as usize).clamp(8, WIDEST);
    let height = ((width as f64 * half.y / half.x).round() as usize).max(8);
    let (mut batch, mut buf) = (rays(model, rectangle, (half, facing.distance), [width, height]), FieldBuffers::default());
    let mut known = Vec::new();
    let views = directions
        .iter()
        .map(|d| {
            let tracer = Tracer { seen_along: Some(along(model, *d)), ..model.tracer(Quality::Full) };
            let traced = tracer.trace(&mut batch, &mut buf);
            known = traced.opacity.iter().map(|o| *o > KNOWN).collect();
            let opaque = traced.rgb.chunks_exact(3).zip(&traced.opacity).flat_map(|(c, o)| [0, 1, 2].map(|k| c[k] / o.max(KNOWN)));
            Image { width, height, channels: 3, data: opaque.map(|v| v.clamp(0.0, 1.0)).collect() }
        })
        .collect();
    Some(Frontal { frame: [-half, half], directions, views, known })
}

/// A direction of the world in model space.
fn along(model: &TextModel, direction: DVec3) -> [f32; 3] {
    (model.model_from_world.rotation * direction).to_array().map(|v| v as f32)
}

/// Rays of a camera on the normal at a distance through the pixels of a picture of the rectangle and its margin.
fn rays(model: &TextModel, rectangle: &Rectangle, (half, distance): (DVec2, f64), [width, height]: [usize; 2]) -> RayBatch {
    let to_model = &model.model_from_world;
    let eye = rectangle.reading_point(DVec2::ZERO) + distance * rectangle.reading_frame(DVec2::ZERO).z_axis;
    let eye = to_model.point(eye);
    let mut batch = RayBatch::default();
    batch.resize(width * height);
    for i in 0..width * height {
        let share = dvec2((i % width) as f64 + 0.5, (i / width) as f64 + 0.5) / dvec2(width as f64, height as f64);
        let at = dvec2(2.0 * share.x - 1.0, 1.0 - 2.0 * share.y) * half;
        let way = to_model.point(rectangle.reading_point(at)) - eye;
        let length = way.length();
        batch.origins[3 * i..3 * i + 3].copy_from_slice(&eye.to_array().map(|v| v as f32));
        batch.dirs[3 * i..3 * i + 3].copy_from_slice(&(way / length).to_array().map(|v| v as f32));
        batch.near_far[2 * i..2 * i + 2].copy_from_slice(&BAND.map(|b| (b * length) as f32));
        (batch.images[i], batch.jitter[i]) = (0, 0.5);
    }
    batch
}
