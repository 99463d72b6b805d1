//! Training of the object model: chooses photographs, steps through both stages, and begins again when a surface is lost.

use super::capture::ObjectCapture;
use super::config::Config;
use super::model::{ObjectModel, Stage};
use super::scores;
use super::topology::{StepInput, StepLoss};
use crate::error::{PipelineError, Result};
use diorama_data::checkpoint;
use diorama_engine::train::{Scalar, Scalars, Scores, StepReport, Trainee};
use diorama_geom::capture::Split;
use diorama_geom::rng::Rng;
use diorama_mesh::surface_limits::SurfaceFault;
use std::path::Path;

/// Streams of random numbers.
const ORDER: u64 = 32;
const STEP: u64 = 33;
/// How often the first stage may begin.
const BEGINNINGS: u32 = 4;
/// What is added to the distances, in cells, when the surface vanished, and taken off when it exploded.
const BIAS: f32 = 0.3;
/// Held-out photographs that are compared during training.
const COMPARED: usize = 4;

/// A model in training.
pub(super) struct Trainer<'a> {
    pub model: ObjectModel,
    pub capture: ObjectCapture,
    train: Vec<usize>,
    checkpoints: &'a Path,
    fault: Option<(u64, SurfaceFault)>,
    recovered: bool,
}

impl<'a> Trainer<'a> {
    pub fn new(model: ObjectModel, capture: ObjectCapture, checkpoints: &'a Path) -> Trainer<'a> {
        let train = capture.indices(Split::Train);
        Trainer { model, capture, train, checkpoints, fault: None, recovered: false }
    }

    /// The photographs of a step: each once before any comes again.
    fn chosen(&self, step: u64) -> Vec<usize> {
        let (n, batch) = (self.train.len() as u64, self.model.config.run.batch as u64);
        let rng = Rng::new(self.model.config.seed, ORDER);
        let of = |draw: u64| {
            let (round, place) = (draw / n, (draw % n) as usize);
            let mut order: Vec<usize> = (0..n as usize).collect();
            order.sort_by_key(|i| rng.bits(round * n + *i as u64));
            self.train[order[place]]
        };
        (step * batch..(step + 1) * batch).map(of).collect()
    }

    fn report(loss: &StepLoss, n: usize) -> StepReport {
        let scalars = Scalars::from([
            Scalar::psnr("psnr", loss.mse),
            Scalar::new("mask_loss", loss.mask).logged_only(),
            Scalar::new("regularizers", loss.regularizers).logged_only(),
            Scalar::new("faces", loss.faces as f64),
            Scalar::rate("views_per_s", n as f64),
        ]);
        StepReport { loss: loss.total(), scalars }
    }
}

/// The share of a stage that is done, and the step within it, from 1.
fn place(config: &Config, step: u64) -> (f32, u32) {
    let (first, second) = (config.topology_steps(), config.run.texture_steps);
    let (done, of) = match step {
        s if s < first => (s, first),
        s if s < first + second => (s - first, second),
        s => (s - first - second, config.run.traced_steps),
    };
    (done as f32 / of.max(1) as f32, done as u32 + 1)
}

impl Trainee for Trainer<'_> {
    type Error = PipelineError;

    fn step(&mut self, step: u64, _: f64) -> Result<StepReport> {
        if step >= self.model.config.topology_steps() {
            self.model.give_texture(&self.capture)?;
        }
        if step >= self.model.config.topology_steps() + self.model.config.run.texture_steps {
            self.model.give_surroundings(&self.capture);
        }
        let photos: Vec<_> = self.chosen(step).into_iter().map(|i| &self.capture.photos[i]).collect();
        let (progress, t) = place(&self.model.config, step);
        let rng = Rng::new(Rng::new(self.model.config.seed, STEP).bits(step), 0);
        let input = StepInput { photos, rng, progress, t, rate_scale: self.model.rate_scale };
        let n = input.photos.len();
        let ObjectModel { config, stage, probe, .. } = &mut self.model;
        let loss = match stage {
            Stage::Textured(m) => m.step(config, &input, probe),
            Stage::Topology(m) => match m.step(config, &input, probe) {
                Ok(loss) => loss,
                Err(fault) => {
                    self.fault = Some((step, fault));
                    StepLoss { color: f64::NAN, ..StepLoss::default() }
                }
            },
        };
        Ok(Trainer::report(&loss, n))
    }

    fn save(&mut self, step: u64, seconds: f64) -> Result<bool> {
        if self.model.params().is_broken() {
            return Ok(false);
        }
        (self.model.origin.step, self.model.origin.seconds) = (step, seconds);
        self.model.save(self.checkpoints)?;
        Ok(true)
    }

    fn recover(&mut self) -> Result<Option<(u64, String)>> {
        if let Some((step, fault)) = self.fault.take() {
            let m = &mut self.model;
            if m.beginnings >= BEGINNINGS {
                let cure = "check that masks and poses belong together, lower optim.shape_rate, or try --set grid.start=hull";
                let before = m.beginnings - 1;
                return Err(PipelineError::Usage(format!("step {step}: {fault}, and did so {before} times before: {cure}")));
            }
            let by = if fault.is_vanished() { BIAS } else { -BIAS };
            let (bias, rate_scale) = (m.bias + by, 0.5 * m.rate_scale);
            m.begin_again(&self.capture, bias, rate_scale)?;
            let than = if by > 0.0 { "larger" } else { "smaller" };
            return Ok(Some((0, format!("{fault}; the first stage begins again, {:.1} cells {than} and at half the rate", by.abs()))));
        }
        if self.recovered {
            return Ok(None);
        }
        self.recovered = true;
        let config = self.model.config.clone();
        let mut fresh = if checkpoint::exists(self.checkpoints) {
            let (c, _) = checkpoint::load(self.checkpoints)?;
            ObjectModel::restored(config, &self.capture, c, &checkpoint::latest(self.checkpoints))?
        } else {
            ObjectModel::new(config, &self.capture)?
        };
        fresh.rate_scale = 0.3 * self.model.rate_scale;
        self.model = fresh;
        Ok(Some((self.model.origin.step, "the loss was not finite; the rate is lowered".into())))
    }

    fn evaluate(&mut self) -> Result<Option<Scores>> {
        let held_out = self.capture.indices(Split::Test);
        if held_out.is_empty() {
            return Ok(None);
        }
        self.model.probe.update();
        let of = |i: &usize| scores::squared_error(&self.model.picture(&self.capture.photos[*i].view), &self.capture.photos[*i].rgba.data);
        let step = held_out.len().div_ceil(COMPARED);
        let all: Vec<f64> = held_out.iter().step_by(step).map(of).collect();
        Ok(Some(Scores::from([Scalar::psnr("psnr", all.iter().sum::<f64>() / all.len() as f64)])))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::relight::object::capture::{ObjectPhoto, ObjectView};
    use crate::relight::object::config::Preset;
    use crate::relight::object::hull::Silhouette;
    use crate::relight::object::placement::Placement;
    use diorama_geom::glam::DVec3;
    use diorama_geom::{Camera, Image, Pose};

    /// Eight pictures of a gray ball.
    fn ball() -> ObjectCapture {
        let camera = Camera::pinhole(32, 32, 0.7);
        let photo = |i: usize| {
            let (angle, z) = (i as f64 * 2.4, -0.8 + 0.2 * i as f64);
            let r = (1.0 - z * z).sqrt();
            let pose = Pose::look_at(4.0 * DVec3::new(r * angle.cos(), r * angle.sin(), z), DVec3::ZERO, DVec3::Z);
            let pixel = |p: usize| {
                let d = pose.rotation * camera.direction((p % 32) as f64 + 0.5, (p / 32) as f64 + 0.5);
                if pose.translation.cross(d).length() < 0.8 { [0.3, 0.3, 0.3, 1.0] } else { [0.0; 4] }
            };
            let rgba = Image { width: 32, height: 32, channels: 4, data: (0..32 * 32).flat_map(pixel).collect() };
            ObjectPhoto { name: i.to_string(), rgba, view: ObjectView::new(camera, pose), split: Split::Train }
        };
        let photos: Vec<ObjectPhoto> = (0..8).map(photo).collect();
        let silhouettes = photos.iter().map(|p| Silhouette::new(&p.rgba, p.view.camera, p.view.pose)).collect();
        ObjectCapture { photos, placement: Placement { center: DVec3::ZERO, scale: 1.0 }, silhouettes }
    }

    #[test]
    fn a_lost_surface_begins_again_until_that_is_in_vain() {
        let capture = ball();
        let mut model = ObjectModel::new(Config::new(Preset::Ci, "d".into()), &capture).unwrap();
        // Far below what the hull says: nothing is inside.
        model.begin_again(&capture, -9.0, 1.0).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let mut trainer = Trainer::new(model, capture, folder.path());
        for (bias, rate) in [(-8.7, 0.5), (-8.4, 0.25)] {
            assert!(trainer.step(0, 0.0).unwrap().loss.is_nan());
            let (to, why) = trainer.recover().unwrap().unwrap();
            assert!(to == 0 && why.contains("vanished") && why.contains("0.3 cells larger") && why.contains("half the rate"), "{why}");
            assert!((trainer.model.bias - bias).abs() < 1e-5 && trainer.model.rate_scale == rate);
        }
        assert!(trainer.step(7, 0.0).unwrap().loss.is_nan());
        let e = trainer.recover().unwrap_err();
        assert!(e.is_input() && e.to_string().contains("step 7: ") && e.to_string().contains("optim.shape_rate"), "{e}");
    }

    #[test]
    fn a_surface_that_explodes_begins_again_smaller() {
        let capture = ball();
        let mut config = Config::new(Preset::Ci, "d".into());
        config.grid.start = "random".into();
        let mut model = ObjectModel::new(config, &capture).unwrap();
        let Stage::Topology(first) = &mut model.stage else { panic!("the first stage") };
        // Every other vertex is inside: more surface than an object has.
        let n = first.distances.values.len();
        (0..n).for_each(|i| first.distances.values[i] = if i % 2 == 0 { 1.0 } else { -1.0 });
        let folder = tempfile::tempdir().unwrap();
        let mut trainer = Trainer::new(model, capture, folder.path());
        assert!(trainer.step(3, 0.0).unwrap().loss.is_nan());
        let (to, why) = trainer.recover().unwrap().unwrap();
        assert!(to == 0 && why.contains("exploded") && why.contains("0.3 cells smaller") && why.contains("half the rate"), "{why}");
    }

    #[test]
    fn every_photograph_comes_once_before_any_comes_again() {
        let capture = ball();
        let model = ObjectModel::new(Config::new(Preset::Ci, "d".into()), &capture).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let trainer = Trainer::new(model, capture, folder.path());
        for round in 0..3 {
            let mut chosen: Vec<usize> = (8 * round..8 * round + 8).flat_map(|s| trainer.chosen(s)).collect();
            chosen.sort_unstable();
            assert_eq!(chosen, (0..8).collect::<Vec<_>>());
        }
    }
}
