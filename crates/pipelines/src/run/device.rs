//! Device of a run: carries out its steps on the CPU, or on a GPU that keeps all of its state.

use super::photographs::StoredPhotographs;
use crate::error::{PipelineError, Result};
use diorama_engine::samplers::pixels::Observation;
use diorama_engine::stages::Stages;
use diorama_engine::step::{CpuTrainer, Figures, Photographs, Scene, Step, Trainees};
use diorama_kernels::device::Api;
#[cfg(feature = "gpu")]
use diorama_kernels::gpu::{Gpu, GpuError};
#[cfg(feature = "gpu")]
use running::Running;
#[cfg(feature = "gpu")]
pub(crate) use running::to_pipeline_error;

/// The device of a run.
pub struct Device {
    #[cfg(feature = "gpu")]
    gpu: Option<Running>,
    cpu: Option<CpuTrainer>,
    note: Option<String>,
    /// Number of times that batches were halved because memory was short.
    halvings: u32,
}

/// Result of a step.
#[derive(Clone, Copy, Debug, Default)]
pub struct Done {
    /// Means and counts of the last steps that are known.
    pub shown: Figures,
    /// Of steps that were not counted before.
    pub counted: Option<Figures>,
}

/// Most such halvings.
const HALVINGS: u32 = 2;

/// Most rays per step on a CPU; GPUs take eight times as many, as they take samples.
const MOST_RAYS: usize = 1 << 14;

/// Reaction to the failure of a device in training.
#[derive(Debug)]
pub enum Aftermath {
    /// The step is tried again with half the batch; why, in words.
    Halve(String),
    /// The CPU goes on; why, in words.
    Cpu(String),
    Fail(PipelineError),
}

/// A device that the user named fails for good, and with `auto` the CPU goes on; but where memory is short, the batch is
/// halved first, twice. `needs`: bytes of what training takes, in words.
pub fn aftermath(e: PipelineError, device: &str, halvings: u32, needs: &str) -> Aftermath {
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

/// The CPU in words.
pub fn cpu_name() -> String {
    format!("cpu ({}, {} threads)", diorama_kernels::simd::level().name(), rayon::current_num_threads())
}

impl Device {
    /// Finds a device by name; `auto` is the best GPU that is no software, else the CPU.
    ///
    /// # Errors
    /// When a named GPU is not part of the build or absent.
    pub fn open(name: &str) -> Result<Device> {
        match name {
            "cpu" => Ok(Device::cpu(None)),
            "auto" => Ok(Device::best()),
            name => {
                let api: Api = name.parse().map_err(PipelineError::Usage)?;
                if !api.is_built() {
                    return Err(PipelineError::Usage(api.not_built()));
                }
                Device::named(api)
            }
        }
    }

    pub fn cpu(note: Option<String>) -> Device {
        Device {
            #[cfg(feature = "gpu")]
            gpu: None,
            cpu: None,
            note,
            halvings: 0,
        }
    }

    /// Number of times that batches were halved because memory was short.
    pub fn halvings(&self) -> u32 {
        self.halvings
    }

    /// Halves batches from now on.
    pub fn halve(&mut self) {
        self.halvings += 1;
    }

    /// Message for the user about the choice of device.
    pub fn note(&self) -> Option<String> {
        self.note.clone()
    }

    /// Time that each stage of steps on the CPU took.
    pub fn stages(&mut self) -> Option<&mut Stages> {
        self.cpu.as_mut().map(CpuTrainer::stages)
    }

    /// Most rays per step.
    pub fn most_rays(&self) -> usize {
        if self.is_hardware() { MOST_RAYS * 8 } else { MOST_RAYS }
    }

    /// Samples per step: `wanted`, or what is left of them where memory is short.
    pub fn batch_samples(&self, wanted: usize) -> usize {
        (wanted >> self.halvings).max(64)
    }

    /// A step on the CPU.
    fn step_on_cpu(&mut self, of: &mut Trainees, photographs: Option<&Photographs>, step: &Step) -> Done {
        let figures = self.cpu.as_mut().expect("the run has begun").step(of, photographs, step);
        Done { shown: figures, counted: Some(figures) }
    }
}

impl Device {
    fn given_gradients_on_cpu(&self) -> Vec<Vec<f32>> {
        self.cpu.as_ref().map_or_else(Vec::new, |c| c.given_gradients().to_vec())
    }
}

/// Photographs for the CPU and for a GPU.
#[derive(Clone, Copy)]
pub struct Pictures<'a> {
    pub photographs: &'a StoredPhotographs,
    /// Pixels of known distance.
    pub observations: &'a [Observation],
}

impl<'a> Pictures<'a> {
    fn on_cpu(&self) -> Photographs<'a> {
        Photographs { pixels: self.photographs, observations: self.observations }
    }
}

#[cfg(not(feature = "gpu"))]
impl Device {
    fn best() -> Device {
        Device::cpu(None)
    }

    fn named(api: Api) -> Result<Device> {
        Err(PipelineError::Usage(api.not_built()))
    }

    pub fn is_gpu(&self) -> bool {
        false
    }

    /// Whether a GPU computes that the CPU does not play.
    pub fn is_hardware(&self) -> bool {
        false
    }

    pub fn name(&self) -> String {
        "cpu".into()
    }

    /// Most bytes of photographs.
    pub fn most_bytes(&self) -> u64 {
        u64::MAX
    }

    /// Gets ready to train.
    ///
    /// # Errors
    /// None in this build.
    pub fn begin(&mut self, of: &Trainees, scene: Scene, _: Option<Pictures>) -> Result<()> {
        self.cpu = Some(CpuTrainer::new(scene, of));
        Ok(())
    }

    /// One step.
    ///
    /// # Errors
    /// None in this build.
    pub fn step(&mut self, of: &mut Trainees, pictures: Option<Pictures>, step: &Step, _: u64) -> Result<Done> {
        Ok(self.step_on_cpu(of, pictures.map(|p| p.on_cpu()).as_ref(), step))
    }

    /// Results of steps that were not counted yet.
    ///
    /// # Errors
    /// None in this build.
    pub fn count(&mut self) -> Result<Option<Figures>> {
        Ok(None)
    }

    /// Gradients of the last step's given codes, `[R, width]` each.
    ///
    /// # Errors
    /// None in this build.
    pub fn given_gradients(&self) -> Result<Vec<Vec<f32>>> {
        Ok(self.given_gradients_on_cpu())
    }

    /// Brings what is trained back.
    ///
    /// # Errors
    /// None in this build.
    pub fn download(&mut self, _: &mut Trainees) -> Result<()> {
        Ok(())
    }
}

#[cfg(feature = "gpu")]
impl Device {
    fn best() -> Device {
        let mut fault = None;
        for api in Api::ALL.into_iter().filter(|a| a.is_built()) {
            match Gpu::open_hardware(api) {
                Ok(gpu) => return Device { gpu: Some(Running::new(gpu)), ..Device::cpu(None) },
                // A device that is there and does not open is worth a word.
                Err(e @ GpuError::Open(..)) => drop(fault.get_or_insert(format!("{e}: the CPU is used"))),
                Err(_) => {}
            }
        }
        Device::cpu(fault)
    }

    fn named(api: Api) -> Result<Device> {
        let gpu = Gpu::open(api).map_err(|e| PipelineError::Usage(e.to_string()))?;
        Ok(Device { gpu: Some(Running::new(gpu)), ..Device::cpu(None) })
    }

    pub fn is_gpu(&self) -> bool {
        self.gpu.is_some()
    }

    /// The GPU, where there is one.
    pub fn gpu(&self) -> Option<&Gpu> {
        self.gpu.as_ref().map(Running::gpu)
    }

    pub fn name(&self) -> String {
        self.gpu.as_ref().map_or("cpu".into(), Running::name)
    }

    /// Whether a GPU computes that the CPU does not play.
    pub fn is_hardware(&self) -> bool {
        self.gpu().is_some_and(|g| !g.software)
    }

    /// Most bytes of photographs.
    pub fn most_bytes(&self) -> u64 {
        self.gpu().map_or(u64::MAX, Gpu::largest_buffer)
    }

    /// Gets ready to train: brings the model and the photographs to the device.
    ///
    /// # Errors
    /// When they do not fit there.
    pub fn begin(&mut self, of: &Trainees, scene: Scene, pictures: Option<Pictures>) -> Result<()> {
        match &mut self.gpu {
            Some(gpu) => return gpu.begin(of, scene, pictures),
            None => self.cpu = Some(CpuTrainer::new(scene, of)),
        }
        Ok(())
    }

    /// One step; a GPU is asked how steps went each time `ask_every` are done, else what is shown is what was known then.
    ///
    /// # Errors
    /// When the device was lost or is full.
    pub fn step(&mut self, of: &mut Trainees, pictures: Option<Pictures>, step: &Step, ask_every: u64) -> Result<Done> {
        match &mut self.gpu {
            Some(gpu) => gpu.step(step, ask_every),
            None => Ok(self.step_on_cpu(of, pictures.map(|p| p.on_cpu()).as_ref(), step)),
        }
    }

    /// Waits for a GPU; results of its steps that were not counted yet.
    ///
    /// # Errors
    /// When the device was lost or is full.
    pub fn count(&mut self) -> Result<Option<Figures>> {
        self.gpu.as_mut().map_or(Ok(None), Running::count)
    }

    /// Gradients of the last step's given codes, `[R, width]` each.
    ///
    /// # Errors
    /// When the device was lost.
    pub fn given_gradients(&self) -> Result<Vec<Vec<f32>>> {
        self.gpu.as_ref().map_or_else(|| Ok(self.given_gradients_on_cpu()), Running::given_gradients)
    }

    /// Brings what is trained back.
    ///
    /// # Errors
    /// When the device was lost.
    pub fn download(&mut self, to: &mut Trainees) -> Result<()> {
        self.gpu.as_mut().map_or(Ok(()), |r| r.download(to))
    }
}

#[cfg(feature = "gpu")]
mod running {
    use super::{Done, Pictures};
    use crate::error::{PipelineError, Result};
    use crate::run::photographs::resident;
    use diorama_engine::on_gpu::GpuTrainer;
    use diorama_engine::step::{Figures, Scene, Step, Trainees};
    use diorama_kernels::gpu::{Gpu, GpuError};

    /// A GPU, and what is in training there.
    pub struct Running {
        gpu: Gpu,
        trainer: Option<GpuTrainer>,
        /// Figures of the last time that the device was asked.
        last: Option<Figures>,
        /// Whether there were steps since.
        is_behind: bool,
    }

    impl Running {
        pub fn new(gpu: Gpu) -> Running {
            Running { gpu, trainer: None, last: None, is_behind: false }
        }

        pub fn gpu(&self) -> &Gpu {
            &self.gpu
        }

        /// Name of the device and of the interface that reaches it.
        pub fn name(&self) -> String {
            format!("{} ({})", self.gpu.name, self.gpu.api.name())
        }

        pub fn begin(&mut self, of: &Trainees, scene: Scene, pictures: Option<Pictures>) -> Result<()> {
            if of.composites_normals() {
                return Err(PipelineError::Usage(format!("{} composites no normals of a field; use --device cpu", self.gpu.name)));
            }
            if let Some(store) = pictures.map(|p| p.photographs.store()) {
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
            }
            // What was known of steps before belongs to parameters that are gone.
            (self.last, self.is_behind) = (None, false);
            // What an earlier trainer has there makes room first.
            self.trainer = None;
            self.gpu.release();
            let images = pictures.map(|p| resident(&self.gpu, p.photographs.store(), p.observations));
            self.trainer = Some(GpuTrainer::new(self.gpu.clone(), scene, of, images));
            Ok(())
        }

        fn trainer(&mut self) -> &mut GpuTrainer {
            self.trainer.as_mut().expect("the run has begun")
        }

        pub fn step(&mut self, step: &Step, ask_every: u64) -> Result<Done> {
            self.trainer().step(step).map_err(to_pipeline_error)?;
            self.is_behind = true;
            let is_asked = self.last.is_none() || (step.number + 1).is_multiple_of(ask_every);
            let counted = if is_asked { self.count()? } else { None };
            Ok(Done { shown: self.last.unwrap_or_default(), counted })
        }

        pub fn count(&mut self) -> Result<Option<Figures>> {
            if !std::mem::take(&mut self.is_behind) {
                return Ok(None);
            }
            self.last = Some(self.trainer().figures().map_err(to_pipeline_error)?);
            Ok(self.last)
        }

        pub fn given_gradients(&self) -> Result<Vec<Vec<f32>>> {
            self.trainer.as_ref().expect("the run has begun").given_gradients().map_err(to_pipeline_error)
        }

        pub fn download(&mut self, to: &mut Trainees) -> Result<()> {
            self.trainer().download(to).map_err(to_pipeline_error)
        }
    }

    pub fn to_pipeline_error(e: GpuError) -> PipelineError {
        match e {
            GpuError::Memory(..) => PipelineError::Memory(e.to_string()),
            e => PipelineError::Device(e.to_string()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_device_outside_of_the_build_is_named_with_its_cure() {
        for api in Api::ALL.into_iter().filter(|a| !a.is_built()) {
            let Err(PipelineError::Usage(text)) = Device::open(api.name()) else { panic!("{} opened", api.name()) };
            assert!(text.contains(api.name()) && !text.contains('\n'), "{text}");
        }
        let cpu = Device::open("cpu").unwrap_or_else(|e| panic!("{e}"));
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
}
