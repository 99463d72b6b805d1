use super::*;
use diorama_testkit::{assert_close, assert_gradient, random, wide};

/// A chain, and a network with two inputs, a skip connection and a split head.
fn nets() -> Vec<Mlp> {
    let layer = |inputs: Vec<Source>, width, relu, bias| Layer { inputs, width, relu, bias };
    use Source::{Input, Layer as L};
    vec![
        Mlp::chain(vec![32], &[64, 16], false),
        Mlp::new(
            vec![5, 3],
            vec![
                layer(vec![Input(0)], 24, true, true),
                layer(vec![Input(0), L(0)], 17, true, true),
                layer(vec![L(1)], 1, false, true),
                layer(vec![L(1), Input(1), L(2)], 4, false, false),
            ],
        ),
    ]
}

#[test]
fn matches_the_reference_both_ways() {
    for mlp in nets() {
        for n in [0, 1, 6, 401] {
            let params = mlp.init(&Rng::new(1, 2));
            let inputs: Vec<Vec<f32>> = mlp.input_widths.iter().map(|k| random(n * k, *k as u64)).collect();
            let views: Vec<&[f32]> = inputs.iter().map(|v| &v[..]).collect();
            let wides: Vec<Vec<f64>> = inputs.iter().map(|v| wide(v)).collect();
            let wide_views: Vec<&[f64]> = wides.iter().map(|v| &v[..]).collect();
            let width = mlp.layers.last().unwrap().width;
            let mut out = vec![9.0; n * width];
            cpu::forward(&mlp, &params, &views, n, &mut out);
            let want = reference::forward(&mlp, &wide(&params), &wide_views, n);
            assert_close("forward", &out, want.last().unwrap(), 1e-4);
            let d = random(n * width, 8);
            let mut seeds: Vec<Vec<f64>> = mlp.layers.iter().map(|l| vec![0.0; n * l.width]).collect();
            *seeds.last_mut().unwrap() = wide(&d);
            let (rp, ri) = reference::backward(&mlp, &wide(&params), &wide_views, n, &seeds);
            let mut dp = vec![9.0; params.len()];
            let mut di: Vec<Vec<f32>> = inputs.iter().map(|v| vec![0.0; v.len()]).collect();
            cpu::backward(&mlp, &params, &views, n, &d, &mut dp, &mut di);
            assert_close("params", &dp, &rp, 1e-4);
            for (a, b) in di.iter().zip(&ri) {
                assert_close("input", a, b, 1e-4);
            }
        }
    }
}

#[test]
fn reference_gradients_match_central_differences() {
    let mlp = &nets()[1];
    let params = wide(&mlp.init(&Rng::new(3, 2)));
    let (a, b) = (wide(&random(10, 1)), wide(&random(6, 2)));
    let seeds: Vec<Vec<f64>> = mlp.layers.iter().map(|l| wide(&random(2 * l.width, 5))).collect();
    let loss = |p: &[f64], a: &[f64], b: &[f64]| {
        let v = reference::forward(mlp, p, &[a, b], 2);
        v.iter().flatten().zip(seeds.iter().flatten()).map(|(v, d)| v * d).sum::<f64>()
    };
    let (dp, di) = reference::backward(mlp, &params, &[&a, &b], 2, &seeds);
    assert_gradient("params", &dp, &params, 1e-5, |p| loss(p, &a, &b));
    assert_gradient("first input", &di[0], &a, 1e-5, |x| loss(&params, x, &b));
    assert_gradient("second input", &di[1], &b, 1e-5, |x| loss(&params, &a, x));
}

#[test]
#[should_panic(expected = "does not come before")]
fn a_layer_cannot_read_ahead() {
    Mlp::new(vec![1], vec![Layer { inputs: vec![Source::Layer(0)], width: 1, relu: false, bias: false }]);
}
