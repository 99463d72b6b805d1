//! `diorama bench nets`

use crate::commands::process::use_threads;
use crate::commands::{Outcome, Verb};
use clap::Args;
use diorama_pipelines::bench::nets::{self, Figures, Wanted};
use diorama_pipelines::{PipelineError, Result};

/// Time layers and whole networks on the CPU, forward and training
#[derive(Args, Clone, Debug)]
#[command(
    after_help = "Example:\n  diorama bench nets conv3x3_64_128 vgg16 --threads 2 --json\n\nPeak memory is comparable only if one network is measured per call."
)]
pub struct Nets {
    /// Parts of the names of layers (NAME_bBATCH) and networks; all if none is given
    names: Vec<String>,
    /// Number of CPU threads [default: all]
    #[arg(long)]
    threads: Option<usize>,
    /// Fewest runs per figure; the median is reported
    #[arg(long, default_value_t = 5)]
    repeats: usize,
    /// Repeat each figure for this many seconds
    #[arg(long, default_value_t = 0.5)]
    seconds: f64,
    /// Print one JSON object on stdout
    #[arg(long)]
    json: bool,
}

impl Verb for Nets {
    fn json(&self) -> bool {
        self.json
    }

    fn run(&self) -> Result<Outcome> {
        use_threads(self.threads)?;
        if self.repeats == 0 || !(0.0..=3600.0).contains(&self.seconds) {
            return Err(PipelineError::Usage("--repeats: at least 1; --seconds: 0 to 3600".into()));
        }
        let wanted = Wanted { names: self.names.clone(), repeats: self.repeats, seconds: self.seconds };
        let report = nets::run(&wanted, &mut |f| {
            if !self.json {
                print(f);
            }
        })?;
        if self.json {
            println!("{}", serde_json::json!(report));
        } else {
            println!("{} thread(s); limit of one core: {:.0} GFLOP/s multiply-add", report.threads, report.peak_gflops);
        }
        Ok(Outcome::Done)
    }
}

fn print(f: Figures) {
    let figures = |forward: (f64, f64), train: (f64, f64)| {
        format!("forward {:9.3} ms {:6.1}, training {:9.3} ms {:6.1} GFLOP/s per core", forward.0, forward.1, train.0, train.1)
    };
    match f {
        Figures::Layer(l) => {
            println!(
                "{:<26} {}",
                format!("{}_b{}", l.name, l.batch),
                figures((l.forward_ms, l.forward_gflops), (l.train_ms, l.train_gflops))
            );
        }
        Figures::Network(n) => {
            let memory = n.peak_bytes.map_or(String::new(), |b| format!(", {} MiB", b >> 20));
            println!("{:<26} {}{memory}", n.name, figures((n.forward_ms, n.forward_gflops), (n.train_ms, n.train_gflops)));
        }
    }
}
