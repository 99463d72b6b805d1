//! Where a run trains: on the CPU, or on a GPU that keeps all of its state.

use super::config::{Config, Method};
use super::model::{ObjectModel, Terms};
use super::recipe::Photographs;
use crate::error::{PipelineError, Result};
use diorama_engine::renderers::supervised::Say;
#[cfg(feature = "gpu")]
use diorama_engine::renderers::supervised::Supervised;
#[cfg(feature = "gpu")]
use diorama_engine::renderers::volume::Accelerator;
use diorama_engine::samplers::pixels::Observation;
use diorama_geom::rng::Rng;
use diorama_kernels::device::Api;
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
    /// Of samples without an occupancy grid.
    pub coarse: Rng,
    pub fine: Rng,
    /// Whether draws go by the errors as they are after this step.
    pub refresh_errors: bool,
    pub stretch: f32,
    pub thin: f32,
    pub terms: Terms,
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
    /// How often batches were halved because memory was short.
    halvings: u32,
}

/// Most such halvings.
const HALVINGS: u32 = 2;

/// What follows from the failure of a device in training.
#[derive(Debug)]
pub(super) enum Aftermath {
    /// The step is tried again with half the batch; why, in words.
    Halve(String),
    /// The CPU goes on; why, in words.
    Cpu(String),
    Fail(PipelineError),
}

/// A device that the user named fails for good, and with `auto` the CPU goes on; but where memory is short, the batch is
/// halved first, twice. `needs`: bytes of what training takes, in words.
pub(super) fn aftermath(e: PipelineError, device: &str, halvings: u32, needs: &str) -> Aftermath {
    let is_auto = device == "auto";
    match e {
        PipelineError::Memory(e) if halvings < HALVINGS => Aftermath::Halve(format!("{e}; the batch is halved")),
        PipelineError::Memory(e) if is_auto => Aftermath::Cpu(format!("{e}, even with a quarter of the batch ({needs}); the CPU goes on")),
        PipelineError::Memory(e) => Aftermath::Fail(PipelineError::Memory(format!(
            "{e}, even with a quarter of the batch ({needs}); raise --downscale, lower --set field.log2_size, or use --device cpu"
        ))),
        PipelineError::Device(e) if is_auto => Aftermath::Cpu(format!("{e}; the CPU goes on")),
        PipelineError::Device(e) => {
            Aftermath::Fail(PipelineError::Device(format!("{e}; go on with --resume, on the CPU with --resume --device cpu")))
        }
        e => Aftermath::Fail(e),
    }
}

/// Finds the device that a configuration asks for; `auto` is the best GPU that is no software, else the CPU.
///
/// # Errors
/// When a named GPU is not part of the build or absent.
pub(super) fn open(config: &Config) -> Result<Opened> {
    match &config.device[..] {
        "cpu" => Ok(Opened::cpu(None)),
        "auto" => Ok(Opened::best()),
        name => {
            let api: Api = name.parse().map_err(PipelineError::Usage)?;
            if !api.is_built() {
                return Err(PipelineError::Usage(api.not_built()));
            }
            Opened::named(api)
        }
    }
}

/// Lets the named device evaluate a model's field; which that is, in words. `auto` is the best GPU that is no software,
/// else the CPU, which goes on where that GPU fails: `say` is told so, once. The failure of a device that was named is
/// [`ObjectModel::check_device`]'s.
///
/// # Errors
/// When a named GPU is not part of the build or absent.
pub fn accelerate(model: &mut ObjectModel, device: &str, say: Say) -> Result<String> {
    let mut c = Config::new(model.config.method, model.config.data.path.clone());
    c.set("device", device)?;
    let opened = open(&c)?;
    opened.note().iter().for_each(|n| say(n));
    #[cfg(feature = "gpu")]
    if let Some(r) = opened.running {
        let (field, coarse, occupancy) = (&model.field, model.coarse.as_ref(), model.occupancy.as_ref());
        let tracer = diorama_engine::on_gpu::GpuTracer::new(r.gpu().clone(), field, coarse, occupancy);
        model.accelerator = Some(supervised(Box::new(tracer), r.name(), device, say));
        return Ok(r.name());
    }
    Ok(cpu_name())
}

/// An opened device as the one that was `asked` for by `--device`: any name but `auto` makes its failure the result.
#[cfg(feature = "gpu")]
fn supervised(device: Box<dyn Accelerator>, name: String, asked: &str, say: Say) -> Supervised {
    Supervised::new(device, name, asked != "auto", say)
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
            halvings: 0,
        }
    }

    /// How often batches were halved because memory was short.
    pub fn halvings(&self) -> u32 {
        self.halvings
    }

    /// Halves batches from now on.
    pub fn halve(&mut self) {
        self.halvings += 1;
    }

    /// What the user is told.
    pub fn note(&self) -> Option<String> {
        self.note.clone()
    }
}

#[cfg(not(feature = "gpu"))]
impl Opened {
    fn best() -> Opened {
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

    pub fn most_bytes(&self) -> u64 {
        u64::MAX
    }

    pub fn upload(&mut self, _: &ObjectModel, _: &Photographs, _: &[Observation]) -> Result<()> {
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

/// Samples per step; fewer through networks whose layers' outputs all lie in memory.
pub(super) fn batch_samples(config: &Config, is_gpu: bool) -> usize {
    match config.sampling.batch_samples {
        0 if is_gpu && config.method == Method::Ngp => 1 << 18,
        0 if is_gpu => 1 << 17,
        0 => 1 << 15,
        n => n,
    }
}

#[cfg(feature = "gpu")]
impl Opened {
    fn best() -> Opened {
        use diorama_kernels::gpu::{Gpu, GpuError};
        let mut fault = None;
        for api in Api::ALL.into_iter().filter(|a| a.is_built()) {
            match Gpu::open_hardware(api) {
                Ok(gpu) => return Opened::gpu(gpu),
                // A device that is there and does not open is worth a word.
                Err(e @ GpuError::Open(..)) => drop(fault.get_or_insert(format!("{e}: the CPU is used"))),
                Err(_) => {}
            }
        }
        Opened::cpu(fault)
    }

    fn named(api: Api) -> Result<Opened> {
        let gpu = diorama_kernels::gpu::Gpu::open(api).map_err(|e| PipelineError::Usage(e.to_string()))?;
        Ok(Opened::gpu(gpu))
    }

    fn gpu(gpu: diorama_kernels::gpu::Gpu) -> Opened {
        Opened { running: Some(Running::new(gpu)), note: None, halvings: 0 }
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
        (batch_samples(config, self.is_hardware()) >> self.halvings).max(64)
    }

    /// Rays per step.
    pub fn most_rays(&self) -> usize {
        if self.is_hardware() { MOST_RAYS * 8 } else { MOST_RAYS }
    }

    /// Most bytes of photographs.
    pub fn most_bytes(&self) -> u64 {
        self.running.as_ref().map_or(u64::MAX, |r| r.gpu().largest_buffer())
    }

    /// Brings the model and the photographs to the device.
    ///
    /// # Errors
    /// When they do not fit there.
    pub fn upload(&mut self, model: &ObjectModel, photographs: &Photographs, observations: &[Observation]) -> Result<()> {
        self.running.as_mut().map_or(Ok(()), |r| r.upload(model, photographs, observations))
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
    use diorama_data::pixel_store::PixelStore;
    use diorama_engine::losses::{ColorLoss, RELATIVE};
    use diorama_engine::on_gpu::{GpuStep, GpuTrainer, Placing, Trainees, TraineesMut};
    use diorama_engine::samplers::pixels::Observation;
    use diorama_geom::rng::Rng;
    use diorama_kernels::gpu::{Gpu, GpuError};
    use diorama_kernels::ops::field_step::gpu::loss;
    use diorama_kernels::ops::march::gpu::prune::Limits;
    use diorama_kernels::ops::pixel_gather::gpu::{Backdrop, GpuPhotographs};

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

        pub fn upload(&mut self, m: &ObjectModel, photographs: &Photographs, observations: &[Observation]) -> Result<()> {
            let store = photographs.store();
            // Of the smallest budgets even 1 of 64 × 64 pixels may be more.
            let bytes: u64 = (0..store.len()).map(|i| (store.kept(i) * store.format().bytes()) as u64).sum();
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
            let of = Trainees {
                field: &m.field,
                coarse: m.coarse.as_ref(),
                learned: m.learned.as_ref(),
                occupancy: m.occupancy.as_ref(),
                corrections: m.corrections.as_ref().map(|g| (g, m.config.camera.refine_focal)),
                error_map: m.error_map.as_ref(),
            };
            let mut images = resident(&self.gpu, store);
            images.observe(&self.gpu, &observations.iter().map(|o| (o.image, o.x, o.y, o.distance)).collect::<Vec<_>>());
            // What an earlier trainer has there makes room first.
            self.trainer = None;
            self.gpu.release();
            self.trainer = Some(GpuTrainer::new(self.gpu.clone(), &of, images, &m.base_cameras(), m.cube()));
            Ok(())
        }

        fn trainer(&mut self) -> &mut GpuTrainer {
            self.trainer.as_mut().expect("the model was uploaded")
        }

        pub fn step(&mut self, m: &mut ObjectModel, step: u64, d: &Drawing, room: usize) -> Result<StepFigures> {
            let (c, s) = (&m.config, &m.config.sampling);
            let placing = match (&m.occupancy, &m.coarse) {
                (Some(grid), _) => Placing::Occupancy {
                    march: grid.march_config(s.max_samples).stretched(d.stretch),
                    limits: Limits { stop: s.stop, min_alpha: s.min_alpha, thin: d.thin, min_weight: 0.0 },
                    room: (room * ROOM.0, room * ROOM.1),
                },
                (None, Some(_)) => Placing::Hierarchical { samples: s.samples, more: s.importance, coarse: d.coarse, fine: d.fine },
                (None, None) => Placing::Stratified { samples: s.samples, rng: d.coarse },
            };
            let o = GpuStep {
                rays: d.rays,
                first: m.origin.rays,
                pixels: d.pixels,
                backdrop: d.background.map_or(Backdrop::Color(m.backdrop_color()), Backdrop::Random),
                near: s.near,
                placing,
                terms: loss::Terms {
                    huber: if let ColorLoss::Huber(width) = d.terms.color { width } else { 0.0 },
                    relative: if m.is_linear() { RELATIVE } else { 0.0 },
                    distortion: d.terms.distortion,
                    normalized: m.field.is_unbounded(),
                    alpha: d.terms.alpha,
                    depth: d.terms.depth,
                },
                near_scaling: d.terms.near_scaling,
                t: step as u32 + 1,
                rate_scale: d.rate_scale,
                refresh_errors: d.refresh_errors,
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
            let to = TraineesMut {
                field: &mut m.field,
                coarse: m.coarse.as_mut(),
                learned: m.learned.as_mut(),
                occupancy: m.occupancy.as_mut(),
                corrections: m.corrections.as_mut(),
                error_map: m.error_map.as_mut(),
            };
            self.trainer().download(to).map_err(told)
        }
    }

    fn told(e: GpuError) -> PipelineError {
        match e {
            GpuError::Memory(..) => PipelineError::Memory(e.to_string()),
            e => PipelineError::Device(e.to_string()),
        }
    }

    /// The pixels that are kept, and which of them count.
    fn resident(gpu: &Gpu, store: &PixelStore) -> GpuPhotographs {
        let n = store.len();
        let sizes: Vec<(u32, u32)> = (0..n).map(|i| store.size(i)).collect();
        let keys: Vec<Rng> = (0..n).map(|i| store.kept_by(i)).collect();
        let pixels: Vec<u32> = (0..n).flat_map(|i| store.words(i)).collect();
        let mut mask = vec![u32::MAX; (0..n).map(|i| store.kept(i)).sum::<usize>().div_ceil(32)];
        let (mut all, mut first) = (true, 0);
        for i in 0..n {
            for (at, _) in store.counting(i).into_iter().flatten().enumerate().filter(|(_, counts)| !counts) {
                mask[(first + at) / 32] &= !(1 << ((first + at) % 32));
                all = false;
            }
            first += store.kept(i);
        }
        GpuPhotographs::upload(gpu, &sizes, store.stride(), &keys, (store.format(), &pixels), (!all).then_some(&mask[..]))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    #[cfg(feature = "gpu")]
    use diorama_engine::{
        fields::Pruning,
        renderers::{
            supervised::Unserved,
            volume::{Placement, Traced},
        },
        samplers::RayBatch,
    };

    #[cfg(feature = "gpu")]
    type TracedRays = (Traced, Option<Vec<f32>>);

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
    fn a_full_device_gets_half_the_batch_twice_and_then_the_bytes_are_said() {
        let full = || PipelineError::Memory("device X: out of memory: allocating 99 bytes".into());
        for device in ["auto", "vulkan"] {
            for halvings in [0, 1] {
                let a = aftermath(full(), device, halvings, "batch 9 MiB");
                assert!(matches!(&a, Aftermath::Halve(why) if why.contains("99 bytes") && why.contains("halved")), "{a:?}");
            }
        }
        let Aftermath::Fail(e) = aftermath(full(), "vulkan", 2, "batch 9 MiB") else { panic!("it goes on") };
        assert!(e.kind() == "memory" && !e.is_input(), "{e}");
        for part in ["99 bytes", "batch 9 MiB", "--downscale"] {
            assert!(e.to_string().contains(part), "{e}");
        }
        assert!(matches!(aftermath(full(), "auto", 2, "batch 9 MiB"), Aftermath::Cpu(why) if why.contains("batch 9 MiB")));
    }

    #[test]
    fn a_lost_device_is_the_end_only_where_it_was_named() {
        let lost = || PipelineError::Device("device X: gone".into());
        assert!(matches!(aftermath(lost(), "auto", 0, ""), Aftermath::Cpu(why) if why.contains("gone")));
        let Aftermath::Fail(e) = aftermath(lost(), "cuda", 0, "") else { panic!("it goes on") };
        assert!(e.kind() == "device" && e.to_string().contains("--resume"), "{e}");
    }

    #[cfg(feature = "gpu")]
    struct Unplugged;

    #[cfg(feature = "gpu")]
    impl Accelerator for Unplugged {
        fn trace(&self, _: &RayBatch, _: &Placement, _: Pruning, _: Option<u32>) -> std::result::Result<TracedRays, Unserved> {
            Err(Unserved::Failed("unplugged".into()))
        }
        fn density(&self, _: &[f32]) -> std::result::Result<Vec<f32>, Unserved> {
            Err(Unserved::Failed("unplugged".into()))
        }
        fn color(&self, _: &[f32], _: &[f32]) -> std::result::Result<Vec<f32>, Unserved> {
            Err(Unserved::Failed("unplugged".into()))
        }
        fn rays(&self) -> usize {
            1
        }
    }

    #[cfg(feature = "gpu")]
    #[test]
    fn a_device_that_was_asked_for_by_name_is_supervised_as_named() {
        use std::sync::{Arc, Mutex};
        for asked in ["auto", "vulkan", "cuda", "webgpu", "metal"] {
            let said = Arc::new(Mutex::new(Vec::new()));
            let to = said.clone();
            let say: Say = Box::new(move |text| to.lock().unwrap().push(text.to_string()));
            let device = supervised(Box::new(Unplugged), "fake".into(), asked, say);
            assert!(device.density(&[0.0; 3]).is_err());
            let is_named = asked != "auto";
            assert_eq!((device.fatal().is_some(), said.lock().unwrap().len()), (is_named, !is_named as usize), "{asked}");
        }
    }

    #[test]
    fn batches_are_larger_on_gpus_unless_given() {
        let mut c = Config::new(Method::Ngp, "x".into());
        assert_eq!((batch_samples(&c, false), batch_samples(&c, true)), (1 << 15, 1 << 18));
        c.set("sampling.batch_samples", "100").unwrap();
        assert_eq!((batch_samples(&c, false), batch_samples(&c, true)), (100, 100));
    }
}
