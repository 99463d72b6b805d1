//! Every rule over several steps against the reference.

use super::*;
use diorama_testkit::{assert_close, random, wide};

const RULES: [Rule; 6] = [
    Rule::SGD,
    Rule::Sgd { momentum: 0.9, nesterov: false },
    Rule::Sgd { momentum: 0.9, nesterov: true },
    Rule::ADAM,
    Rule::ADAM_W,
    Rule::AdamW { beta1: 0.5, beta2: 0.99, epsilon: 1e-6 },
];

#[test]
fn steps_equal_the_reference() {
    for (rule, n) in RULES.into_iter().flat_map(|r| [(r, 0), (r, 1), (r, 67), (r, 40_000)]) {
        let len = |k: usize| if rule.moments() >= k { n } else { 0 };
        let (mut p, mut m, mut v) = (random(n, 1), vec![0.0; len(1)], vec![0.0; len(2)]);
        let (mut pw, mut mw, mut vw) = (wide(&p), vec![0.0; len(1)], vec![0.0; len(2)]);
        for t in 1..=4 {
            let s = Step { rule, rate: 0.02, weight_decay: 0.1, t, scale: 0.7, limit: 0.4 };
            let g = random(n, 10 + t);
            cpu::step(&s, &mut p, &mut m, &mut v, &g);
            reference::step(&s, &mut pw, &mut mw, &mut vw, &wide(&g));
        }
        assert_close(&format!("{rule:?} {n}"), &p, &pw, 1e-5);
        assert_close("first moments", &m, &mw, 1e-5);
        assert_close("second moments", &v, &vw, 1e-5);
    }
}

#[test]
fn known_first_steps() {
    let run = |rule: Rule, weight_decay: f32| {
        let (mut p, mut m, mut v) = ([1.0f64], [0.0], [0.0]);
        let s = Step { rule, rate: 0.1, weight_decay, t: 1, scale: 1.0, limit: f32::INFINITY };
        reference::step(&s, &mut p, &mut m, &mut v, &[2.0]);
        p[0]
    };
    // Adam's first step is the rate, whatever the gradient's size.
    assert!((run(Rule::ADAM, 0.0) - 0.9).abs() < 1e-6 && (run(Rule::ADAM, 0.5) - 0.9).abs() < 1e-6);
    assert!((run(Rule::ADAM_W, 0.5) - 0.85).abs() < 1e-6);
    assert!((run(Rule::SGD, 0.5) - 0.75).abs() < 1e-6);
    assert!((run(Rule::Sgd { momentum: 0.9, nesterov: true }, 0.0) - 0.62).abs() < 1e-6);
}
