//! Detectors that learn a few generated images by heart, go on where they were, and are read by ONNX Runtime.

use super::boxes::DbDecoding;
use super::config::{Backbone, Config, Kind};
use super::network::Detector;
use super::{judge, recipe};
use crate::run::RunFolder;
use crate::run::config::Configuration;
use crate::text::lettering::Fonts;
use diorama_data::{photo, weights};
use diorama_engine::train::Event;
use diorama_geom::ImageU8;
use diorama_geom::glam::{DVec2, dvec2};
use diorama_geom::rng::Rng;
use diorama_nets::{Device, Mode, Tensor, TensorData, param, read_values};
use diorama_testkit::{compare_proven, random_unit, wide};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::atomic::AtomicBool;
use std::time::Instant;

const SIZE: [usize; 2] = [160, 160];
const WORDS: [&str; 12] = ["CAFE", "OPEN", "Hotel", "STOP", "Market", "24h", "EXIT", "Books", "TAXI", "Bar 7", "Sale", "Museum"];

static ON: AtomicBool = AtomicBool::new(false);

/// Writes images of words at angles on uneven ground, three words each, the last of every second image unreadable.
fn write_set(folder: &Path, images: usize) {
    let mut fonts = Fonts::shipped();
    let face = fonts.latin()[0].clone();
    for name in ["images", "icdar15"] {
        std::fs::create_dir_all(folder.join(name)).unwrap();
    }
    for i in 0..images {
        let rng = Rng::new(11, i as u64);
        let draw = |k: u64, low: f64, high: f64| low + rng.uniform(k) as f64 * (high - low);
        let [w, h] = SIZE;
        let ground = [draw(0, 0.3, 0.9), draw(1, 0.3, 0.9), draw(2, 0.3, 0.9)];
        let noise = random_unit(w * h, 40 + i as u64);
        let mut values: Vec<f64> =
            (0..w * h).flat_map(|p| ground.map(|g| g + 0.1 * noise[p] as f64 - 0.2 * (p / w) as f64 / h as f64)).collect();
        let mut lines = String::new();
        for word in 0..3u64 {
            let k = 10 + 10 * word;
            let text = WORDS[(3 * i + word as usize) % WORDS.len()];
            let ink = fonts.set(text, &face, draw(k, 22.0, 30.0) as f32).unwrap().ink;
            let (angle, center) =
                (draw(k + 1, -0.3, 0.3), dvec2(draw(k + 2, 65.0, 95.0), 32.0 + 48.0 * word as f64 + draw(k + 3, -4.0, 4.0)));
            let turn = |p: DVec2| DVec2::from_angle(angle).rotate(p);
            let size = dvec2(ink.width as f64, ink.height as f64);
            let dark = if ground.iter().sum::<f64>() > 1.6 { 0.05 } else { 0.98 };
            for p in 0..w * h {
                let off = dvec2((p % w) as f64 + 0.5, (p / w) as f64 + 0.5) - center;
                let at = DVec2::from_angle(-angle).rotate(off) + 0.5 * size;
                if at.cmpge(DVec2::ZERO).all() && at.cmplt(size).all() {
                    let share = ink.pixel(at.x as usize, at.y as usize)[0] as f64 / 255.0;
                    values[3 * p..3 * p + 3].iter_mut().for_each(|v| *v += share * (dark - *v));
                }
            }
            let half = 0.5 * size + 2.0;
            let corners = [(-half.x, -half.y), (half.x, -half.y), (half.x, half.y), (-half.x, half.y)];
            let numbers: Vec<String> =
                corners.iter().map(|(x, y)| turn(dvec2(*x, *y)) + center).flat_map(|c| [c.x, c.y]).map(|v| format!("{v:.2}")).collect();
            let text = if word == 2 && i % 2 == 1 { "###" } else { text };
            lines += &format!("{},{text}\n", numbers.join(","));
        }
        let data = values.iter().map(|v| (v.clamp(0.0, 1.0) * 255.0) as u8).collect();
        let image = ImageU8 { width: w, height: h, channels: 3, data };
        photo::save_png(&folder.join(format!("images/shop_{i:03}.png")), &image).unwrap();
        std::fs::write(folder.join(format!("icdar15/gt_shop_{i:03}.txt")), lines).unwrap();
    }
}

/// A configuration that sees the images as they are.
fn still(kind: Kind, data: &Path, steps: u64) -> Config {
    let mut c = Config::new(kind, Backbone::Tiny, data.to_path_buf());
    (c.augment.rotation, c.augment.least_scale, c.augment.most_scale, c.augment.color) = (0.0, 1.0, 1.0, 0.0);
    (c.batch.crop, c.run.steps, c.run.log_every, c.batch.workers) = (SIZE[0], steps, 10, 1);
    c
}

fn trained(config: &Config, out: &Path, resume: bool) -> recipe::Trained {
    let mut folder = if resume { RunFolder::open(out).unwrap().0 } else { RunFolder::create(out, false).unwrap() };
    recipe::train(config, &mut folder, (resume, None), &ON, &mut |_| ()).unwrap()
}

/// Trains a kind on eight images until it knows them.
fn learns_by_heart(kind: Kind, steps: u64) {
    let dir = tempfile::tempdir().unwrap();
    let (data, out) = (dir.path().join("data"), dir.path().join("run"));
    write_set(&data, 8);
    let mut config = still(kind, &data, steps);
    if kind == Kind::East {
        // Ten times the rate for photographs: two hundred steps are few.
        config.optim.rate = 0.01;
    }
    let begin = Instant::now();
    let mut folder = RunFolder::create(&out, false).unwrap();
    let mut log = |e: &Event| {
        if let Event::Progress { step, seconds, loss, .. } = e
            && step.is_multiple_of(50)
        {
            println!("{step} {seconds:.1} s loss {loss:.4}");
        }
    };
    let done = recipe::train(&config, &mut folder, (false, None), &ON, &mut log).unwrap();
    let seconds = begin.elapsed().as_secs_f64();
    let (detector, config) = recipe::open(&out, None, None).unwrap();
    assert_eq!(param::arrays(&detector), param::arrays(&done.detector), "the file holds what was trained");
    let set = recipe::labelled(&data).unwrap();
    let judged = judge::judge(&detector, &config, &set, &ON, &mut |_| ()).unwrap().unwrap();
    let e = &judged.evaluation;
    println!("{}: {} steps in {seconds:.0} s, loss {:.4}, {:?}", kind.name(), done.summary.step, done.summary.loss, e);
    assert_eq!((e.images, e.labels, &e.scenes[0].scene[..]), (8, 20, "shop"));
    assert!(e.instance.f >= 0.9, "{e:?}");
}

#[test]
fn east_learns_eight_images_by_heart() {
    learns_by_heart(Kind::East, 200);
}

#[test]
fn db_learns_eight_images_by_heart() {
    learns_by_heart(Kind::Db, 200);
}

#[test]
fn runs_go_on_where_they_were_and_begin_from_weights() {
    let dir = tempfile::tempdir().unwrap();
    let data = dir.path().join("data");
    write_set(&data, 3);
    for kind in Kind::ALL {
        let path = |name: &str| dir.path().join(format!("{}-{name}", kind.name()));
        let mut config = still(kind, &data, 6);
        (config.batch.size, config.batch.crop, config.batch.workers, config.optim.schedule) = (4, 64, 2, "constant".into());
        config.augment.rotation = 0.3;
        let whole = trained(&config, &path("whole"), false);
        config.run.steps = 3;
        trained(&config, &path("parts"), false);
        config.run.steps = 6;
        let parts = trained(&config, &path("parts"), true);
        assert_eq!(param::arrays(&whole.detector), param::arrays(&parts.detector), "{kind:?}");
        let described = recipe::describe(&path("parts")).unwrap();
        assert_eq!((&described["steps"], &described["model"]), (&6.into(), &kind.name().into()));

        // An interrupted run has weights too; a run that begins from these has them before its first step.
        let mut folder = RunFolder::create(&path("begun"), false).unwrap();
        let begin = (false, Some(&*whole.weights));
        let begun = recipe::train(&config, &mut folder, begin, &AtomicBool::new(true), &mut |_| ()).unwrap();
        assert!(begun.summary.interrupted && begun.summary.step == 0);
        assert_eq!(param::arrays(&begun.detector), param::arrays(&whole.detector));
        assert_eq!(param::arrays(&recipe::open(&begun.weights, None, None).unwrap().0), param::arrays(&whole.detector));
    }
}

#[test]
fn backbones_of_torchvision_are_taken_over() {
    let dir = tempfile::tempdir().unwrap();
    let data = dir.path().join("data");
    write_set(&data, 1);
    let config = still(Kind::Db, &data, 1);
    let other = Detector::new(Kind::East, Backbone::Tiny, 7);
    let of =
        |a: &diorama_geom::NamedArray| a.name.strip_prefix("backbone.").map(|n| diorama_geom::NamedArray { name: n.into(), ..a.clone() });
    let mut arrays: Vec<_> = param::arrays(&other).iter().filter_map(of).collect();
    arrays.push(diorama_geom::NamedArray::new("fc.weight", &[1], vec![0.0]));
    let file = dir.path().join("backbone.safetensors");
    weights::save(&file, &arrays, Default::default()).unwrap();
    let run = |name: &str, file: &Path| {
        let mut folder = RunFolder::create(&dir.path().join(name), false).unwrap();
        recipe::train(&config, &mut folder, (false, Some(file)), &AtomicBool::new(true), &mut |_| ())
    };
    let begun = run("a", &file).unwrap();
    let [got, fresh] = [param::arrays(&begun.detector), param::arrays(&Detector::new(Kind::Db, Backbone::Tiny, config.seed))];
    for (got, fresh) in got.iter().zip(&fresh) {
        let theirs = got.name.strip_prefix("backbone.").map(|n| arrays.iter().find(|a| a.name == n).unwrap());
        assert_eq!(got.values, theirs.unwrap_or(fresh).values, "{}", got.name);
    }
    arrays[0].shape = vec![16, 3, 49];
    weights::save(&file, &arrays, Default::default()).unwrap();
    let error = run("b", &file).err().unwrap().to_string();
    assert!(error.contains("backbone.conv1.weight has shape [16, 3, 49], expected [16, 3, 7, 7]"), "{error}");
}

#[test]
fn wrong_files_are_named_with_a_cure() {
    let dir = tempfile::tempdir().unwrap();
    let data = dir.path().join("data");
    write_set(&data, 1);
    let text = |r: crate::Result<(Detector, Config)>| r.err().unwrap().to_string();
    let file = dir.path().join("east.safetensors");
    let east = Detector::new(Kind::East, Backbone::Tiny, 0);
    weights::save(&file, &param::arrays(&east), Default::default()).unwrap();
    assert!(
        text(recipe::open(&file, None, None)).contains("--model: ") && recipe::open(&file, Some(Kind::East), Some(Backbone::Tiny)).is_ok()
    );
    let error = text(recipe::open(&file, Some(Kind::Db), Some(Backbone::Tiny)));
    assert!(error.contains("pyramid.inner_blocks.0.0.weight is missing") && error.contains("check --model"), "{error}");
    let metadata = [("model", "east"), ("backbone", "tiny")].map(|(k, v)| (k.to_string(), v.to_string())).into();
    weights::save(&file, &param::arrays(&east), metadata).unwrap();
    let error = text(recipe::open(&file, Some(Kind::Db), None));
    assert!(error.contains("holds a detector of --model east, not db; leave --model out"), "{error}");
    assert!(recipe::open(&file, None, None).is_ok());

    std::fs::write(data.join("icdar15/gt_shop_000.txt"), "1,1,9,1,9,5,1,5,###").unwrap();
    let error = recipe::labelled(&data).unwrap_err().to_string();
    assert!(error.contains("icdar15: labels no word that counts; write lines such as"), "{error}");
    let mut set = diorama_data::text_set::detector_set::read_set(&data).unwrap();
    let error = judge::find_clusters(&mut set, &data, 0).unwrap_err().to_string();
    assert!(error.contains("--by-pose: ") && error.contains("annotations.jsonl tells no poses"), "{error}");
    set[0].labels[0].region.ignore = false;
    set[0].labels[0].quaternion = Some([1.0, 0.0, 0.0, 0.0]);
    judge::find_clusters(&mut set, &data, 0).unwrap();
    assert_eq!(set[0].labels[0].cluster, Some(0));
}

/// A Python with ONNX Runtime. Without it, prints that the test was skipped, or fails if `DIORAMA_REQUIRE_READERS` is set.
fn onnx_runtime() -> Option<PathBuf> {
    let default = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../target/readers");
    let python = std::env::var_os("DIORAMA_READERS").map_or(default, PathBuf::from).join("venv/bin/python");
    let works = Command::new(&python).args(["-c", "import onnxruntime"]).output().is_ok_and(|o| o.status.success());
    if !works {
        let what = format!("{} has no onnxruntime; run benches/readers.sh", python.display());
        assert!(std::env::var_os("DIORAMA_REQUIRE_READERS").is_none(), "{what}");
        println!("skipped: {what}");
        return None;
    }
    Some(python)
}

#[test]
fn onnx_runtime_computes_the_same() {
    let Some(python) = onnx_runtime() else { return };
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../benches/peers/onnx_outputs.py");
    let dir = tempfile::tempdir().unwrap();
    for (kind, backbone) in
        [(Kind::East, Backbone::Tiny), (Kind::Db, Backbone::Tiny), (Kind::East, Backbone::Resnet50), (Kind::Db, Backbone::Resnet50)]
    {
        // Rounding grows through fifty layers of random weights.
        let tolerance = if backbone == Backbone::Tiny { 1e-4 } else { 3e-4 };
        let detector = Detector::new(kind, backbone, 3);
        // Statistics as training leaves them.
        for seed in 0..30 {
            let x = Tensor::<4>::from_data(TensorData::new(random_unit(2 * 3 * 64 * 64, 60 + seed), [2, 3, 64, 64]), &Device::flex());
            match &detector {
                Detector::East(net) => drop(net.forward(x, Mode::Train).unwrap()),
                Detector::Db(net) => drop(net.forward(x, Mode::Train).unwrap()),
            }
        }
        let (model, input) = (dir.path().join("net.onnx"), dir.path().join("in.f32"));
        recipe::write_onnx(&detector, &Config::new(kind, backbone, "".into()), &model).unwrap();
        // Two sizes of one file: sizes are free.
        for [n, h, w] in [[2, 64, 96], [1, 96, 64]] {
            let values = random_unit(n * 3 * h * w, 9);
            std::fs::write(&input, values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>()).unwrap();
            let shape = format!("{n},3,{h},{w}");
            let out = Command::new(&python).arg(&script).args([&model, &input]).arg(shape).arg(dir.path()).output().unwrap();
            assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
            let x = Tensor::<4>::from_data(TensorData::new(values, [n, 3, h, w]), &Device::flex());
            let ours = match &detector {
                Detector::East(net) => {
                    let maps = net.forward(x, Mode::Eval).unwrap();
                    vec![("score", read_values(maps.score)), ("geometry", read_values(maps.geometry))]
                }
                Detector::Db(net) => vec![("probability", read_values(net.probability(x).unwrap()))],
            };
            for (name, ours) in ours {
                let bytes = std::fs::read(dir.path().join(format!("{name}.f32"))).unwrap();
                let theirs: Vec<f32> = bytes.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
                let off = compare_proven(&ours, &wide(&theirs), tolerance).unwrap_or_else(|e| panic!("{kind:?} {backbone:?} {name}: {e}"));
                println!("{kind:?} {backbone:?} {name} {n}×{h}×{w}: {off:.1e}");
            }
        }
    }
}

#[test]
fn detection_settings_reach_the_boxes() {
    let mut c = Config::template();
    c.set("decode.db.unclip", "0").unwrap();
    assert_eq!(c.decode.db, DbDecoding { unclip: 0.0, ..DbDecoding::default() });
}
