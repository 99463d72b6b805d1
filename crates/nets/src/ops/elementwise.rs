//! Activations, sums of branches, and tensors that several layers read.

use super::Activation;
use super::by_burn;
use crate::bridge::{Forward, Kept, OpError, SliceOp, Values, ValuesMut, apply, apply_one, expect_inputs, expect_shape};
use burn::backend::DispatchTensor;
use burn::tensor::Tensor;
use diorama_kernels::ops::activation::cpu as activations;
use diorama_kernels::ops::sum::cpu as sums;
use rayon::prelude::*;

#[derive(Clone, Debug)]
pub(super) struct ActivationOp(pub(super) Activation);

impl SliceOp for ActivationOp {
    fn name(&self) -> &'static str {
        "activation"
    }

    fn check(&self, shapes: &[&[usize]]) -> Result<(), OpError> {
        expect_inputs(self.name(), shapes, 1)
    }

    fn forward(&self, x: &[Values], _: &[bool]) -> Forward {
        let mut out = ValuesMut::any(x[0].shape());
        activations::forward(self.0, &x[0], &mut out);
        Forward::one(out.freeze(), Kept::of(x))
    }

    fn backward(&self, kept: &Kept, d: &[Option<Values>], _: &[bool]) -> Vec<Option<Values>> {
        let x = &kept.values[0];
        vec![d[0].as_ref().map(|d| {
            let mut dx = ValuesMut::any(x.shape());
            activations::backward(self.0, x, d, &mut dx);
            dx.freeze()
        })]
    }

    fn by_burn(&self, x: &[DispatchTensor]) -> Option<Vec<DispatchTensor>> {
        Some(by_burn::activation(x, self.0))
    }
}

/// `f(x)`, element by element.
pub fn activation<const D: usize>(x: Tensor<D>, f: Activation) -> Result<Tensor<D>, OpError> {
    if f == Activation::None { Ok(x) } else { apply_one(ActivationOp(f), vec![x.into_dispatch()]) }
}

#[derive(Clone, Debug)]
pub(super) struct SumOp {
    pub(super) relu: bool,
}

impl SliceOp for SumOp {
    fn name(&self) -> &'static str {
        "sum"
    }

    fn check(&self, shapes: &[&[usize]]) -> Result<(), OpError> {
        expect_inputs(self.name(), shapes, 2)?;
        let same: Vec<Option<usize>> = shapes[0].iter().map(|n| Some(*n)).collect();
        expect_shape(self.name(), "the second term", shapes[1], &same)
    }

    fn forward(&self, x: &[Values], _: &[bool]) -> Forward {
        let mut out = ValuesMut::any(x[0].shape());
        sums::forward(&x[0], &x[1], self.relu, &mut out);
        let out = out.freeze();
        let kept = if self.relu { Kept::of(std::slice::from_ref(&out)) } else { Kept::default() };
        Forward::one(out, kept)
    }

    fn backward(&self, kept: &Kept, d: &[Option<Values>], _: &[bool]) -> Vec<Option<Values>> {
        let Some(d) = &d[0] else { return vec![None, None] };
        let both = kept.values.first().map_or_else(
            || d.clone(),
            |y| {
                let mut out = ValuesMut::any(y.shape());
                sums::backward_relu(y, d, &mut out);
                out.freeze()
            },
        );
        vec![Some(both.clone()), Some(both)]
    }

    fn by_burn(&self, x: &[DispatchTensor]) -> Option<Vec<DispatchTensor>> {
        Some(by_burn::sum(x, self.relu))
    }
}

/// `a + b` of one shape.
pub fn add<const D: usize>(a: Tensor<D>, b: Tensor<D>) -> Result<Tensor<D>, OpError> {
    apply_one(SumOp { relu: false }, vec![a.into_dispatch(), b.into_dispatch()])
}

/// `max(a + b, 0)` of one shape, as at the end of a residual block.
pub fn add_relu<const D: usize>(a: Tensor<D>, b: Tensor<D>) -> Result<Tensor<D>, OpError> {
    apply_one(SumOp { relu: true }, vec![a.into_dispatch(), b.into_dispatch()])
}

#[derive(Clone, Debug)]
pub(super) struct ForkOp(pub(super) usize);

impl SliceOp for ForkOp {
    fn name(&self) -> &'static str {
        "fork"
    }

    fn check(&self, shapes: &[&[usize]]) -> Result<(), OpError> {
        expect_inputs(self.name(), shapes, 1)
    }

    fn forward(&self, x: &[Values], _: &[bool]) -> Forward {
        Forward { outputs: vec![x[0].clone(); self.0], kept: Kept::default() }
    }

    fn backward(&self, _: &Kept, d: &[Option<Values>], _: &[bool]) -> Vec<Option<Values>> {
        let sum = |a: Values, b: &Values| {
            let mut out = ValuesMut::any(a.shape());
            sums::forward(&a, b, false, &mut out);
            out.freeze()
        };
        let mut parts = d.iter().flatten();
        vec![parts.next().cloned().map(|first| parts.fold(first, sum))]
    }

    fn by_burn(&self, x: &[DispatchTensor]) -> Option<Vec<DispatchTensor>> {
        Some(vec![x[0].clone(); self.0])
    }
}

/// `N` readers of a tensor, whose memory they share; where no gradient is recorded, nothing is.
pub fn fork<const N: usize, const D: usize>(x: Tensor<D>) -> Result<[Tensor<D>; N], OpError> {
    if !x.is_tracked() {
        return Ok(std::array::from_fn(|_| x.clone()));
    }
    let mut out = apply(ForkOp(N), vec![x.into_dispatch()])?.into_iter();
    Ok(std::array::from_fn(|_| Tensor::from_dispatch(out.next().expect("as many outputs as readers"))))
}

/// Scale and shift per image and channel.
#[derive(Clone, Debug)]
pub(super) struct ModulateOp;

impl SliceOp for ModulateOp {
    fn name(&self) -> &'static str {
        "modulate"
    }

    fn check(&self, shapes: &[&[usize]]) -> Result<(), OpError> {
        expect_inputs(self.name(), shapes, 3)?;
        expect_shape(self.name(), "x", shapes[0], &[None, None, None, None])?;
        let planes = [Some(shapes[0][0]), Some(shapes[0][1])];
        expect_shape(self.name(), "scale", shapes[1], &planes)?;
        expect_shape(self.name(), "shift", shapes[2], &planes)
    }

    fn forward(&self, x: &[Values], _: &[bool]) -> Forward {
        let places = x[0].shape()[2] * x[0].shape()[3];
        let mut out = ValuesMut::any(x[0].shape());
        if places > 0 {
            let planes = out.par_chunks_exact_mut(places).zip(x[0].par_chunks_exact(places)).zip(x[1].par_iter()).zip(x[2].par_iter());
            planes.for_each(|(((o, x), scale), shift)| o.iter_mut().zip(x).for_each(|(o, x)| *o = x * (1.0 + scale) + shift));
        }
        Forward::one(out.freeze(), Kept::of(&x[..2]))
    }

    fn backward(&self, kept: &Kept, d: &[Option<Values>], _: &[bool]) -> Vec<Option<Values>> {
        let Some(d) = &d[0] else { return vec![None; 3] };
        let [x, scale] = [&kept.values[0], &kept.values[1]];
        let places = (x.shape()[2] * x.shape()[3]).max(1);
        let (mut dx, mut ds, mut dt) = (ValuesMut::any(x.shape()), ValuesMut::zeros(scale.shape()), ValuesMut::zeros(scale.shape()));
        let planes = dx.par_chunks_exact_mut(places).zip(x.par_chunks_exact(places)).zip(d.par_chunks_exact(places));
        let planes = planes.zip(scale.par_iter()).zip(ds.par_iter_mut()).zip(dt.par_iter_mut());
        planes.for_each(|(((((dx, x), d), scale), ds), dt)| {
            let (mut along, mut sum) = (0.0f64, 0.0f64);
            for ((dx, x), d) in dx.iter_mut().zip(x).zip(d) {
                *dx = d * (1.0 + scale);
                along += (d * x) as f64;
                sum += *d as f64;
            }
            (*ds, *dt) = (along as f32, sum as f32);
        });
        vec![Some(dx.freeze()), Some(ds.freeze()), Some(dt.freeze())]
    }

    fn by_burn(&self, x: &[DispatchTensor]) -> Option<Vec<DispatchTensor>> {
        Some(by_burn::modulate(x))
    }
}

/// `x (1 + scale) + shift`, with a scale and a shift per image and channel.
///
/// # Shapes
/// x `[N, C, H, W]`; scale, shift `[N, C]`.
pub fn modulate(x: Tensor<4>, scale: Tensor<2>, shift: Tensor<2>) -> Result<Tensor<4>, OpError> {
    apply_one(ModulateOp, vec![x.into_dispatch(), scale.into_dispatch(), shift.into_dispatch()])
}
