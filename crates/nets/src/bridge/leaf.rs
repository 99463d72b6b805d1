//! Numbers that live outside burn's graph, for example a field's parameters or the codes of its rays: as leaves of the graph whose
//! gradients are read back, and as gradients of its outputs that were computed elsewhere.

use burn::tensor::{Device, Gradients, Tensor, TensorData};

/// A leaf with copies of the numbers of a shape, whose gradient [`gradient`] gives.
///
/// # Panics
/// When the shape asks for another count of numbers.
pub fn leaf<const D: usize>(values: &[f32], shape: [usize; D], device: &Device) -> Tensor<D> {
    assert_eq!(values.len(), shape.iter().product::<usize>(), "as many numbers as the shape says");
    Tensor::<D>::from_data(TensorData::new(values.to_vec(), shape), &device.clone().without_autodiff()).autodiff().require_grad()
}

/// Goes back through the graph from an output whose gradient, of the same shape, was computed elsewhere.
///
/// # Panics
/// When there are not as many gradients as outputs.
pub fn backward_from<const D: usize>(output: Tensor<D>, d_output: &[f32]) -> Gradients {
    let shape: [usize; D] = output.dims();
    assert_eq!(d_output.len(), shape.iter().product::<usize>(), "a gradient for each output");
    let d = Tensor::<D>::from_data(TensorData::new(d_output.to_vec(), shape), &output.device());
    (output * d).sum().backward()
}

/// The gradient of a leaf; zeros where nothing depends on it.
pub fn gradient<const D: usize>(leaf: &Tensor<D>, found: &mut Gradients) -> Vec<f32> {
    leaf.grad_remove(found).map_or_else(|| vec![0.0; leaf.dims().iter().product()], super::read_values)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gradients_go_in_and_come_out() {
        let device = Device::flex();
        let (x, unused) = (leaf(&[1.0, 2.0, 3.0, 4.0], [2, 2], &device), leaf(&[5.0], [1], &device));
        let y = x.clone() * x.clone();
        let mut found = backward_from(y, &[1.0, 0.0, -1.0, 0.5]);
        assert_eq!(gradient(&x, &mut found), [2.0, 0.0, -6.0, 4.0]);
        assert_eq!(gradient(&unused, &mut found), [0.0]);
    }
}
