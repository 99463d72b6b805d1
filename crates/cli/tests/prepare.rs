//! `prepare` from photographs to a data set, with a stand-in for COLMAP that returns the true model.
#![cfg(unix)]

mod colmap;

use colmap::{SIZE, capture, stand_in};
use diorama_data::{import, photo};
use diorama_geom::ImageU8;
use std::path::Path;
use std::process::Command;

const VIEWS: usize = 16;

fn mean_linear(im: &ImageU8) -> f32 {
    let bright = |p: &[u8]| (p[3] > 200).then(|| diorama_geom::color::linear_from_srgb(p[1] as f32 / 255.0));
    let all: Vec<f32> = im.data.chunks_exact(4).filter_map(bright).collect();
    all.iter().sum::<f32>() / all.len() as f32
}

#[test]
fn photographs_become_a_finished_data_set() {
    let dir = tempfile::tempdir().unwrap();
    let (photos, model, out, colmap) =
        (dir.path().join("photos"), dir.path().join("model"), dir.path().join("data"), dir.path().join("colmap"));
    capture(&photos, &model, VIEWS);
    stand_in(&colmap, &model);
    let prepare = |more: &[&str]| {
        let mut c = Command::new(env!("CARGO_BIN_EXE_diorama"));
        c.env("DIORAMA_COLMAP", &colmap).arg("prepare").arg(&photos).arg("-o").arg(&out).args(more).arg("--json");
        let o = c.output().unwrap();
        let text = String::from_utf8_lossy(&o.stderr).into_owned();
        (o.status.code(), text, serde_json::from_slice::<serde_json::Value>(&o.stdout).unwrap_or_default())
    };
    let (code, text, made) = prepare(&[]);
    assert_eq!(code, Some(0), "{text}");
    assert_eq!((&made["registered"], &made["left_out"]), (&(VIEWS as u64).into(), &0.into()));
    let plain = import::import(&out, &Default::default()).unwrap();
    assert!(plain.frames.len() == VIEWS && plain.frames[0].image.ends_with("images/view_00.jpg"));

    let (code, text, made) = prepare(&[
        "--resume",
        "--select",
        "diverse:12",
        "--crop",
        "20,10,160,170",
        "--normalize-exposure",
        "--denoise",
        "--remove-background",
        "auto",
    ]);
    assert_eq!(code, Some(0), "{text}");
    assert_eq!(made["left_out"], 4);
    let stops = made["exposure_stops"].as_array().unwrap();
    let apart = stops[1].as_f64().unwrap() - stops[0].as_f64().unwrap();
    assert!((apart - 1.0).abs() < 0.15, "half the light is one stop: {stops:?}");
    let finished = import::import(&out, &Default::default()).unwrap();
    assert_eq!(finished.frames.len(), 12);
    assert!(finished.points.iter().all(|p| p.frames.iter().all(|f| *f < 12)) && finished.points.iter().any(|p| p.frames.len() > 2));
    let images: Vec<(usize, ImageU8)> =
        finished.frames.iter().map(|f| (f.name[f.name.len() - 2..].parse().unwrap(), photo::load(&f.image).unwrap())).collect();
    for (f, (_, im)) in finished.frames.iter().zip(&images) {
        assert!(f.image.ends_with(format!("finished/{}.png", f.image.file_stem().unwrap().to_string_lossy())));
        assert_eq!((im.width, im.height, im.channels), (160, 170, 4));
        assert_eq!((f.camera.cx, f.camera.cy), (80.0, 90.0));
        // The center of the picture shows the still life, its border does not.
        let clear = im.data.chunks_exact(4).filter(|p| p[3] < 50).count();
        assert!(im.pixel(0, 0)[3] < 50 && clear * 4 > 160 * 170, "{clear}");
    }
    let mean = |odd: usize| {
        let of: Vec<f32> = images.iter().filter(|(i, _)| i % 2 == odd).map(|(_, im)| mean_linear(im)).collect();
        of.iter().sum::<f32>() / of.len() as f32
    };
    assert!((mean(0) / mean(1) - 1.0).abs() < 0.2, "{} {}", mean(0), mean(1));

    for (flags, named) in [
        (["--crop", "150,0,100,100"], "--crop"),
        (["--crop", "1,2"], "--crop"),
        (["--select", "diverse:2"], "--select"),
        (["--select", "all"], "--select"),
        (["--remove-background", "yes"], "--remove-background"),
        (["--remove-background", "net.onnx"], "net.onnx"),
    ] {
        let (code, text, _) = prepare(&[&["--resume"], &flags[..]].concat());
        assert!(code == Some(2) && text.contains(named), "{flags:?}: {text}");
    }
    // None of these calls removed existing files or left new ones behind.
    assert!(!out.join("finished.partial").exists());
    let kept = import::import(&out, &Default::default()).unwrap();
    assert_eq!(kept.frames.len(), 12);
    assert!(kept.frames.iter().all(|f| photo::load(&f.image).is_ok()));
}

/// Calls `prepare` where COLMAP is neither needed nor available.
fn prepare(input: &Path, out: &Path, more: &[&str]) -> (Option<i32>, String, serde_json::Value) {
    let mut c = Command::new(env!("CARGO_BIN_EXE_diorama"));
    c.env("DIORAMA_COLMAP", "no/such/program").arg("prepare").arg(input).arg("-o").arg(out).args(more).arg("--json");
    let o = c.output().unwrap();
    let text = String::from_utf8_lossy(&o.stderr).into_owned();
    (o.status.code(), text, serde_json::from_slice(&o.stdout).unwrap_or_default())
}

/// Photographs with COLMAP's model beside them.
fn posed(root: &Path) {
    capture(&root.join("images"), &root.join("sparse/0"), VIEWS);
}

#[test]
fn a_posed_capture_is_finished_without_colmap() {
    let dir = tempfile::tempdir().unwrap();
    let (input, out) = (dir.path().join("posed"), dir.path().join("data"));
    posed(&input);
    let given = import::import(&input, &Default::default()).unwrap();
    let (code, text, made) = prepare(&input, &out, &["--sfm", "none"]);
    assert_eq!(code, Some(0), "{text}");
    assert_eq!(
        (&made["images"], &made["registered"], &made["points"]),
        (&(VIEWS as u64).into(), &(VIEWS as u64).into(), &given.points.len().into())
    );
    let same = |made: &diorama_geom::Capture| {
        for f in &made.frames {
            let g = given.frames.iter().find(|g| f.name.ends_with(&g.name)).unwrap();
            assert!((f.world_from_camera.translation - g.world_from_camera.translation).length() < 1e-9);
            assert!((f.world_from_camera.rotation.z_axis - g.world_from_camera.rotation.z_axis).length() < 1e-9);
        }
    };
    let plain = import::import(&out, &Default::default()).unwrap();
    same(&plain);
    assert!(plain.frames.len() == VIEWS && plain.frames[0].image.ends_with("images/view_00.jpg"));
    assert!(plain.points.len() == given.points.len() && (plain.points[7].position - given.points[7].position).length() < 1e-5);
    assert!(given.points.iter().any(|p| p.frames.len() > 2), "the model says who sees its points");
    for (p, g) in plain.points.iter().zip(&given.points) {
        let seen = |c: &diorama_geom::Capture, p: &diorama_geom::SparsePoint| -> Vec<_> {
            p.frames.iter().map(|f| c.frames[*f as usize].image.file_stem().map(|s| s.to_owned())).collect()
        };
        assert_eq!((seen(&plain, p), p.error), (seen(&given, g), g.error));
    }
    assert!(plain.scene.aabb_scale == given.scene.aabb_scale && (plain.scene.center - given.scene.center).length() < 1e-9);

    let all = ["--select", "diverse:12", "--crop", "20,10,160,170", "--normalize-exposure", "--denoise", "--remove-background", "auto"];
    let (code, text, made) = prepare(&input, &out, &[&["--sfm", "none", "--resume"], &all[..]].concat());
    assert_eq!(code, Some(0), "{text}");
    let stops = made["exposure_stops"].as_array().unwrap();
    assert!((stops[1].as_f64().unwrap() - stops[0].as_f64().unwrap() - 1.0).abs() < 0.15, "half the light is one stop: {stops:?}");
    let finished = import::import(&out, &Default::default()).unwrap();
    same(&finished);
    assert_eq!(finished.frames.len(), 12);
    for f in &finished.frames {
        let im = photo::load(&f.image).unwrap();
        let clear = im.data.chunks_exact(4).filter(|p| p[3] < 50).count();
        assert_eq!((im.width, im.height, im.channels, f.camera.cx), (160, 170, 4, 80.0));
        assert!(im.pixel(0, 0)[3] < 50 && clear * 4 > 160 * 170 && clear < 160 * 170, "{clear}");
    }
    // COLMAP with the same model gives the same result.
    let (colmap, other) = (dir.path().join("colmap"), dir.path().join("other"));
    stand_in(&colmap, &input.join("sparse/0"));
    let mut c = Command::new(env!("CARGO_BIN_EXE_diorama"));
    c.env("DIORAMA_COLMAP", &colmap).arg("prepare").arg(input.join("images")).arg("-o").arg(&other).args(all).arg("--json");
    let found: serde_json::Value = serde_json::from_slice(&c.output().unwrap().stdout).unwrap();
    for key in ["foreground", "noise"] {
        let [a, b] = [&made, &found].map(|m| m[key].as_f64().unwrap());
        assert!((a / b - 1.0).abs() < 0.1, "{key}: {a} {b}");
    }
    // The data set's points are used although nothing says which views see them.
    let again = dir.path().join("again");
    let more = ["--sfm", "none", "--normalize-exposure", "--remove-background", "auto", "--max-side", "100"];
    let (code, text, made) = prepare(&out, &again, &more);
    assert_eq!(code, Some(0), "{text}");
    assert!(made["foreground"].as_f64().is_some_and(|f| (0.03..0.8).contains(&f)), "{made}");
    let small = import::import(&again, &Default::default()).unwrap();
    same(&small);
    assert!(small.frames.iter().all(|f| f.camera.height == 100 && photo::size(&f.image).unwrap().1 == 100));
}

#[test]
fn masks_of_a_posed_capture_come_along() {
    let dir = tempfile::tempdir().unwrap();
    let (input, out) = (dir.path().join("posed"), dir.path().join("data"));
    posed(&input);
    std::fs::create_dir(input.join("masks")).unwrap();
    let n = SIZE as usize;
    for i in 0..VIEWS {
        // White is left out; the columns that are kept differ slightly.
        let data = (0..n * n).map(|p| if (60 + i..120 + i).contains(&(p % n)) { 0 } else { 255 }).collect();
        photo::save_png(&input.join(format!("masks/view_{i:02}.jpg.png")), &ImageU8 { width: n, height: n, channels: 1, data }).unwrap();
    }
    let flags = ["--sfm", "none", "--mask", "invert", "--mask-meaning", "object", "--crop", "20,10,160,170"];
    let (code, text, _) = prepare(&input, &out, &flags);
    assert!(code == Some(0) && text.contains("masks for 16 of 16"), "{text}");
    let made = import::import(&out, &Default::default()).unwrap();
    assert!(made.masks.meaning == diorama_geom::capture::MaskMeaning::Object && !made.masks.inverted);
    let mask = photo::load_mask(made.frames[0].mask.as_ref().unwrap()).unwrap();
    assert_eq!((mask.width, mask.height, mask.pixel(39, 5)[0], mask.pixel(40, 5)[0], mask.pixel(100, 5)[0]), (160, 170, 0, 255, 0));
}

#[test]
fn what_none_cannot_do_is_told() {
    let dir = tempfile::tempdir().unwrap();
    let (input, out) = (dir.path().join("posed"), dir.path().join("data"));
    posed(&input);
    std::fs::remove_file(input.join("sparse/0/points3D.bin")).unwrap();
    for (flags, named) in [
        (&["--sfm", "none", "--normalize-exposure"][..], "--normalize-exposure"),
        (&["--sfm", "none", "--remove-background", "auto"], "--remove-background"),
        (&["--sfm", "none", "--every", "9"], "--every"),
        (&["--sfm", "all"], "--sfm"),
        (&["--mask", "use"], "--sfm none"),
    ] {
        let (code, text, _) = prepare(&input, &out, flags);
        assert!(code == Some(2) && text.contains(named) && !out.exists(), "{flags:?}: {text}");
    }
    let (code, text, _) = prepare(&input.join("images"), &dir.path().join("none"), &["--sfm", "none"]);
    assert!(code == Some(2) && text.contains("transforms.json") && !dir.path().join("none").exists(), "{text}");
}

#[test]
fn two_at_once_are_refused_and_a_dead_ones_lock_is_not() {
    let dir = tempfile::tempdir().unwrap();
    let (input, out) = (dir.path().join("posed"), dir.path().join("data"));
    posed(&input);
    std::fs::create_dir(&out).unwrap();
    // The leftovers of a process that was killed.
    std::fs::write(out.join(".lock"), b"").unwrap();
    let first = diorama_data::lock::take(&out).unwrap();
    let (code, text, _) = prepare(&input, &out, &["--sfm", "none"]);
    assert!(code == Some(2) && text.contains("in use by another process"), "{text}");
    assert!(!out.join("images").exists());
    drop(first);
    assert_eq!(prepare(&input, &out, &["--sfm", "none"]).0, Some(0));
    let second = diorama_data::lock::take(&out).unwrap();
    for flag in ["--resume", "--force"] {
        let (code, text, _) = prepare(&input, &out, &["--sfm", "none", flag]);
        assert!(code == Some(2) && text.contains("in use"), "{flag}: {text}");
    }
    drop(second);
    assert_eq!(import::import(&out, &Default::default()).unwrap().frames.len(), VIEWS);
}

#[test]
fn train_refuses_a_model_that_contradicts_itself_and_doctor_says_why() {
    let dir = tempfile::tempdir().unwrap();
    posed(dir.path());
    // The poses of one reconstruction with the points of another: every point is elsewhere.
    let file = dir.path().join("sparse/0/points3D.bin");
    let mut all = std::fs::read(&file).unwrap();
    let mut at = 8;
    while at < all.len() {
        let z = f64::from_le_bytes(all[at + 24..at + 32].try_into().unwrap());
        all[at + 24..at + 32].copy_from_slice(&(z + 3.0).to_le_bytes());
        at += 51 + 8 * u64::from_le_bytes(all[at + 43..at + 51].try_into().unwrap()) as usize;
    }
    std::fs::write(&file, all).unwrap();
    let run = dir.path().join("run");
    let call = |arguments: &[&str]| Command::new(env!("CARGO_BIN_EXE_diorama")).args(arguments).output().unwrap();
    let path = dir.path().to_str().unwrap();
    let o = call(&["train", path, "-o", run.to_str().unwrap(), "--steps", "1"]);
    let text = String::from_utf8_lossy(&o.stderr).into_owned();
    assert!(o.status.code() == Some(2) && text.contains("contradict") && text.contains("diorama prepare") && !run.exists(), "{text}");
    let o = call(&["doctor", path, "--json"]);
    let told: serde_json::Value = serde_json::from_slice(&o.stdout).unwrap();
    let model = told["findings"].as_array().unwrap().iter().find(|f| f["subject"] == "model").unwrap().clone();
    assert!(model["grade"] == "trouble" && model["cure"].as_str().unwrap().contains("prepare"), "{model}");
}

#[test]
fn broken_photographs_are_named_or_left_out() {
    let dir = tempfile::tempdir().unwrap();
    let (photos, model, out, colmap) =
        (dir.path().join("photos"), dir.path().join("model"), dir.path().join("data"), dir.path().join("colmap"));
    capture(&photos, &model, VIEWS);
    stand_in(&colmap, &model);
    let whole = std::fs::read(photos.join("view_00.jpg")).unwrap();
    std::fs::write(photos.join("view_99.jpg"), &whole[..whole.len() * 9 / 10]).unwrap();
    let prepare = |more: &[&str]| {
        let mut c = Command::new(env!("CARGO_BIN_EXE_diorama"));
        c.env("DIORAMA_COLMAP", &colmap).arg("prepare").arg(&photos).arg("-o").arg(&out).args(more).arg("--json");
        let o = c.output().unwrap();
        (o.status.code(), String::from_utf8_lossy(&o.stderr).into_owned(), o.stdout)
    };
    let (code, said, _) = prepare(&[]);
    assert_eq!(code, Some(2), "{said}");
    assert!(said.contains("view_99.jpg") && said.contains("ends early") && said.contains("--skip-broken"), "{said}");
    let (code, said, made) = prepare(&["--force", "--skip-broken"]);
    assert_eq!(code, Some(0), "{said}");
    let made: serde_json::Value = serde_json::from_slice(&made).unwrap();
    assert_eq!(made["broken"], serde_json::json!(["view_99.jpg"]));
    assert_eq!((&made["images"], &made["registered"]), (&(VIEWS as u64).into(), &(VIEWS as u64).into()));
    assert!(!out.join("images/view_99.jpg").exists());
}

#[test]
fn photographs_in_several_lights_become_a_data_set_for_relighting() {
    let dir = tempfile::tempdir().unwrap();
    let (photos, model, out, colmap) =
        (dir.path().join("photos"), dir.path().join("model"), dir.path().join("data"), dir.path().join("colmap"));
    capture(&photos, &model, VIEWS);
    stand_in(&colmap, &model);
    let (masks, list) = (dir.path().join("masks"), dir.path().join("sessions.txt"));
    std::fs::create_dir(&masks).unwrap();
    let mut lines = String::new();
    for i in 0..VIEWS {
        let data = (0..SIZE * SIZE).map(|k| if k % SIZE < 20 { 0 } else { 255 }).collect();
        let mask = ImageU8 { width: SIZE as usize, height: SIZE as usize, channels: 1, data };
        photo::save_png(&masks.join(format!("view_{i:02}.png")), &mask).unwrap();
        lines += &format!("view_{i:02}.jpg {}\n", if i % 2 == 0 { "noon" } else { "dusk" });
    }
    std::fs::write(&list, lines).unwrap();
    let prepare = |out: &Path, more: &[&str]| {
        let mut c = Command::new(env!("CARGO_BIN_EXE_diorama"));
        c.env("DIORAMA_COLMAP", &colmap).args(["relight", "prepare"]).arg(&photos).arg("-o").arg(out).args(more).arg("--json");
        let o = c.output().unwrap();
        let text = String::from_utf8_lossy(&o.stderr).into_owned();
        (o.status.code(), text, serde_json::from_slice::<serde_json::Value>(&o.stdout).unwrap_or_default())
    };
    let (masks_flag, list_flag) = (masks.display().to_string(), list.display().to_string());
    let (code, text, made) = prepare(&out, &["--masks", &masks_flag, "--sessions", &list_flag, "--sky", "none"]);
    assert_eq!(code, Some(0), "{text}");
    assert_eq!((&made["photographs"], &made["sessions"]), (&(VIEWS as u64).into(), &2.into()));
    assert!((made["static_share"].as_f64().unwrap() - 0.9).abs() < 1e-6);
    let read = import::import(&out, &Default::default()).unwrap();
    for f in &read.frames {
        let number: u32 = f.name[f.name.len() - 2..].parse().unwrap();
        assert_eq!(f.session, Some(1 - number % 2), "{}", f.name);
        let mask = photo::load_mask(f.mask.as_ref().unwrap()).unwrap();
        assert!(mask.data[0] == 0 && mask.data[100] == 255);
        assert!(f.world_from_camera.translation.length() < 0.91 + 1e-6);
    }
    assert!(read.points.len() > 100 && read.scene.aabb_scale == 1);

    // Without exposure times, from one light, with a mask too few, or over another folder.
    let other = dir.path().join("other");
    let (code, text, _) = prepare(&other, &["--sessions", "exif"]);
    assert!(code == Some(2) && text.contains("has no time") && text.contains("--sessions"), "{text}");
    assert!(!other.exists());
    let (code, text, made) = prepare(&other, &["--sessions", "names"]);
    assert!(code == Some(0) && made["sessions"] == 1 && text.contains("ambiguous"), "{text}");
    std::fs::remove_file(masks.join("view_03.png")).unwrap();
    let (code, text, _) = prepare(&out, &["--masks", &masks_flag, "--force"]);
    assert!(code == Some(2) && text.contains("15 of 16") && text.contains("view_03"), "{text}");
    let (code, text, _) = prepare(&photos, &[]);
    assert!(code == Some(2) && text.contains("choose another --out"), "{text}");
}
