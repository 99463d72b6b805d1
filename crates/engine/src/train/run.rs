//! The loop.

use super::{Event, StepReport};
use crate::metrics::psnr;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

/// When a run ends, logs, saves and judges.
#[derive(Clone, Debug, PartialEq)]
pub struct RunOptions {
    pub steps: Option<u64>,
    /// Budget of training time, without decoding and judging.
    pub seconds: Option<f64>,
    pub log_every: u64,
    pub save_every_seconds: f64,
    /// Also save each time so many steps are done.
    pub save_every_steps: Option<u64>,
    pub evaluate_every: Option<u64>,
}

/// What is trained.
pub trait Trainee {
    type Error;
    /// One optimiser step; `progress` in [0, 1] drives the schedules.
    fn step(&mut self, step: u64, progress: f64) -> Result<StepReport, Self::Error>;
    /// Writes a checkpoint that `step` steps and `seconds` have gone into.
    fn save(&mut self, step: u64, seconds: f64) -> Result<(), Self::Error>;
    /// After a loss that is not finite: goes back to where it was; the step to go on from and what went wrong, or
    /// `None` if that was tried before.
    fn recover(&mut self) -> Result<Option<(u64, String)>, Self::Error>;
    /// PSNR and MSE on some held-out views.
    fn evaluate(&mut self) -> (f64, f64);
}

/// How a run ended.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Summary {
    pub step: u64,
    pub seconds: f64,
    pub rays: u64,
    pub samples: u64,
    /// Means over the last logging interval.
    pub loss: f64,
    pub psnr: f64,
    pub interrupted: bool,
}

/// Why a run failed.
#[derive(Debug)]
pub enum RunError<E> {
    /// A step, a checkpoint or going back to one failed.
    Failed(E),
    /// The loss was not finite twice; the last good checkpoint is of this step.
    Diverged { step: u64 },
}

/// Where a run begins: zero, or what a checkpoint says.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Origin {
    pub step: u64,
    pub seconds: f64,
    pub rays: u64,
    pub samples: u64,
}

/// Trains until the budget is spent or `interrupt` is set; a last checkpoint is always written.
pub fn run<T: Trainee>(
    options: &RunOptions,
    origin: Origin,
    trainee: &mut T,
    interrupt: &AtomicBool,
    events: &mut dyn FnMut(&Event),
) -> Result<Summary, RunError<T::Error>> {
    let Origin { mut step, seconds: before, mut rays, mut samples } = origin;
    events(&Event::Started { step, steps: options.steps, seconds: options.seconds });
    let mut clock = Clock { start: Instant::now(), paused: 0.0, before };
    let mut since = Window::new(before);
    let mut summary = Summary { step, seconds: before, rays, samples, loss: f64::NAN, psnr: f64::NAN, interrupted: false };
    let mut last_save = before;
    loop {
        let seconds = clock.seconds();
        let progress = budget_share(options, step, seconds);
        summary.interrupted = interrupt.load(Ordering::Relaxed);
        if progress >= 1.0 || summary.interrupted {
            break;
        }
        let report = trainee.step(step, progress).map_err(RunError::Failed)?;
        if !report.loss.is_finite() {
            match trainee.recover().map_err(RunError::Failed)? {
                Some((to_step, why)) => {
                    events(&Event::Recovered { step, to_step, why });
                    step = to_step;
                    continue;
                }
                None => return Err(RunError::Diverged { step }),
            }
        }
        step += 1;
        rays += report.rays;
        samples += report.samples;
        since.add(&report);
        if step.is_multiple_of(options.log_every) {
            let seconds = clock.seconds();
            let p = since.event(step, seconds, budget_share(options, step, seconds), rays, samples);
            if let Event::Progress { loss, psnr, .. } = p {
                (summary.loss, summary.psnr) = (loss, psnr);
            }
            events(&p);
            since = Window::new(seconds);
        }
        let due =
            clock.seconds() - last_save > options.save_every_seconds || options.save_every_steps.is_some_and(|n| step.is_multiple_of(n));
        if due {
            last_save = clock.seconds();
            trainee.save(step, last_save).map_err(RunError::Failed)?;
            events(&Event::Saved { step });
        }
        if options.evaluate_every.is_some_and(|n| step.is_multiple_of(n)) {
            let pause = Instant::now();
            let (psnr, mse) = trainee.evaluate();
            clock.paused += pause.elapsed().as_secs_f64();
            events(&Event::Evaluated { step, seconds: clock.seconds(), psnr, mse });
        }
    }
    if since.steps > 0 {
        let p = since.event(step, clock.seconds(), 1.0, rays, samples);
        if let Event::Progress { loss, psnr, .. } = p {
            (summary.loss, summary.psnr) = (loss, psnr);
        }
        events(&p);
    }
    let seconds = clock.seconds();
    trainee.save(step, seconds).map_err(RunError::Failed)?;
    events(&Event::Saved { step });
    summary = Summary { step, seconds: clock.seconds(), rays, samples, ..summary };
    events(&Event::Finished { step, seconds: summary.seconds, interrupted: summary.interrupted });
    Ok(summary)
}

/// Training time: wall time without the pauses.
struct Clock {
    start: Instant,
    paused: f64,
    before: f64,
}

impl Clock {
    fn seconds(&self) -> f64 {
        self.before + self.start.elapsed().as_secs_f64() - self.paused
    }
}

/// Sums since the last log.
struct Window {
    steps: u64,
    loss: f64,
    mse: f64,
    rays: u64,
    began: f64,
}

impl Window {
    fn new(began: f64) -> Self {
        Window { steps: 0, loss: 0.0, mse: 0.0, rays: 0, began }
    }

    fn add(&mut self, r: &StepReport) {
        self.steps += 1;
        self.loss += r.loss;
        self.mse += r.mse;
        self.rays += r.rays;
    }

    fn event(&self, step: u64, seconds: f64, progress: f64, rays: u64, samples: u64) -> Event {
        let n = self.steps.max(1) as f64;
        let mse = self.mse / n;
        let rays_per_s = self.rays as f64 / (seconds - self.began).max(1e-9);
        Event::Progress { step, seconds, progress, loss: self.loss / n, mse, psnr: psnr(mse), rays, samples, rays_per_s }
    }
}

fn budget_share(options: &RunOptions, step: u64, seconds: f64) -> f64 {
    let steps = options.steps.map_or(0.0, |n| step as f64 / n.max(1) as f64);
    let time = options.seconds.map_or(0.0, |s| seconds / s.max(1e-9));
    steps.max(time)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Default)]
    struct Fake {
        saved: Vec<u64>,
        nan_at: Vec<u64>,
        recovered: bool,
    }

    impl Trainee for Fake {
        type Error = ();
        fn step(&mut self, step: u64, _: f64) -> Result<StepReport, ()> {
            let bad = self.nan_at.first() == Some(&step);
            if bad {
                self.nan_at.remove(0);
            }
            Ok(StepReport { loss: if bad { f64::NAN } else { 1.0 }, mse: 0.01, rays: 10, samples: 100 })
        }
        fn save(&mut self, step: u64, _: f64) -> Result<(), ()> {
            self.saved.push(step);
            Ok(())
        }
        fn recover(&mut self) -> Result<Option<(u64, String)>, ()> {
            let first = !self.recovered;
            self.recovered = true;
            Ok(first.then_some((2, "a NaN".into())))
        }
        fn evaluate(&mut self) -> (f64, f64) {
            (20.0, 0.01)
        }
    }

    fn options() -> RunOptions {
        RunOptions {
            steps: Some(10),
            seconds: None,
            log_every: 4,
            save_every_seconds: 1e9,
            save_every_steps: Some(5),
            evaluate_every: Some(5),
        }
    }

    #[test]
    fn it_counts_logs_saves_and_judges() {
        let (mut f, mut log) = (Fake::default(), Vec::new());
        let s = run(&options(), Origin::default(), &mut f, &AtomicBool::new(false), &mut |e| log.push(e.clone())).unwrap();
        assert_eq!((s.step, s.rays, s.samples, s.interrupted), (10, 100, 1000, false));
        assert!((s.psnr - 20.0).abs() < 1e-9);
        assert_eq!(f.saved, [5, 10, 10]);
        assert_eq!(log.iter().filter(|e| matches!(e, Event::Progress { .. })).count(), 3);
        assert_eq!(log.iter().filter(|e| matches!(e, Event::Evaluated { .. })).count(), 2);
    }

    #[test]
    fn an_interrupt_saves_and_stops() {
        let mut f = Fake::default();
        let s = run(&options(), Origin { step: 3, ..Origin::default() }, &mut f, &AtomicBool::new(true), &mut |_| {}).unwrap();
        assert!(s.interrupted && f.saved == [3]);
    }

    #[test]
    fn one_nan_is_survived_and_a_second_ends_the_run() {
        let mut f = Fake { nan_at: vec![4], ..Fake::default() };
        assert!(run(&options(), Origin::default(), &mut f, &AtomicBool::new(false), &mut |_| {}).is_ok());
        let mut f = Fake { nan_at: vec![4, 6], ..Fake::default() };
        let e = run(&options(), Origin::default(), &mut f, &AtomicBool::new(false), &mut |_| {});
        assert!(matches!(e, Err(RunError::Diverged { step: 6 })));
    }
}
