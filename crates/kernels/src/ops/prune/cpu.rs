//! Opacities of many samples at once, then ray after ray; parallel over groups of rays.

use super::{DROPPED, Pruning};
use crate::math;
use rayon::prelude::*;

/// Rays per task.
const RAYS: usize = 64;

/// Samples in the order in which light passes them, packed ray by ray.
///
/// # Shapes
/// offsets: `[R + 1]`; dt, sigma and alpha: `[S]`; light and counts: `[R]`.
pub struct Samples<'a> {
    pub offsets: &'a [u32],
    pub dt: &'a [f32],
    /// Densities; becomes [`DROPPED`] where no light arrives.
    pub sigma: &'a mut [f32],
    /// Overwritten: opacities, or [`DROPPED`] of samples that are left out.
    pub alpha: &'a mut [f32],
    /// Share of light that arrives at the first sample of each ray; becomes what is left behind its last.
    pub light: &'a mut [f32],
    /// Added to: samples of each ray that stay.
    pub counts: &'a mut [u32],
}

/// Computes opacities, drops samples, and updates each ray's light.
pub fn prune(pruning: &Pruning, samples: Samples) {
    let Samples { offsets, dt, mut sigma, mut alpha, light, counts } = samples;
    let mut tasks = Vec::with_capacity(counts.len().div_ceil(RAYS));
    for (k, (light, counts)) in light.chunks_mut(RAYS).zip(counts.chunks_mut(RAYS)).enumerate() {
        let offsets = &offsets[k * RAYS..=k * RAYS + light.len()];
        let n = (offsets[light.len()] - offsets[0]) as usize;
        let (own_sigma, rest_sigma) = sigma.split_at_mut(n);
        let (own_alpha, rest_alpha) = alpha.split_at_mut(n);
        (sigma, alpha) = (rest_sigma, rest_alpha);
        tasks.push((offsets, light, counts, own_sigma, own_alpha));
    }
    tasks.into_par_iter().for_each(|(offsets, light, counts, sigma, alpha)| {
        let first = offsets[0] as usize;
        math::alphas(sigma, &dt[first..first + sigma.len()], alpha);
        for (r, span) in offsets.windows(2).enumerate() {
            for i in span[0] as usize - first..span[1] as usize - first {
                if light[r] < pruning.stop {
                    (sigma[i], alpha[i]) = (DROPPED, DROPPED);
                    continue;
                }
                let weight = light[r] * alpha[i];
                light[r] -= weight;
                if alpha[i] < pruning.min_alpha.min(pruning.thin * dt[first + i]) || weight < pruning.min_weight {
                    alpha[i] = DROPPED;
                } else {
                    counts[r] += 1;
                }
            }
        }
    });
}
