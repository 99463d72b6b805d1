//! A run that begins on a GPU and ends on the CPU.
#![cfg(feature = "gpu")]

use diorama_pipelines::object::quickstart::write_capture;
use std::process::{Command, Output};

fn diorama(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_diorama")).args(args).output().unwrap()
}

#[test]
fn a_run_goes_on_where_another_device_left_it() {
    let doctor: serde_json::Value = serde_json::from_slice(&diorama(&["doctor", "--json"]).stdout).unwrap();
    let Some(device) = doctor["devices"].as_array().unwrap().iter().filter_map(|d| d.as_str()).find(|d| *d != "cpu") else {
        println!("skipped: no GPU, nor software for one");
        return;
    };
    let dir = tempfile::tempdir().unwrap();
    let (data, run) = (dir.path().join("data"), dir.path().join("run"));
    write_capture(&data, 8, 32).unwrap();
    let (data, run) = (data.to_str().unwrap(), run.to_str().unwrap());
    let json = |out: Output| -> serde_json::Value {
        assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
        serde_json::from_slice(&out.stdout).unwrap()
    };
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
    // It learns on either, and does not begin again in between.
    assert!(mean(&losses[15..20]) < 0.9 * mean(&losses[..5]), "{losses:?}");
    assert!(mean(&losses[20..25]) < 1.2 * mean(&losses[15..20]), "{losses:?}");
    // What a GPU cannot train is refused, in one line.
    let no = diorama(&["train", data, "-o", &format!("{run}2"), "--device", device, "--method", "nerf", "--steps", "2"]);
    assert_eq!(no.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&no.stderr).contains("nerf"), "{}", String::from_utf8_lossy(&no.stderr));
}
