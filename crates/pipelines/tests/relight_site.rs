//! From a trained scene to a mesh with its albedo, and to the light of a photograph that training did not see.

use diorama_data::{model_file, photo};
use diorama_geom::glam::{DAffine3, DVec3};
use diorama_geom::model::{Instance, Material, Part};
use diorama_geom::sh_light::ShLight;
use diorama_geom::{Camera, Mesh, Model, Pose};
use diorama_mesh::extract::Method;
use diorama_pipelines::relight::fit_light::{self, FitOptions, Region};
use diorama_pipelines::relight::meshing::{self, MeshOptions};
use diorama_pipelines::relight::outdoor::config::{Config, Preset};
use diorama_pipelines::relight::outdoor::model::SceneModel;
use diorama_pipelines::relight::outdoor::recipe;
use diorama_pipelines::relight::outdoor::render::ViewLight;
use diorama_pipelines::relight::outdoor::scores::encoded;
use diorama_pipelines::relight::synth::{self, Place, SynthOptions};
use diorama_pipelines::run::RunFolder;
use std::path::Path;
use std::sync::atomic::AtomicBool;

/// A red box on a gray plate, and cameras around.
fn place(views: usize, (width, height): (u32, u32)) -> Place {
    let mut model = Model::default();
    for (i, (low, high, [r, g, b])) in
        [([-4.0, -4.0, -0.3], [4.0, 4.0, 0.0], [0.5, 0.5, 0.5]), ([-1.0, -0.8, 0.0], [0.9, 0.7, 1.4], [0.7, 0.25, 0.2])]
            .into_iter()
            .enumerate()
    {
        let low: [f32; 3] = low;
        let corner = |c: usize| std::array::from_fn(|k| if c >> k & 1 == 0 { low[k] } else { high[k] });
        let sides = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
        let mut mesh = Mesh::default();
        for side in sides {
            let first = mesh.positions.len() as u32;
            mesh.positions.extend(side.map(corner));
            mesh.faces.extend([[first, first + 1, first + 2], [first, first + 2, first + 3]]);
        }
        mesh.compute_normals();
        model.materials.push(Material { base_color: [r, g, b, 1.0], specular: 0.0, ..Material::default() });
        model.parts.push(Part { name: format!("box.{i}"), mesh, material: i });
        model.instances.push(Instance { part: i, world_from_part: DAffine3::IDENTITY });
    }
    let pose = |i: usize| {
        let turn = i as f64 / views as f64 * std::f64::consts::TAU;
        Pose::look_at(DVec3::new(4.0 * turn.cos(), 4.0 * turn.sin(), 2.2 + (i % 3) as f64), DVec3::new(0.0, 0.0, 0.4), DVec3::Z)
    };
    Place { model, cameras: (0..views).map(|i| (Camera::pinhole(width, height, 0.8), pose(i))).collect() }
}

fn trained(dir: &Path) -> SceneModel {
    let (data, run) = (dir.join("data"), dir.join("run"));
    let options = SynthOptions { views: 10, lights: 3, size: (40, 30), samples: 16, seed: 0 };
    synth::generate(&data, &place(10, (40, 30)), &options, false, &AtomicBool::new(false), &mut |_| {}).unwrap();
    let mut config = Config::new(Preset::Ci, data);
    (config.run.steps, config.sampling.rays) = (300, 256);
    let mut folder = RunFolder::create(&run, false).unwrap();
    recipe::train(&config, &mut folder, false, &AtomicBool::new(false), &mut |_| {}).unwrap().model
}

#[test]
fn a_trained_site_becomes_a_mesh_and_tells_the_light_of_a_photograph() {
    let dir = tempfile::tempdir().unwrap();
    let model = trained(dir.path());
    a_mesh_of_the_site(&model, dir.path());
    the_light_of_a_photograph(&model, dir.path());
}

fn a_mesh_of_the_site(model: &SceneModel, dir: &Path) {
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
    assert!(made.candidates.iter().all(|c| c.depth_error >= chosen.depth_error) && chosen.depth_error < 0.15, "{made:?}");
    let read = model_file::read(&made.file).unwrap().model;
    let material = &read.materials[0];
    assert_eq!((material.roughness, material.metallic, material.base_color_texture), (1.0, 0.0, Some(0)));
    assert_eq!(read.face_count(), made.faces);
    // Upright and in the coordinates of the capture: the top of the box is above the plate.
    let (low, high) = read.bounds().unwrap();
    assert!(high[2] > 0.8 && low[2] < 0.5 && high[2] < 3.0, "{low:?} {high:?}");
    let lod = model_file::read(&made.lods[0]).unwrap().model;
    assert!(made.lods[0].ends_with("site.lod1.glb") && lod.face_count() < made.faces);
    // Albedo: red prevails on the box, not on the plate.
    let image = &read.textures[0].image;
    assert_eq!((image.width, image.height), (128, 128));

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

/// The model's own picture in a known light is explained by that light.
fn the_light_of_a_photograph(model: &SceneModel, dir: &Path) {
    let mut truth = ShLight::uniform([0.6, 0.65, 0.8]);
    truth.add_sun(DVec3::new(-0.6, 0.5, 0.6).normalize(), [0.9, 0.8, 0.6]);
    let frame = model.capture.indices(diorama_geom::capture::Split::Test)[0];
    let view = model.view(&model.posed(frame), &ViewLight::of(truth), &mut |_| {});
    let file = dir.join("new.png");
    photo::save_png(&file, &encoded(&view.color)).unwrap();
    let options = FitOptions { photo: file.clone(), camera: Some(frame.to_string()), region: Region::Left };
    let fit = |o: &FitOptions| fit_light::fit(model, o, &AtomicBool::new(false), &mut |_| {});
    let f = fit(&options).unwrap().unwrap();
    let rest = f.rest_psnr.unwrap();
    assert!(f.fitted_psnr > 35.0 && rest > 30.0 && rest > f.mean_light_rest_psnr.unwrap() + 3.0, "{f:?}");
    assert!(fit(&FitOptions { region: Region::All, ..options.clone() }).unwrap().unwrap().rest_psnr.is_none());

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
