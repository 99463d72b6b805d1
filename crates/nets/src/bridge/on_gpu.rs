//! The same bridge on burn's Cube backend: its tensors and our [`Buffer`]s are the same memory of the same device,
//! so nothing is copied and nothing waits.

use super::{SliceKernels, SliceOp};
use burn::backend::{BackendTensor, DispatchTensorKind, TensorMetadata};
use burn::tensor::{DType, Shape};
use burn_cubecl::CubeBackend;
use burn_cubecl::kernel::into_contiguous;
use burn_cubecl::tensor::CubeTensor;
use diorama_kernels::gpu::{Buffer, Gpu};

/// A tensor as an op sees it on a device: row-major values and their shape.
pub struct OnDevice {
    pub data: Buffer,
    pub shape: Vec<usize>,
}

/// What an op returns on a device.
pub struct DeviceOutputs {
    /// Values and shape of each output.
    pub outputs: Vec<(Buffer, Vec<usize>)>,
    /// What the way back needs besides the inputs.
    pub kept: Vec<Buffer>,
}

/// An op's kernels on a device, forward and backward as in [`crate::bridge::SliceOp`].
pub trait DeviceKernels {
    fn forward_on(&self, gpu: &Gpu, inputs: &[OnDevice]) -> DeviceOutputs;
    /// Gradients for the inputs given those of the outputs (`None` where an output was not used).
    fn backward_on(&self, gpu: &Gpu, inputs: &[OnDevice], kept: &[Buffer], d_outputs: &[Option<Buffer>]) -> Vec<Option<Buffer>>;
}

/// The values of an f32 tensor.
fn on_device(t: &CubeTensor) -> OnDevice {
    let t = into_contiguous(t.clone());
    let shape: Vec<usize> = t.shape().iter().copied().collect();
    OnDevice { data: Buffer::of(t.handle, shape.iter().product()), shape }
}

/// A tensor where `like` is.
fn tensor(like: &CubeTensor, data: Buffer, shape: Vec<usize>) -> CubeTensor {
    assert_eq!(data.len(), shape.iter().product::<usize>(), "a result has as many numbers as its shape says");
    CubeTensor::new_contiguous(like.client.clone(), like.device.clone(), Shape::from(shape), data.handle(), DType::F32)
}

/// The device for burn's tensors; ops in burn's graph run on it without copies.
pub fn tensors(gpu: &Gpu) -> burn::tensor::Device {
    burn::tensor::Device::new(gpu.device().clone())
}

fn gpu_of(t: &CubeTensor) -> Gpu {
    Gpu::of(t.device.clone(), t.client.clone())
}

fn kernels(op: &dyn SliceOp) -> &dyn DeviceKernels {
    op.on_device().expect("ops without kernels here were refused")
}

impl SliceKernels for CubeBackend {
    /// Inputs, and what the op keeps besides them.
    type State = (Vec<CubeTensor>, Vec<Buffer>);

    fn run(op: &dyn SliceOp, inputs: Vec<CubeTensor>, _: &[bool]) -> (Vec<CubeTensor>, Self::State) {
        let on: Vec<OnDevice> = inputs.iter().map(on_device).collect();
        let DeviceOutputs { outputs, kept } = kernels(op).forward_on(&gpu_of(&inputs[0]), &on);
        (outputs.into_iter().map(|(data, shape)| tensor(&inputs[0], data, shape)).collect(), (inputs, kept))
    }

    fn run_backward(op: &dyn SliceOp, state: &Self::State, d: Vec<Option<CubeTensor>>, _: &[bool]) -> Vec<Option<CubeTensor>> {
        let (inputs, kept) = state;
        let on: Vec<OnDevice> = inputs.iter().map(on_device).collect();
        let d: Vec<Option<Buffer>> = d.iter().map(|t| t.as_ref().map(|t| on_device(t).data)).collect();
        let gradients = kernels(op).backward_on(&gpu_of(&inputs[0]), &on, kept, &d);
        gradients.into_iter().zip(on).map(|(g, i)| g.map(|g| tensor(&inputs[0], g, i.shape))).collect()
    }

    fn unit(like: &CubeTensor) -> CubeTensor {
        tensor(like, Buffer::of(like.client.empty(size_of::<f32>()), 1), vec![1])
    }

    fn wrap(tensor: BackendTensor<Self>) -> DispatchTensorKind {
        DispatchTensorKind::Cube(tensor)
    }

    fn unwrap(kind: DispatchTensorKind) -> Option<BackendTensor<Self>> {
        match kind {
            DispatchTensorKind::Cube(t) => Some(t),
            _ => None,
        }
    }
}
