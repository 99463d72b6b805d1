//! Where a run trains: on the CPU, or on a GPU that keeps all of its state.

use super::config::{Config, Method};
use super::model::ObjectModel;
use super::recipe::Photographs;
use crate::error::{PipelineError, Result};
use diorama_geom::rng::Rng;
use diorama_kernels::device::Api;
use diorama_kernels::ops::ray_generation::PosedCamera;
#[cfg(feature = "gpu")]
use running::Running;

/// What a step on a GPU depends on besides the configuration.
#[cfg_attr(not(feature = "gpu"), allow(dead_code, reason = "only GPUs read it"))]
pub(super) struct Drawing {
    pub rays: usize,
    pub pixels: Rng,
    /// A new background colour for every ray; none: the run's one colour.
    pub background: Option<Rng>,
    /// Points at which the occupancy grid is sampled in this step; none: it is not.
    pub probes: Option<Rng>,
    /// Edge of the blocks of cells that share a probe.
    pub block: usize,
    pub stretch: f32,
    pub thin: f32,
    pub rate_scale: f32,
}

/// What steps came to, on average over those since the last time that the device was asked.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct StepFigures {
    pub loss: f64,
    pub mse: f64,
    pub trained: f64,
    pub marched: f64,
}

/// The device of a run.
pub(super) struct Opened {
    #[cfg(feature = "gpu")]
    running: Option<Running>,
    note: Option<String>,
}

/// Why a GPU cannot train a configuration.
fn lacking(config: &Config) -> Option<String> {
    let what = match config.method {
        Method::Ngp if config.sampling.error_map => "sampling.error_map".to_string(),
        Method::Ngp if config.camera.refine => "camera.refine".to_string(),
        Method::Ngp => return None,
        m => format!("method {m}"),
    };
    Some(format!("{what} trains on the CPU alone"))
}

/// Finds the device that a configuration asks for; `auto` is the best GPU that is no software, else the CPU.
///
/// # Errors
/// When a named GPU is not part of the build, absent, or cannot train the configuration.
pub(super) fn open(config: &Config) -> Result<Opened> {
    match &config.device[..] {
        "cpu" => Ok(Opened::cpu(None)),
        "auto" => Ok(Opened::best(config)),
        name => {
            let api: Api = name.parse().map_err(PipelineError::Usage)?;
            if !api.is_built() {
                return Err(PipelineError::Usage(api.not_built()));
            }
            if let Some(what) = lacking(config) {
                return Err(PipelineError::Usage(format!("device {name}: {what}; use --device cpu")));
            }
            Opened::named(api)
        }
    }
}

/// Lets the named device draw a model's views; what draws them, in words. `auto` is the best GPU that is no software,
/// else the CPU, which also draws what GPUs cannot.
///
/// # Errors
/// When a named GPU is not part of the build, absent, or cannot draw the model.
pub fn accelerate(model: &mut ObjectModel, device: &str) -> Result<String> {
    // What is only trained differently does not matter to views.
    let mut c = Config::new(model.config.method, model.config.data.path.clone());
    c.set("device", device)?;
    let opened = open(&c)?;
    #[cfg(not(feature = "gpu"))]
    drop(opened);
    #[cfg(feature = "gpu")]
    if let (Some(r), Some(occupancy)) = (opened.running, &model.occupancy) {
        let tracer = diorama_engine::on_gpu::GpuTracer::new(r.gpu().clone(), &model.field, occupancy);
        model.accelerator = Some(Box::new(tracer));
        return Ok(r.name());
    }
    Ok(cpu_name())
}

/// The CPU in words.
pub(super) fn cpu_name() -> String {
    format!("cpu ({}, {} threads)", diorama_kernels::simd::level().name(), rayon::current_num_threads())
}

impl Opened {
    pub fn cpu(note: Option<String>) -> Opened {
        Opened {
            #[cfg(feature = "gpu")]
            running: None,
            note,
        }
    }

    /// What the user is told.
    pub fn note(&self) -> Option<String> {
        self.note.clone()
    }
}

#[cfg(not(feature = "gpu"))]
impl Opened {
    fn best(_: &Config) -> Opened {
        Opened::cpu(None)
    }

    fn named(api: Api) -> Result<Opened> {
        Err(PipelineError::Usage(api.not_built()))
    }

    pub fn is_gpu(&self) -> bool {
        false
    }

    pub fn name(&self) -> String {
        "cpu".into()
    }

    pub fn batch_samples(&self, config: &Config) -> usize {
        batch_samples(config, false)
    }

    pub fn most_rays(&self) -> usize {
        MOST_RAYS
    }

    pub fn upload(&mut self, _: &ObjectModel, _: &Photographs, _: &[PosedCamera]) -> Result<()> {
        Ok(())
    }

    pub fn step(&mut self, _: &mut ObjectModel, _: u64, _: &Drawing) -> Result<StepFigures> {
        unreachable!("this build has no GPUs")
    }

    pub fn figures(&mut self, _: &mut ObjectModel) -> Result<StepFigures> {
        Ok(StepFigures::default())
    }

    pub fn download(&mut self, _: &mut ObjectModel) -> Result<()> {
        Ok(())
    }
}

/// Most rays per step on a CPU; GPUs take eight times as many, as they take samples.
const MOST_RAYS: usize = 1 << 14;

/// Samples per step.
fn batch_samples(config: &Config, is_gpu: bool) -> usize {
    match config.sampling.batch_samples {
        0 if is_gpu => 1 << 18,
        0 => 1 << 15,
        n => n,
    }
}

#[cfg(feature = "gpu")]
impl Opened {
    fn best(config: &Config) -> Opened {
        use diorama_kernels::gpu::Gpu;
        let Some(gpu) = Api::ALL.into_iter().filter(|a| a.is_built()).find_map(|a| Gpu::open_hardware(a).ok()) else {
            return Opened::cpu(None);
        };
        match lacking(config) {
            Some(what) => Opened::cpu(Some(format!("{}: {what}", gpu.name))),
            None => Opened::gpu(gpu),
        }
    }

    fn named(api: Api) -> Result<Opened> {
        let gpu = diorama_kernels::gpu::Gpu::open(api).map_err(|e| PipelineError::Usage(e.to_string()))?;
        Ok(Opened::gpu(gpu))
    }

    fn gpu(gpu: diorama_kernels::gpu::Gpu) -> Opened {
        Opened { running: Some(Running::new(gpu)), note: None }
    }

    pub fn is_gpu(&self) -> bool {
        self.running.is_some()
    }

    pub fn name(&self) -> String {
        self.running.as_ref().map_or("cpu".into(), Running::name)
    }

    /// Whether a GPU computes that the CPU does not play.
    fn is_hardware(&self) -> bool {
        self.running.as_ref().is_some_and(|r| !r.gpu().software)
    }

    /// Samples per step.
    pub fn batch_samples(&self, config: &Config) -> usize {
        batch_samples(config, self.is_hardware())
    }

    /// Rays per step.
    pub fn most_rays(&self) -> usize {
        if self.is_hardware() { MOST_RAYS * 8 } else { MOST_RAYS }
    }

    /// Brings the model and the photographs to the device.
    ///
    /// # Errors
    /// When they do not fit there.
    pub fn upload(&mut self, model: &ObjectModel, photographs: &Photographs, cameras: &[PosedCamera]) -> Result<()> {
        self.running.as_mut().map_or(Ok(()), |r| r.upload(model, photographs, cameras))
    }

    /// One step; its figures are those of the last time that the device was asked.
    ///
    /// # Errors
    /// When the device was lost.
    pub fn step(&mut self, model: &mut ObjectModel, step: u64, drawing: &Drawing) -> Result<StepFigures> {
        let room = self.batch_samples(&model.config);
        self.running.as_mut().expect("a GPU is open").step(model, step, drawing, room)
    }

    /// Waits for the device and counts what it has done.
    ///
    /// # Errors
    /// When the device was lost.
    pub fn figures(&mut self, model: &mut ObjectModel) -> Result<StepFigures> {
        self.running.as_mut().map_or(Ok(StepFigures::default()), |r| r.figures(model))
    }

    /// Brings the model back.
    ///
    /// # Errors
    /// When the device was lost.
    pub fn download(&mut self, model: &mut ObjectModel) -> Result<()> {
        self.running.as_mut().map_or(Ok(()), |r| r.download(model))
    }
}

#[cfg(feature = "gpu")]
mod running {
    use super::{Drawing, StepFigures};
    use crate::error::{PipelineError, Result};
    use crate::object::model::ObjectModel;
    use crate::object::recipe::Photographs;
    use diorama_engine::on_gpu::{GpuStep, GpuTrainer};
    use diorama_engine::samplers::pixels::PixelSource;
    use diorama_kernels::gpu::{Gpu, GpuError};
    use diorama_kernels::ops::march::gpu::prune::Limits;
    use diorama_kernels::ops::ngp_field::gpu::loss::Terms;
    use diorama_kernels::ops::pixel_gather::gpu::{Backdrop, GpuPhotographs};
    use diorama_kernels::ops::ray_generation::PosedCamera;

    /// Most steps between which the device is not asked how they went.
    const UNASKED: u64 = 16;

    /// Room for marched and for trained samples, in wanted samples per step. Rays beyond it are left out of the step.
    const ROOM: (usize, usize) = (6, 2);

    /// A GPU, and what is in training there.
    pub struct Running {
        gpu: Gpu,
        trainer: Option<GpuTrainer>,
        /// Figures of the last time that the device was asked.
        last: Option<StepFigures>,
        /// Rays of the steps that were not asked about.
        rays: u64,
    }

    impl Running {
        pub fn new(gpu: Gpu) -> Running {
            Running { gpu, trainer: None, last: None, rays: 0 }
        }

        pub fn gpu(&self) -> &Gpu {
            &self.gpu
        }

        /// What the device calls itself, and how it is reached.
        pub fn name(&self) -> String {
            format!("{} ({})", self.gpu.name, self.gpu.api.name())
        }

        pub fn upload(&mut self, m: &ObjectModel, photographs: &Photographs, cameras: &[PosedCamera]) -> Result<()> {
            if !photographs.are_whole() {
                let cure = "raise it (--set data.memory_budget=BYTES), raise --downscale, or use --device cpu";
                return Err(PipelineError::Usage(format!(
                    "the photographs exceed data.memory_budget, and a GPU takes all of their pixels; {cure}"
                )));
            }
            let bytes = photographs.bytes();
            let most = self.gpu.largest_buffer();
            if bytes > most {
                return Err(PipelineError::Usage(format!(
                    "the photographs take {} MB, {} holds {} MB in one piece; raise --downscale, or use --device cpu",
                    bytes >> 20,
                    self.gpu.name,
                    most >> 20
                )));
            }
            // What was known of steps before belongs to parameters that are gone.
            (self.last, self.rays) = (None, 0);
            let occupancy = m.occupancy.as_ref().expect("ngp has an occupancy grid");
            let images = resident(&self.gpu, photographs);
            self.trainer = Some(GpuTrainer::new(self.gpu.clone(), &m.field, m.learned.as_ref(), occupancy, images, cameras, m.cube()));
            Ok(())
        }

        fn trainer(&mut self) -> &mut GpuTrainer {
            self.trainer.as_mut().expect("the model was uploaded")
        }

        pub fn step(&mut self, m: &mut ObjectModel, step: u64, d: &Drawing, room: usize) -> Result<StepFigures> {
            let (c, s) = (&m.config, &m.config.sampling);
            let grid = m.occupancy.as_ref().expect("ngp has an occupancy grid");
            let o = GpuStep {
                rays: d.rays,
                first: m.origin.rays,
                pixels: d.pixels,
                backdrop: d.background.map_or(Backdrop::Color(m.backdrop_color()), Backdrop::Random),
                near: s.near,
                march: grid.march_config(s.max_samples).stretched(d.stretch),
                limits: Limits { stop: s.stop, min_alpha: s.min_alpha, thin: d.thin, min_weight: 0.0 },
                terms: Terms { huber: if c.loss.color == "huber" { 0.1 } else { 0.0 }, distortion: c.loss.distortion, alpha: c.loss.alpha },
                near_scaling: c.loss.near_scaling,
                room: (room * ROOM.0, room * ROOM.1),
                t: step as u32 + 1,
                rate_scale: d.rate_scale,
            };
            let points = s.occupancy_points;
            let asked = self.last.is_none() || (step + 1).is_multiple_of(UNASKED.min(c.run.log_every));
            let trainer = self.trainer();
            if let Some(rng) = &d.probes {
                trainer.update_occupancy(rng, step, points, d.block);
            }
            trainer.step(&o);
            self.rays += d.rays as u64;
            m.origin.rays += d.rays as u64;
            if asked { self.figures(m) } else { Ok(self.known()) }
        }

        pub fn figures(&mut self, m: &mut ObjectModel) -> Result<StepFigures> {
            let rays = std::mem::take(&mut self.rays);
            if rays == 0 {
                return Ok(self.known());
            }
            let f = self.trainer().figures().map_err(told)?;
            let per_ray = f.trained / rays as f64;
            let kept = if m.origin.samples == 0 { 0.0 } else { 0.9f64.powi(f.steps as i32) };
            m.samples_per_ray = kept * m.samples_per_ray + (1.0 - kept) * per_ray;
            m.origin.samples += f.trained as u64;
            let figures = StepFigures { loss: f.loss, mse: f.mse, trained: f.trained / f.steps.max(1) as f64, marched: f.marched };
            self.last = Some(figures);
            Ok(figures)
        }

        /// The last figures, but for marched samples, which were counted.
        fn known(&self) -> StepFigures {
            StepFigures { marched: 0.0, ..self.last.unwrap_or_default() }
        }

        pub fn download(&mut self, m: &mut ObjectModel) -> Result<()> {
            let occupancy = m.occupancy.as_mut().expect("ngp has an occupancy grid");
            self.trainer().download(&mut m.field, m.learned.as_mut(), occupancy).map_err(told)
        }
    }

    fn told(e: GpuError) -> PipelineError {
        PipelineError::Device(e.to_string())
    }

    /// All pixels, and which of them count.
    fn resident(gpu: &Gpu, photographs: &Photographs) -> GpuPhotographs {
        let sizes: Vec<(u32, u32)> = (0..photographs.images()).map(|i| photographs.size(i)).collect();
        let every = || {
            let within = |i: usize, (w, h): (u32, u32)| (0..h).flat_map(move |y| (0..w).map(move |x| (i, x, y)));
            sizes.iter().enumerate().flat_map(move |(i, s)| within(i, *s))
        };
        let pixels: Vec<u32> = every().map(|(i, x, y)| u32::from_le_bytes(photographs.rgba(i, x, y))).collect();
        let mut mask = vec![0u32; pixels.len().div_ceil(32)];
        let mut all = true;
        for (at, (i, x, y)) in every().enumerate() {
            let counts = photographs.counts(i, x, y);
            mask[at / 32] |= (counts as u32) << (at % 32);
            all &= counts;
        }
        GpuPhotographs::upload(gpu, &sizes, &pixels, (!all).then_some(&mask[..]))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_gpus_cannot_train_is_said() {
        let plain = Config::new(Method::Ngp, "x".into());
        assert_eq!(lacking(&plain), None);
        assert!(lacking(&Config::new(Method::Nerf, "x".into())).unwrap().contains("nerf"));
        for key in ["sampling.error_map", "camera.refine"] {
            let mut c = plain.clone();
            c.set(key, "true").unwrap();
            assert!(lacking(&c).unwrap().contains(key));
        }
    }

    #[test]
    fn a_device_outside_of_the_build_is_named_with_its_cure() {
        for api in Api::ALL.into_iter().filter(|a| !a.is_built()) {
            let mut c = Config::new(Method::Ngp, "x".into());
            c.set("device", api.name()).unwrap();
            let Err(PipelineError::Usage(text)) = open(&c) else { panic!("{} opened", api.name()) };
            assert!(text.contains(api.name()) && !text.contains('\n'), "{text}");
        }
        let cpu = open(&Config { device: "cpu".into(), ..Config::new(Method::Ngp, "x".into()) }).unwrap_or_else(|e| panic!("{e}"));
        assert!(!cpu.is_gpu());
    }

    #[test]
    fn batches_are_larger_on_gpus_unless_given() {
        let mut c = Config::new(Method::Ngp, "x".into());
        assert_eq!((batch_samples(&c, false), batch_samples(&c, true)), (1 << 15, 1 << 18));
        c.set("sampling.batch_samples", "100").unwrap();
        assert_eq!((batch_samples(&c, false), batch_samples(&c, true)), (100, 100));
    }
}
