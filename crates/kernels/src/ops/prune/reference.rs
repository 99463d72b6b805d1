//! Sample after sample in f64.

use super::{DROPPED, Pruning};
use crate::ops::composite::Packed;

/// Samples that remain after pruning.
pub struct Pruned {
    /// Samples that stay, in order, and where each ray's begin among them, `[R + 1]`.
    pub kept: Vec<usize>,
    pub offsets: Vec<u32>,
    /// Densities, [`DROPPED`] where no light arrives, `[S]`.
    pub sigma: Vec<f32>,
    /// Share of light that passes all samples, `[R]`.
    pub light: Vec<f64>,
}

/// What [`Pruning`] leaves of samples with densities `[S]`.
pub fn prune(pruning: &Pruning, p: &Packed, sigma: &[f32]) -> Pruned {
    let mut out = Pruned { kept: Vec::new(), offsets: vec![0], sigma: sigma.to_vec(), light: Vec::new() };
    for r in 0..p.rays() {
        let mut light = 1.0f64;
        for i in p.range(r) {
            if light < pruning.stop as f64 {
                out.sigma[i] = DROPPED;
                continue;
            }
            let alpha = 1.0 - (-(sigma[i] as f64) * p.dt[i] as f64).exp();
            let weight = light * alpha;
            light -= weight;
            if weight >= pruning.min_weight as f64 && alpha >= pruning.min_alpha.min(pruning.thin * p.dt[i]) as f64 {
                out.kept.push(i);
            }
        }
        out.offsets.push(out.kept.len() as u32);
        out.light.push(light);
    }
    out
}
