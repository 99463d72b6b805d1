use super::*;
#[cfg(feature = "gpu")]
use crate::gpu::table::TOLERANCE;
use diorama_testkit::{assert_close, assert_gradient, random, wide};

#[test]
fn matches_the_reference_both_ways() {
    for c in cases::cases() {
        let (mlp, n) = (&c.mlp, c.n);
        let views: Vec<&[f32]> = c.inputs.iter().map(|v| &v[..]).collect();
        let wides: Vec<Vec<f64>> = c.inputs.iter().map(|v| wide(v)).collect();
        let wide_views: Vec<&[f64]> = wides.iter().map(|v| &v[..]).collect();
        let d = c.d.last().unwrap();
        let mut out = vec![9.0; d.len()];
        cpu::forward(mlp, &c.params, &views, n, &mut out);
        let want = reference::forward(mlp, &wide(&c.params), &wide_views, n);
        assert_close("forward", &out, want.last().unwrap(), 1e-4);
        let mut seeds: Vec<Vec<f64>> = mlp.layers.iter().map(|l| vec![0.0; n * l.width]).collect();
        *seeds.last_mut().unwrap() = wide(d);
        let (rp, ri) = reference::backward(mlp, &wide(&c.params), &wide_views, n, &seeds);
        let mut dp = vec![9.0; c.params.len()];
        let mut di: Vec<Vec<f32>> = c.inputs.iter().map(|v| vec![0.0; v.len()]).collect();
        cpu::backward(mlp, &c.params, &views, n, d, &mut dp, &mut di);
        assert_close("params", &dp, &rp, 1e-4);
        for (a, b) in di.iter().zip(&ri) {
            assert_close("input", a, b, 1e-4);
        }
    }
}

#[test]
fn reference_gradients_match_central_differences() {
    for mlp in cases::networks() {
        let params = wide(&mlp.init(&Rng::new(3, 2)));
        let inputs: Vec<Vec<f64>> = mlp.input_widths.iter().map(|k| wide(&random(2 * k, *k as u64))).collect();
        let views: Vec<&[f64]> = inputs.iter().map(|v| &v[..]).collect();
        let seeds: Vec<Vec<f64>> = mlp.layers.iter().map(|l| wide(&random(2 * l.width, 5))).collect();
        let loss = |p: &[f64], x: &[&[f64]]| {
            let v = reference::forward(&mlp, p, x, 2);
            v.iter().flatten().zip(seeds.iter().flatten()).map(|(v, d)| v * d).sum::<f64>()
        };
        let (dp, di) = reference::backward(&mlp, &params, &views, 2, &seeds);
        for range in mlp.trained() {
            let with = |p: &[f64]| [&params[..range.start], p, &params[range.end..]].concat();
            assert_gradient("params", &dp[range.clone()], &params[range.clone()], 1e-5, |p| loss(&with(p), &views));
        }
        for (i, d) in di.iter().enumerate() {
            assert_gradient("input", d, &inputs[i], 1e-5, |x| {
                let mut views = views.clone();
                views[i] = x;
                loss(&params, &views)
            });
        }
    }
}

#[test]
fn frozen_layers_have_no_gradient_and_what_lies_below_them_still_has() {
    let mlp = &cases::networks()[3];
    let (frozen, n) = (mlp.offsets[1]..mlp.offsets[2], 40);
    assert_eq!(mlp.trained(), [0..frozen.start, frozen.end..mlp.params_len()]);
    let (x, code, params) = (random(n * 7, 1), random(n * 17, 2), mlp.init(&Rng::new(1, 2)));
    let (mut dp, mut di) = (vec![0.0; params.len()], [vec![0.0; x.len()], vec![0.0; code.len()]]);
    cpu::backward(mlp, &params, &[&x, &code], n, &random(n * 5, 3), &mut dp, &mut di);
    assert!(dp[frozen.clone()].iter().all(|d| *d == 0.0));
    assert!(dp[..frozen.start].iter().filter(|d| **d != 0.0).count() > frozen.start / 2);
    // Where nothing below is trained or asked for, the pass ends.
    let mut all = mlp.clone();
    all.layers[..3].iter_mut().for_each(|l| l.frozen = true);
    dp.fill(0.0);
    cpu::backward(&all, &params, &[&x, &code], n, &random(n * 5, 3), &mut dp, &mut di);
    let last = all.offsets[3];
    assert!(dp[..last].iter().all(|d| *d == 0.0) && dp[last..].iter().all(|d| *d != 0.0));
}

#[test]
#[should_panic(expected = "does not come before")]
fn a_layer_cannot_read_ahead() {
    Mlp::new(vec![1], vec![Layer::new(vec![Source::Layer(0)], 1, Activation::None, false)]);
}

#[cfg(feature = "gpu")]
#[test]
fn what_is_off_by_more_than_half_precision_is_refused() {
    use super::gpu::fused::Element;
    let want = wide(&random(100, 1));
    let off = |share: f64| want.iter().map(|v| (v * (1.0 + share)) as f32).collect::<Vec<f32>>();
    for (element, result, allowed) in [
        (None, "forward", TOLERANCE),
        (Some(Element::F32), "d input", TOLERANCE),
        (Some(Element::F16), "forward", 5e-3),
        (Some(Element::F16), "d input", 5e-2),
        (Some(Element::Bf16), "forward", 3e-2),
        (Some(Element::Bf16), "d input", 2e-1),
    ] {
        assert!(cases::compare_as(element, result, &off(0.5 * allowed), &want).is_ok(), "{element:?} {result}");
        assert!(cases::compare_as(element, result, &off(3.0 * allowed), &want).is_err(), "{element:?} {result}");
        assert!(cases::compare_as(element, result, &[f32::NAN; 100], &want).is_err(), "{element:?} {result}");
        assert!(cases::compare_as(element, result, &off(0.0)[1..], &want).is_err(), "{element:?} {result}");
    }
}
