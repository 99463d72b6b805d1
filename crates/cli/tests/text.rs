//! The text commands: scenes are generated and read again, labels are imported, and what is wrong is refused in one line.

use std::path::Path;
use std::process::{Command, Output};

fn run(folder: &Path, arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_diorama")).arg("text").args(arguments).current_dir(folder).output().unwrap()
}

#[track_caller]
fn refused(folder: &Path, arguments: &[&str], expected: &str) {
    let o = run(folder, arguments);
    let text = String::from_utf8_lossy(&o.stderr);
    let errors: Vec<&str> = text.lines().filter(|l| l.starts_with("diorama: ")).collect();
    assert!(o.status.code() == Some(2) && errors.len() == 1 && !text.contains("panicked"), "{arguments:?}: {text}");
    assert!(errors[0].contains(expected), "{expected:?} is not in {:?}", errors[0]);
}

#[test]
fn generated_scenes_are_captures_whose_labels_other_formats_can_replace() {
    let dir = tempfile::tempdir().unwrap();
    let make = ["make-scenes", "--family", "shelf", "--views", "8", "--pixels", "64x48", "--spp", "2", "--fonts", "shipped", "-o", "signs"];
    let made = run(dir.path(), &[&make[..], &["--json"]].concat());
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    let json: serde_json::Value = serde_json::from_slice(&made.stdout).unwrap();
    assert!(json["photographs"] == 8 && json["scenes"][0] == "shelf-000" && json["interrupted"] == false);
    let scene = dir.path().join("signs/shelf-000");
    let info = Command::new(env!("CARGO_BIN_EXE_diorama")).arg("info").arg(&scene).output().unwrap();
    assert!(info.status.success(), "{}", String::from_utf8_lossy(&info.stderr));
    // The same command has nothing to do; another one is refused.
    assert!(run(dir.path(), &make).status.success());
    refused(dir.path(), &[&make[..], &["--seed", "3"]].concat(), "holds scenes made with other seed; give --force");
    refused(dir.path(), &["make-scenes", "--family", "cave"], "expected room, corridor, street, shelf, pillar");
    refused(dir.path(), &["make-scenes", "--signs", "many"], "expected a number or FROM-TO");
    std::fs::create_dir(dir.path().join("gt")).unwrap();
    std::fs::write(dir.path().join("gt/gt_002.txt"), "4,4,30,4,30,12,4,12,CAFE\n").unwrap();
    let annotate = ["annotate", "signs/shelf-000", "gt", "--format", "icdar15"];
    refused(dir.path(), &annotate, "labels.jsonl: is there already; give --force");
    let o = run(dir.path(), &[&annotate[..], &["--force", "--json"]].concat());
    let json: serde_json::Value = serde_json::from_slice(&o.stdout).unwrap();
    assert!(o.status.success() && json["images"] == 1 && json["regions"] == 1, "{json}");
    let labels = std::fs::read_to_string(scene.join("labels.jsonl")).unwrap();
    assert!(labels.contains("images/002.png") && labels.contains("CAFE") && labels.lines().count() == 1);
    std::fs::write(dir.path().join("gt/gt_002.txt"), "4,4,30,4,30,12,4,99,CAFE\n").unwrap();
    refused(
        dir.path(),
        &[&annotate[..], &["--force"]].concat(),
        "gt_002.txt: line 1: vertex 3 at 4, 99 is outside of the photograph of 64×48",
    );
    assert_eq!(std::fs::read_to_string(scene.join("labels.jsonl")).unwrap(), labels);
    refused(
        dir.path(),
        &["annotate", "signs/shelf-000", "gt", "--format", "voc", "--force"],
        "expected labelme, ppocr, icdar13, icdar15, mlt17",
    );
}

#[test]
fn a_run_is_trained_scored_and_refuses_what_it_cannot_learn_from() {
    let dir = tempfile::tempdir().unwrap();
    let make = ["make-scenes", "--family", "shelf", "--views", "8", "--pixels", "64x48", "--spp", "2", "--fonts", "shipped", "-o", "signs"];
    assert!(run(dir.path(), &make).status.success());
    let labels = dir.path().join("signs/shelf-000/labels.jsonl");
    let kept = std::fs::read_to_string(&labels).unwrap();
    let train = ["train", "signs/shelf-000", "--preset", "ci", "--device", "cpu", "--steps", "4", "-o", "run"];
    std::fs::write(&labels, kept.replace("images/", "other/")).unwrap();
    refused(dir.path(), &train, "the capture has no such photograph; its first is images/000.png");
    std::fs::remove_file(&labels).unwrap();
    refused(dir.path(), &train, "labels.jsonl: is missing; import labels with");
    assert!(!dir.path().join("run").exists(), "a refused run leaves nothing");
    std::fs::write(&labels, kept).unwrap();
    let o = run(dir.path(), &[&train[..], &["--no-s3im", "--no-dist", "--no-pe", "--json"]].concat());
    assert!(o.status.success(), "{}", String::from_utf8_lossy(&o.stderr));
    let config = std::fs::read_to_string(dir.path().join("run/config.toml")).unwrap();
    for line in ["application = \"text\"", "s3im = 0.0", "distortion = 0.0", "waves = 0"] {
        assert!(config.lines().any(|l| l == line), "{line} is not in {config}");
    }
    refused(dir.path(), &["train", "--resume", "--no-pe", "-o", "run"], "leave out --no-s3im, --no-dist and --no-pe");
    let o = run(dir.path(), &["eval", "run", "--json"]);
    let json: serde_json::Value = serde_json::from_slice(&o.stdout).unwrap();
    assert!(json["views"] == 1 && json["psnr"].as_f64().is_some_and(f64::is_finite) && json["miou"].is_number(), "{json}");
    assert!(dir.path().join("run/eval").read_dir().unwrap().count() == 1);
}
