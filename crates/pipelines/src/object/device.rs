//! Where a run trains: on the CPU, or on a GPU that keeps all of its state.

use super::config::{Config, Method};
use super::model::ObjectModel;
use super::recipe::Photographs;
use crate::error::{PipelineError, Result};
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
/// else the CPU.
///
/// # Errors
/// When a named GPU is not part of the build or absent.
pub fn accelerate(model: &mut ObjectModel, device: &str) -> Result<String> {
    let mut c = Config::new(model.config.method, model.config.data.path.clone());
    c.set("device", device)?;
    let opened = open(&c)?;
    #[cfg(not(feature = "gpu"))]
    drop(opened);
    #[cfg(feature = "gpu")]
    if let Some(r) = opened.running {
        let (field, coarse, occupancy) = (&model.field, model.coarse.as_ref(), model.occupancy.as_ref());
        model.accelerator = Some(Box::new(diorama_engine::on_gpu::GpuTracer::new(r.gpu().clone(), field, coarse, occupancy)));
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

    pub fn upload(&mut self, _: &ObjectModel, _: &Photographs) -> Result<()> {
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
fn batch_samples(config: &Config, is_gpu: bool) -> usize {
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
        use diorama_kernels::gpu::Gpu;
        let found = Api::ALL.into_iter().filter(|a| a.is_built()).find_map(|a| Gpu::open_hardware(a).ok());
        found.map_or(Opened::cpu(None), Opened::gpu)
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

    /// Most bytes of photographs.
    pub fn most_bytes(&self) -> u64 {
        self.running.as_ref().map_or(u64::MAX, |r| r.gpu().largest_buffer())
    }

    /// Brings the model and the photographs to the device.
    ///
    /// # Errors
    /// When they do not fit there.
    pub fn upload(&mut self, model: &ObjectModel, photographs: &Photographs) -> Result<()> {
        self.running.as_mut().map_or(Ok(()), |r| r.upload(model, photographs))
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
    use diorama_engine::losses::RELATIVE;
    use diorama_engine::on_gpu::{GpuStep, GpuTrainer, Placing, Trainees, TraineesMut};
    use diorama_geom::rng::Rng;
    use diorama_kernels::gpu::{Gpu, GpuError};
    use diorama_kernels::ops::march::gpu::prune::Limits;
    use diorama_kernels::ops::ngp_field::gpu::loss::Terms;
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

        pub fn upload(&mut self, m: &ObjectModel, photographs: &Photographs) -> Result<()> {
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
            let images = resident(&self.gpu, store);
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
                terms: Terms {
                    huber: if c.loss.color == "huber" { 0.1 } else { 0.0 },
                    relative: if m.is_linear() { RELATIVE } else { 0.0 },
                    distortion: c.loss.distortion,
                    alpha: c.loss.alpha,
                },
                near_scaling: c.loss.near_scaling,
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
        PipelineError::Device(e.to_string())
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
