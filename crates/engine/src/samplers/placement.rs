//! Placement of samples on rays, for training and for rendering alike: [`Placement::place`] carries it out on the CPU, `on_gpu` on a
//! device.

use super::RayBatch;
use super::occupancy::Occupancy;
use crate::fields::{Field, FieldBuffers, VisibleSamples};
use diorama_geom::rng::Rng;
use diorama_kernels::ops::march::{self, MarchConfig, MarchRays, OccupancyBits};
use diorama_kernels::ops::prune::Pruning;
use diorama_kernels::ops::strata::cpu as strata;

/// How samples are placed on rays.
#[derive(Clone, Copy, Debug)]
pub enum Placement {
    /// March through occupied cells, then drop samples whose weight is below `pruning`'s limits.
    Occupancy { march: MarchConfig, pruning: Pruning },
    /// One sample in each of `samples` equal intervals: in its middle, or with `noise` anywhere in it.
    Stratified { samples: usize, noise: Option<Rng> },
    /// As many for the coarse field, by whose weights `more` are drawn and added for the main one (Mildenhall et al. 2020). `noise`: for
    /// the first and for those that are added.
    Hierarchical { samples: usize, more: usize, noise: Option<[Rng; 2]> },
}

/// What samples are placed on.
#[derive(Clone, Copy)]
pub struct PlaceOn<'a> {
    /// The field that the samples are encoded for.
    pub field: &'a Field,
    /// Occupied cells, for [`Placement::Occupancy`].
    pub occupancy: Option<&'a OccupancyBits>,
    pub batch: &'a RayBatch,
    /// Rays of the steps before, from which random numbers are counted on.
    pub first: u64,
}

/// Samples of a batch; memory kept between batches.
#[derive(Default)]
pub struct PlacedSamples {
    /// For the main field.
    pub main: VisibleSamples,
    /// For the coarse field of [`Placement::Hierarchical`].
    pub coarse: VisibleSamples,
}

impl Placement {
    /// In the occupied cells of a grid, with marching steps of its own length.
    pub fn occupied(grid: &Occupancy, max_samples: usize, pruning: Pruning) -> Placement {
        Placement::Occupancy { march: grid.march_config(max_samples), pruning }
    }

    /// The same, with other limits below which samples are dropped.
    #[must_use]
    pub fn with_pruning(self, pruning: Pruning) -> Placement {
        match self {
            Placement::Occupancy { march, .. } => Placement::Occupancy { march, pruning },
            other => other,
        }
    }

    /// Places samples and encodes them into `out.main`. `coarse` evaluates `out.coarse`, encoded by [`encode`] for the coarse field, into
    /// `buffers.out`.
    ///
    /// # Panics
    /// When samples go to occupied cells and there is no grid.
    pub fn place(
        &self,
        on: &PlaceOn,
        out: &mut PlacedSamples,
        buffers: &mut FieldBuffers,
        coarse: &mut dyn FnMut(&mut VisibleSamples, &mut FieldBuffers),
    ) {
        let PlaceOn { field, occupancy, batch, first } = *on;
        match *self {
            Placement::Occupancy { march, pruning } => {
                let grid = occupancy.expect("an occupancy grid");
                return field.visible(grid, &march_rays(batch), &march, pruning, &mut out.main, buffers);
            }
            Placement::Stratified { samples, noise } => {
                strata::stratified(&batch.near_far, samples, noise.map(|rng| (rng, first)), &mut out.main.samples);
            }
            Placement::Hierarchical { samples, more, noise } => {
                strata::stratified(&batch.near_far, samples, noise.map(|[rng, _]| (rng, first)), &mut out.coarse.samples);
                coarse(&mut out.coarse, buffers);
                let noise = noise.map(|[_, rng]| (rng, first));
                strata::refine(&out.coarse.samples, &buffers.out.weights, samples, more, noise, &mut out.main.samples);
            }
        }
        encode(field, batch, &mut out.main);
    }
}

/// Positions of samples along their rays, and their encoding.
pub fn encode(field: &Field, batch: &RayBatch, samples: &mut VisibleSamples) {
    march::cpu::positions(&march_rays(batch), &samples.samples, &mut samples.positions);
    field.encode(&samples.positions, &mut samples.encoded);
}

/// The batch's rays as marching takes them.
fn march_rays(b: &RayBatch) -> MarchRays<'_> {
    MarchRays { origins: &b.origins, dirs: &b.dirs, near_far: &b.near_far, jitter: &b.jitter, resumed: false }
}
