//! Builds a field by hand whose color reads a vector per ray, the direction of the sun, and moves the sun of a view.
//!
//! `cargo run --release -p diorama-pipelines --example custom_ray_code -- [FOLDER]`

use diorama_data::photo;
use diorama_engine::fields::{Batch, DirectionCode, Encoded, Encoder, Field, FieldBuffers, Loss, RayCodes};
use diorama_engine::params::ParamGroup;
use diorama_engine::samplers::{RayBatch, pixels};
use diorama_geom::contraction::Space;
use diorama_geom::glam::DVec3;
use diorama_geom::rng::Rng;
use diorama_geom::{Camera, Image};
use diorama_kernels::ops::adam::Adam;
use diorama_kernels::ops::composite::Packed;
use diorama_kernels::ops::field_step::{FieldNet, RayGradient, RayLoss, RayOutput};
use diorama_kernels::ops::fused_mlp::{Head, Layer, Mlp, Source};
use diorama_kernels::ops::hash_grid::{HashGrid, HashGridConfig};
use diorama_kernels::ops::linear::Activation;
use diorama_kernels::ops::march::{self, MarchRays, Marched};
use diorama_kernels::ops::ray_generation::PosedCamera;
use diorama_kernels::ops::strata::cpu as strata;
use diorama_scenes::still_life;
use std::path::PathBuf;

const STEPS: u32 = 300;
const RAYS: usize = 512;
const SAMPLES: usize = 40;
/// Edge of the pictures in pixels.
const EDGE: usize = 64;
/// Photographs under each sun.
const VIEWS: usize = 12;
/// Suns that are trained on; one between them is not.
const SUNS: usize = 6;

/// The sun at an hour, as a unit vector to it: it turns about the vertical axis.
fn sun(hour: f64) -> DVec3 {
    let angle = hour / SUNS as f64 * std::f64::consts::TAU;
    DVec3::new(angle.cos(), angle.sin(), 0.8).normalize()
}

/// The still life before black, from view `i` under the sun of an hour.
fn picture(camera: &Camera, i: usize, hour: f64) -> Vec<f32> {
    let mut scene = still_life::scene();
    (scene.sun, scene.ambient) = (sun(hour), 0.2);
    let rgba = scene.render(camera, &still_life::pose(i, VIEWS), 2).data;
    rgba.chunks_exact(4).flat_map(|p| [0, 1, 2].map(|k| p[k] as f32 * p[3] as f32 / (255.0 * 255.0))).collect()
}

/// Hash grid -> 64 -> 16, whose first channel is the density; these 16 and the sun -> 64 -> color.
fn field() -> Field {
    use Source::{Input, Layer as L};
    let grid = HashGrid::new(HashGridConfig { levels: 8, features: 2, log2_size: 14, base: 8, finest: 128 });
    // Input 0 is the encoded position, the others are the codes of rays in their order.
    let codes = RayCodes { given: vec![3], ..RayCodes::new(DirectionCode::None, None) };
    let mlp = Mlp::new(
        vec![grid.output_dims(), 3],
        vec![
            Layer::new(vec![Input(0)], 64, Activation::Relu, true),
            Layer::new(vec![L(0)], 16, Activation::None, true),
            Layer::new(vec![L(1), Input(1)], 64, Activation::Relu, true),
            Layer::new(vec![L(2)], 16, Activation::None, true),
        ],
    );
    let head = |layer, activation| Head { layer, channel: 0, activation, shift: 0.0 };
    let net = FieldNet::of_color(mlp, head(1, Activation::TruncatedExp), head(3, Activation::Sigmoid));
    let (adam, rng) = (Adam { rate: 1e-2, ..Adam::default() }, Rng::new(1, 2));
    let table = (0..grid.params_len() as u64).map(|i| 1e-4 * (2.0 * rng.uniform(i) - 1.0)).collect();
    let weights = ParamGroup::dense("weights", net.mlp.init(&Rng::new(1, 1)), adam);
    let encoder = Encoder::Hash { grid, table: ParamGroup::sparse("table", table, adam) };
    Field { encoder, codes, net, space: Space::Cube(1.0), weights, normals: None, waves: None }
}

/// Squared difference to colors.
struct Squares<'a>(&'a [f32]);

impl RayLoss for Squares<'_> {
    fn ray(&self, r: usize, out: &RayOutput, gradient: &mut RayGradient) -> f64 {
        let scale = 3.0 / self.0.len() as f32;
        let d = [0, 1, 2].map(|k| out.values[k] - self.0[3 * r + k]);
        gradient.values.copy_from_slice(&d.map(|d| 2.0 * d * scale));
        (d.iter().map(|d| d * d).sum::<f32>() * scale) as f64
    }
}

/// Colors of rays under their suns `[R, 3]`; trains on them where there are targets.
fn evaluate(field: &mut Field, batch: &RayBatch, noise: Option<(Rng, u64)>, suns: &[f32], targets: Option<&[f32]>) -> Vec<f32> {
    let (mut samples, mut positions, mut encoded) = (Marched::default(), Vec::new(), Encoded::default());
    strata::stratified(&batch.near_far, SAMPLES, noise, &mut samples);
    let RayBatch { origins, dirs, near_far, jitter, .. } = batch;
    march::cpu::positions(&MarchRays { origins, dirs, near_far, jitter, resumed: false }, &samples, &mut positions);
    field.encode(&positions, &mut encoded);
    let (given, background) = (&[suns], &vec![0.0; suns.len()]);
    let samples = Packed { offsets: &samples.offsets, t: &samples.t, dt: &samples.dt };
    let rays = Batch { samples, positions: &positions, dirs, images: None, given, background, near_scaling: 0.0 };
    let mut buffers = FieldBuffers::default();
    match targets {
        Some(targets) => field.train(&rays, &mut encoded, Loss::Rays(&Squares(targets)), &mut buffers, None),
        None => field.render(&rays, &mut encoded, &mut buffers),
    }
    buffers.out.values
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let out = std::env::args().nth(1).map_or_else(|| std::env::temp_dir().join("diorama-custom-ray-code"), PathBuf::from);
    std::fs::create_dir_all(&out)?;

    let center = |i: usize| [(i % EDGE) as f32 + 0.5, (i / EDGE) as f32 + 0.5];
    let camera = Camera::pinhole(EDGE as u32, EDGE as u32, still_life::FOV);
    let to_model = still_life::scene_box().model_from_world();
    let cameras: Vec<_> = (0..VIEWS).map(|i| PosedCamera { camera, pose: to_model.pose(&still_life::pose(i, VIEWS)) }).collect();
    let photographs: Vec<Vec<f32>> = (0..SUNS * VIEWS).map(|n| picture(&camera, n % VIEWS, (n / VIEWS) as f64)).collect();

    let (mut field, rng) = (field(), Rng::new(1, 3));
    let (mut batch, mut suns, mut targets) = (RayBatch::default(), vec![0.0; 3 * RAYS], vec![0.0; 3 * RAYS]);
    batch.resize(RAYS);
    for step in 0..STEPS {
        let first = step as u64 * RAYS as u64;
        for r in 0..RAYS {
            let at = 2 * (first + r as u64);
            let (n, pixel) = (rng.below(at, photographs.len() as u64) as usize, rng.below(at + 1, (EDGE * EDGE) as u64) as usize);
            batch.images[r] = (n % VIEWS) as u32;
            batch.pixels[2 * r..][..2].copy_from_slice(&center(pixel));
            suns[3 * r..][..3].copy_from_slice(&sun((n / VIEWS) as f64).as_vec3().to_array());
            targets[3 * r..][..3].copy_from_slice(&photographs[n][3 * pixel..][..3]);
        }
        pixels::rays(&cameras, 0.0, (0.0, 1.0), &mut batch);
        evaluate(&mut field, &batch, Some((Rng::new(1, 4), first)), &suns, Some(&targets));
        field.groups_mut().into_iter().for_each(|g| g.step(step + 1, 1.0));
    }

    // The first view under suns half way between those that were photographed.
    let n = EDGE * EDGE;
    batch.resize(n);
    batch.images.fill(0);
    batch.pixels = (0..n).flat_map(center).collect();
    pixels::rays(&cameras, 0.0, (0.0, 1.0), &mut batch);
    for k in 0..3 {
        let hour = 2.0 * k as f64 + 0.5;
        let rgb = evaluate(&mut field, &batch, None, &sun(hour).as_vec3().to_array().repeat(n), None);
        let truth = picture(&camera, 0, hour);
        let mse = rgb.iter().zip(&truth).map(|(a, b)| (a - b).powi(2) as f64).sum::<f64>() / truth.len() as f64;
        let file = out.join(format!("sun_{k}.png"));
        let image = Image { width: EDGE, height: EDGE, channels: 3, data: rgb };
        photo::save_png(&file, &image.to_u8())?;
        println!("{:.1} dB under a sun that was not trained on, wrote {}", -10.0 * mse.log10(), file.display());
    }
    Ok(())
}
