//! Data sets that cannot be made as they were asked for, on the run of the whole application.

use super::dataset::{self, Synthesized};
use super::plan::{Scenes, Shard, SynthOptions};
use super::prior::{CELLS, Prior};
use crate::error::Result;
use std::path::Path;
use std::sync::atomic::AtomicBool;

fn made(out: &Path, run: &Path, o: &SynthOptions) -> Result<Synthesized> {
    let scenes = Scenes::read(run).unwrap();
    dataset::synthesize(out, (&scenes, o, Shard::WHOLE), false, &AtomicBool::new(false), &mut |_, _| ())
}

/// Checks with a run that has edits; `dir` holds the data set `whole` of the same options.
pub fn check(dir: &Path, run: &Path, options: &SynthOptions) {
    areas(dir, run, options);
    full_disk(dir, run, options);
}

/// Areas that no valid camera shows are refused with those that some do, and these are then drawn.
fn areas(dir: &Path, run: &Path, options: &SynthOptions) {
    let prior = |area: f64| {
        let mut centers = vec![0.0; CELLS * CELLS];
        centers[CELLS / 2 * CELLS + CELLS / 2] = 1.0;
        let file = dir.join("prior.json");
        Prior { regions: 1, centers, areas: vec![area] }.save(&file).unwrap();
        SynthOptions { prior: Some(file), count: 2, ..options.clone() }
    };
    let e = made(&dir.join("tiny"), run, &prior(1e-5)).unwrap_err();
    let text = e.to_string();
    assert!(
        e.is_input() && text.contains("run: cluster ") && text.contains("has no valid camera: its writing is less than 8 pixels"),
        "{e}"
    );
    let shares: Vec<f64> =
        text.split_whitespace().zip(text.split_whitespace().skip(1)).filter(|w| w.1 == "%").flat_map(|w| w.0.parse()).collect();
    let [low, high] = shares[..] else { panic!("{text}") };
    assert!(text.contains("of the picture can be its area") && 0.01 < low && low < high && high <= 100.0, "{text}");
    let drawn = made(&dir.join("possible"), run, &prior(0.01 * (low * high).sqrt())).unwrap();
    assert_eq!(drawn.images, 2);
    let none = SynthOptions { only: vec![200], ..options.clone() };
    let e = made(&dir.join("none"), run, &none).unwrap_err();
    assert!(e.is_input() && e.to_string().contains("there is no such cluster"), "{e}");
}

/// Where an image has no space, the bytes are told, what is written stays valid, and the same call goes on once there is space.
#[cfg(target_os = "linux")]
fn full_disk(dir: &Path, run: &Path, options: &SynthOptions) {
    let out = dir.join("full");
    std::fs::create_dir_all(out.join("images")).unwrap();
    // Each write to this device finds no space.
    std::os::unix::fs::symlink("/dev/full", out.join("images/00000002.png.partial")).unwrap();
    let e = made(&out, run, options).unwrap_err();
    let text = e.to_string();
    assert!(!e.is_input() && text.contains("images/00000002.png: cannot write: No space left on device"), "{text}");
    assert!(text.contains(" bytes were to be written"), "{text}");
    assert_eq!(dataset::read_manifest(&out).unwrap().options, *options);
    let kept = super::journal::read(&out).unwrap();
    assert!([0, 1, 3].iter().all(|k| kept.contains_key(k)) && !kept.contains_key(&2), "the others are kept: {:?}", kept.keys());
    assert!(!out.join("images/00000002.png").exists() && !out.join("annotations.jsonl").exists());
    assert_eq!(made(&out, run, options).unwrap().images, 6);
    for file in ["annotations.jsonl", "images/00000000.png", "images/00000002.png", "images/00000005.png"] {
        assert!(std::fs::read(out.join(file)).unwrap() == std::fs::read(dir.join("whole").join(file)).unwrap(), "{file}");
    }
}

#[cfg(not(target_os = "linux"))]
fn full_disk(_: &Path, _: &Path, _: &SynthOptions) {}
