//! Trains a field with a loss of one's own: from photographs with wrong pixels, a Cauchy loss learns what squares blur.
//!
//! `cargo run --release -p diorama-pipelines --example custom_loss -- [FOLDER]`

use diorama_data::photo;
use diorama_engine::fields::{self, Batch, Field, FieldBuffers, Loss, VisibleSamples};
use diorama_engine::metrics;
use diorama_engine::renderers::volume::{Quality, Tracer, View};
use diorama_engine::samplers::RayBatch;
use diorama_engine::samplers::occupancy::Occupancy;
use diorama_engine::samplers::pixels::{self, DrawOptions, PixelSource};
use diorama_engine::samplers::placement::Placement;
use diorama_geom::contraction::Space;
use diorama_geom::rng::Rng;
use diorama_kernels::ops::composite::Packed;
use diorama_kernels::ops::field_step::{RayGradient, RayLoss, RayOutput};
use diorama_kernels::ops::hash_grid::HashGridConfig;
use diorama_kernels::ops::march::{MarchConfig, MarchRays};
use diorama_kernels::ops::ray_generation::PosedCamera;
use diorama_scenes::still_life::{self, Photo};
use std::path::PathBuf;

const STEPS: u32 = 100;
const RAYS: usize = 512;
/// Length of a step along a ray, in edges of the cube.
const STEP: f32 = 1.0 / 40.0;
const CUBE: Space = Space::Cube(1.0);
/// Share of pixels that show anything.
const WRONG: f32 = 0.3;

/// `c² / 2 log(1 + (d / c)²)` of each channel (Barron 2019, α = 0): differences far beyond `c` hardly pull. With a large `c` it is the
/// square.
struct Cauchy<'a> {
    batch: &'a RayBatch,
    c: f32,
}

impl RayLoss for Cauchy<'_> {
    fn ray(&self, r: usize, out: &RayOutput, gradient: &mut RayGradient) -> f64 {
        let (target, scale) = (&self.batch.target[4 * r..4 * r + 4], 1.0 / self.batch.len() as f32);
        let mut loss = 0.0;
        for k in 0..3 {
            // Straight alpha before black.
            let d = out.values[k] - target[k] * target[3];
            let x = (d / self.c).powi(2);
            loss += 0.5 * self.c * self.c * x.ln_1p() * scale;
            gradient.values[k] = d / (1.0 + x) * scale;
        }
        loss as f64
    }
}

/// Photographs of which some pixels are wrong.
struct Photographs(Vec<Photo>);

impl PixelSource for Photographs {
    fn images(&self) -> usize {
        self.0.len()
    }

    fn size(&self, image: usize) -> (u32, u32) {
        (self.0[image].camera.width, self.0[image].camera.height)
    }

    fn rgba(&self, image: usize, x: u32, y: u32) -> [f32; 4] {
        let rng = Rng::new(7, image as u64);
        let at = 8 * (y as u64 * 4096 + x as u64);
        if rng.uniform(at) < WRONG {
            return [rng.uniform(at + 1), rng.uniform(at + 2), rng.uniform(at + 3), 1.0];
        }
        let p = self.0[image].image.pixel(x as usize, y as usize);
        std::array::from_fn(|k| p[k] as f32 / 255.0)
    }

    fn counts(&self, _: usize, _: u32, _: u32) -> bool {
        true
    }
}

/// Trains a field from nothing: rays, samples on them, the field with the loss, one step of the optimizer.
fn train(photographs: &Photographs, cameras: &[PosedCamera], occupancy: &Occupancy, c: f32) -> Field {
    let grid = HashGridConfig { levels: 8, features: 2, log2_size: 14, base: 8, finest: 128 };
    let mut field = fields::ngp(grid, CUBE, 1e-2, 0, 0, 1);
    // Equal steps through the cube; samples that no light reaches are left out.
    let march = MarchConfig { dt_min: STEP, dt_max: STEP, ..occupancy.march_config(256) };
    let pruning = Quality::Full.pruning();
    let (mut batch, mut visible, mut buffers) = (RayBatch::default(), VisibleSamples::default(), FieldBuffers::default());
    let background = &[0.0; 3 * RAYS];
    batch.resize(RAYS);
    for step in 0..STEPS {
        let (first, rng) = (step as u64 * RAYS as u64, Rng::new(1, 1));
        let o = DrawOptions { cameras, first, rng, near: 0.0, cube: (0.0, 1.0), error_map: None, observations: &[] };
        pixels::draw(photographs, &o, &mut batch);
        let RayBatch { origins, dirs, near_far, jitter, .. } = &batch;
        let rays = MarchRays { origins, dirs, near_far, jitter, resumed: false };
        field.visible(occupancy.bits(), &rays, &march, pruning, &mut visible, &mut buffers);
        let VisibleSamples { samples, positions, encoded } = &mut visible;
        let samples = Packed { offsets: &samples.offsets, t: &samples.t, dt: &samples.dt };
        let rays = Batch { samples, positions, dirs, images: None, given: &[], background, near_scaling: 0.0 };
        field.train(&rays, encoded, Loss::Rays(&Cauchy { batch: &batch, c }), &mut buffers, None);
        field.groups_mut().into_iter().for_each(|g| g.step(step + 1, 1.0));
    }
    field
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let out = std::env::args().nth(1).map_or_else(|| std::env::temp_dir().join("diorama-custom-loss"), PathBuf::from);
    std::fs::create_dir_all(&out)?;

    let mut photos = still_life::photographs(25, 64);
    let held_out = photos.pop().ok_or("no photograph")?;
    let model_from_world = still_life::scene_box().model_from_world();
    let posed = |p: &Photo| PosedCamera { camera: p.camera, pose: model_from_world.pose(&p.world_from_camera) };
    let cameras: Vec<PosedCamera> = photos.iter().map(posed).collect();
    let photographs = Photographs(photos);

    // A grid that is occupied everywhere: nothing is known of the scene. `Occupancy::update` would learn where matter is.
    let occupancy = Occupancy::new(32, 1, false);
    for (name, c) in [("squares", 1e3), ("cauchy", 0.1)] {
        let field = train(&photographs, &cameras, &occupancy, c);
        let placement = Placement::occupied(&occupancy, 1024, Quality::Full.pruning());
        let tracer = Tracer { occupancy: Some(&occupancy), ..Tracer::new(&field, placement, (0.0, 1.0)) };
        let view: View = tracer.view(&posed(&held_out), &mut |_| {});
        let truth = held_out.image.data.chunks_exact(4).flat_map(|p| [0, 1, 2].map(|k| p[k] as f32 * p[3] as f32 / 255.0 / 255.0));
        let mse = view.rgb.data.iter().zip(truth).map(|(a, b)| (a - b).powi(2) as f64).sum::<f64>() / view.rgb.data.len() as f64;
        let file = out.join(format!("{name}.png"));
        photo::save_png(&file, &view.rgb.to_u8())?;
        println!("{name}: {:.1} dB on a view without wrong pixels, wrote {}", metrics::psnr(mse), file.display());
    }
    Ok(())
}
