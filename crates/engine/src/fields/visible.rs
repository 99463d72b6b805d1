//! Marching that drops samples of low weight before the costly part of a step ([`prune`]). Rays advance in waves: a wave is marched,
//! encoded and put through the density layers, and only rays that light still passes join the next, so that hidden samples are not even
//! encoded.

use super::{Encoded, Field, FieldBuffers};
use diorama_kernels::ops::fused_mlp::Mlp;
use diorama_kernels::ops::fused_mlp::cpu::{Activations, forward_block};
use diorama_kernels::ops::linear;
use diorama_kernels::ops::march::{self, MarchConfig, MarchRays, Marched, OccupancyBits};
use diorama_kernels::ops::prune::{self, Pruning};
use rayon::prelude::*;

/// Rows per block of the density network, and samples per task.
const BLOCK: usize = 256;
const TASK: usize = 4096;
/// Samples per ray in the first wave and at most.
const WAVE: (usize, usize) = (24, 96);

/// Rays of a wave: those that light still passes, and where they resume.
#[derive(Default)]
struct RayWave {
    /// Their numbers in the batch.
    indices: Vec<u32>,
    origins: Vec<f32>,
    dirs: Vec<f32>,
    near_far: Vec<f32>,
    jitter: Vec<f32>,
    resumed: bool,
}

/// One advance of the rays that are left: up to `size` samples for each.
#[derive(Default)]
struct Wave {
    /// Most samples per ray.
    size: usize,
    rays: RayWave,
    /// Transmittance of each ray behind the wave.
    light: Vec<f32>,
    marched: Marched,
    positions: Vec<f32>,
    encoded: Encoded,
    sigma: Vec<f32>,
    /// Opacities, or [`prune::DROPPED`].
    alpha: Vec<f32>,
    /// Number of kept samples per ray.
    counts: Vec<u32>,
    /// Kept samples: index in the wave, and place among the samples of all waves.
    kept: Vec<(u32, u32)>,
}

/// Packed samples that were not dropped, with their positions `[S, 3]` in model space and their encoding.
#[derive(Clone, Debug, Default)]
pub struct VisibleSamples {
    pub samples: Marched,
    pub positions: Vec<f32>,
    pub encoded: Encoded,
}

/// Memory kept between calls.
#[derive(Default)]
pub struct VisibleBuffers {
    waves: Vec<Wave>,
    used: usize,
    march: march::cpu::MarchScratch,
    pool: Vec<(Vec<f32>, Activations)>,
    next: Vec<u32>,
}

impl VisibleBuffers {
    /// Cells `[N]` and densities `[N]` of all samples of the last march, wave by wave; densities that no light reaches are negative.
    pub fn densities(&self) -> impl Iterator<Item = (&[u32], &[f32])> {
        self.waves[..self.used].iter().map(|w| (&w.marched.cells[..], &w.sigma[..]))
    }

    /// Transmittance of each ray behind all samples of the last march, dropped ones included, `[R]`.
    pub fn light(&self, rays: usize) -> Vec<f32> {
        let mut light = vec![1.0; rays];
        for w in &self.waves[..self.used] {
            w.rays.indices.iter().zip(&w.light).for_each(|(r, l)| light[*r as usize] = *l);
        }
        light
    }

    /// Number of samples of the last march, dropped ones included.
    pub fn marched(&self) -> usize {
        self.waves[..self.used].iter().map(|w| w.sigma.len()).sum()
    }
}

impl Field {
    /// Marches through occupied cells and keeps the samples that [`Pruning`] does not drop. A field whose encoder has no table keeps all.
    pub fn visible(
        &self,
        grid: &OccupancyBits,
        rays: &MarchRays,
        config: &MarchConfig,
        pruning: Pruning,
        out: &mut VisibleSamples,
        buf: &mut FieldBuffers,
    ) {
        let v = &mut buf.visible;
        v.used = 0;
        let VisibleSamples { samples, positions, encoded } = out;
        let Some((levels, f)) = self.encoder.levels() else {
            march::cpu::march(grid, rays, config, &mut v.march, samples);
            march::cpu::positions(rays, samples, positions);
            return self.encode(positions, encoded);
        };
        let net = self.density_net(self.net.mlp.precision);
        let (mut size, mut done) = (WAVE.0, 0);
        while done < config.max_samples {
            size = size.min(config.max_samples - done);
            if v.waves.len() == v.used {
                v.waves.push(Wave::default());
            }
            let (before, rest) = v.waves.split_at_mut(v.used);
            let wave = &mut rest[0];
            wave.admit_rays(rays, before.last(), pruning.stop);
            wave.size = size;
            if wave.rays.indices.is_empty() {
                break;
            }
            v.used += 1;
            let own = wave.rays.as_march_rays();
            march::cpu::march(grid, &own, &MarchConfig { max_samples: size, ..*config }, &mut v.march, &mut wave.marched);
            march::cpu::positions(&own, &wave.marched, &mut wave.positions);
            buf.stages.done("march");
            let n = wave.marched.t.len();
            self.encode(&wave.positions, &mut wave.encoded);
            buf.stages.done("encode");
            wave.sigma.resize(n, 0.0);
            wave.alpha.resize(n, 0.0);
            self.sigma(&net, &wave.encoded, &mut wave.sigma, &mut v.pool);
            buf.stages.done("density");
            wave.prune(pruning);
            buf.stages.done("prune");
            done += size;
            size = (size * 2).min(WAVE.1);
        }
        let total = place(&mut v.waves[..v.used], &mut v.next, rays.jitter.len(), &mut samples.offsets);
        let waves = &v.waves[..v.used];
        let (t, dt, unit) = (&mut samples.t, &mut samples.dt, &mut encoded.unit);
        rayon::join(
            || {
                gather(waves, 1, total, t, |w| &w.marched.t);
                gather(waves, 3, total, positions, |w| &w.positions);
            },
            || {
                gather(waves, 1, total, dt, |w| &w.marched.dt);
                gather(waves, 3, total, unit, |w| &w.encoded.unit);
            },
        );
        encoded.features.resize(total * levels * f, 0.0);
        if total > 0 {
            encoded.features.par_chunks_mut(total * f).enumerate().for_each(|(l, out)| {
                for w in waves {
                    let level = &w.encoded.features[l * w.sigma.len() * f..];
                    for &(from, to) in &w.kept {
                        let (from, to) = (from as usize * f, to as usize * f);
                        out[to..to + f].copy_from_slice(&level[from..from + f]);
                    }
                }
            });
        }
        buf.stages.done("prune");
    }

    /// The layers up to the density head, which read positions alone; their parameters come first.
    pub fn density_net(&self, precision: diorama_kernels::gemm::Precision) -> Mlp {
        let all = &self.net.mlp;
        Mlp { precision, ..Mlp::new(all.input_widths[..1].to_vec(), all.layers[..=self.net.density.layer].to_vec()) }
    }

    /// Densities `[N]` of encoded points, through the layers of [`Field::density_net`].
    pub(super) fn sigma(&self, mlp: &Mlp, encoded: &Encoded, sigma: &mut [f32], pool: &mut Vec<(Vec<f32>, Activations)>) {
        let (n, dims) = (sigma.len(), self.encoder.dims());
        let head = self.net.density;
        let width = mlp.layers[head.layer].width;
        let params = &self.weights.values[..mlp.params_len()];
        let tasks = n.div_ceil(TASK);
        if pool.len() < tasks {
            pool.resize_with(tasks, Default::default);
        }
        sigma.par_chunks_mut(TASK).zip(pool).enumerate().for_each(|(task, (sigma, (rows, acts)))| {
            rows.resize(BLOCK * dims, 0.0);
            for (b, sigma) in sigma.chunks_mut(BLOCK).enumerate() {
                let first = task * TASK + b * BLOCK;
                self.encoder.rows(encoded, first, &mut rows[..sigma.len() * dims]);
                forward_block(mlp, params, &[&rows[..sigma.len() * dims]], sigma.len(), acts);
                for (s, o) in sigma.iter_mut().zip(acts.values[head.layer].chunks_exact(width)) {
                    *s = o[head.channel] + head.shift;
                }
                linear::cpu::activate(head.activation, sigma);
            }
        });
    }
}

impl RayWave {
    fn clear(&mut self) {
        self.indices.clear();
        [&mut self.origins, &mut self.dirs, &mut self.near_far, &mut self.jitter].into_iter().for_each(Vec::clear);
    }

    fn push(&mut self, all: &MarchRays, ray: usize, start: f32) {
        self.indices.push(ray as u32);
        self.origins.extend_from_slice(&all.origins[ray * 3..ray * 3 + 3]);
        self.dirs.extend_from_slice(&all.dirs[ray * 3..ray * 3 + 3]);
        self.near_far.extend([start, all.near_far[ray * 2 + 1]]);
        self.jitter.push(all.jitter[ray]);
    }

    fn as_march_rays(&self) -> MarchRays<'_> {
        MarchRays { origins: &self.origins, dirs: &self.dirs, near_far: &self.near_far, jitter: &self.jitter, resumed: self.resumed }
    }
}

impl Wave {
    /// Admits the rays that filled all of their samples in the wave before and still have light; to the first wave, all rays that have an extent.
    fn admit_rays(&mut self, rays: &MarchRays, before: Option<&Wave>, stop: f32) {
        self.rays.clear();
        self.light.clear();
        self.rays.resumed = before.is_some();
        let Some(w) = before else {
            let with_extent = |r: &usize| rays.near_far[r * 2] < rays.near_far[r * 2 + 1];
            (0..rays.jitter.len()).filter(with_extent).for_each(|r| self.rays.push(rays, r, rays.near_far[r * 2]));
            return self.light.resize(self.rays.indices.len(), 1.0);
        };
        for (i, &r) in w.rays.indices.iter().enumerate() {
            let (a, b) = (w.marched.offsets[i] as usize, w.marched.offsets[i + 1] as usize);
            if b - a == w.size && w.light[i] >= stop {
                self.rays.push(rays, r as usize, w.marched.t[b - 1] + w.marched.dt[b - 1]);
                self.light.push(w.light[i]);
            }
        }
    }

    /// Computes opacities, drops samples, and lowers the transmittance of each ray.
    fn prune(&mut self, pruning: Pruning) {
        self.counts.clear();
        self.counts.resize(self.rays.indices.len(), 0);
        let samples = prune::cpu::Samples {
            offsets: &self.marched.offsets,
            dt: &self.marched.dt,
            sigma: &mut self.sigma,
            alpha: &mut self.alpha,
            light: &mut self.light,
            counts: &mut self.counts,
        };
        prune::cpu::prune(&pruning, samples);
    }
}

/// Assigns a place to each kept sample, so that those of a ray lie together; returns their number.
fn place(waves: &mut [Wave], next: &mut Vec<u32>, rays: usize, offsets: &mut Vec<u32>) -> usize {
    offsets.clear();
    offsets.resize(rays + 1, 0);
    for w in waves.iter() {
        w.rays.indices.iter().zip(&w.counts).for_each(|(r, c)| offsets[*r as usize + 1] += c);
    }
    for r in 0..rays {
        offsets[r + 1] += offsets[r];
    }
    next.clear();
    next.extend_from_slice(&offsets[..rays]);
    for w in waves {
        w.kept.clear();
        for (i, r) in w.rays.indices.iter().enumerate() {
            let to = &mut next[*r as usize];
            for s in w.marched.offsets[i]..w.marched.offsets[i + 1] {
                if w.alpha[s as usize] >= 0.0 {
                    w.kept.push((s, *to));
                    *to += 1;
                }
            }
        }
    }
    offsets[rays] as usize
}

/// Collects rows of `width` numbers of the kept samples.
fn gather(waves: &[Wave], width: usize, total: usize, out: &mut Vec<f32>, of: impl Fn(&Wave) -> &[f32]) {
    out.resize(total * width, 0.0);
    for w in waves {
        let from = of(w);
        for &(s, to) in &w.kept {
            let (s, to) = (s as usize * width, to as usize * width);
            out[to..to + width].copy_from_slice(&from[s..s + width]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fields::{self, DensityQuery};
    use diorama_geom::contraction::Space;
    use diorama_geom::rng::Rng;
    use diorama_kernels::ops::hash_grid::HashGridConfig;

    const RAYS: usize = 40;

    struct Scene {
        field: Field,
        grid: OccupancyBits,
        origins: Vec<f32>,
        dirs: Vec<f32>,
        near_far: Vec<f32>,
        jitter: Vec<f32>,
    }

    /// Rays through a field of varying density, some of which miss it.
    fn scene() -> Scene {
        let config = HashGridConfig { levels: 4, features: 2, log2_size: 10, base: 4, finest: 32 };
        let mut field = fields::ngp(config, Space::Cube(1.0), 1e-2, 0, 0, 1);
        let rng = Rng::new(3, 3);
        let table = &mut field.encoder.table_mut().expect("a hash field").values;
        table.iter_mut().enumerate().for_each(|(i, v)| *v = rng.normal(i as u64) * 2.0);
        field.net.density.shift = 1.5;
        let mut grid = OccupancyBits::full(16, 1);
        grid.fill_with(|i| rng.uniform((1 << 20) + i as u64) > 0.3);
        let mut s = Scene { field, grid, origins: Vec::new(), dirs: Vec::new(), near_far: Vec::new(), jitter: Vec::new() };
        for r in 0..RAYS as u64 {
            let u = |k: u64| rng.uniform((1 << 30) + r * 8 + k);
            s.origins.extend([u(0), u(1), -0.5]);
            let d = [u(2) - 0.5, u(3) - 0.5, 2.0];
            let l = (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]).sqrt();
            s.dirs.extend(d.map(|v| v / l));
            s.near_far.extend(if r % 9 == 4 { [1.0, 0.0] } else { [0.4, 2.0] });
            s.jitter.push(u(4));
        }
        s
    }

    impl Scene {
        fn rays(&self) -> MarchRays<'_> {
            let (origins, dirs, near_far, jitter) = (&self.origins[..], &self.dirs[..], &self.near_far[..], &self.jitter[..]);
            MarchRays { origins, dirs, near_far, jitter, resumed: false }
        }

        fn config(&self) -> MarchConfig {
            MarchConfig { cone: 1.0 / 256.0, dt_min: 0.004, dt_max: 0.1, max_samples: 1000, ..MarchConfig::default() }
        }

        fn visible(&self, pruning: Pruning) -> (VisibleSamples, FieldBuffers) {
            let (mut out, mut buf) = Default::default();
            self.field.visible(&self.grid, &self.rays(), &self.config(), pruning, &mut out, &mut buf);
            (out, buf)
        }

        fn plain(&self) -> (Marched, Vec<f32>) {
            let (mut samples, mut positions) = Default::default();
            march::cpu::march(&self.grid, &self.rays(), &self.config(), &mut Default::default(), &mut samples);
            march::cpu::positions(&self.rays(), &samples, &mut positions);
            (samples, positions)
        }
    }

    #[test]
    fn waves_without_pruning_equal_one_march() {
        let s = scene();
        let (VisibleSamples { samples: got, positions, encoded }, buf) =
            s.visible(Pruning { stop: 0.0, min_alpha: 0.0, thin: 0.0, min_weight: 0.0 });
        let (want, at) = s.plain();
        assert!(want.offsets.windows(2).any(|w| w[1] - w[0] > 3 * WAVE.0 as u32), "several waves are wanted");
        assert_eq!((&got.offsets, &got.t, &got.dt), (&want.offsets, &want.t, &want.dt));
        assert_eq!(positions, at);
        let mut features = Vec::new();
        s.field.encoder.forward(&encoded.unit, &mut features);
        // Groups of sixteen and what is left over round differently.
        let off = encoded.features.iter().zip(&features).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(off < 1e-4, "{off}");
        assert_eq!(buf.visible.marched(), want.t.len());
    }

    #[test]
    fn what_is_dropped_is_hidden_or_thin() {
        let s = scene();
        let (all, at) = s.plain();
        let mut sigma = vec![0.0; all.t.len()];
        s.field.density(&at, &mut sigma);
        let pruning = Pruning { stop: 0.3, min_alpha: 0.0015, thin: 0.7, min_weight: 0.006 };
        let (VisibleSamples { samples: got, .. }, buf) = s.visible(pruning);
        let mut want = Vec::new();
        for w in all.offsets.windows(2) {
            let mut light = 1.0;
            for i in w[0] as usize..w[1] as usize {
                let alpha = 1.0 - (-sigma[i] * all.dt[i]).exp();
                if light >= pruning.stop && alpha >= pruning.min_alpha.min(pruning.thin * all.dt[i]) && light * alpha >= pruning.min_weight
                {
                    want.push(all.t[i]);
                }
                light *= 1.0 - alpha;
            }
        }
        assert!(want.len() > 50 && want.len() < all.t.len() / 2, "{} of {}", want.len(), all.t.len());
        // Rounding may move a sample across a threshold.
        let missing = want.iter().filter(|t| !got.t.contains(t)).count();
        assert!(missing <= 2 && got.t.len().abs_diff(want.len()) <= 2, "{missing} of {} and {}", want.len(), got.t.len());
        let met: usize = buf.visible.densities().map(|(_, s)| s.iter().filter(|s| **s >= 0.0).count()).sum();
        assert!(met >= got.t.len() && met < buf.visible.marched(), "only densities that light reaches are given");
    }

    #[test]
    fn a_field_that_knows_nothing_keeps_its_samples_however_short_the_steps() {
        let mut s = scene();
        s.field =
            fields::ngp(HashGridConfig { levels: 4, features: 2, log2_size: 10, base: 4, finest: 32 }, Space::Cube(1.0), 1e-2, 0, 0, 1);
        let config = MarchConfig { cone: 0.0, dt_min: 0.0005, dt_max: 0.0005, max_samples: 1000, ..MarchConfig::default() };
        let pruning = Pruning { stop: 1e-4, min_alpha: 0.003, thin: 0.7, min_weight: 0.0 };
        let (mut out, mut buf) = (VisibleSamples::default(), FieldBuffers::default());
        s.field.visible(&s.grid, &s.rays(), &config, pruning, &mut out, &mut buf);
        let samples = out.samples;
        assert!(samples.t.len() > 1000 && samples.t.len() == buf.visible.marched(), "{} of {}", samples.t.len(), buf.visible.marched());
    }
}
