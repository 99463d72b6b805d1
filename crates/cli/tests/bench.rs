//! `diorama bench`: what it prints, and that it leaves nothing behind.

use std::path::Path;
use std::process::{Command, Output};

fn diorama(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_diorama")).args(args).output().expect("diorama runs")
}

fn json(o: &Output) -> serde_json::Value {
    assert!(o.status.success(), "{}", String::from_utf8_lossy(&o.stderr));
    serde_json::from_slice(&o.stdout).expect("one JSON object")
}

#[test]
fn ops_are_measured_against_the_machines_own_limits() {
    let v = json(&diorama(&["bench", "ops", "--repeats", "1", "--json"]));
    assert!(v["limits"]["fma_gflops"].as_f64().unwrap() > 0.5 && v["limits"]["read_gb_per_s"].as_f64().unwrap() > 0.1);
    let ops = v["ops"].as_array().unwrap();
    for wanted in ["linear", "hash_grid", "fused_mlp", "march", "composite", "adam"] {
        let of: Vec<_> = ops.iter().filter(|o| o["op"].as_str().unwrap().starts_with(wanted)).collect();
        assert!(!of.is_empty() && of.iter().all(|o| o["ns"].as_f64().unwrap() > 0.0), "{wanted}: {of:?}");
    }
    for o in ops.iter().filter(|o| !o["share_of_peak"].is_null() && !o["shape"].as_str().unwrap().contains("bf16")) {
        assert!((0.0..1.6).contains(&o["share_of_peak"].as_f64().unwrap()), "{o}");
    }
}

#[test]
fn stages_of_a_step_add_up() {
    let dir = tempfile::tempdir().unwrap();
    diorama_pipelines::object::quickstart::write_capture(dir.path(), 8, 24).unwrap();
    let data = dir.path().to_str().unwrap();
    let before = listing(dir.path());
    let v = json(&diorama(&["bench", "train", data, "--device", "cpu", "--warmup", "20", "--steps", "20", "--json"]));
    assert_eq!(v["steps"], 20);
    let stages = v["stages"].as_array().unwrap();
    let total: f64 = stages.iter().map(|s| s["share"].as_f64().unwrap()).sum();
    assert!((total - 1.0).abs() < 1e-6);
    let spent: f64 = stages.iter().map(|s| s["ms"].as_f64().unwrap() * 20e-3).sum();
    let seconds = v["seconds"].as_f64().unwrap();
    assert!(spent <= seconds * 1.001 && spent > 0.8 * seconds, "{spent} of {seconds}");
    let per_ray = |key: &str| v[key].as_f64().unwrap_or_else(|| panic!("{key} is missing: {v}"));
    assert!(per_ray("trained_per_ray") > 0.0 && per_ray("marched_per_ray") >= per_ray("trained_per_ray"), "{v}");
    assert_eq!(listing(dir.path()), before, "nothing is written");
    let o = diorama(&["bench", "train", "/nowhere"]);
    assert_eq!(o.status.code(), Some(2));
}

fn listing(dir: &Path) -> Vec<String> {
    let mut names: Vec<String> = std::fs::read_dir(dir).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}
