//! From a scene model to a mesh with its albedo, and to the light of a photograph that training did not see.
//!
//! The model is untrained and dense everywhere, so that its surface is the box around given points.

use diorama_data::{model_file, photo};
use diorama_geom::capture::{Frame, Split};
use diorama_geom::glam::DVec3;
use diorama_geom::sh_light::ShLight;
use diorama_geom::{Camera, Capture, ImageU8, Pose, SceneBox, SparsePoint};
use diorama_mesh::extract::Method;
use diorama_pipelines::relight::fit_light::{self, FitOptions, Region};
use diorama_pipelines::relight::meshing::{self, MeshOptions};
use diorama_pipelines::relight::outdoor::config::{Config, Preset};
use diorama_pipelines::relight::outdoor::model::SceneModel;
use diorama_pipelines::relight::outdoor::render::ViewLight;
use diorama_pipelines::relight::outdoor::scores::encoded;
use std::path::Path;
use std::sync::atomic::AtomicBool;

/// Logarithm of the density in model space.
const DENSE: f32 = 3.0;
const VIEWS: usize = 10;

fn model() -> SceneModel {
    let pose = |i: usize| {
        let turn = i as f64 / VIEWS as f64 * std::f64::consts::TAU;
        Pose::look_at(DVec3::new(3.6 * turn.cos(), 3.6 * turn.sin(), 2.0 + 0.5 * (i % 3) as f64), DVec3::new(0.0, 0.0, 0.4), DVec3::Z)
    };
    let camera = Camera::pinhole(40, 30, 0.8);
    let frame = |i: usize| Frame { session: Some(0), ..Frame::new(format!("v{i}"), format!("v{i}.png"), camera, pose(i)) };
    let mut frames: Vec<Frame> = (0..VIEWS).map(frame).collect();
    frames[VIEWS - 1].split = Split::Test;
    let mut capture = Capture::new(frames, SceneBox { center: DVec3::ZERO, half: 4.0, aabb_scale: 1 });
    // Points between (-1, -0.8, 0) and (1, 0.8, 1.4).
    let at = |i: usize| DVec3::new((i % 6) as f64 / 2.5 - 1.0, (i / 6 % 6) as f64 * 0.32 - 0.8, (i / 36) as f64 * 0.28);
    capture.points = (0..216).map(|i| SparsePoint { position: at(i), color: [0; 3], error: 0.0, frames: vec![0, 1, 2] }).collect();
    let mut model = SceneModel::new(Config::new(Preset::Ci, "data".into()), capture).unwrap();
    model.begin_light().unwrap();
    model.field.net.density.shift = DENSE;
    model
}

#[test]
fn a_site_becomes_a_mesh() {
    let (model, dir) = (model(), tempfile::tempdir().unwrap());
    let (model, dir): (_, &Path) = (&model, dir.path());
    let options = MeshOptions {
        out: dir.join("site.glb"),
        method: Method::Cubes,
        resolution: 64,
        level: None,
        interpolate: true,
        target: 3000,
        bake: 128,
        lods: 1,
        quantize: true,
    };
    let run = |o: &MeshOptions| meshing::mesh(model, o, &AtomicBool::new(false), &mut |_, _, _| {});
    let made = run(&options).unwrap().unwrap();
    assert_eq!(made.candidates.len(), 5);
    assert!(made.candidates.iter().all(|c| c.depth_error.is_finite()) && made.sampled <= 1.0, "{made:?}");
    let chosen = made.candidates.iter().find(|c| c.level == made.level).unwrap();
    assert!(made.candidates.iter().all(|c| c.depth_error >= chosen.depth_error), "{made:?}");
    let read = model_file::read(&made.file).unwrap().model;
    let material = &read.materials[0];
    assert_eq!((material.roughness, material.metallic, material.base_color_texture), (1.0, 0.0, Some(0)));
    assert_eq!(read.face_count(), made.faces);
    // Upright and in the coordinates of the capture; no camera sees the underside.
    let (low, high) = read.bounds().unwrap();
    assert!((high[2] - 1.6).abs() < 0.1 && (low[2] + 0.2).abs() < 0.1 && (high[0] - 1.2).abs() < 0.1, "{low:?} {high:?}");
    assert!(made.removed.unseen > 0 && made.faces <= 3000, "{made:?}");
    let lod = model_file::read(&made.lods[0]).unwrap().model;
    assert!(made.lods[0].ends_with("site.lod1.glb") && lod.face_count() < made.faces);
    // An untrained albedo is one half, in linear light.
    let image = &read.textures[0].image;
    assert_eq!((image.width, image.height), (128, 128));
    assert!(image.data.chunks_exact(3).all(|p| p.iter().all(|v| v.abs_diff(188) < 6)), "{:?}", &image.data[..9]);

    the_glazed_roof_is_a_part_of_its_own(dir, &options);

    let stopped =
        meshing::mesh(model, &MeshOptions { out: dir.join("no.glb"), ..options.clone() }, &AtomicBool::new(true), &mut |_, _, _| {});
    assert!(stopped.unwrap().is_none() && !dir.join("no.glb").exists());
    for (wrong, name) in [
        (MeshOptions { resolution: 5, ..options.clone() }, "--resolution"),
        (MeshOptions { bake: 3, ..options.clone() }, "--bake"),
        (MeshOptions { level: Some(-1.0), ..options.clone() }, "--level"),
        (MeshOptions { out: dir.join("a.obj"), ..options.clone() }, ".glb"),
        (MeshOptions { level: Some(1e30), out: dir.join("e.glb"), ..options }, "nothing is as dense"),
    ] {
        let e = run(&wrong).unwrap_err();
        assert!(e.is_input() && e.to_string().contains(name), "{e}");
    }
    assert!(!dir.join("e.glb").exists());
}

/// Masks mark the roof of the box as glass, in front of cameras that look down on it.
fn the_glazed_roof_is_a_part_of_its_own(dir: &Path, options: &MeshOptions) {
    let mut model = model();
    for (i, f) in model.capture.frames.iter_mut().enumerate() {
        let c = f.camera;
        let value = |p: usize| {
            let d = f.world_from_camera.rotation * c.direction((p % 40) as f64 + 0.5, (p / 40) as f64 + 0.5);
            let from = f.world_from_camera.translation;
            let at = from + d * ((1.6 - from.z) / d.z);
            if d.z < 0.0 && at.x.abs() < 1.2 && at.y.abs() < 1.0 { 192 } else { 255 }
        };
        let mask = dir.join(format!("mask{i}.png"));
        photo::save_png(&mask, &ImageU8 { width: 40, height: 30, channels: 1, data: (0..1200).map(value).collect() }).unwrap();
        f.mask = Some(mask);
    }
    let glazed = MeshOptions { out: dir.join("glazed.glb"), resolution: 48, quantize: false, ..options.clone() };
    // One is gone, which is said.
    std::fs::remove_file(dir.join("mask0.png")).unwrap();
    let made = meshing::mesh(&model, &glazed, &AtomicBool::new(false), &mut |_, _, _| {}).unwrap().unwrap();
    for file in [&made.file, &made.lods[0]] {
        let read = model_file::read(file).unwrap().model;
        let [walls, panes] = &read.parts[..] else { panic!("{} parts", read.parts.len()) };
        let glass = &read.materials[panes.material];
        assert!(glass.name == "glass" && glass.roughness < 0.1 && glass.base_color[0] < 0.1 && glass.metallic == 0.0, "{glass:?}");
        assert!(read.materials[walls.material].base_color_texture.is_some());
        let height = |m: &diorama_geom::Mesh| m.positions.iter().map(|p| p[2] as f64).sum::<f64>() / m.positions.len() as f64;
        assert!(height(&panes.mesh) > 1.4 && height(&walls.mesh) < 1.3, "{} {}", height(&panes.mesh), height(&walls.mesh));
    }
    assert!(made.glass * 10 > made.faces && made.glass * 2 < made.faces, "{made:?}");
    assert!(made.notes[0].contains("1 of 9 masks are gone"), "{:?}", made.notes);
}

/// The model's own picture in a known light is explained by that light.
#[test]
fn the_light_of_a_photograph_is_found() {
    let opaque = || {
        let mut model = self::model();
        // So that all cameras see the same surface.
        model.field.net.density.shift = DENSE + 2.0;
        model
    };
    let (model, dir) = (opaque(), tempfile::tempdir().unwrap());
    let (model, dir): (_, &Path) = (&model, dir.path());
    let mut truth = ShLight::uniform([0.6, 0.65, 0.8]);
    truth.add_sun(DVec3::new(-0.6, 0.5, 0.6).normalize(), [0.9, 0.8, 0.6]);
    let frame = VIEWS - 1;
    let view = model.view(&model.posed(frame), &ViewLight::of(truth), &mut |_| {});
    let file = dir.join("new.png");
    photo::save_png(&file, &encoded(&view.color)).unwrap();
    let options = FitOptions { photo: file.clone(), camera: Some(frame.to_string()), region: Region::Left, all_surfaces: true };
    let fit = |o: &FitOptions| fit_light::fit(model, o, &AtomicBool::new(false), &mut |_| {});
    let f = fit(&options).unwrap().unwrap();
    let rest = f.rest_psnr.unwrap();
    assert!(f.fitted_psnr > 35.0 && rest > 30.0 && rest > f.mean_light_rest_psnr.unwrap() + 3.0, "{f:?}");
    assert!(fit(&FitOptions { region: Region::All, ..options.clone() }).unwrap().unwrap().rest_psnr.is_none());

    // A pane that mirrors something bright spoils the light, unless a mask says that it is glass.
    let pane = |x: usize| (4..18).contains(&x);
    let mut glazed = photo::load(&file).unwrap();
    let (w, channels) = (glazed.width, glazed.channels);
    glazed.data.iter_mut().enumerate().filter(|(i, _)| pane(i / channels % w)).for_each(|(_, v)| *v = v.saturating_add(40));
    let mirrored = dir.join("mirrored.png");
    photo::save_png(&mirrored, &glazed).unwrap();
    let mirrored = FitOptions { photo: mirrored, ..options.clone() };
    let spoiled = fit(&mirrored).unwrap().unwrap().rest_psnr.unwrap();
    let mask = dir.join("pane.png");
    let data = (0..1200).map(|p| if pane(p % 40) { 192 } else { 255 }).collect();
    photo::save_png(&mask, &ImageU8 { width: 40, height: 30, channels: 1, data }).unwrap();
    let mut masked = opaque();
    masked.capture.frames[frame].mask = Some(mask);
    let told = fit_light::fit(&masked, &mirrored, &AtomicBool::new(false), &mut |_| {}).unwrap().unwrap();
    let (fitted, left) = (told.fitted_psnr, told.rest_psnr.unwrap());
    assert!(fitted > 35.0 && left > 30.0 && left > spoiled + 5.0, "{fitted} {left} {spoiled}");

    // The same camera from a file.
    let c = model.capture.frames[frame].camera;
    let pose = model.capture.frames[frame].world_from_camera.flip_y_z();
    let row = |i: usize| [pose.rotation.x_axis[i], pose.rotation.y_axis[i], pose.rotation.z_axis[i], pose.translation[i]];
    let entry = serde_json::json!({ "file_path": "new.png", "fl_x": c.fx, "fl_y": c.fy, "cx": c.cx, "cy": c.cy, "w": c.width, "h": c.height,
        "transform_matrix": [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]] });
    let json = dir.join("pose.json");
    std::fs::write(&json, serde_json::json!({ "frames": [entry] }).to_string()).unwrap();
    let from_file = fit(&FitOptions { camera: Some(json.display().to_string()), ..options.clone() }).unwrap().unwrap();
    assert!((from_file.fitted_psnr - f.fitted_psnr).abs() < 0.1, "{} {}", from_file.fitted_psnr, f.fitted_psnr);

    let e = fit(&FitOptions { camera: None, ..options.clone() }).unwrap_err();
    assert!(e.is_input() && e.to_string().contains("--camera"), "{e}");
    let e = fit(&FitOptions { region: Region::Box([0.0, 0.0, 2.0, 2.0]), ..options }).unwrap_err();
    assert!(e.is_input() && e.to_string().contains("--region"), "{e}");
}
