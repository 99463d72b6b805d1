//! Groups of parameters with their gradients, moments, rate and schedule, in buffers of our own; and sets of them, which a step trains
//! together.

use diorama_kernels::ops::adam::{Adam, cpu as adam};
use std::ops::Range;

/// Parameters that share rate, decay and schedule. Sparse groups update touched lines only.
#[derive(Clone, Debug)]
pub struct ParamGroup {
    pub name: &'static str,
    pub values: Vec<f32>,
    pub grads: Vec<f32>,
    pub moment1: Vec<f32>,
    pub moment2: Vec<f32>,
    /// Marks of touched lines; empty for a dense group.
    pub touched: Vec<u8>,
    pub adam: Adam,
    /// How the rate changes over the run.
    pub schedule: Schedule,
    /// A frozen group takes no step, and its gradient is not computed. A field's weights are frozen by
    /// [`crate::fields::Field::freeze_layers`].
    pub frozen: bool,
    /// Ranges that are trained; none: all. The others keep their values, and their gradients are not computed.
    pub trained: Option<Vec<Range<usize>>>,
}

impl ParamGroup {
    pub fn dense(name: &'static str, values: Vec<f32>, adam: Adam) -> Self {
        let n = values.len();
        ParamGroup {
            name,
            values,
            grads: vec![0.0; n],
            moment1: vec![0.0; n],
            moment2: vec![0.0; n],
            touched: Vec::new(),
            adam,
            schedule: Schedule::CONSTANT,
            frozen: false,
            trained: None,
        }
    }

    /// # Panics
    /// When the length is not a multiple of a line.
    pub fn sparse(name: &'static str, values: Vec<f32>, adam: Adam) -> Self {
        assert!(values.len().is_multiple_of(adam::LINE), "{name}: {} is no multiple of {}", values.len(), adam::LINE);
        let touched = vec![0; values.len() / adam::LINE];
        ParamGroup { touched, ..ParamGroup::dense(name, values, adam) }
    }

    /// One optimizer step `t ≥ 1` with the rate times `rate_scale`. Gradients are zero afterwards.
    pub fn step(&mut self, t: u32, rate_scale: f32) {
        if self.frozen {
            self.grads.fill(0.0);
            self.touched.fill(0);
            return;
        }
        let a = Adam { rate: self.adam.rate * rate_scale, ..self.adam };
        if self.touched.is_empty() {
            let all = std::iter::once(0..self.values.len()).collect();
            for r in self.trained.as_ref().unwrap_or(&all) {
                let (values, grads) = (&mut self.values[r.clone()], &self.grads[r.clone()]);
                adam::dense(&a, t, values, &mut self.moment1[r.clone()], &mut self.moment2[r.clone()], grads);
            }
            self.grads.fill(0.0);
        } else {
            adam::sparse(&a, t, &mut self.values, &mut self.moment1, &mut self.moment2, &mut self.grads, &mut self.touched);
        }
    }

    /// Marks the lines of a sparse group that have a gradient.
    pub fn touch(&mut self) {
        let lines = self.grads.chunks_exact(adam::LINE);
        self.touched.iter_mut().zip(lines).for_each(|(t, line)| *t |= line.iter().any(|g| *g != 0.0) as u8);
    }

    /// A copy of the values alone, for rendering; it cannot be trained.
    pub fn values_only(&self) -> ParamGroup {
        ParamGroup {
            name: self.name,
            values: self.values.clone(),
            grads: Vec::new(),
            moment1: Vec::new(),
            moment2: Vec::new(),
            touched: Vec::new(),
            adam: self.adam,
            schedule: self.schedule,
            frozen: true,
            trained: None,
        }
    }

    /// Whether any value is not finite.
    pub fn is_broken(&self) -> bool {
        self.values.iter().any(|v| !v.is_finite())
    }
}

/// Groups of parameters that are trained together, each at its own rate; borrowed from the parts that they belong to.
#[derive(Default)]
pub struct ParamSet<'a>(Vec<(String, &'a mut ParamGroup)>);

/// Why numbers do not fit a [`ParamSet`].
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum RestoreError {
    #[error("{0} is missing")]
    Missing(String),
    #[error("{name} has {got} numbers where the configuration needs {wanted}; use the configuration that it was trained with")]
    Length { name: String, got: usize, wanted: usize },
}

impl<'a> ParamSet<'a> {
    /// Adds groups, named `prefix` and a dot before their own names, or by these alone where the prefix is empty. Checkpoints know them by
    /// these names.
    ///
    /// # Panics
    /// When there is a group of that name.
    pub fn add(&mut self, prefix: &str, groups: impl IntoIterator<Item = &'a mut ParamGroup>) {
        for g in groups {
            let name = if prefix.is_empty() { g.name.to_string() } else { format!("{prefix}.{}", g.name) };
            assert!(self.0.iter().all(|(other, _)| *other != name), "two groups of parameters are called {name}");
            self.0.push((name, g));
        }
    }

    /// The groups with their names.
    pub fn groups(&mut self) -> impl Iterator<Item = (&str, &mut ParamGroup)> {
        self.0.iter_mut().map(|(name, g)| (&name[..], &mut **g))
    }

    /// One optimizer step for each group, at its own rate times that of its schedule and `rate_scale`: step `number` of the run, from 0, of
    /// which the share `progress` is done. Gradients are zero afterwards.
    pub fn step(&mut self, number: u64, progress: f32, rate_scale: f32) {
        self.groups().for_each(|(_, g)| g.step(number as u32 + 1, g.schedule.scale(progress) * rate_scale));
    }

    /// Whether any value is not finite.
    pub fn is_broken(&self) -> bool {
        self.0.iter().any(|(_, g)| g.is_broken())
    }

    /// All numbers that training needs to go on bit by bit: values and moments, by name.
    pub fn into_arrays(self) -> Vec<(String, &'a [f32])> {
        let arrays = |(name, g): (String, &'a mut ParamGroup)| {
            let g: &'a ParamGroup = g;
            [(name.clone(), &g.values[..]), (format!("{name}.moment1"), &g.moment1), (format!("{name}.moment2"), &g.moment2)]
        };
        self.0.into_iter().flat_map(arrays).collect()
    }

    /// Takes over what [`ParamSet::into_arrays`] gave; `take` gives the array of a name. Gradients are zero afterwards.
    ///
    /// # Errors
    /// When an array is missing or has another length; groups before it have theirs then.
    pub fn restore(&mut self, take: &mut dyn FnMut(&str) -> Option<Vec<f32>>) -> Result<(), RestoreError> {
        let mut fill = |name: String, into: &mut Vec<f32>| {
            let values = take(&name).ok_or_else(|| RestoreError::Missing(name.clone()))?;
            if values.len() != into.len() {
                return Err(RestoreError::Length { name, got: values.len(), wanted: into.len() });
            }
            *into = values;
            Ok(())
        };
        for (name, g) in &mut self.0 {
            fill(name.clone(), &mut g.values)?;
            fill(format!("{name}.moment1"), &mut g.moment1)?;
            fill(format!("{name}.moment2"), &mut g.moment2)?;
            g.grads.fill(0.0);
            g.touched.fill(0);
        }
        Ok(())
    }
}

/// How the rate falls over a run, as a function of progress in [0, 1].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Schedule {
    /// Share of the run over which the rate rises from a tenth.
    pub warmup: f32,
    /// Rate at the end over the rate at the start; the fall is exponential.
    pub final_scale: f32,
    /// Progress at which the fall begins.
    pub decay_from: f32,
}

impl Schedule {
    pub const CONSTANT: Schedule = Schedule { warmup: 0.0, final_scale: 1.0, decay_from: 0.0 };

    /// Scale of the rate at `progress`.
    pub fn scale(&self, progress: f32) -> f32 {
        let p = progress.clamp(0.0, 1.0);
        let rise = if p < self.warmup { 0.1 + 0.9 * p / self.warmup } else { 1.0 };
        let fall = ((p - self.decay_from) / (1.0 - self.decay_from).max(1e-6)).clamp(0.0, 1.0);
        rise * self.final_scale.powf(fall)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_frozen_group_stays_where_it_is() {
        let mut g = ParamGroup::dense("w", vec![1.0, 2.0], Adam::default());
        g.frozen = true;
        g.grads = vec![1.0, -1.0];
        g.step(1, 1.0);
        assert_eq!((g.values.clone(), g.grads.clone()), (vec![1.0, 2.0], vec![0.0, 0.0]));
        g.frozen = false;
        g.grads = vec![1.0, -1.0];
        g.step(1, 1.0);
        assert!(g.values[0] < 1.0 && g.values[1] > 2.0);
    }

    #[test]
    fn only_trained_ranges_move() {
        let mut g = ParamGroup::dense("w", vec![1.0; 5], Adam { weight_decay: 0.1, ..Adam::default() });
        g.trained = Some(vec![0..1, 3..5]);
        g.grads = vec![1.0; 5];
        g.step(1, 1.0);
        assert!(g.values[1..3] == [1.0; 2] && [0, 3, 4].iter().all(|i| g.values[*i] < 1.0), "{:?}", g.values);
    }

    #[test]
    fn groups_of_a_set_go_their_own_ways_and_come_back() {
        let group = |name, rate| ParamGroup::dense(name, vec![1.0; 3], Adam { rate, ..Adam::default() });
        let (mut fast, mut slow, mut still) = (group("weights", 0.1), group("weights", 0.1), group("codes", 0.1));
        slow.schedule = Schedule { final_scale: 0.01, ..Schedule::CONSTANT };
        still.frozen = true;
        let mut set = ParamSet::default();
        set.add("field", [&mut fast]);
        set.add("image", [&mut slow]);
        set.add("", [&mut still]);
        set.groups().for_each(|(_, g)| g.grads.fill(1.0));
        set.step(0, 1.0, 0.5);
        let moved: Vec<(&str, f32)> = set.groups().map(|(name, g)| (name, 1.0 - g.values[0])).collect();
        for ((name, by), want) in moved.iter().zip([("field.weights", 0.05), ("image.weights", 0.0005), ("codes", 0.0)]) {
            assert!(*name == want.0 && (by - want.1).abs() < 1e-5, "{moved:?}");
        }
        let kept: Vec<(String, Vec<f32>)> = set.into_arrays().into_iter().map(|(n, v)| (n, v.to_vec())).collect();
        let take = |kept: &[(String, Vec<f32>)], name: &str| kept.iter().find(|k| k.0 == name).map(|k| k.1.clone());
        let mut other = group("weights", 0.1);
        let mut set = ParamSet::default();
        set.add("field", [&mut other]);
        set.restore(&mut |name| take(&kept, name)).unwrap();
        let missing = set.restore(&mut |_| None).unwrap_err().to_string();
        let short = set.restore(&mut |_| Some(vec![0.0])).unwrap_err().to_string();
        assert!(missing.contains("field.weights is missing") && short.contains("1 numbers where"), "{missing}; {short}");
        assert_eq!((other.values, other.moment1), (fast.values, fast.moment1));
    }

    #[test]
    fn the_schedule_rises_then_falls_to_its_end() {
        let s = Schedule { warmup: 0.1, final_scale: 0.03, decay_from: 0.5 };
        assert!((s.scale(0.0) - 0.1).abs() < 1e-6 && (s.scale(0.3) - 1.0).abs() < 1e-6);
        assert!((s.scale(1.0) - 0.03).abs() < 1e-6 && s.scale(0.75) < 1.0);
        assert_eq!(Schedule::CONSTANT.scale(0.7), 1.0);
    }
}
