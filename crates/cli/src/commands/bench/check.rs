//! `diorama bench check`

use crate::commands::{Outcome, Verb};
use clap::Args;
use diorama_pipelines::bench;
use diorama_pipelines::{PipelineError, Result};
use std::collections::BTreeMap;
use std::path::PathBuf;

/// Compare every op on a GPU with its f64 reference; exit code 1 if one differs
#[derive(Args, Clone, Debug)]
#[command(after_help = "Example:\n  diorama bench check --device vulkan")]
pub struct Check {
    /// Also train on this capture, on the device and on the CPU, and compare the losses
    #[arg(long, value_name = "FOLDER")]
    data: Option<PathBuf>,
    /// cuda, vulkan, metal or webgpu
    #[arg(long)]
    device: String,
    /// Print one JSON object on stdout
    #[arg(long)]
    json: bool,
}

impl Verb for Check {
    fn json(&self) -> bool {
        self.json
    }

    fn run(&self) -> Result<Outcome> {
        let r = bench::check::run(&self.device, self.data.as_deref())?;
        let wrong = r.lines.iter().filter(|l| l.fault.is_some()).count();
        if self.json {
            println!("{}", serde_json::json!(r));
        } else {
            for l in &r.lines {
                let error = l.error.map_or("FAILED ".into(), |e| format!("{e:.1e}"));
                println!("{error}  {:<20} {:<18} {:<28} {}", l.op, l.result, l.shape, l.fault.as_deref().unwrap_or(""));
            }
            let atomics = if r.native_atomics { "native f32 atomics" } else { "f32 atomics by exchange" };
            let kind = if r.software { "software" } else { "hardware" };
            println!("longest: {}", longest(&r.lines).join(", "));
            println!(
                "{} ({}, {kind}, {atomics}): {} of {} pass in {:.1} s",
                r.device,
                r.name,
                r.lines.len() - wrong,
                r.lines.len(),
                r.seconds
            );
        }
        if wrong > 0 {
            return Err(PipelineError::Device(format!("{wrong} of {} results on {} are wrong", r.lines.len(), r.device)));
        }
        Ok(Outcome::Done)
    }
}

/// Up to eight ops that took longest, each with its time.
fn longest(lines: &[bench::check::Line]) -> Vec<String> {
    let mut seconds: BTreeMap<&str, f64> = BTreeMap::new();
    lines.iter().for_each(|l| *seconds.entry(l.op).or_default() += l.seconds);
    let mut all: Vec<(&str, f64)> = seconds.into_iter().collect();
    all.sort_by(|a, b| b.1.total_cmp(&a.1));
    all.iter().take(8).map(|(op, s)| format!("{op} {s:.0} s")).collect()
}
