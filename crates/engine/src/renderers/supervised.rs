//! Handling of a device's failures: each is reported once, and never hidden behind results of the CPU.

pub use super::accelerator::Unserved;

use super::accelerator::Accelerator;
use super::traced::Traced;
use crate::samplers::RayBatch;
use crate::samplers::placement::Placement;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};

/// Says a failure to the user.
pub type Say = Box<dyn Fn(&str) + Send + Sync>;

/// An accelerator that is given up at its first failure. With a device that the user named the failure is the result
/// ([`Supervised::failure`]); else it is said once and the CPU goes on.
pub struct Supervised {
    device: Box<dyn Accelerator>,
    name: String,
    named: bool,
    say: Say,
    failure: Mutex<Option<String>>,
    served: AtomicUsize,
}

impl Supervised {
    /// `named`: the user asked for this device; `say` is called once, when the CPU takes over.
    pub fn new(device: Box<dyn Accelerator>, name: impl Into<String>, named: bool, say: Say) -> Self {
        Supervised { device, name: name.into(), named, say, failure: Mutex::new(None), served: AtomicUsize::new(0) }
    }

    /// What the device calls itself.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Calls that the device served.
    pub fn served(&self) -> usize {
        self.served.load(Ordering::Relaxed)
    }

    /// Why the device was given up.
    pub fn failure(&self) -> Option<String> {
        self.failure.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// The failure of a device that the user named: whatever was computed since does not count.
    pub fn fatal(&self) -> Option<String> {
        self.failure().filter(|_| self.named)
    }

    fn call<T>(&self, f: impl FnOnce(&dyn Accelerator) -> Result<T, Unserved>) -> Result<T, Unserved> {
        if let Some(why) = self.failure() {
            return Err(if self.named { Unserved::Abandoned } else { Unserved::Failed(why) });
        }
        let why = match f(&*self.device) {
            Ok(served) => {
                self.served.fetch_add(1, Ordering::Relaxed);
                return Ok(served);
            }
            Err(e) => e.to_string(),
        };
        let mut kept = self.failure.lock().unwrap_or_else(PoisonError::into_inner);
        // Threads that failed together say it once.
        if kept.is_none() {
            if !self.named {
                (self.say)(&format!("{why}; the CPU goes on"));
            }
            *kept = Some(why.clone());
        }
        if self.named { Err(Unserved::Abandoned) } else { Err(Unserved::Failed(why)) }
    }
}

impl Accelerator for Supervised {
    fn trace(&self, batch: &RayBatch, placement: &Placement, appearance: Option<u32>) -> Result<(Traced, Option<Vec<f32>>), Unserved> {
        self.call(|d| d.trace(batch, placement, appearance))
    }

    fn density(&self, model: &[f32]) -> Result<Vec<f32>, Unserved> {
        self.call(|d| d.density(model))
    }

    fn color(&self, model: &[f32], dirs: &[f32]) -> Result<Vec<f32>, Unserved> {
        self.call(|d| d.color(model, dirs))
    }

    fn rays(&self) -> usize {
        self.device.rays()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fields::{self, FieldBuffers};
    use crate::renderers::volume::Tracer;
    use diorama_geom::contraction::Space;
    use std::sync::Arc;

    /// Serves so many calls with what no CPU would compute, then fails.
    struct Fails(AtomicUsize);

    impl Fails {
        fn after(calls: usize) -> Box<Fails> {
            Box::new(Fails(AtomicUsize::new(calls)))
        }

        fn serves(&self) -> Result<(), Unserved> {
            let left = self.0.load(Ordering::Relaxed);
            self.0.store(left.saturating_sub(1), Ordering::Relaxed);
            if left > 0 { Ok(()) } else { Err(Unserved::Failed("device fake: unplugged".into())) }
        }
    }

    impl Accelerator for Fails {
        fn trace(&self, batch: &RayBatch, _: &Placement, _: Option<u32>) -> Result<(Traced, Option<Vec<f32>>), Unserved> {
            self.serves()?;
            let n = batch.len();
            Ok((Traced { rgb: vec![7.0; n * 3], opacity: vec![1.0; n], depth: vec![1.0; n] }, None))
        }
        fn density(&self, model: &[f32]) -> Result<Vec<f32>, Unserved> {
            self.serves().map(|()| vec![7.0; model.len() / 3])
        }
        fn color(&self, model: &[f32], _: &[f32]) -> Result<Vec<f32>, Unserved> {
            self.serves().map(|()| vec![7.0; model.len()])
        }
        fn rays(&self) -> usize {
            4
        }
    }

    fn traced(by: Option<&dyn Accelerator>) -> Traced {
        let field = fields::baseline(Space::Cube(1.0), 1e-3, 3);
        let placement = Placement::Stratified { samples: 8, noise: None };
        let tracer = Tracer { accelerator: by, ..Tracer::new(&field, placement, (0.0, 1.0)) };
        let mut batch = RayBatch::default();
        batch.resize(4);
        batch.origins.fill(0.5);
        batch.dirs.chunks_exact_mut(3).for_each(|d| d[0] = 1.0);
        batch.near_far.chunks_exact_mut(2).for_each(|n| n[1] = 0.5);
        tracer.trace(&mut batch, &mut FieldBuffers::default())
    }

    fn supervised(calls: usize, named: bool) -> (Supervised, Arc<Mutex<Vec<String>>>) {
        let said = Arc::new(Mutex::new(Vec::new()));
        let to = said.clone();
        let say: Say = Box::new(move |text| to.lock().unwrap().push(text.to_string()));
        (Supervised::new(Fails::after(calls), "fake", named, say), said)
    }

    #[test]
    fn without_a_named_device_the_cpu_goes_on_and_it_is_said_once() {
        let (device, said) = supervised(1, false);
        assert_eq!(traced(Some(&device)).rgb[0], 7.0, "the device draws while it can");
        for _ in 0..3 {
            assert_eq!(traced(Some(&device)).rgb, traced(None).rgb);
        }
        assert_eq!(*said.lock().unwrap(), ["device fake: unplugged; the CPU goes on"]);
        assert_eq!((device.served(), device.fatal()), (1, None));
        assert!(device.failure().is_some());
    }

    #[test]
    fn the_failure_of_a_named_device_is_the_result() {
        let (device, said) = supervised(0, true);
        // Nobody draws in its place: what comes back is empty.
        assert!(traced(Some(&device)).opacity.iter().all(|o| *o == 0.0));
        assert_ne!(traced(None).opacity[0], 0.0);
        assert_eq!(device.density(&[0.0; 3]), Err(Unserved::Abandoned));
        assert_eq!((device.served(), device.fatal().as_deref()), (0, Some("device fake: unplugged")));
        assert!(said.lock().unwrap().is_empty(), "the error itself says it");
    }
}
