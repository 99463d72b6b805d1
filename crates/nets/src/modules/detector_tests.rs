//! Detectors against PyTorch with the same weights: outputs, and the loss and all gradients of a step. `benches/peers/detectors_reference.py`
//! made the fixtures.

use super::tests::Fixture;
use super::*;
use crate::layers::Init;
use crate::ops::{self, Activation};
use crate::param::{self, Kind, Mode, Module};
use crate::train::Gradients;
use crate::weights::KeyMap;
use burn::tensor::{Device, Tensor};

/// The backbone of the tests; the script has its counterpart.
const TINY: ResNetSettings = ResNetSettings { width: 2, ..ResNetSettings::TINY };

fn device() -> Device {
    Device::flex()
}

/// Compares the loss and the gradients of all weights.
fn check_step(fixture: &Fixture, net: &dyn Module, loss: Tensor<1>) {
    fixture.check_values("loss", &crate::read_values(loss.clone()));
    let gradients = Gradients::take(net, loss.backward());
    let mut i = 0;
    param::visit(net, &mut |name, p| {
        if p.kind() == Kind::Weight {
            fixture.check_values(&format!("grad.{name}"), &gradients.get(i).unwrap());
        }
        i += 1;
    });
}

#[test]
fn east_learns_as_in_pytorch() {
    let net = East::new(&mut Init::new(1, &device()), EastSettings { backbone: TINY, widths: [4, 3, 2] });
    let fixture = Fixture::read("east");
    fixture.load(&net, &KeyMap::PLAIN);
    let image = || fixture.tensor::<4>("image", &device());
    let maps = net.forward(image(), Mode::Eval).unwrap();
    fixture.check("eval.0", maps.score);
    fixture.check("eval.1", maps.geometry);
    let truth = |i: usize| fixture.tensor::<4>(&format!("truth.{i}"), &device());
    let truth = EastTruth { score: truth(0), weight: truth(1), geometry: truth(2) };
    let loss = east_loss(&net.forward(image(), Mode::Train).unwrap(), &truth);
    check_step(&fixture, &net, loss.total);
}

#[test]
fn db_learns_as_in_pytorch() {
    let net = Db::new(&mut Init::new(1, &device()), DbSettings { backbone: TINY, inner: 4, level: 2 });
    let fixture = Fixture::read("db");
    fixture.load(&net, &KeyMap::PLAIN);
    let image = || fixture.tensor::<4>("image", &device());
    fixture.check("eval.0", net.probability(image()).unwrap());
    let truth = |i: usize| fixture.tensor::<4>(&format!("truth.{i}"), &device());
    let truth = DbTruth { shrunk: truth(0), weight: truth(1), threshold: truth(2), threshold_weight: truth(3) };
    let loss = db_loss(&net.forward(image(), Mode::Train).unwrap(), &truth).unwrap();
    check_step(&fixture, &net, loss.total);
}

#[test]
fn images_without_writing_have_finite_losses_and_gradients() {
    let zeros = |c: usize, side: usize| Tensor::<4>::zeros([2, c, side, side], &device());
    let x = || Tensor::<4>::ones([2, 3, 64, 64], &device()) * 0.5;
    let east = East::new(&mut Init::new(2, &device()), EastSettings { backbone: TINY, widths: [4, 3, 2] });
    let truth = EastTruth { score: zeros(1, 16), weight: zeros(1, 16).add_scalar(1.0), geometry: zeros(5, 16) };
    let loss = east_loss(&east.forward(x(), Mode::Train).unwrap(), &truth);
    assert!(crate::read_values(loss.total.clone())[0].is_finite());
    assert!(Gradients::take(&east, loss.total.backward()).norm().is_finite());
    let db = Db::new(&mut Init::new(2, &device()), DbSettings { backbone: TINY, inner: 4, level: 2 });
    let [shrunk, threshold, threshold_weight] = [zeros(1, 64), zeros(1, 64), zeros(1, 64)];
    let truth = DbTruth { shrunk, weight: zeros(1, 64).add_scalar(1.0), threshold, threshold_weight };
    let maps = db.forward(x(), Mode::Train).unwrap();
    let loss = db_loss(&maps, &truth).unwrap();
    assert!(Gradients::take(&db, loss.total.backward()).norm().is_finite());
    assert!(db_loss(&DbMaps { threshold: None, ..maps }, &truth).is_err());
}

#[test]
fn small_detectors_are_small_and_large_ones_have_the_known_size() {
    let init = || Init::new(1, &device());
    let [east, db] = [param::count(&East::new(&mut init(), EastSettings::TINY)), param::count(&Db::new(&mut init(), DbSettings::TINY))];
    println!("tiny: EAST {east} weights, DB {db}");
    assert!(east <= 450_000 && db <= 450_000, "{east} {db}");
    let large = param::count(&Db::new(&mut init(), DbSettings::RESNET_50));
    // ResNet-50 without its classifier has 23,508,032.
    assert!((25_000_000..26_500_000).contains(&large), "{large}");
}

#[test]
fn outputs_have_the_sizes_that_decoding_expects() {
    let x = Tensor::<4>::zeros([1, 3, 64, 96], &device());
    let east = East::new(&mut Init::new(1, &device()), EastSettings::TINY).forward(x.clone(), Mode::Eval).unwrap();
    assert_eq!((east.score.dims(), east.geometry.dims()), ([1, 1, 16, 24], [1, 5, 16, 24]));
    let db = Db::new(&mut Init::new(1, &device()), DbSettings::TINY);
    let maps = db.forward(x.clone(), Mode::Eval).unwrap();
    assert!(maps.logits.dims() == [1, 1, 64, 96] && maps.threshold.is_none());
    let again = ops::activation(maps.logits, Activation::Sigmoid).unwrap();
    assert_eq!(crate::read_values(again), crate::read_values(db.probability(x).unwrap()));
}
