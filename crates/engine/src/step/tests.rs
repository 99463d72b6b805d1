use super::*;
use crate::fields::{self, DirectionCode, Encoder, RayCodes, VoxelGrid};
use crate::samplers::pixels::OBSERVED_EVERY;
use diorama_geom::contraction::Space;
use diorama_geom::glam::DVec3;
use diorama_geom::{Camera, Pose};
use diorama_kernels::ops::adam::Adam;
use diorama_kernels::ops::field_step::{FieldNet, Output, RayGradients, RayOutputs};
use diorama_kernels::ops::fused_mlp::{Head, Layer, Mlp, Source};
use diorama_kernels::ops::hash_grid::HashGridConfig;
use diorama_kernels::ops::linear::Activation;
use diorama_kernels::ops::march::MarchConfig;
use diorama_kernels::ops::photometric_loss::ColorLoss;
use diorama_testkit::random_unit;

/// One photograph per camera, each of one color.
struct Plain([[f32; 4]; 2]);

impl PixelSource for Plain {
    fn images(&self) -> usize {
        2
    }
    fn size(&self, _: usize) -> (u32, u32) {
        (8, 8)
    }
    fn rgba(&self, image: usize, _: u32, _: u32) -> [f32; 4] {
        self.0[image]
    }
    fn counts(&self, _: usize, x: u32, _: u32) -> bool {
        x < 6
    }
}

fn scene() -> Scene {
    let camera = |at: DVec3| PosedCamera { camera: Camera::pinhole(8, 8, 1.0), pose: Pose::look_at(at, DVec3::splat(0.5), DVec3::Z) };
    Scene { cameras: vec![camera(DVec3::new(2.0, 0.5, 0.5)), camera(DVec3::new(-1.0, 0.5, 0.5))], near: 0.05, cube: (0.0, 1.0) }
}

fn hash_field() -> Field {
    let config = HashGridConfig { levels: 2, features: 2, log2_size: 8, base: 4, finest: 8 };
    fields::ngp(config, Space::Cube(1.0), 1e-2, 2, 0, 3)
}

fn step(number: u64, placement: Placement, loss: Loss<'_>) -> Step<'_> {
    let rays = RaySource::Photographs { count: 64, rng: Rng::new(1, 1) };
    Step::new(number, number * 64, rays, placement, loss)
}

fn stratified() -> Placement {
    Placement::Stratified { samples: 16, noise: Some(Rng::new(1, 2)) }
}

fn photometric(color: ColorLoss) -> Loss<'static> {
    Loss::Photometric(Terms { color, distortion: 0.0, depth: 0.0, alpha: 0.0 })
}

#[test]
fn every_placement_learns_the_colors_of_photographs() {
    let pixels = Plain([[0.8, 0.3, 0.1, 1.0]; 2]);
    let photographs = Photographs { pixels: &pixels, observations: &[] };
    let march = MarchConfig { cone: 0.0, dt_min: 0.06, dt_max: 0.06, max_samples: 64, ..MarchConfig::default() };
    let pruning = fields::Pruning { stop: 1e-4, min_alpha: 0.0, thin: 0.0, min_weight: 0.0 };
    let hierarchical = Placement::Hierarchical { samples: 8, more: 8, noise: Some([Rng::new(1, 3), Rng::new(1, 4)]) };
    for placement in [stratified(), hierarchical, Placement::Occupancy { march, pruning }] {
        let (mut field, mut coarse, mut occupancy) = (hash_field(), hash_field(), Occupancy::new(8, 1, false));
        let mut of = Trainees { coarse: Some(&mut coarse), occupancy: Some(&mut occupancy), ..Trainees::of(&mut field) };
        let mut trainer = CpuTrainer::new(scene(), &of);
        let mut run = |i: u64| {
            let probes = (i > 0 && i.is_multiple_of(16)).then_some(Probes { rng: Rng::new(1, 5), points: 256, block: 1 });
            trainer.step(&mut of, Some(&photographs), &Step { probes, ..step(i, placement, photometric(ColorLoss::Mse)) })
        };
        let first = run(0);
        let last = (1..120).map(run).last().unwrap();
        assert!(last.loss < 0.1 * first.loss && last.mse < 0.1 * first.mse, "{placement:?}: {first:?} {last:?}");
        assert!(last.trained > 0.0 && last.marched >= last.trained && (last.steps, last.rays) == (1, 64));
    }
}

#[test]
fn a_loss_that_is_not_finite_changes_nothing() {
    let pixels = Plain([[f32::NAN; 4]; 2]);
    let photographs = Photographs { pixels: &pixels, observations: &[] };
    let mut field = hash_field();
    let before = field.weights.values.clone();
    let mut of = Trainees::of(&mut field);
    let figures = CpuTrainer::new(scene(), &of).step(&mut of, Some(&photographs), &step(0, stratified(), photometric(ColorLoss::Mse)));
    assert!(figures.loss.is_nan() && of.field.weights.values == before);
}

#[test]
fn cameras_follow_their_corrections_and_keep_focal_lengths_that_are_not_refined() {
    let pixels = Plain([[0.9, 0.1, 0.1, 1.0], [0.1, 0.1, 0.9, 1.0]]);
    let photographs = Photographs { pixels: &pixels, observations: &[] };
    for focal in [false, true] {
        let mut field = hash_field();
        let mut group = ParamGroup::dense("corrections", vec![0.0; 2 * CORRECTION], Adam::default());
        let mut of = Trainees { corrections: Some((&mut group, focal)), ..Trainees::of(&mut field) };
        let mut trainer = CpuTrainer::new(scene(), &of);
        for i in 0..20 {
            trainer.step(&mut of, Some(&photographs), &step(i, stratified(), photometric(ColorLoss::Mse)));
        }
        let moved = |k: usize| group.values.iter().skip(k).step_by(CORRECTION).any(|v| *v != 0.0);
        assert!(moved(0) && moved(3), "{:?}", group.values);
        assert_eq!(moved(6), focal);
        let poses = |all: &[PosedCamera]| all.iter().map(|c| format!("{c:?}")).collect::<Vec<_>>();
        assert_eq!(poses(&trainer.cameras), poses(&corrected(&scene().cameras, &group.values)));
    }
}

/// Voxel corners with a color and as many feature channels.
fn voxel_field(features: usize) -> Field {
    use Source::{Input, Layer as L};
    let grid = VoxelGrid::new(4, 8, |_, _, _| true);
    let table = ParamGroup::sparse("table", random_unit(grid.params_len(), 1), Adam { rate: 1e-2, ..Adam::default() });
    let layers = vec![
        Layer::new(vec![Input(0), Input(1)], 32, Activation::Relu, true),
        Layer::new(vec![L(0)], 16, Activation::None, true),
        Layer::new(vec![L(0)], features.next_multiple_of(16), Activation::None, true),
    ];
    let head = |layer, channel, activation| Head { layer, channel, activation, shift: 0.0 };
    let net = FieldNet {
        density: head(1, 3, Activation::Softplus),
        outputs: vec![
            Output { head: head(1, 0, Activation::Sigmoid), channels: 3, are_shares: false },
            Output { head: head(2, 0, Activation::None), channels: features, are_shares: false },
        ],
        mlp: Mlp::new(vec![8, 5], layers),
    };
    let weights = ParamGroup::dense("weights", net.mlp.init(&Rng::new(1, 1)), Adam { rate: 1e-2, ..Adam::default() });
    let codes = RayCodes { given: vec![5], ..RayCodes::new(DirectionCode::None, None) };
    Field { encoder: Encoder::VoxelCorners { grid, table }, codes, net, space: Space::Cube(1.0), weights, normals: None, waves: None }
}

/// Mean squared distance of every channel from one value, which is known only of all rays together: their mean is subtracted.
struct Spread(f32);

impl BatchLoss for Spread {
    fn batch(&self, out: &RayOutputs, g: &mut RayGradients) -> f64 {
        let n = out.values.len() as f32;
        let mean = out.values.iter().sum::<f32>() / n;
        g.values.fill(2.0 * (mean - self.0) / n);
        ((mean - self.0) as f64).powi(2)
    }
}

#[test]
fn rays_of_the_callers_train_any_outputs_by_a_loss_of_the_batch_but_frozen_layers() {
    let mut field = voxel_field(40);
    field.freeze_layers(|l| l == 1);
    let before = field.weights.values.clone();
    let frozen: Vec<bool> = {
        let trained = field.weights.trained.clone().expect("ranges");
        (0..before.len()).map(|i| !trained.iter().any(|r| r.contains(&i))).collect()
    };
    let rays = 32;
    let dirs: Vec<f32> = [-1.0, 0.0, 0.0].repeat(rays);
    let origins: Vec<f32> = random_unit(rays * 3, 2).chunks_exact(3).flat_map(|p| [2.0, p[1], p[2]]).collect();
    let (images, jitter, background, style) = (vec![0; rays], vec![0.5; rays], vec![0.0; rays * 43], random_unit(rays * 5, 3));
    let given = GivenRays {
        images: &images,
        origins: &origins,
        dirs: &dirs,
        far: &[],
        jitter: &jitter,
        target: &[],
        background: &background,
        codes: &[&style],
    };
    let mut of = Trainees::of(&mut field);
    let mut trainer = CpuTrainer::new(Scene { cameras: Vec::new(), near: 0.05, cube: (0.0, 1.0) }, &of);
    let mut run = |i: u64| {
        let described = step(i, stratified(), Loss::Batch(&Spread(0.7)));
        trainer.step(&mut of, None, &Step { rays: RaySource::Given(given), ..described })
    };
    let first = run(0);
    let last = (1..60).map(&mut run).last().unwrap();
    assert!(last.loss < 0.05 * first.loss && last.mse.is_nan(), "{first:?} {last:?}");
    assert!(trainer.given_gradients()[0].iter().any(|d| *d != 0.0), "the given codes get gradients");
    let moved: Vec<bool> = of.field.weights.values.iter().zip(&before).map(|(a, b)| a != b).collect();
    assert!(moved.iter().zip(&frozen).all(|(m, f)| !(*m && *f)), "frozen layers moved");
    assert!(frozen.contains(&true) && moved.contains(&true));
}

#[test]
fn rays_through_pixels_of_known_distance_and_masked_ones_are_told_apart() {
    let pixels = Plain([[0.5, 0.5, 0.5, 1.0]; 2]);
    let seen = [Observation { image: 1, x: 2, y: 3, distance: 1.5 }, Observation { image: 0, x: 7, y: 3, distance: 1.5 }];
    let photographs = Photographs { pixels: &pixels, observations: &seen };
    let mut field = hash_field();
    let of = Trainees::of(&mut field);
    let mut trainer = CpuTrainer::new(scene(), &of);
    trainer.draw(&of, Some(&photographs), &step(0, stratified(), photometric(ColorLoss::Mse)));
    let b = &trainer.batch;
    assert!(b.distance.iter().filter(|d| **d > 0.0).count() <= 64 / OBSERVED_EVERY as usize && b.distance.iter().any(|d| *d > 0.0));
    for (p, counts) in b.pixels.chunks_exact(2).zip(&b.counts) {
        assert_eq!(p[0] < 6.0, *counts);
    }
}

#[test]
fn rays_of_the_callers_teach_cameras_and_the_error_map_nothing() {
    let pixels = Plain([[0.9, 0.1, 0.1, 1.0]; 2]);
    let photographs = Photographs { pixels: &pixels, observations: &[] };
    let (mut field, mut map) = (hash_field(), ErrorMap::new(2));
    let mut group = ParamGroup::dense("corrections", vec![0.01; 2 * CORRECTION], Adam::default());
    // No camera has this image.
    let (images, jitter, background) = (vec![7; 8], vec![0.5; 8], vec![0.0; 24]);
    let (origins, dirs) = ([2.0, 0.5, 0.4].repeat(8), [-1.0, 0.0, 0.0].repeat(8));
    let target = [0.2, 0.3, 0.4, 1.0].repeat(8);
    let given = GivenRays {
        images: &images,
        origins: &origins,
        dirs: &dirs,
        far: &[],
        jitter: &jitter,
        target: &target,
        background: &background,
        codes: &[],
    };
    let mut of = Trainees { corrections: Some((&mut group, true)), error_map: Some(&mut map), ..Trainees::of(&mut field) };
    let mut trainer = CpuTrainer::new(scene(), &of);
    let described = step(0, stratified(), photometric(ColorLoss::Mse));
    let figures = trainer.step(&mut of, Some(&photographs), &Step { rays: RaySource::Given(given), ..described });
    assert!(figures.mse > 0.0 && figures.trained > 0.0, "{figures:?}");
    assert!(group.values.iter().all(|v| *v == 0.01) && map.errors == ErrorMap::new(2).errors);
}

#[test]
fn what_is_frozen_stays_and_no_gradient_of_it_is_computed() {
    let pixels = Plain([[0.9, 0.1, 0.1, 1.0], [0.1, 0.1, 0.9, 1.0]]);
    let photographs = Photographs { pixels: &pixels, observations: &[] };
    let config = HashGridConfig { levels: 2, features: 2, log2_size: 8, base: 4, finest: 8 };
    for is_frozen in [false, true] {
        // Two images, each with a code.
        let mut field = fields::ngp(config, Space::Cube(1.0), 1e-2, 2, 4, 3);
        if is_frozen {
            field.freeze();
        }
        let before: Vec<Vec<f32>> = field.groups().iter().map(|g| g.values.clone()).collect();
        let mut of = Trainees::of(&mut field);
        let mut trainer = CpuTrainer::new(scene(), &of);
        let figures = trainer.step(&mut of, Some(&photographs), &step(0, stratified(), photometric(ColorLoss::Mse)));
        assert!(figures.loss > 0.0);
        let moved: Vec<bool> = field.groups().iter().zip(&before).map(|(g, b)| g.values != *b).collect();
        assert_eq!(moved, [!is_frozen; 3], "table, weights and codes");
        // Gradients of features take the features' place.
        let visible = trainer.encoded();
        let mut features = Vec::new();
        field.encoder.forward(&visible.unit, &mut features);
        assert_eq!(features == visible.features, is_frozen);
    }
}

#[test]
#[should_panic(expected = "Field::freeze_layers")]
fn weights_that_are_frozen_beside_layers_that_are_not_are_refused() {
    let pixels = Plain([[0.5; 4]; 2]);
    let mut field = hash_field();
    field.weights.frozen = true;
    let mut of = Trainees::of(&mut field);
    let described = step(0, stratified(), photometric(ColorLoss::Mse));
    CpuTrainer::new(scene(), &of).step(&mut of, Some(&Photographs { pixels: &pixels, observations: &[] }), &described);
}

#[test]
fn given_rays_end_where_they_are_told_to() {
    let (origins, dirs) = ([-1.0, 0.5, 0.5].repeat(3), [1.0, 0.0, 0.0].repeat(3));
    let of = |far: &[f32]| {
        let mut near_far = vec![0.0; 6];
        let (images, jitter) = (&[0; 3], &[0.5; 3]);
        let given = GivenRays { images, origins: &origins, dirs: &dirs, far, jitter, target: &[], background: &[0.0; 9], codes: &[] };
        given.extents((0.0, 1.0), 0.05, &mut near_far);
        near_far
    };
    assert_eq!(of(&[]), [1.0, 2.0, 1.0, 2.0, 1.0, 2.0]);
    // The last ends before the scene begins.
    assert_eq!(of(&[f32::MAX, 1.25, 0.5]), [1.0, 2.0, 1.0, 1.25, 0.0, 0.0]);
}
