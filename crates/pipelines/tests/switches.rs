//! Every switch of the configuration changes the result, or is listed here with the reason why not.

use diorama_pipelines::object::config::{Config, Method};
use diorama_pipelines::object::quickstart::write_capture;
use diorama_pipelines::object::recipe;
use diorama_pipelines::run::RunFolder;
use std::path::Path;
use std::sync::atomic::AtomicBool;

/// Switches that leave the parameters alone.
const NEUTRAL: [(&str, &str); 15] = [
    ("device", "this build has one"),
    ("data.path", "names the capture"),
    ("data.format", "tested with the importers"),
    ("data.mask", "this capture has none: tested in masks"),
    ("data.mask_meaning", "this capture has none: tested in masks"),
    ("data.memory_budget", "must not change the result: tested in pixel_store"),
    ("data.white", "of linear light alone: tested in cli/tests/photographs.rs"),
    ("data.skip_broken", "tested with broken photographs in cli/tests/photographs.rs"),
    ("loss.depth", "this capture has alpha: tested in object/recipe_tests.rs"),
    ("loss.depth_from", "the same: tested in object/recipe_tests.rs"),
    ("run.seconds", "the other budget: tested in train::run"),
    ("run.log_every", "tested in train::run"),
    ("run.save_every_seconds", "must not change the result"),
    ("run.save_every_steps", "must not change the result: tested in kill_and_resume"),
    ("run.evaluate_every", "must not change the result: tested in train::run"),
];

/// Switch, value, and what must be on for it to matter.
const SWITCHES: [(&str, &str, &[(&str, &str)]); 45] = [
    ("method", "mlp", &[]),
    ("background", "black", &[]),
    ("seed", "2", &[]),
    ("data.downscale", "2", &[]),
    ("data.shortest_side", "20", &[]),
    ("data.split", "all", &[]),
    ("field.levels", "5", &[]),
    ("field.features", "4", &[]),
    ("field.log2_size", "9", &[]),
    ("field.base", "8", &[]),
    ("field.finest", "64", &[]),
    ("field.appearance", "4", &[]),
    ("field.space", "unbounded", &[]),
    ("field.precision", "f32", &[]),
    ("loss.color", "mse", &[]),
    ("loss.distortion", "1.0", &[]),
    ("loss.alpha", "0.1", &[]),
    ("loss.near_scaling", "4.0", &[]),
    ("optim.rate", "0.02", &[]),
    ("optim.final_scale", "0.5", &[]),
    ("optim.warmup", "0.5", &[]),
    ("optim.decay_from", "0.9", &[]),
    ("optim.weight_decay", "0.1", &[]),
    ("optim.table_decay", "0.1", &[]),
    ("sampling.rays", "128", &[]),
    ("sampling.batch_samples", "1048576", &[]),
    ("sampling.samples", "16", &[("method", "mlp")]),
    ("sampling.importance", "8", &[("method", "nerf"), ("sampling.samples", "8"), ("sampling.rays", "16")]),
    ("sampling.max_samples", "16", &[]),
    ("sampling.stop", "0.5", &[]),
    ("sampling.min_alpha", "0.1", &[("optim.rate", "0.3")]),
    ("sampling.near", "2.0", &[]),
    ("sampling.occupancy_resolution", "32", &[]),
    ("sampling.occupancy_points", "512", &[]),
    ("sampling.occupancy_every", "1", &[]),
    ("sampling.min_cell_views", "7", &[("sampling.occupancy_resolution", "64")]),
    ("sampling.error_map", "true", &[]),
    ("camera.refine", "true", &[]),
    ("camera.refine_focal", "true", &[("camera.refine", "true")]),
    ("camera.rate", "0.01", &[("camera.refine", "true")]),
    ("camera.decay", "1.0", &[("camera.refine", "true")]),
    ("run.steps", "7", &[]),
    ("background", "learned", &[]),
    ("background", "random", &[("method", "mlp")]),
    ("method", "nerf", &[("sampling.samples", "8"), ("sampling.rays", "16")]),
];

/// All parameters after a short run.
fn train(data: &Path, out: &Path, overrides: &[(&str, &str)]) -> Vec<u32> {
    let mut c = Config::new(Method::Ngp, data.to_path_buf());
    for (k, v) in [
        ("field.log2_size", "11"),
        ("field.levels", "4"),
        ("sampling.batch_samples", "2048"),
        ("sampling.occupancy_every", "2"),
        ("sampling.occupancy_points", "2048"),
        ("sampling.occupancy_resolution", "16"),
        ("device", "cpu"),
        ("run.steps", "6"),
        ("data.split", "every:8"),
    ] {
        c.set(k, v).unwrap();
    }
    for (k, v) in overrides {
        c.set(k, v).unwrap();
    }
    let mut folder = RunFolder::create(out, true).unwrap();
    let recipe::Trained { mut model, .. } = recipe::train(&c, &mut folder, false, None, &AtomicBool::new(false), &mut |_| {}).unwrap();
    let (entries, _) = model.entries();
    entries.iter().flat_map(|e| e.data).map(|v| v.to_bits()).collect()
}

#[test]
fn every_switch_changes_the_result() {
    let dir = tempfile::tempdir().unwrap();
    let (data, out) = (dir.path().join("data"), dir.path().join("run"));
    write_capture(&data, 8, 32).unwrap();
    for (key, value, with) in SWITCHES {
        if key == "field.precision" && !diorama_kernels::gemm::has_bf16() {
            println!("{key}: this CPU has f32 alone");
            continue;
        }
        let before = train(&data, &out, with);
        let after = train(&data, &out, &[with, &[(key, value)]].concat());
        assert!(before != after, "{key} = {value} changed nothing");
    }
    // Saving often changes nothing, and neither does running again.
    assert_eq!(train(&data, &out, &[]), train(&data, &out, &[("run.save_every_steps", "1"), ("run.evaluate_every", "3")]));
}

#[test]
fn no_switch_is_forgotten() {
    for (key, _) in Config::new(Method::Ngp, "x".into()).values() {
        let known = SWITCHES.iter().any(|s| s.0 == key) || NEUTRAL.iter().any(|n| n.0 == key);
        assert!(known, "{key} is in no test");
    }
}
