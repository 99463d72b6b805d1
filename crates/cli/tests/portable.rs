//! Machines without AVX-512 or AVX2: every instruction set that this machine supports trains to the same loss.

use diorama_kernels::simd::Level;
use diorama_pipelines::object::quickstart::write_capture;
use std::process::Command;

#[test]
fn every_level_trains_alike_and_tells_its_figures() {
    let dir = tempfile::tempdir().unwrap();
    let data = dir.path().join("data");
    std::fs::create_dir(&data).unwrap();
    write_capture(&data, 12, 48).unwrap();
    let mut losses = Vec::new();
    for level in Level::available() {
        let run = dir.path().join(level.name());
        let out = Command::new(env!("CARGO_BIN_EXE_diorama"))
            .args(["train", data.to_str().unwrap(), "-o", run.to_str().unwrap(), "--device", "cpu", "--steps", "80", "--json"])
            .args(["--set", "sampling.batch_samples=4096", "--set", "field.precision=f32"])
            .env("DIORAMA_SIMD", level.name())
            .output()
            .unwrap();
        let text = String::from_utf8_lossy(&out.stderr);
        assert!(out.status.success() && text.contains(level.name()), "{}: {text}", level.name());
        let v: serde_json::Value = serde_json::from_slice(&out.stdout).unwrap();
        println!(
            "{}: {:.0} rays/s, {:.0} samples/s",
            level.name(),
            v["rays_per_s"].as_f64().unwrap(),
            v["samples_per_s"].as_f64().unwrap()
        );
        losses.push(v["psnr_train"].as_f64().unwrap());
    }
    assert!(losses[0] > 12.0, "80 steps teach something: {losses:?}");
    assert!(losses.iter().all(|l| (l - losses[0]).abs() < 0.5), "{losses:?}");
}
