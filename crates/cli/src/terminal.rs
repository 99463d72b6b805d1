//! Progress on stderr, results on stdout, errors in one line.

use diorama_engine::train::scalar::{label, text};
use diorama_engine::train::{Event, Scores};
use diorama_pipelines::PipelineError;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use std::io::IsTerminal;
use std::time::{Duration, Instant};

/// Seconds between progress lines without a terminal.
const LINE_EVERY: Duration = Duration::from_secs(5);
/// Share of the work before which no remaining time is estimated.
const MIN_SHARE: f64 = 0.01;

/// Exit codes (DESIGN: 0 done, 1 the work failed, 2 bad input or usage, 130 interrupted).
pub const FAILED: u8 = 1;
pub const USAGE: u8 = 2;
pub const INTERRUPTED: u8 = 130;

/// Prints an error in one line, and as JSON on stdout if requested; returns the exit code.
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
    /// What is being prepared; its first line is printed at once.
    preparing: Option<&'static str>,
    /// Of the last evaluation.
    scores: Scores,
}

impl Progress {
    pub fn new() -> Self {
        let bar = std::io::stderr().is_terminal().then(|| {
            let bar = ProgressBar::with_draw_target(Some(1000), ProgressDrawTarget::stderr());
            bar.set_style(ProgressStyle::with_template("{bar:30} {msg} {eta} left").expect("a valid template"));
            bar
        });
        Progress { bar, last_line: None, preparing: None, scores: Scores::default() }
    }

    fn line(&self, text: &str) {
        match &self.bar {
            Some(b) => b.println(text),
            None => eprintln!("{text}"),
        }
    }

    pub fn event(&mut self, event: &Event) {
        match event {
            Event::Started { step, .. } if *step > 0 => self.line(&format!("continuing at step {step}")),
            Event::Started { .. } | Event::Saved { .. } => {}
            Event::Progress { step, seconds, progress, loss, scalars } => {
                let mut text = format!("step {step}  {seconds:.0} s  {}", shown("", "loss", *loss));
                scalars.shown().for_each(|s| text += &shown("  ", &s.name, s.value));
                self.scores.shown().for_each(|s| text += &shown("  held out ", &s.name, s.value));
                if let Some(b) = &self.bar {
                    b.set_position((progress * 1000.0) as u64);
                    b.set_message(text);
                } else if self.last_line.is_none_or(|t| t.elapsed() >= LINE_EVERY) {
                    self.last_line = Some(Instant::now());
                    eprintln!("{text}");
                }
            }
            Event::Preparing { what, share } => {
                if let Some(b) = &self.bar {
                    b.set_message(format!("{what}: {:.0} %", 100.0 * share));
                } else if self.preparing != Some(what) || self.last_line.is_none_or(|t| t.elapsed() >= LINE_EVERY) {
                    self.last_line = Some(Instant::now());
                    eprintln!("{what}: {:.0} %", 100.0 * share);
                }
                self.preparing = Some(what);
            }
            Event::Evaluated { scores, .. } => self.scores = scores.clone(),
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

/// A figure after its name in words.
fn shown(before: &str, name: &str, value: f64) -> String {
    format!("{before}{} {}", label(name), text(name, value))
}

/// Shows the progress of work with a known share: a bar on a terminal, otherwise a line every few seconds; both with the remaining time.
pub struct ShareShown {
    bar: Option<ProgressBar>,
    begin: Instant,
    last_line: Option<Instant>,
}

impl ShareShown {
    pub fn new() -> Self {
        let bar = std::io::stderr().is_terminal().then(|| {
            let bar = ProgressBar::with_draw_target(Some(1000), ProgressDrawTarget::stderr());
            bar.set_style(ProgressStyle::with_template("{bar:30} {msg}").expect("a valid template"));
            bar
        });
        ShareShown { bar, begin: Instant::now(), last_line: None }
    }

    /// Sets the completed share and the description of the work.
    pub fn show(&mut self, share: f64, text: &str) {
        let now = Instant::now();
        let left = time_left(now - self.begin, share);
        let is_known = left.is_some();
        let text = left.map_or(text.to_string(), |left| format!("{text}; {left} left"));
        if let Some(b) = &self.bar {
            b.set_position((share * 1000.0) as u64);
            b.set_message(text);
        } else if self.is_line_due(now, is_known) {
            eprintln!("{text}");
        }
    }

    /// Whether enough time has passed since the last line; the next one is then counted as printed. The first line is printed as soon as
    /// the remaining time is known.
    fn is_line_due(&mut self, now: Instant, is_known: bool) -> bool {
        let due = match self.last_line {
            Some(last) => now.duration_since(last) >= LINE_EVERY,
            None => is_known || now.duration_since(self.begin) >= LINE_EVERY,
        };
        if due {
            self.last_line = Some(now);
        }
        due
    }

    /// Prints a permanent line above the bar.
    pub fn line(&self, text: &str) {
        match &self.bar {
            Some(b) => b.suspend(|| eprintln!("{text}")),
            None => eprintln!("{text}"),
        }
    }

    pub fn finish(&self) {
        if let Some(b) = &self.bar {
            b.finish_and_clear();
        }
    }
}

/// Remaining time in words, assuming constant speed; `None` if too little is done for an estimate.
fn time_left(elapsed: Duration, share: f64) -> Option<String> {
    if share < MIN_SHARE {
        return None;
    }
    let seconds = elapsed.as_secs_f64() * (1.0 - share.min(1.0)) / share;
    Some(if seconds < 100.0 { format!("{seconds:.0} s") } else { format!("{:.0} min", seconds / 60.0) })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_time_left_follows_from_the_share_that_is_done() {
        let after = |seconds: u64, share: f64| time_left(Duration::from_secs(seconds), share);
        assert_eq!(after(10, 0.0), None);
        assert_eq!(after(10, 0.25).unwrap(), "30 s");
        assert_eq!(after(60, 0.1).unwrap(), "9 min");
        assert_eq!(after(60, 1.0).unwrap(), "0 s");
    }

    #[test]
    fn lines_come_every_five_seconds_and_the_first_when_the_time_left_is_known() {
        let due = |known_from: u64| -> Vec<u64> {
            let mut s = ShareShown::new();
            let begin = s.begin;
            (0..14).filter(|i| s.is_line_due(begin + Duration::from_secs(*i), *i >= known_from)).collect()
        };
        assert_eq!(due(1), [1, 6, 11]);
        assert_eq!(due(9), [5, 10]);
    }
}
