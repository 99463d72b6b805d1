//! An exponential moving average of a network's weights, which is often better than the weights themselves.

use super::StateError;
use crate::param::{self, Kind, Module};
use diorama_geom::NamedArray;
use rayon::prelude::*;

/// Numbers per task; elements are independent.
const CHUNK: usize = 1 << 14;

/// The average and how fast it forgets.
#[derive(Clone, Debug)]
pub struct Ema {
    decay: f32,
    averages: Vec<NamedArray>,
    updates: u64,
}

impl Ema {
    /// An average that begins at the network's present weights and statistics.
    pub fn new(module: &dyn Module, decay: f32) -> Ema {
        Ema { decay, averages: param::arrays(module), updates: 0 }
    }

    /// Moves the average towards the network; statistics are taken over as they are. Early updates forget faster, by
    /// `(1 + n) / (10 + n)` where that is less than the decay.
    pub fn update(&mut self, module: &dyn Module) {
        let keep = self.decay.min((1 + self.updates) as f32 / (10 + self.updates) as f32);
        self.updates += 1;
        let mut averages = self.averages.iter_mut();
        param::visit(module, &mut |_, p| {
            let average = averages.next().expect("one for each parameter");
            let keep = if p.kind() == Kind::Weight { keep } else { 0.0 };
            p.read(|now| {
                average.values.par_chunks_mut(CHUNK).zip(now.par_chunks(CHUNK)).for_each(|(a, n)| {
                    a.iter_mut().zip(n).for_each(|(a, n)| *a = keep * *a + (1.0 - keep) * n);
                });
            });
        });
    }

    /// Exchanges the network's numbers and the average: once to use the average, once more to go on training.
    pub fn swap(&mut self, module: &dyn Module) {
        let mut averages = self.averages.iter_mut();
        param::visit(module, &mut |_, p| {
            let average = averages.next().expect("one for each parameter");
            p.write(|now| now.swap_with_slice(&mut average.values));
        });
    }

    /// The average by name.
    pub fn arrays(&self) -> &[NamedArray] {
        &self.averages
    }

    /// What a later run needs to go on.
    pub fn state(&self) -> Vec<NamedArray> {
        let count = [(self.updates & 0xff_ffff) as f32, (self.updates >> 24) as f32];
        let named = self.averages.iter().map(|a| NamedArray { name: format!("ema.{}", a.name), ..a.clone() });
        named.chain([NamedArray::new("ema_updates", &[2], count.to_vec())]).collect()
    }

    /// Takes a saved state over.
    ///
    /// # Errors
    /// When an array is missing or has another length; nothing is changed then.
    pub fn restore(&mut self, arrays: &[NamedArray]) -> Result<(), StateError> {
        let count = StateError::find(arrays, "ema_updates", 2)?;
        let found: Result<Vec<_>, _> =
            self.averages.iter().map(|a| StateError::find(arrays, &format!("ema.{}", a.name), a.values.len())).collect();
        self.averages.iter_mut().zip(found?).for_each(|(a, f)| a.values.copy_from_slice(f));
        self.updates = count[0] as u64 | (count[1] as u64) << 24;
        Ok(())
    }
}
