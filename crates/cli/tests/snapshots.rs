//! Texts that users see, as files in `snapshots/` that can be reviewed: the help of every command, default configurations, errors.
//! `INSTA_UPDATE=always cargo test --release -p diorama --test snapshots` rewrites them.

mod program;

use diorama_pipelines::object::config::{Config, Method};
use program::{copy, copy_all, good};
use std::fmt::Write;
use std::path::Path;
use std::process::{Command, Output, Stdio};

fn diorama(folder: &Path, arguments: &[&str]) -> Output {
    let mut c = Command::new(env!("CARGO_BIN_EXE_diorama"));
    c.args(arguments).current_dir(folder).stdin(Stdio::null()).env_remove("DIORAMA_MEMORY").output().unwrap()
}

/// Names of the commands, and of the commands in groups, as listed in the help.
fn verbs(noun: &[&str]) -> Vec<String> {
    let o = diorama(Path::new("."), &[noun, &["--help"]].concat());
    let text = String::from_utf8(o.stdout).unwrap();
    let listed = text.split("Commands:\n").nth(1).unwrap().split("\n\n").next().unwrap();
    listed.lines().map(|l| l.split_whitespace().next().unwrap().to_string()).filter(|v| v != "help").collect()
}

#[test]
fn help_of_every_verb() {
    let mut calls = vec![vec![]];
    for verb in verbs(&[]) {
        calls.push(vec![verb]);
    }
    for group in ["relight", "text", "bench"] {
        calls.extend(verbs(&[group]).into_iter().map(|v| vec![group.to_string(), v]));
    }
    assert_eq!(calls.len(), 54, "the program, its verbs and those of groups");
    for call in calls {
        let mut arguments: Vec<&str> = call.iter().map(String::as_str).collect();
        arguments.push("--help");
        let o = diorama(Path::new("."), &arguments);
        assert!(o.status.success() && o.stderr.is_empty(), "{call:?}");
        let name = ["help"].into_iter().chain(call.iter().map(String::as_str)).collect::<Vec<_>>().join("-");
        insta::assert_snapshot!(name, String::from_utf8(o.stdout).unwrap());
    }
}

#[test]
fn default_configuration_of_every_method() {
    for method in [Method::Ngp, Method::Nerf, Method::Mlp, Method::Baseline] {
        insta::assert_snapshot!(format!("config-{method}"), Config::new(method, "photographs".into()).to_toml());
    }
}

/// A folder with a capture, a run, and runs that are damaged in one way each.
fn folder() -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    copy_all(&good().capture, &at("capture"));
    copy_all(&good().run, &at("run"));
    let config = std::fs::read_to_string(at("run/config.toml")).unwrap();
    let damaged = |name: &str, file: &str, content: &[u8]| {
        copy_all(&good().run, &at(name));
        std::fs::write(at(name).join(file), content).unwrap();
    };
    damaged("of-another-application", "config.toml", config.replace("\"object\"", "\"sculpture\"").as_bytes());
    damaged("unknown-key", "config.toml", config.replace("log2_size", "log_size").as_bytes());
    damaged("no-toml", "config.toml", b"method = ");
    damaged("no-capture", "capture.json", b"{\"frames\": 3}");
    damaged("no-checkpoint", "checkpoints/latest.safetensors", b"nothing");
    std::fs::remove_file(at("no-checkpoint/checkpoints/previous.safetensors")).unwrap_or_default();
    std::fs::create_dir(at("empty")).unwrap();
    std::fs::create_dir(at("full")).unwrap();
    std::fs::write(at("full/letter.txt"), b"dear").unwrap();
    std::fs::write(at("mesh.glb"), b"mine").unwrap();
    dir
}

/// Calls that must fail, and their output: one line and the exit code.
const WRONG: [&str; 38] = [
    "",
    "trian capture",
    "train capture",
    "train capture --out new --stepz 3",
    "train capture --out new --steps many",
    "train --out new",
    "train missing --out new",
    "train empty --out new",
    "train capture --out run",
    "train capture --out full",
    "train capture --out mesh.glb",
    "train capture --out new --method nurf",
    "train capture --out new --background green",
    "train capture --out new --device abacus",
    "train capture --out new --split every:1",
    "train capture --out new --downscale 0",
    "train capture --out new --seconds -4",
    "train capture --out new --steps 0",
    "train capture --out new --threads 0",
    "train capture --out new --preset poster",
    "train capture --out new --config missing.toml",
    "train capture --out new --set loss.distorsion=1",
    "train capture --out new --set levles=3",
    "train capture --out new --set optim.rate=fast",
    "train capture --out new --set nonsense",
    "train capture --out new --set field.features=3",
    "train --out empty --resume",
    "train --out run --resume --method nerf",
    "eval capture",
    "eval run --on morning",
    "eval of-another-application",
    "info unknown-key",
    "render no-toml",
    "export no-capture -o new.glb",
    "export run -o mesh.glb",
    "eval no-checkpoint --json",
    "render run --size 9",
    "compare run of-another-application",
];

#[test]
fn errors() {
    let dir = folder();
    let mut all = String::new();
    for call in WRONG {
        let arguments: Vec<&str> = call.split_whitespace().collect();
        let o = diorama(dir.path(), &arguments);
        let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
        writeln!(all, "$ diorama {call}\n{}{}exit code {}\n", text(&o.stdout), text(&o.stderr), o.status.code().unwrap()).unwrap();
        assert!(!dir.path().join("new").exists(), "{call}: something was left behind");
    }
    assert_eq!(std::fs::read(dir.path().join("mesh.glb")).unwrap(), b"mine");
    insta::assert_snapshot!("errors", all.replace(dir.path().to_str().unwrap(), "[folder]"));
}

#[test]
fn a_run_from_before_there_were_applications_opens() {
    let (_dir, run) = copy();
    let file = run.join("config.toml");
    let text = std::fs::read_to_string(&file).unwrap();
    let before = text.strip_prefix("application = \"object\"\n").expect("the application comes first");
    std::fs::write(&file, before).unwrap();
    let o = diorama(&run, &["info", ".", "--json"]);
    let told: serde_json::Value = serde_json::from_slice(&o.stdout).unwrap();
    assert_eq!(told["kind"], "object run", "{}", String::from_utf8_lossy(&o.stderr));
}
