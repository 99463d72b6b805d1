//! The loop.

use super::{Event, StepReport};
use crate::metrics::psnr;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

/// How often held-out pixels are judged, and the share of the time that this may take.
const JUDGE_SECONDS: f64 = 10.0;
const JUDGE_SHARE: f64 = 0.03;
/// What judging may take at the end of a run too short for the share.
const JUDGE_ONCE_SECONDS: f64 = 1.0;

/// When a run ends, logs, saves and judges.
#[derive(Clone, Debug, PartialEq)]
pub struct RunOptions {
    pub steps: Option<u64>,
    /// Budget of training time, without decoding; what judging takes counts.
    pub seconds: Option<f64>,
    pub log_every: u64,
    pub save_every_seconds: f64,
    /// Also save each time so many steps are done.
    pub save_every_steps: Option<u64>,
    /// Judge each time so many steps are done; none: every ten seconds, within 3 % of the time.
    pub evaluate_every: Option<u64>,
    /// Rays that judging traces; 0: nothing is held out.
    pub held_out_rays: u64,
}

/// What is trained.
pub trait Trainee {
    type Error;
    /// One optimiser step; `progress` in [0, 1] drives the schedules.
    fn step(&mut self, step: u64, progress: f64) -> Result<StepReport, Self::Error>;
    /// Writes a checkpoint that `step` steps and `seconds` have gone into; false, with nothing written, where a
    /// parameter is not finite.
    fn save(&mut self, step: u64, seconds: f64) -> Result<bool, Self::Error>;
    /// After a loss or a parameter that is not finite: goes back to where it was; the step to go on from and what went
    /// wrong, or `None` if that was tried before.
    fn recover(&mut self) -> Result<Option<(u64, String)>, Self::Error>;
    /// Judges held-out pixels; `None` where that cannot be done now.
    fn evaluate(&mut self) -> Result<Option<HeldOut>, Self::Error>;
}

/// How held-out pixels look.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct HeldOut {
    /// Of all pixels together.
    pub psnr: f64,
    pub mse: f64,
    /// PSNR of each view, named by its frame.
    pub views: Vec<(usize, f64)>,
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
    /// PSNR of held-out pixels when they were judged last.
    pub held_out: Option<f64>,
    pub interrupted: bool,
}

/// Why a run failed.
#[derive(Debug)]
pub enum RunError<E> {
    /// A step, a checkpoint or going back to one failed.
    Failed(E),
    /// The loss or a parameter was not finite at step `first`, and again at `again` after going back.
    Diverged { first: u64, again: u64 },
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
    let clock = Clock { start: Instant::now(), before };
    let mut since = Window::new(before);
    let mut judging = Judging::new(options, origin);
    let mut summary = Summary { step, seconds: before, rays, samples, loss: f64::NAN, psnr: f64::NAN, held_out: None, interrupted: false };
    let (mut last_save, mut fault) = (before, None);
    loop {
        let seconds = clock.seconds();
        let progress = budget_share(options, step, seconds);
        summary.interrupted = interrupt.load(Ordering::Relaxed);
        if progress >= 1.0 || summary.interrupted {
            if since.steps > 0 {
                since.end(&mut summary, (step, clock.seconds(), 1.0), (rays, samples), events);
            }
            if !trainee.save(step, clock.seconds()).map_err(RunError::Failed)? {
                step = go_back(trainee, step, &mut fault, events)?;
                continue;
            }
            if !summary.interrupted && judging.is_worth_it(step, seconds, rays) {
                judging.judge(trainee, step, &clock, &mut summary, events)?;
            }
            break;
        }
        let report = trainee.step(step, progress).map_err(RunError::Failed)?;
        if !report.loss.is_finite() {
            step = go_back(trainee, step, &mut fault, events)?;
            continue;
        }
        step += 1;
        rays += report.rays;
        samples += report.samples;
        since.add(&report);
        if step.is_multiple_of(options.log_every) {
            let seconds = clock.seconds();
            since.end(&mut summary, (step, seconds, budget_share(options, step, seconds)), (rays, samples), events);
        }
        let due =
            clock.seconds() - last_save > options.save_every_seconds || options.save_every_steps.is_some_and(|n| step.is_multiple_of(n));
        if due {
            last_save = clock.seconds();
            if !trainee.save(step, last_save).map_err(RunError::Failed)? {
                step = go_back(trainee, step, &mut fault, events)?;
                continue;
            }
            events(&Event::Saved { step });
        }
        if judging.is_due(step, clock.seconds(), rays) {
            judging.judge(trainee, step, &clock, &mut summary, events)?;
        }
    }
    events(&Event::Saved { step });
    summary = Summary { step, seconds: clock.seconds(), rays, samples, ..summary };
    events(&Event::Finished { step, seconds: summary.seconds, interrupted: summary.interrupted });
    Ok(summary)
}

/// Recovers from what is not finite at `step`; the step to go on from.
fn go_back<T: Trainee>(
    trainee: &mut T,
    step: u64,
    fault: &mut Option<u64>,
    events: &mut dyn FnMut(&Event),
) -> Result<u64, RunError<T::Error>> {
    match trainee.recover().map_err(RunError::Failed)? {
        Some((to_step, why)) => {
            *fault = Some(step);
            events(&Event::Recovered { step, to_step, why });
            Ok(to_step)
        }
        None => Err(RunError::Diverged { first: fault.unwrap_or(step), again: step }),
    }
}

/// Training time: wall time since the start, and what earlier runs took.
struct Clock {
    start: Instant,
    before: f64,
}

impl Clock {
    fn seconds(&self) -> f64 {
        self.before + self.start.elapsed().as_secs_f64()
    }
}

/// Decides when held-out pixels are judged, so that it costs little.
struct Judging {
    every: Option<u64>,
    rays: u64,
    /// Seconds and rays at the start.
    began: (f64, u64),
    last: Option<(u64, f64)>,
    /// Seconds that all judging took, and the last.
    spent: f64,
    cost: Option<f64>,
}

impl Judging {
    fn new(options: &RunOptions, origin: Origin) -> Self {
        let began = (origin.seconds, origin.rays);
        Judging { every: options.evaluate_every, rays: options.held_out_rays, began, last: None, spent: 0.0, cost: None }
    }

    /// What judging will cost: what it cost, else as if its rays were trained on.
    fn expected(&self, seconds: f64, rays: u64) -> f64 {
        let rays_per_s = (rays - self.began.1.min(rays)) as f64 / (seconds - self.began.0).max(1e-9);
        self.cost.unwrap_or(self.rays as f64 / rays_per_s.max(1e-9))
    }

    fn is_affordable(&self, seconds: f64, rays: u64) -> bool {
        self.spent + self.expected(seconds, rays) <= JUDGE_SHARE * (seconds - self.began.0)
    }

    fn is_due(&self, step: u64, seconds: f64, rays: u64) -> bool {
        match self.every {
            _ if self.rays == 0 => false,
            Some(n) => step.is_multiple_of(n),
            None => seconds - self.last.map_or(self.began.0, |l| l.1) >= JUDGE_SECONDS && self.is_affordable(seconds, rays),
        }
    }

    /// At the end of a run.
    fn is_worth_it(&self, step: u64, seconds: f64, rays: u64) -> bool {
        let new = self.last.is_none_or(|l| l.0 != step);
        let cheap = self.is_affordable(seconds, rays) || (self.last.is_none() && self.expected(seconds, rays) <= JUDGE_ONCE_SECONDS);
        self.rays > 0 && rays > self.began.1 && new && cheap
    }

    fn judge<T: Trainee>(
        &mut self,
        trainee: &mut T,
        step: u64,
        clock: &Clock,
        summary: &mut Summary,
        events: &mut dyn FnMut(&Event),
    ) -> Result<(), RunError<T::Error>> {
        let begin = Instant::now();
        let judged = trainee.evaluate().map_err(RunError::Failed)?;
        let cost = begin.elapsed().as_secs_f64();
        (self.cost, self.spent, self.last) = (Some(cost), self.spent + cost, Some((step, clock.seconds())));
        if let Some(HeldOut { psnr, mse, views }) = judged {
            summary.held_out = Some(psnr);
            events(&Event::Evaluated { step, seconds: clock.seconds(), psnr, mse, views });
        }
        Ok(())
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

    /// Tells the means, and begins anew.
    fn end(
        &mut self,
        summary: &mut Summary,
        (step, seconds, progress): (u64, f64, f64),
        (rays, samples): (u64, u64),
        events: &mut dyn FnMut(&Event),
    ) {
        let n = self.steps.max(1) as f64;
        let (loss, mse) = (self.loss / n, self.mse / n);
        (summary.loss, summary.psnr) = (loss, psnr(mse));
        let rays_per_s = self.rays as f64 / (seconds - self.began).max(1e-9);
        events(&Event::Progress { step, seconds, progress, loss, mse, psnr: psnr(mse), rays, samples, rays_per_s });
        *self = Window::new(seconds);
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
    use std::time::Duration;

    #[derive(Default)]
    struct Fake {
        saved: Vec<u64>,
        nan_at: Vec<u64>,
        /// Steps at which parameters are not finite.
        broken_at: Vec<u64>,
        recovered: bool,
        /// What a step and judging take.
        takes: [Duration; 2],
    }

    impl Trainee for Fake {
        type Error = ();
        fn step(&mut self, step: u64, _: f64) -> Result<StepReport, ()> {
            std::thread::sleep(self.takes[0]);
            let bad = self.nan_at.first() == Some(&step);
            if bad {
                self.nan_at.remove(0);
            }
            Ok(StepReport { loss: if bad { f64::NAN } else { 1.0 }, mse: 0.01, rays: 10, samples: 100 })
        }
        fn save(&mut self, step: u64, _: f64) -> Result<bool, ()> {
            if self.broken_at.first() == Some(&step) {
                self.broken_at.remove(0);
                return Ok(false);
            }
            self.saved.push(step);
            Ok(true)
        }
        fn recover(&mut self) -> Result<Option<(u64, String)>, ()> {
            let first = !self.recovered;
            self.recovered = true;
            Ok(first.then_some((2, "a NaN".into())))
        }
        fn evaluate(&mut self) -> Result<Option<HeldOut>, ()> {
            std::thread::sleep(self.takes[1]);
            Ok(Some(HeldOut { psnr: 19.0, mse: 0.0126, views: vec![(3, 19.0)] }))
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
            held_out_rays: 10,
        }
    }

    fn ends(f: &mut Fake, options: &RunOptions) -> (Result<Summary, RunError<()>>, Vec<Event>) {
        let mut log = Vec::new();
        let end = run(options, Origin::default(), f, &AtomicBool::new(false), &mut |e| log.push(e.clone()));
        (end, log)
    }

    #[test]
    fn it_counts_logs_saves_and_judges() {
        let mut f = Fake::default();
        let (s, log) = ends(&mut f, &options());
        let s = s.unwrap();
        assert_eq!((s.step, s.rays, s.samples, s.interrupted), (10, 100, 1000, false));
        assert!((s.psnr - 20.0).abs() < 1e-9 && s.held_out == Some(19.0));
        assert_eq!(f.saved, [5, 10, 10]);
        assert_eq!(log.iter().filter(|e| matches!(e, Event::Progress { .. })).count(), 3);
        assert_eq!(log.iter().filter(|e| matches!(e, Event::Evaluated { .. })).count(), 2);
        let (s, log) = ends(&mut Fake::default(), &RunOptions { held_out_rays: 0, ..options() });
        assert!(s.unwrap().held_out.is_none() && !log.iter().any(|e| matches!(e, Event::Evaluated { .. })), "nothing is held out");
    }

    #[test]
    fn an_interrupt_saves_and_stops() {
        let mut f = Fake::default();
        let s = run(&options(), Origin { step: 3, ..Origin::default() }, &mut f, &AtomicBool::new(true), &mut |_| {}).unwrap();
        assert!(s.interrupted && f.saved == [3]);
    }

    #[test]
    fn one_nan_is_survived_and_a_second_ends_the_run_with_both_steps() {
        let mut f = Fake { nan_at: vec![4], ..Fake::default() };
        assert!(ends(&mut f, &options()).0.is_ok());
        let mut f = Fake { nan_at: vec![4, 6], ..Fake::default() };
        assert!(matches!(ends(&mut f, &options()).0, Err(RunError::Diverged { first: 4, again: 6 })));
    }

    #[test]
    fn parameters_that_are_not_finite_are_never_the_end() {
        // Found in the middle of the run, and when it is over.
        for at in [5, 10] {
            let mut f = Fake { broken_at: vec![at], ..Fake::default() };
            let (s, log) = ends(&mut f, &RunOptions { save_every_steps: Some(at), ..options() });
            assert_eq!(s.unwrap().step, 10);
            assert!(log.iter().any(|e| matches!(e, Event::Recovered { step, to_step: 2, .. } if *step == at)));
            assert_eq!(f.saved.last(), Some(&10));
        }
        let mut f = Fake { broken_at: vec![5, 5], ..Fake::default() };
        assert!(matches!(ends(&mut f, &options()).0, Err(RunError::Diverged { first: 5, again: 5 })));
    }

    #[test]
    fn judging_takes_its_share_of_the_budget_and_no_more() {
        let o = RunOptions { evaluate_every: None, ..options() };
        let origin = Origin { seconds: 100.0, rays: 7000, ..Origin::default() };
        let j = Judging::new(&o, origin);
        // 10 rays at 50 rays a second are expected to take 0.2 s: 3 % of 6.7 s, but not before ten seconds are over.
        assert!(!j.is_due(9, 107.0, 7350) && j.is_due(9, 110.0, 7500));
        let dear = Judging { spent: 0.6, cost: Some(0.6), last: Some((9, 110.0)), ..j };
        assert!(!dear.is_due(50, 130.0, 9000) && dear.is_due(50, 140.5, 9000));
        // Slow trainees are judged later, and a short run once at its end.
        let slow = Judging::new(&RunOptions { held_out_rays: 1000, ..o.clone() }, origin);
        assert!(!slow.is_due(9, 110.0, 7500) && !slow.is_worth_it(9, 110.0, 7500));
        assert!(Judging::new(&o, origin).is_worth_it(9, 101.0, 7050));
        // It counts in the seconds of a run.
        let mut f = Fake { takes: [Duration::from_millis(1), Duration::from_millis(200)], ..Fake::default() };
        let o = RunOptions { steps: None, seconds: Some(0.5), evaluate_every: Some(5), save_every_steps: None, ..options() };
        let s = ends(&mut f, &o).0.unwrap();
        assert!(s.step <= 20, "{} steps of a millisecond, one of five judged for 200", s.step);
    }
}
