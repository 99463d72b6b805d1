use super::*;
use crate::simd::{Level, with_level};
use diorama_testkit::{assert_close, assert_gradient, random, wide};

fn layer(i: usize, o: usize, kernel: [usize; 2], stride: [usize; 2]) -> ConvTranspose2d {
    ConvTranspose2d { kernel, stride, ..ConvTranspose2d::new(i, o, 1, 1) }
}

fn cases() -> Vec<(ConvTranspose2d, Images)> {
    let images = |batch, height, width| Images { batch, height, width };
    vec![
        (layer(2, 3, [3, 3], [1, 1]), images(0, 3, 4)),
        (layer(1, 1, [1, 1], [1, 1]), images(1, 1, 1)),
        (layer(7, 5, [1, 1], [2, 3]), images(2, 4, 5)),
        (ConvTranspose2d { padding: [1; 2], ..layer(20, 18, [4, 4], [2, 2]) }, images(2, 9, 21)),
        (layer(17, 9, [2, 2], [2, 2]), images(3, 5, 7)),
        (ConvTranspose2d { padding: [1; 2], output_padding: [1; 2], ..layer(8, 10, [3, 3], [2, 2]) }, images(2, 8, 9)),
        (ConvTranspose2d { padding: [1, 0], output_padding: [0, 2], ..layer(5, 4, [3, 2], [2, 4]) }, images(1, 6, 5)),
        (ConvTranspose2d { padding: [1; 2], ..layer(6, 11, [3, 3], [1, 1]) }, images(2, 10, 40)),
        (ConvTranspose2d { padding: [2, 1], dilation: [2, 3], ..layer(4, 4, [3, 3], [2, 1]) }, images(1, 7, 9)),
        (ConvTranspose2d { dilation: [2, 2], output_padding: [1, 0], ..layer(3, 5, [2, 3], [1, 2]) }, images(2, 4, 6)),
        (ConvTranspose2d { groups: 2, padding: [1; 2], ..layer(6, 8, [4, 4], [2, 2]) }, images(2, 7, 6)),
        (ConvTranspose2d { padding: [1; 2], ..layer(130, 9, [4, 4], [2, 2]) }, images(2, 9, 24)),
        (ConvTranspose2d { groups: 2, ..layer(500, 6, [2, 2], [2, 2]) }, images(2, 5, 17)),
        (layer(9, 4, [1, 1], [2, 2]), images(2, 5, 6)),
        (ConvTranspose2d { padding: [1; 2], ..layer(70, 10, [4, 4], [2, 2]) }, images(1, 6, 7)),
        (ConvTranspose2d { groups: 2, padding: [1; 2], ..layer(120, 10, [4, 4], [2, 2]) }, images(1, 6, 7)),
        (ConvTranspose2d { padding: [1; 2], ..layer(6, 9, [4, 4], [2, 2]) }, images(1, 14, 17)),
        (ConvTranspose2d { padding: [1; 2], ..layer(150, 9, [4, 4], [2, 2]) }, images(1, 14, 17)),
        (layer(260, 9, [2, 2], [2, 2]), images(1, 5, 7)),
        (layer(150, 9, [2, 2], [2, 2]), images(1, 14, 17)),
        (ConvTranspose2d { padding: [1; 2], ..layer(6, 150, [4, 4], [2, 2]) }, images(1, 3, 5)),
        (ConvTranspose2d { padding: [0, 1], ..layer(6, 9, [3, 4], [3, 2]) }, images(2, 5, 7)),
        (ConvTranspose2d { output_padding: [0, 1], ..layer(6, 9, [2, 1], [1, 2]) }, images(2, 5, 7)),
        (ConvTranspose2d { padding: [0, 1], ..layer(6, 9, [2, 4], [1, 2]) }, images(2, 5, 30)),
        (ConvTranspose2d { padding: [0, 2], ..layer(2, 4, [1, 1], [1, 4]) }, images(1, 300, 2)),
        (layer(20, 5, [2, 2], [2, 2]), images(2, 3, 16)),
        (ConvTranspose2d { groups: 2, ..layer(12, 6, [2, 2], [2, 2]) }, images(2, 9, 32)),
        (layer(7, 9, [3, 2], [3, 2]), images(1, 5, 48)),
        (layer(6, 9, [1, 2], [1, 2]), images(2, 5, 24)),
        (layer(6, 9, [2, 2], [3, 2]), images(2, 3, 16)),
        (layer(200, 4, [2, 2], [2, 2]), images(1, 2, 16)),
        (ConvTranspose2d { groups: 5, padding: [1; 2], ..layer(5, 5, [4, 4], [2, 2]) }, images(2, 7, 33)),
    ]
}

fn tensors(c: &ConvTranspose2d, images: &Images) -> [Vec<f32>; 4] {
    let mut w = random(c.weights_len(), 2);
    w.iter_mut().for_each(|w| *w /= (c.channels_in as f32).sqrt());
    let outputs = images.batch * c.channels_out * c.output(images).pixels();
    [random(images.batch * c.channels_in * images.pixels(), 1), w, random(c.channels_out, 3), random(outputs, 4)]
}

fn check(c: &ConvTranspose2d, images: &Images) {
    let what = format!("{c:?} on {images:?}");
    let [x, w, b, d] = tensors(c, images);
    let wides = [wide(&x), wide(&w), wide(&b), wide(&d)];
    let (mut out, mut before) = (vec![9.0; d.len()], vec![9.0; d.len()]);
    cpu::forward(c, images, &x, &w, &b, &mut out, Some(&mut before));
    assert_close(&format!("out of {what}"), &out, &reference::forward(c, images, &wides[0], &wides[1], &wides[2]), 1e-4);
    let mut alone = vec![9.0; d.len()];
    cpu::forward(c, images, &x, &w, &b, &mut alone, None);
    assert_eq!(alone, out, "out without what was before the activation of {what}");
    let (rx, rw, rb) = reference::backward(c, images, &wides[0], &wides[1], &wides[2], &wides[3]);
    let (mut dx, mut dw, mut db) = (vec![9.0; x.len()], vec![9.0; w.len()], vec![9.0; b.len()]);
    let kept = if c.activation.needs_input() { &before } else { &out };
    cpu::backward(c, images, &x, &w, kept, &d, Gradients { input: Some(&mut dx), weights: Some(&mut dw), bias: Some(&mut db) });
    assert_close(&format!("input's gradient of {what}"), &dx, &rx, 1e-4);
    assert_close(&format!("weights' gradient of {what}"), &dw, &rw, 1e-4);
    assert_close(&format!("bias' gradient of {what}"), &db, &rb, 1e-4);
}

#[test]
fn every_shape_and_activation_matches_the_reference_on_every_level() {
    for level in Level::available() {
        with_level(level, || {
            for (c, images) in cases() {
                for activation in [Activation::None, Activation::LeakyRelu(0.1), Activation::Silu] {
                    check(&ConvTranspose2d { activation, ..c }, &images);
                }
            }
        });
    }
}

#[test]
fn reference_gradients_match_central_differences() {
    let c = ConvTranspose2d { groups: 2, padding: [1, 0], activation: Activation::Tanh, ..layer(4, 2, [3, 2], [2, 1]) };
    let images = Images { batch: 2, height: 3, width: 4 };
    let [x, w, b, d] = tensors(&c, &images).map(|v| wide(&v));
    let (dx, dw, db) = reference::backward(&c, &images, &x, &w, &b, &d);
    let loss = |x: &[f64], w: &[f64], b: &[f64]| reference::forward(&c, &images, x, w, b).iter().zip(&d).map(|(a, b)| a * b).sum::<f64>();
    assert_gradient("x", &dx, &x, 1e-6, |x| loss(x, &w, &b));
    assert_gradient("w", &dw, &w, 1e-6, |w| loss(&x, w, &b));
    assert_gradient("b", &db, &b, 1e-6, |b| loss(&x, &w, b));
}

#[test]
#[should_panic(expected = "output padding is less than stride")]
fn output_padding_is_limited() {
    ConvTranspose2d { output_padding: [2; 2], ..ConvTranspose2d::new(1, 1, 3, 2) }.output(&Images { batch: 1, height: 2, width: 2 });
}
