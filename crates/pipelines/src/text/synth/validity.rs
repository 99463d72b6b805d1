//! Whether a camera may be used: it stands in free space, sees the region, and shows what photographs have shown.

use super::super::label::in_view::{self, OnSurface, READABLE_PX};
use super::super::placed::PlacedRegion;
use super::scene::SynthScene;
use diorama_engine::fields::FieldBuffers;
use diorama_engine::renderers::volume::Quality;
use diorama_engine::samplers::RayBatch;
use diorama_geom::glam::{DVec2, DVec3};
use diorama_geom::{Camera, Pose};
use serde::Serialize;

/// Radius of free space around a camera over the region's distance, and opacity from which it is not free.
const FREE: f64 = 0.05;
const OPAQUE: f32 = 0.5;
/// Transmittance to the region's middle, over that of the photographs.
const LIGHT: f32 = 0.9;
/// Share of the region that is in the picture.
const INSIDE: f64 = 0.9;
/// Largest angle between the rays of the camera and of the nearest photograph to the region, and the ratio of their distances.
const ANGLE: f64 = 35.0;
const DISTANCES: [f64; 2] = [0.5, 2.0];
/// Pixels of the coarse view along its longer side; least share of it that at least two photographs show, most share without a surface.
const COARSE: u32 = 32;
const COVERED: f64 = 0.85;
const EMPTY: f64 = 0.05;
/// Share of the depth by which a photograph's surface may be nearer.
const DEPTH: f64 = 0.1;

/// The check that a camera fails first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, thiserror::Error)]
#[serde(rename_all = "snake_case")]
pub enum Fault {
    #[error("no camera shows the region at this place, size and angle")]
    NoCamera,
    #[error("less than 90 % of the region is in the picture")]
    Outside,
    #[error("its writing is less than 8 pixels high")]
    Small,
    #[error("its angle to the nearest photograph's view is above 35°")]
    Angle,
    #[error("it is less than half or more than twice as far away as the nearest photograph")]
    Distance,
    #[error("it stands in matter")]
    InMatter,
    #[error("something hides the region")]
    Hidden,
    #[error("more than 5 % of the picture has no surface")]
    Empty,
    #[error("less than 85 % of the picture is shown by two photographs")]
    Uncovered,
}

impl SynthScene {
    /// Checks a camera that is to show a region.
    ///
    /// # Errors
    /// With the first check that fails, cheap ones first.
    pub fn check(&self, region: &PlacedRegion, camera: &Camera, pose: &Pose) -> Result<(), Fault> {
        let middle = self.check_geometry(region, camera, pose)?;
        let distance = middle.distance(pose.translation);
        if self.is_in_matter(pose.translation, FREE * distance) {
            return Err(Fault::InMatter);
        }
        let light = in_view::transmittance(&self.model, pose.translation, &[middle], region.front);
        let usual = self.regions.iter().position(|r| r.id == region.id).map_or(1.0, |k| self.lights[k]);
        if light[0] <= LIGHT * usual {
            return Err(Fault::Hidden);
        }
        self.check_view(camera, pose)
    }

    /// The checks that need no view: size, place, angle and distance; returns the region's middle.
    ///
    /// # Errors
    /// With the first check that fails.
    pub(super) fn check_geometry(&self, region: &PlacedRegion, camera: &Camera, pose: &Pose) -> Result<DVec3, Fault> {
        let rectangle = region.rectangle.as_ref().ok_or(Fault::NoCamera)?;
        let middle = rectangle.reading_point(DVec2::ZERO);
        self.check_picture(region, camera, pose)?;
        self.check_photographs(middle, pose.translation)?;
        Ok(middle)
    }

    /// Whether enough of the region is in the picture.
    fn check_picture(&self, region: &PlacedRegion, camera: &Camera, pose: &Pose) -> Result<(), Fault> {
        let word = OnSurface::of(region).ok_or(Fault::NoCamera)?;
        let seen = in_view::seen(word.rectangle, word.bounds, camera, pose).ok_or(Fault::Outside)?;
        let inside = super::super::regions::clipped(&seen.polygon, [camera.width as f64, camera.height as f64]);
        let share = in_view::area(&inside) / in_view::area(&seen.polygon);
        if super::super::regions::shortest_side(&seen.quad) < READABLE_PX {
            return Err(Fault::Small);
        }
        if share >= INSIDE { Ok(()) } else { Err(Fault::Outside) }
    }

    /// Whether a photograph sees the region from about there.
    fn check_photographs(&self, middle: DVec3, eye: DVec3) -> Result<(), Fault> {
        let way = eye - middle;
        let angle = |other: &DVec3| way.angle_between(*other);
        let model = self.model.model_from_world.point(middle);
        let ways = (0..self.photographs.len()).filter(|k| self.shows(*k, model, DEPTH)).map(|k| self.photographs[k].0.translation - middle);
        let nearest = ways.min_by(|a, b| angle(a).total_cmp(&angle(b))).ok_or(Fault::Angle)?;
        if angle(&nearest) > ANGLE.to_radians() {
            return Err(Fault::Angle);
        }
        let ratio = way.length() / nearest.length();
        if (DISTANCES[0]..=DISTANCES[1]).contains(&ratio) { Ok(()) } else { Err(Fault::Distance) }
    }

    /// Whether there is matter within a radius of a point, along the axes and the diagonals.
    fn is_in_matter(&self, eye: DVec3, radius: f64) -> bool {
        let to_model = &self.model.model_from_world;
        let (origin, far) = (to_model.point(eye), (radius * to_model.scale) as f32);
        let axis = |k: usize, sign: f64| {
            let mut v = DVec3::ZERO;
            v[k] = sign;
            v
        };
        let axes = (0..6).map(|i| axis(i / 2, 1.0 - 2.0 * (i % 2) as f64));
        let diagonals = (0..8).map(|i| DVec3::from([0, 1, 2].map(|k| 1.0 - 2.0 * ((i >> k) & 1) as f64)).normalize());
        let ways: Vec<DVec3> = axes.chain(diagonals).collect();
        let (mut batch, mut buf) = (RayBatch::default(), FieldBuffers::default());
        batch.resize(ways.len());
        for (i, way) in ways.iter().enumerate() {
            batch.origins[3 * i..3 * i + 3].copy_from_slice(&origin.to_array().map(|v| v as f32));
            batch.dirs[3 * i..3 * i + 3].copy_from_slice(&way.to_array().map(|v| v as f32));
            batch.near_far[2 * i..2 * i + 2].copy_from_slice(&[0.0, far]);
            (batch.images[i], batch.jitter[i]) = (0, 0.5);
        }
        let traced = self.model.tracer(Quality::Full).trace(&mut batch, &mut buf);
        traced.opacity.iter().any(|o| *o > OPAQUE)
    }

    /// Whether a coarse view has surfaces, and photographs have shown them.
    fn check_view(&self, camera: &Camera, pose: &Pose) -> Result<(), Fault> {
        let longer = camera.width.max(camera.height) as f64;
        let size = [camera.width, camera.height].map(|v| ((v as f64 * COARSE as f64 / longer) as u32).max(1));
        let posed = self.posed(&camera.resized(size[0], size[1]), pose);
        let view = self.model.tracer(Quality::Fast).view(&posed, &mut |_| ());
        let n = view.opacity.data.len();
        let empty = view.opacity.data.iter().filter(|o| **o < OPAQUE).count();
        if empty as f64 > EMPTY * n as f64 {
            return Err(Fault::Empty);
        }
        let is_covered = |i: &usize| {
            let (x, y) = ((i % size[0] as usize) as f64 + 0.5, (i / size[0] as usize) as f64 + 0.5);
            let way = posed.pose.rotation * posed.camera.direction(x, y).normalize();
            let point = posed.pose.translation + way * view.depth.data[*i] as f64;
            (0..self.photographs.len()).filter(|k| self.shows(*k, point, DEPTH)).take(2).count() == 2
        };
        let covered = (0..n).filter(is_covered).count();
        if (covered as f64) < COVERED * n as f64 { Err(Fault::Uncovered) } else { Ok(()) }
    }
}
