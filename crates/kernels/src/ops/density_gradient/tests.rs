use super::cpu::{DensityBuffers, DensitySinks, TableGradient};
use super::*;
use crate::ops::field_step::Output;
use crate::ops::frequency::{Frequency, reference as frequency};
use crate::ops::fused_mlp::Mlp;
use crate::ops::hash_grid::{HashGridConfig, cpu as hash_cpu, reference as hash};
use crate::ops::triangle_wave::reference as wave;
use diorama_geom::rng::Rng;
use diorama_testkit::{assert_close, assert_gradient, random, random_unit, wide};

/// instant-ngp's density layers behind a layer that the density does not depend on, with the color behind them.
fn small(features: usize, activation: Activation) -> FieldNet {
    use Source::{Input, Layer as L};
    let layers = vec![
        Layer::new(vec![Input(0), Input(1)], 6, Activation::Silu, true),
        Layer::new(vec![Input(0)], 24, Activation::Relu, false),
        Layer::new(vec![L(1)], 16, Activation::None, false),
        Layer::new(vec![L(2), L(0)], 16, Activation::Sigmoid, false),
    ];
    let head = |layer, channel, activation| Head { layer, channel, activation, shift: 0.3 };
    FieldNet {
        mlp: Mlp::new(vec![features, 5], layers),
        density: head(2, 3, activation),
        outputs: vec![Output { head: head(3, 0, Activation::None), channels: 3, are_shares: false }],
    }
}

/// Biases, a skip connection, leaky layers, one of them frozen, and a rectified density layer that reads the features, too.
fn skipping(features: usize, activation: Activation) -> FieldNet {
    use Source::{Input, Layer as L};
    let layers = vec![
        Layer::new(vec![Input(0)], 20, Activation::Relu, true),
        Layer { frozen: true, ..Layer::new(vec![Input(0), L(0)], 18, Activation::LeakyRelu, true) },
        Layer::new(vec![L(1), L(0)], 9, Activation::LeakyRelu, true),
        Layer::new(vec![L(2), Input(0), L(0)], 4, Activation::LeakyRelu, true),
    ];
    FieldNet::of_color(
        Mlp::new(vec![features], layers),
        Head { layer: 3, channel: 3, activation, shift: -0.2 },
        Head { layer: 3, channel: 0, activation: Activation::Sigmoid, shift: 0.0 },
    )
}

fn params(net: &FieldNet) -> Vec<f32> {
    let init = net.mlp.init(&Rng::new(1, 1));
    init.iter().zip(random(init.len(), 31)).map(|(p, r)| if *p == 0.0 { 0.3 * r } else { *p }).collect()
}

enum Encoding {
    Hash(HashGrid, Vec<f32>),
    Block(BlockEncoding),
}

fn encodings() -> [Encoding; 4] {
    let grid = HashGrid::new(HashGridConfig { levels: 4, features: 2, log2_size: 9, base: 3, finest: 40 });
    let wide_rows = HashGrid::new(HashGridConfig { levels: 3, features: 4, log2_size: 8, base: 2, finest: 9 });
    let frequency = Frequency { dims: 3, bands: 3, include_input: true, pi: true, window: Some(2.5) };
    [
        Encoding::Hash(grid.clone(), random(grid.params_len(), 2)),
        Encoding::Hash(wide_rows.clone(), random(wide_rows.params_len(), 2)),
        Encoding::Block(BlockEncoding::Frequency(frequency)),
        Encoding::Block(BlockEncoding::TriangleWave { bands: 3 }),
    ]
}

impl Encoding {
    fn dims(&self) -> usize {
        match self {
            Encoding::Hash(grid, _) => grid.output_dims(),
            Encoding::Block(e) => e.output_dims(),
        }
    }

    /// Rows of a level-major array of `per` numbers for each feature.
    fn rows(grid: &HashGrid, levels: &[f64], n: usize, per: usize) -> Vec<f64> {
        let (f, k) = (grid.config.features, grid.output_dims());
        let at = |i: usize, c: usize| (c / f * n + i) * f + c % f;
        (0..n * k * per).map(|e| levels[at(e / per / k, e / per % k) * per + e % per]).collect()
    }

    /// Features `[N, K]` and their derivatives `[N, K, 3]`.
    fn encode(&self, points: &[f64], table: &[f64]) -> (Vec<f64>, Vec<f64>) {
        let n = points.len() / 3;
        let along = |k: usize| -> Vec<f64> { (0..n * 3).map(|e| (e % 3 == k) as u8 as f64).collect() };
        let merged = |tangents: [Vec<f64>; 3]| (0..n * self.dims() * 3).map(|e| tangents[e % 3][e / 3]).collect();
        match self {
            Encoding::Hash(grid, _) => {
                let rows = Self::rows(grid, &hash::forward(grid, points, table), n, 1);
                (rows, Self::rows(grid, &hash::jacobian(grid, points, table), n, 3))
            }
            Encoding::Block(BlockEncoding::Frequency(f)) => {
                (frequency::forward(f, points), merged([0, 1, 2].map(|k| frequency::tangent(f, points, &along(k)))))
            }
            Encoding::Block(BlockEncoding::TriangleWave { bands }) => {
                (wave::forward(*bands, points), merged([0, 1, 2].map(|k| wave::tangent(*bands, points, &along(k)))))
            }
        }
    }

    fn table(&self) -> Vec<f32> {
        if let Encoding::Hash(_, table) = self { table.clone() } else { Vec::new() }
    }
}

const ACTIVATIONS: [Activation; 5] =
    [Activation::TruncatedExp, Activation::Softplus, Activation::Relu, Activation::Sigmoid, Activation::Tanh];

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

#[test]
fn the_gradient_is_that_of_the_density() {
    for encoding in encodings() {
        for make in [small, skipping] {
            let net = make(encoding.dims(), Activation::Softplus);
            let (p, t, points) = (wide(&params(&net)), wide(&encoding.table()), wide(&random_unit(15, 5)));
            let (e, j) = encoding.encode(&points, &t);
            let (_, gradient) = reference::forward(&net, &p, &e, &j);
            let total = |x: &[f64]| -> f64 {
                let (e, j) = encoding.encode(x, &t);
                reference::forward(&net, &p, &e, &j).0.iter().sum()
            };
            assert_gradient("sigma", &gradient, &points, 1e-3, total);
        }
    }
}

#[test]
fn reference_gradients_match_central_differences() {
    for (encoding, activation) in encodings().iter().flat_map(|e| ACTIVATIONS.map(|a| (e, a))) {
        for make in [small, skipping] {
            let net = make(encoding.dims(), activation);
            let mut free = net.clone();
            free.mlp.layers.iter_mut().for_each(|l| l.frozen = false);
            let (p, t, points) = (wide(&params(&net)), wide(&encoding.table()), wide(&random_unit(12, 5)));
            let (ds, dn) = (wide(&random(4, 6)), wide(&random(12, 7)));
            let loss = |p: &[f64], t: &[f64]| {
                let (e, j) = encoding.encode(&points, t);
                let (s, n) = reference::forward(&net, p, &e, &j);
                dot(&s, &ds) + dot(&n, &dn)
            };
            let (e, j) = encoding.encode(&points, &t);
            let (d_params, de, dj) = reference::backward(&free, &p, &e, &j, &ds, &dn);
            assert_gradient("parameters", &d_params, &p, 1e-5, |x| loss(x, &t));
            let frozen = reference::backward(&net, &p, &e, &j, &ds, &dn).0;
            for (layer, at) in net.mlp.layers.iter().zip(net.mlp.offsets.windows(2)).filter(|(l, _)| l.frozen) {
                assert!(frozen[at[0]..at[1]].iter().all(|g| *g == 0.0), "{layer:?}");
            }
            if let Encoding::Hash(grid, _) = encoding {
                assert_gradient("table", &table_gradient(grid, &points, &t, &de, &dj), &t, 1e-5, |x| loss(&p, x));
            }
        }
    }
}

/// Gradient of the table from those of features `[N, K]` and their derivatives `[N, K, 3]`.
fn table_gradient(grid: &HashGrid, points: &[f64], table: &[f64], de: &[f64], dj: &[f64]) -> Vec<f64> {
    let (n, f, k) = (points.len() / 3, grid.config.features, grid.output_dims());
    let level_major = |v: &[f64], per: usize| -> Vec<f64> {
        let of = |l: usize| ((l / f % n) * k + l / (f * n) * f + l % f) * per;
        (0..n * k * per).map(|e| v[of(e / per) + e % per]).collect()
    };
    let (_, mut out) = hash::backward(grid, points, table, &level_major(de, 1));
    out.iter_mut().zip(hash::jacobian_backward(grid, points, &level_major(dj, 3))).for_each(|(a, b)| *a += b);
    out
}

/// Densities, gradients, and the gradients of parameters and table.
type Results = [Vec<f32>; 4];

fn run(encoding: &Encoding, net: &FieldNet, points: &[f32], d: DensityGradients) -> Results {
    let n = points.len() / 3;
    let mut features = vec![0.0; n * encoding.dims()];
    let on = match encoding {
        Encoding::Hash(grid, table) => {
            hash_cpu::forward(grid, points, table, &mut features);
            DensityPoints::Hash { grid, table, points, features: &features }
        }
        Encoding::Block(encoding) => DensityPoints::Encoded { encoding: *encoding, points },
    };
    let (density, params, mut buf) = (DensityNet::new(net).expect("piecewise linear"), params(net), DensityBuffers::default());
    // What a larger call before left behind does not count.
    cpu::forward(&density, &params, &on, true, &mut buf);
    cpu::forward(&density, &params, &on, n == 0 || !d.gradient.is_empty(), &mut buf);
    let (mut d_params, mut grads) = (vec![0.0; params.len()], vec![0.0; encoding.table().len()]);
    let mut touched = vec![0u8; grads.len() / hash_cpu::LINE];
    let is_hash = matches!(encoding, Encoding::Hash(..));
    let table = is_hash.then_some(TableGradient { grads: &mut grads, touched: &mut touched });
    cpu::backward(&density, &params, &on, d, &mut buf, DensitySinks { params: &mut d_params, table });
    [buf.sigma, buf.gradient, d_params, grads]
}

#[test]
fn matches_the_reference_both_ways() {
    for encoding in encodings() {
        for (make, activation) in [(small as fn(usize, Activation) -> FieldNet, 0), (skipping, 1), (small, 1)] {
            let net = make(encoding.dims(), ACTIVATIONS[activation]);
            for n in [0, 1, 253, 5000] {
                let (points, ds, dn) = (random_unit(n * 3, 5), random(n, 6), random(n * 3, 7));
                let (p, t, x) = (wide(&params(&net)), wide(&encoding.table()), wide(&points));
                let (e, j) = encoding.encode(&x, &t);
                let (sigma, gradient) = reference::forward(&net, &p, &e, &j);
                for (ds, dn) in [(&ds[..], &dn[..]), (&ds, &[]), (&[], &dn)] {
                    let [got_sigma, got_gradient, got_params, got_table] =
                        run(&encoding, &net, &points, DensityGradients { sigma: ds, gradient: dn });
                    let full = |v: &[f32], len: usize| if v.is_empty() { vec![0.0; len] } else { wide(v) };
                    let (d_params, de, dj) = reference::backward(&net, &p, &e, &j, &full(ds, n), &full(dn, n * 3));
                    assert_close("sigma", &got_sigma, &sigma, 1e-4);
                    if !dn.is_empty() {
                        assert_close("gradient", &got_gradient, &gradient, 1e-3);
                    }
                    assert_close("parameters", &got_params, &d_params, 1e-3);
                    if let Encoding::Hash(grid, _) = &encoding {
                        assert_close("table", &got_table, &table_gradient(grid, &x, &t, &de, &dj), 1e-3);
                    }
                }
            }
        }
    }
}

#[test]
fn the_result_does_not_depend_on_the_thread_count() {
    let [encoding, ..] = encodings();
    let net = small(encoding.dims(), Activation::TruncatedExp);
    let (points, ds, dn) = (random_unit(30_000, 5), random(10_000, 6), random(30_000, 7));
    let run_with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| run(&encoding, &net, &points, DensityGradients { sigma: &ds, gradient: &dn }))
    };
    assert_eq!(run_with(1), run_with(3));
}

#[test]
fn densities_that_cannot_be_differentiated_are_refused() {
    let refused = |change: &dyn Fn(&mut FieldNet)| {
        let mut net = small(8, Activation::Softplus);
        change(&mut net);
        DensityNet::new(&net).unwrap_err().to_string()
    };
    let reads = refused(&|net| net.mlp.layers[2].inputs.push(Source::Layer(0)));
    assert!(reads.contains("layer 0") && reads.contains("Silu") && reads.contains("use Relu"), "{reads}");
    let code = refused(&|net| net.mlp.layers[1].inputs.push(Source::Input(1)));
    assert!(code.contains("layer 1 reads code 1"), "{code}");
    let modulated = refused(&|net| net.mlp.layers[1].modulation = Some(1));
    assert!(modulated.contains("layer 1 reads code 1"), "{modulated}");
}
