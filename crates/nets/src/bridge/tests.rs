//! The graph that the bridge records: which gradients arrive, and that only those are computed that are wanted.

use super::*;
use burn::tensor::Device;
use std::sync::Mutex;

/// `(x·y, x + y)` elementwise.
#[derive(Debug)]
struct ProductAndSum;

impl SliceOp for ProductAndSum {
    fn name(&self) -> &'static str {
        "product and sum"
    }

    fn check(&self, shapes: &[&[usize]]) -> Result<(), OpError> {
        expect_inputs(self.name(), shapes, 2)
    }

    fn forward(&self, x: &[Values], _: &[bool]) -> Forward {
        let each = |f: fn(f32, f32) -> f32| Values::from_vec(x[0].iter().zip(&x[1][..]).map(|(a, b)| f(*a, *b)).collect(), x[0].shape());
        Forward { outputs: vec![each(|a, b| a * b), each(|a, b| a + b)], kept: Kept::of(x) }
    }

    fn backward(&self, kept: &Kept, d: &[Option<Values>], _: &[bool]) -> Vec<Option<Values>> {
        let at = |k: usize, e: usize| d[k].as_ref().map_or(0.0, |d| d[e]);
        let gradient =
            |other: &Values| Some(Values::from_vec((0..other.len()).map(|e| at(0, e) * other[e] + at(1, e)).collect(), other.shape()));
        vec![gradient(&kept.values[1]), gradient(&kept.values[0])]
    }
}

/// `Σᵢ (i + 1) xᵢ` over any number of inputs; notes which gradients it was asked for.
#[derive(Debug)]
struct WeightedSum(Arc<Mutex<Vec<bool>>>);

impl SliceOp for WeightedSum {
    fn name(&self) -> &'static str {
        "weighted sum"
    }

    fn check(&self, shapes: &[&[usize]]) -> Result<(), OpError> {
        shapes.iter().try_for_each(|s| expect_shape(self.name(), "an input", s, &[Some(2)]))
    }

    fn forward(&self, x: &[Values], _: &[bool]) -> Forward {
        let mut out = ValuesMut::zeros(&[2]);
        for (i, x) in x.iter().enumerate() {
            out.iter_mut().zip(&x[..]).for_each(|(o, x)| *o += (i + 1) as f32 * x);
        }
        Forward::one(out.freeze(), Kept::default())
    }

    fn backward(&self, _: &Kept, d: &[Option<Values>], wanted: &[bool]) -> Vec<Option<Values>> {
        *self.0.lock().unwrap() = wanted.to_vec();
        let d = d[0].as_ref().unwrap();
        let times = |i: usize| Values::from_vec(d.iter().map(|d| (i + 1) as f32 * d).collect(), &[2]);
        wanted.iter().enumerate().map(|(i, w)| w.then(|| times(i))).collect()
    }
}

fn run(use_sum: bool) -> (Vec<f32>, Vec<f32>) {
    let device = Device::flex().autodiff();
    let x = Tensor::<1>::from_floats([1.0, 2.0], &device).require_grad();
    let y = Tensor::<1>::from_floats([3.0, 5.0], &device).require_grad();
    let mut out = apply(ProductAndSum, vec![x.clone().into_dispatch(), y.clone().into_dispatch()]).unwrap();
    let sum = Tensor::<1>::from_dispatch(out.remove(1));
    let product = Tensor::<1>::from_dispatch(out.remove(0));
    let loss = if use_sum { product.sum() + sum.sum() * 10.0 } else { product.sum() };
    let grads = loss.backward();
    (read_values(x.grad(&grads).unwrap()), read_values(y.grad(&grads).unwrap()))
}

#[test]
fn gradients_arrive_from_both_outputs_or_from_one() {
    assert_eq!(run(true), (vec![13.0, 15.0], vec![11.0, 12.0]));
    assert_eq!(run(false), (vec![3.0, 5.0], vec![1.0, 2.0]));
}

#[test]
fn any_number_of_inputs_has_gradients_and_constants_cost_none() {
    for n in [1, 2, 3, 4, 5, 7, 8, 11] {
        let device = Device::flex().autodiff();
        let leaf = |i: usize| Tensor::<1>::from_floats([i as f32, 1.0], &device);
        // Every third input is a constant.
        let inputs: Vec<Tensor<1>> = (0..n).map(|i| if i % 3 == 1 { leaf(i) } else { leaf(i).require_grad() }).collect();
        let asked = Arc::new(Mutex::new(Vec::new()));
        let out: Tensor<1> = apply_one(WeightedSum(asked.clone()), inputs.iter().map(|t| t.clone().into_dispatch()).collect()).unwrap();
        let want: f32 = (0..n).map(|i| (i * (i + 1)) as f32).sum();
        assert_eq!(read_values(out.clone())[0], want);
        let grads = (out.clone() * out).sum().backward();
        for (i, t) in inputs.iter().enumerate() {
            let got = t.grad(&grads).map(read_values);
            assert_eq!(got.map(|g| g[0]), (i % 3 != 1).then_some(2.0 * want * (i + 1) as f32), "input {i} of {n}");
        }
        assert_eq!(*asked.lock().unwrap(), (0..n).map(|i| i % 3 != 1).collect::<Vec<_>>());
    }
}

#[test]
fn inputs_with_and_without_autodiff_mix() {
    let plain = Tensor::<1>::from_floats([1.0, 2.0], &Device::flex());
    let leaf = Tensor::<1>::from_floats([3.0, 4.0], &Device::flex().autodiff()).require_grad();
    let asked = Arc::new(Mutex::new(Vec::new()));
    let out: Tensor<1> = apply_one(WeightedSum(asked.clone()), vec![plain.clone().into_dispatch(), leaf.clone().into_dispatch()]).unwrap();
    assert_eq!(read_values(leaf.grad(&out.sum().backward()).unwrap()), [2.0, 2.0]);
    assert_eq!(*asked.lock().unwrap(), [false, true]);
    // Without autodiff nothing is recorded.
    let out: Tensor<1> = apply_one(WeightedSum(asked), vec![plain.into_dispatch()]).unwrap();
    assert!(!out.is_autodiff());
}

#[test]
fn wrong_calls_are_errors() {
    let asked = Arc::new(Mutex::new(Vec::new()));
    let three = Tensor::<1>::from_floats([1.0, 2.0, 3.0], &Device::flex());
    let e = apply(WeightedSum(asked.clone()), vec![three.clone().into_dispatch()]).unwrap_err();
    assert_eq!(e.to_string(), "weighted sum: an input has shape [3], expected [2]");
    let e = apply(WeightedSum(asked), vec![]).unwrap_err();
    assert_eq!(e.to_string(), "weighted sum takes 1 or more tensors, got 0");
    let e = apply(ProductAndSum, vec![three.into_dispatch()]).unwrap_err();
    assert_eq!(e, OpError::Inputs { op: "product and sum", expected: "2".into(), got: 1 });
}
