//! Use of the device by the object application: samples per step, and rendering.

use super::config::{Config, Method};
use super::model::ObjectModel;
use crate::error::Result;
use crate::run::device::{Device, cpu_name};
use diorama_engine::renderers::supervised::Say;
#[cfg(feature = "gpu")]
use diorama_engine::renderers::supervised::Supervised;
#[cfg(feature = "gpu")]
use diorama_engine::renderers::volume::Accelerator;

/// Lets the named device evaluate a model's field; which that is, in words. `auto` is the best GPU that is no software,
/// else the CPU, which goes on where that GPU fails: `say` is then called once. The failure of a device that was named is
/// [`ObjectModel::check_device`]'s.
///
/// # Errors
/// When a named GPU is not part of the build or absent.
pub fn accelerate(model: &mut ObjectModel, device: &str, say: Say) -> Result<String> {
    let mut c = Config::new(model.config.method, model.config.data.path.clone());
    c.set("device", device)?;
    let opened = Device::open(device)?;
    opened.note().iter().for_each(|n| say(n));
    #[cfg(feature = "gpu")]
    if let Some(gpu) = opened.gpu() {
        let (field, coarse, occupancy) = (&model.field, model.coarse.as_ref(), model.occupancy.as_ref());
        let tracer = diorama_engine::on_gpu::GpuTracer::new(gpu.clone(), field, coarse, occupancy);
        model.accelerator = Some(supervised(Box::new(tracer), opened.name(), device, say));
        return Ok(opened.name());
    }
    Ok(cpu_name())
}

/// An opened device as the one that was `asked` for by `--device`: any name but `auto` makes its failure the result.
#[cfg(feature = "gpu")]
fn supervised(device: Box<dyn Accelerator>, name: String, asked: &str, say: Say) -> Supervised {
    Supervised::new(device, name, asked != "auto", say)
}

/// Samples per step; fewer through networks whose layers' outputs all lie in memory.
pub(super) fn batch_samples(config: &Config, is_gpu: bool) -> usize {
    match config.sampling.batch_samples {
        0 if is_gpu && config.method == Method::Ngp => 1 << 18,
        0 if is_gpu => 1 << 17,
        0 => 1 << 15,
        n => n,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    #[cfg(feature = "gpu")]
    use diorama_engine::{
        renderers::{supervised::Unserved, volume::Traced},
        samplers::{RayBatch, placement::Placement},
    };

    #[cfg(feature = "gpu")]
    type TracedRays = (Traced, Option<Vec<f32>>);

    #[cfg(feature = "gpu")]
    struct Unplugged;

    #[cfg(feature = "gpu")]
    impl Accelerator for Unplugged {
        fn trace(&self, _: &RayBatch, _: &Placement, _: Option<u32>) -> std::result::Result<TracedRays, Unserved> {
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
