//! Cases of the op, for its tests and for `bench check`.

use super::PosedCamera;
#[cfg(feature = "gpu")]
use super::{CORRECTION, gpu::GpuCameras, reference};
#[cfg(feature = "gpu")]
use crate::gpu::{Gpu, GpuError, table::Table};
use diorama_geom::glam::DVec3;
use diorama_geom::{Camera, Lens, Pose};
#[cfg(feature = "gpu")]
use diorama_testkit::wide;
use diorama_testkit::{random, random_unit};

/// Cameras with every lens, rotated and translated.
pub fn cameras() -> Vec<PosedCamera> {
    let lenses = [
        Lens::Pinhole,
        Lens::Brown { k: [0.05, -0.02, 0.004, 0.01, 0.0, 0.0], p: [1e-3, -1e-3] },
        Lens::Fisheye { k: [0.02, -0.003, 0.0, 0.0], p: [1e-3, 0.0], s: [0.0, 1e-3] },
        Lens::Fov { omega: 0.7 },
        Lens::Equirectangular,
    ];
    let posed = |(i, lens)| PosedCamera {
        camera: Camera { lens, ..Camera::pinhole(64, 48, 0.9) },
        pose: Pose::look_at(DVec3::new(2.0, i as f64, 1.0), DVec3::ZERO, DVec3::Z),
    };
    lenses.into_iter().enumerate().map(posed).collect()
}

/// Pixels of cameras, and gradients of their rays' origins and directions.
pub struct Case {
    pub index: Vec<u32>,
    pub pixels: Vec<f32>,
    pub d_origins: Vec<f32>,
    pub d_dirs: Vec<f32>,
}

pub fn case(n: usize) -> Case {
    Case {
        index: (0..n as u32).map(|i| i % 5).collect(),
        pixels: random_unit(n * 2, 1).iter().map(|v| v * 48.0).collect(),
        d_origins: random(n * 3, 2),
        d_dirs: random(n * 3, 3),
    }
}

pub fn cases() -> [Case; 3] {
    [0, 1, 301].map(case)
}

#[cfg(feature = "gpu")]
pub fn check(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    let all = cameras();
    let on_gpu = GpuCameras::upload(gpu, &all);
    for c in cases() {
        let (ig, pg, pw) = (gpu.upload(&c.index), gpu.upload(&c.pixels), wide(&c.pixels));
        let shape = format!("R={}", c.index.len());
        let (origins, dirs) = on_gpu.forward(gpu, &ig, &pg);
        let (want_o, want_d) = reference::forward(&all, &c.index, &pw);
        table.close("ray generation", "origins", &shape, &origins, &want_o)?;
        table.close("ray generation", "directions", &shape, &dirs, &want_d)?;
        let want = reference::backward(&all, &c.index, &pw, &wide(&c.d_origins), &wide(&c.d_dirs));
        let got = on_gpu.backward(gpu, &ig, &pg, &dirs, &gpu.upload(&c.d_origins), &gpu.upload(&c.d_dirs));
        table.close("ray generation", "d corrections", &shape, &got, &want)?;
    }
    check_corrections(gpu, table)
}

/// Cameras with corrections, which replace those before.
#[cfg(feature = "gpu")]
fn check_corrections(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    const OP: &str = "camera corrections";
    let (base, case) = (cameras(), case(60));
    let mut numbers = random(base.len() * CORRECTION, 3);
    // One is none, and one rotates by next to nothing.
    numbers[..CORRECTION].fill(0.0);
    numbers[CORRECTION..2 * CORRECTION].iter_mut().for_each(|v| *v *= 1e-6);
    let correct = |(c, d): (&PosedCamera, &[f32])| c.corrected(&std::array::from_fn(|k| d[k] as f64));
    let on_gpu = GpuCameras::upload(gpu, &base);
    for refined in [false, true] {
        let kept = gpu.upload(&numbers);
        on_gpu.correct(gpu, &kept, refined);
        let of_focal = |i: usize| i % CORRECTION == 6 && !refined;
        let own: Vec<f32> = numbers.iter().zip(0..).map(|(v, i)| if of_focal(i) { 0.0 } else { *v }).collect();
        let corrected: Vec<PosedCamera> = base.iter().zip(own.chunks_exact(CORRECTION)).map(correct).collect();
        let (origins, dirs) = on_gpu.forward(gpu, &gpu.upload(&case.index), &gpu.upload(&case.pixels));
        let (want_origins, want_dirs) = reference::forward(&corrected, &case.index, &wide(&case.pixels));
        let shape = format!("{} cameras, focal lengths refined: {refined}", base.len());
        table.close(OP, "corrections", &shape, &kept, &wide(&own))?;
        table.close(OP, "origins", &shape, &origins, &want_origins)?;
        table.close(OP, "directions", &shape, &dirs, &want_dirs)?;
    }
    Ok(())
}
