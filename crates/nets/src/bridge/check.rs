//! Every op in burn's graph on a device against the same graph on the CPU, whose ops their own tests hold to the
//! f64 references: values of all outputs, and gradients of all inputs through burn's autodiff.

use super::{Composited, composite, distortion, frequency, fused_mlp, hash_grid, linear, scan, spherical_harmonics, ssim, triangle_wave};
use super::{read_values, tensors, trilinear_corner_grid};
use burn::tensor::{Device, Tensor, TensorData};
use diorama_kernels::check::{Row, TOLERANCE, Table};
use diorama_kernels::gpu::Gpu;
use diorama_kernels::ops::composite::Packed;
use diorama_kernels::ops::frequency::Frequency;
use diorama_kernels::ops::fused_mlp::Mlp;
use diorama_kernels::ops::hash_grid::{HashGrid, HashGridConfig};
use diorama_kernels::ops::linear::Activation;
use diorama_kernels::ops::trilinear_corner_grid::Corners;
use diorama_testkit::{compare_proven, random, random_unit, wide};

/// Why no case is refused.
const RIGHT: &str = "shapes are right";

/// What a case gives: results by name.
type Results = Vec<(&'static str, Vec<f32>)>;

/// A line for every result of every op. The device must let units share memory, as burn's own kernels do wherever they run.
pub fn run(gpu: &Gpu) -> Vec<Row> {
    let mut table = Table::new(gpu);
    let (here, there) = (Device::flex().autodiff(), tensors(gpu).autodiff());
    let cases: [(&str, &str, fn(&Device) -> Results); 13] = [
        ("frequency", "N=67", frequencies),
        ("triangle wave", "N=67", waves),
        ("spherical harmonics", "N=67", harmonics),
        ("hash grid", "S=67", grids),
        ("linear", "67x9x5", layers),
        ("network", "N=67", networks),
        ("composite", "R=4", composited),
        ("composite, color alone", "R=4", colored),
        ("distortion", "R=4", distortions),
        ("scan", "R=4", sums),
        ("corner grid", "S=67", corners),
        ("ssim", "20x17x3", images),
        ("burn's own layers after ours", "S=67", mixed),
    ];
    for (op, shape, case) in cases {
        for ((result, want), (_, got)) in case(&here).into_iter().zip(case(&there)) {
            table.row("in burn's graph", result, format!("{op} {shape}"), compare_proven(&got, &wide(&want), TOLERANCE));
        }
    }
    table.rows
}

/// Random numbers that gradients are wanted of.
fn leaf<const D: usize>(device: &Device, shape: [usize; D], seed: u64) -> Tensor<D> {
    given(device, shape, random(shape.iter().product(), seed))
}

fn given<const D: usize>(device: &Device, shape: [usize; D], data: Vec<f32>) -> Tensor<D> {
    Tensor::from_data(TensorData::new(data, shape), device).require_grad()
}

/// `Σ wᵢ tᵢ` for random `w`, so that every element has a gradient of its own.
fn weighed<const D: usize>(t: &Tensor<D>, seed: u64) -> Tensor<1> {
    let n = t.dims().iter().product();
    let w = Tensor::<D>::from_data(TensorData::new(random(n, seed), t.dims()), &t.device());
    (t.clone() * w).sum()
}

/// An output and the gradient of one input.
fn simple(x: Tensor<2>, out: Tensor<2>) -> Results {
    let g = weighed(&out, 50).backward();
    vec![("forward", read_values(out)), ("d x", read_values(x.grad(&g).expect("it reaches x")))]
}

fn frequencies(device: &Device) -> Results {
    let x = leaf(device, [67, 3], 1);
    let f = Frequency { dims: 3, bands: 4, include_input: true, pi: false, window: Some(2.5) };
    simple(x.clone(), frequency(&f, x).expect(RIGHT))
}

fn waves(device: &Device) -> Results {
    let x = leaf(device, [67, 3], 2);
    simple(x.clone(), triangle_wave(5, x).expect(RIGHT))
}

fn harmonics(device: &Device) -> Results {
    let x = leaf(device, [67, 3], 3);
    simple(x.clone(), spherical_harmonics(4, x).expect(RIGHT))
}

fn grid() -> HashGrid {
    HashGrid::new(HashGridConfig { levels: 4, features: 2, log2_size: 9, base: 3, finest: 40 })
}

fn grids(device: &Device) -> Results {
    let (points, table) = (given(device, [67, 3], random_unit(67 * 3, 4)), leaf(device, [grid().rows(), 2], 5));
    let out = hash_grid(&grid(), points.clone(), table.clone()).expect(RIGHT);
    let g = weighed(&out, 51).backward();
    let d_points = read_values(points.grad(&g).expect("it reaches the points"));
    vec![("forward", read_values(out)), ("d points", d_points), ("d table", read_values(table.grad(&g).expect("it reaches the table")))]
}

fn layers(device: &Device) -> Results {
    let mut all = Vec::new();
    for bias in [None, Some(1), Some(67)] {
        let (x, w) = (leaf(device, [67, 9], 6), leaf(device, [9, 5], 7));
        let b = bias.map(|rows| leaf(device, [rows, 5], 8));
        let out = linear(x.clone(), w.clone(), b.clone(), Activation::Softplus).expect(RIGHT);
        let g = weighed(&out, 52).backward();
        all.push(("forward", read_values(out)));
        all.push(("d x", read_values(x.grad(&g).expect("it reaches x"))));
        all.push(("d W", read_values(w.grad(&g).expect("it reaches the weight"))));
        all.extend(b.map(|b| ("d bias", read_values(b.grad(&g).expect("it reaches the bias")))));
    }
    all
}

fn networks(device: &Device) -> Results {
    let mlp = Mlp::chain(vec![5, 7], &[16, 16, 3], true);
    let (a, b, params) = (leaf(device, [67, 5], 9), leaf(device, [67, 7], 10), leaf(device, [mlp.params_len()], 11));
    let out = fused_mlp(&mlp, vec![a.clone(), b.clone()], params.clone()).expect(RIGHT);
    let g = weighed(&out, 53).backward();
    let d = |t: Tensor<2>| read_values(t.grad(&g).expect("it reaches the inputs"));
    let d_params = read_values(params.grad(&g).expect("it reaches the parameters"));
    vec![("forward", read_values(out)), ("d input 0", d(a)), ("d input 1", d(b)), ("d parameters", d_params)]
}

/// Four rays, one of them empty.
const OFFSETS: [u32; 5] = [0, 7, 7, 30, 67];

fn composite_with(device: &Device, color_alone: bool) -> Results {
    let (t, dt) = (random_unit(67, 12), random_unit(67, 13));
    let samples = Packed { offsets: &OFFSETS, t: &t, dt: &dt };
    let sigma = given(device, [67], random_unit(67, 14));
    let (features, background) = (leaf(device, [67, 3], 15), leaf(device, [4, 3], 16));
    let Composited { color, depth, opacity, weights } =
        composite(samples, sigma.clone(), features.clone(), background.clone()).expect(RIGHT);
    let mut loss = weighed(&color, 54);
    if !color_alone {
        loss = loss + weighed(&depth, 55) + weighed(&opacity, 56) + weighed(&weights, 57);
    }
    let g = loss.backward();
    vec![
        ("color", read_values(color)),
        ("depth", read_values(depth)),
        ("opacity", read_values(opacity)),
        ("weights", read_values(weights)),
        ("d densities", read_values(sigma.grad(&g).expect("it reaches the densities"))),
        ("d features", read_values(features.grad(&g).expect("it reaches the features"))),
        ("d background", read_values(background.grad(&g).expect("it reaches the background"))),
    ]
}

fn composited(device: &Device) -> Results {
    composite_with(device, false)
}

fn colored(device: &Device) -> Results {
    composite_with(device, true)
}

fn distortions(device: &Device) -> Results {
    let (t, dt) = (random_unit(67, 17), random_unit(67, 18));
    let weights = given(device, [67], random_unit(67, 19));
    let out = distortion(Packed { offsets: &OFFSETS, t: &t, dt: &dt }, weights.clone()).expect(RIGHT);
    let g = weighed(&out, 58).backward();
    vec![("forward", read_values(out)), ("d weights", read_values(weights.grad(&g).expect("it reaches the weights")))]
}

fn sums(device: &Device) -> Results {
    let x = leaf(device, [67], 20);
    let out = scan(&OFFSETS, x.clone()).expect(RIGHT);
    let g = weighed(&out, 59).backward();
    vec![("forward", read_values(out)), ("d values", read_values(x.grad(&g).expect("it reaches the values")))]
}

fn corners(device: &Device) -> Results {
    let rows: Vec<u32> = (0..6 * 8).map(|i| i * 7 % 29).collect();
    let voxel: Vec<u32> = (0..67).map(|i| i % 6).collect();
    let (local, table) = (given(device, [67, 3], random_unit(67 * 3, 21)), leaf(device, [29, 4], 22));
    let out = trilinear_corner_grid(Corners { rows: &rows, voxel: &voxel }, local.clone(), table.clone()).expect(RIGHT);
    let g = weighed(&out, 60).backward();
    let d_local = read_values(local.grad(&g).expect("it reaches the places"));
    vec![("forward", read_values(out)), ("d local", d_local), ("d table", read_values(table.grad(&g).expect("it reaches the table")))]
}

fn images(device: &Device) -> Results {
    let image = |seed| given(device, [17, 20, 3], random_unit(17 * 20 * 3, seed));
    let (x, y) = (image(23), image(24));
    let out = ssim(x.clone(), y).expect(RIGHT);
    let g = weighed(&out, 61).backward();
    vec![("forward", read_values(out)), ("d x", read_values(x.grad(&g).expect("it reaches the image")))]
}

/// Our encoding, then a permutation, products, sums and a sigmoid of burn's, then our compositing. Not burn's `matmul`,
/// which rounds to TF32 on CUDA.
fn mixed(device: &Device) -> Results {
    let (points, table) = (given(device, [67, 3], random_unit(67 * 3, 25)), leaf(device, [grid().rows(), 2], 26));
    let weight = leaf(device, [1, 8, 4], 27);
    let features = hash_grid(&grid(), points.clone(), table.clone()).expect(RIGHT).swap_dims(0, 1).reshape([67, 8, 1]);
    let out = (features * weight.clone()).sum_dim(1).reshape([67, 4]);
    let sigma = out.clone().slice([0..67, 0..1]).exp().reshape([67]);
    let color = burn::tensor::activation::sigmoid(out.slice([0..67, 1..4]));
    let (t, dt) = (random_unit(67, 28), random_unit(67, 29));
    let background = leaf(device, [4, 3], 30);
    let out = composite(Packed { offsets: &OFFSETS, t: &t, dt: &dt }, sigma, color, background).expect(RIGHT);
    let color = out.color;
    let g = (color.clone() - 0.5).powf_scalar(2.0).mean().backward();
    vec![
        ("color", read_values(color)),
        ("d points", read_values(points.grad(&g).expect("it reaches the points"))),
        ("d table", read_values(table.grad(&g).expect("it reaches the table"))),
        ("d weight", read_values(weight.grad(&g).expect("it reaches the weight"))),
    ]
}
