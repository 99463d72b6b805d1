//! Cases of the op, for its tests and for `bench check`.

use super::Pruning;
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

pub const PRUNING: Pruning = Pruning { stop: 1e-3, min_alpha: 3e-3, thin: 0.7, min_weight: 2e-3 };

/// Rays through thin matter and opaque matter.
pub fn cases() -> [(usize, Scene); 4] {
    [0, 1, 80, 130].map(|rays| {
        let mut s = scene(rays, 3);
        let u = random_unit(s.sigma.len(), 2);
        s.sigma.iter_mut().zip(u).for_each(|(s, u)| *s = if u < 0.3 { 0.05 * u } else { 40.0 * u * u });
        (rays, s)
    })
}

#[cfg(feature = "gpu")]
pub fn check(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    for (rays, scene) in cases() {
        let packed = scene.packed();
        let want = reference::prune(&PRUNING, &packed, &scene.sigma);
        let (p, rows, kept) = (GpuPacked::upload(gpu, &packed), random(scene.t.len() * 5, 6), &want.kept);
        for capacity in [kept.len() + 10, kept.len() / 2] {
            let shape = format!("R={rays} room {capacity}");
            let (sigma, cut) = (gpu.upload(&scene.sigma), gpu.zeros(rays));
            let pruned = on_gpu::prune(gpu, &p, &sigma, &PRUNING, &cut, capacity);
            let bounded: Vec<u32> = want.offsets.iter().map(|o| (*o).min(capacity as u32)).collect();
            let lost: Vec<u32> = want.offsets[1..].iter().map(|o| (*o > capacity as u32) as u32).collect();
            table.close("prune", "densities", &shape, &sigma, &wide(&want.sigma))?;
            table.close("prune", "light", &shape, &pruned.light, &want.light)?;
            table.equal("prune", "offsets", &shape, &pruned.packed.offsets, &bounded)?;
            table.equal("prune", "rays cut", &shape, &cut, &lost)?;
            let n = kept.len().min(capacity);
            let take =
                |v: &[f32], width: usize| -> Vec<f64> { kept[..n].iter().flat_map(|i| wide(&v[i * width..(i + 1) * width])).collect() };
            let live = |all: Vec<f32>, width: usize| gpu.upload(&all[..n * width]);
            let (t, five) = (gpu.read(&pruned.packed.t)?, gpu.read(&pruned.take(gpu, &gpu.upload(&rows), 5))?);
            table.close("prune", "starts", &shape, &live(t, 1), &take(&scene.t, 1))?;
            table.close("prune", "rows", &shape, &live(five, 5), &take(&rows, 5))?;
        }
    }
    Ok(())
}
