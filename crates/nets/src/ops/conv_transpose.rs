//! Transposed convolution of images, with bias and activation.

use super::by_burn;
use super::conv::{Wanted, bias, check_conv};
use super::{Activation, Conv};
use crate::bridge::work;
use crate::bridge::{Forward, Kept, OpError, SliceOp, Values, ValuesMut, apply_one};
use burn::backend::DispatchTensor;
use burn::tensor::Tensor;
use diorama_kernels::ops::conv_transpose2d::{self, ConvTranspose2d};
use diorama_kernels::ops::conv2d::Images;

#[derive(Clone, Debug)]
pub(super) struct ConvTransposeOp(pub(super) Conv);

impl ConvTransposeOp {
    fn conv(&self, x: &[usize], w: &[usize]) -> (ConvTranspose2d, Images) {
        let s = &self.0;
        let conv = ConvTranspose2d {
            channels_in: x[1],
            channels_out: w[1] * s.groups,
            kernel: [w[2], w[3]],
            stride: s.stride,
            padding: s.padding,
            output_padding: s.output_padding,
            dilation: s.dilation,
            groups: s.groups,
            activation: s.activation,
        };
        (conv, Images { batch: x[0], height: x[2], width: x[3] })
    }
}

impl SliceOp for ConvTransposeOp {
    fn name(&self) -> &'static str {
        "conv_transpose2d"
    }

    fn check(&self, shapes: &[&[usize]]) -> Result<(), OpError> {
        let s = &self.0;
        check_conv(self.name(), s, shapes, true)?;
        for axis in 0..2 {
            if s.output_padding[axis] >= s.stride[axis].max(s.dilation[axis]) {
                return Err(OpError::settings(self.name(), "the output's padding is less than the stride or the dilation"));
            }
            let grown = (shapes[0][2 + axis].max(1) - 1) * s.stride[axis] + s.dilation[axis] * (shapes[1][2 + axis].max(1) - 1) + 1;
            if shapes[1][2 + axis] == 0 || grown + s.output_padding[axis] <= 2 * s.padding[axis] {
                return Err(OpError::settings(self.name(), "the padding leaves nothing of the output"));
            }
        }
        Ok(())
    }

    fn forward(&self, x: &[Values], wanted: &[bool]) -> Forward {
        let (conv, images) = self.conv(x[0].shape(), x[1].shape());
        let o = conv.output(&images);
        work::book(images.batch * images.pixels() * conv.weights_len());
        let shape = [o.batch, conv.channels_out, o.height, o.width];
        let mut out = ValuesMut::any(&shape);
        let mut before = (wanted.contains(&true) && self.0.activation.needs_input()).then(|| ValuesMut::any(&shape));
        conv_transpose2d::cpu::forward(&conv, &images, &x[0], &x[1], bias(x), &mut out, before.as_deref_mut());
        let out = out.freeze();
        let mut kept = vec![x[0].clone(), x[1].clone()];
        if self.0.activation != Activation::None {
            kept.push(before.map_or_else(|| out.clone(), ValuesMut::freeze));
        }
        Forward::one(out, if wanted.contains(&true) { Kept::of(&kept) } else { Kept::default() })
    }

    fn backward(&self, kept: &Kept, d: &[Option<Values>], wanted: &[bool]) -> Vec<Option<Values>> {
        let Some(d) = &d[0] else { return vec![None; wanted.len()] };
        let [x, w] = [&kept.values[0], &kept.values[1]];
        let (conv, images) = self.conv(x.shape(), w.shape());
        let mut out = Wanted::new(wanted, [x.shape(), w.shape(), &[conv.channels_out]]);
        let values = kept.values.get(2).map_or(&d[..], |k| &k[..]);
        conv_transpose2d::cpu::backward(&conv, &images, x, w, values, d, out.destinations());
        out.freeze(wanted.len())
    }

    fn by_burn(&self, x: &[DispatchTensor]) -> Option<Vec<DispatchTensor>> {
        Some(by_burn::conv_transpose2d(x, &self.0))
    }
}

/// The transpose of [`super::conv2d()`] in x, with bias and activation.
///
/// # Shapes
/// x `[N, C, H, W]`; weight `[C, C' / groups, h, w]`; bias `[C']`.
pub fn conv_transpose2d(x: Tensor<4>, weight: Tensor<4>, bias: Option<Tensor<1>>, settings: Conv) -> Result<Tensor<4>, OpError> {
    let mut inputs = vec![x.into_dispatch(), weight.into_dispatch()];
    inputs.extend(bias.map(|b| b.into_dispatch()));
    apply_one(ConvTransposeOp(settings), inputs)
}
