//! The relight commands under `kill -9` and Ctrl-C: killed runs end as if they had not been, and nothing half-written is left.

use diorama_data::import::{self, ImportOptions};
use diorama_data::{checkpoint, model_file, photo, sparse_ply, transforms_json};
use diorama_geom::capture::SparsePoint;
use diorama_geom::glam::DVec3;
use diorama_geom::{Camera, ImageU8, Pose};
use diorama_pipelines::relight::synth::{self, Place, SynthOptions};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

const LIMIT: Duration = Duration::from_secs(120);
const CUBE: &str = "v -1 0 -1\nv 1 0 -1\nv 1 0 1\nv -1 0 1\nv -1 2 -1\nv 1 2 -1\nv 1 2 1\nv -1 2 1\n\
    f 1 2 3 4\nf 5 8 7 6\nf 1 5 6 2\nf 2 6 7 3\nf 3 7 8 4\nf 4 8 5 1\n";
/// A scene model so small that a step takes a few hundredths of a second.
const SMALL_SCENE: [&str; 8] = [
    "sampling.rays=512",
    "sampling.max_samples=16",
    "sampling.occupancy_resolution=32",
    "field.log2_size=12",
    "light.model=sun",
    "light.sun_cells=32",
    "run.log_every=1",
    "run.save_every_seconds=0.01",
];
/// Photographs of a cube in an even light.
const OBJECT: [&str; 12] =
    ["synth", "--object", "cube.obj", "--size", "48x48", "--spp", "2", "--light", "uniform", "--unseen-light", "uniform", "--views"];

fn start(folder: &Path, arguments: &[&str]) -> Child {
    let said = std::fs::File::create(folder.join("said")).unwrap();
    let mut c = Command::new(env!("CARGO_BIN_EXE_diorama"));
    c.arg("relight").args(arguments).current_dir(folder).stdout(Stdio::null()).stderr(said).spawn().unwrap()
}

#[track_caller]
fn done(folder: &Path, arguments: &[&str]) {
    let status = start(folder, arguments).wait().unwrap();
    assert!(status.success(), "{arguments:?}: {}", std::fs::read_to_string(folder.join("said")).unwrap());
}

/// Starts a command, and returns it still running when `sign` is seen.
#[track_caller]
fn until(folder: &Path, arguments: &[&str], sign: impl Fn() -> bool) -> Child {
    let mut child = start(folder, arguments);
    let end = Instant::now() + LIMIT;
    while !sign() {
        let is_over = child.try_wait().unwrap().is_some() || Instant::now() > end;
        assert!(!is_over, "{arguments:?}: no sign: {}", std::fs::read_to_string(folder.join("said")).unwrap());
        std::thread::sleep(Duration::from_millis(2));
    }
    child
}

fn folder() -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("cube.obj"), CUBE).unwrap();
    dir
}

/// A cube from five sides, in two lights.
fn street(folder: &Path) {
    let model = model_file::read(&folder.join("cube.obj")).unwrap().model;
    let pose = |i: usize| {
        let turn = i as f64 * 1.2;
        Pose::look_at(DVec3::new(6.0 * turn.cos(), 6.0 * turn.sin(), 3.0), DVec3::new(0.0, 0.0, 1.0), DVec3::Z)
    };
    let place = Place::around(model, (0..5).map(|i| (Camera::pinhole(24, 16, 0.8), pose(i))).collect());
    let options = SynthOptions { views: 5, lights: 2, size: (24, 16), samples: 4, seed: 0 };
    let at = folder.join("street");
    synth::generate(&at, &place, &options, false, &AtomicBool::new(false), &mut |_| {}).unwrap();
    // Points of the cube's top, which all photographs show.
    let capture = import::import(&at, &ImportOptions::default()).unwrap();
    let top = |i: u32| DVec3::new((i % 20) as f64 / 10.0 - 0.95, (i / 20) as f64 / 10.0 - 0.95, 2.0);
    let all: Vec<u32> = (0..capture.frames.len() as u32).collect();
    let points: Vec<SparsePoint> =
        (0..400).map(|i| SparsePoint { position: top(i), color: [128; 3], error: 0.1, frames: all.clone() }).collect();
    sparse_ply::write(&at.join("points.ply"), &points, &capture.frames, &at).unwrap();
    transforms_json::write(&at.join("transforms.json"), &at, &capture, Some("points.ply")).unwrap();
    for split in ["train", "test"] {
        std::fs::remove_file(at.join(format!("transforms_{split}.json"))).unwrap();
    }
}

fn settings<'a>(fixed: &[&'a str], set: &[&'a str]) -> Vec<&'a str> {
    fixed.iter().copied().chain(set.iter().flat_map(|s| ["--set", s])).collect()
}

/// Steps of the last checkpoint, if there is one.
fn steps(run: &Path) -> u64 {
    let file = checkpoint::latest(&run.join("checkpoints"));
    checkpoint::read(&file).map_or(0, |c| c.metadata["step"].parse().unwrap())
}

/// Kills a run with SIGKILL once each of the steps is saved, and goes on; the last checkpoint must be that of `whole`.
fn killed_at(folder: &Path, begin: &[&str], resume: &[&str], [killed, whole]: [&Path; 2], at: &[u64]) {
    for (i, step) in at.iter().enumerate() {
        let mut child = until(folder, if i == 0 { begin } else { resume }, || steps(killed) >= *step);
        child.kill().unwrap();
        let status = child.wait().unwrap();
        assert!(status.code().is_none(), "it was over before it was killed at step {step}: {status}");
    }
    done(folder, resume);
    same([killed, whole]);
}

/// Two runs whose last checkpoints must be equal bit by bit.
fn same([killed, whole]: [&Path; 2]) {
    let read = |run: &Path| {
        let mut c = checkpoint::read(&checkpoint::latest(&run.join("checkpoints"))).unwrap();
        c.tensors.sort_by(|a, b| a.0.cmp(&b.0));
        // How long it took differs.
        c.metadata.remove("seconds_bits");
        c
    };
    let (got, want) = (read(killed), read(whole));
    assert_eq!((got.metadata, got.tensors.len()), (want.metadata, want.tensors.len()));
    for (a, b) in got.tensors.iter().zip(&want.tensors) {
        let same = a.2.len() == b.2.len() && a.2.iter().zip(&b.2).all(|(x, y)| x.to_bits() == y.to_bits());
        assert!(a.0 == b.0 && same, "{} differs", a.0);
    }
}

#[test]
fn a_killed_run_of_the_scene_model_ends_with_the_same_bits() {
    let dir = folder();
    let at = dir.path();
    street(at);
    let train = |run| settings(&["train", "street", "--preset", "ci", "--steps", "80", "--threads", "2", "-o", run], &SMALL_SCENE);
    done(at, &train("whole"));
    assert!(std::fs::read_to_string(at.join("said")).unwrap().contains("by sparse points"));
    // While surfaces are learned, and when light is told apart.
    killed_at(at, &train("killed"), &["train", "--resume", "-o", "killed"], [&at.join("killed"), &at.join("whole")], &[4, 60]);
    // Interrupted when light is just being told apart, which takes longest on many photographs.
    let tells = || std::fs::read_to_string(at.join("said")).is_ok_and(|t| t.contains("telling light"));
    interrupted(at, &train("told"), tells, "told/curves.png.partial");
    assert!(steps(&at.join("told")) < 80);
    done(at, &["train", "--resume", "-o", "told"]);
    same([&at.join("told"), &at.join("whole")]);
}

#[test]
fn a_killed_run_of_the_object_model_ends_with_the_same_bits() {
    let dir = folder();
    let at = dir.path();
    done(at, &[&OBJECT[..], &["16", "-o", "data"]].concat());
    let object = ["object", "data", "--preset", "ci", "--steps", "8", "--mc", "--texture", "64", "--score-spp", "0", "--threads", "2"];
    let set = ["run.log_every=1", "run.save_every_seconds=0.01"];
    let begin = |run, glb| settings(&[&object[..], &["--run", run, "-o", glb]].concat(), &set);
    // The name of a file is in it.
    for folder in ["a", "b"] {
        std::fs::create_dir(at.join(folder)).unwrap();
    }
    done(at, &begin("whole", "a/o.glb"));
    let resume = ["object", "--resume", "--run", "killed", "-o", "b/o.glb", "--score-spp", "0"];
    // Once in each stage.
    killed_at(at, &begin("killed", "b/o.glb"), &resume, [&at.join("killed"), &at.join("whole")], &[3, 11, 19]);
    let glb = |name: &str| std::fs::read(at.join(name)).unwrap();
    assert!(glb("a/o.glb") == glb("b/o.glb"), "the objects differ");
}

fn files(folder: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).unwrap().flatten().map(|e| e.path());
    entries.flat_map(|p| if p.is_dir() { files(&p) } else { vec![p] }).collect()
}

/// Interrupts a command once `sign` is seen: it says so, and neither `unfinished` nor any temporary file is there.
#[track_caller]
fn interrupted(folder: &Path, arguments: &[&str], sign: impl Fn() -> bool, unfinished: &str) {
    let mut child = until(folder, arguments, sign);
    assert!(Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap().success());
    let said = || std::fs::read_to_string(folder.join("said")).unwrap();
    assert_eq!(child.wait().unwrap().code(), Some(130), "{arguments:?}: {}", said());
    assert!(!folder.join(unfinished).exists(), "{arguments:?} left {unfinished}");
    for file in files(folder) {
        let extension = file.extension().unwrap_or_default().to_string_lossy().into_owned();
        assert!(!["partial", "tmp"].contains(&&extension[..]), "{arguments:?} left {}", file.display());
        if extension == "png" {
            photo::load(&file).unwrap_or_else(|e| panic!("{arguments:?} left half a picture: {e}"));
        }
    }
}

fn has_files(folder: &Path) -> bool {
    std::fs::read_dir(folder).is_ok_and(|mut d| d.any(|e| e.is_ok_and(|e| e.path().extension().is_some_and(|e| e == "png"))))
}

/// Twenty large photographs with poses, of two sessions.
fn posed(folder: &Path) {
    std::fs::create_dir_all(folder.join("images")).unwrap();
    let noise = (0..900 * 700 * 3).map(|i: usize| (i.wrapping_mul(2_654_435_761) >> 13) as u8).collect();
    let picture = folder.join("images/0.png");
    photo::save_png(&picture, &ImageU8 { width: 900, height: 700, channels: 3, data: noise }).unwrap();
    let frame = |i: usize| {
        let file = format!("images/{i}.png");
        if i > 0 {
            std::fs::copy(&picture, folder.join(&file)).unwrap();
        }
        let p = Pose::look_at(DVec3::new((0.3 * i as f64).cos(), (0.3 * i as f64).sin(), 0.2) * 0.8, DVec3::ZERO, DVec3::Z).flip_y_z();
        let row = |k: usize| [p.rotation.x_axis[k], p.rotation.y_axis[k], p.rotation.z_axis[k], p.translation[k]];
        serde_json::json!({ "file_path": file, "session": i % 2, "transform_matrix": [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]] })
    };
    let all = serde_json::json!({ "camera_angle_x": 0.9, "frames": (0..20).map(frame).collect::<Vec<_>>() });
    std::fs::write(folder.join("transforms.json"), all.to_string()).unwrap();
}

#[test]
fn photographs_and_pictures_that_were_interrupted_are_whole_or_not_there() {
    let dir = folder();
    let at = dir.path();
    interrupted(at, &[&OBJECT[..], &["4000", "-o", "data"]].concat(), || has_files(&at.join("data/images")), "data/transforms_train.json");
    // What is there of it is in nobody's way.
    done(at, &[&OBJECT[..], &["16", "-o", "data"]].concat());
    posed(&at.join("posed"));
    let prepare = ["prepare", "posed", "--sfm", "none", "--max-side", "400", "-o", "site"];
    interrupted(at, &prepare, || has_files(&at.join("site/images")), "site/transforms.json");
    done(at, &[&prepare[..], &["--resume"]].concat());
    assert_eq!(files(&at.join("site/images")).len(), 20);
    let turn = ["turntable", "cube.obj", "--frames", "4000", "--size", "48x48", "--spp", "4", "-o", "turn"];
    interrupted(at, &turn, || has_files(&at.join("turn")), "turn/3999.png");
}

#[test]
fn runs_and_meshes_that_were_interrupted_are_whole_or_not_there() {
    let dir = folder();
    let at = dir.path();
    street(at);
    let train = settings(&["train", "street", "--preset", "ci", "--steps", "100000", "-o", "run"], &SMALL_SCENE);
    interrupted(at, &train, || at.join("run/metrics.jsonl").exists(), "run/curves.png.partial");
    checkpoint::load(&at.join("run/checkpoints")).unwrap();
    // A short run to its end.
    done(at, &settings(&["train", "street", "--preset", "ci", "--steps", "200", "-o", "short"], &SMALL_SCENE));
    let mesh = ["mesh", "short", "-o", "site.glb", "--resolution", "320", "--level", "0.01"];
    let is_sampling = || std::fs::read_to_string(at.join("said")).is_ok_and(|t| t.contains("density"));
    interrupted(at, &mesh, is_sampling, "site.glb");
    done(at, &[&OBJECT[..], &["16", "-o", "data"]].concat());
    let object = ["object", "data", "--preset", "ci", "--steps", "100000", "--run", "object", "-o", "object.glb"];
    interrupted(at, &object, || at.join("object/metrics.jsonl").exists(), "object.glb");
    checkpoint::load(&at.join("object/checkpoints")).unwrap();
}

#[test]
fn a_scene_model_that_does_not_fit_is_refused() {
    let dir = folder();
    street(dir.path());
    let call = settings(&["train", "street", "--preset", "ci", "--steps", "4", "-o", "run"], &SMALL_SCENE);
    let mut c = Command::new(env!("CARGO_BIN_EXE_diorama"));
    let o = c.arg("relight").args(call).current_dir(dir.path()).env("DIORAMA_MEMORY", "1MiB").output().unwrap();
    let text = String::from_utf8_lossy(&o.stderr);
    assert!(["out of memory: the field", "1 MiB are free", "field.log2_size=11"].iter().all(|w| text.contains(w)), "{text}");
    assert!(o.status.code() == Some(1) && !dir.path().join("run").exists());
}
