//! Progress on stderr, results on stdout, errors in one line.

use diorama_engine::train::Event;
use diorama_pipelines::PipelineError;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use std::io::IsTerminal;
use std::time::Instant;

/// Exit codes (DESIGN: 0 done, 1 the work failed, 2 bad input or usage, 130 interrupted).
pub const FAILED: u8 = 1;
pub const USAGE: u8 = 2;
pub const INTERRUPTED: u8 = 130;

/// Prints an error in one line, and as JSON on stdout where asked; returns the exit code.
pub fn report(error: &PipelineError, json: bool) -> u8 {
    let line = error.to_string().replace('\n', " ");
    eprintln!("diorama: {line}");
    let code = if error.is_input() { USAGE } else { FAILED };
    if json {
        println!("{}", serde_json::json!({ "error": line, "kind": error.kind(), "exit_code": code }));
    }
    code
}

/// Shows a run's events: a bar on a terminal, a line every few seconds elsewhere.
pub struct Progress {
    bar: Option<ProgressBar>,
    last_line: Option<Instant>,
    /// PSNR of held-out pixels when they were judged last.
    held_out: Option<f64>,
}

impl Progress {
    pub fn new() -> Self {
        let bar = std::io::stderr().is_terminal().then(|| {
            let bar = ProgressBar::with_draw_target(Some(1000), ProgressDrawTarget::stderr());
            bar.set_style(ProgressStyle::with_template("{bar:30} {msg} {eta} left").expect("a valid template"));
            bar
        });
        Progress { bar, last_line: None, held_out: None }
    }

    fn line(&self, text: &str) {
        match &self.bar {
            Some(b) => b.println(text),
            None => eprintln!("{text}"),
        }
    }

    pub fn event(&mut self, event: &Event) {
        match event {
            Event::Started { step, .. } if *step > 0 => self.line(&format!("going on at step {step}")),
            Event::Started { .. } | Event::Saved { .. } => {}
            Event::Progress { step, seconds, progress, loss, psnr, rays_per_s, .. } => {
                let held_out = self.held_out.map_or(String::new(), |p| format!("  held out {p:.2}"));
                let text = format!("step {step}  {seconds:.0} s  loss {loss:.5}  psnr {psnr:.2}{held_out}  {rays_per_s:.0} rays/s");
                if let Some(b) = &self.bar {
                    b.set_position((progress * 1000.0) as u64);
                    b.set_message(text);
                } else if self.last_line.is_none_or(|t| t.elapsed().as_secs() >= 5) {
                    self.last_line = Some(Instant::now());
                    eprintln!("{text}");
                }
            }
            Event::Evaluated { psnr, .. } => self.held_out = Some(*psnr),
            Event::Recovered { step, to_step, why } => self.line(&format!("step {step}: {why}; back to step {to_step}")),
            Event::Note(n) => self.line(&format!("note: {n}")),
            Event::Finished { step, seconds, interrupted } => {
                if let Some(b) = &self.bar {
                    b.finish_and_clear();
                }
                let how = if *interrupted { "interrupted" } else { "done" };
                eprintln!("{how} after {step} steps, {seconds:.1} s");
            }
        }
    }
}
