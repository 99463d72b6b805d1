//! `diorama text train-detector` and `eval-detector`: runs go on after an interruption, scores and ONNX files are written, and what is wrong
//! is refused in one line.

use diorama_data::weights;
use std::path::Path;
use std::process::{Command, Output};

fn run(folder: &Path, arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_diorama")).args(arguments).current_dir(folder).output().unwrap()
}

#[track_caller]
fn json(folder: &Path, arguments: &[&str]) -> serde_json::Value {
    let o = run(folder, &[&["text"], arguments, &["--json"]].concat());
    assert!(o.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&o.stderr));
    serde_json::from_slice(&o.stdout).unwrap()
}

#[track_caller]
fn refused(folder: &Path, arguments: &[&str], expected: &str) {
    let o = run(folder, arguments);
    let text = String::from_utf8_lossy(&o.stderr);
    let errors: Vec<&str> = text.lines().filter(|l| l.starts_with("diorama: ")).collect();
    assert!(o.status.code() == Some(2) && errors.len() == 1 && !text.contains("panicked"), "{arguments:?}: {text}");
    assert!(errors[0].contains(expected), "{expected:?} is not in {:?}", errors[0]);
}

/// Two images with a bright board each.
fn write_set(folder: &Path) {
    for name in ["images", "icdar15"] {
        std::fs::create_dir_all(folder.join(name)).unwrap();
    }
    for i in 0..2usize {
        let is_board = |p: usize| (20..80).contains(&(p % 96)) && (20 + 10 * i..44 + 10 * i).contains(&(p / 96));
        let data = (0..96 * 64).flat_map(|p| [if is_board(p) { 230 } else { 40 + (p * 7 % 23) as u8 }; 3]).collect();
        let image = diorama_geom::ImageU8 { width: 96, height: 64, channels: 3, data };
        diorama_data::photo::save_png(&folder.join(format!("images/shop_{i}.png")), &image).unwrap();
        let (top, bottom) = (20 + 10 * i, 44 + 10 * i);
        let line = format!("20,{top},80,{top},80,{bottom},20,{bottom},CAFE\n");
        std::fs::write(folder.join(format!("icdar15/gt_shop_{i}.txt")), line).unwrap();
    }
}

#[test]
fn a_detector_is_trained_in_parts_scored_and_exported() {
    let dir = tempfile::tempdir().unwrap();
    let d = dir.path();
    write_set(&d.join("ds"));
    let small = ["--batch", "2", "--crop", "64", "--data", "ds", "-o", "db"];
    let train = [&["train-detector", "--steps", "2"], &small[..]].concat();
    assert_eq!(json(d, &train)["steps"], 2);
    assert_eq!(json(d, &["train-detector", "--resume", "--steps", "4", "-o", "db"])["steps"], 4);
    let scores = json(d, &["eval-detector", "--weights", "db", "--data", "ds", "--by-scene", "--onnx", "db.onnx"]);
    assert_eq!((&scores["images"], &scores["labels"], &scores["scenes"][0]["scene"]), (&2.into(), &2.into(), &"shop".into()));
    assert!(scores["instance"]["f"].is_number() && scores["images_per_s"].is_number() && scores.get("clusters").is_none());
    assert!(std::fs::metadata(d.join("db.onnx")).unwrap().len() > 1_000_000);
    let begun = [
        "train-detector",
        "--weights",
        "db/detector.safetensors",
        "--steps",
        "1",
        "--batch",
        "2",
        "--crop",
        "64",
        "--data",
        "ds",
        "-o",
        "fine",
    ];
    assert_eq!(json(d, &begun)["steps"], 1);
    let info = run(d, &["info", "db", "--json"]);
    let info: serde_json::Value = serde_json::from_slice(&info.stdout).unwrap();
    assert_eq!((&info["kind"], &info["model"], &info["steps"]), (&"detector run".into(), &"db".into(), &4.into()));

    let text = |more: &[&'static str]| [&["text"], more].concat();
    refused(d, &[&["text"], &train[..]].concat(), "already holds a run");
    refused(d, &text(&["train-detector", "--resume", "--model", "east", "-o", "db"]), "leave out --model and --backbone");
    refused(d, &text(&["train-detector", "--data", "none"]), "give a folder that holds images/ and icdar15/");
    refused(d, &text(&["train-detector", "--data", "ds", "--crop", "100"]), "crop must be a multiple of 32");
    refused(d, &text(&["train-detector", "--data", "ds", "--model", "craft"]), "expected east or db");
    refused(d, &text(&["eval-detector", "--weights", "db", "--data", "ds", "--by-pose"]), "tells no poses of the words");
    refused(d, &text(&["eval-detector", "--weights", "db", "--data", "ds", "--backbone", "resnet50"]), "leave --backbone out");
    refused(d, &text(&["eval-detector", "--weights", "ds", "--data", "ds"]), "is not a run folder");
    refused(d, &["eval", "db"], "is a run of detector; use diorama text eval-detector --weights");
    std::fs::write(d.join("ds/icdar15/gt_shop_1.txt"), "20,20,80\n").unwrap();
    refused(d, &text(&["train-detector", "--data", "ds", "-o", "new"]), "gt_shop_1.txt: line 1: 3 fields; expected x1,y1");
    assert!(!d.join("new").exists(), "nothing is left of what never began");
}

#[test]
fn weights_of_another_shape_are_named_with_both_shapes() {
    let dir = tempfile::tempdir().unwrap();
    let d = dir.path();
    write_set(&d.join("ds"));
    let train = ["text", "train-detector", "--batch", "2", "--crop", "64", "--data", "ds", "--steps", "1", "-o"];
    assert!(run(d, &[&train[..], &["db"]].concat()).status.success());
    let file = d.join("db/detector.safetensors");
    let metadata = weights::metadata(&file).unwrap();
    let mut arrays = weights::read(&file, &|_| true).unwrap();
    let wrong = arrays.iter_mut().find(|a| a.shape.len() == 4).unwrap();
    let (name, shape) = (wrong.name.clone(), wrong.shape.clone());
    wrong.shape = vec![shape.iter().product(), 1, 1, 1];
    let other = format!("{:?}", wrong.shape);
    weights::save(&d.join("other.safetensors"), &arrays, metadata).unwrap();
    let begun = [&train[..], &["fine", "--weights", "other.safetensors"]].concat();
    for part in ["other.safetensors: ", &name, &other, &format!("{shape:?}")] {
        refused(d, &begun, part);
        refused(d, &["text", "eval-detector", "--weights", "other.safetensors", "--data", "ds"], part);
    }
    assert!(!d.join("fine").exists());
}

#[cfg(unix)]
#[test]
fn an_interrupt_keeps_what_was_learned() {
    let dir = tempfile::tempdir().unwrap();
    let d = dir.path();
    write_set(&d.join("ds"));
    let arguments =
        ["text", "train-detector", "--model", "east", "--steps", "100000", "--batch", "2", "--crop", "64", "--data", "ds", "-o", "east"];
    let mut child = Command::new(env!("CARGO_BIN_EXE_diorama")).args(arguments).current_dir(d).spawn().unwrap();
    let metrics = d.join("east/metrics.jsonl");
    for _ in 0..600 {
        if metrics.exists() {
            break;
        }
        std::thread::sleep(std::time::Duration::from_millis(100));
    }
    let kill = Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap();
    assert!(kill.success());
    assert_eq!(child.wait().unwrap().code(), Some(130));
    assert!(d.join("east/detector.safetensors").is_file());
    let scores = json(d, &["eval-detector", "--weights", "east", "--data", "ds"]);
    assert_eq!(scores["images"], 2);
}
