//! Networks against PyTorch with the same weights: outputs in evaluation and in training, and gradients of the inputs.
//! `benches/peers/nets_reference.py` made the fixtures.

use super::*;
use crate::bridge::OpError;
use crate::layers::Init;
use crate::param::{Mode, Module, Visitor};
use crate::weights::{KeyMap, Rule, Strictness, load};
use burn::tensor::{Device, Tensor, TensorData};
use diorama_geom::NamedArray;
use diorama_testkit::{compare_proven, wide};

/// Of the root mean square, as everywhere.
const TOLERANCE: f64 = 1e-4;

pub(super) struct Fixture(Vec<NamedArray>);

impl Fixture {
    pub(super) fn read(name: &str) -> Fixture {
        let path = format!("{}/tests/data/{name}.safetensors", env!("CARGO_MANIFEST_DIR"));
        let bytes = std::fs::read(path).unwrap();
        let file = safetensors::SafeTensors::deserialize(&bytes).unwrap();
        let floats = |d: &[u8]| d.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
        Fixture(file.iter().map(|(n, t)| NamedArray::new(n, t.shape(), floats(t.data()))).collect())
    }

    fn get(&self, name: &str) -> &NamedArray {
        self.0.iter().find(|a| a.name == name).unwrap_or_else(|| panic!("{name} is missing"))
    }

    pub(super) fn tensor<const D: usize>(&self, name: &str, device: &Device) -> Tensor<D> {
        let a = self.get(name);
        let shape: [usize; D] = a.shape[..].try_into().unwrap();
        Tensor::from_data(TensorData::new(a.values.clone(), shape), device)
    }

    pub(super) fn load(&self, net: &dyn Module, map: &KeyMap) {
        let of = |a: &NamedArray| Some(NamedArray { name: a.name.strip_prefix("net.")?.to_string(), ..a.clone() });
        let arrays: Vec<NamedArray> = self.0.iter().filter_map(of).collect();
        load(net, &arrays, map, Strictness::Exact).unwrap();
    }

    pub(super) fn check(&self, name: &str, got: Tensor<4>) {
        let want = self.get(name);
        assert_eq!(got.dims()[..], want.shape[..], "{name}");
        self.check_values(name, &crate::read_values(got));
    }

    pub(super) fn check_values(&self, name: &str, got: &[f32]) {
        if let Err(e) = compare_proven(got, &wide(&self.get(name).values), TOLERANCE) {
            panic!("{name}: {e}");
        }
    }
}

/// Runs a network on images in evaluation and in training, and compares outputs and the images' gradients.
fn parity(name: &str, net: &dyn Module, map: &KeyMap, run: impl Fn(Tensor<4>, Mode) -> Result<Vec<Tensor<4>>, OpError>) {
    let fixture = Fixture::read(name);
    fixture.load(net, map);
    let device = Device::flex();
    for (i, out) in run(fixture.tensor("in.0", &device), Mode::Eval).unwrap().into_iter().enumerate() {
        fixture.check(&format!("eval.{i}"), out);
    }
    let x = fixture.tensor::<4>("in.0", &device.clone().autodiff()).require_grad();
    let mut loss: Option<Tensor<1>> = None;
    for (i, out) in run(x.clone(), Mode::Train).unwrap().into_iter().enumerate() {
        fixture.check(&format!("train.{i}"), out.clone().inner());
        let term = (out * fixture.tensor(&format!("weight.{i}"), &device)).sum();
        loss = Some(loss.map_or(term.clone(), |l| l + term));
    }
    fixture.check("d_in.0", x.grad(&loss.unwrap().backward()).unwrap());
}

struct WithPyramid(ResNet, Fpn);

impl Module for WithPyramid {
    fn visit(&self, v: &mut Visitor) {
        self.0.visit(v);
        v.part("fpn", &self.1);
    }
}

fn pyramid_parity(name: &str, settings: ResNetSettings, out: usize) {
    let mut init = Init::new(1, &Device::flex());
    let backbone = ResNet::new(&mut init, settings);
    let net = WithPyramid(backbone, Fpn::new(&mut init, settings.channels(), out));
    let run = |x, mode| Ok(net.1.forward(net.0.features(x, mode)?, mode)?.into());
    parity(name, &net, &KeyMap::PLAIN, run);
}

#[test]
fn resnet_18_with_a_pyramid_equals_pytorch() {
    pyramid_parity("resnet18_fpn", ResNetSettings { width: 2, ..ResNetSettings::RESNET_18 }, 2);
}

#[test]
fn resnet_50_with_a_pyramid_equals_pytorch() {
    pyramid_parity("resnet50_fpn", ResNetSettings { width: 1, blocks: [1, 2, 1, 1], ..ResNetSettings::RESNET_50 }, 2);
}

#[test]
fn unet_equals_pytorch() {
    let settings = UNetSettings { inputs: 3, outputs: 2, width: 4, depth: 2, groups: 2 };
    let net = UNet::new(&mut Init::new(1, &Device::flex()), settings);
    parity("unet", &net, &KeyMap::PLAIN, |x, mode| Ok(vec![net.forward(x, mode)?]));
}

#[test]
fn vgg_features_equal_pytorch() {
    let cases = [
        ("vgg16", VggSettings::VGG_16, [(1, 2), (2, 2), (3, 3), (4, 3), (5, 3)]),
        ("vgg19", VggSettings::VGG_19, [(1, 2), (2, 2), (3, 4), (4, 4), (5, 4)]),
    ];
    for (name, settings, wanted) in cases {
        let net = Vgg::new(&mut Init::new(1, &Device::flex()), VggSettings { width: 1, ..settings });
        parity(name, &net, &KeyMap::PLAIN, |x, mode| net.features(x, &wanted, mode));
        let e = net.features(Tensor::zeros([1, 3, 32, 32], &Device::flex()), &[(6, 1)], Mode::Eval).unwrap_err();
        assert!(e.to_string().contains("no layer (6, 1)"), "{e}");
    }
}

#[test]
fn vit_equals_pytorch() {
    let settings = VitSettings { image_px: 16, patch_px: 8, width: 12, depth: 2, heads: 2, hidden: 20 };
    let net = Vit::new(&mut Init::new(1, &Device::flex()), settings);
    let fixture = Fixture::read("vit");
    fixture.load(&net, &VIT_KEYS);
    let device = Device::flex();
    fixture.check_values("eval.0", &crate::read_values(net.forward(fixture.tensor("in.0", &device), Mode::Eval).unwrap()));
    let x = fixture.tensor::<4>("in.0", &device.clone().autodiff()).require_grad();
    let out = net.forward(x.clone(), Mode::Train).unwrap();
    let loss = (out * fixture.tensor("weight.0", &device)).sum();
    fixture.check("d_in.0", x.grad(&loss.backward()).unwrap());
}

#[test]
fn renderer_equals_pytorch() {
    const MAP: KeyMap = KeyMap {
        rules: &[
            Rule::transpose("blocks.*.scale.weight", "blocks.*.scale.weight"),
            Rule::transpose("blocks.*.shift.weight", "blocks.*.shift.weight"),
        ],
        ignored: &[],
    };
    let settings = RendererSettings { inputs: 5, codes: 6, width: 8, blocks: 2, scale: 2 };
    let net = Renderer::new(&mut Init::new(1, &Device::flex()), settings);
    let fixture = Fixture::read("renderer");
    let code = fixture.tensor::<2>("in.1", &Device::flex().autodiff()).require_grad();
    parity("renderer", &net, &MAP, |x, mode| {
        let code = if mode == Mode::Train { code.clone() } else { code.clone().inner() };
        Ok(vec![net.forward(x, code, mode)?])
    });
    // Once more for the gradient of the vector that modulates.
    let out = net.forward(fixture.tensor("in.0", &Device::flex()), code.clone(), Mode::Train).unwrap();
    let grads = (out * fixture.tensor("weight.0", &Device::flex())).sum().backward();
    fixture.check_values("d_in.1", &crate::read_values(code.grad(&grads).unwrap()));
}

#[test]
fn discriminator_equals_pytorch() {
    let net = Discriminator::new(&mut Init::new(1, &Device::flex()), 3, 4, 2);
    parity("discriminator", &net, &KeyMap::PLAIN, |x, mode| Ok(vec![net.forward(x, mode)?]));
}

#[test]
fn full_networks_have_the_known_number_of_weights() {
    let mut init = Init::new(1, &Device::flex());
    let classes = Some(1000);
    let resnet = ResNet::new(&mut init, ResNetSettings { classes, ..ResNetSettings::RESNET_18 });
    assert_eq!(crate::param::count(&resnet), 11_689_512);
    let resnet = ResNet::new(&mut init, ResNetSettings { classes, ..ResNetSettings::RESNET_50 });
    assert_eq!(crate::param::count(&resnet), 25_557_032);
    assert_eq!(crate::param::count(&Vgg::new(&mut init, VggSettings::VGG_16)), 14_714_688);
    // vit_b_32 has 88,224,232 with its head of 769,000.
    assert_eq!(crate::param::count(&Vit::new(&mut init, VitSettings::B_32)), 87_455_232);
}
