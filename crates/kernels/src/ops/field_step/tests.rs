use super::cases::ngp_net;
use super::*;
use crate::ops::composite::{Composited, Packed, cases::scene};
use crate::ops::frequency;
use crate::ops::fused_mlp::{Layer, Source};
use crate::ops::hash_grid::{HashGrid, HashGridConfig, cpu as hash};
use crate::ops::linear::Activation;
use diorama_geom::rng::Rng;
use diorama_testkit::{assert_close, random, random_unit, wide};

/// A linear loss with random coefficients for everything that a loss may touch.
struct Linear {
    color: Vec<f32>,
    depth: Vec<f32>,
    opacity: Vec<f32>,
    weights: Vec<f32>,
}

impl Linear {
    fn new(rays: usize, channels: usize, samples: usize) -> Self {
        Linear { color: random(rays * channels, 1), depth: random(rays, 2), opacity: random(rays, 3), weights: random(samples, 4) }
    }
    fn wide(&self) -> Composited<f64> {
        Composited { color: wide(&self.color), depth: wide(&self.depth), opacity: wide(&self.opacity), weights: wide(&self.weights) }
    }
}

impl RayLoss for Linear {
    fn ray(&self, r: usize, out: &RayOutput, g: &mut RayGradient) -> f64 {
        let c = out.values.len();
        g.values.copy_from_slice(&self.color[r * c..(r + 1) * c]);
        g.depth = self.depth[r];
        g.opacity = self.opacity[r];
        let n = g.weights.len();
        g.weights.copy_from_slice(&self.weights[out.first..out.first + n]);
        let mut loss = (out.depth * g.depth + out.opacity * g.opacity) as f64;
        loss += out.values.iter().zip(g.values.iter()).map(|(a, b)| (a * b) as f64).sum::<f64>();
        loss + out.weights.iter().zip(g.weights.iter()).map(|(a, b)| (a * b) as f64).sum::<f64>()
    }
}

fn expand(p: &Packed, code: &[f32], width: usize) -> Vec<f64> {
    (0..p.rays()).flat_map(|r| p.range(r).map(move |_| r)).flat_map(|r| wide(&code[r * width..(r + 1) * width])).collect()
}

fn fold(p: &Packed, d: &[f64], width: usize) -> Vec<f64> {
    (0..p.rays()).flat_map(|r| (0..width).map(move |k| (r, k))).map(|(r, k)| p.range(r).map(|i| d[i * width + k]).sum()).collect()
}

#[test]
fn fused_equals_composed_with_features_codes_and_all_gradients() {
    for c in cases::cases() {
        let (net, p, channels) = (&c.net, c.scene.packed(), c.net.channels());
        let mut features = c.features.clone();
        let [color, depth, opacity, weights] = c.d.clone();
        let loss = Linear { color, depth, opacity, weights };
        let encoding = BlockEncoding::TriangleWave { bands: cases::BANDS };
        let beside = c.points.as_ref().map(|points| Beside { encoding, points, wanted: true });
        let (mut d_first, mut d_second) = (vec![9.0; c.codes[0].len()], vec![9.0; c.codes[1].len()]);
        let (mut out, mut d_params) = (StepOutput::default(), vec![0.0; c.params.len()]);
        let input = StepInput {
            net,
            params: &c.params,
            samples: p,
            extras: Extras::default(),
            background: &c.background,
            beside,
            near_scaling: 0.0,
        };
        let [first, second] = cases::CODES;
        let mut codes = [
            RayCode { values: &c.codes[0], width: first, gradient: Some(&mut d_first) },
            RayCode { values: &c.codes[1], width: second, gradient: Some(&mut d_second) },
        ];
        let (levels, width) = cases::LEVELS;
        let positions = Positions::Features { data: &mut features, levels, width, wanted: true };
        run(&input, positions, &mut codes, Some(&loss), &mut StepBuffers::default(), &mut out, &mut d_params);
        let want = c.want();
        assert_eq!(out.values.len(), c.rays * channels);
        assert_close("values", &out.values, &want.out.color, 1e-4);
        assert_close("depth", &out.depth, &want.out.depth, 1e-4);
        assert_close("opacity", &out.opacity, &want.out.opacity, 1e-4);
        assert_close("weights", &out.weights, &want.out.weights, 1e-4);
        assert_close("d background", &out.d_background, &want.d_background, 1e-4);
        assert_close("d params", &d_params, &want.d_params, 1e-4);
        assert_close("d first code", &d_first, &c.want_code(&want, 0), 1e-4);
        assert_close("d second code", &d_second, &c.want_code(&want, 1), 1e-4);
        assert_close("d features", &features, &c.want_features(&want), 1e-4);
        assert_eq!(out.d_beside.is_empty(), c.points.as_ref().is_none_or(Vec::is_empty));
        c.want_points(&want).into_iter().for_each(|want| assert_close("d points", &out.d_beside, &want, 1e-4));
    }
}

#[test]
fn fused_equals_composed_with_encoded_positions() {
    let encoding = Frequency { dims: 3, bands: 4, include_input: true, pi: true, window: None };
    let net = FieldNet::of_color(
        Mlp::chain(vec![encoding.output_dims()], &[48, 48, 16], true),
        Head { layer: 2, channel: 3, activation: Activation::Softplus, shift: -1.0 },
        Head { layer: 2, channel: 0, activation: Activation::Sigmoid, shift: 0.0 },
    );
    let s = scene(70, 13);
    let (p, n) = (s.packed(), s.t.len());
    let points = random(n * 3, 5);
    let params = net.mlp.init(&Rng::new(1, 1));
    let bg = random(210, 9);
    let loss = Linear::new(70, 3, n);
    let (mut out, mut d_params, mut d_points) = (StepOutput::default(), vec![0.0; params.len()], vec![9.0; n * 3]);
    let input =
        StepInput { net: &net, params: &params, samples: p, extras: Extras::default(), background: &bg, beside: None, near_scaling: 0.0 };
    let positions = Positions::Encoded { encoding: BlockEncoding::Frequency(encoding), points: &points, d_points: Some(&mut d_points) };
    run(&input, positions, &mut [], Some(&loss), &mut StepBuffers::default(), &mut out, &mut d_params);
    let rows = frequency::reference::forward(&encoding, &wide(&points));
    let want = reference::step(&net, &wide(&params), &p, &[&rows], &wide(&bg), &loss.wide());
    assert_close("rgb", &out.values, &want.out.color, 1e-4);
    assert_close("d params", &d_params, &want.d_params, 1e-4);
    assert_close("d points", &d_points, &frequency::reference::backward(&encoding, &wide(&points), &want.d_inputs[0]), 1e-4);
}

#[test]
fn the_result_does_not_depend_on_the_thread_count() {
    let run_with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let net = ngp_net(8);
            let s = scene(200, 3);
            let n = s.t.len();
            let mut features = random(n * 8, 5);
            let params = net.mlp.init(&Rng::new(1, 1));
            let (sh, emb, bg) = (random(3200, 7), random(1000, 8), random(600, 9));
            let loss = Linear::new(200, 3, n);
            let mut d_params = vec![0.0; params.len()];
            let mut out = StepOutput::default();
            let input = StepInput {
                net: &net,
                params: &params,
                samples: s.packed(),
                extras: Extras::default(),
                background: &bg,
                beside: None,
                near_scaling: 0.0,
            };
            let mut codes = [RayCode { values: &sh, width: 16, gradient: None }, RayCode { values: &emb, width: 5, gradient: None }];
            let positions = Positions::Features { data: &mut features, levels: 4, width: 2, wanted: true };
            run(&input, positions, &mut codes, Some(&loss), &mut StepBuffers::default(), &mut out, &mut d_params);
            (d_params, out.values, out.loss.to_bits())
        })
    };
    assert_eq!(run_with(1), run_with(3));
}

#[test]
fn near_samples_learn_with_the_square_of_their_distance() {
    let encoding = Frequency { dims: 3, bands: 2, include_input: true, pi: true, window: None };
    let net = FieldNet::of_color(
        Mlp::chain(vec![encoding.output_dims()], &[32, 16], true),
        Head { layer: 1, channel: 3, activation: Activation::Softplus, shift: -1.0 },
        Head { layer: 1, channel: 0, activation: Activation::Sigmoid, shift: 0.0 },
    );
    let s = scene(20, 3);
    let n = s.t.len();
    let (points, bg, params) = (random(n * 3, 5), random(60, 9), net.mlp.init(&Rng::new(1, 1)));
    let gradient = |near_scaling: f32| {
        let (mut out, mut d_params, mut d_points) = (StepOutput::default(), vec![0.0; params.len()], vec![9.0; n * 3]);
        let input = StepInput {
            net: &net,
            params: &params,
            samples: s.packed(),
            extras: Extras::default(),
            background: &bg,
            beside: None,
            near_scaling,
        };
        let positions = Positions::Encoded { encoding: BlockEncoding::Frequency(encoding), points: &points, d_points: Some(&mut d_points) };
        run(&input, positions, &mut [], Some(&Linear::new(20, 3, n)), &mut StepBuffers::default(), &mut out, &mut d_params);
        d_points
    };
    let plain = gradient(0.0);
    let reach = |i: usize| s.t[i] + 0.5 * s.dt[i];
    let mut sorted: Vec<f32> = (0..n).map(reach).collect();
    sorted.sort_by(f32::total_cmp);
    let near = sorted[n / 2];
    let want: Vec<f64> = (0..n * 3).map(|e| plain[e] as f64 * ((reach(e / 3) / near).min(1.0) as f64).powi(2)).collect();
    assert_close("d points", &gradient(near), &want, 1e-4);
}

#[test]
fn inference_in_two_parts_equals_the_whole_network() {
    use crate::gemm::Precision;
    use crate::ops::fused_mlp::cpu::{Activations, forward_block};
    use infer::{InferBuffers, Inference};
    for (levels, codes) in [(4, 2), (16, 1)] {
        let grid = HashGrid::new(HashGridConfig { levels, features: 2, log2_size: 9, base: 4, finest: 64 });
        for precision in [Precision::F32, Precision::Bf16] {
            let mut net = ngp_net(grid.output_dims());
            if codes == 1 {
                let mut layers = net.mlp.layers.clone();
                layers[2].inputs.pop();
                net.mlp = Mlp::new(vec![grid.output_dims(), 16], layers);
            }
            net.mlp.precision = precision;
            let params = net.mlp.init(&Rng::new(1, 1));
            let table = random(grid.params_len(), 6);
            for n in [0, 1, 16, 77, 600] {
                let points = random_unit(n * 3, 5);
                let mut features = vec![0.0; n * grid.output_dims()];
                hash::forward(&grid, &points, &table, &mut features);
                let rows: Vec<f32> = (0..n)
                    .flat_map(|i| (0..levels).map(move |l| (l * n + i) * 2))
                    .flat_map(|at| [features[at], features[at + 1]])
                    .collect();
                // Three rays.
                let rays: Vec<u32> = (0..n as u32).map(|i| i % 3).collect();
                let (sh, emb) = (random(3 * 16, 7), random(3 * 5, 8));
                let spread = |v: &[f32], w: usize| -> Vec<f32> { rays.iter().flat_map(|&r| v[r as usize * w..][..w].to_vec()).collect() };
                let inputs = [rows, spread(&sh, 16), spread(&emb, 5)];
                let inputs: Vec<&[f32]> = inputs[..1 + codes].iter().map(|v| &v[..]).collect();
                let mut acts = Activations::default();
                forward_block(&net.mlp, &params, &inputs, n, &mut acts);
                let want_sigma: Vec<f64> = (0..n).map(|i| (acts.values[1][i * 16] as f64 + 0.5).exp()).collect();
                let want_rgb: Vec<f64> = (0..n * 3).map(|e| 1.0 / (1.0 + (-acts.values[3][e / 3 * 16 + e % 3] as f64).exp())).collect();
                let by_axis = [0, 1, 2].map(|k| points.iter().skip(k).step_by(3).copied().collect::<Vec<f32>>());
                let whole = Inference::new(&grid, &table, &net, &params).expect("a network that splits");
                let (mut sigma, mut geometry, mut rgb, mut buf) = (Vec::new(), Vec::new(), Vec::new(), InferBuffers::default());
                whole.density(&by_axis, &mut sigma, &mut geometry, &mut buf);
                let all: [infer::Codes; 2] = [(&sh, 16), (&emb, 5)];
                whole.color(&geometry, &rays, &all[..codes], &mut rgb, &mut buf);
                // Features that round to the other of two bf16 numbers move a result by their step.
                let bound = if precision == Precision::F32 { 1e-5 } else { 2e-2 };
                assert_close("sigma", &sigma, &want_sigma, bound);
                assert_close("rgb", &rgb, &want_rgb, bound);
            }
        }
    }
    // Color that reads the position itself cannot be split off.
    let mut net = ngp_net(8);
    let mut layers = net.mlp.layers.clone();
    layers[2].inputs.push(Source::Input(0));
    net.mlp = Mlp::new(vec![8, 16, 5], layers);
    let grid = HashGrid::new(HashGridConfig { levels: 4, features: 2, log2_size: 9, base: 4, finest: 64 });
    let (table, params) = (vec![0.0; grid.params_len()], vec![0.0; net.mlp.params_len()]);
    assert!(Inference::new(&grid, &table, &net, &params).is_none());
}

/// Density and color of one trunk, 40 label channels of another layer, a modulated layer and a frozen one.
fn many_outputs(features: usize) -> FieldNet {
    use Source::{Input, Layer as L};
    let mlp = Mlp::new(
        vec![features, 36],
        vec![
            Layer::new(vec![Input(0)], 24, Activation::Relu, true),
            Layer { modulation: Some(1), ..Layer::new(vec![L(0)], 12, Activation::LeakyRelu, false) },
            Layer { frozen: true, ..Layer::new(vec![L(1)], 6, Activation::None, true) },
            Layer::new(vec![L(0)], 40, Activation::None, true),
        ],
    );
    let head = |layer, channel, activation| Head { layer, channel, activation, shift: 0.1 };
    FieldNet {
        mlp,
        density: head(0, 3, Activation::Softplus),
        outputs: vec![
            Output { head: head(2, 1, Activation::Sigmoid), channels: 3, are_shares: false },
            Output { head: head(3, 0, Activation::None), channels: 40, are_shares: false },
        ],
    }
}

/// Runs a field of many outputs on frequency-encoded positions.
fn run_many(loss: &dyn RayLoss, net: &FieldNet, rays: usize) -> (StepOutput, Vec<f32>, Vec<f32>) {
    let encoding = Frequency { dims: 3, bands: 2, include_input: true, pi: true, window: None };
    let s = scene(rays, 3);
    let points = random(s.t.len() * 3, 5);
    let (params, code, bg) = (net.mlp.init(&Rng::new(1, 1)), random(rays * 36, 7), random(rays * 43, 9));
    let (mut out, mut d_params, mut d_code) = (StepOutput::default(), vec![0.0; params.len()], vec![9.0; code.len()]);
    let input = StepInput {
        net,
        params: &params,
        samples: s.packed(),
        extras: Extras::default(),
        background: &bg,
        beside: None,
        near_scaling: 0.0,
    };
    let mut codes = [RayCode { values: &code, width: 36, gradient: Some(&mut d_code) }];
    let positions = Positions::Encoded { encoding: BlockEncoding::Frequency(encoding), points: &points, d_points: None };
    run(&input, positions, &mut codes, Some(loss), &mut StepBuffers::default(), &mut out, &mut d_params);
    (out, d_params, d_code)
}

#[test]
fn any_number_of_outputs_is_composited_and_differentiated() {
    let encoding = Frequency { dims: 3, bands: 2, include_input: true, pi: true, window: None };
    let net = many_outputs(encoding.output_dims());
    for rays in [0, 1, 80] {
        let s = scene(rays, 3);
        let (p, n) = (s.packed(), s.t.len());
        let loss = Linear::new(rays, 43, n);
        let (out, d_params, d_code) = run_many(&loss, &net, rays);
        let rows = frequency::reference::forward(&encoding, &wide(&random(n * 3, 5)));
        let (code, bg) = (random(rays * 36, 7), random(rays * 43, 9));
        let inputs = [rows, expand(&p, &code, 36)];
        let views: Vec<&[f64]> = inputs.iter().map(|v| &v[..]).collect();
        let want = reference::step(&net, &wide(&net.mlp.init(&Rng::new(1, 1))), &p, &views, &wide(&bg), &loss.wide());
        assert_close("values", &out.values, &want.out.color, 1e-4);
        assert_close("d background", &out.d_background, &want.d_background, 1e-4);
        assert_close("d params", &d_params, &want.d_params, 1e-4);
        assert_close("d code", &d_code, &fold(&p, &want.d_inputs[1], 36), 1e-4);
    }
}

#[test]
fn extras_are_composited_behind_the_outputs_and_differentiated() {
    let encoding = Frequency { dims: 3, bands: 2, include_input: true, pi: true, window: None };
    let net = many_outputs(encoding.output_dims());
    for (rays, k) in [(1, 3), (80, 3), (80, 1)] {
        let s = scene(rays, 3);
        let (p, n, c) = (s.packed(), s.t.len(), 43 + k);
        let (points, extras, bg, code) = (random(n * 3, 5), random(n * k, 8), random(rays * c, 9), random(rays * 36, 7));
        let (loss, params) = (Linear::new(rays, c, n), net.mlp.init(&Rng::new(1, 1)));
        let (mut out, mut d_params, mut d_code) = (StepOutput::default(), vec![0.0; params.len()], vec![9.0; code.len()]);
        let extra = Extras { values: &extras, width: k };
        let input = StepInput { net: &net, params: &params, samples: p, extras: extra, background: &bg, beside: None, near_scaling: 0.0 };
        let mut codes = [RayCode { values: &code, width: 36, gradient: Some(&mut d_code) }];
        let positions = Positions::Encoded { encoding: BlockEncoding::Frequency(encoding), points: &points, d_points: None };
        run(&input, positions, &mut codes, Some(&loss), &mut StepBuffers::default(), &mut out, &mut d_params);
        let rows = frequency::reference::forward(&encoding, &wide(&points));
        let inputs = [rows, expand(&p, &code, 36)];
        let views: Vec<&[f64]> = inputs.iter().map(|v| &v[..]).collect();
        let want = reference::step_with_extras(&net, &wide(&params), &p, &views, &wide(&extras), &wide(&bg), &loss.wide());
        assert_close("values", &out.values, &want.out.color, 1e-4);
        assert_close("d background", &out.d_background, &want.d_background, 1e-4);
        assert_close("d extras", &out.d_extras, &want.d_extras, 1e-4);
        assert_close("d params", &d_params, &want.d_params, 1e-4);
        assert_close("d code", &d_code, &fold(&p, &want.d_inputs[1], 36), 1e-4);
        // The weights' gradients hold the extras' part: without the loss on them, parameters learn something else.
        let mut blind = loss.wide();
        (0..rays * k).for_each(|e| blind.color[e / k * c + 43 + e % k] = 0.0);
        let other = reference::step_with_extras(&net, &wide(&params), &p, &views, &wide(&extras), &wide(&bg), &blind);
        assert!(other.d_params.iter().zip(&want.d_params).any(|(a, b)| (a - b).abs() > 1e-3));
    }
}

#[test]
fn injected_gradients_are_those_of_the_loss_that_gave_them() {
    struct WithoutWeights(Linear);
    impl RayLoss for WithoutWeights {
        fn ray(&self, r: usize, out: &RayOutput, g: &mut RayGradient) -> f64 {
            let loss = self.0.ray(r, out, g);
            g.weights.fill(0.0);
            loss
        }
    }
    let net = many_outputs(15);
    let (rays, samples) = (80, scene(80, 3).t.len());
    let own = WithoutWeights(Linear::new(rays, 43, samples));
    let (_, want, want_code) = run_many(&own, &net, rays);
    let d = RayGradients { values: own.0.color.clone(), opacity: own.0.opacity.clone(), depth: own.0.depth.clone() };
    let (out, got, got_code) = run_many(&InjectedGradients(&d), &net, rays);
    assert_eq!((got, got_code, out.loss), (want, want_code, 0.0));
}

#[test]
fn triangle_waves_are_encoded_in_the_step() {
    use crate::ops::triangle_wave::reference as wave;
    let (bands, s) = (4, scene(50, 3));
    let (p, n) = (s.packed(), s.t.len());
    let net = FieldNet::of_color(
        Mlp::chain(vec![12], &[24, 8], true),
        Head { layer: 1, channel: 3, activation: Activation::Softplus, shift: 0.0 },
        Head { layer: 1, channel: 0, activation: Activation::Sigmoid, shift: 0.0 },
    );
    let (points, params, bg) = (random(n * 3, 5), net.mlp.init(&Rng::new(1, 1)), random(150, 9));
    let loss = Linear::new(50, 3, n);
    let (mut out, mut d_params, mut d_points) = (StepOutput::default(), vec![0.0; params.len()], vec![9.0; n * 3]);
    let input =
        StepInput { net: &net, params: &params, samples: p, extras: Extras::default(), background: &bg, beside: None, near_scaling: 0.0 };
    let positions = Positions::Encoded { encoding: BlockEncoding::TriangleWave { bands }, points: &points, d_points: Some(&mut d_points) };
    run(&input, positions, &mut [], Some(&loss), &mut StepBuffers::default(), &mut out, &mut d_params);
    let rows = wave::forward(bands, &wide(&points));
    let want = reference::step(&net, &wide(&params), &p, &[&rows], &wide(&bg), &loss.wide());
    assert_close("values", &out.values, &want.out.color, 1e-4);
    assert_close("d points", &d_points, &wave::backward(bands, &wide(&points), &want.d_inputs[0]), 1e-4);
}
