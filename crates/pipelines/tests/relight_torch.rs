//! The scene model as printed learns as it does in PyTorch, where normals are differentiated twice: same weights, rays and samples, a hundred
//! steps. Runs where `DIORAMA_TORCH_PYTHON` names a Python that has torch and numpy.

use diorama_engine::samplers::RayBatch;
use diorama_geom::capture::Frame;
use diorama_geom::color::LUMINANCE;
use diorama_geom::glam::{DVec3, Vec3};
use diorama_geom::rng::Rng;
use diorama_geom::{Camera, Capture, Pose, SceneBox};
use diorama_pipelines::relight::outdoor::config::{Config, Preset};
use diorama_pipelines::relight::outdoor::model::SceneModel;
use diorama_pipelines::relight::outdoor::stepper::{Stepper, sphere_rays};
use std::path::Path;
use std::process::Command;

const RAYS: usize = 12;
/// Of networks and lights.
const RATES: [f32; 2] = [4e-5, 1e-3];
const VIEWS: usize = 6;
const SIZE: u32 = 24;

/// The printed network on few rays and samples, and six cameras around a ball, in two lights.
fn model() -> SceneModel {
    let mut config = Config::new(Preset::Paper, "data".into());
    (config.sampling.rays, config.sampling.coarse, config.sampling.fine, config.sampling.near) = (RAYS, 12, 12, 0.05);
    // Slower than as printed: rounding grows with each step, and faster on steeper ground.
    (config.optim.net_rate, config.optim.light_rate) = (RATES[0], RATES[1]);
    let pose = |i: usize| {
        let turn = i as f64 / VIEWS as f64 * std::f64::consts::TAU;
        Pose::look_at(DVec3::new(1.5 * turn.cos(), 1.5 * turn.sin(), 0.7), DVec3::ZERO, DVec3::Z)
    };
    let camera = Camera::pinhole(SIZE, SIZE, 0.9);
    let frame = |i: usize| Frame { session: Some(i as u32 % 2), ..Frame::new(format!("v{i}"), format!("v{i}.png"), camera, pose(i)) };
    let capture = Capture::new((0..VIEWS).map(frame).collect(), SceneBox { center: DVec3::ZERO, half: 2.0, aabb_scale: 1 });
    SceneModel::new(config, capture).unwrap()
}

/// A ball under a light from one side, before a sky.
fn color(origin: Vec3, dir: Vec3, session: u32) -> Vec3 {
    let (o, radius) = (origin - 0.5, 0.17);
    let along = o.dot(dir);
    let square = along * along - o.length_squared() + radius * radius;
    if square < 0.0 {
        return Vec3::new(0.5, 0.6, 0.8) + 0.15 * dir.z;
    }
    let normal = (o + (-along - square.sqrt()) * dir) / radius;
    let toward = if session == 0 { Vec3::new(0.8, 0.0, 0.6) } else { Vec3::new(-0.6, 0.6, 0.53) };
    Vec3::new(0.8, 0.5, 0.3) * (0.3 + 0.7 * normal.dot(toward).max(0.0))
}

/// Rays of one photograph, as a step draws them.
fn rays(model: &SceneModel, step: u64) -> (RayBatch, Vec<u32>) {
    let (cameras, rng, image) = (model.cameras(), Rng::new(7, 1), (step % VIEWS as u64) as u32);
    let mut batch = RayBatch::default();
    batch.resize(RAYS);
    batch.images.fill(image);
    batch.pixels.iter_mut().enumerate().for_each(|(i, p)| *p = rng.uniform(step * 2 * RAYS as u64 + i as u64) * SIZE as f32);
    sphere_rays(model, &cameras, &mut batch);
    for r in 0..RAYS {
        let at = |v: &[f32]| Vec3::from_slice(&v[3 * r..]);
        let c = color(at(&batch.origins), at(&batch.dirs), image % 2);
        batch.target[4 * r..4 * r + 4].copy_from_slice(&[c.x, c.y, c.z, 1.0]);
    }
    (batch, vec![image % 2; RAYS])
}

/// Files of numbers in a folder, to which each step adds.
struct Record<'a>(&'a Path);

impl Record<'_> {
    fn add(&self, name: &str, values: &[f32]) {
        use std::io::Write;
        let mut file = std::fs::OpenOptions::new().create(true).append(true).open(self.0.join(name)).unwrap();
        values.iter().for_each(|v| file.write_all(&v.to_le_bytes()).unwrap());
    }

    /// All parameters, at the start and at the `end`.
    fn parameters(&self, model: &SceneModel, end: &str) {
        let joint = model.joint.as_ref().unwrap();
        let levels = [("coarse", &joint.coarse, &joint.coarse_lights), ("fine", &model.field, &model.lights)];
        for ((name, field, lights), background) in levels.into_iter().zip(&joint.backgrounds) {
            self.add(&format!("{name}.weights{end}"), &field.weights.values);
            self.add(&format!("{name}.lights{end}"), &lights.values);
            self.add(&format!("{name}.background{end}"), &background.weights.values);
        }
    }
}

/// Trains steps from `first` on and compares their losses with PyTorch's; returns them.
fn course(first: u64, steps: u64) -> Vec<f32> {
    let (mut model, mut stepper, dir) = (model(), Stepper::default(), tempfile::tempdir().unwrap());
    let record = Record(dir.path());
    record.parameters(&model, "");
    record.add("radius", &[model.joint.as_ref().unwrap().sphere.radius]);
    record.add("rates", &[first as f32, RATES[0], RATES[1]]);
    let mut losses = Vec::new();
    for step in 0..steps {
        let (batch, light) = rays(&model, step);
        let before = [model.joint.as_ref().unwrap().coarse_lights.values.clone(), model.lights.values.clone()];
        let figures = stepper.step(&mut model, &batch, &light, first + step, 0.0);
        model.rays += RAYS as u64;
        losses.push(figures.loss as f32);
        record.add("origins", &batch.origins);
        record.add("dirs", &batch.dirs);
        record.add("target", &batch.target);
        record.add("light", &light.iter().map(|l| *l as f32).collect::<Vec<_>>());
        for (name, (samples, lights)) in ["coarse", "fine"].into_iter().zip(stepper.samples.iter().zip(&before)) {
            record.add(&format!("{name}.t"), &samples.inner.samples.t);
            record.add(&format!("{name}.dt"), &samples.inner.samples.dt);
            record.add(&format!("{name}.points"), &samples.outer.points);
            record.add(&format!("{name}.outer"), &samples.outer.dt);
            // Noise that was added to what the shadows read.
            let gray = |l: usize, i: usize| (0..3).map(|k| LUMINANCE[k] * lights[27 * l + 3 * i + k]).sum::<f32>();
            let noise = samples.codes.chunks_exact(9).zip(&light).flat_map(|(c, l)| (0..9).map(move |i| c[i] - gray(*l as usize, i)));
            record.add(&format!("{name}.noise"), &noise.collect::<Vec<_>>());
        }
    }
    record.add("losses", &losses);
    record.parameters(&model, ".end");
    match std::env::var("DIORAMA_TORCH_PYTHON") {
        Err(_) => println!("skipped: DIORAMA_TORCH_PYTHON is not set"),
        Ok(python) => {
            let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../benches/peers/relight_torch.py");
            let out = Command::new(python).arg(script).arg(dir.path()).output().unwrap();
            println!("{}{}", String::from_utf8_lossy(&out.stdout), String::from_utf8_lossy(&out.stderr));
            assert!(out.status.success());
        }
    }
    losses
}

#[test]
fn the_printed_model_learns_as_in_pytorch() {
    let losses = course(0, 100);
    let mean = |l: &[f32]| l.iter().sum::<f32>() / l.len() as f32;
    let (first, last) = (mean(&losses[..10]), mean(&losses[90..]));
    println!("loss {first:.4} in the first ten steps, {last:.4} in the last ten");
    assert!(last < 0.6 * first, "{first} {last}");
}

#[test]
fn bands_and_shadows_come_in_as_in_pytorch() {
    // Two thirds of the bands' course, and half of the shadows'.
    course(20_000, 5);
}
