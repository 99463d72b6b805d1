//! Cases of the op, for its tests and for `bench check`.

use super::Packed;
#[cfg(feature = "gpu")]
use super::gpu::{self as on_gpu, GpuComposited, GpuPacked};
#[cfg(feature = "gpu")]
use super::{Composited, reference};
#[cfg(feature = "gpu")]
use crate::gpu::{Gpu, GpuError, table::Table};
use diorama_testkit::random_unit;
#[cfg(feature = "gpu")]
use diorama_testkit::wide;

/// Packed samples with their densities.
pub struct Scene {
    pub offsets: Vec<u32>,
    pub t: Vec<f32>,
    pub dt: Vec<f32>,
    pub sigma: Vec<f32>,
}

/// Rays with different numbers of samples; some are empty, some opaque.
pub fn scene(rays: usize, seed: u64) -> Scene {
    let n = random_unit(rays, seed);
    let mut offsets = vec![0u32];
    let (mut t, mut dt) = (Vec::new(), Vec::new());
    for r in 0..rays {
        let count = if r % 5 == 1 { 0 } else { (n[r] * 40.0) as u32 + 1 };
        let steps = random_unit(count as usize, seed + r as u64 + 7);
        let mut at = 0.1;
        for s in steps {
            t.push(at);
            dt.push(0.02 + 0.05 * s);
            at += 0.1;
        }
        offsets.push(t.len() as u32);
    }
    let sigma = random_unit(t.len(), seed + 1).iter().map(|s| s * s * 40.0).collect();
    Scene { offsets, t, dt, sigma }
}

impl Scene {
    pub fn packed(&self) -> Packed<'_> {
        Packed { offsets: &self.offsets, t: &self.t, dt: &self.dt }
    }
}

/// A scene with features of `channels` channels, and gradients of all results.
pub struct Case {
    pub rays: usize,
    pub channels: usize,
    pub scene: Scene,
    pub features: Vec<f32>,
    pub background: Vec<f32>,
    /// Of color, depth, opacity and weights.
    pub d: [Vec<f32>; 4],
}

pub fn cases() -> Vec<Case> {
    use diorama_testkit::random;
    let of = |(rays, channels): (usize, usize)| {
        let scene = scene(rays, 3);
        let s = scene.t.len();
        let d = [random(rays * channels, 4), random(rays, 5), random(rays, 6), random(s, 7)];
        Case { rays, channels, features: random(s * channels, 1), background: random(rays * channels, 2), d, scene }
    };
    [0, 1, 3, 130].into_iter().flat_map(|rays| [1, 3, 19, 512].map(|c| (rays, c))).map(of).collect()
}

#[cfg(feature = "gpu")]
pub fn check(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    for case in cases() {
        let (p, c, shape) = (case.scene.packed(), case.channels, format!("R={} C={}", case.rays, case.channels));
        let up = |v: &[f32]| gpu.upload(v);
        let (pg, sg, fg, bg) = (GpuPacked::upload(gpu, &p), up(&case.scene.sigma), up(&case.features), up(&case.background));
        let out = on_gpu::forward(gpu, &pg, &sg, &fg, c, &bg);
        let (sd, fd, bd) = (wide(&case.scene.sigma), wide(&case.features), wide(&case.background));
        let want = reference::forward(&p, &sd, &fd, c, &bd);
        for (name, got, want) in [
            ("color", &out.color, &want.color),
            ("depth", &out.depth, &want.depth),
            ("opacity", &out.opacity, &want.opacity),
            ("weights", &out.weights, &want.weights),
        ] {
            table.close("composite", name, &shape, got, want)?;
        }
        let [color, depth, opacity, weights] = case.d.each_ref().map(|v| up(v));
        let g = on_gpu::backward(gpu, &pg, &fg, c, &bg, &out, &GpuComposited { color, depth, opacity, weights });
        let [color, depth, opacity, weights] = case.d.each_ref().map(|v| wide(v));
        let (ds, df, db) = reference::backward(&p, &sd, &fd, c, &bd, &Composited { color, depth, opacity, weights });
        table.close("composite", "d sigma", &shape, &g.sigma, &ds)?;
        table.close("composite", "d features", &shape, &g.features, &df)?;
        table.close("composite", "d background", &shape, &g.background, &db)?;
    }
    Ok(())
}
