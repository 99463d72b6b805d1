//! Views by the device.

use super::shape::Shape;
use crate::fields::{Appearance, Field, Pruning};
use crate::renderers::supervised::Unserved;
use crate::renderers::volume::{Accelerator, Placement, Traced};
use crate::samplers::RayBatch;
use crate::samplers::occupancy::Occupancy;
use diorama_kernels::gpu::{Buffer, Gpu, GpuError, Rows};
use diorama_kernels::ops::composite::gpu::{GpuComposited, GpuPacked};
use diorama_kernels::ops::field_step::gpu::{self as field, FieldInput};
use diorama_kernels::ops::march::MarchConfig;
use diorama_kernels::ops::march::gpu::{self as march, GpuOccupancy, GpuRays};
use diorama_kernels::ops::prune::gpu as prune;
use diorama_kernels::ops::sample_pdf::gpu::strata;

/// Samples that there is room for, and where the CPU plays the device.
const ROOM: usize = 1 << 20;
const SOFTWARE_ROOM: usize = 1 << 17;
/// Samples of a call where a network goes layer by layer and keeps all of its layers' outputs.
const LAYERED_ROOM: usize = 1 << 16;

/// A trained field's parameters on the device.
struct Looks {
    shape: Shape,
    table: Option<Buffer>,
    weights: Buffer,
    /// Codes of all images and their mean, `[images + 1, dims]`.
    appearance: Option<(Buffer, usize)>,
}

impl Looks {
    fn upload(gpu: &Gpu, field: &Field) -> Self {
        let codes = |a: &Appearance| (gpu.upload(&[&a.group.values[..], &a.mean()].concat()), a.dims);
        Looks {
            shape: Shape::new(gpu, field, false),
            table: field.encoder.table().map(|t| gpu.upload(&t.values)),
            weights: gpu.upload(&field.weights.values),
            appearance: field.codes.appearance.as_ref().map(codes),
        }
    }

    fn features(&self, gpu: &Gpu, rays: &GpuRays, packed: &GpuPacked) -> Buffer {
        let points = march::positions(gpu, rays, packed, self.shape.space);
        self.shape.features(gpu, &packed.rows(), &points, self.table.as_ref())
    }

    /// Samples composited before black.
    fn see(&self, gpu: &Gpu, rays: &GpuRays, packed: &GpuPacked, features: &Buffer, appearance: Option<u32>) -> GpuComposited {
        let n = packed.rays();
        let direction = self.shape.direction(gpu, &rays.dirs);
        let code = self.appearance.as_ref().map(|(codes, dims)| {
            let mean = (codes.len() / dims - 1) as u32;
            field::look_up(gpu, codes, &gpu.upload(&vec![appearance.unwrap_or(mean); n]), *dims)
        });
        let codes: Vec<&Buffer> = direction.iter().chain(&code).collect();
        let black = gpu.zeros(n * 3);
        self.shape.net.forward(gpu, &self.weights, &FieldInput { packed, features, codes: &codes }, &black, false).out
    }
}

/// A trained field on the device, ready to be looked at.
pub struct GpuTracer {
    gpu: Gpu,
    field: Looks,
    coarse: Option<Looks>,
    occupancy: Option<GpuOccupancy>,
    /// Samples that there is room for.
    room: usize,
}

impl GpuTracer {
    pub fn new(gpu: Gpu, field: &Field, coarse: Option<&Field>, occupancy: Option<&Occupancy>) -> Self {
        let field = Looks::upload(&gpu, field);
        let all = if gpu.software { SOFTWARE_ROOM } else { ROOM };
        GpuTracer {
            coarse: coarse.map(|f| Looks::upload(&gpu, f)),
            occupancy: occupancy.map(|o| GpuOccupancy::upload(&gpu, o.bits())),
            room: if field.shape.net.element().is_some() || occupancy.is_some() { all } else { LAYERED_ROOM },
            field,
            gpu,
        }
    }

    /// The same with room for other than the usual number of samples.
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

    /// The field's own colours `[N, 3]` at model points, seen along `dirs`, wearing the mean appearance.
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
            out.extend(gpu.read(&f.see(gpu, &rays, &packed, &features, None).color)?);
        }
        Ok(out)
    }

    /// Rays `first..first + n` of a batch; halves are traced apart where their samples find no room together.
    fn part(
        &self,
        batch: &RayBatch,
        (first, n): (usize, usize),
        placement: &Placement,
        pruning: Pruning,
        appearance: Option<u32>,
        out: &mut (Traced, Vec<f32>),
    ) -> Result<(), GpuError> {
        let gpu = &self.gpu;
        let of = |v: &[f32], width: usize| gpu.upload(&v[first * width..(first + n) * width]);
        let rays = GpuRays {
            origins: of(&batch.origins, 3),
            dirs: of(&batch.dirs, 3),
            near_far: of(&batch.near_far, 2),
            jitter: of(&batch.jitter, 1),
            resumed: false,
        };
        let view = match (placement, &self.occupancy, &self.coarse) {
            (Placement::March(config), Some(grid), _) => {
                let Some((view, light)) = self.marched(grid, &rays, config, pruning, appearance, n > 1)? else {
                    self.part(batch, (first, n / 2), placement, pruning, appearance, out)?;
                    return self.part(batch, (first + n / 2, n - n / 2), placement, pruning, appearance, out);
                };
                out.1.extend(gpu.read(&light)?);
                view
            }
            (Placement::Stratified { samples }, _, _) => {
                let packed = strata::stratified(gpu, &rays.near_far, *samples, None);
                self.field.see(gpu, &rays, &packed, &self.field.features(gpu, &rays, &packed), appearance)
            }
            (Placement::Hierarchical { samples, more }, _, Some(coarse)) => {
                let guide = strata::stratified(gpu, &rays.near_far, *samples, None);
                let seen = coarse.see(gpu, &rays, &guide, &coarse.features(gpu, &rays, &guide), appearance);
                let packed = strata::refine(gpu, &guide, &seen.weights, *samples, *more, None);
                self.field.see(gpu, &rays, &packed, &self.field.features(gpu, &rays, &packed), appearance)
            }
            _ => unreachable!("samples are placed as the field was trained"),
        };
        out.0.rgb.extend(gpu.read(&view.color)?);
        out.0.opacity.extend(gpu.read(&view.opacity)?);
        out.0.depth.extend(gpu.read(&view.depth)?);
        Ok(())
    }

    /// Rays through occupied cells, and the light that passes each; none where samples found no room and
    /// `may_split`.
    fn marched(
        &self,
        grid: &GpuOccupancy,
        rays: &GpuRays,
        config: &MarchConfig,
        pruning: Pruning,
        appearance: Option<u32>,
        may_split: bool,
    ) -> Result<Option<(GpuComposited, Buffer)>, GpuError> {
        let (gpu, f) = (&self.gpu, &self.field);
        let marched = march::march(gpu, grid, rays, config, self.room);
        if may_split && gpu.read(&marched.cut)?.contains(&1) {
            return Ok(None);
        }
        let features = f.features(gpu, rays, &marched.packed);
        let sigma = f.shape.net.density(gpu, &f.weights, &features, &marched.packed.rows());
        let pruned = prune::prune(gpu, &marched.packed, &sigma, &pruning, &marched.cut, self.room);
        let features = f.shape.net.take(gpu, &pruned, &features);
        Ok(Some((f.see(gpu, rays, &pruned.packed, &features, appearance), pruned.light)))
    }
}

fn unserved(e: GpuError) -> Unserved {
    Unserved::Failed(e.to_string())
}

impl Accelerator for GpuTracer {
    fn trace(
        &self,
        batch: &RayBatch,
        placement: &Placement,
        pruning: Pruning,
        appearance: Option<u32>,
    ) -> Result<(Traced, Option<Vec<f32>>), Unserved> {
        let mut out = (Traced::default(), Vec::new());
        let at_once = match placement {
            Placement::March(_) => batch.len(),
            Placement::Stratified { samples } => self.room / samples.max(&1),
            Placement::Hierarchical { samples, more } => self.room / (samples + more).max(1),
        };
        for first in (0..batch.len()).step_by(at_once.max(1)) {
            let n = at_once.max(1).min(batch.len() - first);
            self.part(batch, (first, n), placement, pruning, appearance, &mut out).map_err(unserved)?;
        }
        Ok((out.0, matches!(placement, Placement::March(_)).then_some(out.1)))
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
