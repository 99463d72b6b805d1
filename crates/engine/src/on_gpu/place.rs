//! Placement of samples on the device: what [`Placement::place`] does on the CPU.

use super::shape::Shape;
use crate::samplers::placement::Placement;
use diorama_kernels::gpu::{Buffer, Gpu, GpuError, Rows};
use diorama_kernels::ops::composite::gpu::GpuPacked;
use diorama_kernels::ops::field_step::gpu::GpuNet;
use diorama_kernels::ops::march::MarchConfig;
use diorama_kernels::ops::march::gpu::{self as march, GpuOccupancy, GpuRays};
use diorama_kernels::ops::prune::Pruning;
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
    /// Offsets of all samples that were marched, had there been room for them, `[R + 1]`. Rays that a first wave has no room for do not go
    /// on: there, at least so many.
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
    /// What was met, wave by wave.
    pub waves: Vec<Met>,
}

/// All samples that a wave marched to, their cells and their densities.
pub struct Met {
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
        Placement::Occupancy { march: config, pruning } => return Ok(in_waves(gpu, config, pruning, on)),
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

/// Samples per ray of a first wave; a second one takes what is left of the rays that have met no opaque matter by then. A third one gained
/// nothing in training.
const FIRST_WAVE: usize = 32;

/// Samples in occupied cells that their densities do not drop.
fn in_waves(gpu: &Gpu, config: &MarchConfig, pruning: &Pruning, on: &PlaceOn) -> GpuSamples {
    // Where no ray ends early, one wave takes all.
    let first = if pruning.stop > 0.0 { FIRST_WAVE.min(config.max_samples) } else { config.max_samples };
    let rest = config.max_samples - first;
    let of = |max_samples: usize| MarchConfig { max_samples, ..*config };
    let (samples, trace, left) = wave(gpu, on, (on.rays, None), &of(first), pruning, rest > 0);
    let (samples, trace) = match left {
        Some(left) => {
            let (behind, met, _) = wave(gpu, on, (&left, Some(&trace.light)), &of(rest), pruning, false);
            joined(gpu, &on.field.shape.net, (samples, trace), (behind, met), on.room.1)
        }
        None => (samples, trace),
    };
    GpuSamples { march: Some(trace), ..samples }
}

/// Samples of a wave that stay of rays with the light that reaches them, all of it in the first wave; and the rays that go on, if asked for.
fn wave(
    gpu: &Gpu,
    on: &PlaceOn,
    (rays, light): (&GpuRays, Option<&Buffer>),
    config: &MarchConfig,
    pruning: &Pruning,
    goes_on: bool,
) -> (GpuSamples, MarchTrace, Option<GpuRays>) {
    let (grid, net) = (on.grid.expect("an occupancy grid"), &on.field.shape.net);
    let marched = march::march(gpu, grid, rays, config, on.room.0);
    // All samples in occupied cells: their densities decide which stay.
    let (points, features) = on.field.encode(gpu, rays, &marched.packed);
    let rows = marched.packed.rows();
    let sigma = net.density(gpu, on.field.weights, &features, &rows);
    let pruned = prune::prune(gpu, &marched.packed, (&sigma, light), pruning, &marched.cut, on.room.1);
    let further = goes_on.then(|| march::go_on(gpu, rays, &marched, &pruned.light, pruning.stop, config.max_samples));
    let (points, features) = (pruned.take(gpu, &points, 3), net.take(gpu, &pruned, &features));
    let trace = MarchTrace { cut: marched.cut, light: pruned.light, waves: vec![Met { rows, cells: marched.cells, sigma }] };
    (GpuSamples { packed: pruned.packed, points, features, marched: marched.whole, march: None }, trace, further)
}

/// The samples of a second wave behind those of the first.
fn joined(
    gpu: &Gpu,
    net: &GpuNet,
    (first, mut before): (GpuSamples, MarchTrace),
    (second, wave): (GpuSamples, MarchTrace),
    room: usize,
) -> (GpuSamples, MarchTrace) {
    let cut = gpu.either(&before.cut, &wave.cut);
    let joined = prune::join(gpu, &first.packed, &second.packed, &cut, room);
    let points = joined.take(gpu, [&first.points, &second.points], 3);
    let features = net.join(gpu, &joined, [&first.features, &second.features]);
    let marched = prune::sum(gpu, &first.marched, &second.marched);
    before.waves.extend(wave.waves);
    let samples = GpuSamples { packed: joined.packed, points, features, marched, march: None };
    (samples, MarchTrace { cut, light: wave.light, waves: before.waves })
}
