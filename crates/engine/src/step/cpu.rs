//! Training steps on the CPU.

use super::{Backdrop, Figures, GivenRays, Loss, Photographs, RaySource, Scene, Step, Trainees, corrected};
use crate::fields::{self, Batch, Field, FieldBuffers, VisibleSamples};
use crate::params::ParamGroup;
use crate::samplers::RayBatch;
use crate::samplers::occupancy::Occupancy;
use crate::samplers::pixels::{self, DrawOptions, ErrorMap, PixelSource};
use crate::samplers::placement::{self, PlaceOn, PlacedSamples, Placement};
use crate::stages::Stages;
use diorama_kernels::ops::composite::Packed;
use diorama_kernels::ops::linear::Activation;
use diorama_kernels::ops::march;
use diorama_kernels::ops::photometric_loss::{Measure, Photometric, RELATIVE, squared_error};
use diorama_kernels::ops::ray_generation::{self, CORRECTION, PosedCamera};

/// Carries out [`Step`]s on the CPU; keeps its buffers.
pub struct CpuTrainer {
    scene: Scene,
    /// The cameras with their corrections.
    pub(super) cameras: Vec<PosedCamera>,
    pub(super) batch: RayBatch,
    background: Vec<f32>,
    samples: PlacedSamples,
    d_positions: Vec<f32>,
    field: FieldBuffers,
}

impl CpuTrainer {
    pub fn new(scene: Scene, of: &Trainees) -> CpuTrainer {
        let mut trainer = CpuTrainer {
            cameras: Vec::new(),
            scene,
            batch: RayBatch::default(),
            background: Vec::new(),
            samples: PlacedSamples::default(),
            d_positions: Vec::new(),
            field: FieldBuffers::default(),
        };
        trainer.correct(of);
        trainer
    }

    /// Time that each stage of the steps took.
    pub fn stages(&mut self) -> &mut Stages {
        &mut self.field.stages
    }

    /// Gradients of the last step's given codes, `[R, width]` each.
    pub fn given_gradients(&self) -> &[Vec<f32>] {
        &self.field.d_given
    }

    /// The main field's samples of the last step, as its network read them.
    #[cfg(test)]
    pub(super) fn encoded(&self) -> &crate::fields::Encoded {
        &self.samples.main.encoded
    }

    /// Brings the cameras up to date with their corrections.
    fn correct(&mut self, of: &Trainees) {
        self.cameras = match &of.corrections {
            None => self.scene.cameras.clone(),
            Some((group, _)) => corrected(&self.scene.cameras, &group.values),
        };
    }

    /// One optimiser step: draw, place samples, encode, evaluate, compare, and back. A loss that is not finite leaves all parameters as
    /// they were.
    ///
    /// # Panics
    /// When samples go to occupied cells and there is no grid, to a coarse field that is not there, rays to photographs that are not
    /// there, or shapes do not fit the field.
    pub fn step(&mut self, of: &mut Trainees, photographs: Option<&Photographs>, s: &Step) -> Figures {
        self.draw(of, photographs, s);
        self.field.stages.done("draw");
        if let (Some(p), Some(grid)) = (&s.probes, &mut of.occupancy) {
            grid.update(&*of.field, &p.rng, s.number, p.points, p.block);
            self.field.stages.done("occupancy");
        }
        let (loss, trained, marched) = self.place_and_train(of, s);
        self.field.stages.done("network");
        let mse = match s.loss {
            Loss::Photometric(_) => {
                let drawn_from = photographs.filter(|_| s.rays.is_of_cameras()).map(|p| p.pixels);
                self.score(&*of.field, of.error_map.as_deref_mut(), drawn_from)
            }
            Loss::Batch(_) => f64::NAN,
        };
        let (rays, trained, marched) = (self.batch.len() as u64, trained as f64, marched as f64);
        let figures = Figures { steps: 1, rays, whole: rays, loss, mse, trained, marched };
        if !loss.is_finite() {
            return figures;
        }
        if let Some(l) = of.learned.as_mut().filter(|l| !l.group.frozen) {
            l.backward(&self.batch.dirs, &self.background, &self.field.out.d_background);
        }
        let moves = of.moves_cameras(s);
        if let Some((group, _)) = of.corrections.as_mut().filter(|_| moves) {
            self.correct_cameras(group);
        }
        self.field.stages.done("score");
        optimise(of, s);
        self.field.stages.done("optimise");
        if moves {
            self.correct(of);
        }
        if s.refresh_errors
            && let Some(map) = &mut of.error_map
        {
            map.refresh();
        }
        figures
    }

    /// Fills the batch and the background.
    pub(super) fn draw(&mut self, of: &Trainees, photographs: Option<&Photographs>, s: &Step) {
        self.batch.resize(s.rays.count());
        match &s.rays {
            RaySource::Photographs { rng, .. } => {
                let from = photographs.expect("photographs to draw from");
                let Scene { near, cube, .. } = self.scene;
                let error_map = of.error_map.as_deref();
                let o = DrawOptions {
                    cameras: &self.cameras,
                    first: s.first,
                    rng: *rng,
                    near,
                    cube,
                    error_map,
                    observations: from.observations,
                };
                pixels::draw(from.pixels, &o, &mut self.batch);
            }
            RaySource::Given(rays) => self.take(rays),
        }
        let n = self.batch.len();
        match (&of.learned, &s.rays, s.backdrop) {
            (Some(l), ..) => l.forward(&self.batch.dirs, &mut self.background),
            (None, RaySource::Given(g), _) => {
                self.background.clear();
                self.background.extend_from_slice(g.background);
            }
            (None, _, Backdrop::Random(rng)) => {
                self.background.resize(n * 3, 0.0);
                self.background.iter_mut().enumerate().for_each(|(i, v)| *v = rng.uniform(s.first * 3 + i as u64));
            }
            (None, _, Backdrop::Color(color)) => {
                self.background.resize(n * 3, 0.0);
                self.background.chunks_exact_mut(3).for_each(|c| c.copy_from_slice(&color));
            }
        }
    }

    /// Copies the caller's rays into the batch.
    fn take(&mut self, g: &GivenRays) {
        let b = &mut self.batch;
        b.images.copy_from_slice(g.images);
        b.origins.copy_from_slice(g.origins);
        b.dirs.copy_from_slice(g.dirs);
        b.jitter.copy_from_slice(g.jitter);
        b.pixels.fill(0.0);
        b.distance.fill(0.0);
        b.counts.fill(true);
        if g.target.is_empty() {
            b.target.fill(0.0)
        } else {
            b.target.copy_from_slice(g.target)
        }
        g.extents(self.scene.cube, self.scene.near, &mut b.near_far);
    }

    /// Places samples and computes gradients for them: loss, samples trained, samples marched.
    fn place_and_train(&mut self, of: &mut Trainees, s: &Step) -> (f64, usize, usize) {
        let moves = of.moves_cameras(s);
        let drawn = Drawn { batch: &self.batch, background: &self.background, step: s };
        let on = PlaceOn { field: &*of.field, occupancy: of.occupancy.as_deref().map(Occupancy::bits), batch: &self.batch, first: s.first };
        let (coarse, mut coarse_loss, mut trained) = (&mut of.coarse, 0.0, 0);
        let train_coarse = &mut |samples: &mut VisibleSamples, buffers: &mut FieldBuffers| {
            let field = &mut **coarse.as_mut().expect("a coarse field");
            placement::encode(field, drawn.batch, samples);
            drawn.train(field, samples, buffers, None);
            (coarse_loss, trained) = (buffers.out.loss, samples.samples.t.len());
        };
        s.placement.place(&on, &mut self.samples, &mut self.field, train_coarse);
        let main = &mut self.samples.main;
        trained += main.samples.t.len();
        let mut marched = trained;
        if let (Placement::Occupancy { .. }, Some(grid)) = (s.placement, &mut of.occupancy) {
            self.field.visible.densities().for_each(|(cells, sigma)| grid.grid.record(cells, sigma));
            marched = self.field.visible.marched();
        }
        drawn.train(of.field, main, &mut self.field, moves.then_some(&mut self.d_positions));
        (coarse_loss + self.field.out.loss, trained, marched)
    }

    /// Squared error of the step's colors, and what the error map learns from it.
    fn score(&self, field: &Field, mut error_map: Option<&mut ErrorMap>, photographs: Option<&dyn PixelSource>) -> f64 {
        let (b, is_linear) = (&self.batch, measure(field).relative > 0.0);
        let (mut sum, mut n) = (0.0f64, 0usize);
        for r in (0..b.len()).filter(|r| b.counts[*r]) {
            let t = &b.target[r * 4..r * 4 + 4];
            let want = [0, 1, 2].map(|k| t[k] * t[3] + self.background[r * 3 + k] * (1.0 - t[3]));
            let got = [0, 1, 2].map(|k| self.field.out.values[r * 3 + k]);
            let e = squared_error(got, want, is_linear);
            sum += e as f64;
            n += 1;
            if let (Some(map), Some(photographs)) = (&mut error_map, photographs) {
                let image = b.images[r] as usize;
                let (w, h) = photographs.size(image);
                map.record(image, b.pixels[r * 2] / w as f32, b.pixels[r * 2 + 1] / h as f32, e);
            }
        }
        sum / n.max(1) as f64
    }

    /// Adds the gradients of the cameras' corrections, from those of the sample positions.
    fn correct_cameras(&self, group: &mut ParamGroup) {
        let b = &self.batch;
        let (mut d_origins, mut d_dirs) = (vec![0.0; b.len() * 3], vec![0.0; b.len() * 3]);
        march::cpu::positions_backward(&self.samples.main.samples, &self.d_positions, &mut d_origins, &mut d_dirs);
        let mut d = vec![0.0f64; group.values.len()];
        ray_generation::cpu::backward(&self.cameras, &b.images, &b.pixels, &b.dirs, &d_origins, &d_dirs, &mut d);
        group.grads.iter_mut().zip(&d).for_each(|(g, d)| *g += *d as f32);
    }
}

/// Rays of a step, which fields are trained on.
#[derive(Clone, Copy)]
struct Drawn<'a> {
    batch: &'a RayBatch,
    background: &'a [f32],
    step: &'a Step<'a>,
}

impl Drawn<'_> {
    /// Computes gradients of a field for its samples, and of their positions where asked; the loss is in the buffers.
    fn train(&self, field: &mut Field, on: &mut VisibleSamples, buffers: &mut FieldBuffers, d_positions: Option<&mut Vec<f32>>) {
        let &Drawn { batch, background, step: s } = self;
        let marched = &on.samples;
        let samples = Packed { offsets: &marched.offsets, t: &marched.t, dt: &marched.dt };
        let given = match &s.rays {
            RaySource::Given(g) => g.codes,
            RaySource::Photographs { .. } => &[],
        };
        let (dirs, images) = (&batch.dirs[..], Some(&batch.images[..]));
        let b = Batch { samples, positions: &on.positions, dirs, images, given, background, near_scaling: s.near_scaling };
        match s.loss {
            Loss::Batch(loss) => field.train(&b, &mut on.encoded, fields::Loss::Batch(loss), buffers, d_positions),
            Loss::Photometric(terms) => {
                assert_eq!(field.channels(), 3, "a photometric loss compares colors alone");
                let loss = Photometric::new(terms, measure(field), batch.targets(background), samples);
                field.train(&b, &mut on.encoded, fields::Loss::Rays(&loss), buffers, d_positions);
            }
        }
    }
}

/// How a loss measures a field's colors and distances. Linear light has a color head of its own.
pub(crate) fn measure(field: &Field) -> Measure {
    let is_linear = field.net.outputs.first().is_some_and(|o| o.head.activation == Activation::TruncatedExp);
    Measure { relative: if is_linear { RELATIVE } else { 0.0 }, normalized: field.is_unbounded() }
}

/// One optimizer step for every group; cameras only follow rays of their own, and focal lengths that are not refined stay as they were
/// given.
fn optimise(of: &mut Trainees, s: &Step) {
    let mut now = of.reborrow();
    now.corrections = now.corrections.filter(|_| s.rays.is_of_cameras());
    now.into_params().0.step(s.number, s.progress, s.rate_scale);
    if let Some((group, false)) = of.corrections.as_mut().filter(|_| s.rays.is_of_cameras()) {
        group.values.iter_mut().skip(6).step_by(CORRECTION).for_each(|v| *v = 0.0);
    }
}
