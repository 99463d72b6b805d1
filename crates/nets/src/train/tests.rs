//! Training of a small network of layers that exist in any case: resuming, freezing, clipping, averages, memory.

use super::*;
use crate::bridge::linear;
use crate::param::{self, Kind, Mode, Module, Param, Visitor};
use burn::tensor::{Device, Tensor, TensorData};
use diorama_geom::rng::Rng;
use diorama_kernels::ops::linear::Activation;
use diorama_testkit::random;

struct Layer {
    weight: Param,
    bias: Param,
}

impl Module for Layer {
    fn visit(&self, v: &mut Visitor) {
        v.param("weight", &self.weight);
        v.param("bias", &self.bias);
    }
}

/// Two fully connected layers.
struct Net {
    hidden: Layer,
    head: Layer,
}

impl Module for Net {
    fn visit(&self, v: &mut Visitor) {
        v.part("hidden", &self.hidden);
        v.part("head", &self.head);
    }
}

impl Net {
    fn new(seed: u64) -> Net {
        let d = Device::flex();
        let layer = |k: usize, n: usize, stream: u64| Layer {
            weight: Param::uniform(&[k, n], (3.0 / k as f32).sqrt(), &Rng::new(seed, stream), &d),
            bias: Param::constant(Kind::Weight, &[1, n], 0.0, &d),
        };
        Net { hidden: layer(5, 24, 0), head: layer(24, 2, 1) }
    }

    fn forward(&self, x: Tensor<2>, mode: Mode) -> Tensor<2> {
        let l = |l: &Layer, x, a| linear(x, l.weight.tensor(mode), Some(l.bias.tensor(mode)), a).unwrap();
        l(&self.head, l(&self.hidden, x, Activation::Relu), Activation::None)
    }

    fn loss(&self, step: u64) -> Tensor<1> {
        let x = random(64 * 5, 100 + step);
        let y: Vec<f32> = x.chunks(5).flat_map(|x| [x[0] * x[1], (x[2] - x[3]).abs()]).collect();
        let t = |v: Vec<f32>, n: usize| Tensor::<2>::from_data(TensorData::new(v, [64, n]), &Device::flex());
        (self.forward(t(x, 5), Mode::Train) - t(y, 2)).powf_scalar(2.0).mean()
    }

    fn step(&self, o: &mut Optimizer) -> f32 {
        let loss = self.loss(o.steps());
        let value = crate::read_values(loss.clone())[0];
        let mut g = Gradients::take(self, loss.backward());
        g.clip_norm(1.0);
        let rate = Schedule::cosine(2, 400).scale(o.steps());
        o.step(self, g, rate);
        value
    }
}

fn adam(net: &Net) -> Optimizer {
    Optimizer::new(net, Rule::ADAM_W, 1e-2, 1e-3, &[])
}

#[test]
fn the_loss_falls() {
    let net = Net::new(1);
    let mut o = adam(&net);
    let losses: Vec<f32> = (0..300).map(|_| net.step(&mut o)).collect();
    let mean = |l: &[f32]| l.iter().sum::<f32>() / l.len() as f32;
    assert!(mean(&losses[290..]) < 0.1 * mean(&losses[..10]), "{losses:?}");
    assert!(!net.forward(Tensor::zeros([1, 5], &Device::flex()), Mode::Eval).is_autodiff());
}

#[test]
fn a_resumed_run_is_the_same_bit_for_bit() {
    for rule in [Rule::ADAM, Rule::ADAM_W, Rule::Sgd { momentum: 0.9, nesterov: true }, Rule::SGD] {
        let whole = Net::new(2);
        let mut o = Optimizer::new(&whole, rule, 1e-2, 1e-3, &[]);
        let mut average = Ema::new(&whole, 0.99);
        let go = |net: &Net, o: &mut Optimizer, average: &mut Ema| {
            for _ in 0..5 {
                net.step(o);
                average.update(net);
            }
        };
        go(&whole, &mut o, &mut average);
        let saved = saved(&whole, &o, Some(&average));
        go(&whole, &mut o, &mut average);

        let resumed = Net::new(77);
        let mut o2 = Optimizer::new(&resumed, rule, 1e-2, 1e-3, &[]);
        let mut average2 = Ema::new(&resumed, 0.99);
        resume(&resumed, &mut o2, Some(&mut average2), &saved).unwrap();
        go(&resumed, &mut o2, &mut average2);
        assert_eq!(param::arrays(&whole), param::arrays(&resumed), "{rule:?}");
        assert_eq!((o.state(), average.state()), (o2.state(), average2.state()));
        assert!(o2.restore(&resumed, &saved[..3]).is_err());
    }
}

#[test]
fn what_cannot_be_resumed_is_named_and_changes_nothing() {
    let (net, other) = (Net::new(8), Net::new(9));
    let (mut o, mut o2) = (adam(&net), adam(&other));
    let (average, mut average2) = (Ema::new(&net, 0.9), Ema::new(&other, 0.9));
    net.step(&mut o);
    other.step(&mut o2);
    let all = saved(&net, &o, Some(&average));
    let before = saved(&other, &o2, Some(&average2));
    for gone in ["head.bias", "optimizer.second.hidden.weight", "ema.head.weight", "ema_updates"] {
        let rest: Vec<_> = all.iter().filter(|a| a.name != gone).cloned().collect();
        let e = resume(&other, &mut o2, Some(&mut average2), &rest).unwrap_err().to_string();
        assert!(e.contains(&format!("{gone} is missing")), "{gone}: {e}");
        assert_eq!(saved(&other, &o2, Some(&average2)), before, "{gone}");
    }
}

#[test]
fn frozen_weights_have_no_gradient_and_stay() {
    let net = Net::new(3);
    let groups = [Group::of(|n| n.starts_with("hidden")).frozen()];
    let mut o = Optimizer::new(&net, Rule::ADAM, 1e-2, 0.0, &groups);
    let before = param::arrays(&net);
    let g = Gradients::take(&net, net.loss(0).backward());
    assert!((0..4).map(|i| g.get(i).is_some()).eq([false, false, true, true]));
    o.step(&net, g, 1.0);
    let after = param::arrays(&net);
    assert!((0..4).map(|i| before[i] == after[i]).eq([true, true, false, false]));
    assert!(o.state().iter().all(|a| !a.name.contains("hidden")));
}

#[test]
fn groups_have_rates_and_decay_of_their_own() {
    let net = Net::new(4);
    let groups = [Group::of(|n| n.ends_with("bias")).rate_scale(0.0), Group::of(|n| n == "head.weight").weight_decay(5.0)];
    let mut o = Optimizer::new(&net, Rule::SGD, 0.1, 0.0, &groups);
    let before = param::arrays(&net);
    let g = Gradients::take(&net, net.loss(0).backward());
    let d: Vec<f32> = g.get(2).unwrap().to_vec();
    o.step(&net, g, 1.0);
    let after = param::arrays(&net);
    assert_eq!(before[1], after[1]);
    for i in 0..d.len() {
        let want = before[2].values[i] - 0.1 * (d[i] + 5.0 * before[2].values[i]);
        assert!((after[2].values[i] - want).abs() < 1e-6);
    }
}

#[test]
fn gradients_are_clipped_by_norm_and_by_value() {
    let net = Net::new(5);
    let take = || Gradients::take(&net, net.loss(0).backward());
    let mut g = take();
    let norm = g.norm();
    assert_eq!(g.clip_norm(norm * 2.0), norm);
    assert_eq!(g.norm(), norm);
    g.clip_norm(norm / 4.0);
    assert!((g.norm() - norm / 4.0).abs() < 1e-6 * norm);
    let before = param::arrays(&net);
    let mut g = take();
    let raw = g.get(2).unwrap().to_vec();
    g.clip_value(1e-3);
    Optimizer::new(&net, Rule::SGD, 1.0, 0.0, &[]).step(&net, g, 1.0);
    let after = param::arrays(&net);
    let moved = before[2].values.iter().zip(&after[2].values).zip(&raw);
    assert!(raw.iter().any(|g| g.abs() > 1e-3));
    moved.for_each(|((b, a), g)| assert!((b - a - g.clamp(-1e-3, 1e-3)).abs() < 1e-6));
}

#[test]
fn gradients_of_two_halves_add_up() {
    let net = Net::new(6);
    let mut a = Gradients::take(&net, net.loss(0).backward());
    let b = Gradients::take(&net, net.loss(1).backward());
    let sum = Gradients::take(&net, (net.loss(0) + net.loss(1)).backward());
    a.add(&b);
    for i in 0..4 {
        let want: Vec<f64> = sum.get(i).unwrap().iter().map(|v| *v as f64).collect();
        diorama_testkit::assert_close("sum", &a.get(i).unwrap(), &want, 1e-5);
    }
}

#[test]
fn the_average_lags_behind_and_can_be_swapped_in() {
    let net = Net::new(7);
    let mut average = Ema::new(&net, 0.5);
    let start = param::arrays(&net)[0].values[0];
    net.hidden.weight.write(|v| v[0] = start + 1.0);
    // The first update keeps a tenth, the second two elevenths.
    average.update(&net);
    assert!((average.arrays()[0].values[0] - (start + 0.9)).abs() < 1e-6);
    average.swap(&net);
    assert!((net.hidden.weight.values()[0] - (start + 0.9)).abs() < 1e-6);
    average.swap(&net);
    assert_eq!(net.hidden.weight.values()[0], start + 1.0);
}
