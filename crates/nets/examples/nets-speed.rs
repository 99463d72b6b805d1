//! Times training steps and forward passes of whole networks: `nets-speed [NAME…]`; one JSON object per line. Peers:
//! `benches/peers/networks_torch.py`.

use burn::tensor::{Device, Tensor, TensorData};
use diorama_nets::bridge::pool;
use diorama_nets::layers::{Init, Linear};
use diorama_nets::modules::{Fpn, ResNet, ResNetSettings, UNet, UNetSettings, Vgg, VggSettings, Vit, VitSettings};
use diorama_nets::ops::{self, Activation, Error};
use diorama_nets::param::{Mode, Module, Visitor};
use diorama_nets::train::{Gradients, Optimizer, Rule};
use diorama_nets::{OpError, param};
use diorama_testkit::random;
use std::time::Instant;

type Result<T> = std::result::Result<T, OpError>;

fn data<const D: usize>(shape: [usize; D]) -> Tensor<D> {
    Tensor::from_data(TensorData::new(random(shape.iter().product(), 1), shape), &Device::flex())
}

/// Median of several runs in ms, after two that are not counted.
fn median(mut run: impl FnMut() -> Result<()>) -> Result<f64> {
    run()?;
    run()?;
    let begin = Instant::now();
    let mut times = Vec::new();
    while times.len() < 5 || (times.len() < 40 && begin.elapsed().as_secs_f64() < 5.0) {
        let start = Instant::now();
        run()?;
        times.push(start.elapsed().as_secs_f64() * 1e3);
    }
    times.sort_by(f64::total_cmp);
    Ok(times[times.len() / 2])
}

/// A training step: forward, loss, backward, Adam.
fn training(net: &dyn Module, forward: impl Fn(Mode) -> Result<Vec<Tensor<2>>>) -> Result<f64> {
    let mut optimizer = Optimizer::new(net, Rule::ADAM, 1e-4, 0.0, &[]);
    median(|| {
        let mut outputs = forward(Mode::Train)?.into_iter();
        let term = |out: Tensor<2>| {
            let zeros = Tensor::zeros(out.dims(), &Device::flex());
            ops::mean_error(Error::Squared, out, zeros)
        };
        let mut loss = term(outputs.next().expect("an output"))?;
        for out in outputs {
            loss = ops::add(loss, term(out)?)?;
        }
        let gradients = Gradients::take(net, loss.backward());
        drop(loss);
        optimizer.step(net, gradients, 1.0);
        Ok(())
    })
}

fn flat(x: Tensor<4>) -> Tensor<2> {
    let [n, c, h, w] = x.dims();
    x.reshape([n, c * h * w])
}

struct Mlp(Vec<Linear>);

impl Module for Mlp {
    fn visit(&self, v: &mut Visitor) {
        v.parts("layers", &self.0);
    }
}

struct Pyramid(ResNet, Fpn);

impl Module for Pyramid {
    fn visit(&self, v: &mut Visitor) {
        self.0.visit(v);
        v.part("fpn", &self.1);
    }
}

fn mlp() -> Result<(usize, f64)> {
    let mut init = Init::new(1, &Device::flex());
    let layer = |i: usize| {
        Linear::new(&mut init, [64, 384, 384, 384][i], [384, 384, 384, 64][i], if i < 3 { Activation::Relu } else { Activation::None })
    };
    let net = Mlp((0..4).map(layer).collect());
    let x = data([65_536, 64]);
    let forward = |mode| Ok(vec![net.0.iter().try_fold(x.clone(), |x, l| l.forward(x, mode))?]);
    Ok((param::count(&net), training(&net, forward)?))
}

fn resnet() -> Result<(usize, f64)> {
    let mut init = Init::new(1, &Device::flex());
    let s = ResNetSettings::RESNET_18;
    let backbone = ResNet::new(&mut init, s);
    let net = Pyramid(backbone, Fpn::new(&mut init, s.channels(), 64));
    let x = data([4, 3, 320, 320]);
    let forward = |mode| Ok(net.1.forward(net.0.features(x.clone(), mode)?, mode)?.map(flat).into());
    Ok((param::count(&net), training(&net, forward)?))
}

fn unet() -> Result<(usize, f64)> {
    let s = UNetSettings { inputs: 3, outputs: 3, width: 32, depth: 4, groups: 8 };
    let net = UNet::new(&mut Init::new(1, &Device::flex()), s);
    let x = data([8, 3, 128, 128]);
    Ok((param::count(&net), training(&net, |mode| Ok(vec![flat(net.forward(x.clone(), mode)?)]))?))
}

fn vgg() -> Result<(usize, f64)> {
    let net = Vgg::new(&mut Init::new(1, &Device::flex()), VggSettings::VGG_16);
    let x = data([1, 3, 224, 224]);
    Ok((param::count(&net), median(|| net.features(x.clone(), &[(5, 3)], Mode::Eval).map(drop))?))
}

fn vit() -> Result<(usize, f64)> {
    let net = Vit::new(&mut Init::new(1, &Device::flex()), VitSettings::B_32);
    let x = data([1, 3, 224, 224]);
    Ok((param::count(&net), median(|| net.forward(x.clone(), Mode::Eval).map(drop))?))
}

/// Adam on 96 MiB of weights, its gradient at hand.
fn adam() -> Result<(usize, f64)> {
    let mut init = Init::new(1, &Device::flex());
    let net = Mlp(vec![Linear::new(&mut init, 4096, 6144, Activation::None)]);
    let mut optimizer = Optimizer::new(&net, Rule::ADAM, 1e-4, 0.0, &[]);
    let mut times = Vec::new();
    for _ in 0..7 {
        let out = net.0[0].forward(data([4, 4096]), Mode::Train)?;
        let loss = ops::mean_error(Error::Squared, out, data([4, 6144]))?;
        let gradients = Gradients::take(&net, loss.backward());
        drop(loss);
        let start = Instant::now();
        optimizer.step(&net, gradients, 1.0);
        times.push(start.elapsed().as_secs_f64() * 1e3);
    }
    times.sort_by(f64::total_cmp);
    Ok((param::count(&net), times[3]))
}

/// Most memory of this process so far, where the system tells; else 0.
fn peak_mib() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:"));
    line.and_then(|l| l.split_whitespace().next()?.parse::<u64>().ok()).unwrap_or(0) >> 10
}

fn main() -> Result<()> {
    let names: Vec<String> = std::env::args().skip(1).collect();
    type Case = fn() -> Result<(usize, f64)>;
    let cases: [(&str, Case); 6] = [
        ("adam_96mib", adam),
        ("mlp_384_65536", mlp),
        ("unet_128_b8", unet),
        ("resnet18_fpn_320_b4", resnet),
        ("vgg16_224", vgg),
        ("vit_b_32", vit),
    ];
    for (name, run) in cases.into_iter().filter(|(n, _)| names.is_empty() || names.iter().any(|m| m == n)) {
        let before = pool::figures();
        let (weights, ms) = run()?;
        let after = pool::figures();
        let (fresh, pool_mib, peak_mib) = (after.fresh - before.fresh, after.peak_bytes >> 20, peak_mib());
        println!(
            r#"{{"name": "{name}", "weights": {weights}, "ms": {ms:.2}, "fresh": {fresh}, "pool_mib": {pool_mib}, "peak_mib": {peak_mib}}}"#
        );
        pool::release();
    }
    Ok(())
}
