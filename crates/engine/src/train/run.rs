//! The training loop: steps until the budget is spent, with logging, checkpoints, evaluations and recovery.

use super::{Event, Scalar, Scalars, Scores, StepReport};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

/// Seconds between evaluations, and the share of the time that they may take.
const EVALUATE_SECONDS: f64 = 10.0;
const EVALUATE_SHARE: f64 = 0.03;
/// Seconds that an evaluation may take at the end of a run too short for the share.
const EVALUATE_ONCE_SECONDS: f64 = 1.0;

/// When a run ends, logs, saves and evaluates.
#[derive(Clone, Debug, PartialEq)]
pub struct RunOptions {
    pub steps: Option<u64>,
    /// Budget of training time, without decoding; evaluations count.
    pub seconds: Option<f64>,
    pub log_every: u64,
    pub save_every_seconds: f64,
    /// Also save each time so many steps are done.
    pub save_every_steps: Option<u64>,
    /// Evaluate each time so many steps are done; none: every ten seconds, within 3 % of the time.
    pub evaluate_every: Option<u64>,
}

/// A model in training, as the loop drives it.
pub trait Trainee {
    type Error;
    /// Long work that is due before a step; after an interrupt, the step is not taken.
    fn prepare(&mut self, _step: u64, _progress: f64, _interrupt: &AtomicBool, _events: &mut dyn FnMut(&Event)) -> Result<(), Self::Error> {
        Ok(())
    }
    /// One optimizer step; `progress` in [0, 1] drives the schedules.
    fn step(&mut self, step: u64, progress: f64) -> Result<StepReport, Self::Error>;
    /// Writes a checkpoint that `step` steps and `seconds` have gone into; false, with nothing written, where a
    /// parameter is not finite.
    fn save(&mut self, step: u64, seconds: f64) -> Result<bool, Self::Error>;
    /// After a loss or a parameter that is not finite: goes back to where it was; the step to go on from and what went
    /// wrong, or `None` if that was tried before.
    fn recover(&mut self) -> Result<Option<(u64, String)>, Self::Error>;
    /// Scores what has been learned so far; `None` where nothing is held out, or it cannot be done now.
    fn evaluate(&mut self) -> Result<Option<Scores>, Self::Error> {
        Ok(None)
    }
    /// About how many seconds the first [`Trainee::evaluate`] will take, after `seconds` of training; later ones are expected to take as
    /// long as the last.
    fn evaluation_seconds(&self, _seconds: f64) -> f64 {
        0.0
    }
}

/// How a run ended.
#[derive(Clone, Debug, PartialEq)]
pub struct Summary {
    pub step: u64,
    pub seconds: f64,
    /// Mean over the last logging interval; not a number where there was none.
    pub loss: f64,
    /// Figures of the last logging interval.
    pub scalars: Scalars,
    /// Of the last evaluation.
    pub scores: Option<Scores>,
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

/// Step and seconds at which a run begins: zero, or those of a checkpoint.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Origin {
    pub step: u64,
    pub seconds: f64,
}

/// Trains until the budget is spent or `interrupt` is set; a last checkpoint is always written.
pub fn run<T: Trainee>(
    options: &RunOptions,
    origin: Origin,
    trainee: &mut T,
    interrupt: &AtomicBool,
    events: &mut dyn FnMut(&Event),
) -> Result<Summary, RunError<T::Error>> {
    let Origin { mut step, seconds: before } = origin;
    events(&Event::Started { step, steps: options.steps, seconds: options.seconds });
    let clock = Clock { start: Instant::now(), before };
    let mut interval = Interval::new(before);
    let mut evaluations = Evaluations::new(options, origin);
    let mut summary = Summary { step, seconds: before, loss: f64::NAN, scalars: Scalars::default(), scores: None, interrupted: false };
    let (mut last_save, mut fault) = (before, None);
    loop {
        let seconds = clock.seconds();
        let progress = budget_share(options, step, seconds);
        summary.interrupted = interrupt.load(Ordering::Relaxed);
        if progress >= 1.0 || summary.interrupted {
            if interval.steps > 0 {
                interval.end(&mut summary, (step, clock.seconds(), 1.0), events);
            }
            if !trainee.save(step, clock.seconds()).map_err(RunError::Failed)? {
                step = go_back(trainee, step, &mut fault, events)?;
                continue;
            }
            if !summary.interrupted && evaluations.is_last_worth_it(step, seconds, trainee) {
                evaluations.evaluate(trainee, step, &clock, &mut summary, events)?;
            }
            break;
        }
        trainee.prepare(step, progress, interrupt, events).map_err(RunError::Failed)?;
        if interrupt.load(Ordering::Relaxed) {
            continue;
        }
        let report = trainee.step(step, progress).map_err(RunError::Failed)?;
        if !report.loss.is_finite() {
            step = go_back(trainee, step, &mut fault, events)?;
            continue;
        }
        step += 1;
        interval.add(report);
        if step.is_multiple_of(options.log_every) {
            let seconds = clock.seconds();
            interval.end(&mut summary, (step, seconds, budget_share(options, step, seconds)), events);
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
        if evaluations.are_due(step, clock.seconds(), trainee) {
            evaluations.evaluate(trainee, step, &clock, &mut summary, events)?;
        }
    }
    events(&Event::Saved { step });
    summary = Summary { step, seconds: clock.seconds(), ..summary };
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

/// Decides when to evaluate, so that it costs little.
struct Evaluations {
    every: Option<u64>,
    /// Step and seconds at the start.
    began: (u64, f64),
    last: Option<(u64, f64)>,
    /// Seconds that all evaluations took, and the last.
    spent: f64,
    cost: Option<f64>,
}

impl Evaluations {
    fn new(options: &RunOptions, origin: Origin) -> Self {
        Evaluations { every: options.evaluate_every, began: (origin.step, origin.seconds), last: None, spent: 0.0, cost: None }
    }

    /// Seconds that the next evaluation will take: as the last did, else the trainee's guess.
    fn expected(&self, seconds: f64, trainee: &impl Trainee) -> f64 {
        self.cost.unwrap_or_else(|| trainee.evaluation_seconds(seconds - self.began.1))
    }

    fn are_affordable(&self, seconds: f64, trainee: &impl Trainee) -> bool {
        self.spent + self.expected(seconds, trainee) <= EVALUATE_SHARE * (seconds - self.began.1)
    }

    fn are_due(&self, step: u64, seconds: f64, trainee: &impl Trainee) -> bool {
        match self.every {
            Some(n) => step.is_multiple_of(n),
            None => seconds - self.last.map_or(self.began.1, |l| l.1) >= EVALUATE_SECONDS && self.are_affordable(seconds, trainee),
        }
    }

    /// Whether to evaluate at the end of a run.
    fn is_last_worth_it(&self, step: u64, seconds: f64, trainee: &impl Trainee) -> bool {
        let is_new = self.last.is_none_or(|l| l.0 != step);
        let is_cheap = self.last.is_none() && self.expected(seconds, trainee) <= EVALUATE_ONCE_SECONDS;
        step > self.began.0 && is_new && (is_cheap || self.are_affordable(seconds, trainee))
    }

    fn evaluate<T: Trainee>(
        &mut self,
        trainee: &mut T,
        step: u64,
        clock: &Clock,
        summary: &mut Summary,
        events: &mut dyn FnMut(&Event),
    ) -> Result<(), RunError<T::Error>> {
        let begin = Instant::now();
        let scores = trainee.evaluate().map_err(RunError::Failed)?;
        let cost = begin.elapsed().as_secs_f64();
        (self.cost, self.spent, self.last) = (Some(cost), self.spent + cost, Some((step, clock.seconds())));
        if let Some(scores) = scores {
            let scores = Scalars(scores.0.into_iter().map(|s| s.over(1, cost.max(1e-9))).collect());
            events(&Event::Evaluated { step, seconds: clock.seconds(), scores: scores.clone() });
            summary.scores = Some(scores);
        }
        Ok(())
    }
}

/// Sums over the steps of a logging interval.
struct Interval {
    steps: u64,
    loss: f64,
    /// Of each figure, with the number of steps that reported it.
    scalars: Vec<(Scalar, u64)>,
    began: f64,
}

impl Interval {
    fn new(began: f64) -> Self {
        Interval { steps: 0, loss: 0.0, scalars: Vec::new(), began }
    }

    fn add(&mut self, report: StepReport) {
        self.steps += 1;
        self.loss += report.loss;
        for s in report.scalars.0 {
            match self.scalars.iter_mut().find(|(sum, _)| sum.name == s.name) {
                Some((sum, steps)) => {
                    sum.add(s.value);
                    *steps += 1;
                }
                None => self.scalars.push((s, 1)),
            }
        }
    }

    /// Emits what the steps came to, and begins anew.
    fn end(&mut self, summary: &mut Summary, (step, seconds, progress): (u64, f64, f64), events: &mut dyn FnMut(&Event)) {
        let took = (seconds - self.began).max(1e-9);
        let Interval { steps, loss, scalars, .. } = std::mem::replace(self, Interval::new(seconds));
        summary.loss = loss / steps.max(1) as f64;
        summary.scalars = Scalars(scalars.into_iter().map(|(s, steps)| s.over(steps, took)).collect());
        events(&Event::Progress { step, seconds, progress, loss: summary.loss, scalars: summary.scalars.clone() });
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
        steps: u64,
        /// What a step and an evaluation take.
        takes: [Duration; 2],
        /// What the first evaluation is guessed to take for each second of training.
        guess: f64,
        nothing_held_out: bool,
    }

    impl Trainee for Fake {
        type Error = ();
        fn step(&mut self, step: u64, _: f64) -> Result<StepReport, ()> {
            std::thread::sleep(self.takes[0]);
            let bad = self.nan_at.first() == Some(&step);
            if bad {
                self.nan_at.remove(0);
            }
            self.steps += 1;
            // A figure that no other application has, and one that only every second step knows.
            let mut scalars = vec![Scalar::psnr("psnr", 0.01), Scalar::count("words", 10 * self.steps)];
            scalars.extend(step.is_multiple_of(2).then(|| Scalar::new("accuracy", step as f64)));
            Ok(StepReport { loss: if bad { f64::NAN } else { 1.0 }, scalars: Scalars(scalars) })
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
        fn evaluate(&mut self) -> Result<Option<Scores>, ()> {
            std::thread::sleep(self.takes[1]);
            Ok((!self.nothing_held_out).then(|| Scores::from([Scalar::psnr("albedo_psnr", 0.01)])))
        }
        fn evaluation_seconds(&self, seconds: f64) -> f64 {
            self.guess * seconds
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

    fn ends(f: &mut Fake, options: &RunOptions) -> (Result<Summary, RunError<()>>, Vec<Event>) {
        let mut log = Vec::new();
        let end = run(options, Origin::default(), f, &AtomicBool::new(false), &mut |e| log.push(e.clone()));
        (end, log)
    }

    #[test]
    fn it_counts_logs_saves_and_evaluates() {
        let mut f = Fake::default();
        let (s, log) = ends(&mut f, &options());
        let s = s.unwrap();
        assert_eq!((s.step, s.scalars.get("words"), s.interrupted), (10, Some(100.0), false));
        assert!((s.scalars.get("psnr").unwrap() - 20.0).abs() < 1e-9);
        assert_eq!(s.scores.and_then(|s| s.get("albedo_psnr")), Some(20.0));
        assert_eq!(f.saved, [5, 10, 10]);
        let accuracy = |e: &Event| if let Event::Progress { scalars, .. } = e { scalars.get("accuracy") } else { None };
        assert_eq!(log.iter().filter_map(accuracy).collect::<Vec<_>>(), [1.0, 5.0, 8.0], "means of the steps that know it");
        assert_eq!(log.iter().filter(|e| matches!(e, Event::Evaluated { .. })).count(), 2);
        let (s, log) = ends(&mut Fake { nothing_held_out: true, ..Fake::default() }, &options());
        assert!(s.unwrap().scores.is_none() && !log.iter().any(|e| matches!(e, Event::Evaluated { .. })), "nothing is held out");
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
    fn evaluations_take_their_share_of_the_budget_and_no_more() {
        let o = RunOptions { evaluate_every: None, ..options() };
        let origin = Origin { step: 5, seconds: 100.0 };
        let e = Evaluations::new(&o, origin);
        // Guessed to take 2 % of the training before it: within 3 % at once, but not before ten seconds are over.
        let f = Fake { guess: 0.02, ..Fake::default() };
        assert!(!e.are_due(9, 107.0, &f) && e.are_due(9, 110.0, &f));
        let dear = Evaluations { spent: 0.6, cost: Some(0.6), last: Some((9, 110.0)), ..e };
        assert!(!dear.are_due(50, 130.0, &f) && dear.are_due(50, 140.5, &f));
        // What takes long comes later, and once at the end of a short run.
        let slow = Fake { guess: 2.0, ..Fake::default() };
        let e = Evaluations::new(&o, origin);
        assert!(!e.are_due(9, 110.0, &slow) && !e.is_last_worth_it(9, 110.0, &slow));
        assert!(e.is_last_worth_it(9, 100.4, &slow) && !e.is_last_worth_it(5, 100.4, &slow));
        // It counts in the seconds of a run.
        let mut f = Fake { takes: [Duration::from_millis(1), Duration::from_millis(200)], ..Fake::default() };
        let o = RunOptions { steps: None, seconds: Some(0.5), evaluate_every: Some(5), save_every_steps: None, ..options() };
        let s = ends(&mut f, &o).0.unwrap();
        assert!(s.step <= 20, "{} steps of a millisecond, one of five evaluated for 200", s.step);
    }
}
