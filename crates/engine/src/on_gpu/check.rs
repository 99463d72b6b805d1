//! Checks of a device: the parts of a training step compared with the CPU's.

mod draws;
mod views;

use super::GpuTracer;
use crate::fields::{self, DensityQuery, FieldBuffers};
use crate::renderers::supervised::Supervised;
use crate::renderers::volume::{self, Accelerator, Quality, Tracer};
use crate::samplers::RayBatch;
use crate::samplers::occupancy::Occupancy;
use crate::samplers::pixels::{self, DrawOptions, ErrorMap, Observation, PixelSource};
use crate::samplers::placement::Placement;
use crate::samplers::stratified;
use diorama_geom::contraction;
use diorama_geom::glam::DVec3;
use diorama_geom::rng::Rng;
use diorama_geom::{Camera, PixelFormat, Pose};
use diorama_kernels::check::{Row, Table};
use diorama_kernels::gpu::{Gpu, GpuError};
use diorama_kernels::ops::composite::Packed;
use diorama_kernels::ops::composite::gpu::GpuPacked;
use diorama_kernels::ops::field_step::gpu as field;
use diorama_kernels::ops::hash_grid::HashGridConfig;
use diorama_kernels::ops::march::gpu::{self as march, GpuRays, Space};
use diorama_kernels::ops::march::{MarchRays, Marched};
use diorama_kernels::ops::pixel_gather;
use diorama_kernels::ops::pixel_gather::gpu::error_map::GpuErrorMap;
use diorama_kernels::ops::pixel_gather::gpu::{Backdrop, CELLS, GpuPhotographs};
use diorama_kernels::ops::ray_generation::gpu::GpuCameras;
use diorama_kernels::ops::ray_generation::{self, CORRECTION, PosedCamera};
use diorama_kernels::ops::sample_pdf::gpu::strata;
use diorama_testkit::{random, random_unit, wide};

/// Runs all cases.
///
/// # Errors
/// When the device is lost; wrong results are rows with a fault.
pub fn run(gpu: &Gpu) -> Result<Vec<Row>, GpuError> {
    let mut table = Table::new(gpu);
    for case in [draws::draws, strata_cases, corrections, spaces, look_ups, views::views, views::other_views] {
        case(gpu, &mut table)?;
    }
    Ok(table.rows)
}

/// Samples without a grid, as the CPU places them.
fn strata_cases(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    let (n, m) = (13, 29);
    for rays in [0, 1, 70] {
        for jitter in [None, Some((Rng::new(4, 4), (1u64 << 33) + 7))] {
            let mut batch = RayBatch::default();
            batch.resize(rays);
            let near: Vec<f32> = random_unit(rays, 1);
            batch.near_far = near.iter().enumerate().flat_map(|(i, v)| [*v, v + 0.3 * (i % 5) as f32]).collect();
            let weights: Vec<f32> = random_unit(rays * n, 2).iter().map(|w| if *w < 0.7 { 0.0 } else { *w }).collect();
            let (mut coarse, mut fine) = (Marched::default(), Marched::default());
            stratified::stratified(&batch, n, jitter, &mut coarse);
            stratified::refine(&coarse, &weights, n, m, jitter, &mut fine);
            let first = strata::stratified(gpu, &gpu.upload(&batch.near_far), n, jitter);
            let second = strata::refine(gpu, &first, &gpu.upload(&weights), n, m, jitter);
            for (name, got, want) in [("stratified", first, coarse), ("refined", second, fine)] {
                let shape = format!("R={rays} {name}{}", if jitter.is_some() { " jittered" } else { "" });
                table.equal("strata", "offsets", &shape, &got.offsets, &want.offsets)?;
                table.close("strata", "starts", &shape, &got.t, &wide(&want.t))?;
                // Lengths are small differences of starts.
                let ends = |t: &[f32], dt: &[f32]| t.iter().zip(dt).map(|(t, dt)| t + dt).collect::<Vec<f32>>();
                let ends_gpu = ends(&gpu.read(&got.t)?, &gpu.read(&got.dt)?);
                table.close("strata", "ends", &shape, &gpu.upload(&ends_gpu), &wide(&ends(&want.t, &want.dt)))?;
            }
        }
    }
    Ok(())
}

/// Cameras with corrections, and the gradients of rays from those of samples.
fn corrections(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    let base: Vec<PosedCamera> = (0..5)
        .map(|i| PosedCamera {
            camera: Camera::pinhole(64, 48, 0.7),
            pose: Pose::look_at(DVec3::new(2.0, i as f64 - 2.0, 1.0), DVec3::splat(0.5), DVec3::Z),
        })
        .collect();
    let mut numbers = random(5 * CORRECTION, 3);
    // One as given, one turned by next to nothing.
    numbers[..CORRECTION].fill(0.0);
    numbers[CORRECTION..2 * CORRECTION].iter_mut().for_each(|v| *v *= 1e-6);
    let corrected: Vec<PosedCamera> =
        base.iter().zip(numbers.chunks_exact(CORRECTION)).map(|(c, d)| c.corrected(&std::array::from_fn(|k| d[k] as f64))).collect();
    let n = 60;
    let index: Vec<u32> = (0..n as u32).map(|i| i % 5).collect();
    let at: Vec<f32> = random_unit(n * 2, 4).iter().map(|v| v * 48.0).collect();
    let (mut origins, mut dirs) = (vec![0.0; n * 3], vec![0.0; n * 3]);
    ray_generation::cpu::forward(&corrected, &index, &at, &mut origins, &mut dirs);
    let cameras = GpuCameras::upload(gpu, &base);
    // Twice: corrections replace those before.
    let kept = gpu.upload(&numbers);
    cameras.correct(gpu, &kept, false);
    let mut without_focal = numbers.clone();
    without_focal.iter_mut().skip(6).step_by(CORRECTION).for_each(|v| *v = 0.0);
    table.close("camera corrections", "focal lengths kept", "5 cameras", &kept, &wide(&without_focal))?;
    cameras.correct(gpu, &gpu.upload(&numbers), true);
    let (o, d) = cameras.forward(gpu, &gpu.upload(&index), &gpu.upload(&at));
    table.close("camera corrections", "origins", "5 cameras", &o, &wide(&origins))?;
    table.close("camera corrections", "directions", "5 cameras", &d, &wide(&dirs))?;

    for rays in [0, 1, 80] {
        let scene = Ragged::new(rays);
        let (origins, dirs, d) = (random(rays * 3, 4), random(rays * 3, 5), random(scene.t.len() * 3, 6));
        let (near_far, jitter) = (vec![0.0; rays * 2], vec![0.5; rays]);
        let r = MarchRays { origins: &origins, dirs: &dirs, near_far: &near_far, jitter: &jitter, resumed: false };
        let (on_gpu, p) = (GpuRays::upload(gpu, &r), GpuPacked::upload(gpu, &scene.packed()));
        for space in [Space::Model, Space::Cube(4.0), Space::Centred(4.0), Space::Contracted(1.5), Space::ContractedCentred(1.5)] {
            let (mut d_origins, mut d_dirs) = (vec![0.0f64; rays * 3], vec![0.0f64; rays * 3]);
            for r in 0..rays {
                for i in scene.packed().range(r) {
                    let mid = scene.t[i] + 0.5 * scene.dt[i];
                    let g = [0, 1, 2].map(|k: usize| d[i * 3 + k]);
                    let x = [0, 1, 2].map(|k: usize| origins[r * 3 + k] + mid * dirs[r * 3 + k] - 0.5);
                    let g = match space {
                        Space::Model => g,
                        Space::Cube(w) => g.map(|v| v / w),
                        Space::Centred(w) => g.map(|v| 2.0 * v / w),
                        Space::Contracted(w) => contraction::Space::Contracted(w).normalize_backward(x, g),
                        Space::ContractedCentred(w) => contraction::Space::Contracted(w).normalize_backward(x, g).map(|v| 2.0 * v),
                    };
                    for k in 0..3 {
                        d_origins[r * 3 + k] += g[k] as f64;
                        d_dirs[r * 3 + k] += (mid * g[k]) as f64;
                    }
                }
            }
            let (go, gd) = march::positions_backward(gpu, &on_gpu, &p, &gpu.upload(&d), space);
            let shape = format!("R={rays} {space:?}");
            table.close("positions", "d origins", &shape, &go, &d_origins)?;
            table.close("positions", "d directions", &shape, &gd, &d_dirs)?;
        }
    }
    Ok(())
}

/// Rays with 0 to 59 samples each.
struct Ragged {
    offsets: Vec<u32>,
    t: Vec<f32>,
    dt: Vec<f32>,
}

impl Ragged {
    fn new(rays: usize) -> Ragged {
        let mut offsets = vec![0u32];
        (0..rays).for_each(|r| offsets.push(offsets[r] + (r as u32 * 37) % 60));
        let s = offsets[rays] as usize;
        let t = (0..rays).flat_map(|r| (0..offsets[r + 1] - offsets[r]).map(|i| 0.1 + 0.05 * i as f32)).collect();
        let dt = random_unit(s, 1).iter().map(|u| 0.01 + 0.03 * u).collect();
        Ragged { offsets, t, dt }
    }

    fn packed(&self) -> Packed<'_> {
        Packed { offsets: &self.offsets, t: &self.t, dt: &self.dt }
    }
}

fn spaces(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    for rays in [0, 1, 80] {
        let scene = Ragged::new(rays);
        let (origins, dirs) = (random(rays * 3, 4), random(rays * 3, 5));
        let near_far = vec![0.0; rays * 2];
        let jitter = vec![0.5; rays];
        let r = MarchRays { origins: &origins, dirs: &dirs, near_far: &near_far, jitter: &jitter, resumed: false };
        let (on_gpu, p) = (GpuRays::upload(gpu, &r), GpuPacked::upload(gpu, &scene.packed()));
        let mut model = vec![0.0f32; scene.t.len() * 3];
        for r in 0..rays {
            for i in scene.packed().range(r) {
                (0..3).for_each(|k| model[i * 3 + k] = origins[r * 3 + k] + (scene.t[i] + 0.5 * scene.dt[i]) * dirs[r * 3 + k]);
            }
        }
        let cube = model.iter().map(|v| ((v - 0.5) / 4.0 + 0.5) as f64).collect::<Vec<_>>();
        let contracted: Vec<f64> = model
            .chunks_exact(3)
            .flat_map(|m| contraction::Space::Contracted(1.5).normalize([m[0], m[1], m[2]].map(|v| v - 0.5)).map(f64::from))
            .collect();
        let centred = model.iter().map(|v| (2.0 * (v - 0.5) / 4.0) as f64).collect();
        let all = [
            (Space::Model, wide(&model)),
            (Space::Cube(4.0), cube),
            (Space::Contracted(1.5), contracted.iter().map(|v| v + 0.5).collect()),
            (Space::Centred(4.0), centred),
            (Space::ContractedCentred(1.5), contracted.iter().map(|v| 2.0 * v).collect()),
        ];
        for (space, want) in all {
            let shape = format!("R={rays} {space:?}");
            table.close("positions", "forward", &shape, &march::positions(gpu, &on_gpu, &p, space), &want)?;
            table.close("positions", "points", &shape, &march::to_space(gpu, &gpu.upload(&model), space), &want)?;
        }
    }
    Ok(())
}

fn look_ups(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    for n in [0, 1, 200] {
        let (rows, width, codes, d) = (7, 5, random(35, 1), random(n * 5, 2));
        let index: Vec<u32> = (0..n as u32).map(|i| i * 3 % 7).collect();
        let index_gpu = gpu.upload(&index);
        let want: Vec<f64> = index.iter().flat_map(|i| wide(&codes[*i as usize * width..][..width])).collect();
        let shape = format!("R={n}");
        table.close("look up", "forward", &shape, &field::look_up(gpu, &gpu.upload(&codes), &index_gpu, width), &want)?;
        let mut want = vec![0.0f64; rows * width];
        d.iter().enumerate().for_each(|(e, d)| want[index[e / width] as usize * width + e % width] += *d as f64);
        let got = gpu.zeros(rows * width);
        field::look_up_backward(gpu, &gpu.upload(&d), &index_gpu, width, &got);
        table.close("look up", "d table", &shape, &got, &want)?;
    }
    Ok(())
}
