//! `diorama doctor`

use super::mask_flags::MaskFlags;
use super::{Outcome, Verb};
use clap::Args;
use diorama_data::import::{self, ImportOptions};
use diorama_data::memory;
use diorama_kernels::device::Api;
use diorama_pipelines::object::diagnose::{self, Grade};
use diorama_pipelines::{PipelineError, Result};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// Show what this machine supports, and what each missing part disables; or, for a capture, likely problems
#[derive(Args, Clone, Debug)]
#[command(after_help = "Examples:\n  diorama doctor\n  diorama doctor data/chair")]
pub struct Doctor {
    /// Folder of a capture; without it, the machine is checked
    data: Option<PathBuf>,
    /// Format of the capture, if its folder contains several
    #[arg(long, requires = "data")]
    format: Option<String>,
    #[command(flatten)]
    masks: MaskFlags,
    /// Print one JSON object on stdout
    #[arg(long)]
    json: bool,
}

impl Verb for Doctor {
    fn json(&self) -> bool {
        self.json
    }

    fn run(&self) -> Result<Outcome> {
        match &self.data {
            Some(data) => capture(data, self),
            None if self.masks.mask.is_some() || self.masks.mask_meaning.is_some() => {
                Err(PipelineError::Usage("--mask and --mask-meaning: need the folder of a capture too".into()))
            }
            None => machine(self),
        }
    }
}

/// Checks a capture and prints likely problems.
fn capture(data: &Path, a: &Doctor) -> Result<Outcome> {
    let format = a.format.as_deref().map(str::parse).transpose().map_err(PipelineError::Usage)?;
    let masks = a.masks.options()?;
    let options = ImportOptions { format, min_views: 1, masks, allow_broken: true, ..ImportOptions::default() };
    let capture = import::import(data, &options)?;
    let found = diagnose::diagnose(&capture)?;
    if a.json {
        println!("{}", serde_json::json!({ "capture": data, "findings": found }));
        return Ok(Outcome::Done);
    }
    for f in &found {
        let mark = match f.grade {
            Grade::Good => "ok",
            Grade::Note => "note",
            Grade::Trouble => "trouble",
        };
        println!("{mark:<8} {:<10} {}", f.subject, f.text);
        if !f.cure.is_empty() {
            println!("{:<19} -> {}", "", f.cure);
        }
    }
    let count = |g: Grade| found.iter().filter(|f| f.grade == g).count();
    println!("{} problems, {} notes", count(Grade::Trouble), count(Grade::Note));
    Ok(Outcome::Done)
}

fn machine(a: &Doctor) -> Result<Outcome> {
    let cpu = diorama_kernels::device::cpu();
    let gpus = diorama_kernels::device::gpus();
    let devices: Vec<&str> = std::iter::once("cpu").chain(gpus.iter().map(|g| g.api.name())).collect();
    let about: Vec<_> =
        gpus.iter().map(|g| serde_json::json!({ "device": g.api.name(), "name": g.name, "software": g.software })).collect();
    let (total, available) = (memory::of_machine().total, diorama_pipelines::object::memory::available()?);
    let ffmpeg = tool("ffmpeg", "DIORAMA_FFMPEG", "-version");
    let colmap = tool("colmap", "DIORAMA_COLMAP", "-h");
    let data = std::env::var("DIORAMA_TEST_DATA").ok().filter(|d| std::path::Path::new(d).is_dir());
    if a.json {
        let object = serde_json::json!({
            "version": env!("CARGO_PKG_VERSION"),
            "cpu_features": cpu.features,
            "simd": cpu.level.name(),
            "cores": cpu.cores,
            "memory_bytes": total,
            "memory_available_bytes": available,
            "devices": devices,
            "gpus": about,
            "ffmpeg": ffmpeg,
            "colmap": colmap,
            "test_data": data,
        });
        println!("{object}");
        return Ok(Outcome::Done);
    }
    println!("diorama    {}", env!("CARGO_PKG_VERSION"));
    println!("cpu        {} cores, {} kernels ({})", cpu.cores, cpu.level.name(), cpu.features.join(" "));
    let gib = |b: Option<u64>| b.map_or("unknown".into(), |b| format!("{:.1} GiB", b as f64 / (1u64 << 30) as f64));
    println!("memory     {}, {} available", gib(total), gib(available));
    let reach: Vec<_> = Api::ALL.into_iter().filter(|a| a.is_built()).map(Api::name).collect();
    match &reach[..] {
        [] => println!("devices    cpu (this build has no GPU kernels; build it without --no-default-features)"),
        _ if gpus.is_empty() => println!("devices    cpu (no GPU found by {})", reach.join(", ")),
        _ => println!("devices    cpu"),
    }
    for g in &gpus {
        println!("           {}: {}{}", g.api.name(), g.name, if g.software { " (software)" } else { "" });
    }
    let line = |name: &str, found: &Option<String>, without: &str| match found {
        Some(v) => println!("{name:<10} {v}"),
        None => println!("{name:<10} not found: {without}"),
    };
    line("ffmpeg", &ffmpeg, "videos cannot be read; writing MP4 works without it");
    line("colmap", &colmap, "photographs need poses from elsewhere (transforms.json, a COLMAP model or poses_bounds.npy)");
    line("test data", &data, "tests on real captures are skipped (set DIORAMA_TEST_DATA)");
    Ok(Outcome::Done)
}

/// First line of a program's output, if it can be started.
fn tool(name: &str, variable: &str, flag: &str) -> Option<String> {
    let program = std::env::var_os(variable).unwrap_or_else(|| name.into());
    let out = Command::new(program).arg(flag).stdin(Stdio::null()).output().ok()?;
    let text = String::from_utf8_lossy(&out.stdout).into_owned();
    Some(text.lines().find(|l| !l.trim().is_empty()).unwrap_or(name).trim().to_string())
}
