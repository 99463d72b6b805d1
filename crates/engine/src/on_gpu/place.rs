//! Placement of samples on the device: what [`Placement::place`] does on the CPU.

use super::shape::Shape;
use crate::samplers::placement::Placement;
use diorama_kernels::gpu::{Buffer, Gpu, GpuError, Rows};
use diorama_kernels::ops::composite::gpu::GpuPacked;
use diorama_kernels::ops::march::gpu::{self as march, GpuOccupancy, GpuRays};
use diorama_kernels::ops::prune::gpu as prune;
use diorama_kernels::ops::strata::gpu as strata;

/// Encoder and density of a field on the device.
#[derive(Clone, Copy)]
pub struct FieldRef<'a> {
    pub shape: &'a Shape,
    /// Of the encoder, where it has one.
    pub table: Option<&'a Buffer>,
    pub weights: &'a Buffer,
}

impl FieldRef<'_> {
    /// Points of samples `[S, 3]` in the field's space, and encoded.
    pub fn encode(&self, gpu: &Gpu, rays: &GpuRays, packed: &GpuPacked) -> (Buffer, Buffer) {
        let points = march::positions(gpu, rays, packed, self.shape.space);
        let features = self.shape.features(gpu, &packed.rows(), &points, self.table);
        (points, features)
    }
}

/// What samples are placed on.
pub struct PlaceOn<'a> {
    pub field: FieldRef<'a>,
    /// Occupied cells, for [`Placement::Occupancy`].
    pub grid: Option<&'a GpuOccupancy>,
    pub rays: &'a GpuRays,
    /// Rays of the steps before, from which random numbers are counted on.
    pub first: u64,
    /// Samples that there is memory for, before and after [`Placement::Occupancy`] drops those that cannot matter.
    pub room: (usize, usize),
}

/// Samples on the device, encoded.
pub struct GpuSamples {
    pub packed: GpuPacked,
    /// In the field's space, `[S, 3]`.
    pub points: Buffer,
    pub features: Buffer,
    /// Offsets of all samples that were marched, had there been room for them, `[R + 1]`.
    pub marched: Buffer<u32>,
    /// Where an occupancy grid placed them.
    pub march: Option<MarchTrace>,
}

/// What a march through occupied cells met.
pub struct MarchTrace {
    /// 1 for each ray that lost samples for want of room, `[R]`.
    pub cut: Buffer<u32>,
    /// Share of light that passes all samples of a ray, dropped or not, `[R]`.
    pub light: Buffer,
    /// All samples that were marched, their cells and their densities.
    pub rows: Rows,
    pub cells: Buffer<u32>,
    pub sigma: Buffer,
}

/// Places samples and encodes them. `coarse` evaluates those of [`Placement::Hierarchical`]'s first round and gives their weights.
///
/// # Errors
/// When the device was lost.
///
/// # Panics
/// When samples go to occupied cells and there is no grid.
pub fn place(
    gpu: &Gpu,
    placement: &Placement,
    on: &PlaceOn,
    coarse: &mut dyn FnMut(&GpuPacked) -> Result<Buffer, GpuError>,
) -> Result<GpuSamples, GpuError> {
    let packed = match placement {
        Placement::Occupancy { march: config, pruning } => {
            let marched = march::march(gpu, on.grid.expect("an occupancy grid"), on.rays, config, on.room.0);
            // All samples in occupied cells: their densities decide which stay.
            let (points, features) = on.field.encode(gpu, on.rays, &marched.packed);
            let (net, rows) = (&on.field.shape.net, marched.packed.rows());
            let sigma = net.density(gpu, on.field.weights, &features, &rows);
            let pruned = prune::prune(gpu, &marched.packed, &sigma, pruning, &marched.cut, on.room.1);
            let (points, features) = (pruned.take(gpu, &points, 3), net.take(gpu, &pruned, &features));
            let march = MarchTrace { cut: marched.cut, light: pruned.light, rows, cells: marched.cells, sigma };
            let marched = marched.whole;
            return Ok(GpuSamples { packed: pruned.packed, points, features, marched, march: Some(march) });
        }
        Placement::Stratified { samples, noise } => strata::stratified(gpu, &on.rays.near_far, *samples, noise.map(|rng| (rng, on.first))),
        Placement::Hierarchical { samples, more, noise } => {
            let guide = strata::stratified(gpu, &on.rays.near_far, *samples, noise.map(|[rng, _]| (rng, on.first)));
            let weights = coarse(&guide)?;
            strata::refine(gpu, &guide, &weights, *samples, *more, noise.map(|[_, rng]| (rng, on.first)))
        }
    };
    let (points, features) = on.field.encode(gpu, on.rays, &packed);
    Ok(GpuSamples { marched: packed.offsets.clone(), packed, points, features, march: None })
}
