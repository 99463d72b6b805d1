//! Normals that a field composites: `−Σ w ∇σ` with the gradient of the density with respect to position in model space, also where that is
//! contracted. The vector points out of what is dense and is not of unit length. It is differentiated with respect to the densities'
//! weights and to `∇σ`, by first-order passes alone; sample positions get no gradient through it.

use super::{Batch, Encoded, Encoder, Field, FieldBuffers};
use diorama_kernels::ops::density_gradient::cpu::{self as density, DensityBuffers, DensitySinks, TableGradient};
use diorama_kernels::ops::density_gradient::{DensityGradients, DensityNet, DensityPoints, Undifferentiable};
use diorama_kernels::ops::field_step::{BlockEncoding, Extras};
use rayon::prelude::*;

/// Channels of a normal.
pub const NORMAL: usize = 3;

/// Normals as channels of a field, behind its network's outputs.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Normals {
    pub slope: DensitySlope,
    /// Samples of no more weight have no part.
    pub min_weight: f32,
}

/// How the gradient of the density is computed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum DensitySlope {
    /// By the derivatives of encoding and network.
    Exact,
    /// From the opacities `1 − exp(−σ · distance)` at the corners of a tetrahedron at this distance, in model space: smoother than the
    /// field itself, and even where densities differ by orders of magnitude.
    Taps { distance: f32 },
}

/// Why a field cannot have normals.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum NormalsError {
    #[error("{0}")]
    Density(#[from] Undifferentiable),
    #[error("features at the corners of voxels have no normals; use a hash grid or a frequency encoding")]
    VoxelCorners,
}

impl Default for Normals {
    /// Exact, of samples of more than a thousandth of a ray.
    fn default() -> Self {
        Normals { slope: DensitySlope::Exact, min_weight: 1e-3 }
    }
}

impl DensitySlope {
    /// Taps whose distance falls geometrically from `first` to `last` while `share` grows from 0 to 1, and stays there.
    pub fn annealed(share: f32, first: f32, last: f32) -> DensitySlope {
        DensitySlope::Taps { distance: first * (last / first).powf(share.clamp(0.0, 1.0)) }
    }
}

/// Unit vectors to the corners of a tetrahedron: `Σ k kᵀ = 4/3`.
const TAPS: [[f32; 3]; 4] = {
    const A: f32 = 0.577_350_26;
    [[A, -A, -A], [-A, -A, A], [-A, A, -A], [A, A, A]]
};

/// Memory kept between evaluations.
#[derive(Default)]
pub(super) struct NormalBuffers {
    /// Samples that have a part, and their positions `[M, 3]`.
    kept: Vec<u32>,
    positions: Vec<f32>,
    /// The points at which the density is evaluated: these, or their taps.
    encoded: Encoded,
    density: DensityBuffers,
    /// `∇σ` of the kept samples, then the loss's gradient of it, `[M, 3]`.
    slopes: Vec<f32>,
    d_sigma: Vec<f32>,
    /// `−∇σ`, 0 where a sample has no part, `[S, 3]`.
    values: Vec<f32>,
    /// `[R, C + 3]`
    background: Vec<f32>,
}

impl NormalBuffers {
    /// What is composited behind the network's outputs.
    pub fn extras(&self) -> Extras<'_> {
        Extras { values: &self.values, width: NORMAL }
    }

    /// Background of all channels; normals have none.
    pub fn background(&self) -> &[f32] {
        &self.background
    }
}

impl Field {
    /// Channels that the field composites: the network's outputs, then normals where it has them.
    pub fn channels(&self) -> usize {
        self.net.channels() + if self.normals.is_some() { NORMAL } else { 0 }
    }

    /// Composites normals, or no longer.
    ///
    /// # Errors
    /// When the field's density has no gradient that could be trained.
    pub fn set_normals(&mut self, normals: Option<Normals>) -> Result<(), NormalsError> {
        if normals.is_some() {
            DensityNet::new(&self.net)?;
            if matches!(self.encoder, Encoder::VoxelCorners { .. }) {
                return Err(NormalsError::VoxelCorners);
            }
        }
        self.normals = normals;
        Ok(())
    }

    /// Densities `[N]` and their gradients `[N, 3]` at model points `[N, 3]`.
    ///
    /// # Errors
    /// When the field's density has no gradient.
    pub fn density_with_gradient(&self, model: &[f32]) -> Result<(Vec<f32>, Vec<f32>), NormalsError> {
        if matches!(self.encoder, Encoder::VoxelCorners { .. }) {
            return Err(NormalsError::VoxelCorners);
        }
        let net = DensityNet::new(&self.net)?;
        let (mut encoded, mut buf) = (Encoded::default(), DensityBuffers::default());
        self.encode(model, &mut encoded);
        density::forward(&net, &self.weights.values, &self.density_points(&encoded), true, &mut buf);
        self.unit_backward(model, &mut buf.gradient);
        Ok((buf.sigma, buf.gradient))
    }

    /// # Panics
    /// When the field cannot have normals: see [`Field::set_normals`].
    fn density_layers(&self) -> DensityNet {
        DensityNet::new(&self.net).unwrap_or_else(|e| panic!("{e}"))
    }

    /// # Panics
    /// When the features are those of voxels' corners.
    fn density_points<'a>(&'a self, encoded: &'a Encoded) -> DensityPoints<'a> {
        let Encoded { unit: points, features } = encoded;
        match &self.encoder {
            Encoder::Hash { grid, table } => DensityPoints::Hash { grid, table: &table.values, points, features },
            Encoder::Frequency(f) => DensityPoints::Encoded { encoding: BlockEncoding::Frequency(*f), points },
            Encoder::TriangleWave { bands } => DensityPoints::Encoded { encoding: BlockEncoding::TriangleWave { bands: *bands }, points },
            Encoder::VoxelCorners { .. } => panic!("{}", NormalsError::VoxelCorners),
        }
    }

    /// Composites the normals of encoded samples, whose outputs and weights are in `buf.out`.
    pub(super) fn add_normals(&self, how: &Normals, batch: &Batch, encoded: &Encoded, buf: &mut FieldBuffers) {
        let b = &mut buf.normals;
        b.kept.clear();
        b.kept.extend((0..).zip(&buf.out.weights).filter(|(_, w)| **w > how.min_weight).map(|(i, _)| i));
        gather(&b.kept, batch.positions, 3, &mut b.positions);
        let net = self.density_layers();
        match how.slope {
            DensitySlope::Exact => {
                gather(&b.kept, &encoded.unit, 3, &mut b.encoded.unit);
                self.gather_features(&b.kept, encoded, &mut b.encoded.features);
                density::forward(&net, &self.weights.values, &self.density_points(&b.encoded), true, &mut b.density);
                b.slopes.clear();
                b.slopes.extend_from_slice(&b.density.gradient);
                self.unit_backward(&b.positions, &mut b.slopes);
            }
            DensitySlope::Taps { distance } => {
                let taps = |p: &[f32]| TAPS.map(|k| [0, 1, 2].map(|a| p[a] + distance * k[a]));
                let model: Vec<f32> = b.positions.chunks_exact(3).flat_map(taps).flatten().collect();
                self.encode(&model, &mut b.encoded);
                density::forward(&net, &self.weights.values, &self.density_points(&b.encoded), false, &mut b.density);
                let slope = |s: &[f32]| {
                    let opacity: [f32; 4] = std::array::from_fn(|t| -(-s[t] * distance).exp_m1());
                    [0, 1, 2].map(|a| 0.75 / distance * (0..4).map(|t| opacity[t] * TAPS[t][a]).sum::<f32>())
                };
                b.slopes.clear();
                b.slopes.extend(b.density.sigma.chunks_exact(4).flat_map(slope));
            }
        }
        b.values.clear();
        b.values.resize(batch.samples.samples() * NORMAL, 0.0);
        for (&i, slope) in b.kept.iter().zip(b.slopes.chunks_exact(NORMAL)) {
            (0..NORMAL).for_each(|k| b.values[i as usize * NORMAL + k] = -slope[k]);
        }
        self.composite_normals(batch, buf);
        buf.stages.done("normals");
    }

    /// Widens the composited outputs, and the background for training, by the normals.
    fn composite_normals(&self, batch: &Batch, buf: &mut FieldBuffers) {
        let (c, out, b) = (self.net.channels(), &mut buf.out, &mut buf.normals);
        let (mut values, wide) = (Vec::with_capacity(batch.samples.rays() * (c + NORMAL)), c + NORMAL);
        b.background.clear();
        b.background.resize(batch.samples.rays() * wide, 0.0);
        for r in 0..batch.samples.rays() {
            let mut n = [0.0f32; NORMAL];
            for i in batch.samples.range(r) {
                (0..NORMAL).for_each(|k| n[k] += out.weights[i] * b.values[i * NORMAL + k]);
            }
            values.extend_from_slice(&out.values[r * c..(r + 1) * c]);
            values.extend(n);
            b.background[r * wide..][..c].copy_from_slice(&batch.background[r * c..(r + 1) * c]);
        }
        out.values = values;
    }

    /// Adds the gradients of the densities' gradients to weights and table, and drops the normals' part from the background's gradient.
    pub(super) fn normals_backward(&mut self, how: &Normals, buf: &mut FieldBuffers) {
        let (b, out) = (&mut buf.normals, &mut buf.out);
        let wide = self.channels();
        let narrow = wide - NORMAL;
        out.d_background = out.d_background.chunks_exact(wide).flat_map(|row| &row[..narrow]).copied().collect();
        gather(&b.kept, &out.d_extras, NORMAL, &mut b.slopes);
        b.slopes.iter_mut().for_each(|d| *d = -*d);
        let seeds = match how.slope {
            DensitySlope::Exact => {
                self.unit_tangent(&b.positions, &mut b.slopes);
                DensityGradients { sigma: &[], gradient: &b.slopes }
            }
            DensitySlope::Taps { distance } => {
                let tap = |(d, s): (&[f32], &[f32])| -> [f32; 4] {
                    std::array::from_fn(|t| 0.75 * (-s[t] * distance).exp() * (0..NORMAL).map(|a| TAPS[t][a] * d[a]).sum::<f32>())
                };
                b.d_sigma.clear();
                b.d_sigma.extend(b.slopes.chunks_exact(NORMAL).zip(b.density.sigma.chunks_exact(4)).flat_map(tap));
                DensityGradients { sigma: &b.d_sigma, gradient: &[] }
            }
        };
        let net = self.density_layers();
        let mut params = std::mem::take(&mut self.weights.grads);
        let trained = self.encoder.table_mut().filter(|t| !t.frozen);
        let mut table = trained.map(|t| (std::mem::take(&mut t.grads), std::mem::take(&mut t.touched)));
        let sinks = DensitySinks { params: &mut params, table: table.as_mut().map(|(grads, touched)| TableGradient { grads, touched }) };
        density::backward(&net, &self.weights.values, &self.density_points(&b.encoded), seeds, &mut b.density, sinks);
        self.weights.grads = params;
        if let (Some((grads, touched)), Some(t)) = (table, self.encoder.table_mut()) {
            (t.grads, t.touched) = (grads, touched);
        }
        buf.stages.done("normals");
    }

    /// Turns directions in model space into their images in the encoder's coordinates, in place.
    fn unit_tangent(&self, model: &[f32], v: &mut [f32]) {
        let factor = if self.encoder.is_centered() { 2.0 } else { 1.0 };
        for (v, m) in v.chunks_exact_mut(3).zip(model.chunks_exact(3)) {
            let t = self.space.normalize_tangent([m[0] - 0.5, m[1] - 0.5, m[2] - 0.5], [v[0], v[1], v[2]]);
            v.copy_from_slice(&t.map(|t| t * factor));
        }
    }

    /// Features `[L, M, F]` of some of the samples, where the encoder has a table.
    fn gather_features(&self, kept: &[u32], encoded: &Encoded, out: &mut Vec<f32>) {
        let Some((levels, f)) = self.encoder.levels() else { return };
        let total = encoded.unit.len() / 3;
        out.resize(levels * kept.len() * f, 0.0);
        out.par_chunks_mut((kept.len() * f).max(1)).enumerate().for_each(|(l, out)| {
            let level = &encoded.features[l * total * f..];
            for (o, &i) in out.chunks_exact_mut(f).zip(kept) {
                o.copy_from_slice(&level[i as usize * f..][..f]);
            }
        });
    }
}

/// Rows of `width` numbers of some of the samples.
fn gather(kept: &[u32], from: &[f32], width: usize, out: &mut Vec<f32>) {
    out.clear();
    kept.iter().for_each(|&i| out.extend_from_slice(&from[i as usize * width..][..width]));
}
