//! Runs that go wrong.

use super::*;

/// A real trainer whose parameters are spoilt before some steps, and what its losses were.
struct Spoilt {
    trainer: Trainer<'static>,
    at: Vec<u64>,
    losses: Vec<f64>,
    starts: Vec<Vec<f32>>,
}

impl Trainee for Spoilt {
    type Error = PipelineError;
    fn step(&mut self, step: u64, progress: f64) -> Result<StepReport> {
        if step == 0 {
            self.starts.push(self.trainer.model.field.weights.values.clone());
        }
        if self.at.first() == Some(&step) {
            self.at.remove(0);
            self.trainer.model.field.weights.values.fill(f32::NAN);
        }
        let report = self.trainer.step(step, progress)?;
        self.losses.push(report.loss);
        Ok(report)
    }
    fn save(&mut self, _: u64, _: f64) -> Result<bool> {
        Ok(!self.trainer.model.is_broken())
    }
    fn recover(&mut self) -> Result<Option<(u64, String)>> {
        self.trainer.recover()
    }
    fn evaluate(&mut self) -> Result<Option<HeldOut>> {
        self.trainer.evaluate()
    }
}

fn spoilt(at: &[u64]) -> (std::result::Result<Summary, RunError<PipelineError>>, Spoilt) {
    let dir = tempfile::tempdir().unwrap();
    crate::object::quickstart::write_capture(dir.path(), 8, 24).unwrap();
    let mut c = Config::new(Method::Ngp, dir.path().into());
    for (k, v) in [("field.log2_size", "10"), ("sampling.rays", "64"), ("sampling.occupancy_points", "512"), ("device", "cpu")] {
        c.set(k, v).unwrap();
    }
    let mut s = Spoilt { trainer: scratch_trainer(&c, false).unwrap(), at: at.to_vec(), losses: Vec::new(), starts: Vec::new() };
    let options = RunOptions { steps: Some(6), ..run_options(&c) };
    let end = train::run(&options, Default::default(), &mut s, &AtomicBool::new(false), &mut |_| {});
    (end, s)
}

#[test]
fn a_nan_before_the_first_checkpoint_begins_the_run_again_at_a_lower_rate() {
    let (end, s) = spoilt(&[3]);
    assert_eq!(end.unwrap().step, 6);
    // Three good steps, one that is not finite, six good ones.
    let finite: Vec<bool> = s.losses.iter().map(|l| l.is_finite()).collect();
    assert_eq!(finite, [true, true, true, false, true, true, true, true, true, true]);
    assert!(s.starts.len() == 2 && s.starts[0] == s.starts[1], "it began elsewhere");
    assert!((s.trainer.model.rate_scale - 0.3).abs() < 1e-6);
}

#[test]
fn a_second_nan_ends_the_run_with_both_steps() {
    let (end, s) = spoilt(&[3, 4]);
    assert_eq!(s.losses.iter().filter(|l| !l.is_finite()).count(), 2);
    assert!(matches!(end, Err(RunError::Diverged { first: 3, again: 4 })), "{end:?}");
    let e = PipelineError::Diverged { first: 3, again: 4, kept: kept(Path::new("no/such/folder")) }.to_string();
    assert!(e.contains("step 3, and again at step 4") && e.contains("no checkpoint") && !e.contains("safetensors"), "{e}");
}
