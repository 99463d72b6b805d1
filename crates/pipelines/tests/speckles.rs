//! A speckled floor under a ring of cameras: nothing but fine texture tells how far away it is, and no sparse points help.

use diorama_data::{photo, transforms_json};
use diorama_engine::renderers::volume::Quality;
use diorama_geom::capture::{Frame, SceneBox, SparsePoint, Split};
use diorama_geom::glam::DVec3;
use diorama_geom::rng::Rng;
use diorama_geom::{Camera, Capture, ImageU8, Pose};
use diorama_pipelines::object::config::{Config, Method};
use diorama_pipelines::object::model::ObjectModel;
use diorama_pipelines::object::{evaluate, recipe};
use diorama_pipelines::run::RunFolder;
use std::path::Path;
use std::sync::atomic::AtomicBool;

const VIEWS: usize = 32;
const SIZE: u32 = 72;
/// Edge of a speckle, in the world; cameras stand 3.4 away from what they look at.
const SPECKLE: f64 = 0.12;
/// Rays of a pixel, along each side.
const RAYS: usize = 3;

/// Gray speckles below, plain sky above.
fn color(eye: DVec3, direction: DVec3) -> [f64; 3] {
    if direction.z > -1e-3 {
        return [0.6, 0.7, 0.8];
    }
    let p = (eye - direction * (eye.z / direction.z)) / SPECKLE;
    let cell = (p.x.floor() as i64 as u64).wrapping_mul(0x9E37_79B9).wrapping_add(p.y.floor() as i64 as u64);
    let v = 0.15 + 0.5 * Rng::new(7, 1).uniform(cell) as f64;
    [v, v, 0.9 * v]
}

fn write_capture(folder: &Path) {
    let camera = Camera::pinhole(SIZE, SIZE, 0.9);
    let mut frames = Vec::new();
    for i in 0..VIEWS {
        let turn = i as f64 / VIEWS as f64 * std::f64::consts::TAU;
        let eye = DVec3::new(3.0 * turn.cos(), 3.0 * turn.sin(), 1.4 + 0.3 * (3.0 * turn).sin());
        let pose = Pose::look_at(eye, DVec3::ZERO, DVec3::Z);
        let mut image = ImageU8 { width: SIZE as usize, height: SIZE as usize, channels: 3, data: Vec::new() };
        for pixel in 0..SIZE * SIZE {
            let sum = (0..RAYS * RAYS).fold([0.0; 3], |sum, k| {
                let at = |n: u32, k: usize| n as f64 + (k as f64 + 0.5) / RAYS as f64;
                let d = pose.rotation * camera.direction(at(pixel % SIZE, k % RAYS), at(pixel / SIZE, k / RAYS));
                let c = color(eye, d);
                std::array::from_fn(|n| sum[n] + c[n] / (RAYS * RAYS) as f64)
            });
            image.data.extend(sum.map(|v| (v * 255.0).round() as u8));
        }
        let file = folder.join(format!("{i:02}.png"));
        photo::save_png(&file, &image).unwrap();
        let split = if i % 8 == 0 { Split::Test } else { Split::Train };
        frames.push(Frame { split, ..Frame::new(format!("{i:02}"), file, camera, pose) });
    }
    let scene = SceneBox { center: DVec3::ZERO, half: 1.7, aabb_scale: 8 };
    transforms_json::write(&folder.join("transforms.json"), folder, &Capture::new(frames, scene), None).unwrap();
}

fn train(dir: &Path, seed: &str) -> ObjectModel {
    let mut c = Config::new(Method::Ngp, dir.into());
    for (k, v) in [
        ("device", "cpu"),
        ("seed", seed),
        ("field.log2_size", "15"),
        ("sampling.batch_samples", "16384"),
        ("sampling.occupancy_resolution", "64"),
    ] {
        c.set(k, v).unwrap();
    }
    c.run.steps = 300;
    let mut folder = RunFolder::create(&dir.join("run"), true).unwrap();
    recipe::train(&c, &mut folder, false, None, &AtomicBool::new(false), &mut |_| {}).unwrap().model
}

#[test]
fn fine_texture_alone_tells_how_far_away_a_floor_is() {
    let dir = tempfile::tempdir().unwrap();
    write_capture(dir.path());
    for seed in ["1", "2"] {
        let mut model = train(dir.path(), seed);
        assert!(model.capture.points.is_empty(), "nothing told training");
        // What is known of the floor, where held-out views show it.
        let frames: Vec<u32> = (0..VIEWS as u32).collect();
        let place = |k: i32| DVec3::new((k % 15 - 7) as f64 / 5.0, (k / 15 - 7) as f64 / 5.0, 0.0);
        model.capture.points =
            (0..225).map(|k| SparsePoint { position: place(k), color: [0; 3], error: 0.0, frames: frames.clone() }).collect();
        let report = evaluate::evaluate(&model, Split::Test, Quality::Full, &mut |_, _| Ok(())).unwrap();
        let depth = report.depth.expect("held-out views show the points");
        println!("seed {seed}: {depth:?}, {:.1} dB", report.psnr);
        assert!(depth.points > 400 && depth.elsewhere < 0.15 && depth.median < 0.04, "seed {seed}: {depth:?}");
    }
}
