//! A training step whose shapes are known allocates no memory for tensors. Alone in its process, because the pool is shared.

use burn::tensor::{Device, Tensor, TensorData};
use diorama_nets::OpError;
use diorama_nets::bridge::pool;
use diorama_nets::layers::{BatchNorm, Init, LayerNorm, Linear};
use diorama_nets::ops::{self, Activation, Error};
use diorama_nets::param::{Mode, Module, Visitor};
use diorama_nets::train::{Gradients, Optimizer, Rule};
use diorama_testkit::random;

struct Net {
    first: Linear,
    norm: BatchNorm,
    second: Linear,
    layer: LayerNorm,
    head: Linear,
}

impl Module for Net {
    fn visit(&self, v: &mut Visitor) {
        v.part("first", &self.first);
        v.part("norm", &self.norm);
        v.part("second", &self.second);
        v.part("layer", &self.layer);
        v.part("head", &self.head);
    }
}

impl Net {
    fn forward(&self, x: Tensor<2>, mode: Mode) -> Result<Tensor<2>, OpError> {
        let x = self.norm.forward(self.first.forward(x, mode)?, mode)?;
        let [x, skip] = ops::fork(x)?;
        let x = ops::add_relu(self.second.forward(x, mode)?, skip)?;
        self.head.forward(self.layer.forward(x, mode)?, mode)
    }
}

#[test]
fn steps_three_to_ten_allocate_nothing() {
    let device = Device::flex();
    let mut init = Init::new(1, &device);
    let net = Net {
        first: Linear::new(&mut init, 32, 64, Activation::None),
        norm: BatchNorm::new(&init, 64, Activation::Relu),
        second: Linear::new(&mut init, 64, 64, Activation::Gelu),
        layer: LayerNorm::new(&init, 64, 1e-6),
        head: Linear::new(&mut init, 64, 8, Activation::None),
    };
    let mut optimizer = Optimizer::new(&net, Rule::ADAM, 1e-3, 0.0, &[]);
    let data = |n: usize, seed| Tensor::<2>::from_data(TensorData::new(random(256 * n, seed), [256, n]), &device);
    let (x, y) = (data(32, 1), data(8, 2));
    let mut losses = Vec::new();
    let mut fresh = Vec::new();
    for _ in 0..10 {
        let before = pool::figures().fresh;
        let out = net.forward(x.clone(), Mode::Train).unwrap();
        let loss = ops::mean_error(Error::Squared, out, y.clone()).unwrap();
        losses.push(diorama_nets::read_values(loss.clone())[0]);
        let gradients = Gradients::take(&net, loss.backward());
        drop(loss);
        optimizer.step(&net, gradients, 1.0);
        fresh.push(pool::figures().fresh - before);
    }
    assert!(fresh[0] > 20, "the first step needs memory: {fresh:?}");
    assert_eq!(fresh[2..], [0; 8], "{fresh:?}");
    assert!(losses[9] < losses[0], "{losses:?}");
    // What no step needs any more is given back.
    drop((x, y));
    let held = pool::figures().bytes;
    (0..4).for_each(|_| pool::end_step());
    assert!(pool::figures().bytes < held / 10, "{held} bytes, now {}", pool::figures().bytes);
}
