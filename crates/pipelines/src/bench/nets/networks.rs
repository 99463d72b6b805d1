//! Whole networks, as an application runs them: modules, burn's graph, Adam.

use super::{NetworkFigures, Wanted};
use diorama_data::memory;
use diorama_nets::bridge::pool;
use diorama_nets::layers::{Init, Linear};
use diorama_nets::modules::{Fpn, ResNet, ResNetSettings, UNet, UNetSettings, Vgg, VggSettings, Vit, VitSettings};
use diorama_nets::ops::{self, Activation, Error};
use diorama_nets::train::{Gradients, Optimizer, Rule};
use diorama_nets::{Device, Mode, Module, OpError, Tensor, TensorData, Visitor, on_pool};

type Result<T> = std::result::Result<T, OpError>;

/// A network with its input.
pub struct Network {
    pub name: &'static str,
    make: fn() -> Box<dyn Case>,
}

pub const ALL: [Network; 5] = [
    Network { name: "mlp_384_65536", make: || Box::new(Mlp::new()) },
    Network { name: "unet_128_b8", make: || Box::new(Unet::new()) },
    Network { name: "resnet18_fpn_320_b4", make: || Box::new(Pyramid::new()) },
    Network { name: "vgg16_224", make: || Box::new(Features::new()) },
    Network { name: "vit_b_32", make: || Box::new(Transformer::new()) },
];

/// A network that knows its input; its training makes all outputs small.
trait Case: Module {
    fn outputs(&self, mode: Mode) -> Result<Vec<Tensor<2>>>;
}

impl Network {
    pub fn measure(&self, wanted: &Wanted, threads: usize) -> Result<NetworkFigures> {
        on_pool(|| ops::with_precision(wanted.precision, || self.measure_as_set(wanted, threads)))
    }

    fn measure_as_set(&self, wanted: &Wanted, threads: usize) -> Result<NetworkFigures> {
        pool::release();
        memory::reset_peak();
        let case = (self.make)();
        let before = ops::flops();
        drop(case.outputs(Mode::Eval)?);
        let flops = (ops::flops() - before) as f64;
        let forward = wanted.median(|| case.outputs(Mode::Eval).map(drop))?;
        let mut optimizer = Optimizer::new(&*case, Rule::ADAM, 1e-4, 0.0, &[]);
        let train = wanted.median(|| step(&*case, &mut optimizer))?;
        let rate = |flops: f64, seconds: f64| flops / seconds / threads as f64 / 1e9;
        Ok(NetworkFigures {
            name: self.name,
            forward_ms: forward * 1e3,
            train_ms: train * 1e3,
            peak_bytes: memory::peak_of_process(),
            forward_gflops: rate(flops, forward),
            train_gflops: rate(3.0 * flops, train),
        })
    }
}

/// Forward, loss, backward, Adam.
fn step(case: &dyn Case, optimizer: &mut Optimizer) -> Result<()> {
    let mut loss: Option<Tensor<1>> = None;
    for out in case.outputs(Mode::Train)? {
        let zeros = Tensor::zeros(out.dims(), &Device::flex());
        let term = ops::mean_error(Error::Squared, out, zeros)?;
        loss = Some(match loss {
            Some(loss) => ops::add(loss, term)?,
            None => term,
        });
    }
    let Some(loss) = loss else { return Ok(()) };
    let gradients = Gradients::take(case, loss.backward());
    optimizer.step(case, gradients, 1.0);
    Ok(())
}

fn init() -> Init {
    Init::new(1, &Device::flex())
}

/// Numbers from 0 to 1.
fn data<const D: usize>(shape: [usize; D]) -> Tensor<D> {
    let rng = diorama_geom::rng::Rng::new(1, 0);
    let n = shape.iter().product::<usize>() as u64;
    Tensor::from_data(TensorData::new((0..n).map(|i| rng.uniform(i)).collect::<Vec<f32>>(), shape), &Device::flex())
}

fn flat<const D: usize>(x: Tensor<D>) -> Tensor<2> {
    let (n, all) = (x.dims()[0], x.dims().iter().product::<usize>());
    x.reshape([n, all / n])
}

/// 64 → 384 → 384 → 384 → 64 on 65,536 rows.
struct Mlp(Vec<Linear>, Tensor<2>);

impl Mlp {
    fn new() -> Mlp {
        let mut init = init();
        let widths = [64, 384, 384, 384, 64];
        let activation = |i| if i < 3 { Activation::Relu } else { Activation::None };
        let layers = (0..4).map(|i| Linear::new(&mut init, widths[i], widths[i + 1], activation(i)));
        Mlp(layers.collect(), data([65_536, 64]))
    }
}

impl Module for Mlp {
    fn visit(&self, v: &mut Visitor) {
        v.parts("layers", &self.0);
    }
}

impl Case for Mlp {
    fn outputs(&self, mode: Mode) -> Result<Vec<Tensor<2>>> {
        Ok(vec![self.0.iter().try_fold(self.1.clone(), |x, l| l.forward(x, mode))?])
    }
}

struct Unet(UNet, Tensor<4>);

impl Unet {
    fn new() -> Unet {
        let s = UNetSettings { inputs: 3, outputs: 3, width: 32, depth: 4, groups: 8 };
        Unet(UNet::new(&mut init(), s), data([8, 3, 128, 128]))
    }
}

impl Module for Unet {
    fn visit(&self, v: &mut Visitor) {
        self.0.visit(v);
    }
}

impl Case for Unet {
    fn outputs(&self, mode: Mode) -> Result<Vec<Tensor<2>>> {
        Ok(vec![flat(self.0.forward(self.1.clone(), mode)?)])
    }
}

/// ResNet-18 with a feature pyramid of 64 channels.
struct Pyramid(ResNet, Fpn, Tensor<4>);

impl Pyramid {
    fn new() -> Pyramid {
        let (mut init, s) = (init(), ResNetSettings::RESNET_18);
        let backbone = ResNet::new(&mut init, s);
        Pyramid(backbone, Fpn::new(&mut init, s.channels(), 64), data([4, 3, 320, 320]))
    }
}

impl Module for Pyramid {
    fn visit(&self, v: &mut Visitor) {
        self.0.visit(v);
        v.part("fpn", &self.1);
    }
}

impl Case for Pyramid {
    fn outputs(&self, mode: Mode) -> Result<Vec<Tensor<2>>> {
        Ok(self.1.forward(self.0.features(self.2.clone(), mode)?, mode)?.map(flat).into())
    }
}

/// VGG16 to its last convolution.
struct Features(Vgg, Tensor<4>);

impl Features {
    fn new() -> Features {
        Features(Vgg::new(&mut init(), VggSettings::VGG_16), data([1, 3, 224, 224]))
    }
}

impl Module for Features {
    fn visit(&self, v: &mut Visitor) {
        self.0.visit(v);
    }
}

impl Case for Features {
    fn outputs(&self, mode: Mode) -> Result<Vec<Tensor<2>>> {
        Ok(self.0.features(self.1.clone(), &[(5, 3)], mode)?.into_iter().map(flat).collect())
    }
}

struct Transformer(Vit, Tensor<4>);

impl Transformer {
    fn new() -> Transformer {
        Transformer(Vit::new(&mut init(), VitSettings::B_32), data([1, 3, 224, 224]))
    }
}

impl Module for Transformer {
    fn visit(&self, v: &mut Visitor) {
        self.0.visit(v);
    }
}

impl Case for Transformer {
    fn outputs(&self, mode: Mode) -> Result<Vec<Tensor<2>>> {
        Ok(vec![flat(self.0.forward(self.1.clone(), mode)?)])
    }
}
