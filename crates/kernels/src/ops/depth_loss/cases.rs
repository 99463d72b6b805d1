//! Cases of the op, for its tests and for `bench check`.

#[cfg(feature = "gpu")]
use super::{gpu as on_gpu, reference};
use crate::ops::composite::cases::{Scene, scene};
#[cfg(feature = "gpu")]
use crate::{
    gpu::{Gpu, GpuError, table::Table},
    ops::composite::gpu::GpuPacked,
};
use diorama_testkit::random_unit;
#[cfg(feature = "gpu")]
use diorama_testkit::{random, wide};

/// Weights of samples, and distances of rays' surfaces, 0 where they are not known.
pub struct Case {
    pub rays: usize,
    pub scene: Scene,
    pub weights: Vec<f32>,
    pub surface: Vec<f32>,
}

pub fn cases() -> Vec<Case> {
    let of = |rays: usize| {
        let scene = scene(rays, 3);
        let surface = random_unit(rays, 4).iter().zip(0..).map(|(v, r)| if r % 5 == 4 { 0.0 } else { 0.3 + 3.0 * v }).collect();
        Case { rays, weights: random_unit(scene.t.len(), 1), surface, scene }
    };
    [0, 1, 77, 130].map(of).into()
}

#[cfg(feature = "gpu")]
pub fn check(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    let (depth, scale) = (0.3, 0.7);
    for c in cases() {
        let (packed, values, d) = (c.scene.packed(), random(c.rays, 2), random(c.scene.t.len(), 3));
        // Some rays do not count.
        let left_out: Vec<u32> = (0..c.rays as u32).map(|r| (r % 7 == 6) as u32).collect();
        let counted: Vec<f32> = c.surface.iter().zip(&left_out).map(|(s, out)| s * (1 - out) as f32).collect();
        let (p, losses, slopes) = (GpuPacked::upload(gpu, &packed), gpu.upload(&values), gpu.upload(&d));
        let (w, surface, left_out) = (gpu.upload(&c.weights), gpu.upload(&c.surface), gpu.upload(&left_out));
        on_gpu::add(gpu, &p, &w, &surface, &left_out, (depth, scale), (&losses, &slopes));
        let added = |to: &[f32], more: Vec<f64>| -> Vec<f64> { to.iter().zip(more).map(|(a, b)| *a as f64 + b).collect() };
        let loss = reference::forward(&packed, &wide(&c.weights), &counted).iter().map(|l| depth as f64 * l).collect();
        let slope = reference::backward(&packed, &counted, (depth * scale) as f64);
        let shape = format!("R={}", c.rays);
        table.close("depth loss", "forward", &shape, &losses, &added(&values, loss))?;
        table.close("depth loss", "d weights", &shape, &slopes, &added(&d, slope))?;
    }
    Ok(())
}
