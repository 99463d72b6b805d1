//! Packed samples for tests.

use diorama_kernels::ops::composite::Packed;
use diorama_testkit::random_unit;

pub(crate) struct RaggedRays {
    pub offsets: Vec<u32>,
    pub t: Vec<f32>,
    pub dt: Vec<f32>,
    pub sigma: Vec<f32>,
}

/// Rays of different lengths, every fifth from the second on empty.
pub(crate) fn ragged_rays(rays: usize, seed: u64) -> RaggedRays {
    let mut offsets = vec![0];
    for (r, length) in random_unit(rays, seed).iter().enumerate() {
        let count = if r % 5 == 1 { 0 } else { (length * 40.0) as u32 + 1 };
        offsets.push(offsets[r] + count);
    }
    let samples = offsets[rays] as usize;
    let t = (0..samples).map(|s| 0.1 + 0.1 * s as f32).collect();
    let dt = random_unit(samples, seed + 1).iter().map(|u| 0.02 + 0.05 * u).collect();
    let sigma = random_unit(samples, seed + 2).iter().map(|u| u * u * 40.0).collect();
    RaggedRays { offsets, t, dt, sigma }
}

impl RaggedRays {
    pub fn packed(&self) -> Packed<'_> {
        Packed { offsets: &self.offsets, t: &self.t, dt: &self.dt }
    }
}
