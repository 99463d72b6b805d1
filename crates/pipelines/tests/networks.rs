//! Networks and files together: weights that PyTorch wrote, and a run that goes on from a checkpoint.

use diorama_data::{checkpoint, weights as files};
use diorama_engine::fields::{DirectionCode, Encoder, Field, RayCodes};
use diorama_engine::params::ParamGroup;
use diorama_engine::samplers::placement::Placement;
use diorama_engine::step::{GivenRays, Loss, RaySource, Scene, Step, Trainees};
use diorama_geom::contraction::Space;
use diorama_geom::rng::Rng;
use diorama_kernels::ops::adam::Adam;
use diorama_kernels::ops::field_step::{BatchLoss, FieldNet, RayGradients, RayOutputs};
use diorama_kernels::ops::frequency::Frequency;
use diorama_kernels::ops::fused_mlp::{Head, Layer, Mlp, Source};
use diorama_kernels::ops::linear as kernels;
use diorama_nets::bridge::backward_from;
use diorama_nets::layers::{BatchNorm, Conv2d, Init, Linear};
use diorama_nets::ops::{self, Activation, Conv, Error};
use diorama_nets::param::{self, Mode, Module, Visitor};
use diorama_nets::train::{self, Gradients, Optimizer, Rule};
use diorama_nets::weights::{KeyMap, Strictness, load};
use diorama_nets::{Device, Tensor, TensorData};
use diorama_pipelines::run::device::Device as RunDevice;
use diorama_testkit::random;
use std::collections::HashMap;
use std::path::Path;

/// What `benches/peers/lpips_reference.py` saved: a convolution and its normalization.
struct Small {
    conv: Conv2d,
    norm: BatchNorm,
}

impl Module for Small {
    fn visit(&self, v: &mut Visitor) {
        v.part("0", &self.conv);
        v.part("1", &self.norm);
    }
}

#[test]
fn networks_are_filled_from_files_of_pytorch() {
    for name in ["small.pth", "small_legacy.pth"] {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../data/tests/data").join(name);
        let arrays = files::read(&path, &|_| true).unwrap();
        let mut init = Init::new(1, &Device::flex());
        let net = Small { conv: Conv2d::new(&mut init, [2, 3], 2, Conv::default()), norm: BatchNorm::new(&init, 3, Activation::None) };
        let e = load(&net, &arrays, &KeyMap::PLAIN, Strictness::Exact).unwrap_err().to_string();
        assert!(e.contains("brain is unexpected"), "{e}");
        load(&net, &arrays, &KeyMap::PLAIN, Strictness::AllowUnexpected).unwrap();
        assert_eq!(net.norm.running_var.values(), [0.836_628_56, 0.400_305_15, -0.595_174_8]);
        assert_eq!(net.conv.weight.values()[..2], [-1.0, -0.932_165_15]);
        // And what is saved here is read again.
        let dir = tempfile::tempdir().unwrap();
        let saved = dir.path().join("net.safetensors");
        files::save(&saved, &param::arrays(&net), HashMap::new()).unwrap();
        let mut again = files::read(&saved, &|_| true).unwrap();
        let mut want = param::arrays(&net);
        for arrays in [&mut again, &mut want] {
            arrays.sort_by(|a, b| a.name.cmp(&b.name));
        }
        assert_eq!(again, want);
    }
}

struct Net {
    hidden: Linear,
    norm: BatchNorm,
    head: Linear,
}

impl Module for Net {
    fn visit(&self, v: &mut Visitor) {
        v.part("hidden", &self.hidden);
        v.part("norm", &self.norm);
        v.part("head", &self.head);
    }
}

impl Net {
    fn new(seed: u64) -> Net {
        let mut init = Init::new(seed, &Device::flex());
        Net {
            hidden: Linear::new(&mut init, 6, 32, Activation::None),
            norm: BatchNorm::new(&init, 32, Activation::Silu),
            head: Linear::new(&mut init, 32, 2, Activation::None),
        }
    }

    fn steps(&self, optimizer: &mut Optimizer, n: u64) {
        for _ in 0..n {
            let data = |n: usize, seed| Tensor::<2>::from_data(TensorData::new(random(48 * n, seed), [48, n]), &Device::flex());
            let (x, y) = (data(6, optimizer.steps()), data(2, 1000 + optimizer.steps()));
            let x = self.norm.forward(self.hidden.forward(x, Mode::Train).unwrap(), Mode::Train).unwrap();
            let loss = ops::mean_error(Error::Squared, self.head.forward(x, Mode::Train).unwrap(), y).unwrap();
            let gradients = Gradients::take(self, loss.backward());
            optimizer.step(self, gradients, 1.0);
        }
    }
}

#[test]
fn a_run_goes_on_from_a_checkpoint_bit_for_bit() {
    let dir = tempfile::tempdir().unwrap();
    let optimizer = |net: &Net| Optimizer::new(net, Rule::ADAM_W, 1e-2, 1e-2, &[]);
    let whole = Net::new(1);
    let mut steps = optimizer(&whole);
    whole.steps(&mut steps, 5);
    let metadata = HashMap::from([("method".into(), "network".into())]);
    checkpoint::save_arrays(dir.path(), &train::saved(&whole, &steps, None), metadata).unwrap();
    whole.steps(&mut steps, 5);

    let (saved, note) = checkpoint::load(dir.path()).unwrap();
    assert_eq!(note, None);
    let resumed = Net::new(2);
    let mut resumed_steps = optimizer(&resumed);
    train::resume(&resumed, &mut resumed_steps, None, &saved.into_arrays()).unwrap();
    resumed.steps(&mut resumed_steps, 5);
    assert_eq!(param::arrays(&whole), param::arrays(&resumed));
    assert_eq!(steps.state(), resumed_steps.state());
}

/// Codes of rays by a network: a vector per style, from its number.
struct Styles {
    hidden: Linear,
    head: Linear,
}

const STYLE: usize = 4;

impl Module for Styles {
    fn visit(&self, v: &mut Visitor) {
        v.part("hidden", &self.hidden);
        v.part("head", &self.head);
    }
}

impl Styles {
    fn new() -> Styles {
        let mut init = Init::new(5, &Device::flex());
        Styles { hidden: Linear::new(&mut init, 2, 16, Activation::Tanh), head: Linear::new(&mut init, 16, STYLE, Activation::None) }
    }

    /// `[R, STYLE]` of rays whose styles take turns.
    fn codes(&self, rays: usize, mode: Mode) -> Tensor<2> {
        let numbers: Vec<f32> = (0..rays).flat_map(|r| if r % 2 == 0 { [1.0, 0.0] } else { [0.0, 1.0] }).collect();
        let x = Tensor::<2>::from_data(TensorData::new(numbers, [rays, 2]), &Device::flex());
        self.head.forward(self.hidden.forward(x, mode).unwrap(), mode).unwrap()
    }
}

/// A field whose color is a function of position and style.
fn styled_field() -> Field {
    use Source::{Input, Layer as L};
    let encoding = Frequency { dims: 3, bands: 2, include_input: true, pi: true, window: None };
    let layers = vec![
        Layer::new(vec![Input(0), Input(1)], 32, kernels::Activation::Relu, true),
        Layer::new(vec![L(0)], 16, kernels::Activation::None, true),
    ];
    let head = |channel, activation, shift| Head { layer: 1, channel, activation, shift };
    let mlp = Mlp::new(vec![encoding.output_dims(), STYLE], layers);
    let net = FieldNet::of_color(mlp, head(3, kernels::Activation::Softplus, 2.0), head(0, kernels::Activation::Sigmoid, 0.0));
    let weights = ParamGroup::dense("weights", net.mlp.init(&Rng::new(3, 3)), Adam { rate: 5e-3, ..Adam::default() });
    let codes = RayCodes { given: vec![STYLE], ..RayCodes::new(DirectionCode::None, None) };
    Field { encoder: Encoder::Frequency(encoding), codes, net, space: Space::Cube(1.0), weights, normals: None, waves: None }
}

/// Rays of even number are red, the others blue.
struct TwoColors;

impl BatchLoss for TwoColors {
    fn batch(&self, out: &RayOutputs, g: &mut RayGradients) -> f64 {
        let rays = out.opacity.len();
        let error = |i: usize| out.values[i] - if [0, 5].contains(&(i % 6)) { 0.9 } else { 0.1 };
        g.values.iter_mut().enumerate().for_each(|(i, g)| *g = 2.0 * error(i) / rays as f32);
        (0..rays * 3).map(|i| (error(i) * error(i)) as f64).sum::<f64>() / rays as f64
    }
}

/// Losses of steps in which a network gives a field its codes; the field is frozen, or learns by an optimizer of its own.
fn train_with_styles(is_frozen: bool) -> (Vec<f64>, bool, bool) {
    let (mut field, styles) = (styled_field(), Styles::new());
    if is_frozen {
        field.freeze();
    }
    let (first_weights, first_styles) = (field.weights.values.clone(), param::arrays(&styles));
    let mut optimizer = Optimizer::new(&styles, Rule::ADAM_W, 2e-2, 0.0, &[]);
    let mut of = Trainees::of(&mut field);
    let mut device = RunDevice::open("cpu").unwrap();
    device.begin(&of, Scene { cameras: Vec::new(), near: 0.05, cube: (0.0, 1.0) }, None).unwrap();
    let rays = 64;
    let origins: Vec<f32> = random(rays * 2, 1).chunks_exact(2).flat_map(|p| [2.0, 0.5 + 0.3 * p[0], 0.5 + 0.3 * p[1]]).collect();
    let (dirs, images, jitter, background) = ([-1.0, 0.0, 0.0].repeat(rays), vec![0; rays], vec![0.5; rays], vec![0.0; rays * 3]);
    let mut losses = Vec::new();
    for number in 0..80 {
        let codes = styles.codes(rays, Mode::Train);
        let values = diorama_nets::read_values(codes.clone());
        let given = GivenRays {
            images: &images,
            origins: &origins,
            dirs: &dirs,
            far: &[],
            jitter: &jitter,
            target: &[],
            background: &background,
            codes: &[&values],
        };
        let placement = Placement::Stratified { samples: 12, noise: None };
        let step = Step::new(number, number * rays as u64, RaySource::Given(given), placement, Loss::Batch(&TwoColors));
        losses.push(device.step(&mut of, None, &step, 1).unwrap().shown.loss);
        let gradients = Gradients::take(&styles, backward_from(codes, &device.given_gradients().unwrap()[0]));
        optimizer.step(&styles, gradients, 1.0);
    }
    (losses, field.weights.values != first_weights, param::arrays(&styles) != first_styles)
}

#[test]
fn a_network_learns_through_the_codes_that_it_gives_a_field() {
    let (losses, field_moved, styles_moved) = train_with_styles(false);
    assert!(field_moved && styles_moved && losses[79] < 0.2 * losses[0], "{losses:?}");
    // The field is frozen: what is learned, the network has learned from the field's gradients.
    let (losses, field_moved, styles_moved) = train_with_styles(true);
    assert!(!field_moved && styles_moved && losses[79] < 0.97 * losses[0], "{losses:?}");
}
