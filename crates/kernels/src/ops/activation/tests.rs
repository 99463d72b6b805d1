use super::*;
use crate::simd::{Level, with_level};
use diorama_testkit::{assert_close, assert_gradient, random, wide};

pub(crate) const ALL: [Activation; 9] = [
    Activation::None,
    Activation::Relu,
    Activation::LeakyRelu(0.2),
    Activation::Softplus,
    Activation::Sigmoid,
    Activation::Tanh,
    Activation::Silu,
    Activation::Gelu,
    Activation::GeluTanh,
];

#[test]
fn matches_the_reference_both_ways_at_every_level() {
    for level in Level::available() {
        for n in [0, 1, 17, 40_001] {
            for a in ALL {
                let x: Vec<f32> = random(n, 1).iter().map(|v| v * 6.0).collect();
                let d = random(n, 2);
                let (mut out, mut dx) = (vec![9.0; n], vec![9.0; n]);
                with_level(level, || {
                    cpu::forward(a, &x, &mut out);
                    cpu::backward(a, &x, &d, &mut dx);
                });
                let value: Vec<f64> = x.iter().map(|x| reference::value(a, *x as f64)).collect();
                let slope: Vec<f64> = x.iter().zip(&d).map(|(x, d)| *d as f64 * reference::slope(a, *x as f64)).collect();
                assert_close(&format!("{a:?} forward"), &out, &value, 1e-5);
                assert_close(&format!("{a:?} backward"), &dx, &slope, 1e-5);
            }
        }
    }
}

#[test]
fn slopes_of_what_is_kept_match_the_reference() {
    for a in ALL {
        let (x, d) = (random(999, 1), random(999, 2));
        let (mut kept, mut dx) = (x.clone(), vec![9.0; 999]);
        if !a.needs_input() {
            cpu::forward(a, &x, &mut kept);
        }
        cpu::backward_of_kept(a, &kept, &d, &mut dx);
        let want: Vec<f64> = x.iter().zip(&d).map(|(x, d)| *d as f64 * reference::slope(a, *x as f64)).collect();
        assert_close(&format!("{a:?}"), &dx, &want, 1e-5);
    }
}

#[test]
fn reference_slopes_match_central_differences() {
    let x: Vec<f64> = wide(&random(50, 3)).iter().map(|x| x * 5.0).collect();
    for a in ALL {
        let slopes: Vec<f64> = x.iter().map(|x| reference::slope(a, *x)).collect();
        assert_gradient(&format!("{a:?}"), &slopes, &x, 1e-6, |x| x.iter().map(|x| reference::value(a, *x)).sum());
    }
}

#[test]
fn erf_has_its_known_values() {
    for (x, want) in [(0.0, 0.0), (0.5, 0.520_499_877_813_046_5), (2.0, 0.995_322_265_018_952_7), (-3.0, -0.999_977_909_503_001_4)] {
        assert!((reference::erf(x) - want).abs() < 1e-12, "{x}: {}", reference::erf(x));
    }
}

#[test]
fn extremes_stay_finite_and_nan_stays_nan() {
    for a in ALL {
        let x = [1e4, -1e4, 88.0, -88.0, 0.0, -0.0, f32::NAN];
        let (mut out, mut dx) = ([0.0; 7], [0.0; 7]);
        cpu::forward(a, &x, &mut out);
        cpu::backward(a, &x, &[1.0; 7], &mut dx);
        for (i, x) in x[..6].iter().enumerate() {
            assert!((out[i] as f64 - reference::value(a, *x as f64)).abs() <= 1e-6 * (1.0 + x.abs() as f64), "{a:?} {x}: {}", out[i]);
            assert!((dx[i] as f64 - reference::slope(a, *x as f64)).abs() <= 1e-5, "{a:?} {x}: slope {}", dx[i]);
        }
        assert!(out[6].is_nan(), "{a:?}");
    }
}
