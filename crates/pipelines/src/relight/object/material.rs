//! Material by position: a hash grid and a small network that give base color, occlusion, roughness and metalness at any point of space.

use super::capture::BOX_HALF;
use super::config::Config;
use diorama_engine::params::ParamGroup;
use diorama_geom::rng::Rng;
use diorama_kernels::ops::adam::Adam;
use diorama_kernels::ops::fused_mlp::{self, Mlp};
use diorama_kernels::ops::hash_grid::{self, HashGrid, HashGridConfig};
use diorama_kernels::ops::split_sum::SMOOTHEST;
use rayon::prelude::*;

/// Outputs: base color, then occlusion, roughness, metalness.
const OUTPUTS: usize = 6;
/// Added before the sigmoid: an object is not occluded, of middle roughness and no metal until photographs say otherwise.
const SHIFT: [f32; OUTPUTS] = [0.0, 0.0, 0.0, -4.0, 0.0, -3.0];
/// Values of the table at the start lie within ± this.
const FIRST: f32 = 1e-4;
/// Streams of random numbers.
const TABLE: u64 = 30;
const WEIGHTS: u64 = 31;

/// The field and its parameters.
pub struct Material {
    grid: HashGrid,
    mlp: Mlp,
    pub table: ParamGroup,
    pub weights: ParamGroup,
    /// Least and largest value of each output.
    range: [[f32; 2]; OUTPUTS],
}

/// Values at points, `[P, 3]` each, and what gradients need.
pub struct Evaluated {
    points: Vec<f32>,
    encoded: Vec<f32>,
    share: Vec<f32>,
    pub kd: Vec<f32>,
    pub ks: Vec<f32>,
}

impl Material {
    pub fn new(config: &Config) -> Material {
        let m = &config.material;
        let grid = HashGrid::new(HashGridConfig { levels: m.levels, features: 2, log2_size: m.log2_size, base: m.base, finest: m.finest });
        let mlp = Mlp::chain(vec![2; m.levels], &[m.width, m.width, OUTPUTS], false);
        let rng = Rng::new(config.seed, TABLE);
        let table: Vec<f32> = (0..grid.params_len() as u64).into_par_iter().map(|i| FIRST * (2.0 * rng.uniform(i) - 1.0)).collect();
        let adam = Adam { rate: config.optim.material_rate, ..Adam::default() };
        let weights = mlp.init(&Rng::new(config.seed, WEIGHTS));
        let [low, high] = m.color;
        let range = [[low, high], [low, high], [low, high], [0.0, 1.0], [SMOOTHEST, 1.0], [0.0, 1.0]];
        Material { grid, mlp, table: ParamGroup::sparse("table", table, adam), weights: ParamGroup::dense("weights", weights, adam), range }
    }

    /// Values at points of object space, `[P, 3]`.
    pub fn evaluate(&self, positions: &[f32]) -> Evaluated {
        let n = positions.len() / 3;
        let points: Vec<f32> = positions.iter().map(|v| (0.5 + 0.5 * v / BOX_HALF as f32).clamp(0.0, 1.0)).collect();
        let mut encoded = vec![0.0; n * self.grid.output_dims()];
        hash_grid::cpu::forward(&self.grid, &points, &self.table.values, &mut encoded);
        let mut raw = vec![0.0; n * OUTPUTS];
        fused_mlp::cpu::forward(&self.mlp, &self.weights.values, &inputs(&encoded, n), n, &mut raw);
        let (mut kd, mut ks) = (vec![0.0; 3 * n], vec![0.0; 3 * n]);
        let rows = raw.as_chunks_mut::<OUTPUTS>().0.par_iter_mut().with_min_len(1024);
        rows.zip(kd.as_chunks_mut::<3>().0).zip(ks.as_chunks_mut::<3>().0).for_each(|((raw, kd), ks)| {
            for (j, raw) in raw.iter_mut().enumerate() {
                *raw = 1.0 / (1.0 + (-(*raw + SHIFT[j])).exp());
                let [low, high] = self.range[j];
                *(if j < 3 { &mut kd[j] } else { &mut ks[j - 3] }) = low + (high - low) * *raw;
            }
        });
        Evaluated { points, encoded, share: raw, kd, ks }
    }

    /// Adds gradients of the parameters, and gives that of the positions, for gradients of the values.
    pub fn backward(&mut self, at: &Evaluated, d_kd: &[f32], d_ks: &[f32]) -> Vec<f32> {
        let n = at.points.len() / 3;
        let mut d_raw = vec![0.0; n * OUTPUTS];
        let rows = d_raw.as_chunks_mut::<OUTPUTS>().0.par_iter_mut().with_min_len(1024).enumerate();
        rows.for_each(|(i, d)| {
            for (j, d) in d.iter_mut().enumerate() {
                let (share, [low, high]) = (at.share[i * OUTPUTS + j], self.range[j]);
                let of = if j < 3 { d_kd[3 * i + j] } else { d_ks[3 * i + j - 3] };
                *d = of * (high - low) * share * (1.0 - share);
            }
        });
        let mut d_inputs = vec![vec![0.0; 2 * n]; self.grid.levels.len()];
        let mut d_weights = vec![0.0; self.weights.values.len()];
        fused_mlp::cpu::backward(&self.mlp, &self.weights.values, &inputs(&at.encoded, n), n, &d_raw, &mut d_weights, &mut d_inputs);
        self.weights.grads.iter_mut().zip(&d_weights).for_each(|(g, d)| *g += d);
        let d_encoded = d_inputs.concat();
        hash_grid::cpu::backward(&self.grid, &at.points, &d_encoded, &mut self.table.grads, Some(&mut self.table.touched));
        let mut d_points = vec![0.0; 3 * n];
        hash_grid::cpu::backward_positions(&self.grid, &at.points, &self.table.values, &d_encoded, &mut d_points);
        d_points.iter_mut().for_each(|d| *d *= 0.5 / BOX_HALF as f32);
        d_points
    }

    /// Drops the gradients.
    pub fn forget(&mut self) {
        self.table.grads.fill(0.0);
        self.table.touched.fill(0);
        self.weights.grads.fill(0.0);
    }

    /// One optimizer step.
    pub fn step(&mut self, t: u32, rate_scale: f32) {
        self.table.step(t, rate_scale);
        self.weights.step(t, rate_scale);
    }
}

/// The levels of an encoding as inputs of the network.
fn inputs(encoded: &[f32], n: usize) -> Vec<&[f32]> {
    encoded.chunks_exact((2 * n).max(1)).collect()
}

/// Difference beyond which colors count as an edge of the material.
const EDGE: f32 = 0.05;

/// Adds the gradient of `weight · mean ρ(|a − b|)` over values `[P, 3]`, and returns it. `ρ(d) = d e / (d + e)` tells shading from material as
/// Retinex does (Land and McCann 1971): small differences cost what they are, edges hardly more the higher they are.
pub fn smoothness(a: &[f32], b: &[f32], weight: f32, mut to: impl FnMut(usize, f32)) -> f64 {
    let scale = weight / a.len().max(1) as f32;
    let mut sum = 0.0;
    for (i, (a, b)) in a.iter().zip(b).enumerate().filter(|(_, (a, b))| a != b) {
        let d = (a - b).abs();
        sum += (d * EDGE / (d + EDGE)) as f64;
        to(i, scale * (a - b).signum() * (EDGE / (d + EDGE)).powi(2));
    }
    scale as f64 * sum
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::relight::object::config::Preset;
    use diorama_testkit::random;

    #[test]
    fn smoothness_has_its_gradient_and_spares_edges() {
        let (a, b) = (random(6, 1), random(6, 2));
        let mut d = [0.0; 6];
        smoothness(&a, &b, 2.0, |i, v| d[i] = v);
        for i in 0..6 {
            let at = |by: f32| {
                let mut a = a.clone();
                a[i] += by;
                smoothness(&a, &b, 2.0, |_, _| {})
            };
            let want = (at(1e-3) - at(-1e-3)) / 2e-3;
            assert!((d[i] as f64 - want).abs() < 1e-4, "{} {want}", d[i]);
        }
        let of = |d: f32| smoothness(&[d], &[0.0], 1.0, |_, _| {});
        assert!(of(0.6) < 1.2 * of(0.3) && of(0.002) > 1.9 * of(0.001));
    }

    #[test]
    fn gradients_match_central_differences() {
        let mut config = Config::new(Preset::Ci, "d".into());
        config.material.levels = 4;
        let mut m = Material::new(&config);
        m.table.values.iter_mut().enumerate().for_each(|(i, v)| *v = ((i * 37) % 101) as f32 / 101.0 - 0.5);
        let (positions, d) = (random(15, 1), random(30, 2));
        let loss = |m: &Material, p: &[f32]| {
            let e = m.evaluate(p);
            let all = e.kd.iter().chain(&e.ks).zip(&d);
            all.map(|(v, d)| (*v * d) as f64).sum::<f64>()
        };
        let e = m.evaluate(&positions);
        let d_positions = m.backward(&e, &d[..15], &d[15..]);
        let near = |got: f32, want: f64| (got as f64 - want).abs() < 2e-2 * (want.abs() + 0.05);
        let mut compared = 0;
        for i in 0..15 {
            let at = |by: f32| {
                let mut p = positions.clone();
                p[i] += by;
                loss(&m, &p)
            };
            // Features change fast between cells: a longer step averages over kinks of the network.
            const STEP: f64 = 5e-5;
            let (left, here, right) = (at(-STEP as f32), loss(&m, &positions), at(STEP as f32));
            let want = (right - left) / (2.0 * STEP);
            // Not across a wall between cells or a kink.
            if near(((right - here) / STEP) as f32, (here - left) / STEP) {
                compared += 1;
                assert!(near(d_positions[i], want), "position {i}: {} {want}", d_positions[i]);
            }
        }
        assert!(compared >= 10, "{compared} of 15");
        let touched: Vec<usize> = (0..m.table.grads.len()).filter(|i| m.table.grads[*i].abs() > 0.01).take(12).collect();
        assert!(touched.len() == 12);
        for i in touched {
            let grad = m.table.grads[i];
            let mut at = |by: f32| {
                m.table.values[i] += by;
                let l = loss(&m, &positions);
                m.table.values[i] -= by;
                l
            };
            let want = (at(1e-2) - at(-1e-2)) / 2e-2;
            assert!(near(grad, want), "table {i}: {grad} {want}");
        }
    }
}
