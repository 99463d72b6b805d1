use super::*;
use crate::burn_op::values;
use burn::tensor::{Device, TensorData};
use diorama_testkit::{assert_close, assert_gradient, random, wide};

#[test]
fn matches_the_reference_both_ways() {
    for counts in [vec![], vec![0], vec![3, 0, 7, 1], vec![100; 5]] {
        let mut offsets = vec![];
        cpu::exclusive(&counts, &mut offsets);
        assert_eq!(offsets, reference::exclusive(&counts));
        let x = random(*offsets.last().unwrap() as usize, 1);
        let mut out = vec![9.0; x.len()];
        cpu::inclusive(&offsets, &x, &mut out);
        assert_close("inclusive", &out, &reference::inclusive(&offsets, &wide(&x)), 1e-5);
        cpu::inclusive_backward(&offsets, &x, &mut out);
        assert_close("backward", &out, &reference::inclusive_backward(&offsets, &wide(&x)), 1e-5);
    }
}

#[test]
fn reference_gradient_matches_central_differences() {
    let (offsets, x, d) = ([0, 3, 3, 8], wide(&random(8, 1)), wide(&random(8, 2)));
    let g = reference::inclusive_backward(&offsets, &d);
    assert_gradient("x", &g, &x, 1e-6, |x| reference::inclusive(&offsets, x).iter().zip(&d).map(|(a, b)| a * b).sum());
}

#[test]
fn burn_sees_the_same_gradient() {
    let offsets = [0, 3, 8];
    let x = random(8, 1);
    let xt = Tensor::<1>::from_data(TensorData::new(x, [8]), &Device::flex().autodiff()).require_grad();
    let grads = scan(&offsets, xt.clone()).sum().backward();
    assert_close("x", &values(xt.grad(&grads).unwrap()), &[3.0, 2.0, 1.0, 5.0, 4.0, 3.0, 2.0, 1.0], 1e-6);
}
