//! A field that learns a sphere from composited colors and normals.

use super::*;
use crate::fields::{self, DensitySlope, Encoder, Normals};
use crate::params::Schedule;
use crate::renderers::volume::Tracer;
use crate::samplers::RayBatch;
use diorama_geom::contraction::Space;
use diorama_geom::glam::{DVec3, Vec3};
use diorama_geom::{Camera, Pose};
use diorama_kernels::ops::field_step::{RayGradients, RayOutputs};
use diorama_kernels::ops::fused_mlp::Mlp;
use diorama_kernels::ops::hash_grid::HashGridConfig;

const CENTER: Vec3 = Vec3::splat(0.5);
const RADIUS: f32 = 0.28;
const RAYS: usize = 400;
/// Where samples are placed: lowest corner and edge.
const CUBE: (f32, f32) = (0.2, 0.6);

/// Normal of the sphere where a ray meets it.
fn hit(origin: Vec3, dir: Vec3) -> Option<Vec3> {
    let to = origin - CENTER;
    let (b, c) = (to.dot(dir), to.length_squared() - RADIUS * RADIUS);
    (b * b > c).then(|| (to + dir * (-b - (b * b - c).sqrt())) / RADIUS)
}

/// A light from above and a color that changes over the sphere.
fn color(n: Vec3) -> Vec3 {
    (Vec3::splat(0.5) + 0.3 * n) * (0.6 + 0.4 * n.z)
}

/// Rays from all around towards the sphere and past it.
fn rays(first: u64) -> RayBatch {
    let mut b = RayBatch::default();
    b.resize(RAYS);
    let rng = Rng::new(7, 7);
    for r in 0..RAYS {
        let normal = |k: u64| rng.normal((first + r as u64) * 8 + k);
        let origin = CENTER + 1.5 * Vec3::new(normal(0), normal(1), normal(2)).normalize();
        let target = CENTER + 0.25 * Vec3::new(normal(3), normal(4), normal(5));
        b.origins[r * 3..r * 3 + 3].copy_from_slice(&origin.to_array());
        b.dirs[r * 3..r * 3 + 3].copy_from_slice(&(target - origin).normalize().to_array());
        b.jitter[r] = 0.5;
    }
    b
}

/// Squared errors of color and opacity, and one minus the cosine between normals.
struct SphereLoss<'a> {
    rays: &'a RayBatch,
    /// Of the normals' part.
    weight: f32,
}

impl BatchLoss for SphereLoss<'_> {
    fn batch(&self, out: &RayOutputs, g: &mut RayGradients) -> f64 {
        let (mut loss, share) = (0.0, 1.0 / RAYS as f32);
        let vector = |v: &[f32]| Vec3::new(v[0], v[1], v[2]);
        for (r, (v, d)) in out.values.chunks_exact(6).zip(g.values.chunks_exact_mut(6)).enumerate() {
            let want = hit(vector(&self.rays.origins[r * 3..]), vector(&self.rays.dirs[r * 3..]));
            let (e, o) = (vector(v) - want.map_or(Vec3::ZERO, color), out.opacity[r] - want.is_some() as u8 as f32);
            loss += ((e.length_squared() + o * o) * share) as f64;
            d[..3].copy_from_slice(&(2.0 * share * e).to_array());
            g.opacity[r] = 2.0 * share * o;
            let (n, Some(want)) = (vector(&v[3..]), want) else { continue };
            let length = n.length();
            if length > 1e-6 {
                let cos = n.dot(want) / length;
                loss += (self.weight * share * (1.0 - cos)) as f64;
                d[3..].copy_from_slice(&(self.weight * share * (cos * n / length - want) / length).to_array());
            }
        }
        loss
    }
}

/// Median angle in degrees between rendered normals and the sphere's, over the pixels of a view that was not trained on.
fn median_angle(field: &Field) -> f32 {
    let pose = Pose::look_at(DVec3::new(1.6, 1.4, 1.1), DVec3::splat(0.5), DVec3::Z);
    let camera = PosedCamera { camera: Camera::pinhole(32, 32, 0.5), pose };
    let tracer = Tracer::new(field, Placement::Stratified { samples: 96, noise: None }, CUBE);
    let view = tracer.layers(&camera, &[], &mut |_| {});
    assert_eq!(view.values.channels, 6);
    let mut batch = RayBatch::default();
    batch.resize(32 * 32);
    (0..32 * 32).for_each(|i| batch.pixels[i * 2..i * 2 + 2].copy_from_slice(&[(i % 32) as f32 + 0.5, (i / 32) as f32 + 0.5]));
    crate::samplers::pixels::rays(&[camera], 0.0, CUBE, &mut batch);
    let vector = |v: &[f32]| Vec3::new(v[0], v[1], v[2]);
    let mut angles: Vec<f32> = (0..32 * 32)
        .filter_map(|i| {
            let want = hit(vector(&batch.origins[i * 3..]), vector(&batch.dirs[i * 3..]))?;
            Some(vector(&view.values.data[i * 6 + 3..]).angle_between(want).to_degrees())
        })
        .collect();
    assert!(angles.len() > 100, "the view shows the sphere");
    angles.sort_by(f32::total_cmp);
    angles[angles.len() / 2]
}

/// Trains for so many steps at a rate that falls to a tenth, with normals as `slope` says for the share of the steps that are done.
fn train(field: &mut Field, steps: u64, (rate, weight): (f32, f32), slope: impl Fn(f32) -> DensitySlope) {
    let scene = Scene { cameras: Vec::new(), near: 0.0, cube: CUBE };
    for g in field.groups_mut() {
        g.adam.rate = rate;
        g.schedule = Schedule { final_scale: 0.1, ..Schedule::CONSTANT };
    }
    let mut trainer = CpuTrainer::new(scene, &Trainees::of(field));
    for number in 0..steps {
        field.set_normals(Some(Normals { slope: slope(number as f32 / steps as f32), ..Normals::default() })).unwrap();
        let (b, first) = (rays(number * RAYS as u64), number * RAYS as u64);
        let given = GivenRays {
            images: &b.images,
            origins: &b.origins,
            dirs: &b.dirs,
            far: &[],
            jitter: &b.jitter,
            target: &[],
            background: &[0.0; RAYS * 3],
            codes: &[],
        };
        let placement = Placement::Stratified { samples: 40, noise: Some(Rng::new(1, 2)) };
        let loss = SphereLoss { rays: &b, weight };
        let step = Step {
            progress: number as f32 / steps as f32,
            ..Step::new(number, first, RaySource::Given(given), placement, Loss::Batch(&loss))
        };
        let figures = trainer.step(&mut Trainees::of(field), None, &step);
        assert!(figures.loss.is_finite());
    }
}

/// Trains on colors alone, then on colors and normals; the angles after each.
fn angles(field: &mut Field, rates: [f32; 2], slope: impl Fn(f32) -> DensitySlope) -> [f32; 2] {
    train(field, 200, (rates[0], 0.0), |_| DensitySlope::Exact);
    let of_colors = median_angle(field);
    train(field, 300, (rates[1], 1.0), slope);
    field.set_normals(Some(Normals::default())).unwrap();
    [of_colors, median_angle(field)]
}

#[test]
fn a_hash_field_learns_the_normals_of_a_sphere() {
    let config = HashGridConfig { levels: 4, features: 2, log2_size: 14, base: 8, finest: 24 };
    let mut field = fields::ngp(config, Space::Cube(1.0), 1e-2, 0, 0, 3);
    let [before, after] = angles(&mut field, [1e-2, 4e-3], |_| DensitySlope::Exact);
    assert!(after < 5.0 && after < 0.7 * before, "{before} degrees by colors, {after} by normals");
}

#[test]
fn a_frequency_field_learns_from_normals_that_begin_with_taps() {
    let mut field = fields::mlp(Space::Cube(1.0), 2e-3, 3);
    let Encoder::Frequency(f) = &mut field.encoder else { unreachable!() };
    f.bands = 3;
    field.net.mlp = Mlp::chain(vec![f.output_dims()], &[64, 64, 16], true);
    (field.net.density.layer, field.net.outputs[0].head.layer) = (2, 2);
    let adam = field.weights.adam;
    field.weights = ParamGroup::dense("weights", field.net.mlp.init(&Rng::new(5, 5)), adam);
    let [before, after] = angles(&mut field, [4e-3, 4e-3], |share| DensitySlope::annealed(2.0 * share, 1.0 / 32.0, 1.0 / 128.0));
    assert!(after < 0.7 * before, "{before} degrees by colors, {after} by normals");
}
