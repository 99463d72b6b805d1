//! The scene model on a small generated place: it learns, is interrupted and resumed to the same bits, and its layers are rendered.

use diorama_data::photo;
use diorama_engine::train::Event;
use diorama_geom::glam::{DAffine3, DVec3};
use diorama_geom::model::{Instance, Material, Part};
use diorama_geom::view_controls::{ControlInput, ControlValue, ControlValues, check_lists};
use diorama_geom::view_source::{ViewRequest, ViewSource};
use diorama_geom::{Camera, ImageU8, Mesh, Model, Pose};
use diorama_pipelines::relight::outdoor::config::{Config, Preset};
use diorama_pipelines::relight::outdoor::pictures::{self, Layer, PicturesOptions};
use diorama_pipelines::relight::outdoor::{recipe, scores, viewing};
use diorama_pipelines::relight::synth::{self, Place, SynthOptions, Viewpoint};
use diorama_pipelines::run::RunFolder;
use std::ops::Range;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

/// A box with flat normals.
fn cuboid(low: [f32; 3], high: [f32; 3]) -> Mesh {
    let corner = |i: usize| std::array::from_fn(|k| if i >> k & 1 == 0 { low[k] } else { high[k] });
    let sides: [([usize; 4], [f32; 3]); 6] = [
        ([0, 2, 3, 1], [0.0, 0.0, -1.0]),
        ([4, 5, 7, 6], [0.0, 0.0, 1.0]),
        ([0, 1, 5, 4], [0.0, -1.0, 0.0]),
        ([2, 6, 7, 3], [0.0, 1.0, 0.0]),
        ([0, 4, 6, 2], [-1.0, 0.0, 0.0]),
        ([1, 3, 7, 5], [1.0, 0.0, 0.0]),
    ];
    let mut mesh = Mesh::default();
    for (corners, normal) in sides {
        let first = mesh.positions.len() as u32;
        mesh.positions.extend(corners.map(corner));
        mesh.normals.extend([normal; 4]);
        mesh.faces.extend([[first, first + 1, first + 2], [first, first + 2, first + 3]]);
    }
    mesh
}

/// Three boxes on a plate, and cameras around them.
fn place(views: usize, (width, height): (u32, u32)) -> Place {
    let boxes = [
        ([-8.0, -8.0, -0.2], [8.0, 8.0, 0.0], [0.5, 0.48, 0.45]),
        ([-1.6, -0.4, 0.0], [-0.2, 1.2, 1.8], [0.7, 0.3, 0.2]),
        ([0.4, -1.0, 0.0], [1.6, 0.6, 1.0], [0.2, 0.4, 0.6]),
        ([-0.9, -1.8, 0.0], [0.0, -1.1, 0.7], [0.6, 0.6, 0.2]),
    ];
    let mut model = Model::default();
    for (i, (low, high, [r, g, b])) in boxes.into_iter().enumerate() {
        model.materials.push(Material { base_color: [r, g, b, 1.0], specular: 0.0, ..Material::default() });
        model.parts.push(Part { name: format!("box.{i}"), mesh: cuboid(low, high), material: i });
        model.instances.push(Instance { part: i, world_from_part: DAffine3::IDENTITY });
    }
    let camera = Camera::pinhole(width, height, 0.8);
    let pose = |i: usize| {
        let (turn, height) = (i as f64 / views as f64 * std::f64::consts::TAU, 2.2 + 1.3 * (i % 3) as f64);
        Pose::look_at(DVec3::new(4.5 * turn.cos(), 4.5 * turn.sin(), 1.0 + height), DVec3::new(0.0, 0.0, 0.4), DVec3::Z)
    };
    Place::around(model, (0..views).map(|i| (camera, pose(i))).collect())
}

fn generate(out: &Path, views: usize, size: (u32, u32)) {
    let options = SynthOptions { views, lights: 3, size, samples: 16, seed: 0 };
    let made = synth::generate(out, &place(views, size), &options, false, &AtomicBool::new(false), &mut |_| {}).unwrap();
    assert_eq!((made.photographs + made.held_out, made.held_out), (3 * views + 2 * (views / 5), 5 * (views / 5)));
    let again = synth::generate(out, &place(views, size), &options, false, &AtomicBool::new(false), &mut |_| {});
    assert!(again.unwrap_err().to_string().contains("--force"));
}

fn config(data: &Path, steps: u64) -> Config {
    let mut config = Config::new(Preset::Ci, data.into());
    (config.run.steps, config.sampling.rays) = (steps, 256);
    config
}

#[test]
fn each_light_is_photographed_from_viewpoints_of_its_own() {
    let options = SynthOptions { views: 10, lights: 3, size: (16, 12), samples: 1, seed: 0 };
    let viewpoints = Place::street(&options).viewpoints;
    let (held_out, walked): (Vec<Viewpoint>, Vec<Viewpoint>) = viewpoints.iter().partition(|v| v.is_held_out);
    assert!(held_out.len() == 2 && held_out.iter().all(|v| v.light.is_none()));
    for light in 0..3 {
        assert_eq!(walked.iter().filter(|v| v.light == Some(light)).count(), 8);
    }
    let is_alone = |v: &Viewpoint| viewpoints.iter().filter(|w| w.pose == v.pose).count() == 1;
    assert!(viewpoints.iter().all(is_alone));
}

#[test]
fn an_interrupted_run_ends_as_if_it_had_not_been() {
    let dir = tempfile::tempdir().unwrap();
    let data = dir.path().join("data");
    generate(&data, 5, (24, 16));
    let train = |name: &str, stop_at: Option<u64>, resume: bool| {
        let at = dir.path().join(name);
        let mut folder = if resume { RunFolder::open(&at).unwrap().0 } else { RunFolder::create(&at, false).unwrap() };
        let mut config = config(&data, 180);
        (config.run.log_every, config.sampling.rays) = (1, 16);
        // Interrupted while surfaces are learned, in the light's stage, and after what surfaces send was found anew there.
        (config.light.model, config.light.from, config.light.sun_cells) = ("sun".into(), 0.3, 32);
        let stop = AtomicBool::new(false);
        let mut logged = 0;
        let trained = recipe::train(&config, &mut folder, resume, None, &stop, &mut |e| {
            if let Event::Progress { .. } = e {
                logged += 1;
                stop.store(stop_at.is_some_and(|at| logged >= at), Ordering::Relaxed);
            }
        })
        .unwrap();
        (trained.summary.interrupted, trained.model)
    };
    let (_, whole) = train("whole", None, false);
    assert!(train("parts", Some(4), false).0);
    assert!(train("parts", Some(90), true).0);
    assert!(train("parts", Some(70), true).0);
    let (_, resumed) = train("parts", None, true);
    assert_eq!(whole.field.weights.values, resumed.field.weights.values);
    assert_eq!(whole.field.encoder.table().unwrap().values, resumed.field.encoder.table().unwrap().values);
    assert_eq!(whole.lights.values, resumed.lights.values);
    assert_eq!(whole.skies.values, resumed.skies.values);
    assert_eq!(whole.suns.values, resumed.suns.values);
    assert_eq!(whole.sent, resumed.sent);
    assert!(whole.sent != whole.sun_and_sky(), "lights go on following photographs");
    assert!(whole.around().is_some_and(|a| a.iter().all(|v| !v.is_empty())) && whole.around() == resumed.around());
    assert!(!whole.flat.is_empty() && whole.flat == resumed.flat);
}

#[test]
fn a_trained_place_is_scored_and_its_layers_are_rendered() {
    let dir = tempfile::tempdir().unwrap();
    let (data, run) = (dir.path().join("data"), dir.path().join("run"));
    generate(&data, 10, (32, 24));
    let mut folder = RunFolder::create(&run, false).unwrap();
    let mut losses = Vec::new();
    let mut config = config(&data, 200);
    config.sampling.rays = 96;
    recipe::train(&config, &mut folder, false, None, &AtomicBool::new(false), &mut |e| {
        if let Event::Progress { loss, .. } = e {
            losses.push(*loss);
        }
    })
    .unwrap();
    assert!(losses.last().unwrap() < &(0.85 * losses[0]), "{losses:?}");
    drop(folder);
    let (model, _) = recipe::load(&run).unwrap();
    let (mut looked, mut shares) = (0, Vec::new());
    let look = &mut |_: &str, sheet: &scores::Sheet| {
        looked += 1;
        assert!(sheet.ours.iter().zip(&sheet.exact).all(|(a, b)| (a.width, a.height) == (b.width, b.height)));
        Ok(())
    };
    let s = scores::judge(&model, &data, 1, look, &mut |s| shares.push(s)).unwrap();
    assert!(shares.len() == 10 && shares.is_sorted(), "two views in five lights: {shares:?}");
    assert_eq!((s.views, looked), (2, 4));
    assert!(s.veiled_light_psnr.is_finite() && s.veiled_oracle_psnr > s.veiled_mean_psnr, "{s:?}");
    // Exact layers explain more than the mean of the other lights.
    assert!(s.oracle_psnr > s.mean_light_psnr + 2.0 && s.seen_light_psnr.is_finite(), "{s:?}");
    let options = PicturesOptions {
        light: None,
        frames: vec!["0".into(), "v001_noon".into()],
        layers: vec![Layer::Rgb, Layer::Albedo, Layer::Normal, Layer::Shadow],
        samples: 2,
        is_linear: false,
        out: dir.path().join("pictures"),
    };
    let made = pictures::render(&model, &options, &AtomicBool::new(false), &mut |_| {}).unwrap();
    assert!(made.pictures.len() == 8 && made.pictures.iter().all(|p| p.is_file()), "{:?}", made.pictures);
    the_viewer_shows_layers_in_any_light(&run, &data.join("truth"));
    let unknown = PicturesOptions { frames: vec!["nothing".into()], ..options };
    let e = pictures::render(&model, &unknown, &AtomicBool::new(false), &mut |_| {}).unwrap_err();
    assert!(e.is_input() && e.to_string().contains("--frame nothing"), "{e}");
}

/// The printed model, so small that it learns in seconds.
fn printed(data: &Path, steps: u64) -> Config {
    let mut c = Config::new(Preset::Paper, data.into());
    (c.run.steps, c.run.log_every, c.field.width) = (steps, 1, 48);
    (c.sampling.rays, c.sampling.coarse, c.sampling.fine) = (128, 24, 24);
    (c.optim.net_rate, c.optim.light_rate, c.sampling.occupancy_points) = (2e-3, 5e-3, 1 << 12);
    c
}

#[test]
fn the_printed_model_learns_photographs_is_resumed_and_scored() {
    let dir = tempfile::tempdir().unwrap();
    let data = dir.path().join("data");
    generate(&data, 10, (32, 24));
    let train = |name: &str, steps: u64, stop_at: Option<usize>, resume: bool| {
        let at = dir.path().join(name);
        let mut folder = if resume { RunFolder::open(&at).unwrap().0 } else { RunFolder::create(&at, false).unwrap() };
        let (stop, mut losses) = (AtomicBool::new(false), Vec::new());
        let trained = recipe::train(&printed(&data, steps), &mut folder, resume, None, &stop, &mut |e| {
            if let Event::Progress { loss, .. } = e {
                losses.push(*loss);
                stop.store(stop_at.is_some_and(|at| losses.len() >= at), Ordering::Relaxed);
            }
        });
        (trained.unwrap().summary.interrupted, losses)
    };
    assert!(!train("short", 8, None, false).0);
    assert!(train("parts", 8, Some(4), false).0 && !train("parts", 8, None, true).0);
    let losses = train("whole", 160, None, false).1;
    let mean = |l: &[f64]| l.iter().sum::<f64>() / l.len() as f64;
    let (first, last) = (mean(&losses[..10]), mean(&losses[140..]));
    println!("{first} {last}");
    assert!(last < 0.5 * first, "{first} {last}");
    let load = |name: &str| recipe::load(&dir.path().join(name)).unwrap().0;
    let (mut short, mut parts) = (load("short"), load("parts"));
    let arrays = |m: &mut diorama_pipelines::relight::outdoor::model::SceneModel| -> Vec<(String, Vec<f32>)> {
        m.params().into_arrays().into_iter().map(|(name, values)| (name, values.to_vec())).collect()
    };
    assert!(arrays(&mut short) == arrays(&mut parts));
    let s = scores::judge(&load("whole"), &data, 1, &mut |_, _| Ok(()), &mut |_| {}).unwrap();
    println!("{s:?}");
    // Shape and albedo are rough after so few steps; a picture that is upside down or unlit would be far below.
    assert!(s.seen_light_psnr > 14.0 && s.albedo_psnr > 12.0, "{s:?}");
}

/// Light changes what is lit and nothing else; the lists make sense; a place that is looked at has a position.
fn the_viewer_shows_layers_in_any_light(run: &Path, truth: &Path) {
    let (maps, _) = viewing::read_maps(&[truth.join("noon.hdr")]).unwrap();
    let view = viewing::open(run, recipe::load(run).unwrap().0, maps, false).unwrap();
    let scene = view.scene();
    check_lists(&scene.layers, &scene.controls).unwrap();
    let lights = match &scene.controls[0].input {
        ControlInput::Pick { options, .. } => options.iter().map(|(id, _)| id.clone()).collect::<Vec<_>>(),
        other => panic!("{other:?}"),
    };
    assert_eq!(lights, ["learned:0", "learned:1", "learned:2", "map:0", "sky"]);
    let frame = &scene.frames[0];
    let picture = |layer: &str, given: &[(&str, ControlValue)]| {
        let values = ControlValues::checked(&scene.controls, given.iter().map(|(id, v)| (id.to_string(), v.clone()))).unwrap();
        let (camera, world_from_camera) = (frame.camera, frame.world_from_camera);
        view.view(&ViewRequest { camera, world_from_camera, layer: layer.into(), values, clip: None }).unwrap()
    };
    let choice = |id: &str| ("light", ControlValue::Choice(id.into()));
    let plain: Vec<_> = scene.layers.iter().map(|l| picture(&l.id, &[])).collect();
    for (i, a) in plain.iter().enumerate() {
        assert_eq!((a.width, a.height, a.channels), (32, 24, 3));
        assert!(i == 0 || a.data != plain[0].data, "layer {i} looks like the first");
    }
    for changed in [vec![choice("map:0")], vec![choice("sky")], vec![("sun_power", ControlValue::Number(2.0))]] {
        assert_ne!(picture("rgb", &changed).data, plain[0].data, "{changed:?}");
        assert_eq!(picture("albedo", &changed).data, plain[1].data, "{changed:?}");
    }
    let evening = ("sun_azimuth", ControlValue::Number(-90.0));
    assert_ne!(picture("rgb", &[choice("sky"), evening]).data, picture("rgb", &[choice("sky")]).data);
    let dark = picture("rgb", &[choice("map:0"), ("strength", ControlValue::Number(0.0))]);
    assert!(dark.data.iter().all(|v| *v == 0), "there is no light");
}

#[test]
fn photographs_of_one_light_are_warned_about() {
    let dir = tempfile::tempdir().unwrap();
    let data = dir.path().join("data");
    let options = SynthOptions { views: 5, lights: 1, size: (16, 12), samples: 4, seed: 0 };
    synth::generate(&data, &place(5, (16, 12)), &options, false, &AtomicBool::new(false), &mut |_| {}).unwrap();
    // Photographs of other lights that are held out do not help.
    let config = config(&data, 1);
    let mut folder = RunFolder::create(&dir.path().join("run"), false).unwrap();
    let mut notes = Vec::new();
    recipe::train(&config, &mut folder, false, None, &AtomicBool::new(false), &mut |e| {
        if let Event::Note(n) = e {
            notes.push(n.clone());
        }
    })
    .unwrap();
    assert!(notes.iter().any(|n| n.contains("ambiguous")), "{notes:?}");
}

/// A place whose photographs have masks, the right half of which is glass.
fn glaze(data: &Path) {
    for entry in std::fs::read_dir(data.join("masks")).unwrap().flatten() {
        let mask = (0..24 * 16).map(|i| if i % 24 < 12 { 255 } else { 192 }).collect();
        let mask = ImageU8 { width: 24, height: 16, channels: 1, data: mask };
        photo::save_png(&entry.path(), &mask).unwrap();
    }
}

/// Turns the colors of some columns of all photographs around.
fn repaint(data: &Path, columns: Range<usize>) {
    for entry in std::fs::read_dir(data.join("images")).unwrap().flatten() {
        let mut image = photo::load(&entry.path()).unwrap();
        let (w, channels) = (image.width, image.channels);
        image.data.iter_mut().enumerate().filter(|(i, _)| columns.contains(&(i / channels % w))).for_each(|(_, v)| *v = 255 - *v);
        photo::save_png(&entry.path(), &image).unwrap();
    }
}

#[test]
fn what_glass_mirrors_teaches_no_light() {
    let dir = tempfile::tempdir().unwrap();
    let data = dir.path().join("data");
    generate(&data, 5, (24, 16));
    glaze(&data);
    let mut config = config(&data, 12);
    // Opaque from the start, and hardly trained.
    (config.field.first_density, config.optim.grid_rate) = (1000.0, 1e-4);
    (config.light.from, config.light.model, config.light.sun_cells, config.loss.depth) = (0.25, "sun".into(), 16, 0.0);
    (config.run.log_every, config.sampling.max_samples, config.sampling.rays) = (1, 64, 128);
    // Stopped as soon as surfaces are learned, then gone on with after columns of the photographs were repainted.
    let train = |name: &str, columns: Range<usize>| {
        let at = dir.path().join(name);
        let stop = AtomicBool::new(false);
        let mut folder = RunFolder::create(&at, false).unwrap();
        let stopped = recipe::train(&config, &mut folder, false, None, &stop, &mut |e| {
            if let Event::Progress { step, .. } = e {
                stop.store(*step >= 3, Ordering::Relaxed);
            }
        });
        assert!(stopped.unwrap().summary.interrupted);
        drop(folder);
        repaint(&data, columns.clone());
        let done = recipe::train(&config, &mut RunFolder::open(&at).unwrap().0, true, None, &AtomicBool::new(false), &mut |_| {});
        repaint(&data, columns);
        let model = done.unwrap().model;
        (model.field.weights.values.clone(), model.lights.values.clone(), model.suns.values.clone())
    };
    let plain = train("plain", 0..0);
    assert!(plain == train("glass", 12..24), "what glass shows changes the light");
    assert!(plain != train("wall", 0..12), "what walls show changes nothing");
}

/// The error of training on photographs of which all masks hold one value.
fn refusal_of_masks(value: u8) -> String {
    let dir = tempfile::tempdir().unwrap();
    let data = dir.path().join("data");
    generate(&data, 5, (24, 16));
    for entry in std::fs::read_dir(data.join("masks")).unwrap().flatten() {
        photo::save_png(&entry.path(), &ImageU8 { width: 24, height: 16, channels: 1, data: vec![value; 24 * 16] }).unwrap();
    }
    let mut folder = RunFolder::create(&dir.path().join("run"), false).unwrap();
    let trained = recipe::train(&config(&data, 1), &mut folder, false, None, &AtomicBool::new(false), &mut |_| {});
    let e = trained.err().expect("nothing to train on");
    assert!(e.is_input(), "{e}");
    e.to_string()
}

#[test]
fn masks_that_leave_no_surface_are_named() {
    let (transient, glass) = (refusal_of_masks(0), refusal_of_masks(192));
    assert!(["masks", ".png", "100 %", "255 is static"].iter().all(|w| transient.contains(w)), "{transient}");
    assert!(["masks", ".png", "192 is glass", "255"].iter().all(|w| glass.contains(w)), "{glass}");
}

/// Panes so thin that no ray through the middle of a pixel meets them are marked as well.
#[test]
fn masks_of_a_generated_place_mark_all_pixels_that_show_glass() {
    let marked = |width: f32| {
        let (dir, mut place) = (tempfile::tempdir().unwrap(), place(5, (24, 16)));
        place.model.materials[1].transmission = 0.9;
        place.model.parts[1].mesh = cuboid([-0.5 * width, -0.4, 0.0], [0.5 * width, 1.2, 1.8]);
        let options = SynthOptions { views: 5, lights: 1, size: (24, 16), samples: 1, seed: 0 };
        synth::generate(dir.path(), &place, &options, true, &AtomicBool::new(false), &mut |_| {}).unwrap();
        let masks = std::fs::read_dir(dir.path().join("masks")).unwrap().flatten();
        masks.map(|m| photo::load(&m.path()).unwrap().data.iter().filter(|v| **v == 192).count()).sum::<usize>()
    };
    let (wide, thin) = (marked(1.4), marked(0.1));
    assert!(wide > 5 * 20 && thin > 5 * 3 && thin < wide, "{wide} {thin}");
}
