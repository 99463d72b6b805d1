//! Losses, and the softmax that classifiers end with.

use super::by_burn;
use crate::bridge::{Forward, Kept, OpError, SliceOp, Values, ValuesMut, apply_one, expect_inputs, expect_shape};
use burn::backend::DispatchTensor;
use burn::tensor::Tensor;
use diorama_kernels::ops::mean_error::{self, Error};
use diorama_kernels::ops::softmax::{Targets, cpu};
use std::sync::Arc;

/// A class that no row has.
const NO_CLASS: i64 = i64::MIN;

#[derive(Clone, Debug)]
pub(super) struct SoftmaxOp {
    pub(super) logarithm: bool,
}

impl SliceOp for SoftmaxOp {
    fn name(&self) -> &'static str {
        "softmax"
    }

    fn check(&self, shapes: &[&[usize]]) -> Result<(), OpError> {
        expect_inputs(self.name(), shapes, 1)?;
        if shapes[0].last().is_none_or(|n| *n == 0) { Err(OpError::shape(self.name(), "x", shapes[0], "[…, 1 or more]")) } else { Ok(()) }
    }

    fn forward(&self, x: &[Values], _: &[bool]) -> Forward {
        let mut out = ValuesMut::any(x[0].shape());
        let n = x[0].shape()[x[0].shape().len() - 1];
        if self.logarithm {
            cpu::log_softmax(n, &x[0], &mut out)
        } else {
            cpu::softmax(n, &x[0], &mut out)
        }
        let out = out.freeze();
        Forward::one(out.clone(), Kept::of(&[out]))
    }

    fn backward(&self, kept: &Kept, d: &[Option<Values>], _: &[bool]) -> Vec<Option<Values>> {
        let y = &kept.values[0];
        let n = y.shape()[y.shape().len() - 1];
        vec![d[0].as_ref().map(|d| {
            let mut dx = ValuesMut::any(y.shape());
            if self.logarithm {
                cpu::log_softmax_backward(n, y, d, &mut dx)
            } else {
                cpu::softmax_backward(n, y, d, &mut dx)
            }
            dx.freeze()
        })]
    }

    fn by_burn(&self, x: &[DispatchTensor]) -> Option<Vec<DispatchTensor>> {
        Some(by_burn::softmax(x, self.logarithm))
    }
}

/// `eˣ / Σ eˣ` along the last axis.
pub fn softmax<const D: usize>(x: Tensor<D>) -> Result<Tensor<D>, OpError> {
    apply_one(SoftmaxOp { logarithm: false }, vec![x.into_dispatch()])
}

/// The logarithm of [`softmax`].
pub fn log_softmax<const D: usize>(x: Tensor<D>) -> Result<Tensor<D>, OpError> {
    apply_one(SoftmaxOp { logarithm: true }, vec![x.into_dispatch()])
}

#[derive(Clone, Debug)]
pub(super) struct CrossEntropyOp {
    pub(super) classes: Arc<[i64]>,
    pub(super) smoothing: f32,
}

impl CrossEntropyOp {
    fn targets(&self) -> Targets<'_> {
        Targets { classes: &self.classes, smoothing: self.smoothing, ignored: NO_CLASS }
    }
}

impl SliceOp for CrossEntropyOp {
    fn name(&self) -> &'static str {
        "cross entropy"
    }

    fn check(&self, shapes: &[&[usize]]) -> Result<(), OpError> {
        expect_inputs(self.name(), shapes, 1)?;
        expect_shape(self.name(), "logits", shapes[0], &[Some(self.classes.len()), None])?;
        let n = shapes[0][1] as i64;
        if let Some(c) = self.classes.iter().find(|c| !(0..n).contains(*c)) {
            return Err(OpError::settings(self.name(), format!("class {c} of {n}")));
        }
        if self.classes.is_empty() || !(0.0..=1.0).contains(&self.smoothing) {
            return Err(OpError::settings(self.name(), "expected rows, and a smoothing from 0 to 1"));
        }
        Ok(())
    }

    fn forward(&self, x: &[Values], _: &[bool]) -> Forward {
        let mut logs = ValuesMut::any(x[0].shape());
        let mut out = ValuesMut::any(&[1]);
        let mut losses = ValuesMut::any(&[self.classes.len()]);
        out[0] = cpu::cross_entropy(x[0].shape()[1], &x[0], &self.targets(), &mut logs, &mut losses);
        Forward::one(out.freeze(), Kept::of(&[logs.freeze()]))
    }

    fn backward(&self, kept: &Kept, d: &[Option<Values>], _: &[bool]) -> Vec<Option<Values>> {
        let logs = &kept.values[0];
        vec![d[0].as_ref().map(|d| {
            let mut dx = ValuesMut::any(logs.shape());
            cpu::cross_entropy_backward(logs.shape()[1], logs, &self.targets(), d[0], &mut dx);
            dx.freeze()
        })]
    }

    fn by_burn(&self, x: &[DispatchTensor]) -> Option<Vec<DispatchTensor>> {
        Some(by_burn::cross_entropy(x, &self.classes, self.smoothing))
    }
}

/// Mean cross entropy of logits with a class per row; `smoothing` spreads that share of a target over all classes.
///
/// # Shapes
/// logits `[M, classes]`; result `[1]`.
pub fn cross_entropy(logits: Tensor<2>, classes: &[i64], smoothing: f32) -> Result<Tensor<1>, OpError> {
    apply_one(CrossEntropyOp { classes: classes.into(), smoothing }, vec![logits.into_dispatch()])
}

#[derive(Clone, Debug)]
pub(super) struct MeanErrorOp(pub(super) Error);

impl SliceOp for MeanErrorOp {
    fn name(&self) -> &'static str {
        "mean error"
    }

    fn check(&self, shapes: &[&[usize]]) -> Result<(), OpError> {
        expect_inputs(self.name(), shapes, 2)?;
        let same: Vec<Option<usize>> = shapes[0].iter().map(|n| Some(*n)).collect();
        expect_shape(self.name(), "y", shapes[1], &same)
    }

    fn forward(&self, x: &[Values], _: &[bool]) -> Forward {
        let mut out = ValuesMut::any(&[1]);
        out[0] = mean_error::cpu::forward(self.0, &x[0], &x[1]);
        Forward::one(out.freeze(), Kept::of(x))
    }

    fn backward(&self, kept: &Kept, d: &[Option<Values>], wanted: &[bool]) -> Vec<Option<Values>> {
        let Some(d) = &d[0] else { return vec![None, None] };
        let [x, y] = [&kept.values[0], &kept.values[1]];
        let gradient = |d: f32| {
            let mut out = ValuesMut::any(x.shape());
            mean_error::cpu::backward(self.0, x, y, d, &mut out);
            out.freeze()
        };
        vec![wanted[0].then(|| gradient(d[0])), wanted[1].then(|| gradient(-d[0]))]
    }

    fn by_burn(&self, x: &[DispatchTensor]) -> Option<Vec<DispatchTensor>> {
        Some(by_burn::mean_error(x, self.0))
    }
}

/// The mean over all elements of an error of `x − y`.
///
/// # Shapes
/// x and y of one shape; result `[1]`.
pub fn mean_error<const D: usize>(kind: Error, x: Tensor<D>, y: Tensor<D>) -> Result<Tensor<1>, OpError> {
    apply_one(MeanErrorOp(kind), vec![x.into_dispatch(), y.into_dispatch()])
}
