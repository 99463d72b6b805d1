//! Runs that start on a GPU and end on the CPU, and pictures whose paths a GPU traces. Without a device these tests are skipped, or fail if `DIORAMA_REQUIRE_GPU` is set.
#![cfg(feature = "gpu")]

use diorama_data::photo;
use diorama_pipelines::object::quickstart::write_capture;
use std::path::Path;
use std::process::{Command, Output};

fn diorama(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_diorama")).args(args).output().unwrap()
}

fn json(out: Output) -> serde_json::Value {
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
    serde_json::from_slice(&out.stdout).unwrap()
}

/// A GPU, or software that emulates one.
fn device() -> Option<String> {
    let doctor = json(diorama(&["doctor", "--json"]));
    let found = doctor["devices"].as_array().unwrap().iter().filter_map(|d| d.as_str()).find(|d| *d != "cpu").map(str::to_string);
    if found.is_none() {
        assert!(std::env::var_os("DIORAMA_REQUIRE_GPU").is_none(), "a GPU, or software for one, is required: {doctor}");
        println!("skipped: no GPU, nor software for one");
    }
    found
}

#[test]
fn a_run_goes_on_where_another_device_left_it() {
    let Some(device) = device() else { return };
    let device = &device[..];
    let dir = tempfile::tempdir().unwrap();
    let (data, run) = (dir.path().join("data"), dir.path().join("run"));
    write_capture(&data, 8, 32).unwrap();
    let (data, run) = (data.to_str().unwrap(), run.to_str().unwrap());
    let small =
        ["field.log2_size=12", "sampling.rays=64", "sampling.batch_samples=4096", "sampling.occupancy_points=512", "run.log_every=1"];
    let sets: Vec<&str> = small.iter().flat_map(|s| ["--set", s]).collect();
    let begin = json(diorama(&[&["train", data, "-o", run, "--device", device, "--steps", "20", "--json"][..], &sets].concat()));
    assert!(begin["device"].as_str().unwrap().contains(device), "{begin}");
    let end = json(diorama(&["train", "-o", run, "--resume", "--device", "cpu", "--steps", "40", "--json"]));
    assert_eq!((end["device"].as_str(), end["steps"].as_u64()), (Some("cpu"), Some(40)), "{end}");
    let log = std::fs::read_to_string(format!("{run}/metrics.jsonl")).unwrap();
    let losses: Vec<f64> =
        log.lines().map(|l| serde_json::from_str::<serde_json::Value>(l).unwrap()).filter_map(|v| v["loss"].as_f64()).collect();
    assert_eq!(losses.len(), 40);
    let mean = |part: &[f64]| part.iter().sum::<f64>() / part.len() as f64;
    // It learns on both, and does not restart in between.
    assert!(mean(&losses[15..20]) < 0.9 * mean(&losses[..5]), "{losses:?}");
    assert!(mean(&losses[20..25]) < 1.2 * mean(&losses[15..20]), "{losses:?}");
}

#[test]
fn methods_train_render_and_export_there() {
    let Some(device) = device() else { return };
    let dir = tempfile::tempdir().unwrap();
    let data = dir.path().join("data");
    write_capture(&data, 6, 24).unwrap();
    let data = data.to_str().unwrap();
    // The same with a budget that keeps one pixel of each square.
    let ngp = ["--set", "camera.refine=true", "--set", "sampling.error_map=true", "--set", "data.memory_budget=3000"];
    let small = ["--set", "sampling.rays=64", "--set", "sampling.samples=8", "--set", "sampling.importance=8"];
    // The others train as nerf does; `bench check` compares their losses.
    for (method, sets) in [("ngp", &ngp[..]), ("nerf", &small)] {
        let run = dir.path().join(method);
        let run = run.to_str().unwrap();
        let train = ["train", data, "-o", run, "--device", &device, "--method", method, "--steps", "2", "--set", "field.log2_size=12"];
        let out = diorama(&[&train[..], sets].concat());
        let told = String::from_utf8_lossy(&out.stderr).into_owned();
        assert!(out.status.success(), "{method}: {told}");
        assert_eq!(told.contains("one pixel of each"), method == "ngp", "{told}");
        let scores = |device: &str| {
            let report = json(diorama(&["eval", run, "--device", device, "--json"]));
            let drew = report["device"].as_str().unwrap();
            assert!(if device == "cpu" { drew == "cpu" } else { drew.ends_with(&format!("({device})")) }, "{device}: {drew} drew");
            report["psnr"].as_f64().unwrap()
        };
        let (there, here) = (scores(&device), scores("cpu"));
        assert!((there - here).abs() < 0.02, "{method}: {there} dB there, {here} dB here");
        // The CPU continues from the full state: parameters, corrections, errors.
        let end = json(diorama(&["train", "-o", run, "--resume", "--device", "cpu", "--steps", "3", "--json"]));
        assert_eq!((end["device"].as_str(), end["steps"].as_u64()), (Some("cpu"), Some(3)), "{method}: {end}");
    }
    let run = dir.path().join("ngp");
    let mesh = |device: &str| {
        let file = dir.path().join(format!("{device}.ply"));
        let of = ["export", run.to_str().unwrap(), "-o", file.to_str().unwrap(), "--device", device, "--resolution", "24", "--json"];
        json(diorama(&of))["vertices"].as_u64().unwrap()
    };
    let (there, here) = (mesh(&device), mesh("cpu"));
    assert!(here > 0 && there.abs_diff(here) * 50 <= here, "{there} vertices there, {here} here");
}

#[test]
fn a_device_without_room_gets_half_the_batch_twice_and_then_the_bytes_are_said() {
    let Some(_) = device() else { return };
    let doctor = json(diorama(&["doctor", "--json"]));
    let software = doctor["gpus"].as_array().unwrap().iter().find(|g| g["software"] == true);
    let Some(device) = software.and_then(|g| g["device"].as_str()) else {
        println!("skipped: only software is known to be too small");
        return;
    };
    let dir = tempfile::tempdir().unwrap();
    let (data, run) = (dir.path().join("data"), dir.path().join("run"));
    write_capture(&data, 6, 24).unwrap();
    let train = ["train", data.to_str().unwrap(), "-o", run.to_str().unwrap(), "--device", device, "--steps", "2", "--json"];
    let large = ["--set", "field.log2_size=12", "--set", "sampling.rays=64", "--set", "sampling.batch_samples=90000000"];
    let out = diorama(&[&train[..], &large].concat());
    let told = String::from_utf8_lossy(&out.stderr).into_owned();
    assert_eq!(out.status.code(), Some(1), "{told}");
    assert_eq!(told.matches("the batch is halved; back to step 0").count(), 2, "{told}");
    let error: serde_json::Value = serde_json::from_slice(&out.stdout).unwrap();
    assert_eq!(error["kind"], "memory", "{error}");
    let text = error["error"].as_str().unwrap();
    assert!(["GiB", "--downscale", "--device cpu"].iter().all(|p| text.contains(p)) && !run.exists(), "{text}");
}

const CUBE: &str = "v -1 0 -1\nv 1 0 -1\nv 1 0 1\nv -1 0 1\nv -1 2 -1\nv 1 2 -1\nv 1 2 1\nv -1 2 1\n\
    f 1 2 3 4\nf 5 8 7 6\nf 1 5 6 2\nf 2 6 7 3\nf 3 7 8 4\nf 4 8 5 1\n";
const SCENE: &str = r#"
[[object]]
mesh = "cube.obj"
[light]
sky = { elevation = 40, rotation = 60, intensity = 0.02 }
[camera]
eye = [0, 4, 6]
target = [0, 1, 0]
[render]
size = [48, 32]
spp = 64
bounces = 4
"#;

/// A command of the group `relight` in a folder.
fn relight(folder: &Path, arguments: &[&str]) -> Command {
    let mut c = Command::new(env!("CARGO_BIN_EXE_diorama"));
    c.arg("relight").args(arguments).current_dir(folder);
    c
}

fn folder() -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("cube.obj"), CUBE).unwrap();
    std::fs::write(dir.path().join("scene.toml"), SCENE).unwrap();
    dir
}

/// Mean difference of the bytes of two pictures.
fn difference(a: &Path, b: &Path) -> f64 {
    let [a, b] = [a, b].map(|p| photo::load(p).unwrap().data);
    assert_eq!(a.len(), b.len());
    a.iter().zip(&b).map(|(x, y)| x.abs_diff(*y) as f64).sum::<f64>() / a.len() as f64
}

#[test]
fn pictures_and_turntables_are_traced_there_as_here() {
    let Some(device) = device() else { return };
    let dir = folder();
    for name in [&device[..], "cpu"] {
        let composed = relight(dir.path(), &["compose", "scene.toml", "--device", name, "--json", "-o", &format!("{name}.png")]).output();
        let told = json(composed.unwrap());
        let traced_by = told["device"].as_str().unwrap();
        assert!(if name == "cpu" { traced_by == "cpu" } else { traced_by.ends_with(&format!("({name})")) }, "{name}: {traced_by}");
        let turn = ["turntable", "cube.obj", "--frames", "3", "--turn-model", "--light", "sky:20,60", "--size", "24x16", "--spp", "32"];
        let o = relight(dir.path(), &[&turn[..], &["--device", name, "-o", &format!("{name}.turn")]].concat()).output().unwrap();
        assert!(o.status.success(), "{}", String::from_utf8_lossy(&o.stderr));
    }
    for file in [".png", ".turn/0000.png", ".turn/0001.png"] {
        let [there, here] = [&device[..], "cpu"].map(|name| dir.path().join(format!("{name}{file}")));
        // The same random numbers: only rounding differs.
        assert!(difference(&there, &here) < 0.5, "{file}: {}", difference(&there, &here));
    }
    let [first, second] = ["0000", "0001"].map(|i| dir.path().join(format!("{device}.turn/{i}.png")));
    assert!(difference(&first, &second) > 2.0, "the model turns");
}

#[test]
#[cfg(unix)]
fn an_interrupted_picture_goes_on_to_the_same_bits_there() {
    let Some(device) = device() else { return };
    let dir = folder();
    let long = ["compose", "scene.toml", "--spp", "1024", "--device", &device, "-o"];
    assert!(relight(dir.path(), &[&long[..], &["whole.png"]].concat()).status().unwrap().success());
    let parts = [&long[..], &["parts.png"]].concat();
    for wait in 2.. {
        let mut child = relight(dir.path(), &parts).spawn().unwrap();
        std::thread::sleep(std::time::Duration::from_millis(100 * wait));
        assert!(Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap().success());
        match child.wait().unwrap().code() {
            Some(130) => break,
            // Before the handler is there, the signal ends the program.
            code => assert!(code.is_none(), "{code:?}"),
        }
    }
    assert!(dir.path().join("parts.png.unfinished").exists() && !dir.path().join("parts.png").exists());
    assert!(relight(dir.path(), &parts).status().unwrap().success());
    let read = |name: &str| std::fs::read(dir.path().join(name)).unwrap();
    assert_eq!(read("whole.png"), read("parts.png"));
}
