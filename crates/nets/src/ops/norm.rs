//! Normalization: batch, group (instance with as many groups as channels), and layer.

use super::Activation;
use super::by_burn;
use crate::bridge::{Forward, Kept, OpError, SliceOp, Values, ValuesMut, apply_one, expect_inputs, expect_shape};
use crate::param::{Mode, Param};
use burn::backend::DispatchTensor;
use burn::tensor::Tensor;
use diorama_kernels::ops::norm::{LayerNorm, Norm, Over, cpu, layer, update_running};
use std::cell::RefCell;
use std::sync::{Arc, Mutex};

/// What normalizations share.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NormSettings {
    pub epsilon: f32,
    pub activation: Activation,
}

impl Default for NormSettings {
    fn default() -> Self {
        NormSettings { epsilon: 1e-5, activation: Activation::None }
    }
}

/// Running statistics of batch normalization, `[C]` each.
#[derive(Clone, Copy)]
pub struct BatchStatistics<'a> {
    pub mean: &'a Param,
    pub variance: &'a Param,
    /// Share of the batch's statistics in an update, usually 0.1.
    pub momentum: f32,
}

thread_local! {
    /// Sums of a backward pass; grows once.
    static SCRATCH: RefCell<Vec<f32>> = const { RefCell::new(Vec::new()) };
}

/// Mean and variance of a batch, handed out of the op that found them.
type Found = Arc<Mutex<Option<(Values, Values)>>>;

/// Inputs: x, scale, shift; with given statistics mean and variance, too.
#[derive(Clone, Debug)]
pub(super) struct NormOp {
    pub(super) over: Over,
    pub(super) settings: NormSettings,
    pub(super) found: Found,
}

impl NormOp {
    pub(super) fn new(over: Over, settings: NormSettings) -> NormOp {
        NormOp { over, settings, found: Found::default() }
    }

    fn norm<'a>(&self, shape: &[usize], scale: &'a [f32], shift: &'a [f32]) -> Norm<'a> {
        Norm {
            over: self.over,
            images: shape[0],
            channels: shape[1],
            places: shape[2..].iter().product(),
            epsilon: self.settings.epsilon,
            scale: Some(scale),
            shift: Some(shift),
            activation: self.settings.activation,
        }
    }
}

impl SliceOp for NormOp {
    fn name(&self) -> &'static str {
        match self.over {
            Over::Batch | Over::Given => "batch norm",
            Over::Groups(_) => "group norm",
        }
    }

    fn check(&self, shapes: &[&[usize]]) -> Result<(), OpError> {
        expect_inputs(self.name(), shapes, if self.over == Over::Given { 5 } else { 3 })?;
        if shapes[0].len() < 2 {
            return Err(OpError::shape(self.name(), "x", shapes[0], "[N, C, …]"));
        }
        if let Over::Groups(groups) = self.over
            && (groups == 0 || !shapes[0][1].is_multiple_of(groups))
        {
            return Err(OpError::settings(self.name(), format!("{} channels do not divide into {groups} groups", shapes[0][1])));
        }
        let names = ["scale", "shift", "mean", "variance"];
        names.iter().zip(&shapes[1..]).try_for_each(|(name, s)| expect_shape(self.name(), name, s, &[Some(shapes[0][1])]))
    }

    fn forward(&self, x: &[Values], wanted: &[bool]) -> Forward {
        let norm = self.norm(x[0].shape(), &x[1], &x[2]);
        let (mut mean, mut variance) = (ValuesMut::any(&[norm.sets()]), ValuesMut::any(&[norm.sets()]));
        if self.over == Over::Given {
            mean.copy_from_slice(&x[3]);
            variance.copy_from_slice(&x[4]);
        }
        let mut out = ValuesMut::any(x[0].shape());
        cpu::forward(&norm, &x[0], &mut mean, &mut variance, &mut out);
        let (mean, variance) = (mean.freeze(), variance.freeze());
        if self.over == Over::Batch {
            *self.found.lock().expect("no other holder panicked") = Some((mean.clone(), variance.clone()));
        }
        let kept = [x[0].clone(), x[1].clone(), x[2].clone(), mean, variance];
        Forward::one(out.freeze(), if wanted.contains(&true) { Kept::of(&kept) } else { Kept::default() })
    }

    fn backward(&self, kept: &Kept, d: &[Option<Values>], wanted: &[bool]) -> Vec<Option<Values>> {
        let Some(d) = &d[0] else { return vec![None; wanted.len()] };
        let [x, scale, shift, mean, variance] = std::array::from_fn(|i| &kept.values[i]);
        let norm = self.norm(x.shape(), scale, shift);
        let mut dx = ValuesMut::any(x.shape());
        let (mut ds, mut dt) = (ValuesMut::any(scale.shape()), ValuesMut::any(shift.shape()));
        let gradients = cpu::Gradients { x: &mut dx, scale: &mut ds, shift: &mut dt };
        // Taken, not borrowed: while this waits for the pool, its thread may run another backward pass.
        let mut scratch = SCRATCH.take();
        cpu::backward(&norm, x, mean, variance, d, gradients, &mut scratch);
        SCRATCH.set(scratch);
        let mut all = vec![Some(dx.freeze()), Some(ds.freeze()), Some(dt.freeze())];
        all.resize(wanted.len(), None);
        all
    }

    fn by_burn(&self, x: &[DispatchTensor]) -> Option<Vec<DispatchTensor>> {
        if let Over::Groups(groups) = self.over {
            return Some(by_burn::group_norm(x, groups, self.settings.epsilon, self.settings.activation));
        }
        let mut out = by_burn::batch_norm(x, self.settings.epsilon, self.settings.activation);
        if self.over == Over::Batch {
            let mut found = out.split_off(1).into_iter().map(crate::param::values_of);
            *self.found.lock().expect("no other holder panicked") = found.next().zip(found.next());
        }
        Some(out)
    }
}

/// Batch normalization of images or rows with an activation: by the batch's statistics in training, which move the running ones,
/// else by the running ones.
///
/// # Shapes
/// x `[N, C, …]`; scale, shift `[C]`.
pub fn batch_norm<const D: usize>(
    x: Tensor<D>,
    scale: Tensor<1>,
    shift: Tensor<1>,
    running: BatchStatistics,
    settings: NormSettings,
    mode: Mode,
) -> Result<Tensor<D>, OpError> {
    let over = if mode == Mode::Train { Over::Batch } else { Over::Given };
    let op = NormOp::new(over, settings);
    let found = op.found.clone();
    let count = x.dims().iter().enumerate().filter(|(i, _)| *i != 1).map(|(_, n)| n).product();
    let mut inputs = vec![x.into_dispatch(), scale.into_dispatch(), shift.into_dispatch()];
    if over == Over::Given {
        inputs.extend([running.mean, running.variance].map(|p| p.tensor::<1>(Mode::Eval).into_dispatch()));
    } else if count < 2 {
        return Err(OpError::settings("batch norm", "a batch of one number per channel has no variance"));
    }
    let out = apply_one(op, inputs)?;
    if let Some((mean, variance)) = found.lock().expect("no other holder panicked").take() {
        running.mean.write(|m| running.variance.write(|v| update_running(count, running.momentum, &mean, &variance, m, v)));
    }
    Ok(out)
}

/// Group normalization of images with an activation.
///
/// # Shapes
/// x `[N, C, …]`; scale, shift `[C]`.
pub fn group_norm<const D: usize>(
    x: Tensor<D>,
    scale: Tensor<1>,
    shift: Tensor<1>,
    groups: usize,
    settings: NormSettings,
) -> Result<Tensor<D>, OpError> {
    apply_one(NormOp::new(Over::Groups(groups), settings), vec![x.into_dispatch(), scale.into_dispatch(), shift.into_dispatch()])
}

#[derive(Clone, Debug)]
pub(super) struct LayerNormOp(pub(super) NormSettings);

impl LayerNormOp {
    fn norm<'a>(&self, scale: &'a [f32], shift: &'a [f32]) -> LayerNorm<'a> {
        let NormSettings { epsilon, activation } = self.0;
        LayerNorm { width: scale.len(), epsilon, scale: Some(scale), shift: Some(shift), activation }
    }
}

impl SliceOp for LayerNormOp {
    fn name(&self) -> &'static str {
        "layer norm"
    }

    fn check(&self, shapes: &[&[usize]]) -> Result<(), OpError> {
        expect_inputs(self.name(), shapes, 3)?;
        let width = shapes[0].last().copied();
        expect_shape(self.name(), "scale", shapes[1], &[width])?;
        expect_shape(self.name(), "shift", shapes[2], &[width])
    }

    fn forward(&self, x: &[Values], wanted: &[bool]) -> Forward {
        let norm = self.norm(&x[1], &x[2]);
        let rows = x[0].len() / norm.width.max(1);
        let (mut mean, mut variance, mut out) = (ValuesMut::any(&[rows]), ValuesMut::any(&[rows]), ValuesMut::any(x[0].shape()));
        layer::forward(&norm, &x[0], &mut mean, &mut variance, &mut out);
        let kept = [x[0].clone(), x[1].clone(), x[2].clone(), mean.freeze(), variance.freeze()];
        Forward::one(out.freeze(), if wanted.contains(&true) { Kept::of(&kept) } else { Kept::default() })
    }

    fn backward(&self, kept: &Kept, d: &[Option<Values>], _: &[bool]) -> Vec<Option<Values>> {
        let Some(d) = &d[0] else { return vec![None; 3] };
        let [x, scale, shift, mean, variance] = std::array::from_fn(|i| &kept.values[i]);
        let norm = self.norm(scale, shift);
        let mut dx = ValuesMut::any(x.shape());
        let (mut ds, mut dt) = (ValuesMut::any(scale.shape()), ValuesMut::any(shift.shape()));
        let gradients = cpu::Gradients { x: &mut dx, scale: &mut ds, shift: &mut dt };
        // Taken, not borrowed: while this waits for the pool, its thread may run another backward pass.
        let mut scratch = SCRATCH.take();
        layer::backward(&norm, x, mean, variance, d, gradients, &mut scratch);
        SCRATCH.set(scratch);
        vec![Some(dx.freeze()), Some(ds.freeze()), Some(dt.freeze())]
    }

    fn by_burn(&self, x: &[DispatchTensor]) -> Option<Vec<DispatchTensor>> {
        Some(by_burn::layer_norm(x, self.0.epsilon, self.0.activation))
    }
}

/// Layer normalization of the last axis with an activation.
///
/// # Shapes
/// x `[…, K]`; scale, shift `[K]`.
pub fn layer_norm<const D: usize>(x: Tensor<D>, scale: Tensor<1>, shift: Tensor<1>, settings: NormSettings) -> Result<Tensor<D>, OpError> {
    apply_one(LayerNormOp(settings), vec![x.into_dispatch(), scale.into_dispatch(), shift.into_dispatch()])
}
