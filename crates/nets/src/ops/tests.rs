//! Layers in the graph against the references of our ops, or central differences.

use super::*;
use crate::bridge::{pool, read_values};
use crate::param::{Kind, Mode, Param};
use burn::tensor::{Device, Tensor, TensorData};
use diorama_kernels::ops::{conv2d as conv_kernel, softmax as softmax_kernel};
use diorama_testkit::{assert_close, central_differences, random, wide};

fn leaf<const D: usize>(shape: [usize; D], seed: u64) -> Tensor<D> {
    let data = TensorData::new(random(shape.iter().product(), seed), shape);
    Tensor::from_data(data, &Device::flex().autodiff()).require_grad()
}

/// `Σ wᵢ tᵢ` for random `w`, by our kernels alone.
fn weighed<const D: usize>(t: Tensor<D>, seed: u64) -> Tensor<1> {
    let w = Tensor::<D>::from_data(TensorData::new(random(t.dims().iter().product(), seed), t.dims()), &Device::flex());
    (t * w).sum()
}

/// Compares gradients with central differences in f32, one input at a time.
fn assert_differences<const D: usize>(x: [usize; D], f: impl Fn(Tensor<D>) -> Tensor<1>) {
    let xt = leaf(x, 1);
    let g = read_values(xt.grad(&f(xt.clone()).backward()).unwrap());
    let at = |x: &[f64], shape: [usize; D]| {
        let data = TensorData::new(x.iter().map(|v| *v as f32).collect::<Vec<_>>(), shape);
        read_values(f(Tensor::from_data(data, &Device::flex())))[0] as f64
    };
    let want = central_differences(&wide(&read_values(xt)), 3e-3, |v| at(v, x));
    assert_close("gradient", &g, &want, 2e-2);
}

#[test]
fn sums_forks_and_joins_have_the_right_gradients() {
    let other = Tensor::<4>::from_data(TensorData::new(random(24, 5), [2, 3, 2, 2]), &Device::flex());
    assert_differences([2, 3, 2, 2], |x| weighed(add_relu(x, other.clone()).unwrap(), 2));
    assert_differences([2, 3, 2, 2], |x| weighed(add(x, other.clone()).unwrap(), 2));
    assert_differences([2, 3, 2, 2], |x| {
        let [a, b, c] = fork(x).unwrap();
        let twice = add(a, activation(b, Activation::Silu).unwrap()).unwrap();
        weighed(concat_channels(vec![twice, other.clone(), c]).unwrap(), 3)
    });
    assert_differences([2, 3, 2, 2], |x| weighed(to_tokens(x).unwrap(), 4));
    assert_differences([2, 3, 4], |x| weighed(heads(x, 2).unwrap(), 4));
    assert_differences([2, 3, 4], |x| weighed(merge_heads(heads(x, 2).unwrap(), 2).unwrap() * 2.0, 4));
    let scale = Tensor::<2>::from_data(TensorData::new(random(6, 6), [2, 3]), &Device::flex());
    assert_differences([2, 3, 2, 2], |x| weighed(modulate(x, scale.clone(), scale.clone()).unwrap(), 4));
    let image = Tensor::<4>::from_data(TensorData::new(random(24, 7), [2, 3, 2, 2]), &Device::flex());
    assert_differences([2, 3], |s| weighed(modulate(image.clone(), s, scale.clone()).unwrap(), 4));
    assert_differences([2, 3], |s| weighed(modulate(image.clone(), scale.clone(), s).unwrap(), 4));
}

#[test]
fn joined_layouts_are_permutations() {
    let x = leaf([2, 3, 2, 2], 1);
    assert_eq!(read_values(to_tokens(x.clone()).unwrap()), read_values(x.clone().permute([0, 2, 3, 1])));
    let t = leaf([2, 5, 6], 1);
    let by_heads = heads(t.clone(), 3).unwrap();
    assert_eq!(by_heads.dims(), [6, 5, 2]);
    assert_eq!(read_values(by_heads.clone()), read_values(t.clone().reshape([2, 5, 3, 2]).permute([0, 2, 1, 3])));
    assert_eq!(read_values(merge_heads(by_heads, 3).unwrap()), read_values(t.clone()));
    assert!(heads(t, 4).unwrap_err().to_string().contains("does not divide into 4 heads"));
    let joined = concat_channels(vec![x.clone(), leaf([2, 1, 2, 2], 2)]).unwrap();
    assert_eq!(read_values(joined), read_values(Tensor::cat(vec![x, leaf([2, 1, 2, 2], 2)], 1)));
}

#[test]
fn losses_have_the_right_gradients() {
    let y = Tensor::<2>::from_data(TensorData::new(random(12, 5), [3, 4]), &Device::flex());
    for kind in [Error::Squared, Error::Absolute, Error::Huber(0.2)] {
        assert_differences([3, 4], |x| mean_error(kind, x, y.clone()).unwrap());
        assert_differences([3, 4], |x| mean_error(kind, y.clone(), x).unwrap());
    }
    assert_differences([3, 4], |x| cross_entropy(x, &[0, 3, 1], 0.1).unwrap());
    assert_differences([3, 4], |x| weighed(softmax(x).unwrap(), 2));
    assert_differences([3, 4], |x| weighed(log_softmax(x).unwrap(), 2));
    assert!(cross_entropy(y.clone(), &[0, 4, 1], 0.0).unwrap_err().to_string().contains("class 4 of 4"));
    let want = softmax_kernel::reference::softmax(4, &wide(&read_values(y.clone())));
    assert_close("softmax", &read_values(softmax(y).unwrap()), &want, 1e-5);
}

#[test]
fn normalizations_have_the_right_gradients() {
    let vector = |n: usize, seed| Tensor::<1>::from_data(TensorData::new(random(n, seed), [n]), &Device::flex());
    let s = NormSettings { activation: Activation::Silu, ..NormSettings::default() };
    let running = || [0.1, 1.3].map(|v| Param::constant(Kind::Statistic, &[4], v, &Device::flex()));
    for mode in [Mode::Train, Mode::Eval] {
        let [mean, variance] = running();
        let norm = |x: Tensor<4>, scale, shift| {
            let statistics = BatchStatistics { mean: &mean, variance: &variance, momentum: 0.0 };
            weighed(batch_norm(x, scale, shift, statistics, s, mode).unwrap(), 2)
        };
        assert_differences([3, 4, 2, 2], |x| norm(x, vector(4, 3), vector(4, 4)));
        assert_differences([4], |scale| norm(leaf([3, 4, 2, 2], 9), scale, vector(4, 4)));
        assert_differences([4], |shift| norm(leaf([3, 4, 2, 2], 9), vector(4, 4), shift));
    }
    assert_differences([3, 4, 2, 2], |x| weighed(group_norm(x, vector(4, 3), vector(4, 4), 2, s).unwrap(), 2));
    assert_differences([3, 2, 5], |x| weighed(layer_norm(x, vector(5, 3), vector(5, 4), s).unwrap(), 2));
    let e = group_norm(leaf([3, 4, 2, 2], 9), vector(4, 3), vector(4, 4), 3, s).unwrap_err();
    assert_eq!(e.to_string(), "group norm: 4 channels do not divide into 3 groups");
}

#[test]
fn batch_norm_moves_the_running_statistics() {
    let [mean, variance] = [0.0, 1.0].map(|v| Param::constant(Kind::Statistic, &[2], v, &Device::flex()));
    let x = leaf([3, 2, 2, 2], 1);
    let ones = Tensor::<1>::ones([2], &Device::flex());
    let statistics = BatchStatistics { mean: &mean, variance: &variance, momentum: 0.1 };
    batch_norm(x.clone(), ones.clone(), ones, statistics, NormSettings::default(), Mode::Train).unwrap();
    let values = wide(&read_values(x));
    for c in 0..2 {
        let of: Vec<f64> = (0..3).flat_map(|n| values[(n * 2 + c) * 4..][..4].to_vec()).collect();
        let m = of.iter().sum::<f64>() / 12.0;
        let v = of.iter().map(|x| (x - m) * (x - m)).sum::<f64>() / 11.0;
        assert!((mean.values()[c] as f64 - 0.1 * m).abs() < 1e-6 && (variance.values()[c] as f64 - (0.9 + 0.1 * v)).abs() < 1e-6);
    }
}

#[test]
fn linear_and_embedding_have_the_right_gradients() {
    let w = Tensor::<2>::from_data(TensorData::new(random(15, 5), [5, 3]), &Device::flex());
    let b = Tensor::<1>::from_data(TensorData::new(random(3, 6), [3]), &Device::flex());
    for a in [Activation::None, Activation::Gelu, Activation::Sigmoid] {
        assert_differences([2, 4, 5], |x| weighed(linear(x, w.clone(), Some(b.clone()), a).unwrap(), 2));
        assert_differences([5, 3], |w| weighed(linear(leaf([2, 4, 5], 3), w, None, a).unwrap(), 2));
        assert_differences([3], |b| weighed(linear(leaf([2, 4, 5], 3), w.clone(), Some(b), a).unwrap(), 2));
    }
    assert_differences([4, 3], |t| weighed(embedding(t, &[1, 3, 1, 0]).unwrap(), 2));
    assert!(embedding(leaf([4, 3], 1), &[4]).unwrap_err().to_string().contains("row 4 of a table of 4"));
    assert!(linear(leaf([2, 4], 1), w, None, Activation::None).unwrap_err().to_string().contains("expected […, 5]"));
}

#[test]
fn convolutions_refuse_what_does_not_fit() {
    let x = leaf([1, 4, 5, 5], 1);
    let e = |w: [usize; 4], s: Conv| conv2d(x.clone(), leaf(w, 2), None, s).unwrap_err().to_string();
    assert_eq!(e([8, 3, 3, 3], Conv::same(3)), "conv2d: weight has shape [8, 3, 3, 3], expected [any, 4, any, any]");
    assert!(e([8, 4, 7, 7], Conv::default()).contains("room for a kernel that covers 7 pixels"));
    assert!(e([8, 4, 3, 3], Conv { groups: 3, ..Conv::same(3) }).contains("do not divide into 3 groups"));
    let c = conv_kernel::Conv2d { padding: [1; 2], activation: Activation::Relu, ..conv_kernel::Conv2d::new(4, 8, 3) };
    let got = conv2d(x.clone(), leaf([8, 4, 3, 3], 2), None, Conv::same(3).activation(Activation::Relu)).unwrap();
    let images = conv_kernel::Images { batch: 1, height: 5, width: 5 };
    let want = conv_kernel::reference::forward(&c, &images, &wide(&read_values(x)), &wide(&random(288, 2)), &[]);
    assert_close("conv2d", &read_values(got), &want, 1e-4);
}

#[test]
fn the_pool_is_told_about_every_buffer() {
    let before = pool::figures();
    let x = leaf([2, 3, 4, 4], 1);
    drop(add(x.clone(), x));
    let after = pool::figures();
    assert!(after.fresh + after.reused > before.fresh + before.reused);
}

/// What our kernels give and what burn's ops give, of an output and of the gradients of all inputs.
fn assert_by_burn(op: impl crate::bridge::SliceOp + Clone, shapes: &[&[usize]]) {
    use crate::bridge::apply;
    use burn::backend::ops::FloatTensorOps;
    let run = |by_burn: bool| {
        let leaves: Vec<Tensor<1>> = shapes.iter().enumerate().map(|(i, s)| leaf([s.iter().product()], 30 + i as u64)).collect();
        let shaped = |(t, s): (&Tensor<1>, &&[usize])| {
            burn::backend::Dispatch::float_reshape(t.clone().into_dispatch(), burn::tensor::Shape::from(s.to_vec()))
        };
        let inputs: Vec<_> = leaves.iter().zip(shapes).map(shaped).collect();
        let outputs = if by_burn { op.by_burn(&inputs).unwrap() } else { apply(op.clone(), inputs).unwrap() };
        let out = Tensor::<1>::from_dispatch(outputs.into_iter().next().unwrap());
        let n: usize = out.shape().iter().product();
        let out = out.reshape([n]);
        let grads = weighed(out.clone(), 60).backward();
        let mut all = vec![read_values(out)];
        all.extend(leaves.iter().map(|l| l.grad(&grads).map_or(Vec::new(), read_values)));
        all
    };
    for (i, (ours, theirs)) in run(false).into_iter().zip(run(true)).enumerate() {
        assert_close(&format!("{} result {i}", op.name()), &ours, &wide(&theirs), 1e-4);
    }
}

#[test]
fn burns_own_ops_give_the_same() {
    let image: &[usize] = &[2, 4, 6, 5];
    let f = Activation::Silu;
    for groups in [1, 2] {
        let settings = Conv { groups, ..Conv::same(3).stride(2) }.activation(Activation::Silu);
        assert_by_burn(conv::ConvOp(settings), &[image, &[6, 4 / groups, 3, 3], &[6]]);
        let settings = Conv { output_padding: [1; 2], ..settings }.activation(Activation::Gelu);
        assert_by_burn(conv_transpose::ConvTransposeOp(settings), &[image, &[4, 6 / groups, 3, 3], &[6]]);
    }
    assert_by_burn(elementwise::ActivationOp(Activation::Gelu), &[image]);
    assert_by_burn(elementwise::SumOp { relu: true }, &[image, image]);
    assert_by_burn(elementwise::ModulateOp, &[image, &[2, 4], &[2, 4]]);
    let settings = NormSettings { activation: f, ..NormSettings::default() };
    assert_by_burn(norm::NormOp::new(diorama_kernels::ops::norm::Over::Batch, settings), &[image, &[4], &[4]]);
    assert_by_burn(norm::NormOp::new(diorama_kernels::ops::norm::Over::Groups(2), settings), &[image, &[4], &[4]]);
    assert_by_burn(norm::LayerNormOp(settings), &[&[3, 7, 5], &[5], &[5]]);
    assert_by_burn(loss::SoftmaxOp { logarithm: true }, &[&[3, 7]]);
    assert_by_burn(loss::SoftmaxOp { logarithm: false }, &[&[3, 7]]);
    assert_by_burn(loss::CrossEntropyOp { classes: [2, 0, 6].into(), smoothing: 0.1 }, &[&[3, 7]]);
    for kind in [Error::Squared, Error::Absolute, Error::Huber(0.3)] {
        assert_by_burn(loss::MeanErrorOp(kind), &[image, image]);
    }
    assert_by_burn(sample::MaxPoolOp(Pool { kernel: [3; 2], stride: [2; 2], padding: [1; 2], ceil_mode: false }), &[image]);
    assert_by_burn(sample::GlobalAverageOp, &[image]);
    assert_by_burn(sample::ShuffleOp(2), &[image]);
    assert_by_burn(join::ConcatOp { channels: vec![4, 3] }, &[image, &[2, 3, 6, 5]]);
    assert_by_burn(join::SplitOp { heads: 2 }, &[&[2, 5, 18]]);
    assert_by_burn(join::ClassTokenOp, &[&[2, 5, 4], &[1, 1, 4], &[1, 6, 4]]);
    assert_by_burn(attention::AttentionOp { causal: false }, &[&[3, 5, 4], &[3, 6, 4], &[3, 6, 4]]);
    assert_by_burn(attention::AttentionOp { causal: true }, &[&[3, 5, 4], &[3, 5, 4], &[3, 5, 4]]);
    assert_by_burn(embedding::EmbeddingOp { indices: [1, 3, 1].into() }, &[&[4, 3]]);
}
