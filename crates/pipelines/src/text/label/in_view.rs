//! Text regions in views: quadrilaterals, outlines, poses, and how much of them a view shows.

use super::super::field::model::TextModel;
use super::super::placed::PlacedRegion;
use super::super::regions::TextPose;
use super::super::regions::{GRID, clipped, shortest_side};
use super::super::surface::{Kind, Rectangle};
use super::super::truth::rows;
use diorama_data::text_labels::{self, UNREADABLE};
use diorama_data::text_set::{SetCharacter, SetWord, WordPose};
use diorama_engine::fields::{FieldBuffers, Pruning};
use diorama_engine::renderers::volume::Tracer;
use diorama_engine::samplers::RayBatch;
use diorama_geom::glam::{DVec2, DVec3, dvec2};
use diorama_geom::{Camera, Pose};
use serde::{Deserialize, Serialize};

/// Visibility below which a region is left out, and below which nobody is to read it.
pub const LEAST_VISIBLE: f64 = 0.1;
pub const READABLE: f64 = 0.5;
/// Length of the shortest side in pixels below which nobody is to read it.
pub const READABLE_PX: f64 = 8.0;
/// Points of the upper and the lower edge of a region that bends.
const BENT_POINTS: usize = 10;
/// Transmittance from which a point is seen.
const SEEN: f32 = 0.5;
/// Where less light is left than any check asks for, rays end.
const DARK: Pruning = Pruning { stop: 0.1, min_alpha: 0.0, thin: f32::INFINITY, min_weight: 0.0 };
/// Steps along the ray before a surface that are its own at least.
const STEPS: f64 = 1.5;

/// A word on a rectangle.
#[derive(Clone, Copy)]
pub struct OnSurface<'a> {
    pub rectangle: &'a Rectangle,
    /// Reading coordinates of its lower left and upper right corner.
    pub bounds: [DVec2; 2],
    pub id: u32,
    pub transcription: &'a str,
    pub script: Option<&'a str>,
    /// See [`PlacedRegion::front`].
    pub front: f64,
    /// Its characters, as far as they are known, with their bounds.
    pub characters: &'a [Lettered],
}

/// A character and the reading coordinates of its lower left and upper right corner.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Lettered {
    pub text: String,
    pub bounds: [DVec2; 2],
}

impl<'a> OnSurface<'a> {
    /// The whole of a region; none without a rectangle.
    pub fn of(region: &'a PlacedRegion) -> Option<OnSurface<'a>> {
        let rectangle = region.rectangle.as_ref()?;
        let half = 0.5 * rectangle.reading_size();
        let (id, transcription, script, front) = (region.id, &region.transcription[..], region.script.as_deref(), region.front);
        Some(OnSurface { rectangle, bounds: [-half, half], id, transcription, script, front, characters: &[] })
    }

    /// Reading coordinates of a point of the grid of [`GRID`] points.
    pub fn grid_point(&self, i: usize) -> DVec2 {
        let [columns, rows] = GRID;
        let share = dvec2((i % columns) as f64 + 0.5, (i / columns) as f64 + 0.5) / dvec2(columns as f64, rows as f64);
        let [low, high] = self.bounds;
        low + share * (high - low)
    }
}

/// How a part of a rectangle appears to a camera.
#[derive(Clone, Debug, PartialEq)]
pub struct InView {
    /// Corners of what of it faces the camera, clockwise from the upper left in reading order, in pixels, also outside of the picture.
    pub quad: [[f64; 2]; 4],
    pub polygon: Vec<[f64; 2]>,
    pub pose: TextPose,
    pub size: DVec2,
}

/// What of a part of a rectangle faces a camera, by its lower left and upper right corner in reading coordinates; none where it turns its back
/// or is partly behind the camera.
pub fn seen(rectangle: &Rectangle, bounds: [DVec2; 2], camera: &Camera, pose: &Pose) -> Option<InView> {
    let [low, high] = rectangle.facing(pose.translation)?;
    let [from, to] = [dvec2(bounds[0].x.max(low), bounds[0].y), dvec2(bounds[1].x.min(high), bounds[1].y)];
    (from.x < to.x).then(|| part(rectangle, [from, to], camera, pose)).flatten()
}

/// The same of a part that is known to face the camera.
fn part(rectangle: &Rectangle, [low, high]: [DVec2; 2], camera: &Camera, pose: &Pose) -> Option<InView> {
    let camera_from_world = pose.inverse();
    let at = |x: f64, y: f64| camera.project(camera_from_world.point(rectangle.reading_point(dvec2(x, y)))).map(|p| p.to_array());
    let quad = [at(low.x, high.y)?, at(high.x, high.y)?, at(high.x, low.y)?, at(low.x, low.y)?];
    let along = |y: f64, from: f64, to: f64| {
        (0..BENT_POINTS).map(move |k| at(from + (to - from) * k as f64 / (BENT_POINTS - 1) as f64, y)).collect::<Option<Vec<_>>>()
    };
    let polygon = if rectangle.surface.kind == Kind::Plane {
        quad.to_vec()
    } else {
        [along(high.y, low.x, high.x)?, along(low.y, high.x, low.x)?].concat()
    };
    let middle = 0.5 * (low + high);
    let pose = TextPose {
        rotation: camera_from_world.rotation * rectangle.reading_frame(middle),
        translation: camera_from_world.point(rectangle.reading_point(middle)),
    };
    Some(InView { quad, polygon, pose, size: high - low })
}

/// Which points of a word's grid of [`GRID`] points are in the picture and face the camera, and which of these nothing hides.
pub struct Visible {
    pub in_picture: Vec<bool>,
    pub seen: Vec<bool>,
}

impl Visible {
    /// Share of the grid that is seen.
    pub fn share(&self) -> f64 {
        self.seen.iter().filter(|s| **s).count() as f64 / self.seen.len() as f64
    }
}

/// What a view shows of a word: transmittance just before its surface above one half.
pub fn visible(model: &TextModel, word: &OnSurface, camera: &Camera, pose: &Pose) -> Visible {
    let n = GRID[0] * GRID[1];
    let (rectangle, camera_from_world) = (word.rectangle, pose.inverse());
    let facing = rectangle.facing(pose.translation);
    let in_picture: Vec<bool> = (0..n)
        .map(|i| {
            let at = word.grid_point(i);
            let faces = facing.is_some_and(|[low, high]| (low..=high).contains(&at.x));
            faces && camera.shows(camera_from_world.point(rectangle.reading_point(at)))
        })
        .collect();
    let listed: Vec<usize> = (0..n).filter(|i| in_picture[*i]).collect();
    let points: Vec<DVec3> = listed.iter().map(|i| rectangle.reading_point(word.grid_point(*i))).collect();
    let light = transmittance(model, pose.translation, &points, word.front);
    let mut seen = vec![false; n];
    listed.iter().zip(light).for_each(|(i, light)| seen[*i] = light > SEEN);
    Visible { in_picture, seen }
}

/// Light that comes to an eye from `front` before points of the world, or from a few steps before them.
pub fn transmittance(model: &TextModel, eye: DVec3, points: &[DVec3], front: f64) -> Vec<f32> {
    if points.is_empty() {
        return Vec::new();
    }
    let to_model = &model.model_from_world;
    let origin = to_model.point(eye);
    let (mut batch, mut buf) = (RayBatch::default(), FieldBuffers::default());
    batch.resize(points.len());
    for (i, p) in points.iter().enumerate() {
        let way = to_model.point(*p) - origin;
        let (distance, direction) = (way.length(), way.normalize_or(DVec3::Z));
        let far = end(model, distance, front);
        let near = model.config.sampling.near;
        batch.origins[3 * i..3 * i + 3].copy_from_slice(&origin.to_array().map(|v| v as f32));
        batch.dirs[3 * i..3 * i + 3].copy_from_slice(&direction.to_array().map(|v| v as f32));
        batch.near_far[2 * i..2 * i + 2].copy_from_slice(&if far > near { [near, far] } else { [0.0; 2] });
        (batch.images[i], batch.jitter[i]) = (0, 0.5);
    }
    let tracer = model.tracer(super::QUALITY);
    let tracer = Tracer { placement: tracer.placement.with_pruning(DARK), ..tracer };
    tracer.trace(&mut batch, &mut buf).opacity.iter().map(|o| 1.0 - o).collect()
}

/// Where, in model space, what stands before a surface at a distance ends; `front` is in units of the capture.
pub fn end(model: &TextModel, distance: f64, front: f64) -> f32 {
    let march = model.occupancy.march_config(model.config.sampling.max_samples);
    let own = (front * model.model_from_world.scale).max(STEPS * march.step(distance as f32) as f64);
    (distance - own) as f32
}

/// A word as the label of a view of `camera`; none where less than [`LEAST_VISIBLE`] of it is visible.
pub fn labelled(model: &TextModel, word: &OnSurface, camera: &Camera, pose: &Pose) -> Option<SetWord> {
    let whole = seen(word.rectangle, word.bounds, camera, pose)?;
    let shown = visible(model, word, camera, pose);
    let visibility = shown.share();
    if visibility < LEAST_VISIBLE {
        return None;
    }
    let size = [camera.width as f64, camera.height as f64];
    let is_inside = |q: &[[f64; 2]; 4]| q.iter().all(|p| (0.0..=size[0]).contains(&p[0]) && (0.0..=size[1]).contains(&p[1]));
    // Where the border cuts it, the label is the part whose points are in the picture.
    let quad = match is_inside(&whole.quad) {
        true => whole.quad,
        false => within(part(word.rectangle, bounds(word, &shown.in_picture)?, camera, pose)?.quad, size),
    };
    // Where a bent outline crosses itself at its rim, its corners are the outline.
    let outline = if text_labels::check_polygon(&whole.polygon).is_ok() { &whole.polygon[..] } else { &whole.quad[..] };
    let polygon = clipped(outline, size);
    let is_sound = [&polygon[..], &quad].iter().all(|p| text_labels::check_polygon(p).is_ok() && area(p) > 0.0);
    let ignore = visibility < READABLE || shortest_side(&whole.quad) < READABLE_PX;
    let text_pose = rows(&whole.pose);
    let character = |c: &Lettered| {
        let quad = seen(word.rectangle, c.bounds, camera, pose)?.quad;
        let is_sound = is_inside(&quad) && area(&quad) > 0.0 && text_labels::check_polygon(&quad).is_ok();
        is_sound.then(|| SetCharacter { text: c.text.clone(), quad })
    };
    is_sound.then(|| SetWord {
        id: word.id,
        quad,
        polygon,
        transcription: if ignore { UNREADABLE.into() } else { word.transcription.into() },
        script: word.script.map(Into::into),
        ignore,
        visibility,
        pose: Some(WordPose::new(text_pose, whole.size.to_array())),
        cluster: None,
        characters: word.characters.iter().filter_map(character).collect(),
    })
}

/// Corners, lower left and upper right, of the cells of a word's grid for which something holds.
fn bounds(word: &OnSurface, holds: &[bool]) -> Option<[DVec2; 2]> {
    let size = word.bounds[1] - word.bounds[0];
    let half_cell = 0.5 * size / dvec2(GRID[0] as f64, GRID[1] as f64);
    let own = || (0..holds.len()).filter(|i| holds[*i]).map(|i| word.grid_point(i));
    Some([own().reduce(DVec2::min)? - half_cell, own().reduce(DVec2::max)? + half_cell])
}

/// Corners moved into a picture.
fn within(quad: [[f64; 2]; 4], size: [f64; 2]) -> [[f64; 2]; 4] {
    quad.map(|p| [0, 1].map(|k| p[k].clamp(0.0, size[k])))
}

/// Area of a polygon that is clockwise where y points down.
pub fn area(polygon: &[[f64; 2]]) -> f64 {
    let n = polygon.len();
    0.5 * (0..n).map(|k| DVec2::from(polygon[k]).perp_dot(DVec2::from(polygon[(k + 1) % n]))).sum::<f64>()
}
