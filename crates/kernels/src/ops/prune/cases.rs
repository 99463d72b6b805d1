//! Cases of the op, for its tests and for `bench check`.

use super::Pruning;
#[cfg(feature = "gpu")]
use super::{gpu as on_gpu, reference};
use crate::ops::composite::cases::{Scene, scene};
#[cfg(feature = "gpu")]
use crate::{
    gpu::{Buffer, Gpu, GpuError, table::Table},
    ops::composite::gpu::GpuPacked,
    ops::march::{self, cases as marches},
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
    check_waves(gpu, table)?;
    for (rays, scene) in cases() {
        let packed = scene.packed();
        let want = reference::prune(&PRUNING, &packed, &scene.sigma);
        let (p, rows_of_five, kept) = (GpuPacked::upload(gpu, &packed), random(scene.t.len() * 5, 6), &want.kept);
        for capacity in [kept.len() + 10, kept.len() / 2] {
            let shape = format!("R={rays} room {capacity}");
            let (sigma, cut) = (gpu.upload(&scene.sigma), gpu.zeros(rays));
            let pruned = on_gpu::prune(gpu, &p, (&sigma, None), &PRUNING, &cut, capacity);
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
            let (t, five) = (gpu.read(&pruned.packed.t)?, gpu.read(&pruned.take(gpu, &gpu.upload(&rows_of_five), 5))?);
            table.close("prune", "starts", &shape, &live(t, 1), &take(&scene.t, 1))?;
            table.close("prune", "rows", &shape, &live(five, 5), &take(&rows_of_five, 5))?;
            // The same in two parts of each ray.
            let cut = gpu.zeros(rays);
            let (joined, light, five) = in_parts(gpu, table, &scene, &rows_of_five, &cut, capacity)?;
            table.close("prune", "light of parts", &shape, &light, &want.light)?;
            table.equal("prune", "offsets of parts", &shape, &joined.packed.offsets, &bounded)?;
            table.equal("prune", "rays cut of parts", &shape, &cut, &lost)?;
            let (t, dt) = (gpu.read(&joined.packed.t)?, gpu.read(&joined.packed.dt)?);
            table.close("prune", "starts of parts", &shape, &live(t, 1), &take(&scene.t, 1))?;
            table.close("prune", "lengths of parts", &shape, &live(dt, 1), &take(&scene.dt, 1))?;
            table.close("prune", "rows of parts", &shape, &live(gpu.read(&five)?, 5), &take(&rows_of_five, 5))?;
        }
    }
    Ok(())
}

/// The same march in two waves, between which no ray ends for want of light.
#[cfg(feature = "gpu")]
fn in_waves(
    gpu: &Gpu,
    grid: &march::gpu::GpuOccupancy,
    rays: &march::gpu::GpuRays,
    config: &march::MarchConfig,
    capacity: usize,
) -> Result<march::Marched, GpuError> {
    const FIRST: usize = 7;
    let first = march::gpu::march(gpu, grid, rays, &march::MarchConfig { max_samples: FIRST, ..*config }, capacity);
    let light = gpu.upload(&vec![1.0f32; rays.jitter.len()]);
    let left = march::gpu::go_on(gpu, rays, &first, &light, 1.0, FIRST);
    let second = march::gpu::march(gpu, grid, &left, &march::MarchConfig { max_samples: config.max_samples - FIRST, ..*config }, capacity);
    let joined = on_gpu::join(gpu, &first.packed, &second.packed, &first.cut, capacity);
    let mut of = Vec::new();
    for wave in [&first, &second] {
        of.push((gpu.read(&wave.packed.offsets)?, gpu.read(&wave.cells)?));
    }
    let of_ray = |r: usize| of.iter().flat_map(move |(offsets, cells)| cells[offsets[r] as usize..offsets[r + 1] as usize].to_vec());
    Ok(march::Marched {
        offsets: gpu.read(&joined.packed.offsets)?,
        t: gpu.read(&joined.packed.t)?,
        dt: gpu.read(&joined.packed.dt)?,
        cells: (0..rays.jitter.len()).flat_map(of_ray).collect(),
    })
}

#[cfg(feature = "gpu")]
fn check_waves(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    for marches::Case { grid, config, rays } in marches::cases() {
        let (r, n) = (rays.view(), rays.jitter.len());
        let want = march::reference::march(&grid, &r, &config);
        let (on, occupancy) = (march::gpu::GpuRays::upload(gpu, &r), march::gpu::GpuOccupancy::upload(gpu, &grid));
        let got = in_waves(gpu, &occupancy, &on, &config, want.t.len() + 500)?;
        let shape = format!("R={n} cascades={} unbounded={}", grid.cascades, config.unbounded);
        table.row("prune", "samples of two waves", shape, marches::compare_rays(&got, &want));
    }
    Ok(())
}

/// Prunes the first samples of each ray, then the others with the light that is left, and joins what stays.
#[cfg(feature = "gpu")]
fn in_parts(
    gpu: &Gpu,
    table: &mut Table,
    scene: &Scene,
    rows: &[f32],
    cut: &Buffer<u32>,
    capacity: usize,
) -> Result<(on_gpu::Joined, Buffer, Buffer), GpuError> {
    const FIRST: u32 = 4;
    let mut parts = [const { (Vec::new(), Vec::new()) }; 2];
    parts.iter_mut().for_each(|(offsets, _)| offsets.push(0u32));
    for w in scene.offsets.windows(2) {
        let middle = (w[0] + FIRST).min(w[1]);
        for ((offsets, samples), range) in parts.iter_mut().zip([w[0]..middle, middle..w[1]]) {
            samples.extend(range.map(|i| i as usize));
            offsets.push(samples.len() as u32);
        }
    }
    let hidden = wide(&reference::prune(&PRUNING, &scene.packed(), &scene.sigma).sigma);
    let mut before: Option<Buffer> = None;
    let mut kept = Vec::new();
    for (offsets, samples) in &parts {
        let of = |v: &[f32]| gpu.upload(&samples.iter().map(|i| v[*i]).collect::<Vec<_>>());
        let packed = GpuPacked { offsets: gpu.upload(offsets), t: of(&scene.t), dt: of(&scene.dt) };
        let own: Vec<f32> = samples.iter().flat_map(|i| rows[5 * i..5 * (i + 1)].to_vec()).collect();
        let sigma = of(&scene.sigma);
        let pruned = on_gpu::prune(gpu, &packed, (&sigma, before.as_ref()), &PRUNING, cut, capacity);
        let want: Vec<f64> = samples.iter().map(|i| hidden[*i]).collect();
        table.close("prune", "densities of a part", format!("R={} room {capacity}", offsets.len() - 1), &sigma, &want)?;
        let five = pruned.take(gpu, &gpu.upload(&own), 5);
        before = Some(pruned.light);
        kept.push((pruned.packed, five));
    }
    let joined = on_gpu::join(gpu, &kept[0].0, &kept[1].0, cut, capacity);
    let five = joined.take(gpu, [&kept[0].1, &kept[1].1], 5);
    Ok((joined, before.expect("two parts"), five))
}
