//! Times the gradient of the density beside the training step of the same field, per 100,000 samples: a hash grid of 16 × 2 features and
//! instant-ngp's network, whose density layers are 32 → 64 → 16.

use diorama_geom::rng::Rng;
use diorama_kernels::gemm::{Precision, has_bf16};
use diorama_kernels::ops::composite::Packed;
use diorama_kernels::ops::density_gradient::cpu::{DensityBuffers, DensitySinks, TableGradient, backward, forward};
use diorama_kernels::ops::density_gradient::{DensityGradients, DensityNet, DensityPoints};
use diorama_kernels::ops::field_step::{
    Extras, FieldNet, InjectedGradients, Positions, RayCode, RayGradients, StepBuffers, StepInput, StepOutput, run,
};
use diorama_kernels::ops::fused_mlp::{Head, Layer, Mlp, Source};
use diorama_kernels::ops::hash_grid::{HashGrid, HashGridConfig, cpu as hash};
use diorama_kernels::ops::linear::Activation;
use std::time::Instant;

const SAMPLES: usize = 100_000;
const PER_RAY: usize = 50;
const RAYS: usize = SAMPLES / PER_RAY;

fn random(n: usize, seed: u64) -> Vec<f32> {
    let rng = Rng::new(seed, 1);
    (0..n as u64).map(|i| rng.uniform(i)).collect()
}

/// Median time of a call in milliseconds.
fn time(mut call: impl FnMut()) -> f64 {
    call();
    let mut times: Vec<f64> = (0..21)
        .map(|_| {
            let start = Instant::now();
            call();
            start.elapsed().as_secs_f64() * 1e3
        })
        .collect();
    times.sort_by(f64::total_cmp);
    times[times.len() / 2]
}

fn net(precision: Precision) -> FieldNet {
    use Source::{Input, Layer as L};
    let layer =
        |inputs: Vec<Source>, width, relu: bool| Layer::new(inputs, width, if relu { Activation::Relu } else { Activation::None }, false);
    let layers = vec![
        layer(vec![Input(0)], 64, true),
        layer(vec![L(0)], 16, false),
        layer(vec![L(1), Input(1)], 64, true),
        layer(vec![L(2)], 64, true),
        layer(vec![L(3)], 16, false),
    ];
    FieldNet::of_color(
        Mlp { precision, ..Mlp::new(vec![32, 16], layers) },
        Head { layer: 1, channel: 0, activation: Activation::TruncatedExp, shift: 0.0 },
        Head { layer: 4, channel: 0, activation: Activation::Sigmoid, shift: 0.0 },
    )
}

/// Points of rays through the cube.
fn points() -> Vec<f32> {
    let ends = random(RAYS * 6, 3);
    let at = |s: usize, k: usize| {
        let (e, u) = (&ends[s / PER_RAY * 6..], (s % PER_RAY) as f32 / PER_RAY as f32);
        e[k] + (e[k + 3] - e[k]) * u
    };
    (0..SAMPLES * 3).map(|e| at(e / 3, e % 3)).collect()
}

fn main() {
    let grid = HashGrid::new(HashGridConfig { levels: 16, features: 2, log2_size: 19, base: 16, finest: 2048 });
    let (table, points) = (random(grid.params_len(), 1), points());
    let (mut grads, mut touched) = (vec![0.0; table.len()], vec![0u8; table.len() / hash::LINE]);
    let mut features = vec![0.0; SAMPLES * 32];
    let encode = time(|| hash::forward(&grid, &points, &table, &mut features));
    let d = random(SAMPLES * 32, 4);
    let scatter = time(|| hash::backward(&grid, &points, &d, &mut grads, Some(&mut touched)));
    let (mut along, mut d_points) = (vec![0.0; SAMPLES * 32], vec![0.0; SAMPLES * 3]);
    let gradient = time(|| hash::gradient(&grid, &points, &table, &d, &mut d_points));
    let (value, direction) = (random(SAMPLES, 10), random(SAMPLES * 3, 11));
    let derivatives = time(|| hash::derivatives(&grid, &points, &table, &direction, &mut along));
    let back = time(|| {
        let to = TableGradient { grads: &mut grads, touched: &mut touched };
        hash::gradient_backward(&grid, &points, &d, hash::Along { value: &value, direction: &direction }, to);
    });
    println!("hash grid: encode {encode:.1} ms, scatter {scatter:.1} ms");
    println!("hash grid: gradient {gradient:.1} ms, derivatives {derivatives:.1} ms, scatter with slopes {back:.1} ms");
    let offsets: Vec<u32> = (0..=RAYS).map(|r| (r * PER_RAY) as u32).collect();
    let (t, dt, background) = (random(SAMPLES, 5), vec![0.02; SAMPLES], vec![0.0; RAYS * 6]);
    let (codes, extras) = (random(RAYS * 16, 6), random(SAMPLES * 3, 7));
    let d_rays = |c: usize| RayGradients { values: random(RAYS * c, 8), opacity: vec![0.0; RAYS], depth: vec![0.0; RAYS] };
    for (name, precision) in [("f32", Precision::F32), ("bf16", Precision::Bf16)] {
        if precision == Precision::Bf16 && !has_bf16() {
            println!("bf16: not on this CPU");
            continue;
        }
        let net = net(precision);
        let params = net.mlp.init(&Rng::new(1, 1));
        let (mut buffers, mut out, mut d_params) = (StepBuffers::default(), StepOutput::default(), vec![0.0; params.len()]);
        let samples = Packed { offsets: &offsets, t: &t, dt: &dt };
        let mut work = features.clone();
        let mut step = |width: usize| {
            let d = d_rays(3 + width);
            let extras = Extras { values: &extras[..SAMPLES * width], width };
            let background = &background[..RAYS * (3 + width)];
            let input = StepInput { net: &net, params: &params, samples, extras, background, beside: None, near_scaling: 0.0 };
            let [mut alone, mut trained] = [false, true].map(|is_trained| {
                time(|| {
                    work.copy_from_slice(&features);
                    let positions = Positions::Features { data: &mut work, levels: 16, width: 2, wanted: true };
                    let loss = InjectedGradients(&d);
                    let mut codes = [RayCode { values: &codes, width: 16, gradient: None }];
                    let loss = if is_trained { Some(&loss as _) } else { None };
                    run(&input, positions, &mut codes, loss, &mut buffers, &mut out, &mut d_params);
                })
            });
            let copy = time(|| work.copy_from_slice(&features));
            (alone, trained) = (alone - copy, trained - copy);
            println!("{name}: field step with {width} extras: composite {alone:.1} ms, train {trained:.1} ms");
            alone + trained
        };
        step(3);
        let own = step(0) + encode + scatter;
        let density = DensityNet::new(&net).expect("a density of the position alone");
        let on = DensityPoints::Hash { grid: &grid, table: &table, points: &points, features: &features };
        let (mut buf, d_gradient) = (DensityBuffers::default(), random(SAMPLES * 3, 9));
        let there = time(|| forward(&density, &params, &on, true, &mut buf));
        let back = time(|| {
            let table = Some(TableGradient { grads: &mut grads, touched: &mut touched });
            let d = DensityGradients { sigma: &[], gradient: &d_gradient };
            backward(&density, &params, &on, d, &mut buf, DensitySinks { params: &mut d_params, table });
        });
        let ratio = (there + back) / own;
        println!("{name}: density gradient: forward {there:.1} ms, backward {back:.1} ms");
        println!("{name}: {ratio:.2} of a batch step with its encoding (encode, composite, train, scatter: {own:.1} ms)");
    }
}
