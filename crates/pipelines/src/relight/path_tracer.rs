//! Devices that trace the paths of pictures: a GPU, or the CPU.

use crate::error::{PipelineError, Result};
use crate::run::device::Device;
use diorama_engine::renderers::supervised::Say;
use diorama_kernels::ops::path_trace::{Film, Scene, Settings, View, cpu};

/// Name of the CPU.
const CPU: &str = "cpu";

/// Traces paths elsewhere than on the CPU.
pub trait PathDevice {
    /// Copies a scene, whose paths are traced from then on.
    ///
    /// # Errors
    /// When the device failed, or has no room for the scene.
    fn load(&mut self, scene: &Scene) -> Result<()>;

    /// Replaces the light by that of another scene.
    ///
    /// # Errors
    /// As [`PathDevice::load`].
    fn set_light(&mut self, scene: &Scene) -> Result<()>;

    /// Adds `samples` samples to each pixel of a film.
    ///
    /// # Errors
    /// When the device failed; then the film stays as it was.
    fn add(&mut self, view: &View, settings: &Settings, samples: u32, film: &mut Film) -> Result<()>;
}

/// The device that traces the paths of pictures. If a named device fails, the call returns the error; with `auto`, the failure is reported once
/// and the CPU continues.
pub struct PathTracer {
    device: Option<Box<dyn PathDevice>>,
    name: String,
    is_named: bool,
    say: Say,
}

impl PathTracer {
    /// The CPU.
    pub fn cpu() -> PathTracer {
        PathTracer { device: None, name: CPU.into(), is_named: true, say: Box::new(|_| {}) }
    }

    /// Finds a device by name; `auto` is the best GPU that is no software, else the CPU. `say` tells the user about the choice and failures.
    ///
    /// # Errors
    /// When a named GPU is not part of the build or absent.
    pub fn open(device: &str, say: Say) -> Result<PathTracer> {
        let opened = Device::open(device)?;
        opened.note().iter().for_each(|n| say(n));
        let tracer = PathTracer { is_named: device != "auto", say, ..PathTracer::cpu() };
        #[cfg(feature = "gpu")]
        if let Some(gpu) = opened.gpu() {
            let device = on_gpu::OnGpu { gpu: gpu.clone(), scene: None };
            return Ok(PathTracer { device: Some(Box::new(device)), name: opened.name(), ..tracer });
        }
        Ok(tracer)
    }

    /// The device in words.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Brings a scene to the device; the following calls of [`PathTracer::add`] must be given the same scene.
    ///
    /// # Errors
    /// When a device that was named failed.
    pub fn load(&mut self, scene: &Scene) -> Result<()> {
        self.call(|d| d.load(scene)).map(drop)
    }

    /// Brings the changed light of the loaded scene to the device.
    ///
    /// # Errors
    /// As [`PathTracer::load`].
    pub fn set_light(&mut self, scene: &Scene) -> Result<()> {
        self.call(|d| d.set_light(scene)).map(drop)
    }

    /// Adds `samples` samples to each pixel of a film of the scene that was loaded.
    ///
    /// # Errors
    /// As [`PathTracer::load`].
    pub fn add(&mut self, scene: &Scene, view: &View, settings: &Settings, samples: u32, film: &mut Film) -> Result<()> {
        if !self.call(|d| d.add(view, settings, samples, film))? {
            cpu::render(scene, view, settings, samples, film);
        }
        Ok(())
    }

    /// Whether the device did it.
    fn call(&mut self, work: impl FnOnce(&mut dyn PathDevice) -> Result<()>) -> Result<bool> {
        let Some(device) = &mut self.device else { return Ok(false) };
        match work(device.as_mut()) {
            Ok(()) => Ok(true),
            Err(PipelineError::Device(e)) if self.is_named => Err(PipelineError::Device(format!("{e}; use --device cpu"))),
            Err(PipelineError::Memory(e)) if self.is_named => Err(PipelineError::Memory(format!("{e}; use --device cpu"))),
            Err(PipelineError::Device(e) | PipelineError::Memory(e)) => {
                (self.say)(&format!("{e}; the CPU goes on"));
                (self.device, self.name) = (None, CPU.into());
                Ok(false)
            }
            Err(e) => Err(e),
        }
    }
}

#[cfg(feature = "gpu")]
mod on_gpu {
    use super::PathDevice;
    use crate::error::Result;
    use crate::run::device::to_pipeline_error;
    use diorama_kernels::gpu::Gpu;
    use diorama_kernels::ops::path_trace::gpu::{self, GpuScene};
    use diorama_kernels::ops::path_trace::{Film, Scene, Settings, View};

    /// A GPU and the scene that was loaded.
    pub struct OnGpu {
        pub gpu: Gpu,
        pub scene: Option<GpuScene>,
    }

    impl PathDevice for OnGpu {
        fn load(&mut self, scene: &Scene) -> Result<()> {
            // An earlier scene makes room first.
            self.scene = None;
            self.gpu.release();
            self.scene = Some(GpuScene::upload(&self.gpu, scene).map_err(to_pipeline_error)?);
            Ok(())
        }

        fn set_light(&mut self, scene: &Scene) -> Result<()> {
            let loaded = self.scene.as_mut().expect("a scene was loaded");
            loaded.set_light(&self.gpu, scene).map_err(to_pipeline_error)
        }

        fn add(&mut self, view: &View, settings: &Settings, samples: u32, film: &mut Film) -> Result<()> {
            let loaded = self.scene.as_ref().expect("a scene was loaded");
            gpu::render(&self.gpu, loaded, view, settings, samples, film).map_err(to_pipeline_error)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::relight::picture::{self, Job};
    use diorama_geom::daylight::Daylight;
    use diorama_geom::environment::Environment;
    use diorama_geom::glam::DVec3;
    use diorama_geom::{Camera, Model, Pose};
    use std::sync::atomic::AtomicBool;
    use std::sync::{Arc, Mutex};

    /// Adds samples of a light that is not there, so many times, then fails.
    struct Fails(usize);

    impl PathDevice for Fails {
        fn load(&mut self, _: &Scene) -> Result<()> {
            Ok(())
        }
        fn set_light(&mut self, _: &Scene) -> Result<()> {
            Ok(())
        }
        fn add(&mut self, _: &View, _: &Settings, samples: u32, film: &mut Film) -> Result<()> {
            self.0 = self.0.checked_sub(1).ok_or_else(|| PipelineError::Device("device fake: unplugged".into()))?;
            film.samples += samples;
            film.pixels.iter_mut().for_each(|p| p.color = [7.0; 3]);
            Ok(())
        }
    }

    /// Passes of a picture of a uniform light of 1, and what was said.
    fn picture(is_named: bool, passes: u32) -> (Result<Film>, Vec<String>) {
        let scene = Scene::new(&Model::default(), &Daylight::of(Environment::uniform([1.0; 3], 8)));
        let view =
            View { camera: Camera::pinhole(4, 4, 0.6), world_from_camera: Pose::look_at(DVec3::X, DVec3::ZERO, DVec3::Z), lens: None };
        let said = Arc::new(Mutex::new(Vec::new()));
        let to = said.clone();
        let say: Say = Box::new(move |text| to.lock().unwrap().push(text.to_string()));
        let mut tracer = PathTracer { device: Some(Box::new(Fails(1))), name: "fake".into(), is_named, say };
        let mut film = Film::new(&view.camera);
        let passes = (0..passes).try_for_each(|_| tracer.add(&scene, &view, &Settings::default(), 1, &mut film));
        let said = said.lock().unwrap().clone();
        (passes.map(|()| film), said)
    }

    #[test]
    fn the_failure_of_a_named_device_is_the_result() {
        assert_eq!(picture(true, 1).0.unwrap().pixels[0].color, [7.0; 3], "the device draws while it can");
        let (film, said) = picture(true, 3);
        assert!(matches!(film, Err(PipelineError::Device(e)) if e.contains("unplugged") && e.contains("--device cpu")));
        assert!(said.is_empty(), "the error itself says it");
    }

    #[test]
    fn passes_before_a_failure_are_kept() {
        let dir = tempfile::tempdir().unwrap();
        let scene = Scene::new(&Model::default(), &Daylight::of(Environment::uniform([1.0; 3], 8)));
        let job = Job {
            scene: &scene,
            view: View {
                camera: Camera::pinhole(4, 4, 0.6),
                world_from_camera: Pose::look_at(DVec3::X, DVec3::ZERO, DVec3::Z),
                lens: None,
            },
            settings: Settings::default(),
            samples: 64,
            kept: Some(dir.path().join("a.png.unfinished")),
            key: "a".into(),
        };
        let mut fails = PathTracer { device: Some(Box::new(Fails(2))), ..PathTracer::cpu() };
        let draw = |tracer: &mut PathTracer| picture::render(&job, tracer, &AtomicBool::new(false), &mut |_| {});
        assert!(draw(&mut fails).is_err());
        let (film, _) = draw(&mut PathTracer::cpu()).unwrap();
        // Two of four passes of 7, two of 1.
        assert!(film.samples == 64 && film.pixels.iter().all(|p| (p.color[0] - 4.0).abs() < 1e-4), "{:?}", film.pixels[0]);
    }

    #[test]
    fn without_a_named_device_the_cpu_goes_on_and_it_is_said_once() {
        let (film, said) = picture(false, 4);
        let film = film.unwrap();
        // One pass of 7 and three of 1.
        assert!(film.samples == 4 && film.pixels.iter().all(|p| (p.color[0] - 2.5).abs() < 1e-5), "{:?}", film.pixels[0]);
        assert_eq!(said, ["device fake: unplugged; the CPU goes on"]);
    }
}
