//! The object model end to end: generated photographs of a small object become a mesh with materials.

use diorama_data::gltf::{self, WriteOptions};
use diorama_data::{checkpoint, environment, model_file, photo};
use diorama_geom::model::{Model, Texture, Wrap};
use diorama_geom::{ImageU8, Mesh};
use diorama_pipelines::PipelineError;
use diorama_pipelines::relight::light::{LightOptions, Source};
use diorama_pipelines::relight::object::capture;
use diorama_pipelines::relight::object::config::{Config, Preset};
use diorama_pipelines::relight::object::recipe::{self, Trained};
use diorama_pipelines::relight::object::scores;
use diorama_pipelines::relight::object::synth::{self, ObjectSynth};
use diorama_pipelines::run::RunFolder;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, Ordering};

/// An egg with a red and a blue half and a waist.
fn egg() -> Model {
    let (columns, rows) = (32u32, 16u32);
    let mut mesh = Mesh::default();
    for j in 0..=rows {
        for i in 0..=columns {
            let (u, v) = (i as f32 / columns as f32, j as f32 / rows as f32);
            let (polar, angle) = (v * std::f32::consts::PI, u * std::f32::consts::TAU);
            let r = polar.sin() * (0.7 + 0.15 * (2.0 * polar).cos());
            mesh.positions.push([r * angle.cos(), r * angle.sin(), polar.cos()]);
            mesh.uvs.push([u, v]);
        }
    }
    for j in 0..rows {
        for i in 0..columns {
            let at = |x: u32, y: u32| y * (columns + 1) + x;
            let quad = [at(i, j), at(i, j + 1), at(i + 1, j + 1), at(i + 1, j)];
            mesh.faces.extend([[quad[0], quad[1], quad[2]], [quad[0], quad[2], quad[3]]]);
        }
    }
    mesh.compute_normals();
    let mut model = Model::of("egg", mesh);
    let color = |x: usize| if x < 32 { [200, 60, 40] } else { [40, 70, 190] };
    let image = ImageU8 { width: 64, height: 8, channels: 3, data: (0..512).flat_map(|i| color(i % 64)).collect() };
    model.textures.push(Texture { image, wrap: [Wrap::Repeat; 2] });
    model.materials[0].base_color_texture = Some(0);
    model.materials[0].roughness = 0.6;
    model
}

/// Photographs of the egg, made once.
fn photographs() -> &'static Path {
    static MADE: OnceLock<(tempfile::TempDir, PathBuf)> = OnceLock::new();
    let (_, data) = MADE.get_or_init(|| {
        let dir = tempfile::tempdir().unwrap();
        let (glb, data) = (dir.path().join("egg.glb"), dir.path().join("data"));
        gltf::save(&glb, &egg(), WriteOptions::default()).unwrap();
        let sky = |elevation, rotation| LightOptions { strength: 0.02, ..LightOptions::of(Source::Sky { elevation, rotation }) };
        let options = ObjectSynth {
            object: glb.to_string_lossy().into_owned(),
            views: 24,
            size: (64, 64),
            samples: 16,
            light: sky(40.0, 100.0),
            unseen: sky(20.0, 250.0),
            shows_light: false,
            seed: 0,
        };
        let made = synth::generate(&data, &options, false, &AtomicBool::new(false), &mut |_| {}).unwrap();
        assert_eq!((made.photographs, made.held_out), (21, 3));
        (dir, data)
    });
    data
}

fn train(config: &Config, run: &Path, resume: bool, stop_at: Option<u64>) -> Trained {
    let mut folder = if resume { RunFolder::open(run).unwrap().0 } else { RunFolder::create(run, false).unwrap() };
    let imported = if resume { folder.capture().unwrap() } else { capture::import(config).unwrap() };
    let stop = AtomicBool::new(false);
    let watch = &mut |e: &diorama_engine::train::Event| {
        if let diorama_engine::train::Event::Progress { step, .. } = e {
            stop.fetch_or(stop_at.is_some_and(|at| *step >= at), Ordering::Relaxed);
        }
    };
    recipe::train(config, &imported, &mut folder, resume, &stop, watch).unwrap()
}

#[test]
fn photographs_become_a_mesh_with_materials() {
    let dir = tempfile::tempdir().unwrap();
    let config = Config::new(Preset::Ci, photographs().into());
    let trained = train(&config, &dir.path().join("run"), false, None);
    let s = scores::judge(&trained.model, &trained.capture, 16, &mut |_, _| Ok(())).unwrap();
    let t = s.truth.clone().unwrap();
    // Bars of the small benchmark: 22 dB, 1 % of the diagonal.
    assert!(s.object_psnr > 28.0 && s.object_traced_psnr > 28.0, "{s:?}");
    assert!(t.chamfer < 0.004 && t.base_color_psnr > 12.0 && t.object_relight_psnr > 14.0, "{s:?}");
    let glb = dir.path().join("egg.glb");
    let probe = recipe::export(&trained.model, &glb).unwrap();
    let model = model_file::read(&glb).unwrap().model;
    let material = &model.materials[model.parts[0].material];
    assert!([material.base_color_texture, material.metallic_roughness_texture, material.normal_texture].iter().all(Option::is_some));
    assert!(environment::read(&probe).unwrap().environment.image().data.iter().any(|v| *v > 0.1));
}

#[test]
fn the_third_stage_keeps_the_mesh_and_explains_the_photographs() {
    let dir = tempfile::tempdir().unwrap();
    let mut config = Config::new(Preset::Ci, photographs().into());
    (config.run.topology_steps, config.run.traced_steps) = (100, 60);
    let traced = train(&config, &dir.path().join("traced"), false, None);
    let s = scores::judge(&traced.model, &traced.capture, 8, &mut |_, _| Ok(())).unwrap();
    assert!(s.object_psnr > 25.0 && s.truth.as_ref().unwrap().chamfer < 0.004, "{s:?}");
    assert_eq!(traced.model.stage.name(), "traced");
}

/// The photographs as `poses_bounds.npy` with masks beside `images`.
fn nerd_layout(data: &Path) {
    for folder in ["images", "masks"] {
        std::fs::create_dir_all(data.join(folder)).unwrap();
    }
    let imported = capture::import(&Config::new(Preset::Ci, photographs().into())).unwrap();
    let mut values = Vec::new();
    let mut frames = imported.frames;
    frames.sort_by(|a, b| a.name.cmp(&b.name));
    for (i, f) in frames.iter().enumerate() {
        let (r, t, c) = (f.world_from_camera.rotation, f.world_from_camera.translation, &f.camera);
        for k in 0..3 {
            values.extend([r.y_axis[k], r.x_axis[k], -r.z_axis[k], t[k], [c.height as f64, c.width as f64, c.fx][k]]);
        }
        values.extend([0.1, 10.0]);
        let image = photo::load(&f.image).unwrap();
        let part = |channels: usize, of: &dyn Fn(&[u8; 4]) -> Vec<u8>| {
            let data = image.data.as_chunks::<4>().0.iter().flat_map(of).collect();
            ImageU8 { channels, data, width: image.width, height: image.height }
        };
        photo::save_png(&data.join(format!("images/{i:03}.png")), &part(3, &|p| p[..3].to_vec())).unwrap();
        photo::save_png(&data.join(format!("masks/{i:03}.png")), &part(1, &|p| vec![p[3]])).unwrap();
    }
    let header = format!("{{'descr': '<f8', 'fortran_order': False, 'shape': ({}, 17), }}\n", frames.len());
    let mut npy = b"\x93NUMPY\x01\0".to_vec();
    npy.extend((header.len() as u16).to_le_bytes());
    npy.extend(header.as_bytes());
    values.iter().for_each(|v: &f64| npy.extend(v.to_le_bytes()));
    std::fs::write(data.join("poses_bounds.npy"), npy).unwrap();
}

#[test]
fn a_given_mesh_is_textured_from_photographs_with_masks() {
    let dir = tempfile::tempdir().unwrap();
    let (data, base) = (dir.path().join("data"), dir.path().join("egg.glb"));
    nerd_layout(&data);
    gltf::save(&base, &egg(), WriteOptions::default()).unwrap();
    let mut config = Config::new(Preset::Ci, data);
    config.base_mesh = base;
    let trained = train(&config, &dir.path().join("run"), false, None);
    assert_eq!(trained.summary.step, config.run.texture_steps);
    // Photographs of this layout have no split: those of training are compared.
    let photos = trained.capture.photos.iter().step_by(6);
    let off: Vec<f64> = photos.map(|p| scores::squared_error(&trained.model.picture(&p.view), &p.rgba.data)).collect();
    let psnr = -10.0 * (off.iter().sum::<f64>() / off.len() as f64).log10();
    assert!(psnr > 22.0, "{psnr} dB");
}

#[test]
fn a_random_surface_finds_the_object() {
    let dir = tempfile::tempdir().unwrap();
    let mut config = Config::new(Preset::Ci, photographs().into());
    config.grid.start = "random".into();
    let trained = train(&config, &dir.path().join("run"), false, None);
    let s = scores::judge(&trained.model, &trained.capture, 4, &mut |_, _| Ok(())).unwrap();
    // Parts of the first noise are left inside, and the shape is coarse.
    assert!(s.object_psnr > 18.0 && s.truth.as_ref().unwrap().chamfer < 0.04, "{s:?}");
}

#[test]
fn an_interrupted_run_goes_on_to_the_same_bits() {
    let dir = tempfile::tempdir().unwrap();
    let mut config = Config::new(Preset::Ci, photographs().into());
    (config.run.topology_steps, config.run.texture_steps, config.run.traced_steps, config.run.log_every) = (6, 6, 6, 1);
    let whole = dir.path().join("whole");
    train(&config, &whole, false, None);
    for at in [3, 6, 9, 12, 15] {
        let run = dir.path().join(format!("stopped{at}"));
        assert!(train(&config, &run, false, Some(at)).summary.interrupted);
        assert!(!train(&config, &run, true, None).summary.interrupted);
        let tensors = |run: &Path| checkpoint::load(&run.join("checkpoints")).unwrap().0.tensors;
        assert_eq!(tensors(&run), tensors(&whole), "stopped at {at}");
    }
}

fn refusal(change: impl FnOnce(&Path, &mut Config)) -> PipelineError {
    let dir = tempfile::tempdir().unwrap();
    let data = dir.path().join("data");
    std::fs::create_dir_all(data.join("images")).unwrap();
    for name in ["transforms_train.json", "transforms_test.json"] {
        std::fs::copy(photographs().join(name), data.join(name)).unwrap();
    }
    for file in std::fs::read_dir(photographs().join("images")).unwrap().flatten() {
        std::fs::copy(file.path(), data.join("images").join(file.file_name())).unwrap();
    }
    let mut config = Config::new(Preset::Ci, data.clone());
    change(&data, &mut config);
    let imported = capture::import(&config).unwrap();
    let e = capture::load(&config, &imported).err().expect("it is refused");
    assert!(e.is_input() && !e.to_string().contains('\n'), "{e}");
    e
}

/// Rewrites the pixels of a photograph.
fn rewrite(data: &Path, of: impl Fn([u8; 4]) -> Vec<u8>) {
    let file = data.join("images/003.png");
    let image = photo::load(&file).unwrap();
    let pixels: Vec<u8> = image.data.as_chunks::<4>().0.iter().flat_map(|p| of(*p)).collect();
    let channels = pixels.len() / (image.width * image.height);
    photo::save_png(&file, &ImageU8 { channels, data: pixels, ..image }).unwrap();
}

#[test]
fn bad_captures_are_refused_with_a_cure() {
    let e = refusal(|data, _| rewrite(data, |p| p[..3].to_vec())).to_string();
    assert!(e.contains("003.png") && e.contains("RGBA") && e.contains("masks/"), "{e}");
    let e = refusal(|data, _| rewrite(data, |[r, g, b, _]| vec![r, g, b, 255])).to_string();
    assert!(e.contains("003.png") && e.contains("%") && e.contains("inverted"), "{e}");
    let mut config = Config::new(Preset::Ci, photographs().to_path_buf());
    config.grid.file = "no_tets.npz".into();
    let capture = capture::load(&config, &capture::import(&config).unwrap()).unwrap();
    let e = diorama_pipelines::relight::object::model::ObjectModel::new(config, &capture).err().expect("it is refused").to_string();
    assert!(e.contains("no_tets.npz"), "{e}");
    let e = refusal(|_, config| config.grid.scale = diorama_pipelines::run::config::Auto::Is(0.5)).to_string();
    assert!(e.contains("pixels") && e.contains("grid.scale=1.") && e.contains("auto"), "{e}");
}
