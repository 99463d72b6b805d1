//! Gradients of a network's weights, in the order in which it tells them.

use crate::bridge::{Values, ValuesMut};
use crate::param::{self, Module};
use burn::backend::DispatchTensor;
use burn::tensor::Tensor;
use diorama_kernels::ops::sum::cpu as sums;
use rayon::prelude::*;

/// Numbers of which one sum is made at a time; fixed, so that sums do not depend on threads.
const CHUNK: usize = 1 << 14;

/// A gradient where its weight is. A tensor is large beside values, hence the box.
#[derive(Clone, Debug)]
pub(super) enum Gradient {
    Cpu(Values),
    Device(Box<Tensor<1>>),
}

/// The gradients of one step; `None` for parameters that are frozen, statistics, or did not take part.
#[derive(Debug)]
pub struct Gradients {
    values: Vec<Option<Gradient>>,
    scale: f32,
    limit: f32,
}

impl Gradients {
    /// Takes the gradients that `loss.backward()` found, and the graph's views of the parameters away.
    pub fn take(module: &dyn Module, mut found: burn::tensor::Gradients) -> Gradients {
        let mut values = Vec::new();
        param::visit(module, &mut |_, p| {
            let gradient = p.take_leaf().and_then(|leaf: DispatchTensor| {
                // The rank of a tensor is a matter of its type alone.
                Tensor::<1>::from_dispatch(leaf).grad_remove(&mut found)
            });
            values.push(gradient.map(|g| {
                if p.is_on_cpu() {
                    Gradient::Cpu(param::values_of(g.into_dispatch()))
                } else {
                    Gradient::Device(Box::new(g.reshape([p.len()])))
                }
            }));
        });
        Gradients { values, scale: 1.0, limit: f32::INFINITY }
    }

    /// Adds the gradients of another part of the batch.
    ///
    /// # Panics
    /// When they are another network's, or either was clipped.
    pub fn add(&mut self, other: &Gradients) {
        assert_eq!(self.values.len(), other.values.len(), "gradients of one network");
        let clipped = |g: &Gradients| g.scale != 1.0 || g.limit != f32::INFINITY;
        assert!(!clipped(self) && !clipped(other), "clip the sum");
        for (a, b) in self.values.iter_mut().zip(&other.values) {
            let sum = match (&*a, b) {
                (Some(Gradient::Cpu(x)), Some(Gradient::Cpu(y))) => {
                    let mut out = ValuesMut::any(x.shape());
                    sums::forward(x, y, false, &mut out);
                    Some(Gradient::Cpu(out.freeze()))
                }
                (Some(Gradient::Device(x)), Some(Gradient::Device(y))) => Some(Gradient::Device(Box::new((**x).clone() + (**y).clone()))),
                (None, Some(y)) => Some(y.clone()),
                (_, None) => continue,
                _ => unreachable!("a weight is in one place"),
            };
            *a = sum;
        }
    }

    /// The gradient of the network's parameter number `i`, before clipping.
    pub fn get(&self, i: usize) -> Option<Values> {
        self.values[i].as_ref().map(|g| match g {
            Gradient::Cpu(v) => v.clone(),
            Gradient::Device(t) => param::values_of((**t).clone().into_dispatch()),
        })
    }

    pub(super) fn at(&self, i: usize) -> Option<&Gradient> {
        self.values[i].as_ref()
    }

    /// How many parameters the network has.
    pub fn len(&self) -> usize {
        self.values.len()
    }

    pub fn is_empty(&self) -> bool {
        self.values.is_empty()
    }

    /// The root of the sum of all squares, clipping included only as a scale.
    pub fn norm(&self) -> f32 {
        let of = |g: &Gradient| -> f64 {
            let v = match g {
                Gradient::Cpu(v) => v,
                Gradient::Device(t) => return crate::read_values(((**t).clone() * (**t).clone()).sum())[0] as f64,
            };
            let parts: Vec<f64> = v.par_chunks(CHUNK).map(|c| c.iter().map(|g| (*g as f64) * (*g as f64)).sum()).collect();
            parts.iter().sum()
        };
        (self.values.iter().flatten().map(of).sum::<f64>().sqrt() as f32) * self.scale
    }

    /// Scales all gradients down so that their norm is at most `most`; returns the norm before.
    pub fn clip_norm(&mut self, most: f32) -> f32 {
        let norm = self.norm();
        if norm > most {
            self.scale *= most / norm;
        }
        norm
    }

    /// Limits each element to `[-most, most]`.
    pub fn clip_value(&mut self, most: f32) {
        self.limit = self.limit.min(most);
    }

    /// The factor and the limit that the optimizer applies to each element.
    pub(super) fn clipping(&self) -> (f32, f32) {
        (self.scale, self.limit)
    }
}
