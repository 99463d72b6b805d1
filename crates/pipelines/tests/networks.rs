//! Networks and files together: weights that PyTorch wrote, and a run that goes on from a checkpoint.

use diorama_data::{checkpoint, weights as files};
use diorama_nets::layers::{BatchNorm, Conv2d, Init, Linear};
use diorama_nets::ops::{self, Activation, Conv, Error};
use diorama_nets::param::{self, Mode, Module, Visitor};
use diorama_nets::train::{self, Gradients, Optimizer, Rule};
use diorama_nets::weights::{KeyMap, Strictness, load};
use diorama_nets::{Device, Tensor, TensorData};
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
