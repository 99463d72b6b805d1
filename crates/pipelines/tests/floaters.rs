//! Floaters in an exported mesh: the field is three balls, of which a device that stands for a GPU knows the densities.

use diorama_data::splat_ply;
use diorama_engine::renderers::supervised::{Supervised, Unserved};
use diorama_engine::renderers::volume::{Accelerator, Traced};
use diorama_engine::samplers::RayBatch;
use diorama_engine::samplers::placement::Placement;
use diorama_geom::glam::DVec3;
use diorama_geom::{Camera, Pose, Similarity};
use diorama_pipelines::object::config::{Config, Method};
use diorama_pipelines::object::export::{self, ExportOptions, Exported, Format, Size};
use diorama_pipelines::object::model::ObjectModel;
use diorama_pipelines::object::{quickstart, recipe};
use std::path::Path;

/// Center in the world and radius.
type Ball = (DVec3, f64);

struct Balls {
    balls: Vec<Ball>,
    world_from_model: Similarity,
}

impl Accelerator for Balls {
    fn trace(&self, _: &RayBatch, _: &Placement, _: Option<u32>) -> Result<(Traced, Option<Vec<f32>>), Unserved> {
        Err(Unserved::Failed("only densities and colors are known".into()))
    }
    fn density(&self, model: &[f32]) -> Result<Vec<f32>, Unserved> {
        let at = |p: &[f32]| {
            let p = self.world_from_model.point(DVec3::new(p[0] as f64, p[1] as f64, p[2] as f64));
            let depth = self.balls.iter().map(|(c, r)| r - (p - *c).length()).fold(f64::MIN, f64::max);
            // A steep slope through the surface.
            (1e3 * (1.0 + 20.0 * depth)).clamp(0.0, 1e6) as f32
        };
        Ok(model.chunks_exact(3).map(at).collect())
    }
    fn color(&self, model: &[f32], _: &[f32]) -> Result<Vec<f32>, Unserved> {
        Ok(vec![0.5; model.len()])
    }
    fn rays(&self) -> usize {
        4
    }
}

fn look(eye: DVec3, target: DVec3, fov: f64) -> (Camera, Pose) {
    (Camera::pinhole(64, 64, fov), Pose::look_at(eye, target, DVec3::new(0.1, 0.2, 1.0)))
}

/// A field of balls, and training cameras at the given places.
fn model(dir: &Path, balls: &[Ball], cameras: &[(Camera, Pose)]) -> ObjectModel {
    quickstart::write_capture(dir, cameras.len() * 8 / 7 + 2, 16).unwrap();
    let mut c = Config::new(Method::Ngp, dir.into());
    c.set("field.log2_size", "10").unwrap();
    c.set("sampling.occupancy_resolution", "16").unwrap();
    let mut m = ObjectModel::new(c.clone(), recipe::load_capture(&c).unwrap(), true).unwrap();
    assert!(m.train.len() >= cameras.len());
    m.train.truncate(cameras.len());
    for (i, (camera, pose)) in m.train.iter().zip(cameras) {
        let f = &mut m.capture.frames[*i];
        (f.camera, f.world_from_camera) = (*camera, *pose);
    }
    let device = Balls { balls: balls.to_vec(), world_from_model: m.model_from_world.inverse() };
    m.accelerator = Some(Supervised::new(Box::new(device), "balls", true, Box::new(|_| {})));
    m
}

/// Whether each ball is in the file that an export writes, and what the export says of it.
fn exported(m: &ObjectModel, balls: &[Ball], keep_unseen: bool) -> (Vec<bool>, Exported) {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("a.ply");
    let s = &m.capture.scene;
    let corner = |sign: f64| (s.center + DVec3::splat(sign * s.half)).as_vec3().to_array();
    let density = 1e3 * m.model_from_world.scale as f32;
    let options = ExportOptions {
        format: Format::Ply,
        out: out.clone(),
        method: Default::default(),
        resolution: 96,
        level: Some(density),
        faces: Some(0),
        texture: None,
        normal_map: false,
        watertight: false,
        size: Size::Scaled(1.0),
        unit_m: 1.0,
        clip: Some((corner(-1.0), corner(1.0))),
        floaters: 0.0,
        keep_unseen,
    };
    let made = export::export(m, &options, &mut |_| {}, &mut |_, _, _| {}).unwrap();
    let written = splat_ply::read(&out).unwrap();
    let in_world: Vec<DVec3> =
        written.positions.iter().map(|p| m.capture.world_from_capture.point(DVec3::from(p.map(f64::from)))).collect();
    let near = |(c, r): &Ball| in_world.iter().any(|p| ((*p - *c).length() - r).abs() < 0.1 * r);
    (balls.iter().map(near).collect(), made)
}

#[test]
fn what_two_cameras_see_is_not_in_the_exported_mesh_and_what_three_see_is() {
    let dir = tempfile::tempdir().unwrap();
    let scene = {
        quickstart::write_capture(&dir.path().join("probe"), 8, 16).unwrap();
        recipe::load_capture(&Config::new(Method::Ngp, dir.path().join("probe"))).unwrap().scene
    };
    let (center, h) = (scene.center, scene.half);
    let at = |x: f64, y: f64, z: f64| center + h * DVec3::new(x, y, z);
    // The object, a part above it that two cameras see, and one below it that three see.
    let balls = [(center, 0.35 * h), (at(0.7, 0.7, 0.7), 0.15 * h), (at(-0.7, -0.7, -0.7), 0.15 * h)];
    let mut cameras: Vec<_> = (0..12)
        .map(|i| {
            let a = i as f64 / 12.0 * std::f64::consts::TAU;
            look(at(4.0 * a.cos(), 4.0 * a.sin(), 0.0), center, 0.2)
        })
        .collect();
    for (ball, seers) in [(balls[1].0, 2), (balls[2].0, 3)] {
        let away = (ball - center).normalize();
        cameras.extend((0..seers).map(|i| look(ball + h * (2.0 * away + DVec3::Y * 0.3 * i as f64), ball, 0.3)));
    }
    let m = model(&dir.path().join("capture"), &balls, &cameras);
    let (kept, all) = exported(&m, &balls, true);
    assert_eq!((kept, all.removed), (vec![true; 3], Default::default()));
    let (stays, made) = exported(&m, &balls, false);
    assert_eq!(stays, [true, false, true]);
    assert!(made.removed.unseen > 100 && made.removed.before_cameras == 0, "{:?}", made.removed);
    assert_eq!(made.faces + made.removed.unseen, all.faces);
    // With a third camera it stays.
    let third = look(balls[1].0 + h * DVec3::new(0.3, 0.0, 2.0), balls[1].0, 0.3);
    let m = model(&dir.path().join("three"), &balls, &[&cameras[..], &[third]].concat());
    assert_eq!(exported(&m, &balls, false).0, [true; 3]);
}
