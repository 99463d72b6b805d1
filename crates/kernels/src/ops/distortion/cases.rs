//! Cases of the op, for its tests and for `bench check`.

#[cfg(feature = "gpu")]
use super::{gpu as on_gpu, reference};
use crate::ops::composite::cases::{Scene, scene};
#[cfg(feature = "gpu")]
use crate::{
    gpu::{Gpu, GpuError, table::Table},
    ops::composite::gpu::GpuPacked,
};
#[cfg(feature = "gpu")]
use diorama_testkit::wide;
use diorama_testkit::{random, random_unit};

/// Weights of samples, and gradients of rays' losses.
pub struct Case {
    pub rays: usize,
    pub scene: Scene,
    pub weights: Vec<f32>,
    pub d: Vec<f32>,
}

pub fn cases() -> Vec<Case> {
    let of = |rays: usize| {
        let scene = scene(rays, 3);
        Case { rays, weights: random_unit(scene.t.len(), 1), d: random(rays, 2), scene }
    };
    [0, 1, 77, 130].map(of).into()
}

#[cfg(feature = "gpu")]
pub fn check(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    for c in cases() {
        let (p, w, shape) = (GpuPacked::upload(gpu, &c.scene.packed()), gpu.upload(&c.weights), format!("R={}", c.rays));
        let want = reference::forward(&c.scene.packed(), &wide(&c.weights));
        table.close("distortion", "forward", &shape, &on_gpu::forward(gpu, &p, &w), &want)?;
        let want = reference::backward(&c.scene.packed(), &wide(&c.weights), &wide(&c.d));
        table.close("distortion", "d weights", &shape, &on_gpu::backward(gpu, &p, &w, &gpu.upload(&c.d)), &want)?;
    }
    Ok(())
}
