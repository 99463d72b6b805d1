//! The bridge from our ops to burn's autodiff: any op on slices becomes a differentiable op on
//! `Tensor`, without a backend type parameter and without copying its inputs.
//!
//! burn has no op with several outputs, so a joint node (a one-element stand-in) is the child of the
//! inputs, and each output a child of the joint node whose backward only leaves its gradient behind.

use burn::backend::autodiff::checkpoint::{base::Checkpointer, strategy::CheckpointStrategy};
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::flex::FlexTensor;
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Backend, Dispatch, Flex, TensorMetadata, backend_extension};
use burn::tensor::{Shape, Tensor, TensorData};
use std::fmt::Debug;
use std::sync::{Arc, Mutex};

#[cfg(feature = "gpu")]
pub use crate::on_gpu::DeviceOp;

/// Without burn on GPUs an op needs no kernels here.
#[cfg(not(feature = "gpu"))]
pub trait DeviceOp {}
#[cfg(not(feature = "gpu"))]
impl<T> DeviceOp for T {}

/// Most inputs and outputs that an op may have.
pub const ARITY: usize = 4;

/// A tensor as an op sees it: row-major values and their shape.
#[derive(Clone, Copy)]
pub struct In<'a> {
    pub data: &'a [f32],
    pub shape: &'a [usize],
}

/// What an op returns per output: values and shape.
pub type Out = (Vec<f32>, Vec<usize>);

/// An op on slices with its backward.
pub trait SliceOp: DeviceOp + Debug + Send + Sync + 'static {
    /// At most [`ARITY`] outputs.
    fn forward(&self, inputs: &[In]) -> Vec<Out>;
    /// Gradients for the inputs given those of the outputs (`None` where an output was not used);
    /// `None` for an input without gradient.
    fn backward(&self, inputs: &[In], d_outputs: &[Option<&[f32]>]) -> Vec<Option<Vec<f32>>>;
}

/// A shared op, cheap to clone into a graph.
#[derive(Clone, Debug)]
pub struct OpRef(pub(crate) Arc<dyn SliceOp>);

/// Runs `op` on up to [`ARITY`] tensors of any rank; gradients flow where the device has autodiff.
///
/// # Panics
/// When there are no or too many inputs.
pub fn apply(op: impl SliceOp, inputs: Vec<FloatTensor<Dispatch>>) -> Vec<FloatTensor<Dispatch>> {
    let n = inputs.len();
    assert!((1..=ARITY).contains(&n), "an op takes 1 to {ARITY} tensors, got {n}");
    let pad = inputs[0].clone();
    let at = |i: usize| inputs.get(i).unwrap_or(&pad).clone();
    let (a, b, c, d) = Dispatch::slice_op(at(0), at(1), at(2), at(3), n, OpRef(Arc::new(op)));
    vec![a, b, c, d]
}

/// [`apply`] for a single output of rank `D`.
pub fn apply_one<const D: usize>(op: impl SliceOp, inputs: Vec<FloatTensor<Dispatch>>) -> Tensor<D> {
    Tensor::from_dispatch(apply(op, inputs).swap_remove(0))
}

/// Forward and backward of a slice op per backend.
pub trait SliceKernels: Backend {
    /// What the way back needs besides the inputs.
    type Kept: Debug + Clone + Send + 'static;

    fn k_forward(inputs: &[FloatTensor<Self>], op: &OpRef) -> (Vec<FloatTensor<Self>>, Self::Kept);
    fn k_backward(
        inputs: &[FloatTensor<Self>],
        kept: &Self::Kept,
        d: Vec<Option<FloatTensor<Self>>>,
        op: &OpRef,
    ) -> Vec<Option<FloatTensor<Self>>>;
    /// One number that nobody reads, where `like` is.
    fn k_unit(like: &FloatTensor<Self>) -> FloatTensor<Self>;
}

fn contiguous(t: &FlexTensor) -> FlexTensor {
    if t.is_contiguous() { t.clone() } else { t.to_contiguous() }
}

fn floats(t: &FlexTensor) -> &[f32] {
    t.as_slice::<f32>().expect("a contiguous f32 tensor")
}

fn flex(data: Vec<f32>, shape: Vec<usize>) -> FlexTensor {
    FlexTensor::from_data(TensorData::new(data, Shape::from(shape)))
}

impl SliceKernels for Flex {
    type Kept = ();

    fn k_forward(inputs: &[FlexTensor], op: &OpRef) -> (Vec<FlexTensor>, ()) {
        let inputs: Vec<FlexTensor> = inputs.iter().map(contiguous).collect();
        let shapes: Vec<Vec<usize>> = inputs.iter().map(|t| t.shape().iter().copied().collect()).collect();
        let views: Vec<In> = inputs.iter().zip(&shapes).map(|(t, s)| In { data: floats(t), shape: s }).collect();
        (op.0.forward(&views).into_iter().map(|(data, shape)| flex(data, shape)).collect(), ())
    }

    fn k_backward(inputs: &[FlexTensor], _: &(), d: Vec<Option<FlexTensor>>, op: &OpRef) -> Vec<Option<FlexTensor>> {
        let inputs: Vec<FlexTensor> = inputs.iter().map(contiguous).collect();
        let d: Vec<Option<FlexTensor>> = d.iter().map(|t| t.as_ref().map(contiguous)).collect();
        let shapes: Vec<Vec<usize>> = inputs.iter().map(|t| t.shape().iter().copied().collect()).collect();
        let views: Vec<In> = inputs.iter().zip(&shapes).map(|(t, s)| In { data: floats(t), shape: s }).collect();
        let grads: Vec<Option<&[f32]>> = d.iter().map(|t| t.as_ref().map(floats)).collect();
        let out = op.0.backward(&views, &grads);
        out.into_iter().zip(shapes).map(|(g, shape)| g.map(|g| flex(g, shape))).collect()
    }

    fn k_unit(_: &FlexTensor) -> FlexTensor {
        flex(vec![0.0], vec![1])
    }
}

pub(crate) type Four<B> = (FloatTensor<B>, FloatTensor<B>, FloatTensor<B>, FloatTensor<B>);

/// The extension that burn's dispatch learns.
#[backend_extension(Autodiff, Flex, Cube: cfg(feature = "gpu"))]
pub trait SliceBackend: burn::backend::Backend {
    fn slice_op(
        a: FloatTensor<Self>,
        b: FloatTensor<Self>,
        c: FloatTensor<Self>,
        d: FloatTensor<Self>,
        n: usize,
        op: OpRef,
    ) -> (FloatTensor<Self>, FloatTensor<Self>, FloatTensor<Self>, FloatTensor<Self>);
}

pub(crate) fn four<B: SliceKernels>(mut outputs: Vec<FloatTensor<B>>, unit: &FloatTensor<B>) -> Four<B> {
    outputs.resize_with(ARITY, || unit.clone());
    let mut it = outputs.into_iter();
    let mut next = || it.next().expect("resized to ARITY");
    (next(), next(), next(), next())
}

impl SliceBackend for Flex {
    fn slice_op(a: FlexTensor, b: FlexTensor, c: FlexTensor, d: FlexTensor, n: usize, op: OpRef) -> Four<Self> {
        let unit = Self::k_unit(&a);
        four::<Flex>(Self::k_forward(&[a, b, c, d][..n], &op).0, &unit)
    }
}

type Slots<B> = Arc<Mutex<Vec<Option<FloatTensor<B>>>>>;

#[derive(Debug)]
struct OutputStep;
impl<B: SliceKernels> Backward<B, 1> for OutputStep {
    type State = (Slots<B>, usize);
    fn backward(self, ops: Ops<Self::State, 1>, grads: &mut Gradients, _: &mut Checkpointer) {
        let g = grads.consume::<B>(&ops.node);
        ops.state.0.lock().expect("no other holder panicked")[ops.state.1] = Some(g);
    }
}

#[derive(Debug)]
struct JointStep;
impl<B: SliceKernels> Backward<B, ARITY> for JointStep {
    type State = (Vec<FloatTensor<B>>, B::Kept, usize, OpRef, Slots<B>);
    fn backward(self, ops: Ops<Self::State, ARITY>, grads: &mut Gradients, _: &mut Checkpointer) {
        let (inputs, kept, outputs, op, slots) = ops.state;
        let mut d = std::mem::take(&mut *slots.lock().expect("no other holder panicked"));
        d.truncate(outputs);
        let n = inputs.len();
        for (i, (node, g)) in ops.parents.into_iter().zip(B::k_backward(&inputs, &kept, d, &op)).enumerate() {
            if let (true, Some(node), Some(g)) = (i < n, node, g) {
                grads.register::<B>(node.id, g);
            }
        }
    }
}

impl<B: SliceKernels, C: CheckpointStrategy> SliceBackend for Autodiff<B, C> {
    fn slice_op(a: FloatTensor<Self>, b: FloatTensor<Self>, c: FloatTensor<Self>, d: FloatTensor<Self>, n: usize, op: OpRef) -> Four<Self> {
        let (mut inputs, nodes): (Vec<_>, Vec<_>) = [a, b, c, d].into_iter().map(|t| t.into_parts()).unzip();
        inputs.truncate(n);
        let unit = B::k_unit(&inputs[0]);
        let (outputs, kept) = B::k_forward(&inputs, &op);
        let count = outputs.len();
        let nodes: [_; ARITY] = nodes.try_into().unwrap_or_else(|_| unreachable!("four inputs"));
        match JointStep.prepare::<C>(nodes).compute_bound().stateful() {
            OpsKind::Tracked(prep) => {
                let slots: Slots<B> = Arc::new(Mutex::new(vec![None; ARITY]));
                let joint: FloatTensor<Self> = prep.finish((inputs, kept, count, op, slots.clone()), unit.clone());
                let children = outputs
                    .into_iter()
                    .enumerate()
                    .map(|(i, t)| match OutputStep.prepare::<C>([joint.node()]).compute_bound().stateful() {
                        OpsKind::Tracked(prep) => prep.finish((slots.clone(), i), t),
                        OpsKind::UnTracked(prep) => prep.finish(t),
                    })
                    .collect();
                four_autodiff::<B, C>(children, &unit)
            }
            OpsKind::UnTracked(prep) => {
                drop(prep);
                four_autodiff::<B, C>(outputs.into_iter().map(<FloatTensor<Self>>::new).collect(), &unit)
            }
        }
    }
}

fn four_autodiff<B: SliceKernels, C: CheckpointStrategy>(
    mut outputs: Vec<FloatTensor<Autodiff<B, C>>>,
    unit: &FloatTensor<B>,
) -> Four<Autodiff<B, C>> {
    outputs.resize_with(ARITY, || <FloatTensor<Autodiff<B, C>>>::new(unit.clone()));
    let mut it = outputs.into_iter();
    let mut next = || it.next().expect("resized to ARITY");
    (next(), next(), next(), next())
}

/// The values of a tensor, for tests and for reading results.
pub fn values<const D: usize>(t: Tensor<D>) -> Vec<f32> {
    t.into_data().convert::<f32>().try_to_vec().expect("f32 after conversion")
}

#[cfg(test)]
mod tests {
    use super::*;
    #[cfg(feature = "gpu")]
    use crate::on_gpu::{Ahead, OnDevice};
    use burn::tensor::Device;
    #[cfg(feature = "gpu")]
    use diorama_kernels::gpu::{Buffer, Gpu};

    /// `(x·y, x + y)` elementwise.
    #[derive(Debug)]
    struct ProductAndSum;
    impl SliceOp for ProductAndSum {
        fn forward(&self, i: &[In]) -> Vec<Out> {
            let f = |g: fn(f32, f32) -> f32| i[0].data.iter().zip(i[1].data).map(|(a, b)| g(*a, *b)).collect();
            vec![(f(|a, b| a * b), i[0].shape.to_vec()), (f(|a, b| a + b), i[0].shape.to_vec())]
        }
        fn backward(&self, i: &[In], d: &[Option<&[f32]>]) -> Vec<Option<Vec<f32>>> {
            let at = |k: usize, e: usize| d[k].map_or(0.0, |d| d[e]);
            let n = i[0].data.len();
            let g = |other: &[f32]| (0..n).map(|e| at(0, e) * other[e] + at(1, e)).collect::<Vec<f32>>();
            vec![Some(g(i[1].data)), Some(g(i[0].data))]
        }
    }

    #[cfg(feature = "gpu")]
    impl DeviceOp for ProductAndSum {
        fn ahead(&self, _: &Gpu, _: &[OnDevice]) -> Ahead {
            unreachable!("the test runs on the CPU")
        }
        fn back(&self, _: &Gpu, _: &[OnDevice], _: &[Buffer], _: &[Option<Buffer>]) -> Vec<Option<Buffer>> {
            unreachable!("the test runs on the CPU")
        }
    }

    fn run(use_sum: bool) -> (Vec<f32>, Vec<f32>) {
        let device = Device::flex().autodiff();
        let x = Tensor::<1>::from_floats([1.0, 2.0], &device).require_grad();
        let y = Tensor::<1>::from_floats([3.0, 5.0], &device).require_grad();
        let mut out = apply(ProductAndSum, vec![x.clone().into_dispatch(), y.clone().into_dispatch()]);
        let sum = Tensor::<1>::from_dispatch(out.remove(1));
        let product = Tensor::<1>::from_dispatch(out.remove(0));
        let loss = if use_sum { product.sum() + sum.sum() * 10.0 } else { product.sum() };
        let grads = loss.backward();
        (values(x.grad(&grads).unwrap()), values(y.grad(&grads).unwrap()))
    }

    #[test]
    fn gradients_arrive_from_both_outputs_or_from_one() {
        assert_eq!(run(true), (vec![13.0, 15.0], vec![11.0, 12.0]));
        assert_eq!(run(false), (vec![3.0, 5.0], vec![1.0, 2.0]));
    }
}
