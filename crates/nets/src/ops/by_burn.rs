//! The same layers by burn's own ops, for devices where our kernels do not run. Shapes were checked before.

use super::{Activation, Conv, Error};
use burn::backend::DispatchTensor;
use burn::backend::ops::FloatTensorOps;
use burn::backend::{Dispatch, TensorMetadata};
use burn::tensor::ops::{AttentionModuleOptions, ConvOptions, ConvTransposeOptions, MaxPoolOptions};
use burn::tensor::{Int, Shape, Tensor, TensorData, activation, module};
use diorama_kernels::ops::pool::Pool;

/// What an op takes and gives.
pub(super) type Tensors = Vec<DispatchTensor>;

fn of<const D: usize>(x: &DispatchTensor) -> Tensor<D> {
    Tensor::from_dispatch(x.clone())
}

fn one<const D: usize>(x: Tensor<D>) -> Tensors {
    vec![x.into_dispatch()]
}

fn reshaped(x: DispatchTensor, shape: &[usize]) -> DispatchTensor {
    Dispatch::float_reshape(x, Shape::from(shape.to_vec()))
}

/// The shape of a tensor of any rank.
fn shape_of(x: &DispatchTensor) -> Vec<usize> {
    x.shape().iter().copied().collect()
}

/// Rows of the last axis.
fn rows(x: &DispatchTensor) -> Tensor<2> {
    let shape = shape_of(x);
    let n = shape.last().copied().unwrap_or(1);
    Tensor::from_dispatch(reshaped(x.clone(), &[shape.iter().product::<usize>() / n.max(1), n]))
}

fn activated<const D: usize>(x: Tensor<D>, f: Activation) -> Tensor<D> {
    match f {
        Activation::None => x,
        Activation::Relu => activation::relu(x),
        Activation::LeakyRelu(slope) => activation::leaky_relu(x, slope as f64),
        Activation::Softplus => activation::softplus(x, 1.0),
        Activation::Sigmoid => activation::sigmoid(x),
        Activation::Tanh => activation::tanh(x),
        Activation::Silu => activation::silu(x),
        Activation::Gelu => activation::gelu(x),
        Activation::GeluTanh => activation::gelu_approximate(x),
    }
}

/// Elementwise ops, for which the shape does not matter.
pub(super) fn activation(x: &[DispatchTensor], f: Activation) -> Tensors {
    let shape = shape_of(&x[0]);
    vec![reshaped(activated(rows(&x[0]), f).into_dispatch(), &shape)]
}

pub(super) fn sum(x: &[DispatchTensor], relu: bool) -> Tensors {
    let shape = shape_of(&x[0]);
    let sum = rows(&x[0]) + rows(&x[1]);
    vec![reshaped(if relu { activation::relu(sum) } else { sum }.into_dispatch(), &shape)]
}

pub(super) fn modulate(x: &[DispatchTensor]) -> Tensors {
    let [n, c] = of::<2>(&x[1]).dims();
    one(of::<4>(&x[0]) * (of::<2>(&x[1]).reshape([n, c, 1, 1]) + 1.0) + of::<2>(&x[2]).reshape([n, c, 1, 1]))
}

pub(super) fn conv2d(x: &[DispatchTensor], s: &Conv) -> Tensors {
    let options = ConvOptions::new(s.stride, s.padding, s.dilation, s.groups);
    one(activated(module::conv2d(of(&x[0]), of(&x[1]), x.get(2).map(of), options), s.activation))
}

pub(super) fn conv_transpose2d(x: &[DispatchTensor], s: &Conv) -> Tensors {
    let options = ConvTransposeOptions::new(s.stride, s.padding, s.output_padding, s.dilation, s.groups);
    one(activated(module::conv_transpose2d(of(&x[0]), of(&x[1]), x.get(2).map(of), options), s.activation))
}

/// By moments of the axes after the first two of `[sets, count]`.
fn normalized(x: Tensor<3>, epsilon: f32) -> Tensor<3> {
    let centered = x.clone() - x.mean_dim(2);
    let variance = (centered.clone() * centered.clone()).mean_dim(2);
    centered / (variance + epsilon).sqrt()
}

/// Scales and shifts channels of `[N, C, L]`.
fn affine(x: Tensor<3>, scale: &DispatchTensor, shift: &DispatchTensor) -> Tensor<3> {
    let c = x.dims()[1];
    x * of::<1>(scale).reshape([1, c, 1]) + of::<1>(shift).reshape([1, c, 1])
}

/// Batch normalization; the batch's mean and variance, where they were not given, follow the output.
pub(super) fn batch_norm(x: &[DispatchTensor], epsilon: f32, f: Activation) -> Tensors {
    let shape = shape_of(&x[0]);
    let flat = Tensor::<3>::from_dispatch(reshaped(x[0].clone(), &[shape[0], shape[1], shape[2..].iter().product()]));
    let (out, found) = if x.len() == 5 {
        (module::batch_norm(flat, of(&x[1]), of(&x[2]), of(&x[3]), of(&x[4]), epsilon as f64), Vec::new())
    } else {
        let r = module::batch_norm_train(flat, of(&x[1]), of(&x[2]), epsilon as f64);
        (r.output, vec![r.mean.into_dispatch(), r.variance.into_dispatch()])
    };
    let out = reshaped(activated(out, f).into_dispatch(), &shape);
    std::iter::once(out).chain(found).collect()
}

pub(super) fn group_norm(x: &[DispatchTensor], groups: usize, epsilon: f32, f: Activation) -> Tensors {
    let shape = shape_of(&x[0]);
    let (n, c, places) = (shape[0], shape[1], shape[2..].iter().product::<usize>());
    let by_group = Tensor::<3>::from_dispatch(reshaped(x[0].clone(), &[n, groups, c / groups * places]));
    let out = affine(normalized(by_group, epsilon).reshape([n, c, places]), &x[1], &x[2]);
    vec![reshaped(activated(out, f).into_dispatch(), &shape)]
}

pub(super) fn layer_norm(x: &[DispatchTensor], epsilon: f32, f: Activation) -> Tensors {
    let shape = shape_of(&x[0]);
    let out = module::layer_norm(rows(&x[0]), of(&x[1]), Some(of(&x[2])), epsilon as f64);
    vec![reshaped(activated(out, f).into_dispatch(), &shape)]
}

pub(super) fn softmax(x: &[DispatchTensor], logarithm: bool) -> Tensors {
    let shape = shape_of(&x[0]);
    let rows = rows(&x[0]);
    let out = if logarithm { activation::log_softmax(rows, 1) } else { activation::softmax(rows, 1) };
    vec![reshaped(out.into_dispatch(), &shape)]
}

pub(super) fn cross_entropy(x: &[DispatchTensor], classes: &[i64], smoothing: f32) -> Tensors {
    let logits = of::<2>(&x[0]);
    let [m, n] = logits.dims();
    let share = smoothing / n as f32;
    let at = |i: usize, c: usize| share + if classes[i] == c as i64 { 1.0 - smoothing } else { 0.0 };
    let targets: Vec<f32> = (0..m * n).map(|i| at(i / n, i % n)).collect();
    let targets = Tensor::<2>::from_data(TensorData::new(targets, [m, n]), &logits.device());
    one(activation::log_softmax(logits, 1).mul(targets).sum().neg() / m as f32)
}

pub(super) fn mean_error(x: &[DispatchTensor], kind: Error) -> Tensors {
    let e = rows(&x[0]) - rows(&x[1]);
    one(match kind {
        Error::Squared => (e.clone() * e).mean(),
        Error::Absolute => e.abs().mean(),
        Error::Huber(d) => {
            let near = e.clone().abs().clamp_max(d);
            (near.clone() * (e.abs() - near * 0.5)).mean()
        }
    })
}

pub(super) fn max_pool(x: &[DispatchTensor], pool: &Pool) -> Tensors {
    let mut options = MaxPoolOptions::new(pool.kernel);
    (options.stride, options.padding, options.ceil_mode) = (pool.stride, pool.padding.map(|p| (p, p)), pool.ceil_mode);
    one(module::max_pool2d(of(&x[0]), options))
}

pub(super) fn global_average(x: &[DispatchTensor]) -> Tensors {
    let x = of::<4>(&x[0]);
    let [n, c, h, w] = x.dims();
    one(x.reshape([n, c, h * w]).mean_dim(2).reshape([n, c]))
}

pub(super) fn pixel_shuffle(x: &[DispatchTensor], r: usize) -> Tensors {
    let x = of::<4>(&x[0]);
    let [n, c, h, w] = x.dims();
    let c = c / (r * r);
    one(x.reshape([n, c, r, r, h, w]).permute([0, 1, 4, 2, 5, 3]).reshape([n, c, h * r, w * r]))
}

pub(super) fn concat(x: &[DispatchTensor]) -> Tensors {
    one(Tensor::cat(x.iter().map(of::<4>).collect(), 1))
}

/// `[A, B, C, D]` to `[A, C, B, D]`, in another shape of as many numbers.
pub(super) fn swap(x: &[DispatchTensor], from: [usize; 4], to: &[usize]) -> Tensors {
    let swapped = Tensor::<4>::from_dispatch(reshaped(x[0].clone(), &from)).swap_dims(1, 2);
    vec![reshaped(swapped.into_dispatch(), to)]
}

pub(super) fn split_heads(x: &[DispatchTensor], heads: usize) -> Tensors {
    let x = of::<3>(&x[0]);
    let [n, t, width] = x.dims();
    let k = width / (3 * heads);
    let parts = x.reshape([n, t, 3, heads, k]).permute([2, 0, 3, 1, 4]);
    (0..3).map(|i| parts.clone().narrow(0, i, 1).reshape([n * heads, t, k]).into_dispatch()).collect()
}

pub(super) fn class_token(x: &[DispatchTensor]) -> Tensors {
    let (tokens, class) = (of::<3>(&x[0]), of::<3>(&x[1]));
    let [n, _, width] = tokens.dims();
    one(Tensor::cat(vec![class.expand([n, 1, width]), tokens], 1) + of::<3>(&x[2]))
}

pub(super) fn attention(x: &[DispatchTensor], causal: bool) -> Tensors {
    let by_head = |x: &DispatchTensor| {
        let x = of::<3>(x);
        let [b, t, k] = x.dims();
        x.reshape([b, 1, t, k])
    };
    let options = AttentionModuleOptions { is_causal: causal, ..AttentionModuleOptions::default() };
    let out = module::attention(by_head(&x[0]), by_head(&x[1]), by_head(&x[2]), None, None, options);
    let [b, _, t, k] = out.dims();
    one(out.reshape([b, t, k]))
}

pub(super) fn embedding(x: &[DispatchTensor], indices: &[i64]) -> Tensors {
    let table = of::<2>(&x[0]);
    let indices = Tensor::<1, Int>::from_data(TensorData::new(indices.to_vec(), [indices.len()]), &table.device());
    one(table.select(0, indices))
}
