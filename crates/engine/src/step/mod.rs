//! A training step, described once ([`Step`]): source of rays, placement of samples, loss and rates. [`CpuTrainer`] carries it out on the
//! CPU, `on_gpu::GpuTrainer` on a device.

mod cpu;

pub use cpu::CpuTrainer;
#[cfg(feature = "gpu")]
pub(crate) use cpu::measure;
pub use diorama_kernels::ops::pixel_draw::Backdrop;

use crate::background::LearnedBackground;
use crate::fields::Field;
use crate::params::{ParamGroup, ParamSet};
use crate::samplers::occupancy::Occupancy;
use crate::samplers::pixels::{ErrorMap, Observation, PixelSource};
use crate::samplers::placement::Placement;
use diorama_geom::rng::Rng;
use diorama_kernels::ops::field_step::BatchLoss;
use diorama_kernels::ops::photometric_loss::Terms;
use diorama_kernels::ops::ray_aabb;
use diorama_kernels::ops::ray_generation::{CORRECTION, PosedCamera};

/// Description of a training step.
#[derive(Clone, Copy)]
pub struct Step<'a> {
    /// Number of the step, from 0.
    pub number: u64,
    pub rays: RaySource<'a>,
    /// Rays of the steps before, from which random numbers are counted on.
    pub first: u64,
    /// Background of the rays; ignored where one is learned, and for rays of the caller's.
    pub backdrop: Backdrop,
    pub placement: Placement,
    /// Samples that a device has memory for where an occupancy grid places them: before and after those are dropped that cannot matter.
    /// Rays beyond it are left out of the step.
    pub room: (usize, usize),
    /// Points at which the occupancy grid samples the field before the step; none: it stays as it is.
    pub probes: Option<Probes>,
    pub loss: Loss<'a>,
    /// Distance within which samples learn more slowly; 0: none.
    pub near_scaling: f32,
    /// Share of the run that is done, 0 to 1, for the groups' schedules.
    pub progress: f32,
    /// Factor of each group's own rate.
    pub rate_scale: f32,
    /// Whether draws go by the errors as they are after this step.
    pub refresh_errors: bool,
}

impl<'a> Step<'a> {
    /// Step `number` before black, whose random numbers are counted on from ray `first`, with room for 2¹⁸ samples on a device and without
    /// anything else.
    pub fn new(number: u64, first: u64, rays: RaySource<'a>, placement: Placement, loss: Loss<'a>) -> Step<'a> {
        Step {
            number,
            rays,
            first,
            backdrop: Backdrop::Color([0.0; 3]),
            placement,
            room: (1 << 18, 1 << 18),
            probes: None,
            loss,
            near_scaling: 0.0,
            progress: 0.0,
            rate_scale: 1.0,
            refresh_errors: false,
        }
    }
}

/// Source of a step's rays.
#[derive(Clone, Copy)]
pub enum RaySource<'a> {
    /// Random pixels of the training photographs, half of them where errors are high if there is an [`ErrorMap`].
    Photographs { count: usize, rng: Rng },
    /// Rays of the caller's, for example of whole patches that generated cameras see. They teach cameras' corrections and the error map
    /// nothing.
    Given(GivenRays<'a>),
}

impl RaySource<'_> {
    /// Rays of the step.
    pub fn count(&self) -> usize {
        match self {
            RaySource::Photographs { count, .. } => *count,
            RaySource::Given(g) => g.images.len(),
        }
    }

    /// Whether the rays are those of the training cameras, which corrections and the error map belong to.
    pub(crate) fn is_of_cameras(&self) -> bool {
        matches!(self, RaySource::Photographs { .. })
    }
}

/// Rays in model space with what belongs to each; lengths must agree.
#[derive(Clone, Copy, Debug)]
pub struct GivenRays<'a> {
    /// Row of the appearance codes, `[R]`.
    pub images: &'a [u32],
    /// `[R, 3]`
    pub origins: &'a [f32],
    /// Unit length, `[R, 3]`.
    pub dirs: &'a [f32],
    /// Distance at which each ends, `[R]`; may be empty where all end with the scene.
    pub far: &'a [f32],
    /// Offset of the first sample within a marching step, in `[0, 1)`, `[R]`.
    pub jitter: &'a [f32],
    /// Straight RGBA `[R, 4]`; may be empty where a [`BatchLoss`] knows what to compare with.
    pub target: &'a [f32],
    /// Background of the field's channels, `[R, C]`.
    pub background: &'a [f32],
    /// Vectors of [`crate::fields::RayCodes::given`], `[R, width]` each.
    pub codes: &'a [&'a [f32]],
}

impl GivenRays<'_> {
    /// Distances at which rays enter and leave the scene's outer `cube` (lowest corner and edge), or end, `[R, 2]`.
    pub(crate) fn extents(&self, (low, size): (f32, f32), near: f32, near_far: &mut [f32]) {
        ray_aabb::cpu::intersect(self.origins, self.dirs, [low; 3], [low + size; 3], near, near_far);
        for (extent, far) in near_far.chunks_exact_mut(2).zip(self.far) {
            extent[1] = extent[1].min(*far);
            if extent[1] <= extent[0] {
                extent.fill(0.0);
            }
        }
    }
}

/// Random points at which the occupancy grid is sampled.
#[derive(Clone, Copy, Debug)]
pub struct Probes {
    pub rng: Rng,
    pub points: usize,
    /// Edge of the blocks of cells that share a point.
    pub block: usize,
}

/// Loss of a step.
#[derive(Clone, Copy)]
pub enum Loss<'a> {
    /// Colors `[R, 3]` against photographs, ray by ray.
    Photometric(Terms),
    /// A function of all rays' outputs `[R, C]`, computed on the CPU; the network is evaluated once more for its gradients.
    Batch(&'a dyn BatchLoss),
}

/// Photographs that a step draws from.
#[derive(Clone, Copy)]
pub struct Photographs<'a> {
    pub pixels: &'a dyn PixelSource,
    /// Pixels of known distance.
    pub observations: &'a [Observation],
}

/// Extent of rays, and the training cameras before corrections.
#[derive(Clone, Debug)]
pub struct Scene {
    pub cameras: Vec<PosedCamera>,
    /// Distance from the camera at which rays begin, in model space.
    pub near: f32,
    /// The outer cube in model space: lowest corner and edge.
    pub cube: (f32, f32),
}

/// Everything that a step changes: fields, background, grid, cameras and error map.
pub struct Trainees<'a> {
    pub field: &'a mut Field,
    /// Places samples for the main field ([`Placement::Hierarchical`]).
    pub coarse: Option<&'a mut Field>,
    pub learned: Option<&'a mut LearnedBackground>,
    pub occupancy: Option<&'a mut Occupancy>,
    /// Corrections of the cameras, `[cameras, 7]`, and whether focal lengths are refined, too.
    pub corrections: Option<(&'a mut ParamGroup, bool)>,
    pub error_map: Option<&'a mut ErrorMap>,
}

impl<'a> Trainees<'a> {
    /// A field alone.
    pub fn of(field: &'a mut Field) -> Trainees<'a> {
        Trainees { field, coarse: None, learned: None, occupancy: None, corrections: None, error_map: None }
    }

    /// Whether a field composites normals, which the CPU alone does.
    pub fn composites_normals(&self) -> bool {
        [Some(&*self.field), self.coarse.as_deref()].into_iter().flatten().any(|f| f.normals.is_some())
    }

    /// The parameters among them, by the names that checkpoints have, then the grid and the map, which learn without gradients.
    pub fn into_params(self) -> (ParamSet<'a>, Option<&'a mut Occupancy>, Option<&'a mut ErrorMap>) {
        let mut params = ParamSet::default();
        params.add("field", self.field.groups_mut());
        params.add("coarse", self.coarse.into_iter().flat_map(Field::groups_mut));
        params.add("", self.learned.map(|l| &mut l.group));
        params.add("", self.corrections.map(|(group, _)| group));
        (params, self.occupancy, self.error_map)
    }

    /// The same, borrowed for a shorter time.
    pub fn reborrow(&mut self) -> Trainees<'_> {
        Trainees {
            field: self.field,
            coarse: self.coarse.as_deref_mut(),
            learned: self.learned.as_deref_mut(),
            occupancy: self.occupancy.as_deref_mut(),
            corrections: self.corrections.as_mut().map(|(group, focal)| (&mut **group, *focal)),
            error_map: self.error_map.as_deref_mut(),
        }
    }

    /// Whether the cameras learn from a step's rays.
    pub(crate) fn moves_cameras(&self, s: &Step) -> bool {
        self.corrections.as_ref().is_some_and(|(group, _)| !group.frozen) && s.rays.is_of_cameras()
    }
}

/// Losses and counts of steps.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Figures {
    pub steps: u64,
    pub rays: u64,
    /// Rays that did not lose samples for want of room; all on the CPU.
    pub whole: u64,
    /// Means over the steps.
    pub loss: f64,
    /// Squared color error of the rays; not a number with a [`BatchLoss`].
    pub mse: f64,
    /// Samples of whole rays that were trained on, all steps together.
    pub trained: f64,
    /// Samples that were marched to, those that found no room among them.
    pub marched: f64,
}

/// Cameras with their corrections `[cameras, 7]`.
pub fn corrected(cameras: &[PosedCamera], corrections: &[f32]) -> Vec<PosedCamera> {
    let rows = corrections.chunks_exact(CORRECTION);
    cameras.iter().zip(rows).map(|(c, d)| c.corrected(&std::array::from_fn(|k| d[k] as f64))).collect()
}

#[cfg(test)]
mod sphere_tests;
#[cfg(test)]
mod tests;
