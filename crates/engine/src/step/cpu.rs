//! Training steps on the CPU.

use super::{Backdrop, Figures, GivenRays, Loss, Photographs, Placement, RaySource, Scene, Step, Trainees, corrected};
use crate::fields::{self, Batch, Field, FieldBuffers, VisibleSamples};
use crate::losses::{self, Photometric, RELATIVE, Terms};
use crate::params::ParamGroup;
use crate::samplers::pixels::{self, DrawOptions, ErrorMap, PixelSource};
use crate::samplers::{RayBatch, stratified};
use crate::stages::Stages;
use diorama_kernels::ops::composite::Packed;
use diorama_kernels::ops::distortion;
use diorama_kernels::ops::linear::Activation;
use diorama_kernels::ops::march::{self, MarchRays};
use diorama_kernels::ops::ray_aabb;
use diorama_kernels::ops::ray_generation::{self, CORRECTION, PosedCamera};

/// Carries out [`Step`]s on the CPU; keeps its buffers.
pub struct CpuTrainer {
    scene: Scene,
    /// The cameras with their corrections.
    pub(super) cameras: Vec<PosedCamera>,
    pub(super) batch: RayBatch,
    background: Vec<f32>,
    visible: VisibleSamples,
    guide: VisibleSamples,
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
            visible: VisibleSamples::default(),
            guide: VisibleSamples::default(),
            d_positions: Vec::new(),
            field: FieldBuffers::default(),
        };
        trainer.correct(of);
        trainer
    }

    /// Where the time of steps goes.
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
        &self.visible.encoded
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
        let (loss, trained, marched) = match s.placement {
            Placement::Occupancy { .. } => self.occupied(of, s),
            Placement::Stratified { .. } => self.stratified(of, s),
            Placement::Hierarchical { .. } => self.hierarchical(of, s),
        };
        self.field.stages.done("network");
        let mse = match s.loss {
            Loss::Photometric(_) => {
                let drawn_from = photographs.filter(|_| s.rays.is_of_cameras()).map(|p| p.pixels);
                self.score(&*of.field, of.error_map.as_deref_mut(), drawn_from)
            }
            Loss::Batch(_) => f64::NAN,
        };
        let figures = Figures { steps: 1, rays: self.batch.len() as u64, loss, mse, trained: trained as f64, marched: marched as f64 };
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

    /// Takes the caller's rays.
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
        let (low, size) = self.scene.cube;
        ray_aabb::cpu::intersect(&b.origins, &b.dirs, [low; 3], [low + size; 3], self.scene.near, &mut b.near_far);
    }

    /// Samples in occupied cells through the one field: loss, samples trained, samples marched.
    fn occupied(&mut self, of: &mut Trainees, s: &Step) -> (f64, usize, usize) {
        let Placement::Occupancy { march, pruning, .. } = s.placement else { unreachable!("placed otherwise") };
        let grid = of.occupancy.as_mut().expect("an occupancy grid");
        of.field.visible(&grid.bits, &rays(&self.batch), &march, pruning, &mut self.visible, &mut self.field);
        self.field.visible.seen().for_each(|(cells, sigma)| grid.record(cells, sigma));
        let marched = self.field.visible.marched();
        let loss = self.train(of, s, Which::Main);
        (loss, self.visible.samples.t.len(), marched)
    }

    /// Samples in equal intervals through the one field.
    fn stratified(&mut self, of: &mut Trainees, s: &Step) -> (f64, usize, usize) {
        let Placement::Stratified { samples, rng } = s.placement else { unreachable!("placed otherwise") };
        stratified::stratified(&self.batch, samples, Some((rng, s.first)), &mut self.visible.samples);
        encode(of.field, &self.batch, &mut self.visible);
        let loss = self.train(of, s, Which::Main);
        (loss, self.visible.samples.t.len(), self.visible.samples.t.len())
    }

    /// Samples in equal intervals through the coarse field, then more where it found matter through the main one.
    fn hierarchical(&mut self, of: &mut Trainees, s: &Step) -> (f64, usize, usize) {
        let Placement::Hierarchical { samples, more, coarse, fine } = s.placement else { unreachable!("placed otherwise") };
        stratified::stratified(&self.batch, samples, Some((coarse, s.first)), &mut self.guide.samples);
        encode(of.coarse.as_ref().expect("a coarse field"), &self.batch, &mut self.guide);
        let coarse_loss = self.train(of, s, Which::Coarse);
        let (from, to) = (&self.guide.samples, &mut self.visible.samples);
        stratified::refine(from, &self.field.out.weights, samples, more, Some((fine, s.first)), to);
        encode(of.field, &self.batch, &mut self.visible);
        let loss = self.train(of, s, Which::Main);
        let trained = self.guide.samples.t.len() + self.visible.samples.t.len();
        (coarse_loss + loss, trained, trained)
    }

    /// Gradients of a field for its samples, and of the positions where cameras move; the loss.
    fn train(&mut self, of: &mut Trainees, s: &Step, which: Which) -> f64 {
        let moves = of.moves_cameras(s) && matches!(which, Which::Main);
        let (field, on) = match which {
            Which::Main => (&mut *of.field, &mut self.visible),
            Which::Coarse => (&mut **of.coarse.as_mut().expect("a coarse field"), &mut self.guide),
        };
        let marched = &on.samples;
        let samples = Packed { offsets: &marched.offsets, t: &marched.t, dt: &marched.dt };
        let given = match &s.rays {
            RaySource::Given(g) => g.codes,
            RaySource::Photographs { .. } => &[],
        };
        let (dirs, images, background) = (&self.batch.dirs[..], Some(&self.batch.images[..]), &self.background[..]);
        let b = Batch { samples, positions: &on.positions, dirs, images, given, background, near_scaling: s.near_scaling };
        let d_positions = moves.then_some(&mut self.d_positions);
        match s.loss {
            Loss::Batch(loss) => field.train(&b, &mut on.encoded, fields::Loss::Batch(loss), &mut self.field, d_positions),
            Loss::Photometric(terms) => {
                assert_eq!(field.net.channels(), 3, "a photometric loss compares colors alone");
                let (mut starts, mut lengths) = (Vec::new(), Vec::new());
                let spread = if terms.distortion > 0.0 && field.is_unbounded() {
                    distortion::cpu::normalize(&samples, &mut starts, &mut lengths);
                    Packed { offsets: &marched.offsets, t: &starts, dt: &lengths }
                } else {
                    samples
                };
                let Terms { color, distortion, depth, alpha } = terms;
                let relative = relative(field);
                let batch = &self.batch;
                let loss = Photometric { batch, samples: spread, background, color, relative, distortion, alpha, depth, along: samples };
                field.train(&b, &mut on.encoded, fields::Loss::Rays(&loss), &mut self.field, d_positions);
            }
        }
        self.field.out.loss
    }

    /// Squared error of the step's colors, and what the error map learns from it.
    fn score(&self, field: &Field, mut error_map: Option<&mut ErrorMap>, photographs: Option<&dyn PixelSource>) -> f64 {
        let (b, is_linear) = (&self.batch, relative(field) > 0.0);
        let (mut sum, mut n) = (0.0f64, 0usize);
        for r in (0..b.len()).filter(|r| b.counts[*r]) {
            let t = &b.target[r * 4..r * 4 + 4];
            let want = [0, 1, 2].map(|k| t[k] * t[3] + self.background[r * 3 + k] * (1.0 - t[3]));
            let got = [0, 1, 2].map(|k| self.field.out.values[r * 3 + k]);
            let e = losses::squared_error(got, want, is_linear);
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
        march::cpu::positions_backward(&self.visible.samples, &self.d_positions, &mut d_origins, &mut d_dirs);
        let mut d = vec![0.0f64; group.values.len()];
        ray_generation::cpu::backward(&self.cameras, &b.images, &b.pixels, &b.dirs, &d_origins, &d_dirs, &mut d);
        group.grads.iter_mut().zip(&d).for_each(|(g, d)| *g += *d as f32);
    }
}

/// Which of a step's fields.
#[derive(Clone, Copy)]
enum Which {
    Main,
    Coarse,
}

/// What differences of linear light are divided by besides the prediction; 0 where colors are as photographs show them. Linear light has a
/// color head of its own.
pub(crate) fn relative(field: &Field) -> f32 {
    let is_linear = field.net.outputs.first().is_some_and(|o| o.head.activation == Activation::TruncatedExp);
    if is_linear { RELATIVE } else { 0.0 }
}

/// The batch's rays as marching takes them.
fn rays(b: &RayBatch) -> MarchRays<'_> {
    MarchRays { origins: &b.origins, dirs: &b.dirs, near_far: &b.near_far, jitter: &b.jitter, resumed: false }
}

/// Positions of samples along their rays, and their encoding.
fn encode(field: &Field, batch: &RayBatch, out: &mut VisibleSamples) {
    march::cpu::positions(&rays(batch), &out.samples, &mut out.positions);
    field.encode(&out.positions, &mut out.encoded);
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
