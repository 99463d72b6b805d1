use super::*;
use crate::gemm::has_bf16;
use crate::ops::activation::tests::ALL as ACTIVATIONS;
use crate::simd::{Level, with_level};
use diorama_testkit::{assert_close, assert_gradient, random, wide};

fn conv(i: usize, o: usize, kernel: [usize; 2]) -> Conv2d {
    Conv2d { kernel, ..Conv2d::new(i, o, 1) }
}

/// Every kind of layer with images of odd sizes.
fn cases() -> Vec<(Conv2d, Images)> {
    let images = |batch, height, width| Images { batch, height, width };
    let same = |c: Conv2d| Conv2d { padding: [c.kernel[0] / 2, c.kernel[1] / 2], ..c };
    vec![
        (conv(3, 4, [1, 1]), images(0, 4, 4)),
        (conv(1, 1, [1, 1]), images(1, 1, 1)),
        (conv(5, 7, [1, 1]), images(2, 3, 5)),
        (conv(40, 33, [1, 1]), images(3, 9, 11)),
        (conv(8, 8, [3, 3]), images(1, 3, 3)),
        (same(conv(3, 5, [3, 3])), images(2, 1, 1)),
        (same(conv(16, 20, [3, 3])), images(2, 19, 67)),
        (same(conv(70, 9, [3, 3])), images(1, 40, 41)),
        (same(conv(24, 17, [3, 3])), images(5, 5, 6)),
        (conv(16, 24, [3, 3]), images(2, 21, 34)),
        (Conv2d { padding: [2, 0], ..conv(65, 20, [3, 3]) }, images(1, 16, 49)),
        (same(conv(24, 20, [3, 3])), images(1, 37, 64)),
        (Conv2d { stride: [2, 2], ..same(conv(70, 43, [3, 3])) }, images(1, 61, 128)),
        (Conv2d { stride: [2, 2], padding: [0, 2], ..conv(33, 32, [3, 3]) }, images(1, 75, 90)),
        (Conv2d { groups: 2, stride: [2, 2], ..same(conv(64, 64, [3, 3])) }, images(2, 64, 64)),
        (Conv2d { groups: 2, ..same(conv(48, 34, [3, 3])) }, images(2, 24, 27)),
        (same(conv(4, 6, [5, 3])), images(1, 13, 9)),
        (same(conv(3, 10, [7, 7])), images(1, 20, 23)),
        (Conv2d { stride: [2, 2], ..same(conv(3, 10, [7, 7])) }, images(2, 21, 30)),
        (Conv2d { stride: [2, 2], ..same(conv(18, 12, [3, 3])) }, images(2, 17, 18)),
        (Conv2d { stride: [2, 2], ..conv(6, 9, [1, 1]) }, images(2, 7, 8)),
        (Conv2d { stride: [3, 2], padding: [2, 0], ..conv(5, 4, [2, 5]) }, images(2, 14, 15)),
        (Conv2d { stride: [1, 4], padding: [1, 3], ..conv(2, 3, [4, 4]) }, images(1, 6, 21)),
        (Conv2d { dilation: [2, 3], padding: [2, 3], ..conv(6, 8, [3, 3]) }, images(2, 12, 25)),
        (Conv2d { stride: [2, 2], ..conv(6, 9, [2, 2]) }, images(2, 8, 64)),
        (Conv2d { groups: 2, stride: [2, 2], ..conv(8, 10, [2, 2]) }, images(1, 4, 34)),
        (Conv2d { dilation: [2, 2], stride: [2, 2], padding: [1, 4], ..conv(6, 5, [3, 4]) }, images(2, 12, 13)),
        (Conv2d { padding: [4, 5], ..conv(2, 3, [2, 2]) }, images(1, 2, 3)),
        (Conv2d { groups: 3, ..same(conv(12, 9, [3, 3])) }, images(2, 11, 19)),
        (Conv2d { groups: 2, stride: [2, 2], ..same(conv(40, 20, [3, 3])) }, images(1, 16, 15)),
        (Conv2d { groups: 6, ..same(conv(6, 6, [3, 3])) }, images(2, 13, 37)),
        (conv(300, 9, [1, 1]), images(2, 8, 24)),
        (Conv2d { groups: 2, ..conv(80, 20, [1, 1]) }, images(3, 6, 32)),
        (Conv2d { groups: 2, stride: [2, 2], ..same(conv(150, 10, [3, 3])) }, images(2, 20, 31)),
        (Conv2d { groups: 6, ..same(conv(6, 12, [5, 5])) }, images(1, 9, 8)),
        (Conv2d { groups: 6, ..same(conv(6, 12, [5, 5])) }, images(1, 9, 30)),
        (Conv2d { groups: 2, stride: [2, 2], ..same(conv(2, 2, [3, 3])) }, images(2, 37, 80)),
        (Conv2d { groups: 2, stride: [1, 2], ..conv(2, 2, [1, 2]) }, images(1, 3, 64)),
        (Conv2d { groups: 3, stride: [2, 2], padding: [3, 2], ..conv(3, 3, [2, 3]) }, images(2, 1, 71)),
        (Conv2d { groups: 2, dilation: [4, 1], padding: [5, 1], ..conv(2, 2, [3, 3]) }, images(2, 2, 40)),
        (Conv2d { groups: 7, stride: [2, 2], ..same(conv(7, 7, [3, 3])) }, images(3, 20, 33)),
        (Conv2d { groups: 3, stride: [2, 2], ..same(conv(3, 3, [3, 3])) }, images(2, 16, 134)),
        (Conv2d { groups: 3, stride: [1, 2], ..same(conv(3, 6, [3, 3])) }, images(2, 5, 140)),
        (Conv2d { groups: 3, ..same(conv(3, 6, [3, 3])) }, images(2, 7, 81)),
        (Conv2d { groups: 2, padding: [4, 7], ..conv(2, 2, [3, 5]) }, images(1, 2, 50)),
        (Conv2d { groups: 2, stride: [3, 2], padding: [0, 2], dilation: [2, 3], ..conv(2, 2, [2, 2]) }, images(2, 8, 70)),
        (conv(300, 10, [1, 1]), images(2, 6, 16)),
        (Conv2d { groups: 2, ..conv(600, 20, [1, 1]) }, images(2, 4, 24)),
        (conv(10, 300, [1, 1]), images(2, 3, 17)),
        (conv(20, 11, [1, 1]), images(3, 8, 48)),
        (Conv2d { padding: [1, 0], ..conv(5, 19, [3, 1]) }, images(2, 9, 48)),
        (Conv2d { groups: 2, ..same(conv(8, 100, [3, 3])) }, images(2, 6, 8)),
        (Conv2d { groups: 2, ..same(conv(20, 120, [5, 3])) }, images(1, 16, 16)),
        (Conv2d { groups: 2, stride: [2, 2], ..same(conv(20, 220, [3, 3])) }, images(1, 10, 12)),
        (same(conv(20, 150, [3, 3])), images(1, 4, 6)),
        (Conv2d { stride: [2, 2], ..same(conv(150, 20, [3, 3])) }, images(2, 4, 6)),
        (Conv2d { stride: [1, 4], padding: [0, 2], ..conv(4, 2, [1, 1]) }, images(1, 300, 1)),
        (Conv2d { groups: 3, stride: [1, 4], padding: [0, 2], ..conv(3, 3, [1, 1]) }, images(1, 300, 1)),
        (Conv2d { groups: 4, dilation: [3, 2], padding: [3, 1], ..conv(4, 4, [3, 3]) }, images(1, 15, 40)),
    ]
}

/// Random tensors of a layer: x, weights of variance 1 / fan-in, bias, gradient of the outputs.
fn tensors(c: &Conv2d, images: &Images) -> [Vec<f32>; 4] {
    let fan = (c.channels_in / c.groups * c.taps()) as f32;
    let mut w = random(c.weights_len(), 2);
    w.iter_mut().for_each(|w| *w /= fan.sqrt());
    let outputs = images.batch * c.channels_out * c.output(images).pixels();
    [random(images.batch * c.channels_in * images.pixels(), 1), w, random(c.channels_out, 3), random(outputs, 4)]
}

fn check(c: &Conv2d, images: &Images, biased: bool) {
    let what = format!("{c:?} on {images:?}");
    let [x, w, b, d] = tensors(c, images);
    let b = if biased { b } else { Vec::new() };
    let wides = [wide(&x), wide(&w), wide(&b), wide(&d)];
    let (mut out, mut before) = (vec![9.0; d.len()], vec![9.0; d.len()]);
    cpu::forward(c, images, &x, &w, &b, &mut out, Some(&mut before));
    assert_close(&format!("out of {what}"), &out, &reference::forward(c, images, &wides[0], &wides[1], &wides[2]), 1e-4);
    let mut alone = vec![9.0; d.len()];
    cpu::forward(c, images, &x, &w, &b, &mut alone, None);
    assert_eq!(alone, out, "out without what was before the activation of {what}");
    let linear = Conv2d { activation: Activation::None, ..*c };
    assert_close(&format!("before of {what}"), &before, &reference::forward(&linear, images, &wides[0], &wides[1], &wides[2]), 1e-4);
    let (rx, rw, rb) = reference::backward(c, images, &wides[0], &wides[1], &wides[2], &wides[3]);
    let (mut dx, mut dw, mut db) = (vec![9.0; x.len()], vec![9.0; w.len()], vec![9.0; c.channels_out]);
    let kept = if c.activation.needs_input() { &before } else { &out };
    let gradients = Gradients { input: Some(&mut dx), weights: Some(&mut dw), bias: Some(&mut db) };
    cpu::backward(c, images, &x, &w, kept, &d, gradients);
    assert_close(&format!("input's gradient of {what}"), &dx, &rx, 1e-4);
    assert_close(&format!("weights' gradient of {what}"), &dw, &rw, 1e-4);
    assert_close(&format!("bias' gradient of {what}"), &db, &rb, 1e-4);
}

#[test]
fn every_shape_matches_the_reference_on_every_level() {
    for level in Level::available() {
        with_level(level, || {
            for (c, images) in cases() {
                check(&c, &images, true);
            }
        });
    }
}

#[test]
fn every_activation_matches_the_reference_on_every_level() {
    for level in Level::available() {
        with_level(level, || {
            for activation in ACTIVATIONS {
                let c = Conv2d { activation, padding: [1; 2], ..Conv2d::new(5, 11, 3) };
                check(&c, &Images { batch: 2, height: 9, width: 14 }, false);
                let c = Conv2d { groups: 5, channels_out: 5, ..c };
                check(&c, &Images { batch: 2, height: 9, width: 14 }, true);
                check(&c, &Images { batch: 2, height: 9, width: 37 }, true);
                let c = Conv2d { activation, ..Conv2d::new(20, 11, 1) };
                check(&c, &Images { batch: 2, height: 6, width: 32 }, true);
            }
        });
    }
}

#[test]
fn reference_gradients_match_central_differences() {
    for activation in ACTIVATIONS {
        let c = Conv2d { groups: 2, stride: [2, 1], padding: [1, 0], dilation: [1, 2], activation, ..conv(4, 2, [3, 2]) };
        let images = Images { batch: 2, height: 4, width: 5 };
        let [x, w, b, d] = tensors(&c, &images).map(|v| wide(&v));
        let (dx, dw, db) = reference::backward(&c, &images, &x, &w, &b, &d);
        let loss =
            |x: &[f64], w: &[f64], b: &[f64]| reference::forward(&c, &images, x, w, b).iter().zip(&d).map(|(a, b)| a * b).sum::<f64>();
        assert_gradient("x", &dx, &x, 1e-6, |x| loss(x, &w, &b));
        assert_gradient("w", &dw, &w, 1e-6, |w| loss(&x, w, &b));
        assert_gradient("b", &db, &b, 1e-6, |b| loss(&x, &w, b));
    }
}

#[test]
fn results_do_not_depend_on_the_number_of_threads() {
    let c = Conv2d { padding: [1; 2], ..Conv2d::new(20, 24, 3) };
    let images = Images { batch: 3, height: 21, width: 50 };
    assert!(c.weight_sums(&images).shares() > 1, "pixels of the weights' gradient are summed in parts");
    // With few threads, several of these small images would share a band.
    let many = (Conv2d { stride: [2; 2], padding: [1; 2], ..Conv2d::new(20, 7, 3) }, Images { batch: 16, height: 32, width: 32 });
    // With many threads, its output channels are divided.
    let one = (Conv2d { stride: [2; 2], padding: [1; 2], ..Conv2d::new(64, 64, 3) }, Images { batch: 1, height: 64, width: 64 });
    assert!(takes_fewer_products(one.0, &one.1) && !takes_fewer_products(many.0, &many.1));
    for (c, images) in [(c, images), many, one] {
        let [x, w, b, d] = tensors(&c, &images);
        let run = |threads: usize| {
            rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(|| {
                let (mut out, mut dx, mut dw, mut db) = (vec![0.0; d.len()], vec![0.0; x.len()], vec![0.0; w.len()], vec![0.0; b.len()]);
                cpu::forward(&c, &images, &x, &w, &b, &mut out, None);
                let gradients = Gradients { input: Some(&mut dx), weights: Some(&mut dw), bias: Some(&mut db) };
                cpu::backward(&c, &images, &x, &w, &out, &d, gradients);
                [out, dx, dw, db].concat().iter().map(|v| v.to_bits()).collect::<Vec<_>>()
            })
        };
        let one = run(1);
        assert!(one == run(2) && one == run(5), "{c:?}");
    }
}

#[test]
#[should_panic(expected = "a kernel that covers 3 pixels on an image of 2")]
fn a_kernel_must_fit() {
    Conv2d::new(1, 1, 3).output(&Images { batch: 1, height: 2, width: 9 });
}

/// Whether the forward pass takes Winograd's way.
fn takes_fewer_products(c: Conv2d, images: &Images) -> bool {
    let [x, w, bias, d] = tensors(&c, images);
    let mut out = vec![0.0; d.len()];
    let t = shapes::Tensors { x: &x, weights: &w, bias: &bias, activation: c.activation, out: &mut out, before: None };
    winograd::run(&c.correlation(images), t).is_ok()
}

#[test]
fn square_kernels_on_many_channels_take_fewer_products() {
    let images = |height, width| Images { batch: 1, height, width };
    let (tiny, small, large) = (images(6, 6), images(20, 31), images(97, 128));
    let fewer = takes_fewer_products;
    for level in Level::available() {
        with_level(level, || {
            let c = Conv2d { padding: [1; 2], ..Conv2d::new(64, 64, 3) };
            let strided = Conv2d { stride: [2; 2], ..c };
            assert!(fewer(c, &small) && fewer(strided, &large), "{level:?}");
            assert!(fewer(Conv2d { groups: 2, ..c }, &small) && fewer(Conv2d { groups: 2, ..strided }, &large), "{level:?} in groups");
            assert!(!fewer(strided, &tiny) && !fewer(Conv2d { stride: [2, 1], ..c }, &large));
            assert!(!fewer(Conv2d { dilation: [2; 2], ..c }, &small) && !fewer(Conv2d { kernel: [3, 1], ..c }, &small));
            assert!(!fewer(Conv2d { channels_in: 3, ..c }, &small));
            let of_stride = |step| cases().iter().filter(|(c, images)| c.stride == [step; 2] && fewer(*c, images)).count();
            assert!(of_stride(1) >= 3 && of_stride(2) >= 3, "{level:?}: cases with few products");
        });
    }
}

#[test]
fn bf16_equals_the_convolution_of_rounded_factors() {
    if !has_bf16() {
        println!("no bf16 tiles here");
        return;
    }
    let round = |v: &[f32]| -> Vec<f32> { v.iter().map(|v| half::bf16::from_f32(*v).to_f32()).collect() };
    for (c, images) in cases().into_iter().filter(|(c, _)| c.channels_in > c.groups && c.channels_out > c.groups) {
        let what = format!("{c:?} on {images:?}");
        let c = Conv2d { precision: Precision::Bf16, activation: Activation::Relu, ..c };
        let [x, w, b, d] = tensors(&c, &images);
        let [rx, rw, rd] = [&x, &w, &d].map(|v| wide(&round(v)));
        let (mut out, mut dx) = (vec![9.0; d.len()], vec![9.0; x.len()]);
        cpu::forward(&c, &images, &x, &w, &b, &mut out, None);
        assert_close(&format!("out of {what}"), &out, &reference::forward(&c, &images, &rx, &rw, &wide(&b)), 1e-4);
        let linear = Conv2d { activation: Activation::None, ..c };
        let gradients = Gradients { input: Some(&mut dx), ..Gradients::default() };
        cpu::backward(&linear, &images, &x, &w, &out, &d, gradients);
        let want = reference::backward(&linear, &images, &rx, &rw, &wide(&b), &rd).0;
        assert_close(&format!("input's gradient of {what}"), &dx, &want, 1e-4);
    }
}
