//! Optimizers that step a network's weights in place, with rates, decay and freezing by groups of names.

use super::gradients::{Gradient, Gradients};
use super::on_device::{self, DeviceMoments};
use crate::bridge::pool;
use crate::param::{self, Kind, Module};
use diorama_geom::NamedArray;
use diorama_kernels::ops::weight_step::{self, cpu};

pub use diorama_kernels::ops::weight_step::Rule;

/// Weights that share a rate. The first group whose name test admits a weight has it.
pub struct Group {
    chosen: Box<dyn Fn(&str) -> bool + Send + Sync>,
    /// Factor of the optimizer's rate.
    pub rate_scale: f32,
    /// Instead of the optimizer's weight decay.
    pub weight_decay: Option<f32>,
    /// A frozen group is not stepped, and its gradient is not computed.
    pub frozen: bool,
}

impl Group {
    pub fn of(chosen: impl Fn(&str) -> bool + Send + Sync + 'static) -> Group {
        Group { chosen: Box::new(chosen), rate_scale: 1.0, weight_decay: None, frozen: false }
    }

    pub fn rate_scale(self, rate_scale: f32) -> Group {
        Group { rate_scale, ..self }
    }

    pub fn weight_decay(self, weight_decay: f32) -> Group {
        Group { weight_decay: Some(weight_decay), ..self }
    }

    pub fn frozen(self) -> Group {
        Group { frozen: true, ..self }
    }
}

/// Why a saved state does not fit.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("the saved state of the training does not fit the network: {0}")]
pub struct StateError(String);

impl StateError {
    /// The numbers of an array, where it is there and has as many.
    pub(super) fn find<'a>(arrays: &'a [NamedArray], name: &str, len: usize) -> Result<&'a [f32], StateError> {
        match arrays.iter().find(|a| a.name == name) {
            None => Err(StateError(format!("{name} is missing"))),
            Some(a) if a.values.len() != len => Err(StateError(format!("{name} has {} numbers, expected {len}", a.values.len()))),
            Some(a) => Ok(&a.values),
        }
    }
}

/// Moments of one weight.
#[derive(Debug, Default)]
struct Moments {
    name: String,
    first: Vec<f32>,
    second: Vec<f32>,
    /// Instead of these where the weight is on a GPU.
    device: DeviceMoments,
    rate_scale: f32,
    weight_decay: f32,
    stepped: bool,
    len: usize,
}

/// An optimizer and its state for one network.
pub struct Optimizer {
    rule: Rule,
    rate: f32,
    weight_decay: f32,
    slots: Vec<Moments>,
    steps: u64,
}

impl Optimizer {
    /// An optimizer of a network's weights: weights of frozen groups are frozen in the network, those of others are not touched by
    /// this.
    pub fn new(module: &dyn Module, rule: Rule, rate: f32, weight_decay: f32, groups: &[Group]) -> Optimizer {
        let mut slots = Vec::new();
        param::visit(module, &mut |name, p| {
            let group = groups.iter().find(|g| (g.chosen)(name));
            if group.is_some_and(|g| g.frozen) {
                p.set_frozen(true);
            }
            let stepped = p.kind() == Kind::Weight && !group.is_some_and(|g| g.frozen);
            let zeros = |wanted: bool| if stepped && wanted && p.is_on_cpu() { vec![0.0; p.len()] } else { Vec::new() };
            slots.push(Moments {
                name: name.to_string(),
                first: zeros(rule.moments() >= 1),
                second: zeros(rule.moments() >= 2),
                device: DeviceMoments::default(),
                len: p.len(),
                rate_scale: group.map_or(1.0, |g| g.rate_scale),
                weight_decay: group.and_then(|g| g.weight_decay).unwrap_or(weight_decay),
                stepped,
            });
        });
        Optimizer { rule, rate, weight_decay, slots, steps: 0 }
    }

    /// How many steps were taken.
    pub fn steps(&self) -> u64 {
        self.steps
    }

    pub fn rate(&self) -> f32 {
        self.rate
    }

    pub fn weight_decay(&self) -> f32 {
        self.weight_decay
    }

    /// Steps every weight that has a gradient, with the rate times `rate_scale`, and ends the memory pool's step.
    ///
    /// # Panics
    /// When the gradients are another network's.
    pub fn step(&mut self, module: &dyn Module, gradients: Gradients, rate_scale: f32) {
        assert_eq!(gradients.len(), self.slots.len(), "gradients of the optimizer's network");
        self.steps += 1;
        let (scale, limit) = gradients.clipping();
        let mut i = 0;
        let (rule, rate, t) = (self.rule, self.rate * rate_scale, self.steps);
        let slots = &mut self.slots;
        param::visit(module, &mut |_, p| {
            let (m, g) = (&mut slots[i], gradients.at(i));
            i += 1;
            let (Some(g), true) = (g, m.stepped && !p.is_frozen()) else { return };
            let step = weight_step::Step { rule, rate: rate * m.rate_scale, weight_decay: m.weight_decay, t, scale, limit };
            match g {
                Gradient::Cpu(g) => p.write(|w| cpu::step(&step, w, &mut m.first, &mut m.second, g)),
                Gradient::Device(g) => p.replace(|w| on_device::step(&step, w, &mut m.device, (**g).clone())),
            }
        });
        drop(gradients);
        pool::end_step();
    }

    /// Everything that a later run needs to go on bit by bit, besides the weights: the moments, and the count of steps in two
    /// numbers of 24 bits.
    pub fn state(&self) -> Vec<NamedArray> {
        let count = [(self.steps & 0xff_ffff) as f32, (self.steps >> 24) as f32];
        let mut out = vec![NamedArray::new("optimizer.steps", &[2], count.to_vec())];
        for m in &self.slots {
            for (which, values, device) in [("first", &m.first, &m.device.first), ("second", &m.second, &m.device.second)] {
                let values = device.as_ref().map_or_else(|| values.clone(), |d| crate::read_values(d.clone()));
                if !values.is_empty() {
                    out.push(NamedArray::new(format!("optimizer.{which}.{}", m.name), &[values.len()], values));
                }
            }
        }
        out
    }

    /// Takes a saved state over.
    ///
    /// # Errors
    /// When an array is missing or has another length; nothing is changed then.
    pub fn restore(&mut self, module: &dyn Module, arrays: &[NamedArray]) -> Result<(), StateError> {
        let find = |name: &str, len: usize| StateError::find(arrays, name, len);
        let count = find("optimizer.steps", 2)?;
        let steps = count[0] as u64 | (count[1] as u64) << 24;
        // Before the first step there are no moments on devices.
        let moments = if steps == 0 { 0 } else { self.rule.moments() };
        let mut found = Vec::new();
        for m in self.slots.iter().filter(|m| m.stepped) {
            for which in ["first", "second"].into_iter().take(moments) {
                found.push(find(&format!("optimizer.{which}.{}", m.name), m.len)?);
            }
        }
        self.steps = steps;
        let mut found = found.into_iter();
        let mut slots = self.slots.iter_mut();
        param::visit(module, &mut |_, p| {
            let Some(m) = slots.next().filter(|m| m.stepped) else { return };
            let on_cpu = [&mut m.first, &mut m.second];
            let on_device = [&mut m.device.first, &mut m.device.second];
            for (cpu, device) in on_cpu.into_iter().zip(on_device).take(moments) {
                let values = found.next().expect("found above");
                if p.is_on_cpu() { cpu.copy_from_slice(values) } else { *device = Some(p.beside(values.to_vec())) }
            }
        });
        Ok(())
    }
}
