//! The field of a scene with writing, its classes, and what renders them.

use super::config::{Config, Stage};
use super::label_maps::Labels;
use crate::error::{PipelineError, Result};
use crate::run::param_state::{self, entry};
use diorama_data::checkpoint::{Checkpoint, Entry};
use diorama_engine::fields::{self, DirectionCode, Encoder, Field, FieldBuffers, Pruning, RayCodes};
use diorama_engine::params::{ParamGroup, ParamSet, Schedule};
use diorama_engine::renderers::view::View;
use diorama_engine::renderers::volume::{Backdrop, Quality, Tracer};
use diorama_engine::samplers::occupancy::{self, Occupancy};
use diorama_engine::samplers::placement::Placement;
use diorama_engine::samplers::{RayBatch, pixels};
use diorama_engine::step::Scene;
use diorama_engine::train::Origin;
use diorama_geom::capture::Split;
use diorama_geom::contraction::Space;
use diorama_geom::rng::Rng;
use diorama_geom::{Capture, Similarity};
use diorama_kernels::gemm::Precision;
use diorama_kernels::ops::adam::Adam;
use diorama_kernels::ops::field_step::{FieldNet, Output};
use diorama_kernels::ops::fused_mlp::{Head, Layer, Mlp, Source};
use diorama_kernels::ops::hash_grid::HashGridConfig;
use diorama_kernels::ops::linear::Activation;
use diorama_kernels::ops::ray_generation::PosedCamera;
use std::collections::HashMap;
use std::path::Path;

/// Where rays end in space without a bound, in inner cubes.
const FAR: f32 = 1024.0;
/// Density before anything is learned, per inner cube.
const FIRST_DENSITY: f32 = 0.1;
/// L2 penalty on the hash grid.
const TABLE_DECAY: f32 = 1e-5;
/// Layers of the density, which come first.
const DENSITY: usize = 2;
/// Half widths of the windows in which surfaces are looked for, over the distance, and the opacity that one has.
const WINDOWS: [f32; 3] = [0.3, 0.15, 0.08];
const SURFACE: f32 = 0.5;
const SURFACE_RAYS: usize = 1 << 12;
/// Output layers are padded to whole vectors.
const PADDED: usize = 16;
/// Stream of the head's initial values.
const LABELS: u64 = 5;

/// Field, classes and capture of one run.
pub struct TextModel {
    pub config: Config,
    pub stage: Stage,
    pub capture: Capture,
    pub labels: Labels,
    pub model_from_world: Similarity,
    /// Density and color.
    pub field: Field,
    /// Density and shares of the classes, once they are learned.
    pub classes: Option<Field>,
    pub occupancy: Occupancy,
    /// Training frames, as indices into the capture.
    pub train: Vec<usize>,
    pub origin: Origin,
    pub rays: u64,
    pub rate_scale: f32,
}

impl TextModel {
    /// An untrained model.
    ///
    /// # Errors
    /// When the configuration is wrong, or there are no training photographs.
    pub fn new(config: Config, capture: Capture, labels: Labels) -> Result<TextModel> {
        use crate::run::config::Configuration;
        config.check()?;
        let train = capture.indices(Split::Train);
        if train.is_empty() {
            return Err(PipelineError::Usage(format!("{}: no photographs to train on", config.data.path.display())));
        }
        let space = match config.field.space == "unbounded" {
            // What lies around the cameras keeps its shape.
            true => Space::Contracted((2.0 * capture.viewing_distance()).clamp(1.0, 8.0) as f32),
            false => Space::Cube(capture.scene.aabb_scale.max(1) as f32),
        };
        let (cubes, cascades, unbounded) = match space {
            Space::Contracted(edge) => (2.0 * edge, 8, true),
            Space::Cube(edge) => (edge, (edge.ceil() as u32).next_power_of_two().ilog2() as usize + 1, false),
        };
        let f = &config.field;
        let grid = HashGridConfig {
            levels: f.levels,
            features: 2,
            log2_size: f.log2_size,
            base: f.base,
            finest: (f.finest as f32 * cubes) as u32,
        };
        let mut field = fields::ngp(grid, space, config.optim.rate, train.len(), f.appearance, config.seed);
        field.net.density.shift = FIRST_DENSITY.ln();
        field.net.mlp.precision = Precision::Bf16;
        field.encoder.table_mut().into_iter().for_each(|t| t.adam.weight_decay = TABLE_DECAY);
        field.groups_mut().into_iter().for_each(|g| g.schedule = schedule(&config));
        let mut model = TextModel {
            stage: Stage::Scene,
            model_from_world: capture.scene.model_from_world(),
            field,
            classes: None,
            occupancy: Occupancy::new(config.sampling.occupancy_resolution, cascades, unbounded),
            train,
            origin: Origin::default(),
            rays: 0,
            rate_scale: 1.0,
            config,
            capture,
            labels,
        };
        let cameras = model.cameras();
        // Steps no finer than what a pixel sees: coarse photographs hold no more.
        let focal = cameras.iter().map(|c| c.camera.fx).fold(0.0, f64::max);
        model.occupancy.cone = occupancy::CONE.max(1.0 / focal as f32);
        model.occupancy.keep_visible(&cameras, 2);
        Ok(model)
    }

    /// A frame's camera at the run's resolution, in model space.
    pub fn posed(&self, frame: usize) -> PosedCamera {
        let f = &self.capture.frames[frame];
        PosedCamera { camera: f.camera.downscaled(self.config.data.downscale), pose: self.model_from_world.pose(&f.world_from_camera) }
    }

    /// The training cameras.
    pub fn cameras(&self) -> Vec<PosedCamera> {
        self.train.iter().map(|i| self.posed(*i)).collect()
    }

    /// Lowest corner and edge of the outer cube in model space.
    pub fn cube(&self) -> (f32, f32) {
        match self.field.space {
            Space::Contracted(_) => (0.5 - FAR, 2.0 * FAR),
            Space::Cube(edge) => (0.5 - 0.5 * edge, edge),
        }
    }

    /// Cameras and extent of the rays of training.
    pub fn scene(&self) -> Scene {
        Scene { cameras: self.cameras(), near: self.config.sampling.near, cube: self.cube() }
    }

    /// Limits below which samples are dropped in training.
    pub fn pruning(&self) -> Pruning {
        Pruning { stop: 1e-4, min_alpha: 3e-3, thin: 0.7 * self.field.net.density.shift.exp(), min_weight: 0.0 }
    }

    fn tracer_of<'a>(&'a self, field: &'a Field, quality: Quality) -> Tracer<'a> {
        let placement = Placement::occupied(&self.occupancy, self.config.sampling.max_samples, quality.pruning());
        Tracer {
            occupancy: Some(&self.occupancy),
            backdrop: Backdrop::Color([0.0; 3]),
            near: self.config.sampling.near,
            shared_weight: quality.shared_weight(),
            tolerance: quality.tolerance(),
            ..Tracer::new(field, placement, self.cube())
        }
    }

    /// A renderer of colors with the mean appearance code.
    pub fn tracer(&self, quality: Quality) -> Tracer<'_> {
        self.tracer_of(&self.field, quality)
    }

    /// A renderer of the classes' shares; none before they are learned.
    pub fn label_tracer(&self, quality: Quality) -> Option<Tracer<'_>> {
        self.classes.as_ref().map(|classes| self.tracer_of(classes, quality))
    }

    /// Shares of the classes `[H · W, C]` that a camera sees, what nothing hides the background's; none before they are learned.
    pub fn shares(&self, camera: &PosedCamera, progress: &mut dyn FnMut(usize)) -> Option<Vec<f32>> {
        let layers = self.label_tracer(Quality::Full)?.layers(camera, &[], progress);
        let mut shares = layers.values.data;
        for (row, opacity) in shares.chunks_exact_mut(self.labels.count()).zip(&layers.opacity.data) {
            row[0] += 1.0 - opacity;
        }
        Some(shares)
    }

    /// Distances of surfaces along rays of a camera's pixels, from those that their light ends at on average: means in narrowing windows around
    /// them, which leave out fog before a surface. 0 where less than half of the light ends there.
    pub fn surfaces(&self, camera: &PosedCamera, pixels: &[usize], distances: &[f32]) -> Vec<f32> {
        let (w, mut out, mut buf) = (camera.camera.width as usize, distances.to_vec(), FieldBuffers::default());
        let tracer = self.tracer(Quality::Full);
        for (pixels, out) in pixels.chunks(SURFACE_RAYS).zip(out.chunks_mut(SURFACE_RAYS)) {
            let mut batch = RayBatch::default();
            batch.resize(pixels.len());
            for (i, p) in pixels.iter().enumerate() {
                batch.pixels[2 * i..2 * i + 2].copy_from_slice(&[(p % w) as f32 + 0.5, (p / w) as f32 + 0.5]);
                (batch.images[i], batch.jitter[i]) = (0, 0.5);
            }
            pixels::rays(std::slice::from_ref(camera), self.config.sampling.near, self.cube(), &mut batch);
            for share in WINDOWS {
                for (i, d) in out.iter().enumerate() {
                    batch.near_far[2 * i..2 * i + 2].copy_from_slice(&[(1.0 - share) * d, (1.0 + share) * d]);
                }
                let traced = tracer.trace(&mut batch, &mut buf);
                for (i, d) in out.iter_mut().enumerate() {
                    *d = if traced.opacity[i] > SURFACE { traced.depth[i] / traced.opacity[i] } else { 0.0 };
                }
            }
        }
        out
    }

    /// A view whose depths are those of surfaces, and whose opacity is 0 where there is none.
    pub fn surface_view(&self, camera: &PosedCamera) -> View {
        let mut view = self.tracer(Quality::Full).view(camera, &mut |_| ());
        let all: Vec<usize> = (0..view.depth.data.len()).collect();
        view.depth.data = self.surfaces(camera, &all, &view.depth.data);
        view.opacity.data.iter_mut().zip(&view.depth.data).filter(|(_, d)| **d == 0.0).for_each(|(o, _)| *o = 0.0);
        view
    }

    /// Goes on to the stage of labels: density and color stay.
    pub fn begin_labels(&mut self) {
        self.classes = Some(of_labels(&self.config, &self.field, self.labels.count()));
        self.stage = Stage::Labels;
    }

    /// Whether any parameter is not finite.
    pub fn is_broken(&mut self) -> bool {
        params(&mut self.field, &mut self.classes).is_broken()
    }

    /// Everything that a checkpoint holds.
    pub fn entries(&mut self) -> (Vec<Entry<'_>>, HashMap<String, String>) {
        let metadata = HashMap::from([
            ("method".to_string(), "text".to_string()),
            ("stage".into(), if self.stage == Stage::Labels { "labels" } else { "scene" }.into()),
            ("step".into(), self.origin.step.to_string()),
            ("rays".into(), self.rays.to_string()),
            ("seconds_bits".into(), self.origin.seconds.to_bits().to_string()),
            ("rate_scale_bits".into(), self.rate_scale.to_bits().to_string()),
        ]);
        let mut entries = param_state::entries(params(&mut self.field, &mut self.classes));
        entries.extend([entry("occupancy", &self.occupancy.grid.density), entry("occupancy.fresh", &self.occupancy.grid.fresh)]);
        (entries, metadata)
    }

    /// Takes over a checkpoint of the same shape.
    ///
    /// # Errors
    /// When the checkpoint is of another method or shape.
    pub fn restore(&mut self, mut c: Checkpoint, file: &Path) -> Result<()> {
        fn number<T: std::str::FromStr>(c: &Checkpoint, key: &str, file: &Path) -> Result<T> {
            let value = c.metadata.get(key).and_then(|v| v.parse().ok());
            value.ok_or_else(|| PipelineError::Usage(format!("{}: metadata {key} is missing or malformed", file.display())))
        }
        let is_labels = c.metadata.get("stage").is_some_and(|s| s == "labels");
        if is_labels && self.classes.is_none() {
            self.begin_labels();
        }
        self.origin = Origin { step: number(&c, "step", file)?, seconds: f64::from_bits(number(&c, "seconds_bits", file)?) };
        self.rays = number(&c, "rays", file)?;
        self.rate_scale = f32::from_bits(number(&c, "rate_scale_bits", file)?);
        param_state::restore(&mut params(&mut self.field, &mut self.classes), &mut c, file)?;
        param_state::take(&mut self.occupancy.grid.density, "occupancy", &mut c, file)?;
        param_state::take(&mut self.occupancy.grid.fresh, "occupancy.fresh", &mut c, file)?;
        self.occupancy.grid.refresh();
        // The grid of both fields is one.
        if let (Some(classes), Some(table)) = (&mut self.classes, self.field.encoder.table()) {
            classes.encoder.table_mut().into_iter().for_each(|t| t.values.clone_from(&table.values));
        }
        Ok(())
    }
}

/// The parameters that a checkpoint holds: the grid stands once.
fn params<'a>(field: &'a mut Field, classes: &'a mut Option<Field>) -> ParamSet<'a> {
    let mut params = ParamSet::default();
    params.add("field", field.groups_mut());
    params.add("labels", classes.iter_mut().map(|c| &mut c.weights));
    params
}

/// Course of the rates over each stage.
fn schedule(config: &Config) -> Schedule {
    Schedule { warmup: 0.01, final_scale: config.optim.final_scale, decay_from: 0.0 }
}

/// Shares of classes on the density of a field, which stays: triangle waves of the position and the density's 16 features → width → width →
/// classes.
fn of_labels(config: &Config, scene: &Field, classes: usize) -> Field {
    use Source::{Input, Layer as L};
    let l = &config.labels;
    let layer = |inputs, width, activation| Layer::new(inputs, width, activation, true);
    let mut layers = scene.net.mlp.layers[..DENSITY].to_vec();
    let mut widths = vec![scene.encoder.dims()];
    let mut reads = vec![L(1)];
    if l.waves > 0 {
        widths.push(3 * l.waves);
        reads.insert(0, Input(1));
    }
    layers.extend([
        layer(reads, l.width, Activation::Relu),
        layer(vec![L(DENSITY)], l.width, Activation::Relu),
        layer(vec![L(DENSITY + 1)], classes.next_multiple_of(PADDED), Activation::None),
    ]);
    let head = Head { layer: DENSITY + 2, channel: 0, activation: Activation::None, shift: 0.0 };
    let net = FieldNet {
        density: scene.net.density,
        outputs: vec![Output { head, channels: classes, are_shares: true }],
        mlp: Mlp { precision: scene.net.mlp.precision, ..Mlp::new(widths, layers) },
    };
    let mut weights = net.mlp.init(&Rng::new(config.seed, LABELS));
    let kept = net.mlp.offsets[DENSITY];
    weights[..kept].copy_from_slice(&scene.weights.values[..kept]);
    let adam = Adam { rate: config.optim.label_rate, ..Adam::default() };
    let encoder = match &scene.encoder {
        Encoder::Hash { grid, table } => Encoder::Hash { grid: grid.clone(), table: ParamGroup { frozen: true, ..table.values_only() } },
        other => other.clone(),
    };
    let mut field = Field {
        weights: ParamGroup { schedule: schedule(config), ..ParamGroup::dense("weights", weights, adam) },
        codes: RayCodes { direction: DirectionCode::None, appearance: None, given: Vec::new() },
        waves: (l.waves > 0).then_some(l.waves),
        space: scene.space,
        normals: None,
        encoder,
        net,
    };
    field.freeze_layers(|j| j < DENSITY);
    field
}
