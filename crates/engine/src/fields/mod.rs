//! Radiance fields: an encoding of position, codes of direction and appearance, and a network.

mod presets;
mod visible;

pub use presets::{baseline, mlp, nerf, ngp};
pub use visible::{Pruning, VisibleBuffers};

use crate::params::ParamGroup;
use crate::stages::Stages;
use diorama_geom::contraction::Space;
use diorama_kernels::gemm::Precision;
use diorama_kernels::ops::composite::Packed;
use diorama_kernels::ops::fused_mlp;
use diorama_kernels::ops::hash_grid::{self, HashGrid};
use diorama_kernels::ops::field_step::{self, FieldNet, Positions, RayCode, RayLoss, StepBuffers, StepInput, StepOutput};
use diorama_kernels::ops::{frequency, linear, spherical_harmonics};
use rayon::prelude::*;

/// How positions are encoded.
#[derive(Clone, Debug, PartialEq)]
pub enum Encoding {
    /// Over the field's space as `[0, 1]³`.
    Hash(HashGrid),
    /// Over the field's space as `[−1, 1]³`.
    Frequency(frequency::Frequency),
}

/// How directions are encoded.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum DirectionCode {
    None,
    SphericalHarmonics(usize),
    Frequency(frequency::Frequency),
}

impl DirectionCode {
    pub fn dims(&self) -> usize {
        match self {
            DirectionCode::None => 0,
            DirectionCode::SphericalHarmonics(d) => d * d,
            DirectionCode::Frequency(f) => f.output_dims(),
        }
    }

    fn encode(&self, dirs: &[f32], out: &mut Vec<f32>) {
        out.resize(dirs.len() / 3 * self.dims(), 0.0);
        match self {
            DirectionCode::None => {}
            DirectionCode::SphericalHarmonics(d) => spherical_harmonics::cpu::forward(*d, dirs, out),
            DirectionCode::Frequency(f) => frequency::cpu::forward(f, dirs, out),
        }
    }
}

/// A vector per training image that the colour network reads (NeRF in the Wild).
#[derive(Clone, Debug)]
pub struct Appearance {
    pub dims: usize,
    /// `[images, dims]`
    pub group: ParamGroup,
}

/// A field in model space, where the inner cube is `[0, 1]³`.
#[derive(Clone, Debug)]
pub struct Field {
    pub encoding: Encoding,
    pub directions: DirectionCode,
    pub net: FieldNet,
    pub space: Space,
    pub table: Option<ParamGroup>,
    pub weights: ParamGroup,
    pub appearance: Option<Appearance>,
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
    /// `[R, 3]`
    pub background: &'a [f32],
    /// See [`StepInput::near_scaling`].
    pub near_scaling: f32,
}

/// Memory kept between evaluations.
#[derive(Default)]
pub struct FieldBuffers {
    unit: Vec<f32>,
    features: Vec<f32>,
    direction: Vec<f32>,
    appearance: Vec<f32>,
    d_appearance: Vec<f32>,
    /// Whether [`Field::visible`] has already encoded the samples that come next.
    encoded: bool,
    pub visible: VisibleBuffers,
    step: StepBuffers,
    pub out: StepOutput,
    pub stages: Stages,
}

impl Field {
    /// Field coordinates of model points: `[0, 1]³` for a hash grid, `[−1, 1]³` for frequencies.
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
        if matches!(self.encoding, Encoding::Frequency(_)) { u.map(|v| 2.0 * v) } else { u.map(|v| v + 0.5) }
    }

    /// Turns gradients of field coordinates into gradients of model points, in place.
    fn unit_backward(&self, model: &[f32], d: &mut [f32]) {
        let factor = if matches!(self.encoding, Encoding::Frequency(_)) { 2.0 } else { 1.0 };
        for (d, m) in d.chunks_exact_mut(3).zip(model.chunks_exact(3)) {
            let g = self.space.normalize_backward([m[0] - 0.5, m[1] - 0.5, m[2] - 0.5], [d[0], d[1], d[2]]);
            d.copy_from_slice(&g.map(|g| g * factor));
        }
    }

    /// Whether space has no bound.
    pub fn is_unbounded(&self) -> bool {
        matches!(self.space, Space::Contracted(_))
    }

    /// Codes of rays for the color layers: of their directions, and of the appearance of `images`, or of all in the mean.
    pub(crate) fn ray_codes(&self, dirs: &[f32], images: Option<&[u32]>, direction: &mut Vec<f32>, appearance: &mut Vec<f32>) {
        self.directions.encode(dirs, direction);
        let Some(a) = &self.appearance else { return };
        appearance.resize(dirs.len() / 3 * a.dims, 0.0);
        let mean = if images.is_none() { a.mean() } else { Vec::new() };
        for (r, row) in appearance.chunks_exact_mut(a.dims).enumerate() {
            match images {
                Some(images) => {
                    let i = images[r] as usize * a.dims;
                    row.copy_from_slice(&a.group.values[i..i + a.dims]);
                }
                None => row.copy_from_slice(&mean),
            }
        }
    }

    /// Composites a batch into `buf.out`.
    pub fn render(&self, batch: &Batch, buf: &mut FieldBuffers) {
        let encoded = std::mem::take(&mut buf.encoded);
        if !encoded {
            self.unit(batch.positions, &mut buf.unit);
        }
        let (mut direction, mut appearance) = (std::mem::take(&mut buf.direction), std::mem::take(&mut buf.appearance));
        self.ray_codes(batch.dirs, batch.images, &mut direction, &mut appearance);
        let mut codes = Vec::new();
        if self.directions.dims() > 0 {
            codes.push(RayCode { values: &direction, width: self.directions.dims(), gradient: None });
        }
        if let Some(a) = &self.appearance {
            codes.push(RayCode { values: &appearance, width: a.dims, gradient: None });
        }
        let input = StepInput {
            net: &self.net,
            params: &self.weights.values,
            samples: batch.samples,
            background: batch.background,
            near_scaling: batch.near_scaling,
        };
        let positions = match (&self.encoding, &self.table) {
            (Encoding::Hash(grid), Some(table)) => {
                if !encoded {
                    buf.features.resize(batch.samples.samples() * grid.output_dims(), 0.0);
                    hash_grid::cpu::forward(grid, &buf.unit, &table.values, &mut buf.features);
                }
                Positions::Features { data: &mut buf.features, levels: grid.levels.len(), width: grid.config.features }
            }
            (Encoding::Frequency(f), _) => Positions::Encoded { encoding: *f, points: &buf.unit, d_points: None },
            (Encoding::Hash(_), None) => unreachable!("a hash field has a table"),
        };
        field_step::run(&input, positions, &mut codes, None, &mut buf.step, &mut buf.out, &mut []);
        drop(codes);
        (buf.direction, buf.appearance) = (direction, appearance);
    }

    /// [`Field::render`] with a loss: adds gradients to the groups and, where asked, gives those of the positions.
    pub fn train(&mut self, batch: &Batch, loss: &dyn RayLoss, buf: &mut FieldBuffers, d_positions: Option<&mut Vec<f32>>) {
        let encoded = std::mem::take(&mut buf.encoded);
        if !encoded {
            self.unit(batch.positions, &mut buf.unit);
        }
        let (mut direction, mut appearance) = (std::mem::take(&mut buf.direction), std::mem::take(&mut buf.appearance));
        self.ray_codes(batch.dirs, batch.images, &mut direction, &mut appearance);
        let mut d_appearance = std::mem::take(&mut buf.d_appearance);
        d_appearance.resize(appearance.len(), 0.0);
        let mut codes = Vec::new();
        if self.directions.dims() > 0 {
            codes.push(RayCode { values: &direction, width: self.directions.dims(), gradient: None });
        }
        if let Some(a) = &self.appearance {
            codes.push(RayCode { values: &appearance, width: a.dims, gradient: Some(&mut d_appearance) });
        }
        let input = StepInput {
            net: &self.net,
            params: &self.weights.values,
            samples: batch.samples,
            background: batch.background,
            near_scaling: batch.near_scaling,
        };
        let mut own = Vec::new();
        match (&self.encoding, &mut self.table) {
            (Encoding::Hash(grid), Some(table)) => {
                if !encoded {
                    buf.features.resize(batch.samples.samples() * grid.output_dims(), 0.0);
                    hash_grid::cpu::forward(grid, &buf.unit, &table.values, &mut buf.features);
                    buf.stages.done("encode");
                }
                let positions = Positions::Features { data: &mut buf.features, levels: grid.levels.len(), width: grid.config.features };
                field_step::run(&input, positions, &mut codes, Some(loss), &mut buf.step, &mut buf.out, &mut self.weights.grads);
                buf.stages.done("network");
                if !table.frozen {
                    hash_grid::cpu::backward(grid, &buf.unit, &buf.features, &mut table.grads, Some(&mut table.touched));
                    buf.stages.done("scatter");
                }
                if let Some(d) = d_positions {
                    d.resize(batch.positions.len(), 0.0);
                    hash_grid::cpu::backward_positions(grid, &buf.unit, &table.values, &buf.features, d);
                    self.unit_backward(batch.positions, d);
                }
            }
            (Encoding::Frequency(f), _) => {
                let wanted = d_positions.is_some();
                own.resize(if wanted { batch.positions.len() } else { 0 }, 0.0);
                let d_points = wanted.then_some(&mut own[..]);
                let positions = Positions::Encoded { encoding: *f, points: &buf.unit, d_points };
                field_step::run(&input, positions, &mut codes, Some(loss), &mut buf.step, &mut buf.out, &mut self.weights.grads);
                if let Some(d) = d_positions {
                    self.unit_backward(batch.positions, &mut own);
                    *d = own;
                }
            }
            (Encoding::Hash(_), None) => unreachable!("a hash field has a table"),
        }
        drop(codes);
        if let (Some(a), Some(images)) = (&mut self.appearance, batch.images) {
            for (row, &i) in d_appearance.chunks_exact(a.dims).zip(images) {
                let g = &mut a.group.grads[i as usize * a.dims..][..a.dims];
                g.iter_mut().zip(row).for_each(|(g, d)| *g += d);
            }
        }
        (buf.direction, buf.appearance, buf.d_appearance) = (direction, appearance, d_appearance);
    }

    /// Densities `[N]` (per unit of model space) at model points `[N, 3]`.
    pub fn density(&self, model: &[f32], sigma: &mut [f32]) {
        let head = self.net.density;
        let mlp = self.density_net(Precision::F32);
        let params = &self.weights.values[..mlp.params_len()];
        let width = mlp.layers[head.layer].width;
        let (mut unit, mut rows, mut features, mut out) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        let mut buffers = Vec::new();
        const CHUNK: usize = 1 << 16;
        for (points, sigma) in model.chunks(CHUNK * 3).zip(sigma.chunks_mut(CHUNK)) {
            let n = sigma.len();
            self.unit(points, &mut unit);
            match (&self.encoding, &self.table) {
                (Encoding::Hash(grid), Some(table)) => {
                    features.resize(n * grid.output_dims(), 0.0);
                    hash_grid::cpu::forward(grid, &unit, &table.values, &mut features);
                    self.sigma(grid, &mlp, &features, sigma, &mut buffers);
                }
                (Encoding::Frequency(f), _) => {
                    let w = f.output_dims();
                    rows.resize(n * w, 0.0);
                    rows.par_chunks_mut(w * 256).zip(unit.par_chunks(3 * 256)).for_each(|(o, x)| frequency::cpu::forward(f, x, o));
                    out.resize(n * width, 0.0);
                    fused_mlp::cpu::forward(&mlp, params, &[&rows], n, &mut out);
                    for (s, o) in sigma.iter_mut().zip(out.chunks_exact(width)) {
                        *s = o[head.channel] + head.shift;
                    }
                    linear::cpu::activate(head.activation, sigma);
                }
                (Encoding::Hash(_), None) => unreachable!("a hash field has a table"),
            }
        }
    }

    /// All parameter groups.
    /// A copy to look at, which cannot be trained.
    pub fn to_look_at(&self) -> Field {
        Field {
            encoding: self.encoding.clone(),
            directions: self.directions,
            net: self.net.clone(),
            space: self.space,
            table: self.table.as_ref().map(ParamGroup::values_only),
            weights: self.weights.values_only(),
            appearance: self.appearance.as_ref().map(|a| Appearance { dims: a.dims, group: a.group.values_only() }),
        }
    }

    pub fn groups(&self) -> Vec<&ParamGroup> {
        self.table.iter().chain([&self.weights]).chain(self.appearance.iter().map(|a| &a.group)).collect()
    }

    /// All parameter groups, to be changed.
    pub fn groups_mut(&mut self) -> Vec<&mut ParamGroup> {
        self.table.iter_mut().chain([&mut self.weights]).chain(self.appearance.iter_mut().map(|a| &mut a.group)).collect()
    }
}

impl Appearance {
    /// The mean code over all images, used for views that were not trained on.
    pub fn mean(&self) -> Vec<f32> {
        let n = (self.group.values.len() / self.dims).max(1) as f32;
        (0..self.dims).map(|k| self.group.values.iter().skip(k).step_by(self.dims).sum::<f32>() / n).collect()
    }
}
