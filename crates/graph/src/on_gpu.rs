//! The same bridge on burn's Cube backend: its tensors and our [`Buffer`]s are the same memory of the same device,
//! so nothing is copied and nothing waits.

use crate::bridge::{Four, OpRef, SliceBackend, SliceKernels, four};
use burn::backend::TensorMetadata;
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
pub struct Ahead {
    /// Values and shape of each output.
    pub outputs: Vec<(Buffer, Vec<usize>)>,
    /// What the way back needs besides the inputs.
    pub kept: Vec<Buffer>,
}

/// An op's kernels, forward and backward as in [`crate::SliceOp`].
pub trait DeviceOp {
    fn ahead(&self, gpu: &Gpu, inputs: &[OnDevice]) -> Ahead;
    /// Gradients for the inputs given those of the outputs (`None` where an output was not used).
    fn back(&self, gpu: &Gpu, inputs: &[OnDevice], kept: &[Buffer], d_outputs: &[Option<Buffer>]) -> Vec<Option<Buffer>>;
}

/// The values of an f32 tensor.
fn on_device(t: &CubeTensor) -> OnDevice {
    assert_eq!(t.dtype, DType::F32, "an op takes f32 tensors");
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

impl SliceKernels for CubeBackend {
    type Kept = Vec<Buffer>;

    fn k_forward(inputs: &[CubeTensor], op: &OpRef) -> (Vec<CubeTensor>, Vec<Buffer>) {
        let on: Vec<OnDevice> = inputs.iter().map(on_device).collect();
        let Ahead { outputs, kept } = op.0.ahead(&gpu_of(&inputs[0]), &on);
        (outputs.into_iter().map(|(data, shape)| tensor(&inputs[0], data, shape)).collect(), kept)
    }

    fn k_backward(inputs: &[CubeTensor], kept: &Vec<Buffer>, d: Vec<Option<CubeTensor>>, op: &OpRef) -> Vec<Option<CubeTensor>> {
        let on: Vec<OnDevice> = inputs.iter().map(on_device).collect();
        let d: Vec<Option<Buffer>> = d.iter().map(|t| t.as_ref().map(|t| on_device(t).data)).collect();
        let gradients = op.0.back(&gpu_of(&inputs[0]), &on, kept, &d);
        gradients.into_iter().zip(on).map(|(g, i)| g.map(|g| tensor(&inputs[0], g, i.shape))).collect()
    }

    fn k_unit(like: &CubeTensor) -> CubeTensor {
        tensor(like, Buffer::of(like.client.empty(size_of::<f32>()), 1), vec![1])
    }
}

impl SliceBackend for CubeBackend {
    fn slice_op(a: CubeTensor, b: CubeTensor, c: CubeTensor, d: CubeTensor, n: usize, op: OpRef) -> Four<Self> {
        let unit = Self::k_unit(&a);
        four::<CubeBackend>(Self::k_forward(&[a, b, c, d][..n], &op).0, &unit)
    }
}
