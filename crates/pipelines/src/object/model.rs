//! The model of the object application: a capture with the fields that are fitted to it.

use super::config::{Background, Config, Method};
use super::field_shape::{cascades, hash_grid, space};
use crate::error::{PipelineError, Result};
use diorama_engine::background::LearnedBackground;
use diorama_engine::fields::{self, DensityQuery, Field, FieldBuffers, Pruning};
use diorama_engine::params::{ParamGroup, Schedule};
use diorama_engine::renderers::supervised::{Supervised, Unserved};
use diorama_engine::renderers::volume::{Accelerator, Backdrop, Quality, Tracer};
use diorama_engine::samplers::occupancy::Occupancy;
use diorama_engine::samplers::pixels::ErrorMap;
use diorama_engine::samplers::placement::Placement;
use diorama_engine::step::{self, Scene, Trainees};
use diorama_engine::train::Origin;
use diorama_geom::capture::{ColorSpace, Split};
use diorama_geom::color::srgb_from_linear;
use diorama_geom::contraction::Space;
use diorama_geom::field_query::FieldQuery;
use diorama_geom::glam::DVec3;
use diorama_geom::{Capture, Pose, Similarity};
use diorama_kernels::gemm::Precision;
use diorama_kernels::ops::adam::Adam;
use diorama_kernels::ops::linear::Activation;
use diorama_kernels::ops::photometric_loss::{ColorLoss, Terms};
use diorama_kernels::ops::ray_generation::{CORRECTION, PosedCamera};

/// Where rays end in space without a bound, in inner cubes: a camera that moves by one sees it move by 0.001 radians.
const FAR: f32 = 1024.0;

/// Fields, occupancy and corrections of one run, with the capture they belong to.
pub struct ObjectModel {
    pub config: Config,
    pub capture: Capture,
    pub model_from_world: Similarity,
    pub field: Field,
    /// The coarse network of `nerf`.
    pub coarse: Option<Field>,
    pub occupancy: Option<Occupancy>,
    pub learned: Option<LearnedBackground>,
    /// Corrections of the training cameras, `[train, 7]`.
    pub corrections: Option<ParamGroup>,
    pub error_map: Option<ErrorMap>,
    /// Training frames, as indices into the capture.
    pub train: Vec<usize>,
    /// Whether the photographs have transparent pixels.
    pub has_alpha: bool,
    /// How far training is.
    pub origin: Origin,
    /// Rays and samples that were trained on so far.
    pub rays: u64,
    pub samples: u64,
    /// Running mean of samples per ray, which sets the rays per step.
    pub samples_per_ray: f64,
    /// Lowered once after a loss that was not finite.
    pub rate_scale: f32,
    /// Device that renders instead of the CPU.
    pub accelerator: Option<Supervised>,
}

/// Density per inner cube at the start of unbounded fields: light passes most of the inner cube, so that what stands
/// there is found before what would stand in front of each camera.
const INITIAL_DENSITY: f32 = 0.1;

/// L2 penalty on the hash grid of unbounded fields: what few rays have a say in stays smooth.
const TABLE_DECAY: f32 = 1e-5;

/// Weight of the distortion loss in unbounded space and in a box.
const DISTORTION: (f32, f32) = (0.1, 0.01);

/// Steps in which the distortion loss of unbounded space grows to its weight, from nothing: at once, it would gather what little
/// matter there is before each camera, where nothing else is known yet. Even a tenth of it does so on captures of plain surfaces.
const DISTORTION_RAMP: u64 = 2000;

/// Width of the Huber loss's quadratic part.
const HUBER: f32 = 0.1;

/// Weight of the light that ends away from what pixels of known distance show, in unbounded space.
const DEPTH: f32 = 0.3;

impl ObjectModel {
    /// An untrained model.
    pub fn new(config: Config, capture: Capture, has_alpha: bool) -> Result<ObjectModel> {
        config.check()?;
        let train = capture.indices(Split::Train);
        let is_linear = is_linear(&capture);
        let space = space(&config, &capture, has_alpha);
        let (seed, rate, images, dims) = (config.seed, config.optim.rate, train.len(), config.field.appearance.or(0.0) as usize);
        let (field, coarse) = match config.method {
            Method::Ngp => (fields::ngp(hash_grid(&config, &capture, space), space, rate, images, dims, seed), None),
            Method::Nerf => (fields::nerf(space, rate, images, dims, seed, 1), Some(fields::nerf(space, rate, images, dims, seed, 0))),
            Method::Mlp => (fields::mlp(space, rate, seed), None),
            Method::Baseline => (fields::baseline(space, rate, seed), None),
        };
        let occupancy = (config.method == Method::Ngp)
            .then(|| Occupancy::new(config.sampling.occupancy_resolution, cascades(space), matches!(space, Space::Contracted(_))));
        let learned = (config.background == Background::Learned)
            .then(|| LearnedBackground::new(color_head(is_linear).0, Adam { rate, ..Adam::default() }));
        let corrections = config.camera.refine.then(|| {
            let adam = Adam { rate: config.camera.rate, weight_decay: config.camera.decay, ..Adam::default() };
            ParamGroup::dense("corrections", vec![0.0; images * CORRECTION], adam)
        });
        let error_map = config.sampling.error_map.then(|| ErrorMap::new(images));
        let mut model = ObjectModel {
            model_from_world: capture.scene.model_from_world(),
            field,
            coarse,
            occupancy,
            learned,
            corrections,
            error_map,
            train,
            has_alpha,
            origin: Origin::default(),
            rays: 0,
            samples: 0,
            samples_per_ray: 256.0,
            rate_scale: 1.0,
            accelerator: None,
            config,
            capture,
        };
        let cameras = model.base_cameras();
        if let Some(o) = &mut model.occupancy {
            o.keep_visible(&cameras, model.config.sampling.min_cell_views);
        }
        let decay = model.config.optim.weight_decay;
        let table_decay = model.config.optim.table_decay.or(if model.field.is_unbounded() { TABLE_DECAY } else { 0.0 });
        if model.config.method == Method::Ngp && model.field.is_unbounded() {
            model.field.net.density.shift = INITIAL_DENSITY.ln();
        }
        let precision = if model.config.field.precision == "auto" { Precision::Bf16 } else { Precision::F32 };
        for f in model.fields_mut() {
            f.weights.adam.weight_decay = decay;
            f.encoder.table_mut().into_iter().for_each(|t| t.adam.weight_decay = table_decay);
            f.net.mlp.precision = precision;
            let color = f.net.color_mut();
            (color.activation, color.shift) = color_head(is_linear);
        }
        let o = &model.config.optim;
        let schedule = Schedule { warmup: o.warmup, final_scale: o.final_scale, decay_from: o.decay_from };
        model.trainees().into_params().0.groups().for_each(|(_, g)| g.schedule = schedule);
        Ok(model)
    }

    fn fields_mut(&mut self) -> Vec<&mut Field> {
        [&mut self.field].into_iter().chain(self.coarse.as_mut()).collect()
    }

    /// A frame's camera at the run's resolution, standing in model space.
    pub fn posed(&self, frame: usize) -> PosedCamera {
        let f = &self.capture.frames[frame];
        PosedCamera { camera: f.camera.reduced(self.config.reduction()), pose: self.model_from_world.pose(&f.world_from_camera) }
    }

    /// A camera that stands in the world, in model space.
    pub fn to_model(&self, camera: diorama_geom::Camera, world_from_camera: &Pose) -> PosedCamera {
        PosedCamera { camera, pose: self.model_from_world.pose(world_from_camera) }
    }

    /// How far cameras stand from what they look at, in inner cubes.
    pub fn viewing_distance(&self) -> f64 {
        self.capture.viewing_distance()
    }

    /// The training cameras as given.
    pub fn base_cameras(&self) -> Vec<PosedCamera> {
        self.train.iter().map(|&i| self.posed(i)).collect()
    }

    /// The training cameras with their corrections.
    pub fn cameras(&self) -> Vec<PosedCamera> {
        let base = self.base_cameras();
        self.corrections.as_ref().map_or_else(|| base.clone(), |g| step::corrected(&base, &g.values))
    }

    /// Density per inner cube, a little below what the field starts from: what is denser is trained on however short its
    /// step, else a field could lose all of its samples before it has learned anything.
    pub fn thin(&self) -> f32 {
        0.7 * self.field.net.density.shift.exp()
    }

    /// Limits below which samples are dropped in training.
    pub fn pruning(&self) -> Pruning {
        let s = &self.config.sampling;
        Pruning { stop: s.stop, min_alpha: s.min_alpha, thin: self.thin(), min_weight: 0.0 }
    }

    /// Cameras and extent of the rays of training.
    pub fn scene(&self) -> Scene {
        Scene { cameras: self.base_cameras(), near: self.config.sampling.near, cube: self.cube() }
    }

    /// Everything that a step changes.
    pub fn trainees(&mut self) -> Trainees<'_> {
        let focal = self.config.camera.refine_focal;
        Trainees {
            field: &mut self.field,
            coarse: self.coarse.as_mut(),
            learned: self.learned.as_mut(),
            occupancy: self.occupancy.as_mut(),
            corrections: self.corrections.as_mut().map(|g| (g, focal)),
            error_map: self.error_map.as_mut(),
        }
    }

    /// Weights of the loss at a training step.
    pub fn terms(&self, step: u64) -> Terms {
        let l = &self.config.loss;
        let color = if l.color == "huber" { ColorLoss::Huber(HUBER) } else { ColorLoss::Mse };
        Terms { color, distortion: self.distortion(step), depth: self.depth(), alpha: l.alpha }
    }

    /// Weight of the distortion loss at a training step.
    fn distortion(&self, step: u64) -> f32 {
        let weight = self.config.loss.distortion;
        match self.field.is_unbounded() {
            true => weight.or(DISTORTION.0) * (step as f32 / DISTORTION_RAMP as f32).min(1.0),
            false => weight.or(DISTORTION.1),
        }
    }

    /// Weight of the light that ends away from what pixels of known distance show.
    pub fn depth(&self) -> f32 {
        self.config.loss.depth.or(if self.field.is_unbounded() { DEPTH } else { 0.0 })
    }

    /// The scene's outer cube in model space: lowest corner and edge.
    pub fn cube(&self) -> (f32, f32) {
        match self.field.space {
            Space::Contracted(_) => (0.5 - FAR, 2.0 * FAR),
            Space::Cube(edge) => (0.5 - 0.5 * edge, edge),
        }
    }

    /// The colour that renders and scores are composited on, unless it is learned.
    pub fn backdrop_color(&self) -> [f32; 3] {
        match self.config.background {
            Background::White => [1.0; 3],
            Background::Black => [0.0; 3],
            _ if self.has_alpha => [1.0; 3],
            _ => [0.0; 3],
        }
    }

    /// Whether the photographs, and so the field's colors, are linear light.
    pub fn is_linear(&self) -> bool {
        is_linear(&self.capture)
    }

    /// A renderer of the model, with the mean appearance code.
    pub fn tracer(&self, quality: Quality) -> Tracer<'_> {
        let s = &self.config.sampling;
        let placement = match (&self.occupancy, &self.coarse) {
            (Some(grid), _) => Placement::occupied(grid, s.max_samples, quality.pruning()),
            (None, Some(_)) => Placement::Hierarchical { samples: s.samples, more: s.importance, noise: None },
            (None, None) => Placement::Stratified { samples: s.samples, noise: None },
        };
        Tracer {
            field: &self.field,
            coarse: self.coarse.as_ref(),
            occupancy: self.occupancy.as_ref(),
            placement,
            backdrop: self.learned.as_ref().map_or(Backdrop::Color(self.backdrop_color()), Backdrop::Learned),
            near: s.near,
            cube: self.cube(),
            clip: None,
            within: None,
            crop: None,
            is_linear: self.is_linear(),
            shared_weight: quality.shared_weight(),
            appearance: None,
            tolerance: quality.tolerance(),
            accelerator: self.accelerator.as_ref().map(|a| a as &dyn Accelerator),
            seen_along: None,
        }
    }

    /// # Errors
    /// When the device that the user named has failed: what was computed since does not count.
    pub fn check_device(&self) -> Result<()> {
        match self.accelerator.as_ref().and_then(Supervised::fatal) {
            Some(why) => Err(PipelineError::Device(format!("{why}; use --device cpu"))),
            None => Ok(()),
        }
    }

    /// Name of the device that has rendered so far; the CPU if it failed or was not used.
    pub fn drew_on(&self) -> String {
        let device = self.accelerator.as_ref().filter(|a| a.served() > 0 && a.failure().is_none());
        device.map_or("cpu".into(), |a| a.name().to_string())
    }

    /// Whether any parameter is not finite.
    pub fn is_broken(&mut self) -> bool {
        self.trainees().into_params().0.is_broken()
    }

    /// A copy of the values alone, for rendering; it cannot be trained.
    pub fn for_rendering(&self) -> ObjectModel {
        ObjectModel {
            config: self.config.clone(),
            capture: self.capture.clone(),
            model_from_world: self.model_from_world,
            field: self.field.for_rendering(),
            coarse: self.coarse.as_ref().map(Field::for_rendering),
            occupancy: self.occupancy.clone(),
            learned: self.learned.as_ref().map(LearnedBackground::for_rendering),
            corrections: self.corrections.as_ref().map(ParamGroup::values_only),
            error_map: None,
            train: self.train.clone(),
            has_alpha: self.has_alpha,
            origin: self.origin,
            rays: self.rays,
            samples: self.samples,
            samples_per_ray: self.samples_per_ray,
            rate_scale: self.rate_scale,
            accelerator: None,
        }
    }
}

/// Whether all photographs hold linear light.
pub fn is_linear(capture: &Capture) -> bool {
    !capture.frames.is_empty() && capture.frames.iter().all(|f| f.color_space == ColorSpace::Linear)
}

impl FieldQuery for ObjectModel {
    fn density(&self, points_in_world: &[[f32; 3]], sigma: &mut [f32]) {
        let model = self.model_points(points_in_world);
        self.model_density(&model, sigma);
        // Per model unit to per world unit; nothing lies outside of the scene's cube.
        let (low, size) = self.cube();
        let scale = self.model_from_world.scale as f32;
        for (s, p) in sigma.iter_mut().zip(model.chunks_exact(3)) {
            let inside = p.iter().all(|v| (low..=low + size).contains(v));
            *s = if inside { *s * scale } else { 0.0 };
        }
    }

    fn color(&self, points_in_world: &[[f32; 3]], directions: &[[f32; 3]], rgb_srgb: &mut [[f32; 3]]) {
        const CHUNK: usize = 1 << 16;
        let on_device = |a: &Supervised| a.color(&self.model_points(points_in_world), directions.as_flattened());
        match self.accelerator.as_ref().map(on_device) {
            Some(Ok(rgb)) => {
                rgb_srgb.as_flattened_mut().copy_from_slice(&rgb);
                return self.encode(rgb_srgb);
            }
            Some(Err(Unserved::Abandoned)) => return rgb_srgb.fill([0.0; 3]),
            Some(Err(Unserved::Failed(_))) | None => {}
        }
        let mut buf = FieldBuffers::default();
        for ((p, d), out) in points_in_world.chunks(CHUNK).zip(directions.chunks(CHUNK)).zip(rgb_srgb.chunks_mut(CHUNK)) {
            let own = self.field.outputs_at(&self.model_points(p), d.as_flattened(), &[], &mut buf);
            out.as_flattened_mut().copy_from_slice(own);
        }
        self.encode(rgb_srgb);
    }
}

/// How the last layer becomes color: between 0 and 1, or for linear light any value above 0, at first a middle gray.
fn color_head(is_linear: bool) -> (Activation, f32) {
    if is_linear { (Activation::TruncatedExp, -1.6) } else { (Activation::Sigmoid, 0.0) }
}

impl ObjectModel {
    /// The field's own colors to sRGB.
    pub fn encode(&self, rgb: &mut [[f32; 3]]) {
        if self.is_linear() {
            rgb.as_flattened_mut().iter_mut().for_each(|v| *v = srgb_from_linear(*v));
        }
    }

    /// Densities per model unit `[N]` at model points `[N, 3]`.
    pub fn model_density(&self, model: &[f32], sigma: &mut [f32]) {
        match self.accelerator.as_ref().map(|a| a.density(model)) {
            Some(Ok(d)) => sigma.copy_from_slice(&d),
            Some(Err(Unserved::Abandoned)) => sigma.fill(0.0),
            Some(Err(Unserved::Failed(_))) | None => self.field.density(model, sigma),
        }
    }

    fn model_points(&self, points_in_world: &[[f32; 3]]) -> Vec<f32> {
        points_in_world
            .iter()
            .flat_map(|p| self.model_from_world.point(DVec3::new(p[0] as f64, p[1] as f64, p[2] as f64)).as_vec3().to_array())
            .collect()
    }
}
