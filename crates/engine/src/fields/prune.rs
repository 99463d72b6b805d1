//! Leaves out samples that cannot matter before the costly part of a step: those behind opaque matter
//! (instant-ngp ends rays where the transmittance falls below 1e-4) and those that hold next to nothing
//! (nerfacc, Li et al. 2023, the alpha threshold).

use super::{Encoding, Field, FieldBuffers};
use diorama_kernels::math;
use diorama_kernels::ops::fused_mlp::Mlp;
use diorama_kernels::ops::fused_mlp::cpu::{Activations, forward_block};
use diorama_kernels::ops::hash_grid::{self, HashGrid};
use diorama_kernels::ops::linear;
use diorama_kernels::ops::march::Marched;
use rayon::prelude::*;

/// Rows per block of the density network, and samples per task.
const BLOCK: usize = 256;
const TASK: usize = 4096;

/// Which samples are left out.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pruning {
    /// Samples behind which less than this share of light arrives.
    pub stop: f32,
    /// Samples of less opacity than this.
    pub min_alpha: f32,
}

/// Memory kept between calls.
#[derive(Default)]
pub(super) struct DensityBuffers {
    pool: Vec<(Vec<f32>, Activations)>,
}

impl Field {
    /// Marches' samples and positions shrink to what [`Pruning`] leaves; their encoding stays in `buf` for
    /// [`Field::train`], which must come next. Fields without a hash grid are left alone.
    pub fn prune(&self, samples: &mut Marched, positions: &mut Vec<f32>, pruning: Pruning, buf: &mut FieldBuffers) {
        let (Encoding::Hash(grid), Some(table)) = (&self.encoding, &self.table) else { return };
        let n = samples.t.len();
        self.unit(positions, &mut buf.unit);
        buf.features.resize(n * grid.output_dims(), 0.0);
        hash_grid::cpu::forward(grid, &buf.unit, &table.values, &mut buf.features);
        buf.stages.done("encode");
        buf.alpha.resize(n, 0.0);
        buf.sigma.resize(n, 0.0);
        self.sigma(grid, &self.density_net(self.net.mlp.precision), &buf.features, &mut buf.sigma, &mut buf.density);
        let tasks = buf.alpha.par_chunks_mut(TASK).zip(buf.sigma.par_chunks(TASK)).zip(samples.dt.par_chunks(TASK));
        tasks.for_each(|((alpha, sigma), dt)| math::alphas(sigma, dt, alpha));
        buf.stages.done("density");
        let kept = &mut buf.kept;
        kept.clear();
        let mut first = 0;
        for r in 1..samples.offsets.len() {
            let mut light = 1.0f32;
            for i in first..samples.offsets[r] as usize {
                if light < pruning.stop {
                    break;
                }
                let alpha = buf.alpha[i];
                light *= 1.0 - alpha;
                if alpha >= pruning.min_alpha {
                    kept.push(i as u32);
                }
            }
            first = samples.offsets[r] as usize;
            samples.offsets[r] = kept.len() as u32;
        }
        compact(kept, 1, &mut samples.t);
        compact(kept, 1, &mut samples.dt);
        compact(kept, 3, positions);
        compact(kept, 3, &mut buf.unit);
        let (f, m) = (grid.config.features, kept.len());
        buf.spare.resize(m * grid.output_dims(), 0.0);
        if m > 0 {
            buf.spare.par_chunks_mut(m * f).zip(buf.features.par_chunks(n * f)).for_each(|(out, level)| {
                for (o, &i) in out.chunks_exact_mut(f).zip(kept.iter()) {
                    o.copy_from_slice(&level[i as usize * f..][..f]);
                }
            });
        }
        std::mem::swap(&mut buf.spare, &mut buf.features);
        buf.encoded = true;
        buf.stages.done("prune");
    }

    /// The layers up to the density head, which read positions alone; their parameters come first.
    pub(super) fn density_net(&self, precision: diorama_kernels::gemm::Precision) -> Mlp {
        let all = &self.net.mlp;
        Mlp { precision, ..Mlp::new(all.input_widths[..1].to_vec(), all.layers[..=self.net.sigma.layer].to_vec()) }
    }

    /// Densities `[N]` of level-major features `[L, N, F]`.
    pub(super) fn sigma(&self, grid: &HashGrid, mlp: &Mlp, features: &[f32], sigma: &mut [f32], buffers: &mut DensityBuffers) {
        let (n, f, dims) = (sigma.len(), grid.config.features, grid.output_dims());
        let head = self.net.sigma;
        let width = mlp.layers[head.layer].width;
        let params = &self.weights.values[..mlp.params_len()];
        let tasks = n.div_ceil(TASK);
        if buffers.pool.len() < tasks {
            buffers.pool.resize_with(tasks, Default::default);
        }
        sigma.par_chunks_mut(TASK).zip(&mut buffers.pool).enumerate().for_each(|(task, (sigma, (rows, acts)))| {
            rows.resize(BLOCK * dims, 0.0);
            for (b, sigma) in sigma.chunks_mut(BLOCK).enumerate() {
                let first = task * TASK + b * BLOCK;
                for l in 0..dims / f {
                    let part = &features[(l * n + first) * f..(l * n + first + sigma.len()) * f];
                    for (row, v) in rows.chunks_exact_mut(dims).zip(part.chunks_exact(f)) {
                        row[l * f..(l + 1) * f].copy_from_slice(v);
                    }
                }
                forward_block(mlp, params, &[&rows[..sigma.len() * dims]], sigma.len(), acts);
                for (s, o) in sigma.iter_mut().zip(acts.values[head.layer].chunks_exact(width)) {
                    *s = o[head.channel] + head.shift;
                }
                linear::cpu::activate(head.activation, sigma);
            }
        });
    }
}

/// Keeps the given rows of `width` numbers, which are in ascending order.
fn compact(kept: &[u32], width: usize, data: &mut Vec<f32>) {
    for (to, &from) in kept.iter().enumerate() {
        let from = from as usize * width;
        data.copy_within(from..from + width, to * width);
    }
    data.truncate(kept.len() * width);
}
