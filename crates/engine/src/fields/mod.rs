//! Radiance fields: an encoding of position, codes of rays, and a network.

mod encoder;
mod injected;
mod inverted_sphere;
mod normals;
mod presets;
mod ray_codes;
mod visible;

pub use diorama_kernels::ops::prune::Pruning;
pub use encoder::{Encoded, Encoder, VoxelGrid};
pub use inverted_sphere::{InvertedSphere, OuterSamples, Sphere};
pub use normals::{DensitySlope, NORMAL, Normals, NormalsError};
pub use presets::{baseline, mlp, nerf, ngp, trunk};
pub use ray_codes::{Appearance, DirectionCode, RayCodes};
pub use visible::{VisibleBuffers, VisibleSamples};

use injected::Injected;

use crate::params::ParamGroup;
use crate::stages::Stages;
use diorama_geom::contraction::Space;
use diorama_kernels::gemm::Precision;
use diorama_kernels::ops::composite::Packed;
use diorama_kernels::ops::field_step::{
    self, BatchLoss, Beside, BlockEncoding, Extras, FieldNet, RayCode, RayGradients, RayLoss, RayOutputs, StepBuffers, StepInput,
    StepOutput,
};
use diorama_kernels::ops::fused_mlp::cpu::Activations;
use rayon::prelude::*;

/// A field in model space, where the inner cube is `[0, 1]³`.
#[derive(Clone, Debug)]
pub struct Field {
    pub encoder: Encoder,
    pub codes: RayCodes,
    pub net: FieldNet,
    pub space: Space,
    pub weights: ParamGroup,
    /// Normals that are composited behind the network's outputs; see [`Field::set_normals`].
    pub normals: Option<Normals>,
    /// Bands of triangle waves of the encoder's coordinates, which the network reads last.
    pub waves: Option<usize>,
}

/// Anything with a density at every point, for occupancy grids and meshing.
pub trait DensityQuery {
    /// Densities `[N]` (per unit of model space) at model points `[N, 3]`.
    fn density(&self, model: &[f32], sigma: &mut [f32]);
}

/// Samples of a batch of rays, in model space.
#[derive(Clone, Copy)]
pub struct Batch<'a> {
    pub samples: Packed<'a>,
    /// Sample midpoints, `[S, 3]`.
    pub positions: &'a [f32],
    /// `[R, 3]`
    pub dirs: &'a [f32],
    /// Image of each ray for the appearance code; none: the mean code.
    pub images: Option<&'a [u32]>,
    /// Vectors of [`RayCodes::given`], `[R, width]` each.
    pub given: &'a [&'a [f32]],
    /// `[R, C]`
    pub background: &'a [f32],
    /// See [`StepInput::near_scaling`].
    pub near_scaling: f32,
}

/// Loss that training minimizes.
#[derive(Clone, Copy)]
pub enum Loss<'a> {
    /// A sum over rays, which is computed while a block's activations are in cache.
    Rays(&'a dyn RayLoss),
    /// A function of the whole batch, for which the network is evaluated twice.
    Batch(&'a dyn BatchLoss),
}

/// Memory kept between evaluations.
#[derive(Default)]
pub struct FieldBuffers {
    direction: Vec<f32>,
    appearance: Vec<f32>,
    d_appearance: Vec<f32>,
    /// Gradients of the given codes, `[R, width]` each.
    pub d_given: Vec<Vec<f32>>,
    d_points: Vec<f32>,
    injected: RayGradients,
    normals: normals::NormalBuffers,
    pub visible: VisibleBuffers,
    step: StepBuffers,
    pub out: StepOutput,
    pub stages: Stages,
}

impl Field {
    /// Freezes the network's layers that `is_frozen` says, and no others: their parameters keep their values, and no gradient is computed.
    pub fn freeze_layers(&mut self, is_frozen: impl Fn(usize) -> bool) {
        self.net.mlp.layers.iter_mut().enumerate().for_each(|(j, l)| l.frozen = is_frozen(j));
        self.weights.frozen = self.net.mlp.layers.iter().all(|l| l.frozen);
        self.weights.trained = Some(self.net.mlp.trained());
    }

    /// Freezes all of the field: a step then costs no gradient but those of what lies before it, such as cameras and given codes.
    pub fn freeze(&mut self) {
        self.freeze_layers(|_| true);
        self.groups_mut().into_iter().for_each(|g| g.frozen = true);
    }

    /// # Panics
    /// When the weights are frozen and layers are not, whose gradients would be computed for nothing.
    pub(crate) fn check_freezing(&self) {
        let is_consistent = !self.weights.frozen || self.net.mlp.layers.iter().all(|l| l.frozen);
        assert!(is_consistent, "freeze a field's weights by Field::freeze_layers");
    }

    /// The encoder's coordinates of model points.
    fn unit(&self, model: &[f32], out: &mut Vec<f32>) {
        out.resize(model.len(), 0.0);
        out.par_chunks_mut(3 * 4096).zip(model.par_chunks(3 * 4096)).for_each(|(out, model)| {
            for (o, m) in out.chunks_exact_mut(3).zip(model.chunks_exact(3)) {
                o.copy_from_slice(&self.unit_point([m[0], m[1], m[2]]));
            }
        });
    }

    /// [`Field::unit`] of one point.
    #[inline(always)]
    pub(crate) fn unit_point(&self, model: [f32; 3]) -> [f32; 3] {
        let u = self.space.normalize(model.map(|v| v - 0.5));
        if self.encoder.is_centered() { u.map(|v| 2.0 * v) } else { u.map(|v| v + 0.5) }
    }

    /// Turns gradients of field coordinates into gradients of model points, in place.
    fn unit_backward(&self, model: &[f32], d: &mut [f32]) {
        let factor = if self.encoder.is_centered() { 2.0 } else { 1.0 };
        for (d, m) in d.chunks_exact_mut(3).zip(model.chunks_exact(3)) {
            let g = self.space.normalize_backward([m[0] - 0.5, m[1] - 0.5, m[2] - 0.5], [d[0], d[1], d[2]]);
            d.copy_from_slice(&g.map(|g| g * factor));
        }
    }

    /// Whether the field's space is unbounded.
    pub fn is_unbounded(&self) -> bool {
        matches!(self.space, Space::Contracted(_))
    }

    /// Encodes model points `[S, 3]`.
    pub fn encode(&self, model: &[f32], out: &mut Encoded) {
        self.unit(model, &mut out.unit);
        self.encoder.forward(&out.unit, &mut out.features);
    }

    /// Composites a batch of encoded samples into `buf.out`: the network's outputs and, where the field has them, normals.
    pub fn render(&self, batch: &Batch, encoded: &mut Encoded, buf: &mut FieldBuffers) {
        self.render_outputs(batch, encoded, buf);
        if let Some(how) = &self.normals {
            self.add_normals(how, batch, encoded, buf);
        }
    }

    /// [`Field::render`] without normals.
    pub(crate) fn render_outputs(&self, batch: &Batch, encoded: &mut Encoded, buf: &mut FieldBuffers) {
        let (mut direction, mut appearance) = (std::mem::take(&mut buf.direction), std::mem::take(&mut buf.appearance));
        self.codes.encode(batch.dirs, batch.images, &mut direction, &mut appearance);
        let mut codes = self.ray_codes(batch, &direction, &appearance);
        let Encoded { unit, features } = encoded;
        let positions = self.encoder.positions(unit, features, None, false);
        let input = self.step_input(batch, Extras::default(), batch.background, self.beside(unit, false));
        field_step::run(&input, positions, &mut codes, None, &mut buf.step, &mut buf.out, &mut []);
        drop(codes);
        (buf.direction, buf.appearance) = (direction, appearance);
    }

    /// Outputs `[N, C]` of the field, normals included, at model points `[N, 3]`, viewed along unit directions `[N, 3]`, with the mean appearance
    /// code and the given codes, `[N, width]` each.
    pub fn outputs_at<'a>(&self, model: &[f32], dirs: &[f32], given: &[&[f32]], buf: &'a mut FieldBuffers) -> &'a [f32] {
        // One sample per ray, so long that it is opaque.
        let n = model.len() / 3;
        let offsets: Vec<u32> = (0..=n as u32).collect();
        let (t, dt, background) = (vec![0.0; n], vec![1e30f32; n], vec![0.0; n * self.net.channels()]);
        let samples = Packed { offsets: &offsets, t: &t, dt: &dt };
        let mut encoded = Encoded::default();
        self.encode(model, &mut encoded);
        let batch = Batch { samples, positions: model, dirs, images: None, given, background: &background, near_scaling: 0.0 };
        self.render(&batch, &mut encoded, buf);
        &buf.out.values
    }

    /// The second encoding of samples at `unit`, where the field has one.
    fn beside<'a>(&self, unit: &'a [f32], wanted: bool) -> Option<Beside<'a>> {
        self.waves.map(|bands| Beside { encoding: BlockEncoding::TriangleWave { bands }, points: unit, wanted })
    }

    fn step_input<'a>(&'a self, batch: &Batch<'a>, extras: Extras<'a>, background: &'a [f32], beside: Option<Beside<'a>>) -> StepInput<'a> {
        StepInput {
            net: &self.net,
            params: &self.weights.values,
            samples: batch.samples,
            extras,
            background,
            beside,
            near_scaling: batch.near_scaling,
        }
    }

    /// The codes of a batch in the network's order.
    fn ray_codes<'a>(&self, batch: &Batch<'a>, direction: &'a [f32], appearance: &'a [f32]) -> Vec<RayCode<'a>> {
        let direction = (self.codes.direction.dims() > 0).then_some(direction);
        let appearance = self.codes.appearance.as_ref().map(|_| appearance);
        let all = direction.into_iter().chain(appearance).chain(batch.given.iter().copied());
        all.zip(self.codes.widths()).map(|(values, width)| RayCode { values, width, gradient: None }).collect()
    }

    /// [`Field::render`] with a loss: adds gradients to the groups and, where asked, gives those of the positions.
    pub fn train(&mut self, batch: &Batch, encoded: &mut Encoded, loss: Loss, buf: &mut FieldBuffers, d_positions: Option<&mut Vec<f32>>) {
        let mut injected = std::mem::take(&mut buf.injected);
        if self.normals.is_some() || matches!(loss, Loss::Batch(_)) {
            self.render(batch, encoded, buf);
        }
        let value = match loss {
            Loss::Rays(_) => None,
            Loss::Batch(loss) => {
                injected.clear(batch.samples.rays(), self.channels());
                let out = RayOutputs { values: &buf.out.values, opacity: &buf.out.opacity, depth: &buf.out.depth };
                Some(loss.batch(&out, &mut injected))
            }
        };
        let given = Injected::new(&injected, &loss, batch.samples, self.is_unbounded());
        let rays = if let Loss::Rays(rays) = loss { rays } else { &given };
        self.train_rays(batch, encoded, rays, buf, d_positions);
        buf.out.loss += value.unwrap_or(0.0);
        buf.injected = injected;
    }

    fn train_rays(
        &mut self,
        batch: &Batch,
        encoded: &mut Encoded,
        loss: &dyn RayLoss,
        buf: &mut FieldBuffers,
        d_positions: Option<&mut Vec<f32>>,
    ) {
        let (mut direction, mut appearance) = (std::mem::take(&mut buf.direction), std::mem::take(&mut buf.appearance));
        self.codes.encode(batch.dirs, batch.images, &mut direction, &mut appearance);
        let (mut d_appearance, mut d_given) = (std::mem::take(&mut buf.d_appearance), std::mem::take(&mut buf.d_given));
        d_appearance.resize(appearance.len(), 0.0);
        d_given.resize_with(batch.given.len(), Vec::new);
        d_given.iter_mut().zip(batch.given).for_each(|(d, v)| d.resize(v.len(), 0.0));
        self.check_freezing();
        let wants_appearance = self.codes.appearance.as_ref().is_some_and(|a| !a.group.frozen);
        let wants_features = self.encoder.table().is_some_and(|t| !t.frozen) || d_positions.is_some();
        let mut grads = std::mem::take(&mut self.weights.grads);
        let mut codes = self.ray_codes(batch, &direction, &appearance);
        let own = codes.len() - batch.given.len();
        if wants_appearance {
            codes[own - 1].gradient = Some(&mut d_appearance);
        }
        codes[own..].iter_mut().zip(&mut d_given).for_each(|(c, d)| c.gradient = Some(d));
        // Gradients of positions that are encoded in the step; features have theirs in place.
        let in_step = d_positions.is_some() && self.encoder.levels().is_none();
        buf.d_points.resize(if in_step { batch.positions.len() } else { 0 }, 0.0);
        let Encoded { unit, features } = &mut *encoded;
        let beside = self.beside(unit, d_positions.is_some());
        let positions = self.encoder.positions(unit, features, in_step.then_some(&mut buf.d_points[..]), wants_features);
        let (extras, background) = match self.normals {
            None => (Extras::default(), batch.background),
            Some(_) => (buf.normals.extras(), buf.normals.background()),
        };
        let input = self.step_input(batch, extras, background, beside);
        field_step::run(&input, positions, &mut codes, Some(loss), &mut buf.step, &mut buf.out, &mut grads);
        drop(codes);
        self.weights.grads = grads;
        buf.stages.done("network");
        self.encoder.backward(encoded);
        buf.stages.done("scatter");
        if let Some(how) = self.normals {
            self.normals_backward(&how, buf);
        }
        if let Some(d) = d_positions {
            d.resize(batch.positions.len(), 0.0);
            match in_step {
                true => d.copy_from_slice(&buf.d_points),
                false => self.encoder.positions_backward(encoded, d),
            }
            if self.waves.is_some() {
                d.iter_mut().zip(&buf.out.d_beside).for_each(|(d, w)| *d += w);
            }
            self.unit_backward(batch.positions, d);
        }
        if let (true, Some(a), Some(images)) = (wants_appearance, &mut self.codes.appearance, batch.images) {
            for (row, &i) in d_appearance.chunks_exact(a.dims).zip(images) {
                let g = &mut a.group.grads[i as usize * a.dims..][..a.dims];
                g.iter_mut().zip(row).for_each(|(g, d)| *g += d);
            }
        }
        (buf.direction, buf.appearance, buf.d_appearance, buf.d_given) = (direction, appearance, d_appearance, d_given);
    }

    /// A copy of the values alone, for rendering; it cannot be trained.
    pub fn for_rendering(&self) -> Field {
        Field {
            encoder: self.encoder.for_rendering(),
            codes: self.codes.for_rendering(),
            net: self.net.clone(),
            space: self.space,
            weights: self.weights.values_only(),
            normals: self.normals,
            waves: self.waves,
        }
    }

    /// All parameter groups.
    pub fn groups(&self) -> Vec<&ParamGroup> {
        self.encoder.table().into_iter().chain([&self.weights]).chain(self.codes.appearance.iter().map(|a| &a.group)).collect()
    }

    /// All parameter groups, to be changed.
    pub fn groups_mut(&mut self) -> Vec<&mut ParamGroup> {
        let codes = self.codes.appearance.iter_mut().map(|a| &mut a.group);
        self.encoder.table_mut().into_iter().chain([&mut self.weights]).chain(codes).collect()
    }
}

impl DensityQuery for Field {
    fn density(&self, model: &[f32], sigma: &mut [f32]) {
        const CHUNK: usize = 1 << 16;
        let mlp = self.density_net(Precision::F32);
        let (mut encoded, mut pool): (Encoded, Vec<(Vec<f32>, Activations)>) = Default::default();
        for (points, sigma) in model.chunks(CHUNK * 3).zip(sigma.chunks_mut(CHUNK)) {
            self.encode(points, &mut encoded);
            self.sigma(&mlp, &encoded, sigma, &mut pool);
        }
    }
}

#[cfg(test)]
mod normals_tests;
#[cfg(test)]
mod tests;
