//! An optimizer's step by burn's ops, for weights that live on a GPU: the same formulas as `diorama-kernels`' `weight_step`.

use burn::tensor::Tensor;
use diorama_kernels::ops::weight_step::{Rule, Step};

/// Moments of a weight on a device; `None` before the first step, and where the rule has none.
#[derive(Clone, Debug, Default)]
pub(super) struct DeviceMoments {
    pub first: Option<Tensor<1>>,
    pub second: Option<Tensor<1>>,
}

/// The weight after a step; the moments are replaced.
pub(super) fn step(s: &Step, w: Tensor<1>, moments: &mut DeviceMoments, g: Tensor<1>) -> Tensor<1> {
    let mut g = g * s.scale;
    if s.limit.is_finite() {
        g = g.clamp(-s.limit, s.limit);
    }
    match s.rule {
        Rule::Sgd { momentum, nesterov } => {
            let g = g + w.clone() * s.weight_decay;
            if s.rule.moments() == 0 {
                return w - g * s.rate;
            }
            let m = moments.first.take().map_or(g.clone(), |m| m * momentum + g.clone());
            moments.first = Some(m.clone());
            w - if nesterov { g + m * momentum } else { m } * s.rate
        }
        Rule::Adam { beta1, beta2, epsilon } | Rule::AdamW { beta1, beta2, epsilon } => {
            let (mut w, mut g) = (w, g);
            if matches!(s.rule, Rule::Adam { .. }) {
                g = g + w.clone() * s.weight_decay;
            } else {
                w = w * (1.0 - s.rate * s.weight_decay);
            }
            let blend = |old: Option<Tensor<1>>, new: Tensor<1>, keep: f32| {
                let new = new * (1.0 - keep);
                old.map_or(new.clone(), |old| old * keep + new)
            };
            let m = blend(moments.first.take(), g.clone(), beta1);
            let v = blend(moments.second.take(), g.clone() * g, beta2);
            (moments.first, moments.second) = (Some(m.clone()), Some(v.clone()));
            let (b1, b2, t) = (beta1 as f64, beta2 as f64, s.t as f64);
            let root = (1.0 / (1.0 - b2.powf(t))).sqrt() as f32;
            w - m * ((s.rate as f64 / (1.0 - b1.powf(t))) as f32) / (v.sqrt() * root + epsilon)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::{Device, TensorData};
    use diorama_kernels::ops::weight_step::reference;
    use diorama_testkit::{assert_close, random, wide};

    #[test]
    fn steps_equal_the_reference() {
        let rules = [
            Rule::SGD,
            Rule::Sgd { momentum: 0.9, nesterov: false },
            Rule::Sgd { momentum: 0.9, nesterov: true },
            Rule::ADAM,
            Rule::ADAM_W,
        ];
        for rule in rules {
            let tensor = |v: Vec<f32>| Tensor::<1>::from_data(TensorData::new(v, [33]), &Device::flex());
            let (mut w, mut moments) = (tensor(random(33, 1)), DeviceMoments::default());
            let len = |k: usize| if rule.moments() >= k { 33 } else { 0 };
            let (mut want, mut m, mut v) = (wide(&random(33, 1)), vec![0.0; len(1)], vec![0.0; len(2)]);
            for t in 1..=4 {
                let s = Step { rule, rate: 0.02, weight_decay: 0.1, t, scale: 0.7, limit: 0.4 };
                let g = random(33, 10 + t);
                w = step(&s, w, &mut moments, tensor(g.clone()));
                reference::step(&s, &mut want, &mut m, &mut v, &wide(&g));
            }
            assert_close(&format!("{rule:?}"), &crate::read_values(w), &want, 1e-5);
        }
    }
}
