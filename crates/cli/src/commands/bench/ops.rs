//! `diorama bench ops`

use crate::commands::{Outcome, Verb};
use clap::Args;
use diorama_pipelines::bench;
use diorama_pipelines::{PipelineError, Result};

/// Time each op and compare it with the machine's measured limits
#[derive(Args, Clone, Debug)]
#[command(after_help = "Example:\n  diorama bench ops --threads 2 --json")]
pub struct Ops {
    /// Number of CPU threads [default: 1]
    #[arg(long)]
    threads: Option<usize>,
    /// cpu, cuda, vulkan, metal or webgpu
    #[arg(long, default_value = "cpu")]
    device: String,
    /// Runs per figure; the median is reported
    #[arg(long, default_value_t = 9)]
    repeats: usize,
    /// Print one JSON object on stdout
    #[arg(long)]
    json: bool,
}

impl Verb for Ops {
    fn json(&self) -> bool {
        self.json
    }

    fn run(&self) -> Result<Outcome> {
        if self.threads == Some(0) || self.repeats == 0 {
            return Err(PipelineError::Usage("--threads and --repeats: at least 1".into()));
        }
        let optional = |v: Option<f64>, unit: &str| v.map_or(String::new(), |v| format!("{v:8.1} {unit}"));
        let print = |f: &bench::ops::OpFigure| {
            let share = f.share_of_peak.map_or(String::new(), |s| format!("{:5.0} % of the multiply-add peak", 100.0 * s));
            let rate = format!("{}{}", optional(f.gflops, "GFLOP/s"), optional(f.gb_per_s, "GB/s"));
            println!("{:<30} {:<30} {:>10.1} ns/{:<10} {rate} {share}", f.op, f.shape, f.ns, f.unit);
        };
        if self.device != "cpu" {
            if self.threads.is_some() {
                return Err(PipelineError::Usage(format!("--threads applies to the CPU only; leave it out with --device {}", self.device)));
            }
            return gpu_ops(self, &print);
        }
        let report = bench::ops::run(self.threads.unwrap_or(1), self.repeats, &mut |f| {
            if !self.json {
                print(f);
            }
        });
        if self.json {
            println!("{}", serde_json::json!(report));
        } else {
            let l = report.limits;
            println!(
                "{} thread(s), {}; limits of one thread: {:.0} GFLOP/s multiply-add, {:.1} GB/s read",
                report.threads, report.simd, l.fma_gflops, l.read_gb_per_s
            );
        }
        Ok(Outcome::Done)
    }
}

#[cfg(feature = "gpu")]
fn gpu_ops(a: &Ops, print: &dyn Fn(&bench::ops::OpFigure)) -> Result<Outcome> {
    let report = bench::gpu_ops::run(&a.device, a.repeats, &mut |f| {
        if !a.json {
            print(f);
        }
    })?;
    if a.json {
        println!("{}", serde_json::json!(report));
    } else {
        println!("{} ({}): copies {:.0} GB/s", report.device, report.name, report.copy_gb_per_s);
    }
    Ok(Outcome::Done)
}

#[cfg(not(feature = "gpu"))]
fn gpu_ops(a: &Ops, _: &dyn Fn(&bench::ops::OpFigure)) -> Result<Outcome> {
    Err(bench::check::not_built(&a.device))
}
