//! The scene model: a field of density, albedo and shadow, and light and sky per session.

use super::config::{Config, Stage};
use super::fields;
use super::joint::{self, Joint};
use super::shading::{LIGHT, SKY};
use super::sun::{SUN, Surfaces};
use super::visibility::{Ambient, Visibility};
use crate::error::{PipelineError, Result};
use crate::run::param_state::{self, entry};
use diorama_data::checkpoint::{Checkpoint, Entry};
use diorama_engine::fields::{Field, FieldBuffers, Pruning};
use diorama_engine::params::{ParamGroup, ParamSet};
use diorama_engine::renderers::volume::{Backdrop, Quality, Tracer};
use diorama_engine::samplers::occupancy::Occupancy;
use diorama_engine::samplers::placement::Placement;
use diorama_engine::step::Scene;
use diorama_engine::train::Origin;
use diorama_geom::capture::{Frame, Split};
use diorama_geom::contraction::Space;
use diorama_geom::glam::Vec3;
use diorama_geom::sh_light::ShLight;
use diorama_geom::{Capture, Similarity};
use diorama_kernels::ops::adam::Adam;
use diorama_kernels::ops::ray_generation::PosedCamera;
use std::collections::HashMap;
use std::path::Path;
use std::sync::Arc;

/// Where rays end in space without a bound, in inner cubes, and where the sky begins: what was learned beyond is the sky of the photographs.
const FAR: f32 = 1024.0;
const SKY_FROM: f32 = 8.0;

/// What shadows read where they do not matter.
const UNLIT: [f32; 9] = [0.0; 9];

/// What stands around: what hides light, and surfaces that send it on.
pub struct Around {
    pub visibility: Arc<Visibility>,
    pub surfaces: Surfaces,
}

/// Field, lights and capture of one run.
pub struct SceneModel {
    pub config: Config,
    pub stage: Stage,
    /// First step of the light's stage.
    pub began: u64,
    pub capture: Capture,
    pub model_from_world: Similarity,
    pub field: Field,
    /// Coarse network, its lights and the backgrounds; only where `field.kind` is `mlp`.
    pub joint: Option<Joint>,
    pub occupancy: Occupancy,
    /// `[lights, 9, 3]`
    pub lights: ParamGroup,
    /// `[lights, 16, 3]`
    pub skies: ParamGroup,
    /// Logarithms of gains, `[train, 3]`; empty without gains.
    pub gains: ParamGroup,
    /// Sun of each light, `[lights, 6]`. Lights hold suns, too, unless they are apart.
    pub suns: ParamGroup,
    /// Times that surfaces were flattened, and the distances that are from this: `[N, 4]` of image, column, row, distance.
    pub flattened: u64,
    pub flat: Vec<f32>,
    /// Suns and lights `[lights, 6 + 27]` in which surfaces sent light on when that was found last, from the light's stage on.
    pub sent: Vec<f32>,
    /// What hides light and sends it on, from the light's stage on.
    pub surroundings: Option<Arc<Around>>,
    /// Training frames, as indices into the capture, and the light of each.
    pub train: Vec<usize>,
    pub light_of: Vec<u32>,
    /// Session of each light, where photographs of a session share it.
    pub sessions: Vec<u32>,
    pub origin: Origin,
    pub rays: u64,
    /// Running mean of the samples that a ray of training has.
    pub samples_per_ray: f64,
    /// Running median of the errors, in sRGB.
    pub median: f32,
    pub rate_scale: f32,
}

impl SceneModel {
    /// An untrained model.
    ///
    /// # Errors
    /// When the configuration is wrong, or there are no training photographs.
    pub fn new(config: Config, capture: Capture) -> Result<SceneModel> {
        use crate::run::config::Configuration;
        config.check()?;
        let train = capture.indices(Split::Train);
        if train.is_empty() {
            return Err(PipelineError::Usage(format!("{}: no photographs to train on", config.data.path.display())));
        }
        let (light_of, sessions) = lights_of(&config, &capture, &train);
        let model_from_world = capture.scene.model_from_world();
        let all_cameras = || capture.frames.iter().map(|f| posed(&config, &model_from_world, f)).collect::<Vec<_>>();
        let sphere = config.field.is_joint().then(|| joint::sphere(&all_cameras()));
        let space = match (&sphere, config.field.space == "unbounded") {
            (Some(sphere), _) => Space::Cube(2.0 * sphere.radius),
            // What lies around the cameras keeps its shape.
            (None, true) => Space::Contracted((2.0 * capture.viewing_distance()).clamp(1.0, 8.0) as f32),
            (None, false) => Space::Cube(capture.scene.aabb_scale.max(1) as f32),
        };
        let (edge, unbounded) = match space {
            Space::Contracted(_) => (1, true),
            Space::Cube(e) => ((e.ceil() as u32).next_power_of_two(), false),
        };
        let cascades = if unbounded { 8 } else { edge.ilog2() as usize + 1 };
        let schedule = fields::schedule(&config);
        let adam = |rate: f32| Adam { rate, ..Adam::default() };
        let group = |name, values, rate| ParamGroup { schedule, ..ParamGroup::dense(name, values, adam(rate)) };
        let n = sessions.len().max(light_of.iter().map(|l| *l as usize + 1).max().unwrap_or(0));
        let rate = config.optim.light_rate;
        let gains = if config.light.gain { vec![0.0; 3 * train.len()] } else { Vec::new() };
        let field = match &sphere {
            Some(sphere) => joint::fine(&config, sphere),
            None => fields::of_surfaces(&config, space, train.len()),
        };
        let joint = sphere.map(|sphere| Joint::new(&config, sphere, n));
        let mut model = SceneModel {
            stage: if joint.is_some() { Stage::Light } else { Stage::Surfaces },
            began: 0,
            model_from_world,
            field,
            joint,
            occupancy: Occupancy::new(config.sampling.occupancy_resolution, cascades, unbounded),
            lights: match &sphere {
                Some(_) => joint::joint_lights(&config, n),
                None => group("lights", fields::first_lights(n), rate),
            },
            skies: group("skies", first_skies(n), rate),
            gains: group("gains", gains, rate),
            suns: group("suns", vec![0.0; SUN * n], rate),
            flattened: 0,
            flat: Vec::new(),
            sent: Vec::new(),
            surroundings: None,
            train,
            light_of,
            sessions,
            origin: Origin::default(),
            rays: 0,
            samples_per_ray: 256.0,
            median: 0.1,
            rate_scale: 1.0,
            config,
            capture,
        };
        let cameras = model.cameras();
        model.occupancy.keep_visible(&cameras, 2);
        Ok(model)
    }

    /// A frame's camera at the run's resolution, in model space.
    pub fn posed(&self, frame: usize) -> PosedCamera {
        posed(&self.config, &self.model_from_world, &self.capture.frames[frame])
    }

    /// The training cameras.
    pub fn cameras(&self) -> Vec<PosedCamera> {
        self.train.iter().map(|i| self.posed(*i)).collect()
    }

    /// Lowest corner and edge of the outer cube in model space.
    pub fn cube(&self) -> (f32, f32) {
        self.cube_in(self.stage)
    }

    /// The same in a stage: light has no surfaces in the sky.
    pub fn cube_in(&self, stage: Stage) -> (f32, f32) {
        let far = if stage == Stage::Light { SKY_FROM } else { FAR };
        match self.field.space {
            Space::Contracted(_) => (0.5 - far, 2.0 * far),
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

    /// A renderer of layers.
    pub fn tracer(&self, quality: Quality) -> Tracer<'_> {
        Tracer {
            field: &self.field,
            coarse: self.joint.as_ref().map(|j| &j.coarse),
            occupancy: Some(&self.occupancy),
            placement: match &self.joint {
                Some(_) => Joint::placement(&self.config),
                None => Placement::occupied(&self.occupancy, self.config.sampling.max_samples, quality.pruning()),
            },
            backdrop: Backdrop::Color([0.0; 3]),
            near: self.config.sampling.near,
            cube: self.cube(),
            clip: None,
            crop: None,
            is_linear: true,
            shared_weight: 0.0,
            appearance: None,
            tolerance: 0.0,
            within: self.joint.as_ref().filter(|j| !j.backgrounds.is_empty()).map(|j| j.sphere),
            accelerator: None,
            seen_along: None,
        }
    }

    /// Codes of the field for layers that no light changes; none in the stage of surfaces.
    pub fn unlit_codes(&self) -> Vec<&'static [f32]> {
        vec![&UNLIT; self.field.codes.given.len()]
    }

    /// The light of a session or photograph.
    pub fn light(&self, index: usize) -> ShLight {
        let values = &self.lights.values[index * LIGHT..][..LIGHT];
        ShLight(std::array::from_fn(|i| std::array::from_fn(|k| values[3 * i + k] as f64)))
    }

    /// Number of lights that are learned.
    pub fn light_count(&self) -> usize {
        self.lights.values.len() / LIGHT
    }

    /// Name of a learned light: its session, or its photograph.
    pub fn light_name(&self, index: usize) -> String {
        match self.sessions.get(index) {
            Some(session) => format!("Session {session}"),
            None => self.capture.frames[self.train[index]].name.clone(),
        }
    }

    /// The sky of a session or photograph, `[16, 3]`.
    pub fn sky(&self, index: usize) -> &[f32] {
        &self.skies.values[index * SKY..][..SKY]
    }

    /// The light of a frame of the capture: its own, or that of its session; none for sessions that were not trained on.
    pub fn light_of_frame(&self, frame: usize) -> Option<usize> {
        match self.train.iter().position(|t| *t == frame) {
            Some(i) => Some(self.light_of[i] as usize),
            None if self.config.light.of == "image" => None,
            None => self.sessions.iter().position(|s| Some(*s) == self.capture.frames[frame].session.or(Some(0))),
        }
    }

    /// A copy that renders: without gradients and moments.
    pub fn for_rendering(&self) -> SceneModel {
        SceneModel {
            config: self.config.clone(),
            stage: self.stage,
            began: self.began,
            capture: self.capture.clone(),
            model_from_world: self.model_from_world,
            field: self.field.for_rendering(),
            joint: self.joint.as_ref().map(Joint::for_rendering),
            occupancy: self.occupancy.clone(),
            lights: self.lights.values_only(),
            skies: self.skies.values_only(),
            gains: self.gains.values_only(),
            suns: self.suns.values_only(),
            flattened: self.flattened,
            flat: Vec::new(),
            sent: self.sent.clone(),
            surroundings: self.surroundings.clone(),
            train: self.train.clone(),
            light_of: self.light_of.clone(),
            sessions: self.sessions.clone(),
            origin: self.origin,
            rays: self.rays,
            samples_per_ray: self.samples_per_ray,
            median: self.median,
            rate_scale: self.rate_scale,
        }
    }

    /// Numbers of what stands around, as a checkpoint keeps them: cells that hide light, surfaces.
    pub fn around(&self) -> Option<[Vec<f32>; 2]> {
        self.surroundings.as_ref().map(|a| [a.visibility.numbers(), a.surfaces.numbers()])
    }

    /// Everything that is trained by gradients.
    pub fn params(&mut self) -> ParamSet<'_> {
        let tables = [&mut self.lights, &mut self.skies, &mut self.gains, &mut self.suns];
        params(&mut self.field, &mut self.joint, tables)
    }

    /// Lowest corner and edge of the cube in which surfaces hide light: all of a bounded space, else some of what is around the inner cube.
    pub fn shaded_cube(&self) -> (f32, f32) {
        if self.field.is_unbounded() { (-0.5, 2.0) } else { self.cube() }
    }

    /// Counts a step's rays and their samples.
    pub fn count(&mut self, rays: usize, samples: f64) {
        let own = samples / rays.max(1) as f64;
        self.samples_per_ray = if self.rays == 0 { own } else { 0.9 * self.samples_per_ray + 0.1 * own };
        self.rays += rays as u64;
    }

    /// Whether suns are apart from the lights' harmonics.
    pub fn has_suns(&self) -> bool {
        self.stage == Stage::Light && self.config.light.has_sun()
    }

    /// The sun of a session or photograph where it is apart.
    pub fn sun(&self, index: usize) -> Option<[f32; SUN]> {
        self.has_suns().then(|| std::array::from_fn(|i| self.suns.values[index * SUN + i]))
    }

    /// Light of the sky and of surfaces in each learned light, where suns are apart.
    pub fn ambients(&self) -> Vec<Ambient> {
        let Some(around) = self.surroundings.as_ref().filter(|_| self.has_suns()) else { return Vec::new() };
        let of = |(sent, sky): (&[f32], &[f32])| {
            let mut ambient = around.surfaces.light(&around.visibility, &sent[..SUN], &sent[SUN..]);
            ambient.sky = sky.to_vec();
            ambient
        };
        self.sent.chunks_exact(SUN + LIGHT).zip(self.lights.values.chunks_exact(LIGHT)).map(of).collect()
    }

    /// Sun and light of each light, `[lights, 6 + 27]`.
    pub fn sun_and_sky(&self) -> Vec<f32> {
        let lights = self.suns.values.chunks_exact(SUN).zip(self.lights.values.chunks_exact(LIGHT));
        lights.flat_map(|(sun, sky)| sun.iter().chain(sky).copied()).collect()
    }

    /// Finds anew what surfaces send, in the lights and with the albedos that the model knows now.
    pub fn send_again(&mut self) {
        let Some(around) = &self.surroundings else { return };
        let albedos = self.albedos(&around.surfaces.positions());
        let mut surfaces = around.surfaces.clone();
        surfaces.albedos = albedos;
        self.surroundings = Some(Arc::new(Around { visibility: around.visibility.clone(), surfaces }));
        self.sent = self.sun_and_sky();
    }

    /// Albedos at points of surfaces.
    fn albedos(&self, points: &[Vec3]) -> Vec<Vec3> {
        let model: Vec<f32> = points.iter().flat_map(|p| p.to_array()).collect();
        let codes = vec![vec![0.0; 9 * points.len()]; self.field.codes.given.len()];
        let given: Vec<&[f32]> = codes.iter().map(|c| &c[..]).collect();
        let mut buffers = FieldBuffers::default();
        let out = self.field.outputs_at(&model, &vec![0.0; model.len()], &given, &mut buffers);
        out.chunks_exact(self.field.channels()).map(Vec3::from_slice).collect()
    }

    /// A field that renders each light by the mean code of its photographs, in place of the photographs' codes.
    ///
    /// # Panics
    /// In the light's stage, where surfaces have no codes.
    pub fn with_shared_codes(&self) -> Field {
        let (lights, mut field) = (self.light_count(), self.field.for_rendering());
        let a = field.codes.appearance.as_mut().expect("the stage of surfaces");
        let mean = |l: usize, k: usize| {
            let own = || (0..self.train.len()).filter(|i| self.light_of[*i] as usize == l);
            own().map(|i| a.group.values[i * a.dims + k]).sum::<f32>() / own().count().max(1) as f32
        };
        let means: Vec<f32> = (0..lights).flat_map(|l| (0..a.dims).map(move |k| (l, k))).map(|(l, k)| mean(l, k)).collect();
        a.group.values = means;
        field
    }

    /// Goes on to the stage of light: surfaces stay, and albedo, shadow and normal are to be learned on them.
    ///
    /// # Errors
    /// When the model is not in the stage of surfaces.
    pub fn begin_light(&mut self) -> Result<()> {
        self.field = fields::of_materials(&self.config, self.field.clone())?;
        self.stage = Stage::Light;
        self.sent = self.sun_and_sky();
        Ok(())
    }

    /// Everything that a checkpoint holds; `around` are the numbers of what stands around.
    pub fn entries<'a>(&'a mut self, around: &'a Option<[Vec<f32>; 2]>) -> (Vec<Entry<'a>>, HashMap<String, String>) {
        let mut metadata = HashMap::from([
            ("method".to_string(), "relight".to_string()),
            ("stage".into(), if self.stage == Stage::Light { "light" } else { "surfaces" }.into()),
            ("began".into(), self.began.to_string()),
            ("step".into(), self.origin.step.to_string()),
            ("rays".into(), self.rays.to_string()),
            ("flattened".into(), self.flattened.to_string()),
            ("seconds_bits".into(), self.origin.seconds.to_bits().to_string()),
            ("samples_per_ray_bits".into(), self.samples_per_ray.to_bits().to_string()),
            ("median_bits".into(), self.median.to_bits().to_string()),
            ("rate_scale_bits".into(), self.rate_scale.to_bits().to_string()),
        ]);
        metadata.extend(self.surroundings.as_ref().map(|a| ("lift_bits".into(), a.visibility.lift().to_bits().to_string())));
        let tables = [&mut self.lights, &mut self.skies, &mut self.gains, &mut self.suns];
        let mut entries = param_state::entries(params(&mut self.field, &mut self.joint, tables));
        entries.extend([entry("occupancy", &self.occupancy.grid.density), entry("occupancy.fresh", &self.occupancy.grid.fresh)]);
        entries.extend([entry("flat", &self.flat), entry("sent", &self.sent)]);
        entries.extend(around.iter().flat_map(|a| ["cells", "surfaces"].into_iter().zip(a)).map(|(name, v)| entry(name, v)));
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
        fn tensor(c: &mut Checkpoint, name: &str, file: &Path) -> Result<Vec<f32>> {
            c.take(name).ok_or_else(|| PipelineError::Usage(format!("{}: {name} is missing", file.display())))
        }
        let is_light = self.joint.is_none() && c.metadata.get("stage").is_some_and(|s| s == "light");
        if is_light && self.stage == Stage::Surfaces {
            self.begin_light()?;
        }
        self.origin = Origin { step: number(&c, "step", file)?, seconds: f64::from_bits(number(&c, "seconds_bits", file)?) };
        self.rays = number(&c, "rays", file)?;
        self.samples_per_ray = f64::from_bits(number(&c, "samples_per_ray_bits", file)?);
        self.began = number(&c, "began", file)?;
        self.flattened = number(&c, "flattened", file)?;
        self.flat = tensor(&mut c, "flat", file)?;
        self.median = f32::from_bits(number(&c, "median_bits", file)?);
        self.rate_scale = f32::from_bits(number(&c, "rate_scale_bits", file)?);
        param_state::restore(&mut self.params(), &mut c, file)?;
        param_state::take(&mut self.occupancy.grid.density, "occupancy", &mut c, file)?;
        param_state::take(&mut self.occupancy.grid.fresh, "occupancy.fresh", &mut c, file)?;
        self.occupancy.grid.refresh();
        if let Some(joint) = &mut self.joint {
            joint.anneal(&mut self.field, self.origin.step);
        }
        if is_light {
            let (cube, cells) = (self.shaded_cube(), self.config.light.sun_cells);
            // Runs of before cells had depths knew which are solid.
            let found = match c.take("solid") {
                Some(bits) => Visibility::from_bits(&bits, cube, cells),
                None => Visibility::from_numbers(&tensor(&mut c, "cells", file)?, cube, cells),
            };
            let Some(mut visibility) = found else {
                return Err(PipelineError::Usage(format!("{}: what hides light does not have {cells} cells per axis", file.display())));
            };
            // Runs of before rays could begin higher have none.
            if c.metadata.contains_key("lift_bits") {
                visibility = visibility.lifted_by(f32::from_bits(number(&c, "lift_bits", file)?));
            }
            let surfaces = Surfaces::from_numbers(&tensor(&mut c, "surfaces", file)?, &visibility);
            self.surroundings = Some(Arc::new(Around { visibility: Arc::new(visibility), surfaces }));
            // Runs of before lights followed photographs have none: their lights are as they were found.
            let sent = c.take("sent").unwrap_or_else(|| self.sun_and_sky());
            if sent.len() != (SUN + LIGHT) * self.light_count() {
                return Err(PipelineError::Usage(format!(
                    "{}: sent has {} numbers for {} lights",
                    file.display(),
                    sent.len(),
                    self.light_count()
                )));
            }
            self.sent = sent;
        }
        Ok(())
    }
}

/// A frame's camera at a run's resolution, in model space.
fn posed(config: &Config, model_from_world: &Similarity, frame: &Frame) -> PosedCamera {
    PosedCamera { camera: frame.camera.downscaled(config.data.downscale), pose: model_from_world.pose(&frame.world_from_camera) }
}

/// The light of each training frame, and the sessions in order.
fn lights_of(config: &Config, capture: &Capture, train: &[usize]) -> (Vec<u32>, Vec<u32>) {
    if config.light.of == "image" {
        return ((0..train.len() as u32).collect(), Vec::new());
    }
    let session = |i: &usize| capture.frames[*i].session.unwrap_or(0);
    let mut sessions: Vec<u32> = train.iter().map(session).collect();
    sessions.sort_unstable();
    sessions.dedup();
    (train.iter().map(|i| sessions.binary_search(&session(i)).expect("listed") as u32).collect(), sessions)
}

/// Everything that is trained by gradients, by the names that checkpoints have.
fn params<'a>(field: &'a mut Field, joint: &'a mut Option<Joint>, tables: [&'a mut ParamGroup; 4]) -> ParamSet<'a> {
    let mut params = ParamSet::default();
    params.add("field", field.groups_mut());
    params.add("", tables);
    if let Some(joint) = joint {
        params.add("coarse", joint.coarse.groups_mut().into_iter().chain([&mut joint.coarse_lights]));
        let names = ["background.coarse", "background.fine"];
        joint.backgrounds.iter_mut().zip(names).for_each(|(b, name)| params.add(name, [&mut b.weights]));
    }
    params
}

/// Even, bright skies.
fn first_skies(n: usize) -> Vec<f32> {
    // The first basis function is 0.2821.
    (0..n).flat_map(|_| (0..SKY).map(|i| if i < 3 { 0.5 / 0.282_094_8 } else { 0.0 })).collect()
}
