//! Parameters of networks, and how a network tells them by name.
//!
//! A parameter's numbers live in a tensor of its own that the optimizer steps in place; a step's graph holds a tracked view of
//! them, which the optimizer drops before it writes.

use crate::bridge::Values;
use burn::backend::{BackendTensor, DispatchAutodiffContext, DispatchTensor, DispatchTensorKind, TensorMetadata};
use burn::tensor::{Device, Tensor, TensorData};
use diorama_geom::NamedArray;
use diorama_geom::rng::Rng;
use std::sync::{Mutex, MutexGuard};

/// Whether a network is trained or used.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mode {
    /// Gradients are recorded, normalization uses the batch's statistics and updates the running ones.
    Train,
    /// Nothing is recorded, normalization uses the running statistics.
    Eval,
}

/// What a parameter is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// Stepped by the optimizer.
    Weight,
    /// Kept with the weights, but changed by the network itself, as running statistics are.
    Statistic,
}

/// Numbers that belong to a network.
#[derive(Debug)]
pub struct Param {
    kind: Kind,
    shape: Vec<usize>,
    state: Mutex<State>,
}

#[derive(Debug)]
struct State {
    value: DispatchTensor,
    /// The view of this step's graph.
    leaf: Option<DispatchTensor>,
    frozen: bool,
}

impl Clone for Param {
    /// A copy of its own memory once either is written.
    fn clone(&self) -> Self {
        let s = self.lock();
        let state = Mutex::new(State { value: s.value.clone(), leaf: None, frozen: s.frozen });
        Param { kind: self.kind, shape: self.shape.clone(), state }
    }
}

impl Param {
    /// # Panics
    /// When the shape asks for another count of values.
    pub fn new(kind: Kind, shape: &[usize], values: Vec<f32>, device: &Device) -> Param {
        assert_eq!(values.len(), shape.iter().product::<usize>(), "a parameter has as many numbers as its shape says");
        let flat = Tensor::<1>::from_data(TensorData::new(values, [shape.iter().product::<usize>()]), &device.clone().without_autodiff());
        let state = Mutex::new(State { value: flat.into_dispatch(), leaf: None, frozen: false });
        Param { kind, shape: shape.to_vec(), state }
    }

    /// A weight with uniform numbers in `[-bound, bound)`.
    pub fn uniform(shape: &[usize], bound: f32, rng: &Rng, device: &Device) -> Param {
        let n = shape.iter().product::<usize>() as u64;
        Param::new(Kind::Weight, shape, (0..n).map(|i| (rng.uniform(i) * 2.0 - 1.0) * bound).collect(), device)
    }

    /// A weight with normal numbers of standard deviation `std`.
    pub fn normal(shape: &[usize], std: f32, rng: &Rng, device: &Device) -> Param {
        let n = shape.iter().product::<usize>() as u64;
        Param::new(Kind::Weight, shape, (0..n).map(|i| rng.normal(i) * std).collect(), device)
    }

    /// The same number everywhere.
    pub fn constant(kind: Kind, shape: &[usize], value: f32, device: &Device) -> Param {
        Param::new(kind, shape, vec![value; shape.iter().product()], device)
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().expect("no other holder panicked")
    }

    pub fn kind(&self) -> Kind {
        self.kind
    }

    pub fn shape(&self) -> &[usize] {
        &self.shape
    }

    /// The tensor to compute with: in training, of a weight that is not frozen, the one whose gradient the optimizer takes.
    ///
    /// # Panics
    /// When `D` is not the parameter's rank.
    pub fn tensor<const D: usize>(&self, mode: Mode) -> Tensor<D> {
        let mut s = self.lock();
        let shape: [usize; D] = self.shape[..].try_into().expect("the parameter's rank");
        if mode == Mode::Eval || s.frozen || self.kind == Kind::Statistic {
            return Tensor::<1>::from_dispatch(s.value.clone()).reshape(shape);
        }
        let State { value, leaf, .. } = &mut *s;
        let track = || Tensor::<1>::from_dispatch(value.clone()).reshape(shape).autodiff().require_grad().into_dispatch();
        let leaf = leaf.get_or_insert_with(track);
        Tensor::from_dispatch(leaf.clone())
    }

    /// Excludes a weight from training, so that no gradient is computed for it, or includes it again.
    pub fn set_frozen(&self, frozen: bool) {
        let mut s = self.lock();
        (s.frozen, s.leaf) = (frozen, None);
    }

    pub fn is_frozen(&self) -> bool {
        self.lock().frozen
    }

    /// Takes the view of this step's graph away; afterwards the numbers can be written in place.
    pub(crate) fn take_leaf(&self) -> Option<DispatchTensor> {
        self.lock().leaf.take()
    }

    /// Writes the numbers in place where they lie on the CPU and nothing else refers to them, else in a copy.
    pub fn write(&self, write: impl FnOnce(&mut [f32])) {
        let mut s = self.lock();
        if let DispatchTensorKind::Flex(BackendTensor::Float(t)) = &mut s.value.kind {
            write(t.storage_mut());
            return;
        }
        let t = Tensor::<1>::from_dispatch(s.value.clone());
        let device = t.device();
        let mut values = crate::read_values(t);
        write(&mut values);
        let n = values.len();
        s.value = Tensor::<1>::from_data(TensorData::new(values, [n]), &device).into_dispatch();
    }

    /// Replaces the numbers by a function of them, where they are.
    pub(crate) fn replace(&self, new: impl FnOnce(Tensor<1>) -> Tensor<1>) {
        let mut s = self.lock();
        s.value = new(Tensor::from_dispatch(s.value.clone())).into_dispatch();
    }

    /// Numbers where the parameter's are.
    pub(crate) fn beside(&self, values: Vec<f32>) -> Tensor<1> {
        let device = Tensor::<1>::from_dispatch(self.lock().value.clone()).device();
        let n = values.len();
        Tensor::from_data(TensorData::new(values, [n]), &device)
    }

    /// Shows the numbers, without a copy where they lie on the CPU.
    pub fn read<T>(&self, read: impl FnOnce(&[f32]) -> T) -> T {
        let s = self.lock();
        if let DispatchTensorKind::Flex(BackendTensor::Float(t)) = &s.value.kind {
            return read(t.storage());
        }
        read(&crate::read_values(Tensor::<1>::from_dispatch(s.value.clone())))
    }

    /// A copy of the numbers.
    pub fn values(&self) -> Vec<f32> {
        self.read(<[f32]>::to_vec)
    }

    /// Whether the numbers lie on the CPU.
    pub fn is_on_cpu(&self) -> bool {
        matches!(self.lock().value.kind, DispatchTensorKind::Flex(_))
    }

    /// How many numbers there are.
    pub fn len(&self) -> usize {
        self.shape.iter().product()
    }

    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// The numbers of a tensor on the CPU without a copy where they lie row by row.
pub(crate) fn values_of(tensor: DispatchTensor) -> Values {
    match Tensor::<1>::from_dispatch(tensor).inner().into_dispatch().kind {
        DispatchTensorKind::Flex(BackendTensor::Float(t)) => Values::of(&t),
        kind => {
            let shape: Vec<usize> = kind.shape().iter().copied().collect();
            let t = DispatchTensor { kind, autodiff: DispatchAutodiffContext::Disabled };
            Values::from_vec(crate::read_values(Tensor::<1>::from_dispatch(t).reshape([shape.iter().product::<usize>()])), &shape)
        }
    }
}

/// Collects parameters with their full names, as `layer1.0.conv1.weight`.
pub struct Visitor<'a> {
    path: String,
    visit: &'a mut dyn FnMut(&str, &Param),
}

impl Visitor<'_> {
    /// One parameter.
    pub fn param(&mut self, name: &str, param: &Param) {
        let full = if self.path.is_empty() { name.to_string() } else { format!("{}.{name}", self.path) };
        (self.visit)(&full, param);
    }

    /// The parameters of a part of the network.
    pub fn part(&mut self, name: &str, part: &dyn Module) {
        let before = self.path.len();
        if before > 0 {
            self.path.push('.');
        }
        self.path.push_str(name);
        part.visit(self);
        self.path.truncate(before);
    }

    /// The parts of a list, numbered from 0.
    pub fn parts<M: Module>(&mut self, name: &str, parts: &[M]) {
        for (i, part) in parts.iter().enumerate() {
            self.part(&format!("{name}.{i}"), part);
        }
    }
}

/// A network or a part of one: it tells its parameters, always in the same order.
pub trait Module {
    fn visit(&self, v: &mut Visitor);
}

/// Calls `visit` with the full name of every parameter of `module`, in its order.
pub fn visit(module: &dyn Module, visit: &mut dyn FnMut(&str, &Param)) {
    module.visit(&mut Visitor { path: String::new(), visit });
}

/// Copies of all parameters and statistics.
pub fn arrays(module: &dyn Module) -> Vec<NamedArray> {
    let mut out = Vec::new();
    visit(module, &mut |name, p| out.push(NamedArray::new(name, p.shape(), p.values())));
    out
}

/// How many weights a network has.
pub fn count(module: &dyn Module) -> usize {
    let mut n = 0;
    visit(module, &mut |_, p| n += if p.kind() == Kind::Weight { p.len() } else { 0 });
    n
}

/// Freezes the weights whose names `chosen` admits, so that no gradient is computed for them.
pub fn freeze(module: &dyn Module, chosen: impl Fn(&str) -> bool) {
    visit(module, &mut |name, p| {
        if chosen(name) {
            p.set_frozen(true);
        }
    });
}
