//! Every op on a device against its f64 reference, forward and backward, over empty, single, odd and
//! ragged shapes.

mod losses;

use super::{Buffer, Gpu, GpuError, Rows};
use crate::device::Api;
use crate::ops::adam::{self, Adam};
use crate::ops::composite::{self, Composited, Packed, gpu::GpuComposited, gpu::GpuPacked};
use crate::ops::field_step::gpu::{Arithmetic, GpuNet};
use crate::ops::field_step::{self, FieldNet, Output};
use crate::ops::fused_mlp::gpu::fused::{self, Element, Fused};
use crate::ops::fused_mlp::{self, Head, Layer, Mlp, Source};
use crate::ops::hash_grid::{self, HashGrid, HashGridConfig, gpu::GpuHashGrid};
use crate::ops::linear::{self, Activation, BiasKind};
use crate::ops::march::{self, MarchConfig, MarchRays, OccupancyBits, gpu::Space};
use crate::ops::marching_cubes::CaseTable;
use crate::ops::ray_generation::{self, PosedCamera, gpu::GpuCameras};
use crate::ops::trilinear_corner_grid::{self, Corners, gpu::GpuCorners};
use crate::ops::{
    frequency, marching_cubes, marching_tetrahedra, pixel_gather, ray_aabb, sample_pdf, scan, spherical_harmonics, ssim, triangle_wave,
};
use diorama_geom::glam::DVec3;
use diorama_geom::rng::Rng;
use diorama_geom::{Camera, Lens, PixelFormat, Pose};
use diorama_testkit::{compare, random, random_unit, wide};

/// Largest error allowed, relative to the value plus the root mean square of all.
pub const TOLERANCE: f64 = 1e-3;

/// Largest error allowed of numbers in half precision (11 bits), and of their gradients: root mean square, relative
/// to that of all. Gradients stray further, because sums close to 0 fall on the other side of a ReLU's kink.
const HALF_TOLERANCE: [f64; 2] = [5e-3, 5e-2];
/// The same for bfloat16 (8 bits).
const BRAIN_TOLERANCE: [f64; 2] = [3e-2, 2e-1];

/// Compares a result that was computed with an element.
fn compare_as(element: Option<Element>, result: &str, got: &[f32], want: &[f64]) -> Result<f64, String> {
    let allowed = match element {
        None | Some(Element::F32) => return compare(got, want, TOLERANCE),
        Some(Element::F16) => HALF_TOLERANCE,
        Some(Element::Bf16) => BRAIN_TOLERANCE,
    }[result.starts_with("d ") as usize];
    if got.len() != want.len() {
        return Err(format!("lengths differ: {} and {}", got.len(), want.len()));
    }
    let energy = |v: &mut dyn Iterator<Item = f64>| v.map(|x| x * x).sum::<f64>().sqrt();
    let scale = energy(&mut want.iter().copied());
    let error = energy(&mut got.iter().zip(want).map(|(g, w)| *g as f64 - w));
    let relative = if scale > 0.0 { error / scale } else { error };
    if relative <= allowed { Ok(relative) } else { Err(format!("root mean square error {relative:.3e}, allowed {allowed:.0e}")) }
}

/// One line of the table.
#[derive(Clone, Debug)]
pub struct Row {
    pub op: &'static str,
    /// What was compared, for example `forward` or `d table`.
    pub result: &'static str,
    pub shape: String,
    /// Largest relative error.
    pub error: f64,
    /// What is wrong; none: it passed.
    pub fault: Option<String>,
}

/// The table so far.
pub struct Table<'a> {
    gpu: &'a Gpu,
    pub rows: Vec<Row>,
}

impl<'a> Table<'a> {
    pub fn new(gpu: &'a Gpu) -> Self {
        Table { gpu, rows: Vec::new() }
    }

    /// Adds a line of a known outcome: the largest relative error, or what is wrong.
    pub fn row(&mut self, op: &'static str, result: &'static str, shape: String, outcome: Result<f64, String>) {
        let (error, fault) = match outcome {
            Ok(e) => (e, None),
            Err(e) => (f64::INFINITY, Some(e)),
        };
        self.rows.push(Row { op, result, shape, error, fault });
    }

    /// Compares numbers within [`TOLERANCE`].
    ///
    /// # Errors
    /// When the device is lost.
    pub fn close(
        &mut self,
        op: &'static str,
        result: &'static str,
        shape: impl ToString,
        got: &Buffer,
        want: &[f64],
    ) -> Result<(), GpuError> {
        let got = self.gpu.read(got)?;
        self.row(op, result, shape.to_string(), compare(&got, want, TOLERANCE));
        Ok(())
    }

    /// Compares exactly.
    ///
    /// # Errors
    /// When the device is lost.
    pub fn equal(
        &mut self,
        op: &'static str,
        result: &'static str,
        shape: impl ToString,
        got: &Buffer,
        want: &[u32],
    ) -> Result<(), GpuError> {
        let got = self.gpu.read_u32(got)?;
        let differs = got.iter().zip(want).position(|(a, b)| a != b);
        let outcome = match differs {
            _ if got.len() != want.len() => Err(format!("lengths differ: {} and {}", got.len(), want.len())),
            Some(i) => Err(format!("element {i}: {} is not {}", got[i], want[i])),
            None => Ok(0.0),
        };
        self.row(op, result, shape.to_string(), outcome);
        Ok(())
    }
}

/// Runs all cases.
///
/// # Errors
/// When the device is lost; wrong results are rows with a fault.
pub fn run(gpu: &Gpu) -> Result<Vec<Row>, GpuError> {
    let mut table = Table::new(gpu);
    let cases = [
        hash_grids,
        encodings,
        layers,
        networks,
        compositing,
        losses::distortions,
        losses::depths,
        sums,
        boxes,
        marches,
        samples,
        corners,
        pixels,
        steps,
        cast,
        images,
        fields,
        surfaces,
    ];
    for case in cases {
        case(gpu, &mut table)?;
    }
    Ok(table.rows)
}

/// The ways in which the device may have to add: its own, or exchanges where it has none; WebGPU needs both,
/// because browsers have none.
fn adders(gpu: &Gpu) -> Vec<(&'static str, Gpu)> {
    let mut all = Vec::new();
    if gpu.has_native_atomics() {
        all.push(("d table, native", gpu.clone()));
    }
    if !gpu.has_native_atomics() || gpu.api == Api::WebGpu {
        all.push(("d table, exchanged", gpu.without_native_atomics()));
    }
    all
}

fn hash_grids(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    for features in [1, 2, 4, 8] {
        let grid = HashGrid::new(HashGridConfig { levels: 4, features, log2_size: 9, base: 3, finest: 40 });
        let on_gpu = GpuHashGrid::new(gpu, &grid);
        let t = random(grid.params_len(), 2);
        let t_gpu = gpu.upload(&t);
        for s in [0, 1, 67, 1000] {
            let mut p = random_unit(s * 3, 11);
            if s > 3 {
                p[..9].copy_from_slice(&[0.0, 1.0, 0.5, -0.3, 0.4, 1.7, 1.0, 1.0, 1.0]);
            }
            let (d, dj) = (random(s * grid.output_dims(), 3), random(s * grid.output_dims() * 3, 5));
            let (p_gpu, d_gpu, dj_gpu) = (gpu.upload(&p), gpu.upload(&d), gpu.upload(&dj));
            let (rows, shape) = (Rows::all(gpu, s), format!("S={s} L=4 F={features}"));
            let (pw, tw) = (wide(&p), wide(&t));
            table.close(
                "hash grid",
                "forward",
                &shape,
                &on_gpu.forward(gpu, &rows, &p_gpu, &t_gpu),
                &hash_grid::reference::forward(&grid, &pw, &tw),
            )?;
            let (dp, dt) = hash_grid::reference::backward(&grid, &pw, &tw, &wide(&d));
            table.close("hash grid", "d points", &shape, &on_gpu.backward_positions(gpu, &rows, &p_gpu, &t_gpu, &d_gpu), &dp)?;
            let jacobian = hash_grid::reference::jacobian(&grid, &pw, &tw);
            table.close("hash grid", "jacobian", &shape, &on_gpu.jacobian(gpu, &rows, &p_gpu, &t_gpu), &jacobian)?;
            let djt = hash_grid::reference::jacobian_backward(&grid, &pw, &wide(&dj));
            for (name, adder) in adders(gpu) {
                let (sum, sum_j) = (gpu.zeros(grid.params_len()), gpu.zeros(grid.params_len()));
                on_gpu.backward(&adder, &rows, &p_gpu, &d_gpu, &sum);
                table.close("hash grid", name, &shape, &sum, &dt)?;
                on_gpu.jacobian_backward(&adder, &rows, &p_gpu, &dj_gpu, &sum_j);
                table.close("hash grid jacobian", name, &shape, &sum_j, &djt)?;
            }
        }
    }
    Ok(())
}

fn encodings(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    for n in [0, 1, 333] {
        let shape = format!("N={n}");
        let x = random(n * 3, 1);
        let x_gpu = gpu.upload(&x);
        for f in [
            frequency::Frequency { dims: 3, bands: 10, include_input: true, pi: false, window: None },
            frequency::Frequency { dims: 3, bands: 4, include_input: false, pi: true, window: Some(2.5) },
        ] {
            let d = random(n * f.output_dims(), 2);
            table.close(
                "frequency",
                "forward",
                &shape,
                &frequency::gpu::forward(gpu, &f, &x_gpu),
                &frequency::reference::forward(&f, &wide(&x)),
            )?;
            let want = frequency::reference::backward(&f, &wide(&x), &wide(&d));
            table.close("frequency", "d x", &shape, &frequency::gpu::backward(gpu, &f, &x_gpu, &gpu.upload(&d)), &want)?;
        }
        let d = random(n * 3 * 6, 3);
        table.close(
            "triangle wave",
            "forward",
            &shape,
            &triangle_wave::gpu::forward(gpu, 6, &x_gpu),
            &triangle_wave::reference::forward(6, &wide(&x)),
        )?;
        let want = triangle_wave::reference::backward(6, &wide(&x), &wide(&d));
        table.close("triangle wave", "d x", &shape, &triangle_wave::gpu::backward(gpu, 6, &x_gpu, &gpu.upload(&d)), &want)?;
        for degree in 1..=4 {
            let shape = format!("N={n} degree={degree}");
            let d = random(n * degree * degree, 4);
            let want = spherical_harmonics::reference::forward(degree, &wide(&x));
            table.close("spherical harmonics", "forward", &shape, &spherical_harmonics::gpu::forward(gpu, degree, &x_gpu), &want)?;
            let want = spherical_harmonics::reference::backward(degree, &wide(&x), &wide(&d));
            let got = spherical_harmonics::gpu::backward(gpu, degree, &x_gpu, &gpu.upload(&d));
            table.close("spherical harmonics", "d directions", &shape, &got, &want)?;
        }
    }
    Ok(())
}

fn layers(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    use linear::{gpu as on_gpu, reference};
    let all = [Activation::None, Activation::Relu, Activation::Sigmoid, Activation::Softplus, Activation::TruncatedExp];
    for (m, k, n) in [(0, 3, 4), (1, 1, 1), (7, 5, 3), (500, 64, 64), (385, 33, 257)] {
        for (kind, bias_len) in [(BiasKind::None, 0), (BiasKind::Shared, n), (BiasKind::PerRow, m * n)] {
            for a in all {
                let shape = format!("{m}x{k}x{n} {a:?} {kind:?}");
                let (x, b, d) = (random(m * k, 1), random(bias_len, 3), random(m * n, 4));
                let w: Vec<f32> = random(k * n, 2).iter().map(|w| w / (k as f32).sqrt()).collect();
                let (xg, wg, bg) = (gpu.upload(&x), gpu.upload(&w), gpu.upload(&b));
                let (xd, wd, bd) = (wide(&x), wide(&w), wide(&b));
                let out = on_gpu::forward(gpu, &Rows::all(gpu, m), (k, n), &xg, &wg, Some(&bg), kind, a);
                table.close("linear", "forward", &shape, &out, &reference::forward(m, k, n, &xd, &wd, &bd, kind, a))?;
                let g = on_gpu::backward(gpu, &Rows::all(gpu, m), (k, n), &xg, &wg, kind, a, &out, &gpu.upload(&d));
                let (dx, dw, db) = reference::backward(m, k, n, &xd, &wd, &bd, kind, a, &wide(&d));
                table.close("linear", "d x", &shape, &g.x, &dx)?;
                table.close("linear", "d weight", &shape, &g.w, &dw)?;
                if let Some(bias) = &g.bias {
                    table.close("linear", "d bias", &shape, bias, &db)?;
                }
            }
        }
    }
    Ok(())
}

/// Skip connections, split heads and biases.
fn branched() -> Mlp {
    let layer = |inputs: Vec<Source>, width, relu: bool, bias| {
        Layer::new(inputs, width, if relu { Activation::Relu } else { Activation::None }, bias)
    };
    Mlp::new(
        vec![9, 5],
        vec![
            layer(vec![Source::Input(0)], 16, true, true),
            layer(vec![Source::Layer(0), Source::Input(0)], 12, true, false),
            layer(vec![Source::Layer(1)], 7, false, true),
            layer(vec![Source::Layer(2), Source::Input(1), Source::Layer(0)], 3, false, true),
        ],
    )
}

/// Every activation, modulated layers and a frozen one.
fn modulated() -> Mlp {
    let curved = [Activation::LeakyRelu, Activation::Softplus, Activation::Sigmoid, Activation::Tanh, Activation::Silu];
    let by = |inputs, width, activation| Layer { modulation: Some(1), ..Layer::new(inputs, width, activation, true) };
    let mut layers: Vec<Layer> = curved
        .iter()
        .enumerate()
        .map(|(j, a)| Layer::new(vec![if j == 0 { Source::Input(0) } else { Source::Layer(j - 1) }], 9, *a, true))
        .collect();
    layers.push(by(vec![Source::Layer(4)], 8, Activation::Silu));
    layers.push(Layer { frozen: true, ..Layer::new(vec![Source::Layer(5)], 11, Activation::Relu, true) });
    layers.push(Layer::new(vec![Source::Layer(6), Source::Input(0)], 4, Activation::None, true));
    Mlp::new(vec![9, 17], layers)
}

/// As wide as networks of fields become.
fn wide_chain() -> Mlp {
    Mlp::chain(vec![60], &[384, 512, 16], true)
}

fn networks(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    for mlp in [Mlp::chain(vec![32], &[64, 64, 16], false), branched(), modulated(), wide_chain()] {
        for n in [0, 1, 259] {
            let shape = format!("N={n} {} layers", mlp.layers.len());
            let params = mlp.init(&Rng::new(3, 1));
            let inputs: Vec<Vec<f32>> = mlp.input_widths.iter().map(|w| random(n * w, *w as u64)).collect();
            let d: Vec<Vec<f32>> = mlp.layers.iter().map(|l| random(n * l.width, 8)).collect();
            let on_gpu: Vec<Buffer> = inputs.iter().map(|i| gpu.upload(i)).collect();
            let refs: Vec<&Buffer> = on_gpu.iter().collect();
            let p = gpu.upload(&params);
            let values = fused_mlp::gpu::forward(gpu, &mlp, &p, &refs, &Rows::all(gpu, n));
            let wide_inputs: Vec<Vec<f64>> = inputs.iter().map(|i| wide(i)).collect();
            let wide_refs: Vec<&[f64]> = wide_inputs.iter().map(|i| &i[..]).collect();
            let want = fused_mlp::reference::forward(&mlp, &wide(&params), &wide_refs, n);
            table.close("fused MLP", "forward", &shape, values.layers.last().expect("layers"), want.last().expect("layers"))?;
            let seeds = d.iter().map(|d| Some(gpu.upload(d))).collect();
            let (dp, di) = fused_mlp::gpu::backward(gpu, &mlp, &p, &refs, &values, &Rows::all(gpu, n), seeds);
            let wide_d: Vec<Vec<f64>> = d.iter().map(|d| wide(d)).collect();
            let (wp, wi) = fused_mlp::reference::backward(&mlp, &wide(&params), &wide_refs, n, &wide_d);
            table.close("fused MLP", "d parameters", &shape, &dp, &wp)?;
            for (got, want) in di.iter().zip(&wi) {
                table.close("fused MLP", "d input", &shape, got, want)?;
            }
            in_one_launch(gpu, table, &mlp, &p, &refs, n)?;
        }
    }
    Ok(())
}

/// The whole network in one launch, in f32 and on tensor cores, with its last layer as a head.
fn in_one_launch(gpu: &Gpu, table: &mut Table, mlp: &Mlp, params: &Buffer, inputs: &[&Buffer], n: usize) -> Result<(), GpuError> {
    let last = mlp.layers.len() - 1;
    let width = mlp.layers[last].width;
    let head = Head { layer: last, channel: 0, activation: Activation::None, shift: 0.0 };
    let wide_params = wide(&gpu.read(params)?);
    let wide_inputs: Vec<Vec<f64>> = inputs.iter().map(|i| Ok(wide(&gpu.read(i)?))).collect::<Result<_, GpuError>>()?;
    let wide_inputs: Vec<&[f64]> = wide_inputs.iter().map(|i| &i[..]).collect();
    let d = random(n * width, 8);
    let mut wide_d: Vec<Vec<f64>> = mlp.layers.iter().map(|l| vec![0.0; n * l.width]).collect();
    wide_d[last] = wide(&d);
    let want = fused_mlp::reference::forward(mlp, &wide_params, &wide_inputs, n);
    let (want_params, want_inputs) = fused_mlp::reference::backward(mlp, &wide_params, &wide_inputs, n, &wide_d);
    for element in [Some(Element::F32), fused::tensor_element(gpu)].into_iter().flatten() {
        let wanted = vec![true; inputs.len()];
        let Some(net) = Fused::new(gpu, mlp, &[(head, width)], 0, &wanted, element) else { continue };
        let shape = format!("N={n} {} layers {element:?}", mlp.layers.len());
        let rows = Rows::all(gpu, n);
        let kept = net.forward(gpu, params, inputs, &rows, true);
        let mut close = |result, got: &Buffer, want: &[f64]| {
            table.row("one launch", result, shape.clone(), compare_as(Some(element), result, &gpu.read(got)?, want));
            Ok::<_, GpuError>(())
        };
        close("forward", &kept.heads[0], want.last().expect("layers"))?;
        let (dp, di) = net.backward(gpu, params, inputs, &kept, &rows, &[&gpu.upload(&d)], 64.0);
        close("d parameters", &dp, &want_params)?;
        for (got, want) in di.iter().zip(&want_inputs) {
            close("d input", got.as_ref().expect("wanted"), want)?;
        }
    }
    Ok(())
}

/// Ragged rays, empty ones among them, some opaque.
struct Rays {
    offsets: Vec<u32>,
    t: Vec<f32>,
    dt: Vec<f32>,
    sigma: Vec<f32>,
}

impl Rays {
    fn new(rays: usize) -> Rays {
        let n = random_unit(rays, 3);
        let (mut offsets, mut t) = (vec![0u32], Vec::new());
        for r in 0..rays {
            let count = if r % 5 == 1 { 0 } else { (n[r] * 40.0) as usize + 1 };
            t.extend((0..count).map(|i| 0.1 + 0.1 * i as f32));
            offsets.push(t.len() as u32);
        }
        let dt = random_unit(t.len(), 7).iter().map(|s| 0.02 + 0.05 * s).collect();
        let sigma = random_unit(t.len(), 4).iter().map(|s| s * s * 40.0).collect();
        Rays { offsets, t, dt, sigma }
    }

    fn packed(&self) -> Packed<'_> {
        Packed { offsets: &self.offsets, t: &self.t, dt: &self.dt }
    }
}

fn compositing(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    use composite::{gpu as on_gpu, reference};
    for rays in [0, 1, 130] {
        for c in [1, 3, 19] {
            let scene = Rays::new(rays);
            let (s, shape) = (scene.t.len(), format!("R={rays} C={c}"));
            let (f, b) = (random(s * c, 1), random(rays * c, 2));
            let up = |v: &[f32]| gpu.upload(v);
            let (p, sg, fg, bg) = (GpuPacked::upload(gpu, &scene.packed()), up(&scene.sigma), up(&f), up(&b));
            let out = on_gpu::forward(gpu, &p, &sg, &fg, c, &bg);
            let (sd, fd, bd) = (wide(&scene.sigma), wide(&f), wide(&b));
            let want = reference::forward(&scene.packed(), &sd, &fd, c, &bd);
            for (name, got, want) in [
                ("color", &out.color, &want.color),
                ("depth", &out.depth, &want.depth),
                ("opacity", &out.opacity, &want.opacity),
                ("weights", &out.weights, &want.weights),
            ] {
                table.close("composite", name, &shape, got, want)?;
            }
            let d = [random(rays * c, 4), random(rays, 5), random(rays, 6), random(s, 7)];
            let [color, depth, opacity, weights] = d.each_ref().map(|v| up(v));
            let g = on_gpu::backward(gpu, &p, &fg, c, &bg, &out, &GpuComposited { color, depth, opacity, weights });
            let [color, depth, opacity, weights] = d.each_ref().map(|v| wide(v));
            let (ds, df, db) = reference::backward(&scene.packed(), &sd, &fd, c, &bd, &Composited { color, depth, opacity, weights });
            table.close("composite", "d sigma", &shape, &g.sigma, &ds)?;
            table.close("composite", "d features", &shape, &g.features, &df)?;
            table.close("composite", "d background", &shape, &g.background, &db)?;
        }
    }
    Ok(())
}

fn sums(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    for n in [0, 1, 255, 256, 10_001] {
        let counts: Vec<u32> = random_unit(n, 1).iter().map(|v| (v * 40.0) as u32).collect();
        let got = scan::gpu::exclusive(gpu, &gpu.upload_u32(&counts));
        table.equal("scan", "exclusive", format!("R={n}"), &got, &scan_of(&counts))?;
    }
    let scene = Rays::new(77);
    let (x, offsets) = (random(scene.t.len(), 2), gpu.upload_u32(&scene.offsets));
    let got = scan::gpu::inclusive(gpu, &offsets, &gpu.upload(&x));
    table.close("scan", "inclusive", "R=77", &got, &scan::reference::inclusive(&scene.offsets, &wide(&x)))?;
    let got = scan::gpu::inclusive_backward(gpu, &offsets, &gpu.upload(&x));
    table.close("scan", "d inclusive", "R=77", &got, &scan::reference::inclusive_backward(&scene.offsets, &wide(&x)))
}

/// The reference sums each prefix anew, which is too slow for the longest case.
fn scan_of(counts: &[u32]) -> Vec<u32> {
    let mut out = vec![0];
    counts.iter().for_each(|c| out.push(out[out.len() - 1] + c));
    out
}

/// Origins in and around the cube with unit directions.
fn rays(n: usize) -> [Vec<f32>; 4] {
    let mut dirs = random(n * 3, 2);
    for d in dirs.chunks_exact_mut(3) {
        let l = (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]).sqrt();
        d.iter_mut().for_each(|v| *v /= l);
    }
    [random_unit(n * 3, 1), dirs, (0..n).flat_map(|_| [0.05, 3.0]).collect(), random_unit(n, 3)]
}

fn boxes(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    for n in [0, 1, 301] {
        let [origins, mut dirs, ..] = rays(n);
        if n > 3 {
            dirs[..6].copy_from_slice(&[0.0, 0.0, 1.0, 0.0, 1.0, 0.0]);
        }
        let (min, max) = ([0.2, 0.3, 0.1], [0.8, 0.9, 0.7]);
        let got = ray_aabb::gpu::intersect(gpu, &gpu.upload(&origins), &gpu.upload(&dirs), min, max, 0.05);
        let want =
            ray_aabb::reference::intersect(&wide(&origins), &wide(&dirs), min.map(|v| v as f64), max.map(|v| v as f64), 0.05f32 as f64);
        table.close("ray and box", "near and far", format!("R={n}"), &got, &want)?;
    }
    Ok(())
}

/// A sample whose midpoint lies on a cell wall may fall to either side: rays that differ are counted, and
/// no more than one in fifty may.
fn marches(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    let bounded = MarchConfig { dt_min: 0.005, dt_max: 0.08, max_samples: 200, ..MarchConfig::default() };
    let growing = MarchConfig { cone: 1.0 / 256.0, ..bounded };
    let unbounded = MarchConfig { dt_max: 1e6, disparity_from: 0.7, unbounded: true, max_samples: 600, ..growing };
    for (cascades, config) in [(1, bounded), (3, growing), (3, unbounded)] {
        for n in [0, 1, 300] {
            let mut grid = OccupancyBits::full(16, cascades);
            let u = random_unit(grid.cells(), 9);
            grid.fill_with(|i| u[i] < 0.3 && i / 64 % 3 != 0);
            let [origins, dirs, mut near_far, jitter] = rays(n);
            if config.unbounded {
                near_far.iter_mut().skip(1).step_by(2).for_each(|far| *far = 1000.0);
            }
            let r = MarchRays { origins: &origins, dirs: &dirs, near_far: &near_far, jitter: &jitter, resumed: false };
            let want = march::reference::march(&grid, &r, &config);
            let on_gpu = march::gpu::GpuRays::upload(gpu, &r);
            let capacity = want.t.len() + 500;
            let occupancy = march::gpu::GpuOccupancy::upload(gpu, &grid);
            let marched = march::gpu::march(gpu, &occupancy, &on_gpu, &config, capacity);
            let packed = &marched.packed;
            let (offsets, t, cells) = (gpu.read_u32(&packed.offsets)?, gpu.read(&packed.t)?, gpu.read_u32(&marched.cells)?);
            let places = gpu.read(&march::gpu::positions(gpu, &on_gpu, packed, Space::Model))?;
            let mut ties = 0;
            for i in 0..n {
                let a = offsets[i] as usize..offsets[i + 1] as usize;
                let b = want.offsets[i] as usize..want.offsets[i + 1] as usize;
                let same = a.end <= capacity
                    && a.len() == b.len()
                    && a.clone().zip(b).all(|(a, b)| {
                        let mid = want.t[b] + 0.5 * want.dt[b];
                        let at =
                            (0..3).all(|k| (places[a * 3 + k] - (origins[i * 3 + k] + mid * dirs[i * 3 + k])).abs() < 1e-4 * mid.max(1.0));
                        (t[a] - want.t[b]).abs() < 1e-4 * want.t[b].max(1.0) && cells[a] == want.cells[b] && at
                    });
                ties += !same as usize;
            }
            let outcome = if ties * 50 <= n { Ok(0.0) } else { Err(format!("{ties} of {n} rays differ")) };
            table.row("march", "samples", format!("R={n} cascades={cascades} unbounded={}", config.unbounded), outcome);
            // With room for half of them, offsets must stop there and what fits must be the same.
            let half = capacity / 2;
            let marched = march::gpu::march(gpu, &occupancy, &on_gpu, &config, half);
            let packed = &marched.packed;
            let cut: Vec<u32> = offsets.iter().skip(1).map(|o| (*o > half as u32) as u32).collect();
            table.equal("march", "rays cut", format!("R={n} cascades={cascades} unbounded={}", config.unbounded), &marched.cut, &cut)?;
            let bounded: Vec<u32> = offsets.iter().map(|o| (*o).min(half as u32)).collect();
            table.equal(
                "march",
                "bounded offsets",
                format!("R={n} cascades={cascades} unbounded={}", config.unbounded),
                &packed.offsets,
                &bounded,
            )?;
            let kept = *bounded.last().expect("R + 1 offsets") as usize;
            let same = gpu.read(&packed.t)?[..kept] == t[..kept];
            let outcome = if same { Ok(0.0) } else { Err("other samples than with room for all".into()) };
            table.row("march", "bounded samples", format!("R={n} cascades={cascades} unbounded={}", config.unbounded), outcome);
        }
    }
    Ok(())
}

fn samples(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    for (rays, n, m) in [(0, 8, 4), (1, 1, 1), (37, 64, 33)] {
        let edges: Vec<f32> = (0..rays * (n + 1)).map(|i| (i % (n + 1)) as f32 * 0.1 + 0.5).collect();
        let (w, u) = (random_unit(rays * n, 1), random_unit(rays * m, 2));
        let got = sample_pdf::gpu::sample(gpu, n, &gpu.upload(&edges), &gpu.upload(&w), m, &gpu.upload(&u));
        let want = sample_pdf::reference::sample(n, &wide(&edges), &wide(&w), m, &wide(&u));
        table.close("sample pdf", "distances", format!("R={rays} N={n} M={m}"), &got, &want)?;
    }
    Ok(())
}

fn corners(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    for (s, c) in [(0, 4), (1, 1), (301, 7)] {
        let voxel: Vec<u32> = random_unit(s, 1).iter().map(|v| (v * 20.0) as u32).collect();
        let rows: Vec<u32> = random_unit(20 * 8, 2).iter().map(|v| (v * 50.0) as u32).collect();
        let k = Corners { rows: &rows, voxel: &voxel };
        let (local, values, d) = (random_unit(s * 3, 3), random(50 * c, 4), random(s * c, 5));
        let (on_gpu, lg, vg, dg) = (GpuCorners::upload(gpu, &k), gpu.upload(&local), gpu.upload(&values), gpu.upload(&d));
        let shape = format!("S={s} C={c}");
        let want = trilinear_corner_grid::reference::forward(&k, &wide(&local), &wide(&values), c);
        table.close("corner grid", "forward", &shape, &on_gpu.forward(gpu, &lg, &vg, c), &want)?;
        let (dl, dt) = trilinear_corner_grid::reference::backward(&k, &wide(&local), &wide(&values), c, &wide(&d));
        for (name, adder) in adders(gpu) {
            let sum = gpu.zeros(50 * c);
            table.close("corner grid", "d places", &shape, &on_gpu.backward(&adder, &lg, &vg, c, &dg, &sum), &dl)?;
            table.close("corner grid", name, &shape, &sum, &dt)?;
        }
    }
    Ok(())
}

fn pixels(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    for format in [PixelFormat::Unorm8, PixelFormat::Unorm16, PixelFormat::Half] {
        // Half floats from 2⁻¹⁴ to 2, of both signs: larger ones would hide errors of the others.
        let sixteen = |v: &f32| {
            let bits = (v * 65536.0) as u32;
            if format == PixelFormat::Half { bits & 0x8000 | (0x0400 + bits % 0x3c00) } else { bits }
        };
        let words: Vec<u32> = random_unit(400, 1).as_chunks().0.iter().map(|[a, b]| sixteen(b) << 16 | sixteen(a)).collect();
        for n in [0, 1, 67] {
            let at: Vec<u32> = random_unit(n, 2).iter().map(|v| (v * 100.0) as u32).collect();
            let chosen: Vec<usize> = at.iter().map(|i| *i as usize).collect();
            let got = pixel_gather::gpu::gather(gpu, format, &gpu.upload_u32(&words), &gpu.upload_u32(&at));
            let want = pixel_gather::reference::gather(format, &words, &chosen);
            table.close("pixel gather", "forward", format!("R={n} {format:?}"), &got, &want)?;
        }
    }
    Ok(())
}

fn steps(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    for (n, sparse, trained) in [(1, false, 0..1), (999, false, 0..999), (999, true, 0..999), (999, false, 300..640)] {
        let a = Adam { weight_decay: 0.1, ..Adam::default() };
        let p = random(n, 1);
        let (pg, mg, vg) = (gpu.upload(&p), gpu.zeros(n), gpu.zeros(n));
        let (mut pw, mut mw, mut vw) = (wide(&p), vec![0.0; n], vec![0.0; n]);
        for t in 1..=3 {
            let mut g = random(n, 10 + t as u64);
            g.iter_mut().skip(t as usize % 3).step_by(3).for_each(|g| *g = 0.0);
            let gg = gpu.upload(&g);
            let (own, shape) = (trained.clone(), format!("N={n} sparse={sparse} {trained:?}"));
            adam::gpu::step(gpu, &a, t, sparse, own.clone(), &pg, &mg, &vg, &gg);
            let of = wide(&g[own.clone()]);
            adam::reference::step(&a, t, sparse, &mut pw[own.clone()], &mut mw[own.clone()], &mut vw[own.clone()], &of);
            let left: Vec<f64> = (0..n).map(|i| if own.contains(&i) { 0.0 } else { g[i] as f64 }).collect();
            table.close("adam", "gradient cleared", shape, &gg, &left)?;
        }
        let shape = format!("N={n} sparse={sparse} {trained:?}");
        table.close("adam", "parameters", shape.clone(), &pg, &pw)?;
        table.close("adam", "moments", shape, &vg, &vw)?;
    }
    Ok(())
}

/// A crossing, named by the edge that it lies on: direction and lower point.
fn edge_of(p: &[f32]) -> (usize, [u32; 3]) {
    let direction = (0..3).filter(|&k| p[k].fract() > 0.0).map(|k| 1 << k).sum();
    (direction, [p[0] as u32, p[1] as u32, p[2] as u32])
}

/// The same vertices on the same edges, and the same triangles whichever vertex they begin with.
fn surfaces(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    surface(gpu, table, "marching cubes", &marching_cubes::case_table())?;
    surface(gpu, table, "marching tetrahedra", &marching_tetrahedra::case_table())
}

fn surface(gpu: &Gpu, table: &mut Table, op: &'static str, cases: &CaseTable) -> Result<(), GpuError> {
    for (nx, ny, nz) in [(0, 3, 3), (1, 1, 1), (2, 2, 2), (9, 13, 11)] {
        let (density, level) = (random_unit(nx * ny * nz, 5), 0.4);
        let mut mesher = marching_cubes::cpu::Mesher::new(cases, nx, ny, level);
        density.chunks_exact((nx * ny).max(1)).for_each(|slice| mesher.push(slice));
        let (vertices, faces) = marching_cubes::gpu::extract(gpu, cases, &gpu.upload(&density), (nx, ny, nz), level)?;
        let (vertices, faces) = (gpu.read(&vertices)?, gpu.read_u32(&faces)?);
        let shape = format!("{nx}x{ny}x{nz}");
        let sorted = |vertices: &[f32]| {
            let mut all: Vec<_> = vertices.chunks_exact(3).map(|p| (edge_of(p), [p[0], p[1], p[2]])).collect();
            all.sort_by_key(|v| v.0);
            all.iter().flat_map(|v| v.1).collect::<Vec<f32>>()
        };
        let want = sorted(mesher.positions.as_flattened());
        table.close(op, "vertices", &shape, &gpu.upload(&sorted(&vertices)), &wide(&want))?;
        let triangles = |vertices: &[f32], faces: &[u32]| {
            let edge = |v: u32| edge_of(&vertices[v as usize * 3..][..3]);
            let mut all: Vec<_> = faces.chunks_exact(3).map(|f| [edge(f[0]), edge(f[1]), edge(f[2])]).collect();
            all.iter_mut().for_each(|t| {
                let least = (0..3).min_by_key(|&k| t[k]).unwrap_or(0);
                t.rotate_left(least);
            });
            all.sort();
            all
        };
        let same = triangles(&vertices, &faces) == triangles(mesher.positions.as_flattened(), mesher.faces.as_flattened());
        let outcome = if same { Ok(0.0) } else { Err("other triangles than the CPU's".into()) };
        table.row(op, "faces", shape, outcome);
    }
    Ok(())
}

/// Every lens, turned and moved.
fn cameras() -> Vec<PosedCamera> {
    let lenses = [
        Lens::Pinhole,
        Lens::Brown { k: [0.05, -0.02, 0.004, 0.01, 0.0, 0.0], p: [1e-3, -1e-3] },
        Lens::Fisheye { k: [0.02, -0.003, 0.0, 0.0], p: [1e-3, 0.0], s: [0.0, 1e-3] },
        Lens::Fov { omega: 0.7 },
        Lens::Equirectangular,
    ];
    let posed = |(i, lens)| PosedCamera {
        camera: Camera { lens, ..Camera::pinhole(64, 48, 0.9) },
        pose: Pose::look_at(DVec3::new(2.0, i as f64, 1.0), DVec3::ZERO, DVec3::Z),
    };
    lenses.into_iter().enumerate().map(posed).collect()
}

fn cast(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    let all = cameras();
    let on_gpu = GpuCameras::upload(gpu, &all);
    for n in [0, 1, 301] {
        let index: Vec<u32> = (0..n as u32).map(|i| i % 5).collect();
        let pixels: Vec<f32> = random_unit(n * 2, 1).iter().map(|v| v * 48.0).collect();
        let (ig, pg, shape) = (gpu.upload_u32(&index), gpu.upload(&pixels), format!("R={n}"));
        let (origins, dirs) = on_gpu.forward(gpu, &ig, &pg);
        let (want_o, want_d) = ray_generation::reference::forward(&all, &index, &wide(&pixels));
        table.close("ray generation", "origins", &shape, &origins, &want_o)?;
        table.close("ray generation", "directions", &shape, &dirs, &want_d)?;
        let (go, gd) = (random(n * 3, 2), random(n * 3, 3));
        let want = ray_generation::reference::backward(&all, &index, &wide(&pixels), &wide(&go), &wide(&gd));
        let got = on_gpu.backward(gpu, &ig, &pg, &dirs, &gpu.upload(&go), &gpu.upload(&gd));
        table.close("ray generation", "d corrections", &shape, &got, &want)?;
    }
    Ok(())
}

fn images(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    for (w, h, c) in [(11, 11, 1), (10, 30, 3), (24, 17, 3)] {
        let (x, y) = (random_unit(w * h * c, 1), random_unit(w * h * c, 2));
        let (xg, yg, shape) = (gpu.upload(&x), gpu.upload(&y), format!("{w}x{h}x{c}"));
        let values = gpu.read(&ssim::gpu::forward(gpu, (w, h, c), &xg, &yg))?;
        let mean = values.iter().sum::<f32>() / values.len() as f32;
        let want = ssim::reference::ssim(w, h, c, &wide(&x), &wide(&y));
        let outcome = if want.is_nan() && mean.is_nan() { Ok(0.0) } else { compare(&[mean], &[want], TOLERANCE) };
        table.row("SSIM", "mean", shape.clone(), outcome);
        let fits = w >= ssim::WINDOW && h >= ssim::WINDOW;
        let want = if fits { ssim::reference::gradient(w, h, c, &wide(&x), &wide(&y)) } else { vec![0.0; x.len()] };
        table.close("SSIM", "d x", &shape, &ssim::gpu::backward(gpu, (w, h, c), &xg, &yg), &want)?;
    }
    Ok(())
}

/// A density network and a colour network that also reads two codes, as instant-ngp's.
fn field_net(features: usize) -> FieldNet {
    use Source::{Input, Layer as L};
    let layer =
        |inputs: Vec<Source>, width, relu: bool| Layer::new(inputs, width, if relu { Activation::Relu } else { Activation::None }, false);
    let layers = vec![
        layer(vec![Input(0)], 32, true),
        layer(vec![L(0)], 16, false),
        layer(vec![L(1), Input(1), Input(2)], 32, true),
        layer(vec![L(2)], 3, false),
    ];
    FieldNet::of_color(
        Mlp::new(vec![features, 16, 5], layers),
        Head { layer: 1, channel: 2, activation: Activation::TruncatedExp, shift: 0.5 },
        Head { layer: 3, channel: 0, activation: Activation::Sigmoid, shift: 0.0 },
    )
}

/// The same with eleven channels more, of a layer of their own and of the color's.
fn field_with_labels(features: usize) -> FieldNet {
    let mut net = field_net(features);
    let mut layers = net.mlp.layers.clone();
    layers.push(Layer::new(vec![Source::Layer(1)], 10, Activation::None, true));
    net.mlp = Mlp::new(net.mlp.input_widths.clone(), layers);
    let head = |layer, channel, activation| Head { layer, channel, activation, shift: 0.1 };
    net.outputs.push(Output { head: head(4, 0, Activation::None), channels: 10 });
    net.outputs.push(Output { head: head(3, 2, Activation::Tanh), channels: 1 });
    net
}

fn fields(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    let (levels, per_level) = (4, 2);
    for net in [field_net(levels * per_level), field_with_labels(levels * per_level)] {
        field(gpu, table, &net, (levels, per_level))?;
    }
    Ok(())
}

fn field(gpu: &Gpu, table: &mut Table, net: &FieldNet, (levels, per_level): (usize, usize)) -> Result<(), GpuError> {
    let c = net.channels();
    let params = net.mlp.init(&Rng::new(1, 1));
    for rays in [0, 1, 90] {
        let scene = Rays::new(rays);
        let (p, s) = (scene.packed(), scene.t.len());
        let features = random(s * levels * per_level, 6);
        let codes = [random(rays * 16, 7), random(rays * 5, 8)];
        let (background, d) = (random(rays * c, 9), [random(rays * c, 1), random(rays, 2), random(rays, 3), random(s, 4)]);
        let rows: Vec<f64> = (0..s)
            .flat_map(|i| (0..levels * per_level).map(move |k| (i, k)))
            .map(|(i, k)| features[(k / per_level * s + i) * per_level + k % per_level] as f64)
            .collect();
        let spread = |code: &[f32], w: usize| -> Vec<f64> {
            (0..rays).flat_map(|r| p.range(r).flat_map(move |_| wide(&code[r * w..(r + 1) * w]))).collect()
        };
        let (first, second) = (spread(&codes[0], 16), spread(&codes[1], 5));
        let [color, depth, opacity, weights] = d.each_ref().map(|v| wide(v));
        let wide_d = Composited { color, depth, opacity, weights };
        let want = field_step::reference::step(net, &wide(&params), &p, &[&rows, &first, &second], &wide(&background), &wide_d);

        let up = |v: &[f32]| gpu.upload(v);
        let (on_gpu, pg, fg, bg) = (GpuPacked::upload(gpu, &p), up(&params), up(&features), up(&background));
        let (ca, cb) = (up(&codes[0]), up(&codes[1]));
        let density = Mlp::new(net.mlp.input_widths[..1].to_vec(), net.mlp.layers[..=net.density.layer].to_vec());
        for (arithmetic, precise) in [(Arithmetic::Layers, "layers"), (Arithmetic::Exact, "one launch"), (Arithmetic::Best, "tensor cores")]
        {
            let on_gpu_net = GpuNet::new(gpu, net, &density, per_level, &[true; 3], arithmetic);
            let element = on_gpu_net.element();
            if matches!((arithmetic, element), (Arithmetic::Exact, None) | (Arithmetic::Best, None | Some(Element::F32))) {
                // The device has no way but those before.
                continue;
            }
            let shape = format!("R={rays} S={s} C={c} {precise}");
            let features = on_gpu_net.features(gpu, &on_gpu.rows(), fg.clone());
            let mut close = |result, got: &Buffer, want: &[f64]| {
                let got = gpu.read(got)?;
                table.row("field", result, shape.clone(), compare_as(element, result, &got, want));
                Ok::<_, GpuError>(())
            };
            close("density", &on_gpu_net.density(gpu, &pg, &features, &on_gpu.rows()), &want.sigma)?;
            let step = on_gpu_net.forward(gpu, &pg, &on_gpu, &features, &[&ca, &cb], &bg, true);
            close("color", &step.out.color, &want.out.color)?;
            close("weights", &step.out.weights, &want.out.weights)?;
            let [color, depth, opacity, weights] = d.each_ref().map(|v| up(v));
            let d = GpuComposited { color, depth, opacity, weights };
            let g = on_gpu_net.backward(gpu, &pg, &on_gpu, &bg, &step, &d, 0.0);
            close("d parameters", &g.params, &want.d_params)?;
            close("d background", &g.background, &want.d_background)?;
            let level_major: Vec<f64> = (0..levels * s * per_level)
                .map(|i| want.d_inputs[0][i / per_level % s * levels * per_level + i / (s * per_level) * per_level + i % per_level])
                .collect();
            close("d features", g.features.as_ref().expect("wanted"), &level_major)?;
            for (i, w) in [16, 5].into_iter().enumerate() {
                let d = &want.d_inputs[i + 1];
                let summed: Vec<f64> = (0..rays * w).map(|e| p.range(e / w).map(|k| d[k * w + e % w]).sum()).collect();
                close("d code", g.codes[i].as_ref().expect("wanted"), &summed)?;
            }
        }
    }
    Ok(())
}
