//! The parts of a training step on a device against what the CPU does.

use super::GpuTracer;
use crate::fields::{self, DensityQuery, FieldBuffers};
use crate::losses::{ColorLoss, Photometric};
use crate::renderers::supervised::Supervised;
use crate::renderers::volume::{self, Accelerator, Quality, Sampling, Tracer};
use crate::samplers::RayBatch;
use crate::samplers::occupancy::Occupancy;
use crate::samplers::pixels::{self, DrawOptions, ErrorMap, Observation, PixelSource};
use crate::samplers::stratified;
use diorama_geom::contraction;
use diorama_geom::glam::DVec3;
use diorama_geom::rng::Rng;
use diorama_geom::{Camera, PixelFormat, Pose};
use diorama_kernels::gpu::check::{Row, Table};
use diorama_kernels::gpu::{Gpu, GpuError, Rows};
use diorama_kernels::ops::composite::gpu::{GpuComposited, GpuPacked};
use diorama_kernels::ops::composite::{Composited, Packed, cpu as composite, reference};
use diorama_kernels::ops::distortion;
use diorama_kernels::ops::field_step::gpu as field;
use diorama_kernels::ops::field_step::gpu::loss::{self, Figures, SUMS, Target, Terms};
use diorama_kernels::ops::field_step::{RayGradient, RayLoss, RayOutput};
use diorama_kernels::ops::hash_grid::HashGridConfig;
use diorama_kernels::ops::march::gpu::occupancy::GpuOccupancyGrid;
use diorama_kernels::ops::march::gpu::prune::{self, Limits};
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
    for case in [draws, strata_cases, corrections, spaces, prunings, grids, losses, look_ups, views, other_views] {
        case(gpu, &mut table)?;
    }
    Ok(table.rows)
}

/// Two photographs of unlike size, of which one of so many by so many pixels was kept; the left half of the second may
/// not be trained on.
struct Two {
    stride: u32,
    format: PixelFormat,
}

impl Two {
    fn kept_by(image: usize) -> Rng {
        Rng::new(image as u64, 77)
    }

    /// What was kept, square by square.
    fn kept(&self) -> Vec<(usize, u32, u32)> {
        let s = self.stride;
        let squares = |i: usize| {
            let (w, h) = self.size(i);
            (0..h.div_ceil(s)).flat_map(move |y| (0..w.div_ceil(s)).map(move |x| (i, x * s, y * s)))
        };
        (0..2).flat_map(squares).map(|(i, x, y)| (i, self.snap(i, x, y))).map(|(i, (x, y))| (i, x, y)).collect()
    }
}

impl Two {
    /// A pixel as it is stored; half floats of it reach up to 3.
    fn words(&self, image: usize, x: u32, y: u32) -> [u32; 2] {
        let v = [x * 7, y * 30, image as u32, 200 + x];
        match self.format {
            PixelFormat::Unorm8 => [u32::from_le_bytes(v.map(|v| v as u8)), 0],
            PixelFormat::Unorm16 => [((v[1] * 257) << 16) | (v[0] * 257), ((v[3] * 257) << 16) | (v[2] * 257)],
            PixelFormat::Half => [(0x3000 + v[1] * 21) << 16 | (0x3000 + v[0] * 21), 0x3c00 << 16 | (0x3000 + v[2])],
        }
    }
}

impl PixelSource for Two {
    fn images(&self) -> usize {
        2
    }
    fn size(&self, image: usize) -> (u32, u32) {
        [(8, 4), (33, 7)][image]
    }
    fn snap(&self, image: usize, x: u32, y: u32) -> (u32, u32) {
        let (s, (w, h)) = (self.stride, self.size(image));
        let (x0, y0) = (x / s * s, y / s * s);
        let random = Two::kept_by(image).bits((y0 as u64) << 32 | x0 as u64);
        (x0 + random as u32 % s.min(w - x0), y0 + (random >> 32) as u32 % s.min(h - y0))
    }
    fn rgba(&self, image: usize, x: u32, y: u32) -> [f32; 4] {
        pixel_gather::cpu::convert(self.format, self.words(image, x, y))
    }
    fn counts(&self, image: usize, x: u32, _: u32) -> bool {
        image == 0 || x > 16
    }
}

fn draws(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    // Errors whose roots add up exactly, so that the same cells are drawn.
    let mut errors = ErrorMap::new(2);
    errors.errors.iter_mut().enumerate().for_each(|(i, e)| *e = [0.0625, 0.0, 1.0, 0.25][i * 7 % 4]);
    errors.refresh();
    use PixelFormat::{Half, Unorm8, Unorm16};
    // Some of them masked, in the second photograph; and none.
    let seen: Vec<Observation> = (0..30)
        .map(|i| Observation { image: i % 2, x: i * 3 % [8, 33][i as usize % 2], y: i % [4, 7][i as usize % 2], distance: 0.5 + i as f32 })
        .collect();
    for (stride, map, format, observed) in
        [(1, None, Unorm8, 0), (3, None, Unorm8, 30), (1, Some(&errors), Unorm8, 30), (3, None, Unorm16, 0), (1, None, Half, 1)]
    {
        let observations = &seen[..observed];
        let two = Two { stride, format };
        let (sizes, kept) = ([two.size(0), two.size(1)], two.kept());
        let own = pixel_gather::words_per_pixel(format);
        let words: Vec<u32> = kept.iter().flat_map(|(i, x, y)| two.words(*i, *x, *y).into_iter().take(own)).collect();
        let mut mask = vec![0u32; kept.len().div_ceil(32)];
        kept.iter().enumerate().for_each(|(at, (i, x, y))| mask[at / 32] |= (two.counts(*i, *x, *y) as u32) << (at % 32));
        let mut photographs = GpuPhotographs::upload(gpu, &sizes, stride, &[0, 1].map(Two::kept_by), (format, &words), Some(&mask));
        photographs.observe(gpu, &observations.iter().map(|o| (o.image, o.x, o.y, o.distance)).collect::<Vec<_>>());
        let camera = PosedCamera { camera: Camera::pinhole(8, 4, 1.0), pose: Pose::look_at(DVec3::X, DVec3::ZERO, DVec3::Z) };
        let on_gpu = map.map(|m| GpuErrorMap::upload(gpu, &m.errors, &m.drawn));
        let (rng, back) = (Rng::new(3, 1), Rng::new(3, 2));
        // Counters beyond 32 bits, too.
        for (n, first) in [(0, 0), (1, 5), (700, (1 << 33) + 12_345)] {
            let mut batch = RayBatch::default();
            batch.resize(n);
            let o = DrawOptions { cameras: &[camera; 2], first, rng, near: 0.1, cube: (0.0, 1.0), error_map: map, observations };
            pixels::draw(&two, &o, &mut batch);
            let drawn = photographs.draw(gpu, n, first, &rng, on_gpu.as_ref(), Backdrop::Random(back));
            let (shape, exact) = (
                format!("R={n} from {first} 1 of {stride}² {format:?}{} observed={observed}", if map.is_some() { " by error" } else { "" }),
                |v: &[f32]| v.iter().map(|v| v.to_bits()).collect::<Vec<_>>(),
            );
            table.equal("draw", "images", &shape, &drawn.images, &batch.images)?;
            table.equal("draw", "pixels", &shape, &drawn.pixels, &exact(&batch.pixels))?;
            table.equal("draw", "jitter", &shape, &drawn.jitter, &exact(&batch.jitter))?;
            let refused: Vec<u32> = batch.counts.iter().map(|c| !c as u32).collect();
            table.equal("draw", "left out", &shape, &drawn.left_out, &refused)?;
            table.equal("draw", "distance", &shape, &drawn.distance, &exact(&batch.distance))?;
            let background: Vec<f32> = (0..n * 3).map(|i| back.uniform(first * 3 + i as u64)).collect();
            table.equal("draw", "background", &shape, &drawn.background, &exact(&background))?;
            let mut got = gpu.read(&drawn.target)?;
            got.chunks_exact_mut(4).zip(&refused).filter(|(_, r)| **r == 1).for_each(|(t, _)| t.fill(0.0));
            batch.target.chunks_exact_mut(4).zip(&refused).filter(|(_, r)| **r == 1).for_each(|(t, _)| t.fill(0.0));
            table.close("draw", "target", &shape, &gpu.upload(&got), &wide(&batch.target))?;
            let color = photographs.draw(gpu, n, first, &rng, on_gpu.as_ref(), Backdrop::Color([0.25, 0.5, 0.75])).background;
            table.close("draw", "one background", &shape, &color, &wide(&[0.25, 0.5, 0.75].repeat(n)))?;

            let Some(errors_gpu) = &on_gpu else { continue };
            let (before, seen) = (errors_gpu.read(gpu)?.0, random_unit(n, 4));
            let mut of_cell = vec![Vec::new(); before.len()];
            for r in (0..n).filter(|r| refused[*r] == 0) {
                let (image, (w, h)) = (batch.images[r] as usize, two.size(batch.images[r] as usize));
                let cell = |at: f32, of: u32| ((at / of as f32 * CELLS as f32) as usize).min(CELLS - 1);
                of_cell[(image * CELLS + cell(batch.pixels[r * 2 + 1], h)) * CELLS + cell(batch.pixels[r * 2], w)].push(seen[r] as f64);
            }
            let mixed = before.iter().zip(&of_cell).map(|(e, seen)| {
                let kept = 0.9f64.powi(seen.len() as i32);
                kept * *e as f64 + (1.0 - kept) * seen.iter().sum::<f64>() / seen.len().max(1) as f64
            });
            errors_gpu.record(gpu, &photographs, &drawn, &gpu.upload(&seen));
            table.close("error map", "errors", &shape, &gpu.upload(&errors_gpu.read(gpu)?.0), &mixed.collect::<Vec<_>>())?;
            // The next draws go by the errors of the start again.
            let sums = errors.drawn.iter().scan(0.0, |sum, e| {
                *sum += (*e as f64).sqrt();
                Some(*sum)
            });
            table.close("error map", "sums", &shape, errors_gpu.cdf(), &sums.collect::<Vec<_>>())?;
        }
    }
    Ok(())
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
    let (o, d) = cameras.forward(gpu, &gpu.upload_u32(&index), &gpu.upload(&at));
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
    sigma: Vec<f32>,
}

impl Ragged {
    fn new(rays: usize) -> Ragged {
        let mut offsets = vec![0u32];
        (0..rays).for_each(|r| offsets.push(offsets[r] + (r as u32 * 37) % 60));
        let s = offsets[rays] as usize;
        let t = (0..rays).flat_map(|r| (0..offsets[r + 1] - offsets[r]).map(|i| 0.1 + 0.05 * i as f32)).collect();
        let dt = random_unit(s, 1).iter().map(|u| 0.01 + 0.03 * u).collect();
        let sigma = random_unit(s, 2).iter().map(|u| if *u < 0.3 { 0.05 * u } else { 40.0 * u * u }).collect();
        Ragged { offsets, t, dt, sigma }
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

fn prunings(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    let limits = Limits { stop: 1e-3, min_alpha: 3e-3, thin: 0.7, min_weight: 2e-3 };
    for rays in [0, 1, 130] {
        let scene = Ragged::new(rays);
        let (mut sigma, mut kept, mut offsets) = (scene.sigma.clone(), Vec::new(), vec![0u32]);
        let mut lights = Vec::new();
        for r in 0..rays {
            let mut light = 1.0f64;
            for i in scene.packed().range(r) {
                if light < limits.stop as f64 {
                    sigma[i] = -1.0;
                    continue;
                }
                let alpha = 1.0 - (-(sigma[i] as f64) * scene.dt[i] as f64).exp();
                let weight = light * alpha;
                light -= weight;
                if weight >= limits.min_weight as f64 && alpha >= limits.min_alpha.min(limits.thin * scene.dt[i]) as f64 {
                    kept.push(i);
                }
            }
            offsets.push(kept.len() as u32);
            lights.push(light);
        }
        let (p, rows) = (GpuPacked::upload(gpu, &scene.packed()), random(scene.t.len() * 5, 6));
        for capacity in [kept.len() + 10, kept.len() / 2] {
            let shape = format!("R={rays} room {capacity}");
            let (sigma_gpu, cut) = (gpu.upload(&scene.sigma), gpu.zeros(rays));
            let pruned = prune::prune(gpu, &p, &sigma_gpu, limits, &cut, capacity);
            let bounded: Vec<u32> = offsets.iter().map(|o| (*o).min(capacity as u32)).collect();
            let lost: Vec<u32> = offsets[1..].iter().map(|o| (*o > capacity as u32) as u32).collect();
            table.close("prune", "densities", &shape, &sigma_gpu, &wide(&sigma))?;
            table.close("prune", "light", &shape, &pruned.light, &lights)?;
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

fn grids(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    let rng = Rng::new(5, 6);
    for (cascades, unbounded) in [(1, false), (3, false), (3, true)] {
        let mut grid = Occupancy::new(16, cascades, unbounded);
        // A corner that no camera sees.
        grid.density[..40].fill(-1.0);
        grid.refresh();
        let g = &grid;
        let thresholds: Vec<f32> = (0..cascades).map(|c| g.most(c)).collect();
        let on_gpu = GpuOccupancyGrid::upload(gpu, &g.bits, &g.density, &g.fresh, &g.live, g.decay, &thresholds);
        for (step, block) in [(0u64, 2), (16, 2), (1 << 30, 1)] {
            let shape = format!("cascades={cascades} unbounded={unbounded} step {step} block {block}");
            let (points, cells) = grid.probe(&rng, step, 3000, block);
            let (points_gpu, cells_gpu) = on_gpu.probe(gpu, &rng, step, 3000, block, Space::Model);
            table.close("occupancy", "points", &shape, &points_gpu, &wide(&points))?;
            table.equal("occupancy", "cells", &shape, &cells_gpu, &cells)?;
            let sigma: Vec<f32> = random_unit(3000, step + 1).iter().map(|u| u * u * 20.0).collect();
            let met: Vec<u32> = cells.iter().rev().copied().collect();
            let met_sigma: Vec<f32> = random(3000, step + 2).iter().map(|s| s * 9.0).collect();
            grid.record(&met, &met_sigma);
            on_gpu.record(gpu, &Rows::all(gpu, 3000), &gpu.upload_u32(&met), &gpu.upload(&met_sigma));
            grid.fold(&cells, &sigma, block);
            on_gpu.update(gpu, &cells_gpu, &gpu.upload(&sigma), block);
            let (density, _) = on_gpu.read(gpu)?;
            // The greatest number stands for "not sampled yet" and would swamp all errors.
            let known = |v: &[f32]| v.iter().map(|d| if *d == f32::MAX { -2.0 } else { *d }).collect::<Vec<f32>>();
            table.close("occupancy", "densities", &shape, &gpu.upload(&known(&density)), &wide(&known(&grid.density)))?;
            let wrong = on_gpu.bits.differences(gpu, &grid.bits)?;
            let outcome = if wrong == 0 { Ok(0.0) } else { Err(format!("{wrong} words differ")) };
            table.row("occupancy", "bits", shape, outcome);
        }
    }
    Ok(())
}

fn losses(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    let near = 1.0f32;
    for rays in [1, 130] {
        let scene = Ragged::new(rays);
        let (p, s) = (scene.packed(), scene.t.len());
        let mut batch = RayBatch::default();
        batch.resize(rays);
        batch.target = random_unit(rays * 4, 7);
        batch.counts.iter_mut().skip(2).step_by(9).for_each(|c| *c = false);
        // Every third ray's surface is known.
        batch.distance.iter_mut().step_by(3).zip(random_unit(rays, 10)).for_each(|(d, u)| *d = 0.1 + 3.0 * u);
        let (rgb, background) = (random_unit(s * 3, 8), random_unit(rays * 3, 9));
        let out = composite::forward(&p, &scene.sigma, &rgb, 3, &background);
        let (mut starts, mut lengths) = (Vec::new(), Vec::new());
        distortion::cpu::normalize(&p, &mut starts, &mut lengths);
        let in_distance = Packed { t: &starts, dt: &lengths, ..p };
        let wide_huber = ColorLoss::Huber(0.1);
        for (color, huber, relative, normalized, depth) in
            [(ColorLoss::Mse, 0.0, 0.0, true, 0.4), (wide_huber, 0.1, 0.0, false, 0.0), (wide_huber, 0.1, 0.05, false, 0.4)]
        {
            let (distortion, alpha) = (0.3, 0.2);
            let spread = if normalized { in_distance } else { p };
            let photometric = Photometric {
                batch: &batch,
                samples: spread,
                background: &background,
                color,
                relative,
                distortion,
                alpha,
                depth,
                along: p,
            };
            let (mut value, mut error, mut counted) = (0.0f64, 0.0f64, 0usize);
            let mut of_rays = vec![0.0f64; rays];
            let (mut d_color, mut d_opacity, mut d_weights) = (vec![0.0; rays * 3], vec![0.0; rays], vec![0.0; s]);
            for r in 0..rays {
                let rgb = [0, 1, 2].map(|k: usize| out.color[r * 3 + k]);
                let o = RayOutput {
                    values: &rgb,
                    opacity: out.opacity[r],
                    depth: out.depth[r],
                    weights: &out.weights[p.range(r)],
                    first: p.range(r).start,
                };
                let values = &mut d_color[r * 3..r * 3 + 3];
                let mut g = RayGradient { values, opacity: 0.0, depth: 0.0, weights: &mut d_weights[p.range(r)] };
                value += photometric.ray(r, &o, &mut g);
                d_opacity[r] = g.opacity;
                let target = photometric.target(r);
                if batch.counts[r] {
                    of_rays[r] = photometric.squared_error(rgb, target) as f64;
                    error += of_rays[r];
                    counted += 1;
                }
            }
            let up = |v: &[f32]| gpu.upload(v);
            let on_gpu = GpuPacked::upload(gpu, &p);
            let results =
                GpuComposited { color: up(&out.color), depth: up(&out.depth), opacity: up(&out.opacity), weights: up(&out.weights) };
            let left_out: Vec<u32> = batch.counts.iter().map(|c| !c as u32).collect();
            let (rgba, background, left_out, sums) = (up(&batch.target), up(&background), gpu.upload_u32(&left_out), gpu.zeros(SUMS));
            let distance = up(&batch.distance);
            let target = Target { rgba: &rgba, background: &background, left_out: &left_out, distance: &distance };
            let figures = Figures { sums: &sums, marched: &on_gpu.offsets, is_main: true };
            let (d, errors) =
                loss::loss(gpu, Terms { huber, relative, distortion, normalized, alpha, depth }, &on_gpu, &results, target, figures);
            let shape = format!("R={rays} S={s} {color:?} relative {relative} normalized={normalized} depth={depth}");
            table.close("loss", "errors", &shape, &errors, &of_rays)?;
            table.close("loss", "d color", &shape, &d.color, &wide(&d_color))?;
            table.close("loss", "d opacity", &shape, &d.opacity, &wide(&d_opacity))?;
            table.close("loss", "d weights", &shape, &d.weights, &wide(&d_weights))?;
            let sums = gpu.read(&sums)?;
            let want = [value, error / counted as f64];
            table.close("loss", "sums", &shape, &up(&sums[..2]), &want)?;
            table.close("loss", "counts", &shape, &up(&sums[2..]), &[s as f64, s as f64, 1.0])?;

            // All of it at once.
            for reach in [0.0, near] {
                let terms = Terms { huber, relative, distortion, normalized, alpha, depth };
                let (sigma_gpu, rgb_gpu, sums) = (up(&scene.sigma), up(&rgb), gpu.zeros(SUMS));
                let figures = Figures { sums: &sums, marched: &on_gpu.offsets, is_main: true };
                let (g, own_errors) = loss::composite_and_loss(gpu, terms, &on_gpu, &sigma_gpu, &rgb_gpu, target, reach, figures);
                table.close("composite + loss", "errors", &shape, &own_errors, &wide(&gpu.read(&errors)?))?;
                let d = Composited { color: wide(&d_color), depth: vec![0.0; rays], opacity: wide(&d_opacity), weights: wide(&d_weights) };
                let (sigma, background) = (wide(&scene.sigma), wide(&gpu.read(&background)?));
                let (ds, dc, db) = reference::backward(&p, &sigma, &wide(&rgb), 3, &background, &d);
                let kept = |i: usize| if reach > 0.0 { ((scene.t[i] + 0.5 * scene.dt[i]) / reach).min(1.0).powi(2) as f64 } else { 1.0 };
                let shape = format!("{shape} near scaling {reach}");
                table.close("composite + loss", "d sigma", &shape, &g.sigma, &(0..s).map(|i| ds[i] * kept(i)).collect::<Vec<_>>())?;
                table.close(
                    "composite + loss",
                    "d rgb",
                    &shape,
                    &g.features,
                    &(0..s * 3).map(|i| dc[i] * kept(i / 3)).collect::<Vec<_>>(),
                )?;
                table.close("composite + loss", "d background", &shape, &g.background, &db)?;
                let sums = gpu.read(&sums)?;
                table.close("composite + loss", "sums", &shape, &up(&sums[..2]), &[value, error / counted as f64])?;
                table.close("composite + loss", "counts", &shape, &up(&sums[2..]), &[s as f64, s as f64, 1.0])?;
            }
        }
        // Gradients close to the camera.
        let (d_sigma, d_rgb) = (random(s, 3), random(s * 3, 4));
        let (got_sigma, got_rgb) = (gpu.upload(&d_sigma), gpu.upload(&d_rgb));
        field::soften(gpu, &GpuPacked::upload(gpu, &p), &got_sigma, &got_rgb, near);
        let scale = |i: usize| ((scene.t[i] + 0.5 * scene.dt[i]) / near).min(1.0).powi(2) as f64;
        let shape = format!("S={s}");
        let want: Vec<f64> = (0..s).map(|i| d_sigma[i] as f64 * scale(i)).collect();
        table.close("near scaling", "d sigma", &shape, &got_sigma, &want)?;
        let want: Vec<f64> = (0..s * 3).map(|i| d_rgb[i] as f64 * scale(i / 3)).collect();
        table.close("near scaling", "d rgb", &shape, &got_rgb, &want)?;
    }
    Ok(())
}

/// A view that the device itself has drawn.
///
/// # Errors
/// When it failed, or did not draw at all: what the CPU draws in its place proves nothing.
fn drawn<T>(name: &str, device: Box<dyn Accelerator>, draw: impl FnOnce(&dyn Accelerator) -> T) -> Result<T, GpuError> {
    let device = Supervised::new(device, name, true, Box::new(|_| {}));
    let view = draw(&device);
    match device.fatal() {
        Some(why) => Err(GpuError::Lost(name.into(), why)),
        None if device.served() == 0 => Err(GpuError::Lost(name.into(), "it drew nothing of a view".into())),
        None => Ok(view),
    }
}

/// Views by the device and by the CPU, with room for all samples of a batch and with so little that it is split.
fn views(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    let grid = HashGridConfig { levels: 3, features: 2, log2_size: 10, base: 4, finest: 16 };
    let camera =
        PosedCamera { camera: Camera::pinhole(12, 10, 0.6), pose: Pose::look_at(DVec3::new(1.9, 1.2, 1.0), DVec3::splat(0.5), DVec3::Z) };
    for (images, space) in [(0, contraction::Space::Cube(1.0)), (3, contraction::Space::Contracted(1.0))] {
        let mut f = fields::ngp(grid, space, 1e-2, images, if images > 0 { 4 } else { 0 }, 1);
        f.net.density.shift = 1.2;
        f.encoder.table_mut().into_iter().for_each(|t| t.values.iter_mut().for_each(|v| *v *= 2e4));
        let occupancy = Occupancy::new(16, 1, false);
        for (quality, room) in [(Quality::Full, 1 << 17), (Quality::Full, 4096), (Quality::Fast, 1 << 17)] {
            let on_cpu = Tracer {
                field: &f,
                sampling: Sampling::Occupancy { grid: &occupancy, max_samples: 4096 },
                backdrop: volume::Backdrop::Color([0.2, 0.5, 0.9]),
                near: 0.1,
                cube: (0.0, 1.0),
                clip: None,
                crop: None,
                is_linear: false,
                pruning: quality.pruning(),
                shared_weight: 0.0,
                appearance: None,
                tolerance: 0.0,
                accelerator: None,
            };
            let device = GpuTracer::new(gpu.clone(), &f, None, Some(&occupancy)).with_room(room);
            let want = on_cpu.view(&camera, &mut |_| {});
            let got = drawn(&gpu.name, Box::new(device), |by| Tracer { accelerator: Some(by), ..on_cpu }.view(&camera, &mut |_| {}))?;
            let shape = format!("{quality:?} room {room} images={images}");
            table.close("view", "color", &shape, &gpu.upload(&got.rgb.data), &wide(&want.rgb.data))?;
            table.close("view", "opacity", &shape, &gpu.upload(&got.opacity.data), &wide(&want.opacity.data))?;
            table.close("view", "depth", &shape, &gpu.upload(&got.depth.data), &wide(&want.depth.data))?;
        }
    }
    Ok(())
}

/// Views, densities and colours of fields without a grid.
fn other_views(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    let camera =
        PosedCamera { camera: Camera::pinhole(6, 5, 0.6), pose: Pose::look_at(DVec3::new(1.9, 1.2, 1.0), DVec3::splat(0.5), DVec3::Z) };
    let (fine, coarse) =
        (fields::nerf(contraction::Space::Cube(1.0), 1e-3, 2, 4, 1, 1), fields::nerf(contraction::Space::Cube(1.0), 1e-3, 2, 4, 1, 0));
    let plain = fields::baseline(contraction::Space::Cube(2.0), 1e-3, 3);
    for (name, field, guide) in [("nerf", &fine, Some(&coarse)), ("baseline", &plain, None)] {
        let sampling = match guide {
            Some(coarse) => Sampling::Hierarchical { coarse, samples: 8, more: 8 },
            None => Sampling::Stratified { samples: 16 },
        };
        let on_cpu = Tracer {
            field,
            sampling,
            backdrop: volume::Backdrop::Color([0.2, 0.5, 0.9]),
            near: 0.1,
            cube: (0.0, 1.0),
            clip: None,
            crop: None,
            is_linear: false,
            pruning: Quality::Full.pruning(),
            shared_weight: 0.0,
            appearance: None,
            tolerance: 0.0,
            accelerator: None,
        };
        // Room for all rays at once, and for some.
        for room in [1 << 10, 100] {
            let tracer = || GpuTracer::new(gpu.clone(), field, guide, None).with_room(room);
            let device = tracer();
            let want = on_cpu.view(&camera, &mut |_| {});
            let got = drawn(&gpu.name, Box::new(tracer()), |by| Tracer { accelerator: Some(by), ..on_cpu }.view(&camera, &mut |_| {}))?;
            let shape = format!("{name} room {room}");
            table.close("view", "color", &shape, &gpu.upload(&got.rgb.data), &wide(&want.rgb.data))?;
            table.close("view", "opacity", &shape, &gpu.upload(&got.opacity.data), &wide(&want.opacity.data))?;
            table.close("view", "depth", &shape, &gpu.upload(&got.depth.data), &wide(&want.depth.data))?;
            let (points, mut sigma) = (random_unit(450, 1), vec![0.0; 150]);
            field.density(&points, &mut sigma);
            table.close("view", "densities", &shape, &gpu.upload(&device.density(&points)?), &wide(&sigma))?;
            let dirs: Vec<f32> = points.chunks_exact(3).flat_map(unit).collect();
            let mut buf = FieldBuffers::default();
            let colors = wide(field.outputs_at(&points, &dirs, &mut buf));
            table.close("view", "own colors", &shape, &gpu.upload(&device.color(&points, &dirs)?), &colors)?;
        }
    }
    Ok(())
}

fn unit(v: &[f32]) -> [f32; 3] {
    let length = (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt().max(1e-6);
    [v[0] / length, v[1] / length, v[2] / length]
}

fn look_ups(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    for n in [0, 1, 200] {
        let (rows, width, codes, d) = (7, 5, random(35, 1), random(n * 5, 2));
        let index: Vec<u32> = (0..n as u32).map(|i| i * 3 % 7).collect();
        let index_gpu = gpu.upload_u32(&index);
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fields::Pruning;
    use crate::renderers::supervised::Unserved;
    use crate::renderers::volume::{Placement, Traced};

    /// Evaluates densities where it works.
    struct Device {
        works: bool,
    }

    impl Accelerator for Device {
        fn trace(&self, _: &RayBatch, _: &Placement, _: Pruning, _: Option<u32>) -> Result<(Traced, Option<Vec<f32>>), Unserved> {
            Err(Unserved::Failed("unplugged".into()))
        }
        fn density(&self, model: &[f32]) -> Result<Vec<f32>, Unserved> {
            if self.works { Ok(vec![1.0; model.len() / 3]) } else { Err(Unserved::Failed("unplugged".into())) }
        }
        fn color(&self, _: &[f32], _: &[f32]) -> Result<Vec<f32>, Unserved> {
            Err(Unserved::Failed("unplugged".into()))
        }
        fn rays(&self) -> usize {
            1
        }
    }

    #[test]
    fn what_a_device_did_not_draw_counts_as_lost() {
        let by = |works: bool, asked: bool| {
            let on_cpu = vec![2.0];
            drawn("fake", Box::new(Device { works }), |by| if asked { by.density(&[0.0; 3]).unwrap_or(on_cpu) } else { on_cpu })
        };
        assert_eq!(by(true, true).unwrap(), [1.0]);
        // The CPU's result is there both times.
        for (works, asked, why) in [(true, false, "it drew nothing of a view"), (false, true, "unplugged")] {
            let Err(GpuError::Lost(name, text)) = by(works, asked) else { panic!("works {works}, asked {asked}: it counts") };
            assert_eq!((&name[..], &text[..]), ("fake", why));
        }
    }
}
