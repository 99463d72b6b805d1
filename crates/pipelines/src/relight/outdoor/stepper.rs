//! A step of the model as printed.

use super::config::Config;
use super::joint::{Joint, JointGradients, JointLoss};
use super::model::SceneModel;
use super::shading::LIGHT;
use super::sun::gray;
use diorama_engine::fields::{Batch, Field, FieldBuffers, InvertedSphere, Loss, OuterSamples, VisibleSamples};
use diorama_engine::params::ParamGroup;
use diorama_engine::samplers::RayBatch;
use diorama_engine::samplers::{pixels, placement};
use diorama_geom::color::LUMINANCE;
use diorama_geom::rng::Rng;
use diorama_kernels::ops::composite::Packed;
use diorama_kernels::ops::ray_generation::PosedCamera;
use diorama_kernels::ops::strata::cpu as strata;
use std::sync::Mutex;

/// Streams of random numbers: first samples, those that are added, the same outside of the sphere, and noise on the light.
const FIRST: u64 = 30;
const ADDED: u64 = 31;
const OUTER_FIRST: u64 = 32;
const OUTER_ADDED: u64 = 33;
const NOISE: u64 = 34;
/// Standard deviation of noise on the light that shadows see.
const LIGHT_NOISE: f32 = 0.01;
/// Steps from which on shadows are held near 1, and in which that weight grows.
const SHADOW_FROM: f32 = 10_000.0;
const SHADOW_RAMP: f32 = 20_000.0;

/// Network, light and background of one of the two levels.
pub struct Level<'a> {
    pub field: &'a mut Field,
    pub lights: &'a mut ParamGroup,
    pub background: Option<&'a mut InvertedSphere>,
}

/// Samples of a level in the last step, and what its shadows read.
#[derive(Default)]
pub struct LevelSamples {
    pub inner: VisibleSamples,
    pub outer: OuterSamples,
    /// `[R, 9]`
    pub codes: Vec<f32>,
}

/// Carries out steps; keeps its buffers.
#[derive(Default)]
pub struct Stepper {
    /// Of the coarse and the fine network.
    pub samples: [LevelSamples; 2],
    buffers: FieldBuffers,
}

/// Figures of a step.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct JointFigures {
    /// Of both networks.
    pub loss: f64,
    /// Of the fine network.
    pub mse: f64,
    /// Samples of both networks.
    pub samples: usize,
}

/// Weight of the shadows in a step.
fn shadow_weight(weight: f32, step: u64) -> f32 {
    weight * ((step as f32 - SHADOW_FROM) / SHADOW_RAMP).clamp(0.0, 1.0)
}

/// Sets origins, directions and extents of the images and pixels in `batch`: where there is a background, rays end at its sphere.
///
/// # Panics
/// When the model is none that is learned at once.
pub fn sphere_rays(model: &SceneModel, cameras: &[PosedCamera], batch: &mut RayBatch) {
    let joint = model.joint.as_ref().expect("a model that is learned at once");
    pixels::rays(cameras, model.config.sampling.near, model.cube(), batch);
    if !joint.backgrounds.is_empty() {
        joint.sphere.cut(&batch.origins, &batch.dirs, &mut batch.near_far);
    }
}

impl Stepper {
    /// One optimizer step on rays whose origins, directions, extents and targets are set; `light` is that of each. A loss that is not
    /// finite leaves all parameters as they were.
    ///
    /// # Panics
    /// When the model is none that is learned at once.
    pub fn step(&mut self, model: &mut SceneModel, batch: &RayBatch, light: &[u32], number: u64, progress: f32) -> JointFigures {
        let c = model.config.clone();
        let (first, rate_scale) = (model.rays, model.rate_scale);
        let mut joint = model.joint.take().expect("a model that is learned at once");
        joint.anneal(&mut model.field, number);
        let target: Vec<f32> = batch.target.chunks_exact(4).flat_map(|t| [t[0], t[1], t[2]]).collect();
        let mut figures = JointFigures::default();
        for l in 0..2 {
            self.place(l, &joint, &model.field, &c, batch, first);
            let level = level(&mut joint, model, l);
            let noise = Rng::new(c.seed ^ number.wrapping_mul(0x9e37_79b9), NOISE + l as u64);
            let (loss, mse) = self.train(l, level, batch, (&target, light), shadow_weight(c.loss.shadow, number), &noise);
            (figures.loss, figures.mse) = (figures.loss + loss, mse);
            figures.samples += self.samples[l].inner.samples.t.len();
        }
        model.joint = Some(joint);
        if figures.loss.is_finite() {
            model.params().step(number, progress, rate_scale);
        }
        figures
    }

    /// Samples of a level: strata for the coarse network, and more where its weights are for the fine one.
    fn place(&mut self, l: usize, joint: &Joint, fine: &Field, c: &Config, batch: &RayBatch, first: u64) {
        let rng = |stream| Some((Rng::new(c.seed, stream), first));
        let (n, more) = (c.sampling.coarse, c.sampling.fine);
        let [coarse, main] = &mut self.samples;
        if l == 0 {
            strata::stratified(&batch.near_far, n, rng(FIRST), &mut coarse.inner.samples);
            placement::encode(&joint.coarse, batch, &mut coarse.inner);
        } else {
            strata::refine(&coarse.inner.samples, &self.buffers.out.weights, n, more, rng(ADDED), &mut main.inner.samples);
            placement::encode(fine, batch, &mut main.inner);
        }
        let Some(background) = joint.backgrounds.get(l) else { return };
        if l == 0 {
            strata::stratified(&[0.0, 1.0].repeat(batch.len()), n, rng(OUTER_FIRST), &mut coarse.outer.samples);
        } else {
            strata::refine(&coarse.outer.samples, &coarse.outer.out.weights, n, more, rng(OUTER_ADDED), &mut main.outer.samples);
        }
        background.locate(&batch.origins, &batch.dirs, &mut self.samples[l].outer);
    }

    /// Gradients of a level: its loss, and the squared error of its colors.
    fn train(
        &mut self,
        l: usize,
        level: Level,
        batch: &RayBatch,
        (target, light): (&[f32], &[u32]),
        shadow: f32,
        noise: &Rng,
    ) -> (f64, f64) {
        let Level { field, lights, mut background } = level;
        let LevelSamples { inner, outer, codes } = &mut self.samples[l];
        let n = batch.len();
        codes.clear();
        for (r, of) in light.iter().enumerate() {
            let table = &lights.values[LIGHT * *of as usize..][..LIGHT];
            codes.extend((0..9).map(|i| gray(&table[3 * i..]) + LIGHT_NOISE * noise.normal((9 * r + i) as u64)));
        }
        let behind = match &mut background {
            Some(b) => {
                b.render(outer);
                outer.out.values.clone()
            }
            None => vec![0.0; 3 * n],
        };
        let table = lights.values.clone();
        let loss = JointLoss { target, counts: &batch.counts, light, lights: &table, behind: &behind, shadow, out: Mutex::default() };
        let (given, empty) = ([&codes[..]], [0.0, 0.0, 0.0, 1.0].repeat(n));
        let b = Batch {
            samples: Packed { offsets: &inner.samples.offsets, t: &inner.samples.t, dt: &inner.samples.dt },
            positions: &inner.positions,
            dirs: &batch.dirs,
            images: None,
            given: &given,
            background: &empty,
            near_scaling: 0.0,
        };
        field.train(&b, &mut inner.encoded, Loss::Batch(&loss), &mut self.buffers, None);
        let JointGradients { lights: d_lights, behind: d_behind, mse } = loss.out.into_inner().expect("no other thread holds it");
        lights.grads.iter_mut().zip(d_lights).for_each(|(g, d)| *g += d);
        // What the shadows read of the light.
        for (of, d) in light.iter().zip(self.buffers.d_given[0].chunks_exact(9)) {
            let grads = &mut lights.grads[LIGHT * *of as usize..][..LIGHT];
            grads.chunks_exact_mut(3).zip(d).for_each(|(g, d)| (0..3).for_each(|k| g[k] += LUMINANCE[k] * d));
        }
        if let Some(b) = background {
            b.run(outer, Some(d_behind));
        }
        (self.buffers.out.loss, mse)
    }
}

/// A level of a model whose other networks are apart.
fn level<'a>(joint: &'a mut Joint, model: &'a mut SceneModel, l: usize) -> Level<'a> {
    let background = joint.backgrounds.get_mut(l);
    match l {
        0 => Level { field: &mut joint.coarse, lights: &mut joint.coarse_lights, background },
        _ => Level { field: &mut model.field, lights: &mut model.lights, background },
    }
}
