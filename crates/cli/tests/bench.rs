//! The output of `diorama bench`, and that it leaves nothing behind.

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

#[test]
fn layers_and_networks_are_measured_forward_and_in_training() {
    let call =
        |names: &[&str]| diorama(&[&["bench", "nets", "--threads", "2", "--repeats", "1", "--seconds", "0", "--json"], names].concat());
    let v = json(&call(&["conv3x3_64_128_b1", "vgg16"]));
    let keys = |v: &serde_json::Value| v.as_object().unwrap().keys().cloned().collect::<Vec<_>>();
    assert_eq!(keys(&v), ["threads", "peak_gflops", "layers", "networks"]);
    assert_eq!(v["threads"], 2);
    let peak = v["peak_gflops"].as_f64().unwrap();
    let [layer] = &v["layers"].as_array().unwrap()[..] else { panic!("one layer has this name: {v}") };
    assert_eq!(keys(layer), ["name", "batch", "forward_gflops", "train_gflops"]);
    assert_eq!((&layer["name"], &layer["batch"]), (&"conv3x3_64_128".into(), &1.into()));
    for key in ["forward_gflops", "train_gflops"] {
        let rate = layer[key].as_f64().unwrap();
        assert!(rate > 0.01 * peak && rate < 1.3 * peak, "{key}: {rate} of {peak}");
    }
    let [network] = &v["networks"].as_array().unwrap()[..] else { panic!("one network has this name: {v}") };
    assert_eq!(keys(network), ["name", "forward_ms", "train_ms", "peak_bytes"]);
    // A step includes a forward pass, and the weights alone take 59 MB four times.
    assert!(network["forward_ms"].as_f64().unwrap() > 0.0 && network["train_ms"].as_f64() > network["forward_ms"].as_f64(), "{v}");
    assert!(network["peak_bytes"].as_u64().is_none_or(|b| b > 200 << 20), "{v}");
    let o = call(&["no such layer"]);
    assert_eq!(o.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&[o.stdout, o.stderr].concat()).contains("vit_b_32"), "known names are listed");
}

#[test]
fn tracing_and_rasterizing_are_measured() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("a.obj"), "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n").unwrap();
    let model = dir.path().join("a.obj");
    let small = ["--size", "64x32", "--spp", "2", "--repeats", "1", "--threads", "2", "--json"];
    let v = json(&diorama(&[&["bench", "path-trace", model.to_str().unwrap()], &small[..]].concat()));
    assert_eq!((v["triangles"].as_u64(), &v["size"], &v["threads"]), (Some(1), &serde_json::json!([64, 32]), &2.into()));
    let samples = 64.0 * 32.0 * 2.0 / v["seconds"].as_f64().unwrap();
    assert!((v["samples_per_s"].as_f64().unwrap() / samples - 1.0).abs() < 1e-6, "{v}");
    // Each sample is one ray from the camera at least.
    assert!(v["rays_per_s"].as_f64().unwrap() > samples, "{v}");
    let v = json(&diorama(&["bench", "raster", "--size", "64", "--repeats", "1", "--threads", "2", "--json"]));
    assert!(
        ["rasterize_ms", "interpolate_ms", "texture_ms", "pixels_per_s", "trilinear_pixels_per_s"]
            .iter()
            .all(|k| v[k].as_f64().unwrap() > 0.0),
        "{v}"
    );
    assert_eq!(diorama(&["bench", "path-trace", "/nowhere.glb"]).status.code(), Some(2));
    assert_eq!(diorama(&["bench", "raster", "--repeats", "0"]).status.code(), Some(2));
}

#[test]
fn tables_of_the_thesis_name_what_is_asked_wrongly() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("out");
    for (given, named) in
        [(&["2"][..], "table 2"), (&["1", "--data", "sofa=/tmp"], "head, cape, ficus"), (&["4", "--data", "head"], "OBJECT=FOLDER")]
    {
        let o = diorama(&[&["bench", "thesis"], given, &["--quick", "-o", out.to_str().unwrap()]].concat());
        let said = String::from_utf8_lossy(&o.stderr).into_owned();
        assert!(o.status.code() == Some(2) && said.contains(named) && !out.exists(), "{given:?}: {said}");
    }
}

fn listing(dir: &Path) -> Vec<String> {
    let mut names: Vec<String> = std::fs::read_dir(dir).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}
