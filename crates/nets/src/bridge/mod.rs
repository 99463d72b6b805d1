//! The bridge from our ops to burn's autodiff: any op on slices becomes a differentiable op on `Tensor`, without a backend type
//! parameter and without copying its inputs.
//!
//! Each file beside this one holds one op of `diorama-kernels`. `graph` builds the nodes of burn's graph, `pool` owns the memory.

#[cfg(feature = "gpu")]
pub mod check;
mod composite;
mod distortion;
mod error;
mod frequency;
mod fused_mlp;
mod graph;
mod hash_grid;
mod leaf;
mod linear;
#[cfg(feature = "gpu")]
mod on_gpu;
pub mod pool;
mod precision;
#[cfg(test)]
mod ragged_rays;
mod scan;
mod spherical_harmonics;
mod ssim;
mod triangle_wave;
mod trilinear_corner_grid;
pub(crate) mod work;

pub use composite::{Composited, composite};
pub use distortion::distortion;
pub use error::{OpError, expect_inputs, expect_shape};
pub use frequency::frequency;
pub use fused_mlp::fused_mlp;
pub use hash_grid::hash_grid;
pub use leaf::{backward_from, gradient, leaf};
pub use linear::linear;
pub(crate) use linear::linear_of_rows;
#[cfg(feature = "gpu")]
pub use on_gpu::{DeviceKernels, DeviceOutputs, OnDevice, tensors};
pub use pool::{Indices, IndicesMut, Values, ValuesMut};
pub(crate) use precision::precision;
pub use precision::{Precision, with_precision};
pub use scan::scan;
pub use spherical_harmonics::spherical_harmonics;
pub use ssim::ssim;
pub use triangle_wave::triangle_wave;
pub use trilinear_corner_grid::trilinear_corner_grid;

use burn::backend::flex::FlexTensor;
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Backend, BackendTensor, DispatchAutodiffContext, DispatchTensor, DispatchTensorKind, Flex, TensorMetadata};
use burn::tensor::{DType, Tensor};
use std::fmt::Debug;
use std::sync::Arc;

/// What an op's backward needs of its forward. Clones share the memory.
#[derive(Clone, Debug, Default)]
pub struct Kept {
    pub values: Vec<Values>,
    pub indices: Vec<Indices>,
}

impl Kept {
    pub fn of(values: &[Values]) -> Kept {
        Kept { values: values.to_vec(), indices: Vec::new() }
    }
}

/// What an op's forward gives.
pub struct Forward {
    pub outputs: Vec<Values>,
    pub kept: Kept,
}

impl Forward {
    pub fn one(output: Values, kept: Kept) -> Forward {
        Forward { outputs: vec![output], kept }
    }
}

/// An op on slices with its backward.
pub trait SliceOp: Debug + Send + Sync + 'static {
    /// The op's name in errors.
    fn name(&self) -> &'static str;

    /// Whether the op can be applied to inputs of these shapes; `forward` is called with none that were refused.
    fn check(&self, shapes: &[&[usize]]) -> Result<(), OpError>;

    /// Outputs, and what the backward needs. `wanted` says which inputs a gradient will be asked of; where it is of none,
    /// nothing need be kept.
    fn forward(&self, inputs: &[Values], wanted: &[bool]) -> Forward;

    /// Gradients for the inputs given those of the outputs (`None` where an output was not used); `None` for an input without
    /// one, or whose gradient is not `wanted`.
    fn backward(&self, kept: &Kept, d_outputs: &[Option<Values>], wanted: &[bool]) -> Vec<Option<Values>>;

    /// The op by burn's own ops, which record their own graph: for devices where it has no kernels.
    fn by_burn(&self, _: &[DispatchTensor]) -> Option<Vec<DispatchTensor>> {
        None
    }

    /// The op's kernels on GPUs, where it has them.
    #[cfg(feature = "gpu")]
    fn on_device(&self) -> Option<&dyn DeviceKernels> {
        None
    }
}

/// A shared op, cheap to clone into a graph.
pub(crate) type OpRef = Arc<dyn SliceOp>;

/// Forward and backward of a slice op per backend.
pub(crate) trait SliceKernels: Backend {
    /// What the way back needs.
    type State: Debug + Clone + Send + 'static;

    fn run(op: &dyn SliceOp, inputs: Vec<FloatTensor<Self>>, wanted: &[bool]) -> (Vec<FloatTensor<Self>>, Self::State);
    fn run_backward(
        op: &dyn SliceOp,
        state: &Self::State,
        d_outputs: Vec<Option<FloatTensor<Self>>>,
        wanted: &[bool],
    ) -> Vec<Option<FloatTensor<Self>>>;
    /// One number that nobody reads, where `like` is.
    fn unit(like: &FloatTensor<Self>) -> FloatTensor<Self>;
    fn wrap(tensor: BackendTensor<Self>) -> DispatchTensorKind;
    /// The inner tensor of this backend; `None` on another one.
    fn unwrap(kind: DispatchTensorKind) -> Option<BackendTensor<Self>>;
}

impl SliceKernels for Flex {
    type State = Kept;

    fn run(op: &dyn SliceOp, inputs: Vec<FlexTensor>, wanted: &[bool]) -> (Vec<FlexTensor>, Kept) {
        let inputs: Vec<Values> = inputs.iter().map(Values::of).collect();
        let forward = op.forward(&inputs, wanted);
        (forward.outputs.into_iter().map(Values::into_tensor).collect(), forward.kept)
    }

    fn run_backward(op: &dyn SliceOp, kept: &Kept, d: Vec<Option<FlexTensor>>, wanted: &[bool]) -> Vec<Option<FlexTensor>> {
        let d: Vec<Option<Values>> = d.iter().map(|t| t.as_ref().map(Values::of)).collect();
        op.backward(kept, &d, wanted).into_iter().map(|g| g.map(Values::into_tensor)).collect()
    }

    fn unit(_: &FlexTensor) -> FlexTensor {
        ValuesMut::zeros(&[1]).freeze().into_tensor()
    }

    fn wrap(tensor: BackendTensor<Flex>) -> DispatchTensorKind {
        DispatchTensorKind::Flex(tensor)
    }

    fn unwrap(kind: DispatchTensorKind) -> Option<BackendTensor<Flex>> {
        match kind {
            DispatchTensorKind::Flex(t) => Some(t),
            #[allow(unreachable_patterns)]
            _ => None,
        }
    }
}

/// Runs `op` on tensors of any rank; gradients flow where a tensor has autodiff.
///
/// # Errors
/// When the op refuses the shapes, or the inputs do not share a device that the op runs on.
pub fn apply(op: impl SliceOp, inputs: Vec<DispatchTensor>) -> Result<Vec<DispatchTensor>, OpError> {
    apply_shared(Arc::new(op), inputs)
}

fn apply_shared(op: OpRef, inputs: Vec<DispatchTensor>) -> Result<Vec<DispatchTensor>, OpError> {
    let name = op.name();
    if inputs.is_empty() {
        return Err(OpError::Inputs { op: name, expected: "1 or more".into(), got: 0 });
    }
    let shapes: Vec<_> = inputs.iter().map(|t| t.shape()).collect();
    let slices: Vec<&[usize]> = shapes.iter().map(|s| &s[..]).collect();
    op.check(&slices)?;
    for (index, t) in inputs.iter().enumerate() {
        if t.dtype() != DType::F32 {
            return Err(OpError::Type { op: name, index, got: format!("{:?}", t.dtype()) });
        }
    }
    let inner = match &inputs[0].kind {
        DispatchTensorKind::Autodiff(inner) => inner,
        kind => kind,
    };
    match inner {
        DispatchTensorKind::Flex(_) => apply_on::<Flex>(op, inputs),
        #[cfg(feature = "gpu")]
        DispatchTensorKind::Cube(_) if op.on_device().is_some() => apply_on::<burn_cubecl::CubeBackend>(op, inputs),
        #[allow(unreachable_patterns)]
        _ => op.by_burn(&inputs).ok_or(OpError::NoKernels { op: name }),
    }
}

fn apply_on<B: SliceKernels>(op: OpRef, inputs: Vec<DispatchTensor>) -> Result<Vec<DispatchTensor>, OpError> {
    let autodiff = inputs.iter().fold(DispatchAutodiffContext::Disabled, |c, t| c.merge(t.autodiff));
    let mut tracked = Vec::new();
    for (index, t) in inputs.into_iter().enumerate() {
        let kind = match t.kind {
            DispatchTensorKind::Autodiff(inner) => *inner,
            kind => kind,
        };
        tracked.push(match B::unwrap(kind) {
            Some(BackendTensor::Autodiff(t)) => t,
            Some(t) => FloatTensor::<Autodiff<B>>::new(t.float()),
            None => return Err(OpError::Devices { op: op.name(), index }),
        });
    }
    let wrap = |tensor: BackendTensor<B>, boxed: bool| {
        let kind = B::wrap(tensor);
        DispatchTensor { kind: if boxed { DispatchTensorKind::Autodiff(Box::new(kind)) } else { kind }, autodiff }
    };
    if autodiff == DispatchAutodiffContext::Disabled {
        let wanted = vec![false; tracked.len()];
        let (outputs, _) = B::run(&*op, tracked.into_iter().map(|t| t.into_primitive()).collect(), &wanted);
        return Ok(outputs.into_iter().map(|t| wrap(BackendTensor::Float(t), false)).collect());
    }
    Ok(graph::record::<B>(op, tracked).into_iter().map(|t| wrap(BackendTensor::Autodiff(t), true)).collect())
}

/// [`apply`] for a single output of rank `D`.
pub fn apply_one<const D: usize>(op: impl SliceOp, inputs: Vec<DispatchTensor>) -> Result<Tensor<D>, OpError> {
    Ok(Tensor::from_dispatch(apply(op, inputs)?.swap_remove(0)))
}

/// The numbers of a tensor, for tests and for reading results.
pub fn read_values<const D: usize>(t: Tensor<D>) -> Vec<f32> {
    t.into_data().convert::<f32>().try_to_vec().expect("f32 after conversion")
}

#[cfg(test)]
mod tests;
