//! A small network, evaluated block by block, in burn's graph.

#[cfg(feature = "gpu")]
use super::{DeviceKernels, DeviceOutputs, OnDevice};
use super::{Forward, Kept, OpError, SliceOp, Values, ValuesMut, apply_one, expect_inputs, expect_shape};
use burn::tensor::Tensor;
#[cfg(feature = "gpu")]
use diorama_kernels::gpu::{Buffer, Gpu, Rows};
#[cfg(feature = "gpu")]
use diorama_kernels::ops::fused_mlp::gpu as kernels;
use diorama_kernels::ops::fused_mlp::{Mlp, cpu};

#[derive(Debug)]
struct MlpOp(Mlp);

impl SliceOp for MlpOp {
    fn name(&self) -> &'static str {
        "network"
    }

    fn check(&self, shapes: &[&[usize]]) -> Result<(), OpError> {
        expect_inputs(self.name(), shapes, self.0.input_widths.len() + 1)?;
        let rows = shapes[0].first().copied();
        for (shape, width) in shapes.iter().zip(&self.0.input_widths) {
            expect_shape(self.name(), "an input", shape, &[rows, Some(*width)])?;
        }
        expect_shape(self.name(), "params", shapes[shapes.len() - 1], &[Some(self.0.params_len())])
    }

    fn forward(&self, x: &[Values], _: &[bool]) -> Forward {
        let n = x[0].shape()[0];
        let (params, inputs) = x.split_last().expect("the parameters come last");
        let inputs: Vec<&[f32]> = inputs.iter().map(|i| &i[..]).collect();
        let mut out = ValuesMut::zeros(&[n, self.0.layers.last().map_or(0, |l| l.width)]);
        cpu::forward(&self.0, params, &inputs, n, &mut out);
        Forward::one(out.freeze(), Kept::of(x))
    }

    fn backward(&self, kept: &Kept, d: &[Option<Values>], _: &[bool]) -> Vec<Option<Values>> {
        let Some(d) = &d[0] else { return vec![None; kept.values.len()] };
        let (params, inputs) = kept.values.split_last().expect("the parameters come last");
        let n = inputs[0].shape()[0];
        let slices: Vec<&[f32]> = inputs.iter().map(|i| &i[..]).collect();
        let mut d_inputs: Vec<Vec<f32>> = inputs.iter().map(|i| vec![0.0; i.len()]).collect();
        let mut d_params = ValuesMut::zeros(params.shape());
        cpu::backward(&self.0, params, &slices, n, d, &mut d_params, &mut d_inputs);
        let d_inputs = d_inputs.into_iter().zip(inputs).map(|(d, i)| Some(Values::from_vec(d, i.shape())));
        d_inputs.chain([Some(d_params.freeze())]).collect()
    }

    #[cfg(feature = "gpu")]
    fn on_device(&self) -> Option<&dyn DeviceKernels> {
        Some(self)
    }
}

/// The network's last layer as a burn op, differentiable in its inputs and parameters.
///
/// # Shapes
/// inputs: up to three `[N, K_i]`; params: `[params_len]`; result: `[N, width]`.
pub fn fused_mlp(mlp: &Mlp, inputs: Vec<Tensor<2>>, params: Tensor<1>) -> Result<Tensor<2>, OpError> {
    let all = inputs.into_iter().map(|t| t.into_dispatch()).chain([params.into_dispatch()]).collect();
    apply_one(MlpOp(mlp.clone()), all)
}

#[cfg(feature = "gpu")]
impl DeviceKernels for MlpOp {
    fn forward_on(&self, gpu: &Gpu, i: &[OnDevice]) -> DeviceOutputs {
        let (n, width) = (i[0].shape[0], self.0.layers.last().map_or(0, |l| l.width));
        let (params, inputs) = i.split_last().expect("the parameters come last");
        let inputs: Vec<&Buffer> = inputs.iter().map(|i| &i.data).collect();
        let values = kernels::forward(gpu, &self.0, &params.data, &inputs, &Rows::all(gpu, n));
        let out = values.layers.last().cloned().unwrap_or_else(|| gpu.empty(0));
        // Outputs of all layers, then the inputs of activations that need them.
        let kept = values.layers.into_iter().chain(values.pre.into_iter().flatten()).collect();
        DeviceOutputs { outputs: vec![(out, vec![n, width])], kept }
    }

    fn backward_on(&self, gpu: &Gpu, i: &[OnDevice], kept: &[Buffer], d: &[Option<Buffer>]) -> Vec<Option<Buffer>> {
        let Some(d) = &d[0] else { return vec![None; i.len()] };
        let (params, inputs) = i.split_last().expect("the parameters come last");
        let inputs: Vec<&Buffer> = inputs.iter().map(|i| &i.data).collect();
        let (layers, pre) = kept.split_at(self.0.layers.len());
        let mut pre = pre.iter().cloned();
        let pre = self.0.layers.iter().map(|l| if l.activation.is_monotonic() { None } else { pre.next() }).collect();
        let values = kernels::Values { layers: layers.to_vec(), pre };
        let mut d_layers = vec![None; layers.len()];
        if let Some(last) = d_layers.last_mut() {
            *last = Some(d.clone());
        }
        let rows = Rows::all(gpu, i[0].shape[0]);
        let (d_params, d_inputs) = kernels::backward(gpu, &self.0, &params.data, &inputs, &values, &rows, d_layers);
        d_inputs.into_iter().chain([d_params]).map(Some).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::read_values;
    use burn::tensor::{Device, TensorData};
    use diorama_geom::rng::Rng;
    use diorama_kernels::ops::fused_mlp::{Layer, Source, reference};
    use diorama_kernels::ops::linear::Activation;
    use diorama_testkit::{assert_close, random, wide};

    /// A network with two inputs, a skip connection and a split head.
    fn network() -> Mlp {
        let layer = |inputs: Vec<Source>, width, relu: bool, bias| {
            Layer::new(inputs, width, if relu { Activation::Relu } else { Activation::None }, bias)
        };
        use Source::{Input, Layer as L};
        Mlp::new(
            vec![5, 3],
            vec![
                layer(vec![Input(0)], 24, true, true),
                layer(vec![Input(0), L(0)], 17, true, true),
                layer(vec![L(1)], 1, false, true),
                layer(vec![L(1), Input(1), L(2)], 4, false, false),
            ],
        )
    }

    #[test]
    fn burn_sees_the_same_gradients() {
        let mlp = &network();
        let device = Device::flex().autodiff();
        let params = mlp.init(&Rng::new(1, 2));
        let (a, b) = (random(15, 1), random(9, 2));
        let at = Tensor::<2>::from_data(TensorData::new(a.clone(), [3, 5]), &device).require_grad();
        let bt = Tensor::<2>::from_data(TensorData::new(b.clone(), [3, 3]), &device).require_grad();
        let pt = Tensor::<1>::from_data(TensorData::new(params.clone(), [params.len()]), &device).require_grad();
        let grads = fused_mlp(mlp, vec![at.clone(), bt.clone()], pt.clone()).unwrap().sum().backward();
        let mut seeds: Vec<Vec<f64>> = mlp.layers.iter().map(|l| vec![0.0; 3 * l.width]).collect();
        seeds[3].fill(1.0);
        let (dp, di) = reference::backward(mlp, &wide(&params), &[&wide(&a), &wide(&b)], 3, &seeds);
        assert_close("params", &read_values(pt.grad(&grads).unwrap()), &dp, 1e-4);
        assert_close("input", &read_values(at.grad(&grads).unwrap()), &di[0], 1e-4);
        assert_close("input", &read_values(bt.grad(&grads).unwrap()), &di[1], 1e-4);
    }
}
