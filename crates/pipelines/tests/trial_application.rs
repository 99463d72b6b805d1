//! An application that is none of ours, in one file: labelled blocks, seen by cameras that are made up as training goes on. Its field has
//! features at the corners of voxels, a color from a network that is frozen, and 40 channels that tell what a block is made of; its loss
//! compares patches of pixels that are put together at random (Xie et al. 2023, S3IM).

use diorama_engine::fields::{DirectionCode, Encoder, Field, Pruning, RayCodes, VoxelGrid};
use diorama_engine::params::ParamGroup;
use diorama_engine::samplers::occupancy::Occupancy;
use diorama_engine::samplers::placement::Placement;
use diorama_engine::step::{GivenRays, Loss, RaySource, Scene, Step, Trainees};
use diorama_geom::contraction::Space;
use diorama_geom::glam::DVec3;
use diorama_geom::rng::Rng;
use diorama_geom::{Camera, Pose};
use diorama_kernels::ops::adam::Adam;
use diorama_kernels::ops::field_step::{BatchLoss, FieldNet, Output, RayGradients, RayOutputs};
use diorama_kernels::ops::fused_mlp::{Head, Layer, Mlp, Source};
use diorama_kernels::ops::linear::Activation;
use diorama_kernels::ops::march::MarchConfig;
use diorama_kernels::ops::ray_generation::{self, PosedCamera};
use diorama_kernels::ops::ssim::cpu as ssim;
use diorama_pipelines::run::device::Device;

/// Voxels per side, materials, features per corner, edge of a patch, and steps.
const GRID: usize = 16;
const MATERIALS: usize = 40;
const FEATURES: usize = 16;
const PATCH: usize = 16;
const STEPS: u64 = 100;
/// Steps on a device and beside it, which may be slow software.
#[cfg(feature = "gpu")]
const STEPS_THERE: u64 = 40;
const CHANNELS: usize = 3 + MATERIALS;

/// A landscape: hills whose material depends on their height; none: air.
fn material(x: usize, y: usize, z: usize) -> Option<usize> {
    let height = 5.0 + 3.0 * (x as f32 * 0.5).sin() + 2.0 * (y as f32 * 0.7).cos();
    ((z as f32) < height).then_some(z * 4 % MATERIALS)
}

/// Color of a material.
fn color(material: usize) -> [f32; 3] {
    [0.3, 1.1, 2.3].map(|phase| 0.5 + 0.4 * (material as f32 * 0.6 + phase).sin())
}

fn field() -> Field {
    use Source::{Input, Layer as L};
    let grid = VoxelGrid::new(GRID, FEATURES, |x, y, z| material(x, y, z).is_some());
    let rng = Rng::new(7, 1);
    let adam = Adam { rate: 5e-2, ..Adam::default() };
    let table = (0..grid.params_len()).map(|i| 0.5 * rng.normal(i as u64)).collect();
    let layers = vec![
        Layer::new(vec![Input(0)], 32, Activation::Relu, true),
        Layer::new(vec![L(0)], 16, Activation::None, true),
        Layer::new(vec![L(0), Input(1)], 32, Activation::LeakyRelu, true),
        Layer::new(vec![L(2)], 16, Activation::None, true),
        Layer::new(vec![L(0)], 48, Activation::None, true),
    ];
    let head = |layer, activation| Head { layer, channel: 0, activation, shift: 0.0 };
    let net = FieldNet {
        density: Head { shift: 3.0, ..head(1, Activation::Softplus) },
        outputs: vec![
            Output { head: head(3, Activation::Sigmoid), channels: 3, are_shares: false },
            Output { head: head(4, Activation::Sigmoid), channels: MATERIALS, are_shares: false },
        ],
        mlp: Mlp::new(vec![FEATURES, 4], layers),
    };
    let weights = ParamGroup::dense("weights", net.mlp.init(&Rng::new(7, 2)), Adam { rate: 1e-2, ..Adam::default() });
    let codes = RayCodes::new(DirectionCode::SphericalHarmonics(2), None);
    let encoder = Encoder::VoxelCorners { grid, table: ParamGroup::sparse("table", table, adam) };
    let mut field = Field { encoder, codes, net, space: Space::Cube(1.0), weights, normals: None, waves: None };
    // The color network stays as it is: colors are learned as features alone.
    field.freeze_layers(|l| l == 2 || l == 3);
    field
}

/// Where blocks are, which is known.
fn occupancy() -> Occupancy {
    let mut o = Occupancy::new(GRID, 1, false);
    let is_block = |i: usize| material(i % GRID, i / GRID % GRID, i / GRID / GRID).is_some();
    o.grid.density.iter_mut().enumerate().for_each(|(i, d)| *d = if is_block(i) { 1e4 } else { 0.0 });
    o.grid.refresh();
    o
}

/// A patch of pixels of a camera that no photograph has.
struct Patch {
    origins: Vec<f32>,
    dirs: Vec<f32>,
    /// `[R, CHANNELS]`
    wanted: Vec<f32>,
}

impl Patch {
    fn generate(step: u64) -> Patch {
        let rng = Rng::new(7, 100 + step);
        let angle = rng.uniform(0) as f64 * std::f64::consts::TAU;
        let eye = DVec3::new(0.5 + 1.2 * angle.cos(), 0.5 + 1.2 * angle.sin(), 1.0 + 0.4 * rng.uniform(1) as f64);
        let pose = Pose::look_at(eye, DVec3::new(0.5, 0.5, 0.25), DVec3::Z);
        let camera = PosedCamera { camera: Camera::pinhole(64, 64, 0.9), pose };
        let (left, top) = (rng.below(2, 48) as f32, rng.below(3, 48) as f32);
        let n = PATCH * PATCH;
        let pixels: Vec<f32> = (0..n).flat_map(|i| [left + (i % PATCH) as f32 + 0.5, top + (i / PATCH) as f32 + 0.5]).collect();
        let (mut origins, mut dirs) = (vec![0.0; n * 3], vec![0.0; n * 3]);
        ray_generation::cpu::forward(&[camera], &vec![0; n], &pixels, &mut origins, &mut dirs);
        let wanted = origins.chunks_exact(3).zip(dirs.chunks_exact(3)).flat_map(|(o, d)| truth(o, d)).collect();
        Patch { origins, dirs, wanted }
    }
}

/// What a ray sees: color and material of the first block, or nothing at all.
fn truth(o: &[f32], d: &[f32]) -> [f32; CHANNELS] {
    let mut out = [0.0; CHANNELS];
    for i in 0..3000 {
        let at = [0, 1, 2].map(|k| (o[k] + d[k] * i as f32 * 1e-3) * GRID as f32);
        if at.iter().all(|v| (0.0..GRID as f32).contains(v))
            && let Some(m) = material(at[0] as usize, at[1] as usize, at[2] as usize)
        {
            out[..3].copy_from_slice(&color(m));
            out[3 + m] = 1.0;
            break;
        }
    }
    out
}

/// `Σ (v − v*)² / R + ¼ (1 − SSIM)`, the latter of colors whose pixels are shuffled.
struct Loosely<'a> {
    wanted: &'a [f32],
    step: u64,
}

impl BatchLoss for Loosely<'_> {
    fn batch(&self, out: &RayOutputs, g: &mut RayGradients) -> f64 {
        let rays = out.opacity.len();
        let mut loss = 0.0f64;
        for ((v, w), g) in out.values.iter().zip(self.wanted).zip(&mut g.values) {
            loss += ((v - w) * (v - w) / rays as f32) as f64;
            *g += 2.0 * (v - w) / rays as f32;
        }
        let rng = Rng::new(8, self.step);
        let mut order: Vec<usize> = (0..rays).collect();
        (1..rays).rev().for_each(|i| order.swap(i, rng.below(i as u64, i as u64 + 1) as usize));
        let shuffled = |all: &[f32]| -> Vec<f32> { order.iter().flat_map(|r| all[r * CHANNELS..r * CHANNELS + 3].to_vec()).collect() };
        let (x, y) = (shuffled(out.values), shuffled(self.wanted));
        let d = ssim::gradient(PATCH, PATCH, 3, &x, &y);
        for (i, r) in order.iter().enumerate() {
            (0..3).for_each(|k| g.values[r * CHANNELS + k] -= 0.25 * d[i * 3 + k]);
        }
        loss + 0.25 * (1.0 - ssim::ssim(PATCH, PATCH, 3, &x, &y))
    }
}

/// Losses of the first steps, and the field afterwards.
fn train(device: &mut Device, steps: u64) -> (Vec<f64>, Field) {
    let (mut field, mut occupancy) = (field(), occupancy());
    let march = MarchConfig { cone: 0.0, dt_min: 0.015, dt_max: 0.015, max_samples: 128, ..MarchConfig::default() };
    let placement = Placement::Occupancy { march, pruning: Pruning { stop: 1e-4, min_alpha: 0.0, thin: 0.0, min_weight: 0.0 } };
    let scene = Scene { cameras: Vec::new(), near: 0.05, cube: (0.0, 1.0) };
    let mut of = Trainees { occupancy: Some(&mut occupancy), ..Trainees::of(&mut field) };
    device.begin(&of, scene, None).unwrap();
    let rays = PATCH * PATCH;
    let (images, jitter, background) = (vec![0; rays], vec![0.5; rays], vec![0.0; rays * CHANNELS]);
    let mut losses = Vec::new();
    for number in 0..steps {
        let patch = Patch::generate(number);
        let given = GivenRays {
            images: &images,
            origins: &patch.origins,
            dirs: &patch.dirs,
            far: &[],
            jitter: &jitter,
            target: &[],
            background: &background,
            codes: &[],
        };
        let loss = Loosely { wanted: &patch.wanted, step: number };
        let step = Step::new(number, number * rays as u64, RaySource::Given(given), placement, Loss::Batch(&loss));
        let step = Step { room: (1 << 15, 1 << 15), ..step };
        losses.push(device.step(&mut of, None, &step, 1).unwrap().shown.loss);
    }
    device.download(&mut of).unwrap();
    (losses, field)
}

#[test]
fn it_learns_on_the_cpu_and_its_frozen_network_stays() {
    let (losses, field) = train(&mut Device::open("cpu").unwrap(), STEPS);
    let mean = |l: &[f64]| l.iter().sum::<f64>() / l.len() as f64;
    assert!(mean(&losses[90..]) < 0.4 * mean(&losses[..10]), "{losses:?}");
    let (start, trained) = (self::field(), field.weights.trained.clone().unwrap());
    let moved = |i: &usize| field.weights.values[*i] != start.weights.values[*i];
    let is_trained = |i: &usize| trained.iter().any(|r| r.contains(i));
    let all = 0..field.weights.values.len();
    assert!(all.clone().filter(moved).all(|i| is_trained(&i)), "a frozen layer moved");
    assert!(all.clone().any(|i| !is_trained(&i)) && all.filter(moved).count() > 1000);
    let tables = (field.encoder.table().unwrap(), start.encoder.table().unwrap());
    assert!(tables.0.values != tables.1.values && tables.0.values[..FEATURES] == tables.1.values[..FEATURES], "what is empty stays so");
}

#[cfg(feature = "gpu")]
#[test]
fn a_device_comes_to_the_same_losses() {
    let mut device = match Device::open("vulkan").or_else(|_| Device::open("metal")) {
        Ok(device) => device,
        Err(e) => {
            assert!(std::env::var_os("DIORAMA_REQUIRE_GPU").is_none(), "a GPU, or software for one, is required: {e}");
            return println!("skipped: no GPU, nor software for one");
        }
    };
    let (cpu, _) = train(&mut Device::open("cpu").unwrap(), STEPS_THERE);
    let (gpu, _) = train(&mut device, STEPS_THERE);
    for (step, (a, b)) in cpu.iter().zip(&gpu).enumerate() {
        assert!((a - b).abs() <= 0.02 * a, "step {step}: {a} on the CPU, {b} on {}", device.name());
    }
}
