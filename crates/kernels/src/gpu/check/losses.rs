//! Losses of rays' samples against their references.

use super::{Rays, Table};
use crate::gpu::{Gpu, GpuError};
use crate::ops::composite::gpu::GpuPacked;
use crate::ops::{depth_loss, distortion};
use diorama_testkit::{random, random_unit, wide};

pub(super) fn distortions(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    for rays in [0, 1, 130] {
        let scene = Rays::new(rays);
        let (w, d) = (random_unit(scene.t.len(), 1), random(rays, 2));
        let (p, wg) = (GpuPacked::upload(gpu, &scene.packed()), gpu.upload(&w));
        let shape = format!("R={rays}");
        let want = distortion::reference::forward(&scene.packed(), &wide(&w));
        table.close("distortion", "forward", &shape, &distortion::gpu::forward(gpu, &p, &wg), &want)?;
        let want = distortion::reference::backward(&scene.packed(), &wide(&w), &wide(&d));
        table.close("distortion", "d weights", &shape, &distortion::gpu::backward(gpu, &p, &wg, &gpu.upload(&d)), &want)?;
    }
    Ok(())
}

pub(super) fn depths(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    let (depth, scale) = (0.3, 0.7);
    for rays in [0, 1, 130] {
        let scene = Rays::new(rays);
        let (packed, w, values, d) = (scene.packed(), random_unit(scene.t.len(), 1), random(rays, 2), random(scene.t.len(), 3));
        // Some surfaces are not known, and some rays do not count.
        let surface: Vec<f32> = random_unit(rays, 4).iter().zip(0..).map(|(v, r)| if r % 5 == 4 { 0.0 } else { 0.3 + 3.0 * v }).collect();
        let left_out: Vec<u32> = (0..rays as u32).map(|r| (r % 7 == 6) as u32).collect();
        let counted: Vec<f32> = surface.iter().zip(&left_out).map(|(s, out)| s * (1 - out) as f32).collect();
        let (p, losses, slopes) = (GpuPacked::upload(gpu, &packed), gpu.upload(&values), gpu.upload(&d));
        depth_loss::gpu::add(gpu, &p, &gpu.upload(&w), &gpu.upload(&surface), &gpu.upload(&left_out), (depth, scale), (&losses, &slopes));
        let added = |to: &[f32], more: Vec<f64>| -> Vec<f64> { to.iter().zip(more).map(|(a, b)| *a as f64 + b).collect() };
        let loss = depth_loss::reference::forward(&packed, &wide(&w), &counted).iter().map(|l| depth as f64 * l).collect();
        let slope = depth_loss::reference::backward(&packed, &counted, (depth * scale) as f64);
        let shape = format!("R={rays}");
        table.close("depth_loss", "forward", &shape, &losses, &added(&values, loss))?;
        table.close("depth_loss", "d weights", &shape, &slopes, &added(&d, slope))?;
    }
    Ok(())
}
