//! Runs that go wrong.

use super::*;
use crate::error::PipelineError;
use crate::object::config::Method;
use crate::run::training::kept;
use diorama_engine::renderers::volume::Quality;
use diorama_engine::train::{self, RunError, Scores, StepReport};
use diorama_geom::Reduction;
use diorama_geom::capture::SparsePoint;

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
    fn evaluate(&mut self) -> Result<Option<Scores>> {
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
    let mut s = Spoilt {
        trainer: scratch_trainer(&c, false, Loaded::new(&c).unwrap()).unwrap(),
        at: at.to_vec(),
        losses: Vec::new(),
        starts: Vec::new(),
    };
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

/// A trainer on a small capture in unbounded space, half as large as its photographs.
fn unbounded() -> Trainer<'static> {
    let dir = tempfile::tempdir().unwrap();
    crate::object::quickstart::write_capture(dir.path(), 10, 48).unwrap();
    let mut c = Config::new(Method::Ngp, dir.path().into());
    for (k, v) in [
        ("field.log2_size", "12"),
        ("field.space", "unbounded"),
        ("sampling.rays", "256"),
        ("sampling.occupancy_points", "4096"),
        ("sampling.occupancy_resolution", "32"),
        ("loss.distortion", "0"),
        ("data.downscale", "2"),
        ("device", "cpu"),
    ] {
        c.set(k, v).unwrap();
    }
    scratch_trainer(&c, false, Loaded::new(&c).unwrap()).unwrap()
}

/// A point before the middle of frame 1's picture, seen by frames 0 (held out), 1, 2 and 3.
fn add_point(t: &mut Trainer, away: f64, error: f32, frames: &[u32]) {
    let capture = &mut t.model.capture;
    let (pose, camera) = (&capture.frames[1].world_from_camera, capture.frames[1].camera.reduced(Reduction::ShortestSide(24)));
    let position = pose.point(camera.direction(12.5, 12.5) * away);
    capture.points.push(SparsePoint { position, color: [0; 3], error, frames: frames.to_vec() });
}

#[test]
fn observations_are_the_pixels_and_distances_of_points_that_are_sure() {
    let mut t = unbounded();
    let scale = t.model.model_from_world.scale;
    add_point(&mut t, 0.5, 0.4, &[0, 1, 2, 3]);
    add_point(&mut t, 0.5, 9.0, &[0, 1, 2, 3]);
    add_point(&mut t, 0.5, 0.4, &[0, 1, 2]);
    let too_close = 0.5 * t.model.config.sampling.near as f64 / scale;
    add_point(&mut t, too_close, 0.4, &[1, 2, 3]);
    t.model.config.set("loss.depth_from", "points").unwrap();
    let (got, source) = observations::find(&mut t.model, &t.photographs, &AtomicBool::new(false), &mut |_| {});
    assert_eq!(source, observations::Source::Points);
    let image = t.model.train.iter().position(|f| *f == 1).unwrap() as u32;
    assert!(got.iter().all(|o| t.model.train[o.image as usize] != 0), "frame 0 is held out: {got:?}");
    let ahead: Vec<_> = got.iter().filter(|o| o.image == image).collect();
    assert!(ahead.len() == 1 && (ahead[0].x, ahead[0].y) == (12, 12), "the middle of 24 pixels, once: {got:?}");
    assert!((ahead[0].distance as f64 / scale - 0.5).abs() < 1e-5, "{got:?}");
}

#[test]
fn distances_come_from_where_the_configuration_says() {
    for (from, points, want) in [
        ("points", 0, observations::Source::Points),
        ("stereo", 2000, observations::Source::Stereo),
        ("auto", 0, observations::Source::Stereo),
        ("auto", 3, observations::Source::Stereo),
        ("auto", 2000, observations::Source::Points),
    ] {
        let mut t = unbounded();
        (0..points).for_each(|_| add_point(&mut t, 0.5, 0.4, &[1, 2, 3]));
        t.model.config.loss.depth_from = from.into();
        let (found, source) = observations::find(&mut t.model, &t.photographs, &AtomicBool::new(false), &mut |_| {});
        assert_eq!(source, want, "{from} with {points} points");
        assert!(source == observations::Source::Stereo || found.len() >= points, "{from}: {} of {points}", found.len());
        // What was found once stays so when the run is resumed.
        assert_eq!(t.model.config.loss.depth_from, if want == observations::Source::Points { "points" } else { "stereo" });
    }
}

/// How far matter stands, on average over the light, in the middle of frame 1, in the world.
fn depth_in_the_middle(depth: &str) -> f64 {
    let mut t = unbounded();
    t.model.config.set("loss.depth", depth).unwrap();
    let camera = t.model.capture.frames[1].camera;
    // Closer than anything that the photographs show.
    add_point(&mut t, 0.4, 0.0, &[1, 2, 3]);
    t.observations = if t.model.depth() > 0.0 { observations::of_points(&t.model) } else { Vec::new() };
    t.observations.retain(|o| t.model.train[o.image as usize] == 1);
    for step in 0..100 {
        t.step(step, step as f64 / 100.0).unwrap();
    }
    let pose = t.model.capture.frames[1].world_from_camera;
    let view = t.model.tracer(Quality::Full).view(&t.model.to_model(camera.reduced(Reduction::ShortestSide(24)), &pose), &mut |_| {});
    view.depth.pixel(12, 12)[0] as f64 / t.model.model_from_world.scale
}

#[test]
fn matter_gathers_where_a_point_is_seen() {
    let (without, with) = (depth_in_the_middle("0"), depth_in_the_middle("3"));
    assert!((with - 0.4).abs() < 0.3 && without > 1.0, "{with} with the point at 0.4, {without} without");
}
