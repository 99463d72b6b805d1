//! Bad input gives one line that names file, field and remedy, and exit code 2, and leaves nothing behind.

use diorama_pipelines::object::quickstart::write_capture;
use std::path::Path;
use std::process::{Command, Output};
use std::sync::OnceLock;

fn diorama(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_diorama")).args(args).output().unwrap()
}

/// A valid capture, made once.
fn good() -> &'static Path {
    static GOOD: OnceLock<tempfile::TempDir> = OnceLock::new();
    GOOD.get_or_init(|| {
        let dir = tempfile::tempdir().unwrap();
        write_capture(dir.path(), 8, 24).unwrap();
        dir
    })
    .path()
}

/// A copy of the valid capture for a test to damage.
fn copy() -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    std::fs::create_dir(dir.path().join("images")).unwrap();
    std::fs::copy(good().join("transforms.json"), dir.path().join("transforms.json")).unwrap();
    for e in std::fs::read_dir(good().join("images")).unwrap().flatten() {
        std::fs::copy(e.path(), dir.path().join("images").join(e.file_name())).unwrap();
    }
    dir
}

fn edit(dir: &Path, change: impl FnOnce(&mut serde_json::Value)) {
    let file = dir.join("transforms.json");
    let mut json: serde_json::Value = serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
    change(&mut json);
    std::fs::write(file, json.to_string()).unwrap();
}

/// Trains on `data` and checks that it is refused.
#[track_caller]
fn refused(data: &Path, extra: &[&str], expected: &[&str]) {
    let out = tempfile::tempdir().unwrap();
    let run = out.path().join("run");
    let mut args = vec!["train", data.to_str().unwrap(), "--out", run.to_str().unwrap(), "--steps", "1"];
    args.extend(extra);
    check(&diorama(&args), expected);
    assert!(!run.exists(), "something was left behind");
}

#[track_caller]
fn check(o: &Output, expected: &[&str]) {
    let text = String::from_utf8_lossy(&o.stderr);
    let errors: Vec<&str> = text.lines().filter(|l| l.starts_with("diorama: ")).collect();
    assert_eq!(o.status.code(), Some(2), "{text}");
    assert_eq!(errors.len(), 1, "one line: {text}");
    assert!(!text.contains("panicked"), "{text}");
    for e in expected {
        assert!(errors[0].contains(e), "{e:?} is not in {:?}", errors[0]);
    }
}

/// Damages the JSON, then expects an error that names the damage.
#[track_caller]
fn json_refused(expected: &[&str], change: impl FnOnce(&mut serde_json::Value)) {
    let dir = copy();
    edit(dir.path(), change);
    let mut all = vec!["transforms.json"];
    all.extend(expected);
    refused(dir.path(), &[], &all);
}

#[test]
fn the_good_capture_trains() {
    let out = tempfile::tempdir().unwrap();
    let run = out.path().join("a run ü");
    let o = diorama(&[
        "train",
        good().to_str().unwrap(),
        "--out",
        run.to_str().unwrap(),
        "--steps",
        "2",
        "--set",
        "field.log2_size=10",
        "--json",
    ]);
    assert!(o.status.success(), "{}", String::from_utf8_lossy(&o.stderr));
    let json: serde_json::Value = serde_json::from_slice(o.stdout.split(|b| *b == b'\n').rfind(|l| !l.is_empty()).unwrap()).unwrap();
    for key in ["run", "method", "device", "steps", "seconds", "rays", "samples", "rays_per_s", "samples_per_s", "loss", "psnr_train"] {
        assert!(json.get(key).is_some(), "{key} is missing: {json}");
    }
    for file in [
        "config.toml",
        "capture.json",
        "command.txt",
        "metrics.jsonl",
        "events.tfevents",
        "curves.svg",
        "curves.png",
        "checkpoints/latest.safetensors",
    ] {
        assert!(run.join(file).exists(), "{file}");
    }
    let o = diorama(&["eval", run.to_str().unwrap(), "--json"]);
    let json: serde_json::Value = serde_json::from_slice(&o.stdout).unwrap();
    for key in ["views", "psnr", "ssim", "mse", "psnr_min", "lpips"] {
        assert!(json.get(key).is_some(), "{key} is missing: {json}");
    }
}

#[test]
fn folders_without_a_capture() {
    refused(Path::new("/nonexistent/capture"), &[], &["/nonexistent/capture", "does not exist"]);
    let empty = tempfile::tempdir().unwrap();
    refused(empty.path(), &[], &["transforms.json", "COLMAP"]);
}

#[test]
fn json_that_is_not_an_object_cut_short_or_nested_too_deep() {
    let dir = copy();
    let file = dir.path().join("transforms.json");
    let whole = std::fs::read(&file).unwrap();
    std::fs::write(&file, "[1, 2]").unwrap();
    refused(dir.path(), &[], &["transforms.json", "not a JSON object"]);
    std::fs::write(&file, &whole[..whole.len() / 2]).unwrap();
    refused(dir.path(), &[], &["transforms.json", "ends too early"]);
    std::fs::write(&file, format!("{{\"frames\":{}{}}}", "[".repeat(100_000), "]".repeat(100_000))).unwrap();
    refused(dir.path(), &[], &["transforms.json", "recursion limit"]);
    std::fs::write(&file, b"").unwrap();
    refused(dir.path(), &[], &["transforms.json"]);
}

#[test]
fn frames_missing_of_the_wrong_type_or_too_few() {
    json_refused(&["frames: missing"], |j| {
        j.as_object_mut().unwrap().remove("frames");
    });
    json_refused(&["frames", "expected a list"], |j| j["frames"] = "many".into());
    json_refused(&["frames[0].file_path"], |j| j["frames"][0]["file_path"] = 7.into());
    let dir = copy();
    edit(dir.path(), |j| j["frames"].as_array_mut().unwrap().truncate(2));
    refused(dir.path(), &[], &["2 usable views", "at least 3"]);
    let dir = copy();
    std::fs::remove_dir_all(dir.path().join("images")).unwrap();
    refused(dir.path(), &[], &["0 usable views", "8 listed images are missing"]);
}

#[test]
fn photographs_that_cannot_be_decoded() {
    let dir = copy();
    let image = dir.path().join("images/view_03.png");
    let whole = std::fs::read(&image).unwrap();
    for (bytes, expected) in [(&b"no image"[..], "cannot be decoded"), (b"", "0 bytes"), (&whole[..whole.len() / 2], "ends early")] {
        std::fs::write(&image, bytes).unwrap();
        refused(dir.path(), &[], &["view_03.png", expected]);
    }
}

#[test]
fn a_photograph_that_claims_to_be_huge() {
    let dir = copy();
    let image = dir.path().join("images/view_03.png");
    let mut png = std::fs::read(&image).unwrap();
    png[16..20].copy_from_slice(&100_000u32.to_be_bytes());
    png[20..24].copy_from_slice(&100_000u32.to_be_bytes());
    let crc =
        !png[12..29].iter().fold(!0u32, |c, b| (0..8).fold(c ^ *b as u32, |c, _| if c & 1 == 1 { c >> 1 ^ 0xedb8_8320 } else { c >> 1 }));
    png[29..33].copy_from_slice(&crc.to_be_bytes());
    std::fs::write(&image, png).unwrap();
    refused(dir.path(), &[], &["view_03.png", "limit"]);
}

#[test]
fn sizes_that_do_not_match() {
    let dir = copy();
    edit(dir.path(), |j| j["frames"][3]["w"] = 40.into());
    refused(dir.path(), &[], &["view_03.png", "24×24", "40×24"]);
    let dir = copy();
    let mask = diorama_geom::ImageU8 { width: 24, height: 36, channels: 1, data: vec![255; 24 * 36] };
    diorama_data::photo::save_png(&dir.path().join("mask.png"), &mask).unwrap();
    edit(dir.path(), |j| j["frames"][1]["mask_path"] = "mask.png".into());
    refused(dir.path(), &[], &["mask.png", "24×36", "24×24"]);
}

#[test]
fn a_mask_that_cannot_be_read() {
    let dir = copy();
    std::fs::create_dir(dir.path().join("masks")).unwrap();
    std::fs::write(dir.path().join("masks/view_03.jpg"), b"no picture").unwrap();
    refused(dir.path(), &[], &["masks/view_03.jpg", "decoded"]);
    refused(copy().path(), &["--mask", "perhaps"], &["mask", "use, invert or ignore"]);
    refused(copy().path(), &["--mask-meaning", "thing"], &["auto, object, unknown or classes"]);
}

#[test]
fn a_mask_that_is_not_there() {
    json_refused(&["frames[1].mask_path", "does not exist"], |j| j["frames"][1]["mask_path"] = "gone.png".into());
}

#[test]
fn poses_that_are_zero_broken_stretched_or_mirrored() {
    let set = |k: usize, v: serde_json::Value| move |j: &mut serde_json::Value| j["frames"][2]["transform_matrix"][k % 3][k / 3] = v;
    json_refused(&["frames[2].transform_matrix", "zero"], |j| {
        for r in 0..3 {
            for c in 0..3 {
                j["frames"][2]["transform_matrix"][r][c] = 0.into();
            }
        }
    });
    json_refused(&["frames[2].transform_matrix", "not a finite 32-bit number"], set(0, serde_json::Value::Null));
    json_refused(&["frames[2].transform_matrix", "not rigid"], set(4, 3.5.into()));
    json_refused(&["frames[2].transform_matrix", "mirrors"], |j| {
        for r in 0..3 {
            let v = j["frames"][2]["transform_matrix"][r][0].as_f64().unwrap();
            j["frames"][2]["transform_matrix"][r][0] = (-v).into();
        }
    });
    json_refused(&["frames[2].transform_matrix", "rows of 4"], |j| {
        j["frames"][2]["transform_matrix"] = serde_json::json!([[1, 2], [3, 4]])
    });
    json_refused(&["frames[2].transform_matrix", "missing"], |j| {
        j["frames"][2].as_object_mut().unwrap().remove("transform_matrix");
    });
}

#[test]
fn cameras_that_all_stand_at_one_place() {
    let dir = copy();
    edit(dir.path(), |j| {
        let first = j["frames"][0]["transform_matrix"].clone();
        j["frames"].as_array_mut().unwrap().iter_mut().for_each(|f| f["transform_matrix"] = first.clone());
    });
    refused(dir.path(), &[], &["same position"]);
}

#[test]
fn intrinsics_that_make_no_sense() {
    json_refused(&["camera_model", "KANNALA", "OPENCV_FISHEYE"], |j| j["frames"][0]["camera_model"] = "KANNALA".into());
    json_refused(&["frames[0].fl_x", "greater than 0"], |j| j["frames"][0]["fl_x"] = (-5).into());
    json_refused(&["frames[0].w", "expected a number"], |j| j["frames"][0]["w"] = "wide".into());
    json_refused(&["fl_x: missing"], |j| {
        for key in ["fl_x", "fl_y"] {
            j["frames"][0].as_object_mut().unwrap().remove(key);
        }
    });
    json_refused(&["aabb_scale", "power of two"], |j| j["aabb_scale"] = 3.into());
    let dir = copy();
    let file = dir.path().join("transforms.json");
    let text = std::fs::read_to_string(&file).unwrap();
    let at = text.find("\"fl_x\":").unwrap();
    let end = at + text[at..].find(',').unwrap();
    std::fs::write(&file, format!("{}\"fl_x\": 1e39{}", &text[..at], &text[end..])).unwrap();
    refused(dir.path(), &[], &["fl_x", "finite 32-bit"]);
}

#[test]
fn paths_that_leave_the_dataset() {
    for path in ["../../etc/passwd", "/etc/passwd", "C:\\secret.png", "\\\\server\\share.png"] {
        json_refused(&["frames[0].file_path", "leads out of the dataset"], |j| j["frames"][0]["file_path"] = path.into());
    }
    #[cfg(unix)]
    {
        let dir = copy();
        let outside = tempfile::tempdir().unwrap();
        std::fs::copy(good().join("images/view_00.png"), outside.path().join("x.png")).unwrap();
        std::os::unix::fs::symlink(outside.path().join("x.png"), dir.path().join("images/link.png")).unwrap();
        edit(dir.path(), |j| j["frames"][0]["file_path"] = "images/link.png".into());
        refused(dir.path(), &[], &["leads out of the dataset"]);
    }
}

#[test]
fn flags_and_configuration() {
    let g = good();
    for (extra, expected) in [
        (&["--method", "nurf"][..], "ngp, nerf, mlp, baseline"),
        (&["--split", "every:1"], "every:N"),
        (&["--split", "1:2:3"], "every:N"),
        (&["--background", "green"], "learned"),
        (&["--device", "cuda"], "cuda"),
        (&["--downscale", "0"], "at least 1"),
        (&["--threads", "0"], "at least 1"),
        (&["--seconds", "-4"], "greater than 0"),
        (&["--set", "loss.distorsion=1"], "did you mean loss.distortion"),
        (&["--set", "field.features=3"], "features must be"),
        (&["--set", "nonsense"], "KEY=VALUE"),
        (&["--format", "zip"], "expected transforms"),
        (&["--preset", "poster"], "report"),
        (&["--config", "/nonexistent.toml"], "/nonexistent.toml"),
        (&["--method", "mlp", "--set", "field.appearance=4"], "appearance"),
    ] {
        refused(g, extra, &[expected]);
    }
}

#[test]
fn folders_of_runs() {
    let out = tempfile::tempdir().unwrap();
    let run = out.path().join("run");
    let r = run.to_str().unwrap();
    let train = |extra: &[&str]| {
        let mut a = vec!["train", good().to_str().unwrap(), "--out", r, "--steps", "2", "--set", "field.log2_size=10"];
        a.extend(extra);
        diorama(&a)
    };
    check(&diorama(&["eval", r]), &["not a run folder"]);
    assert!(train(&[]).status.success());
    let before = std::fs::read(run.join("checkpoints/latest.safetensors")).unwrap();
    check(&train(&[]), &["already holds a run", "--resume"]);
    assert_eq!(std::fs::read(run.join("checkpoints/latest.safetensors")).unwrap(), before);
    // A forced run that cannot start leaves the earlier run unchanged.
    let spoiled = copy();
    std::fs::write(spoiled.path().join("images/view_03.png"), b"").unwrap();
    check(&diorama(&["train", spoiled.path().to_str().unwrap(), "--out", r, "--force", "--steps", "1"]), &["0 bytes"]);
    assert_eq!(std::fs::read(run.join("checkpoints/latest.safetensors")).unwrap(), before);
    check(&diorama(&["train", "--out", r, "--resume", "--method", "nerf"]), &["--method cannot change"]);
    check(&diorama(&["train", "/elsewhere", "--out", r, "--resume"]), &["was trained on"]);
    check(&diorama(&["render", r, "--path", "loop"]), &["orbit, spiral"]);
    check(&diorama(&["render", r, "--size", "9"]), &["WIDTHxHEIGHT"]);
    check(&diorama(&["render", r, "--layers", "rgb,heat"]), &["heat"]);
    check(&diorama(&["export", r, "-o", out.path().join("a.docx").to_str().unwrap()]), &["glb, obj, ply, stl, usdz or dae"]);
    check(&diorama(&["export", r, "-o", "/nonexistent/a.glb"]), &["/nonexistent", "not a folder"]);
    check(&diorama(&["export", r, "-o", out.path().join("a.glb").to_str().unwrap(), "--clip", "1,2,3"]), &["--clip"]);
    check(&diorama(&["export", r, "-o", out.path().join("a.glb").to_str().unwrap(), "--level", "1e9"]), &["mesh is empty", "--level"]);
    assert!(!out.path().join("a.glb").exists());
    std::fs::write(out.path().join("b.glb"), b"mine").unwrap();
    check(&diorama(&["export", r, "-o", out.path().join("b.glb").to_str().unwrap()]), &["b.glb", "--force"]);
    assert_eq!(std::fs::read(out.path().join("b.glb")).unwrap(), b"mine");
    // A damaged checkpoint without a previous one, and a checkpoint of another version.
    let _ = std::fs::remove_file(run.join("checkpoints/previous.safetensors"));
    std::fs::write(run.join("checkpoints/latest.safetensors"), &before[..before.len() - 5]).unwrap();
    check(&diorama(&["eval", r]), &["latest.safetensors", "not a whole checkpoint"]);
    let at = before.windows(13).position(|w| w == b"\"version\":\"1\"").unwrap();
    let mut other = before.clone();
    other[at + 11] = b'7';
    std::fs::write(run.join("checkpoints/latest.safetensors"), other).unwrap();
    check(&diorama(&["eval", r]), &["version 7"]);
    std::fs::remove_dir_all(run.join("checkpoints")).unwrap();
    check(&diorama(&["eval", r]), &["no checkpoint yet"]);
    let file = out.path().join("file");
    std::fs::write(&file, b"x").unwrap();
    check(&diorama(&["train", good().to_str().unwrap(), "--out", file.to_str().unwrap(), "--steps", "1"]), &["is a file"]);
    // A folder in use by another process.
    let lock = std::fs::File::create(run.join(".lock")).unwrap();
    lock.lock().unwrap();
    check(&diorama(&["train", "--out", r, "--resume"]), &["in use by another process"]);
}

#[test]
fn usage_errors_exit_with_two_and_help_with_zero() {
    assert_eq!(diorama(&["trane"]).status.code(), Some(2));
    assert_eq!(diorama(&["train", "--what"]).status.code(), Some(2));
    assert_eq!(diorama(&["--help"]).status.code(), Some(0));
    let o = diorama(&["train", "--help"]);
    assert!(String::from_utf8_lossy(&o.stdout).contains("Examples:"));
}

#[test]
fn errors_are_json_where_asked() {
    let o = diorama(&["eval", "/nonexistent", "--json"]);
    let json: serde_json::Value = serde_json::from_slice(&o.stdout).unwrap();
    assert_eq!((json["kind"].as_str(), json["exit_code"].as_i64()), (Some("input"), Some(2)));
}

#[test]
fn doctor_names_what_the_contract_asks_for() {
    let o = diorama(&["doctor", "--json"]);
    let json: serde_json::Value = serde_json::from_slice(&o.stdout).unwrap();
    for key in ["cpu_features", "cores", "memory_bytes", "devices", "ffmpeg", "colmap", "test_data"] {
        assert!(json.get(key).is_some(), "{key}");
    }
}

#[test]
fn poses_bounds_of_another_shape() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::create_dir(dir.path().join("images")).unwrap();
    std::fs::copy(good().join("images/view_00.png"), dir.path().join("images/a.png")).unwrap();
    let header = format!("{:<117}\n", "{'descr': '<f8', 'fortran_order': False, 'shape': (1, 15), }");
    let npy = [&b"\x93NUMPY\x01\x00\x76\x00"[..], header.as_bytes(), &[0; 120]].concat();
    std::fs::write(dir.path().join("poses_bounds.npy"), npy).unwrap();
    refused(dir.path(), &[], &["poses_bounds.npy", "[1, 15]", "[images, 17]"]);
}
