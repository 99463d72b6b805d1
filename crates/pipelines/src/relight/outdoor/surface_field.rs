//! The scene model as meshing sees it: density and albedo at points and along short rays, and where matter may be.

use super::model::SceneModel;
use diorama_engine::fields::{Batch, DensityQuery, Encoded, Field, FieldBuffers};
use diorama_engine::renderers::layers::Layers;
use diorama_engine::renderers::volume::{Quality, Tracer};
use diorama_engine::samplers::RayBatch;
use diorama_geom::Camera;
use diorama_geom::capture::Frame;
use diorama_geom::color::srgb_from_linear;
use diorama_geom::field_query::FieldQuery;
use diorama_geom::glam::DVec3;
use diorama_kernels::ops::composite::Packed;
use diorama_kernels::ops::march::OccupancyBits;
use diorama_kernels::ops::ray_generation::PosedCamera;
use rayon::prelude::*;

/// Points per evaluation.
const CHUNK: usize = 1 << 16;
/// Opacity of a short ray from which its albedo counts.
const MATTER: f32 = 0.2;

/// A trained model without what meshing does not need: normals along rays.
pub struct SurfaceField<'a> {
    pub model: &'a SceneModel,
    field: Field,
}

impl<'a> SurfaceField<'a> {
    /// Of a trained model.
    pub fn new(model: &'a SceneModel) -> SurfaceField<'a> {
        SurfaceField { model, field: Field { normals: None, ..model.field.for_rendering() } }
    }

    fn tracer(&self) -> Tracer<'_> {
        Tracer { field: &self.field, ..self.model.tracer(Quality::Full) }
    }

    fn srgb_albedo(&self, v: f32) -> f32 {
        srgb_from_linear(self.model.linear_albedo(v).clamp(0.0, 1.0))
    }

    fn to_model(&self, p_in_world: [f32; 3]) -> [f32; 3] {
        self.model.model_from_world.point(DVec3::from(p_in_world.map(f64::from))).as_vec3().to_array()
    }

    /// Whether the occupancy grid has matter in a box of the world, given by its lowest and highest corner.
    pub fn may_hold(&self, low: [f32; 3], high: [f32; 3]) -> bool {
        let (low, high) = (self.to_model(low), self.to_model(high));
        let (corner, edge) = self.model.cube();
        let (low, high) = (low.map(|v| v.max(corner)), high.map(|v| v.min(corner + edge)));
        if (0..3).any(|k| low[k] >= high[k]) {
            return false;
        }
        let occupancy = &self.model.occupancy;
        let bits = occupancy.bits();
        let reaches = |c: &usize| {
            let (corner, size) = OccupancyBits::cube(*c);
            (0..3).all(|k| low[k] >= corner && high[k] <= corner + size)
        };
        match (0..bits.cascades).find(reaches) {
            Some(cascade) => any_occupied(bits, cascade, low, high),
            None => occupancy.unbounded || any_occupied(bits, bits.cascades - 1, low, high),
        }
    }

    /// Opacity and expected distance, in units of the world, in a small view of a frame, at most `longest` pixels wide and high; and its
    /// camera.
    pub fn depth_view(&self, frame: &Frame, longest: u32) -> (Layers, Camera) {
        let c = &frame.camera;
        let shrink = (longest as f64 / c.width.max(c.height) as f64).min(1.0);
        let small = c.resized(((c.width as f64 * shrink) as u32).max(1), ((c.height as f64 * shrink) as u32).max(1));
        let posed = PosedCamera { camera: small, pose: self.model.model_from_world.pose(&frame.world_from_camera) };
        let mut view = self.tracer().layers(&posed, &self.model.unlit_codes(), &mut |_| {});
        let scale = self.model.model_from_world.scale as f32;
        view.depth.data.iter_mut().for_each(|d| *d /= scale);
        (view, small)
    }

    /// sRGB albedo `[N]` along short rays that end at `reach` behind the points of the surface and begin as far before them, against the
    /// normals; negative where a ray meets nothing. `progress` receives the rays done and their number.
    ///
    /// # Shapes
    /// positions, normals: `[N, 3]`.
    pub fn albedo(
        &self,
        positions: &[[f32; 3]],
        normals: &[[f32; 3]],
        reach: f32,
        progress: &mut dyn FnMut(usize, usize),
    ) -> Vec<[f32; 3]> {
        let mut out = Vec::with_capacity(positions.len());
        let tracer = Tracer { near: 0.0, ..self.tracer() };
        let reach = reach * self.model.model_from_world.scale as f32;
        let (mut batch, mut buf) = (RayBatch::default(), FieldBuffers::default());
        for (p, n) in positions.chunks(CHUNK).zip(normals.chunks(CHUNK)) {
            batch.resize(p.len());
            for (r, (p, n)) in p.iter().zip(n).enumerate() {
                let p = self.to_model(*p);
                let origin: [f32; 3] = std::array::from_fn(|k| p[k] + reach * n[k]);
                batch.origins[3 * r..3 * r + 3].copy_from_slice(&origin);
                batch.dirs[3 * r..3 * r + 3].copy_from_slice(&n.map(|v| -v));
                batch.near_far[2 * r..2 * r + 2].copy_from_slice(&[0.0, 2.0 * reach]);
                (batch.jitter[r], batch.images[r]) = (0.5, 0);
            }
            let traced = tracer.trace_layers(&mut batch, &self.model.unlit_codes(), &mut buf);
            let channels = self.field.channels();
            out.extend(traced.rgb.chunks_exact(channels).zip(&traced.opacity).map(|(v, o)| match *o > MATTER {
                true => std::array::from_fn(|k| self.srgb_albedo(v[k] / o)),
                false => [-1.0; 3],
            }));
            progress(out.len(), positions.len());
        }
        out
    }
}

/// Whether a cell of a cascade is occupied between two corners in model space.
fn any_occupied(bits: &OccupancyBits, cascade: usize, low: [f32; 3], high: [f32; 3]) -> bool {
    let (corner, size) = OccupancyBits::cube(cascade);
    let n = bits.resolution;
    let cell = |v: f32| (((v - corner) / size * n as f32) as usize).min(n - 1);
    let [x, y, z] = std::array::from_fn(|k| cell(low[k])..=cell(high[k]));
    z.into_iter().any(|z| {
        y.clone().any(|y| {
            let row = ((cascade * n + z) * n + y) * n;
            x.clone().any(|x| bits.get(row + x))
        })
    })
}

impl FieldQuery for SurfaceField<'_> {
    fn density(&self, points_in_world: &[[f32; 3]], sigma: &mut [f32]) {
        let model: Vec<[f32; 3]> = points_in_world.par_iter().map(|p| self.to_model(*p)).collect();
        self.field.density(model.as_flattened(), sigma);
        // Per model unit to per world unit; nothing lies outside of the scene's cube.
        let (low, size) = self.model.cube();
        let scale = self.model.model_from_world.scale as f32;
        for (s, p) in sigma.iter_mut().zip(&model) {
            let inside = p.iter().all(|v| (low..=low + size).contains(v));
            *s = if inside { *s * scale } else { 0.0 };
        }
    }

    /// The albedo, which is the same from every direction.
    fn color(&self, points_in_world: &[[f32; 3]], directions: &[[f32; 3]], rgb_srgb: &mut [[f32; 3]]) {
        let mut buf = FieldBuffers::default();
        let channels = self.field.channels();
        for ((p, d), out) in points_in_world.chunks(CHUNK).zip(directions.chunks(CHUNK)).zip(rgb_srgb.chunks_mut(CHUNK)) {
            let positions: Vec<f32> = p.iter().flat_map(|p| self.to_model(*p)).collect();
            // One sample per ray, so long that it is opaque.
            let offsets: Vec<u32> = (0..=p.len() as u32).collect();
            let (t, dt, background) = (vec![0.0; p.len()], vec![1e30f32; p.len()], vec![0.0; p.len() * channels]);
            let codes: Vec<Vec<f32>> = self.model.unlit_codes().iter().map(|c| c.repeat(p.len())).collect();
            let given: Vec<&[f32]> = codes.iter().map(|c| &c[..]).collect();
            let mut encoded = Encoded::default();
            self.field.encode(&positions, &mut encoded);
            let batch = Batch {
                samples: Packed { offsets: &offsets, t: &t, dt: &dt },
                positions: &positions,
                dirs: d.as_flattened(),
                images: None,
                given: &given,
                background: &background,
                near_scaling: 0.0,
            };
            self.field.render(&batch, &mut encoded, &mut buf);
            let linear = buf.out.values.chunks_exact(channels);
            out.iter_mut().zip(linear).for_each(|(o, v)| *o = std::array::from_fn(|k| self.srgb_albedo(v[k])));
        }
    }
}
