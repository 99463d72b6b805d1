//! Convolution and transposed convolution of images, with bias and activation.

use super::Activation;
use super::by_burn;
use crate::bridge::work;
use crate::bridge::{Forward, Kept, OpError, SliceOp, Values, ValuesMut, apply_one, expect_inputs, expect_shape};
use burn::backend::DispatchTensor;
use burn::tensor::Tensor;
use diorama_kernels::ops::conv2d::{self, Conv2d, Gradients, Images};

/// How a kernel moves over an image; pairs are (vertical, horizontal).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Conv {
    pub stride: [usize; 2],
    pub padding: [usize; 2],
    pub dilation: [usize; 2],
    pub groups: usize,
    /// Rows and columns that a transposed convolution adds at the far borders.
    pub output_padding: [usize; 2],
    pub activation: Activation,
}

impl Default for Conv {
    fn default() -> Self {
        let one = [1; 2];
        Conv { stride: one, padding: [0; 2], dilation: one, groups: 1, output_padding: [0; 2], activation: Activation::None }
    }
}

impl Conv {
    /// A padding that keeps the size of an odd kernel without stride.
    pub fn same(kernel: usize) -> Conv {
        Conv { padding: [kernel / 2; 2], ..Conv::default() }
    }

    pub fn stride(self, stride: usize) -> Conv {
        Conv { stride: [stride; 2], ..self }
    }

    pub fn activation(self, activation: Activation) -> Conv {
        Conv { activation, ..self }
    }
}

#[derive(Clone, Debug)]
pub(super) struct ConvOp(pub(super) Conv);

impl ConvOp {
    fn conv(&self, x: &[usize], w: &[usize]) -> (Conv2d, Images) {
        let s = &self.0;
        let conv = Conv2d {
            channels_in: x[1],
            channels_out: w[0],
            kernel: [w[2], w[3]],
            stride: s.stride,
            padding: s.padding,
            dilation: s.dilation,
            groups: s.groups,
            activation: s.activation,
        };
        (conv, Images { batch: x[0], height: x[2], width: x[3] })
    }
}

/// Checks what both kinds of convolution share; `per_group` and `out` are the places of channels in the weights' shape.
pub(super) fn check_conv(op: &'static str, s: &Conv, shapes: &[&[usize]], transposed: bool) -> Result<(), OpError> {
    if shapes.len() != 2 {
        expect_inputs(op, shapes, 3)?;
    }
    let (x, w) = (shapes[0], shapes[1]);
    expect_shape(op, "x", x, &[None, None, None, None])?;
    if s.groups == 0 || s.stride.contains(&0) || s.dilation.contains(&0) {
        return Err(OpError::settings(op, "groups, stride and dilation are at least 1"));
    }
    if !x[1].is_multiple_of(s.groups) {
        return Err(OpError::settings(op, format!("{} channels do not divide into {} groups", x[1], s.groups)));
    }
    let out = if transposed {
        expect_shape(op, "weight", w, &[Some(x[1]), None, None, None])?;
        w[1] * s.groups
    } else {
        expect_shape(op, "weight", w, &[None, Some(x[1] / s.groups), None, None])?;
        if !w[0].is_multiple_of(s.groups) {
            return Err(OpError::settings(op, format!("{} channels do not divide into {} groups", w[0], s.groups)));
        }
        for axis in 0..2 {
            let (room, reach) = (x[2 + axis] + 2 * s.padding[axis], s.dilation[axis] * w[2 + axis].saturating_sub(1) + 1);
            if w[2 + axis] == 0 || room < reach {
                return Err(OpError::shape(op, "x", x, format!("room for a kernel that covers {reach} pixels")));
            }
        }
        w[0]
    };
    shapes.get(2).map_or(Ok(()), |b| expect_shape(op, "bias", b, &[Some(out)]))
}

/// The bias of an op's inputs; empty without one.
pub(super) fn bias(inputs: &[Values]) -> &[f32] {
    inputs.get(2).map_or(&[], |b| &b[..])
}

/// Destinations for the gradients that are wanted.
pub(super) struct Wanted([Option<ValuesMut>; 3]);

impl Wanted {
    pub(super) fn new(wanted: &[bool], shapes: [&[usize]; 3]) -> Wanted {
        Wanted(std::array::from_fn(|i| wanted.get(i).is_some_and(|w| *w).then(|| ValuesMut::any(shapes[i]))))
    }

    pub(super) fn destinations(&mut self) -> Gradients<'_> {
        let [input, weights, bias] = &mut self.0;
        Gradients { input: input.as_deref_mut(), weights: weights.as_deref_mut(), bias: bias.as_deref_mut() }
    }

    pub(super) fn freeze(self, count: usize) -> Vec<Option<Values>> {
        self.0.into_iter().take(count).map(|v| v.map(ValuesMut::freeze)).collect()
    }
}

impl SliceOp for ConvOp {
    fn name(&self) -> &'static str {
        "conv2d"
    }

    fn check(&self, shapes: &[&[usize]]) -> Result<(), OpError> {
        check_conv(self.name(), &self.0, shapes, false)
    }

    fn forward(&self, x: &[Values], wanted: &[bool]) -> Forward {
        let (conv, images) = self.conv(x[0].shape(), x[1].shape());
        let o = conv.output(&images);
        work::book(o.batch * o.pixels() * conv.weights_len());
        let shape = [o.batch, conv.channels_out, o.height, o.width];
        let mut out = ValuesMut::any(&shape);
        let mut before = (wanted.contains(&true) && self.0.activation.needs_input()).then(|| ValuesMut::any(&shape));
        conv2d::cpu::forward(&conv, &images, &x[0], &x[1], bias(x), &mut out, before.as_deref_mut());
        let out = out.freeze();
        if !wanted.contains(&true) {
            return Forward::one(out, Kept::default());
        }
        let mut kept = vec![x[0].clone(), x[1].clone()];
        if self.0.activation != Activation::None {
            kept.push(before.map_or_else(|| out.clone(), ValuesMut::freeze));
        }
        Forward::one(out, Kept::of(&kept))
    }

    fn backward(&self, kept: &Kept, d: &[Option<Values>], wanted: &[bool]) -> Vec<Option<Values>> {
        let Some(d) = &d[0] else { return vec![None; wanted.len()] };
        let [x, w] = [&kept.values[0], &kept.values[1]];
        let (conv, images) = self.conv(x.shape(), w.shape());
        let mut out = Wanted::new(wanted, [x.shape(), w.shape(), &[conv.channels_out]]);
        let values = kept.values.get(2).map_or(&d[..], |k| &k[..]);
        conv2d::cpu::backward(&conv, &images, x, w, values, d, out.destinations());
        out.freeze(wanted.len())
    }

    fn by_burn(&self, x: &[DispatchTensor]) -> Option<Vec<DispatchTensor>> {
        Some(by_burn::conv2d(x, &self.0))
    }
}

/// `act(w ∗ x + b)`
///
/// # Shapes
/// x `[N, C, H, W]`; weight `[C', C / groups, h, w]`; bias `[C']`.
pub fn conv2d(x: Tensor<4>, weight: Tensor<4>, bias: Option<Tensor<1>>, settings: Conv) -> Result<Tensor<4>, OpError> {
    let mut inputs = vec![x.into_dispatch(), weight.into_dispatch()];
    inputs.extend(bias.map(|b| b.into_dispatch()));
    apply_one(ConvOp(settings), inputs)
}
