//! `kill -9` at random moments, then `--resume`: the result is bit-equal to that of an uninterrupted run.

use diorama_data::checkpoint;
use diorama_pipelines::object::quickstart::write_capture;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

const STEPS: &str = "40";

fn start(data: &Path, run: &Path, resume: bool) -> Child {
    let mut c = Command::new(env!("CARGO_BIN_EXE_diorama"));
    c.arg("train").arg("--out").arg(run).args(["--steps", STEPS]);
    if resume {
        c.arg("--resume");
    } else {
        c.arg(data).args(["--seed", "3", "--threads", "2", "--device", "cpu", "--force"]);
        for s in [
            "field.log2_size=15",
            "sampling.batch_samples=4096",
            "run.save_every_steps=2",
            "run.log_every=1",
            "field.appearance=4",
            "sampling.error_map=true",
            "camera.refine=true",
            "loss.distortion=0.01",
        ] {
            c.args(["--set", s]);
        }
    }
    c.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap()
}

/// Step and loss of every training line, without wall times; whether held-out views are scored as well, the clock decides.
fn curve(run: &Path) -> Vec<(u64, String)> {
    let text = std::fs::read_to_string(run.join("metrics.jsonl")).unwrap();
    let lines = text.lines().map(|l| serde_json::from_str::<serde_json::Value>(l).unwrap());
    lines.filter(|v| v.get("loss").is_some()).map(|v| (v["step"].as_u64().unwrap(), v["loss"].to_string())).collect()
}

/// Five kills, or as many as `DIORAMA_KILLS` says.
#[test]
fn kills_change_nothing() {
    let wanted: u64 = std::env::var("DIORAMA_KILLS").ok().and_then(|n| n.parse().ok()).unwrap_or(5);
    let dir = tempfile::tempdir().unwrap();
    let (data, alone, killed) = (dir.path().join("data"), dir.path().join("alone"), dir.path().join("killed"));
    write_capture(&data, 8, 32).unwrap();
    let began = Instant::now();
    assert!(start(&data, &alone, false).wait().unwrap().success());
    let whole = began.elapsed();
    let mut want = checkpoint::read(&checkpoint::latest(&alone.join("checkpoints"))).unwrap();

    let (mut kills, mut inside_a_save) = (0, 0);
    let seed = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).unwrap().as_nanos() as u64;
    println!("seed {seed}");
    let rng = diorama_geom::rng::Rng::new(seed, 0);
    let mut attempt = 0u64;
    while kills < wanted || inside_a_save == 0 {
        attempt += 1;
        assert!(attempt < 12 * wanted, "{kills} kills of {wanted}, {inside_a_save} of them inside a save, in {attempt} attempts");
        let resume = killed.join("config.toml").exists();
        let mut child = start(&data, &killed, resume);
        let pause = whole.mul_f32(0.1 + 0.35 * rng.uniform(attempt));
        std::thread::sleep(pause.max(Duration::from_millis(5)));
        if attempt.is_multiple_of(2) {
            // Every other time, waits until a checkpoint is being written.
            let partial = killed.join("checkpoints/latest.safetensors.partial");
            let until = Instant::now() + Duration::from_secs(3);
            while !partial.exists() && Instant::now() < until && child.try_wait().unwrap().is_none() {
                std::hint::spin_loop();
            }
        }
        let finished = child.try_wait().unwrap();
        child.kill().ok();
        child.wait().unwrap();
        let checkpoints = killed.join("checkpoints");
        if checkpoint::exists(&checkpoints) {
            checkpoint::load(&checkpoints).expect("the file on disk always loads");
        }
        if let Some(status) = finished {
            assert!(status.success(), "{status}");
            // The run finished: start a new one with the remaining kills.
            std::fs::remove_dir_all(&killed).unwrap();
            continue;
        }
        kills += 1;
        inside_a_save += checkpoints.join("latest.safetensors.partial").exists() as usize;
    }
    println!("{kills} kills, {inside_a_save} of them inside a save");
    assert!(start(&data, &killed, killed.join("config.toml").exists()).wait().unwrap().success());
    let mut got = checkpoint::read(&checkpoint::latest(&killed.join("checkpoints"))).unwrap();
    assert_eq!(got.metadata["step"], want.metadata["step"]);
    got.tensors.sort_by(|a, b| a.0.cmp(&b.0));
    want.tensors.sort_by(|a, b| a.0.cmp(&b.0));
    assert!(want.tensors.len() >= 10);
    for (a, b) in got.tensors.iter().zip(&want.tensors) {
        let same = a.2.iter().zip(&b.2).all(|(x, y)| x.to_bits() == y.to_bits());
        assert!(a.0 == b.0 && a.2.len() == b.2.len() && same, "{} differs", a.0);
    }
    assert_eq!(curve(&alone).len(), STEPS.parse::<usize>().unwrap(), "one line a step");
    assert_eq!(curve(&killed), curve(&alone), "metrics past a checkpoint are cut");
}

#[cfg(unix)]
#[test]
fn an_interrupt_writes_a_checkpoint_and_exits_with_130() {
    let dir = tempfile::tempdir().unwrap();
    let (data, run) = (dir.path().join("data"), dir.path().join("run"));
    write_capture(&data, 8, 32).unwrap();
    let mut child = Command::new(env!("CARGO_BIN_EXE_diorama"))
        .arg("train")
        .arg(&data)
        .arg("--out")
        .arg(&run)
        .args(["--steps", "1000000", "--set", "field.log2_size=12", "--set", "run.log_every=1"])
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let until = Instant::now() + Duration::from_secs(60);
    while !run.join("metrics.jsonl").exists() && Instant::now() < until {
        std::thread::sleep(Duration::from_millis(20));
    }
    Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap();
    assert_eq!(child.wait().unwrap().code(), Some(130));
    let c = checkpoint::read(&checkpoint::latest(&run.join("checkpoints"))).unwrap();
    assert!(c.metadata["step"].parse::<u64>().unwrap() > 0);
}
