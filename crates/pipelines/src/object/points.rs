//! A point cloud of the field's surface as the training cameras see it.

use super::export::{Size, metres_per_unit, to_capture};
use super::extent;
use super::model::ObjectModel;
use crate::error::{PipelineError, Result};
use diorama_data::point_cloud;
use diorama_engine::fields::FieldBuffers;
use diorama_engine::renderers::volume::{Backdrop, Quality, Tracer};
use diorama_engine::samplers::{RayBatch, pixels};
use diorama_geom::Mesh;
use diorama_geom::glam::DVec3;
use diorama_geom::rng::Rng;
use diorama_kernels::ops::ray_generation::PosedCamera;
use serde::Serialize;
use std::path::PathBuf;
use std::time::Instant;

/// Files of points.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PointFormat {
    Ply,
    Las,
    E57,
}

impl PointFormat {
    /// Whether coordinates are in meters by the format's standard.
    pub fn has_units(self) -> bool {
        self == PointFormat::E57
    }
}

impl std::str::FromStr for PointFormat {
    type Err = String;

    fn from_str(s: &str) -> std::result::Result<Self, String> {
        match s.to_ascii_lowercase().as_str() {
            "ply" => Ok(PointFormat::Ply),
            "las" => Ok(PointFormat::Las),
            "e57" => Ok(PointFormat::E57),
            _ => Err(format!("format {s:?}: points are written as ply, las or e57")),
        }
    }
}

/// Which part of the world is taken.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Region {
    /// What most cameras look at.
    Auto,
    /// Everything that any camera sees.
    Everything,
    /// Lowest and highest corner in the world.
    Box([f32; 3], [f32; 3]),
}

/// How to take points.
#[derive(Clone, Debug, PartialEq)]
pub struct PointOptions {
    pub format: PointFormat,
    pub out: PathBuf,
    pub points: usize,
    pub region: Region,
    pub size: Size,
    /// Unit of the coordinates, in meters, of formats that do not tell theirs.
    pub unit_m: f64,
}

/// Points where nobody says how many, and the most.
pub const POINTS: usize = 1_000_000;
pub const MOST_POINTS: usize = 50_000_000;

/// What was written.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ExportedPoints {
    pub file: PathBuf,
    pub points: usize,
    /// Points that were asked for.
    pub asked: usize,
    pub bytes: u64,
    pub seconds: f64,
    /// Extent in meters along x, y, z (z up).
    pub extent_m: [f32; 3],
    /// Meters per unit of the capture.
    pub scale: f64,
}

/// Rays that are traced at once.
const RAYS: usize = 1 << 16;
/// The least length, in shares of the region's longest side and of the distance to the camera, within which a ray must meet its
/// surface for the surface to count; a mean of two surfaces lies between them, in the empty.
const CELL: f64 = 1.0 / 320.0;
const FAR_CELL: f64 = 0.005;
const REACH: f32 = 3.0;
/// Light that a surface must stop.
const OPAQUE: f32 = 0.5;
/// Rays per wanted point after which the search ends.
const PATIENCE: usize = 40;
/// Stream of random numbers for pixels.
const STREAM: u64 = 0x706f_696e_7473;

/// Draws pixels of the training cameras at random, follows their rays to the surface, and writes what they meet with colors and
/// normals; `progress` receives the stage and (done, of).
///
/// # Errors
/// When no camera sees a surface in the region, the device that was named failed, or the disk refuses.
pub fn export(model: &ObjectModel, o: &PointOptions, progress: &mut dyn FnMut(&str, usize, usize)) -> Result<ExportedPoints> {
    let start = Instant::now();
    if !(1..=MOST_POINTS).contains(&o.points) {
        return Err(PipelineError::Usage(format!("--points {}: must be 1 to {MOST_POINTS}", o.points)));
    }
    let mut cloud = sample(model, o, progress);
    model.check_device()?;
    to_capture(model, &mut cloud);
    let scale = metres_per_unit(&cloud, o.size);
    let extent_m = cloud.bounds().map_or([0.0; 3], |(lo, hi)| std::array::from_fn(|k| ((hi[k] - lo[k]) as f64 * scale) as f32));
    let unit = if o.format.has_units() { 1.0 } else { o.unit_m };
    cloud.positions.iter_mut().flatten().for_each(|v| *v = (*v as f64 * scale / unit) as f32);
    match o.format {
        PointFormat::Ply => point_cloud::save_ply(&o.out, &cloud),
        PointFormat::Las => point_cloud::save_las(&o.out, &cloud),
        PointFormat::E57 => point_cloud::save_e57(&o.out, &cloud),
    }?;
    Ok(ExportedPoints {
        file: o.out.clone(),
        points: cloud.positions.len(),
        asked: o.points,
        bytes: std::fs::metadata(&o.out).map_or(0, |m| m.len()),
        seconds: start.elapsed().as_secs_f64(),
        extent_m,
        scale,
    })
}

/// Points in the world with normals and colors.
fn sample(model: &ObjectModel, o: &PointOptions, progress: &mut dyn FnMut(&str, usize, usize)) -> Mesh {
    let cameras = model.cameras();
    let region = match o.region {
        Region::Auto => Some(extent::of(model)),
        Region::Everything => None,
        Region::Box(lo, hi) => Some((lo, hi)),
    };
    let to_model = |p: [f32; 3]| model.model_from_world.point(DVec3::from(p.map(f64::from))).as_vec3().to_array();
    let clip = region.map(|(lo, hi)| (to_model(lo), to_model(hi)));
    let (lo, hi) = clip.unwrap_or(([0.0; 3], [1.0; 3]));
    let cell = CELL as f32 * (0..3).map(|k| hi[k] - lo[k]).fold(0.0, f32::max);
    let mut tracer = model.tracer(Quality::Full);
    tracer.backdrop = Backdrop::Color([0.0; 3]);
    tracer.clip = clip;
    let rng = Rng::new(model.config.seed, STREAM);
    let (mut batch, mut buf) = (RayBatch::default(), FieldBuffers::default());
    let mut cloud = Mesh::default();
    let world_from_model = model.model_from_world.inverse();
    let mut drawn = 0u64;
    while cloud.positions.len() < o.points && drawn < (o.points * PATIENCE).max(1 << 20) as u64 {
        let n = RAYS.min(2 * (o.points - cloud.positions.len()).max(1 << 10));
        draw(&cameras, &rng, drawn, n, &mut batch);
        drawn += n as u64;
        let found = surface(&tracer, model.cube(), &cameras, (&mut batch, &mut buf), cell);
        let found = &found[..found.len().min(o.points - cloud.positions.len())];
        let normals = normals(model, found, cell);
        for (p, n) in found.iter().zip(normals) {
            let at = DVec3::from(p.position.map(f64::from));
            let p_in_world = world_from_model.point(at).as_vec3().to_array();
            // The middle of a soft surface may lie a little outside of the box that its ray entered.
            if region.is_some_and(|(lo, hi)| (0..3).any(|k| !(lo[k]..=hi[k]).contains(&p_in_world[k]))) {
                continue;
            }
            cloud.positions.push(p_in_world);
            cloud.normals.push(n);
            let mut color = [p.rgb];
            model.encode(&mut color);
            cloud.colors_srgb.extend(color);
        }
        progress("points", cloud.positions.len(), o.points);
    }
    cloud
}

/// What a ray meets, in model space.
struct Met {
    position: [f32; 3],
    direction: [f32; 3],
    rgb: [f32; 3],
}

/// Draws pixels at random, each camera as often as the others.
fn draw(cameras: &[PosedCamera], rng: &Rng, first: u64, n: usize, batch: &mut RayBatch) {
    batch.resize(n);
    for i in 0..n {
        let at = 3 * (first + i as u64);
        let image = rng.below(at, cameras.len() as u64) as usize;
        let camera = &cameras[image].camera;
        batch.images[i] = image as u32;
        batch.pixels[i * 2] = rng.uniform(at + 1) * camera.width as f32;
        batch.pixels[i * 2 + 1] = rng.uniform(at + 2) * camera.height as f32;
        batch.jitter[i] = 0.5;
    }
}

/// Follows rays to where their light comes from on average, and keeps those that meet a surface there.
fn surface(
    tracer: &Tracer,
    cube: (f32, f32),
    cameras: &[PosedCamera],
    (batch, buf): (&mut RayBatch, &mut FieldBuffers),
    cell: f32,
) -> Vec<Met> {
    pixels::rays(cameras, tracer.near, cube, batch);
    // All wear the mean appearance.
    let images = std::mem::take(&mut batch.images);
    batch.images = vec![0; images.len()];
    let far = tracer.trace(batch, buf);
    let mut close = RayBatch::default();
    let rays: Vec<usize> = (0..batch.len()).filter(|r| far.opacity[*r] > OPAQUE).collect();
    close.resize(rays.len());
    for (i, &r) in rays.iter().enumerate() {
        let t = far.depth[r] / far.opacity[r];
        let reach = REACH * cell.max(FAR_CELL as f32 * t);
        close.origins[i * 3..i * 3 + 3].copy_from_slice(&batch.origins[r * 3..r * 3 + 3]);
        close.dirs[i * 3..i * 3 + 3].copy_from_slice(&batch.dirs[r * 3..r * 3 + 3]);
        (close.near_far[i * 2], close.near_far[i * 2 + 1]) = ((t - reach).max(tracer.near), t + reach);
        (close.jitter[i], close.images[i]) = (0.5, 0);
    }
    let near = Tracer { clip: None, ..*tracer }.trace(&mut close, buf);
    let met = |i: usize| {
        let opacity = near.opacity[i];
        (opacity > OPAQUE).then(|| {
            let t = near.depth[i] / opacity;
            let at = |v: &[f32]| -> [f32; 3] { std::array::from_fn(|k| v[i * 3 + k]) };
            let (origin, direction, rgb) = (at(&close.origins), at(&close.dirs), at(&near.rgb));
            Met { position: std::array::from_fn(|k| origin[k] + t * direction[k]), direction, rgb: rgb.map(|v| v / opacity) }
        })
    };
    (0..rays.len()).filter_map(met).collect()
}

/// Unit normals `−∇σ` that face the cameras, in the world (whose axes are the model's), by central differences.
fn normals(model: &ObjectModel, met: &[Met], cell: f32) -> Vec<[f32; 3]> {
    let mut points = Vec::with_capacity(met.len() * 18);
    for m in met {
        for k in 0..3 {
            for s in [cell, -cell] {
                let mut q = m.position;
                q[k] += s;
                points.extend(q);
            }
        }
    }
    let mut sigma = vec![0.0; points.len() / 3];
    model.model_density(&points, &mut sigma);
    sigma
        .chunks_exact(6)
        .zip(met)
        .map(|(s, m)| {
            let n = DVec3::from([s[1] - s[0], s[3] - s[2], s[5] - s[4]].map(f64::from));
            let d = DVec3::from(m.direction.map(f64::from));
            let n = n.try_normalize().unwrap_or(-d);
            (if n.dot(d) > 0.0 { -n } else { n }).as_vec3().to_array()
        })
        .collect()
}
