//! Rendering on the device.

use super::place::{self, FieldRef, PlaceOn};
use super::shape::Shape;
use crate::fields::{Appearance, Field};
use crate::renderers::supervised::Unserved;
use crate::renderers::volume::{Accelerator, Traced};
use crate::samplers::RayBatch;
use crate::samplers::occupancy::Occupancy;
use crate::samplers::placement::Placement;
use diorama_kernels::gpu::{Buffer, Gpu, GpuError, Rows};
use diorama_kernels::ops::composite::gpu::{GpuComposited, GpuPacked};
use diorama_kernels::ops::field_step::gpu::{self as field, FieldInput};
use diorama_kernels::ops::march::gpu::{self as march, GpuOccupancy, GpuRays};
use std::sync::atomic::AtomicU32;
use std::sync::atomic::Ordering::Relaxed;

/// Samples per part: on a GPU, and where the CPU plays one.
const ROOM: usize = 1 << 21;
const SOFTWARE_ROOM: usize = 1 << 17;
/// Samples per part of networks that run layer by layer and keep the outputs of every layer.
const LAYERED_ROOM: usize = 1 << 16;
/// Samples per part at least.
const LEAST_ROOM: usize = 1 << 14;
/// Numbers per sample in the widest matrix, which must lie in one piece of memory.
const WIDTH: usize = 64;
/// Samples of a ray, before any is known.
const FIRST_GUESS: f32 = 64.0;
/// Share of the room that a part is meant to fill, and share of what rays needed before that is expected of the next at least.
const FILL: f32 = 0.8;
const FORGET: f32 = 0.7;

/// A trained field's parameters on the device.
struct ViewField {
    shape: Shape,
    table: Option<Buffer>,
    weights: Buffer,
    /// Codes of all images and their mean, `[images + 1, dims]`.
    appearance: Option<(Buffer, usize)>,
}

impl ViewField {
    fn upload(gpu: &Gpu, field: &Field) -> Self {
        let codes = |a: &Appearance| (gpu.upload(&[&a.group.values[..], &a.mean()].concat()), a.dims);
        ViewField {
            shape: Shape::new(gpu, field, false),
            table: field.encoder.table().map(|t| gpu.upload(&t.values)),
            weights: gpu.upload(&field.weights.values),
            appearance: field.codes.appearance.as_ref().map(codes),
        }
    }

    fn read(&self) -> FieldRef<'_> {
        FieldRef { shape: &self.shape, table: self.table.as_ref(), weights: &self.weights }
    }

    /// Evaluates and composites encoded samples before black.
    fn shade(
        &self,
        gpu: &Gpu,
        rays: &GpuRays,
        packed: &GpuPacked,
        (points, features): (&Buffer, &Buffer),
        appearance: Option<u32>,
    ) -> GpuComposited {
        let n = packed.rays();
        let direction = self.shape.direction(gpu, &rays.dirs);
        let code = self.appearance.as_ref().map(|(codes, dims)| {
            let mean = (codes.len() / dims - 1) as u32;
            field::look_up(gpu, codes, &gpu.upload(&vec![appearance.unwrap_or(mean); n]), *dims)
        });
        let codes: Vec<&Buffer> = direction.iter().chain(&code).collect();
        let black = gpu.zeros(n * self.shape.net.net.channels());
        let waves = self.shape.waves(gpu, points);
        let input = FieldInput { packed, features, codes: &codes, beside: waves.as_ref() };
        self.shape.net.forward(gpu, &self.weights, &input, &black, false).out
    }
}

/// Renders a trained field on the device.
pub struct GpuTracer {
    gpu: Gpu,
    field: ViewField,
    coarse: Option<ViewField>,
    occupancy: Option<GpuOccupancy>,
    /// Samples per part.
    room: usize,
    /// Marched samples per ray that the next part is expected to need, as bits of f32.
    per_ray: AtomicU32,
}

impl GpuTracer {
    pub fn new(gpu: Gpu, field: &Field, coarse: Option<&Field>, occupancy: Option<&Occupancy>) -> Self {
        let field = ViewField::upload(&gpu, field);
        let fitting = gpu.largest_buffer() as usize / (size_of::<f32>() * WIDTH);
        let all = if gpu.software { SOFTWARE_ROOM } else { ROOM.min(fitting).max(LEAST_ROOM) };
        GpuTracer {
            coarse: coarse.map(|f| ViewField::upload(&gpu, f)),
            occupancy: occupancy.map(|o| GpuOccupancy::upload(&gpu, o.bits())),
            room: if field.shape.net.element().is_some() || occupancy.is_some() { all } else { LAYERED_ROOM },
            per_ray: AtomicU32::new(FIRST_GUESS.to_bits()),
            field,
            gpu,
        }
    }

    /// The same tracer with memory for `samples` samples per part.
    #[must_use]
    pub fn with_room(self, samples: usize) -> Self {
        GpuTracer { room: samples, ..self }
    }

    /// Densities `[N]` at model points `[N, 3]`.
    ///
    /// # Errors
    /// When the device was lost.
    pub fn density(&self, model: &[f32]) -> Result<Vec<f32>, GpuError> {
        let (gpu, f) = (&self.gpu, &self.field);
        let mut out = Vec::with_capacity(model.len() / 3);
        for part in model.chunks(self.room * 3) {
            let n = part.len() / 3;
            let points = march::to_space(gpu, &gpu.upload(part), f.shape.space);
            let rows = Rows::all(gpu, n);
            let features = f.shape.features(gpu, &rows, &points, f.table.as_ref());
            out.extend(gpu.read(&f.shape.net.density(gpu, &f.weights, &features, &rows))?);
        }
        Ok(out)
    }

    /// Colors `[N, 3]` of the field at model points `[N, 3]`, viewed along unit directions `[N, 3]`, with the mean appearance code.
    ///
    /// # Errors
    /// When the device was lost.
    pub fn color(&self, model: &[f32], dirs: &[f32]) -> Result<Vec<f32>, GpuError> {
        let (gpu, f) = (&self.gpu, &self.field);
        let mut out = Vec::with_capacity(model.len());
        for (points, dirs) in model.chunks(self.room * 3).zip(dirs.chunks(self.room * 3)) {
            let n = points.len() / 3;
            // One sample per ray, so long that it is opaque.
            let offsets = gpu.upload(&(0..=n as u32).collect::<Vec<_>>());
            let packed = GpuPacked { offsets, t: gpu.zeros(n), dt: gpu.upload(&vec![1e30f32; n]) };
            let points = gpu.upload(points);
            let (near_far, jitter) = (gpu.zeros(n * 2), gpu.zeros(n));
            let rays = GpuRays { origins: points.clone(), dirs: gpu.upload(dirs), near_far, jitter, resumed: false };
            let points = march::to_space(gpu, &points, f.shape.space);
            let features = f.shape.features(gpu, &packed.rows(), &points, f.table.as_ref());
            out.extend(gpu.read(&f.shade(gpu, &rays, &packed, (&points, &features), None).color)?);
        }
        Ok(out)
    }

    /// Rays `first..first + n` of a batch; how many samples were marched to, or more, had there been room for them. Without room for all of them
    /// the rays are not added to `out`, unless `last_resort`.
    fn part(
        &self,
        batch: &RayBatch,
        (first, n): (usize, usize),
        (room, last_resort): (usize, bool),
        placement: &Placement,
        appearance: Option<u32>,
        out: &mut (Traced, Vec<f32>),
    ) -> Result<usize, GpuError> {
        let gpu = &self.gpu;
        let of = |v: &[f32], width: usize| gpu.upload(&v[first * width..(first + n) * width]);
        let rays = GpuRays {
            origins: of(&batch.origins, 3),
            dirs: of(&batch.dirs, 3),
            near_far: of(&batch.near_far, 2),
            jitter: of(&batch.jitter, 1),
            resumed: false,
        };
        let on = PlaceOn { field: self.field.read(), grid: self.occupancy.as_ref(), rays: &rays, first: 0, room: (room, room) };
        let mut weights = |packed: &GpuPacked| {
            let coarse = self.coarse.as_ref().expect("a coarse field");
            let (points, features) = coarse.read().encode(gpu, &rays, packed);
            Ok(coarse.shade(gpu, &rays, packed, (&points, &features), appearance).weights)
        };
        let samples = place::place(gpu, placement, &on, &mut weights)?;
        let view = self.field.shade(gpu, &rays, &samples.packed, (&samples.points, &samples.features), appearance);
        let light = samples.march.map_or_else(|| gpu.empty(0), |m| m.light);
        let [needed, light, rgb, opacity, depth] =
            gpu.read_together([&samples.marched.last().cast(), &light, &view.color, &view.opacity, &view.depth])?;
        let needed = needed[0].to_bits() as usize;
        if needed <= room || last_resort {
            out.1.extend(light);
            out.0.rgb.extend(rgb);
            out.0.opacity.extend(opacity);
            out.0.depth.extend(depth);
        }
        Ok(needed)
    }

    /// Traces a batch in parts of as many rays as find room for their samples, judged by the parts before.
    fn marched_parts(
        &self,
        batch: &RayBatch,
        placement: &Placement,
        appearance: Option<u32>,
        out: &mut (Traced, Vec<f32>),
    ) -> Result<(), GpuError> {
        let mut first = 0;
        while first < batch.len() {
            let expected = f32::from_bits(self.per_ray.load(Relaxed));
            let n = ((FILL * self.room as f32 / expected) as usize).clamp(1, batch.len() - first);
            let room = ((n as f32 * expected / FILL) as usize).next_power_of_two().clamp(LEAST_ROOM.min(self.room), self.room);
            let last_resort = n == 1 && room == self.room;
            let needed = self.part(batch, (first, n), (room, last_resort), placement, appearance, out)?;
            // Of a part that found no room it is known what that part needs at least.
            let is_done = needed <= room || last_resort;
            let floor = if is_done { FORGET * expected } else { 0.0 };
            self.per_ray.store((needed as f32 / n as f32).max(floor).max(1.0).to_bits(), Relaxed);
            if is_done {
                first += n;
            }
        }
        Ok(())
    }
}

fn unserved(e: GpuError) -> Unserved {
    Unserved::Failed(e.to_string())
}

impl Accelerator for GpuTracer {
    fn trace(&self, batch: &RayBatch, placement: &Placement, appearance: Option<u32>) -> Result<(Traced, Option<Vec<f32>>), Unserved> {
        let mut out = (Traced::default(), Vec::new());
        let per_ray = match placement {
            Placement::Occupancy { .. } => {
                self.marched_parts(batch, placement, appearance, &mut out).map_err(unserved)?;
                return Ok((out.0, Some(out.1)));
            }
            Placement::Stratified { samples, .. } => *samples,
            Placement::Hierarchical { samples, more, .. } => samples + more,
        };
        let at_once = (self.room / per_ray.max(1)).max(1);
        for first in (0..batch.len()).step_by(at_once) {
            let n = at_once.min(batch.len() - first);
            self.part(batch, (first, n), (self.room, true), placement, appearance, &mut out).map_err(unserved)?;
        }
        Ok((out.0, None))
    }

    fn density(&self, model: &[f32]) -> Result<Vec<f32>, Unserved> {
        GpuTracer::density(self, model).map_err(unserved)
    }

    fn color(&self, model: &[f32], dirs: &[f32]) -> Result<Vec<f32>, Unserved> {
        GpuTracer::color(self, model, dirs).map_err(unserved)
    }

    fn rays(&self) -> usize {
        if self.gpu.software { 1 << 12 } else { 1 << 17 }
    }
}
