//! `diorama bench ops --device D`: the ops on a GPU beside the rate at which it copies memory.

use super::median_seconds;
use super::ops::OpFigure;
use crate::{PipelineError, Result};
use diorama_engine::fields;
use diorama_geom::contraction::Space;
use diorama_geom::rng::Rng;
use diorama_kernels::gemm::Precision;
use diorama_kernels::gpu::{Buffer, Gpu, GpuError, Rows};
use diorama_kernels::ops::adam::{self, Adam};
use diorama_kernels::ops::composite::Packed;
use diorama_kernels::ops::composite::gpu::{self as composite, GpuGradients, GpuPacked};
use diorama_kernels::ops::field_step::gpu::{Arithmetic, FieldInput, GpuNet};
use diorama_kernels::ops::fused_mlp::gpu::fused::Element;
use diorama_kernels::ops::hash_grid::gpu::GpuHashGrid;
use diorama_kernels::ops::hash_grid::{HashGrid, HashGridConfig};
use diorama_kernels::ops::linear::{self, Activation};
use diorama_kernels::ops::photometric_loss::gpu::{self as loss, Figures, SUMS, Target};
use diorama_kernels::ops::photometric_loss::{ColorLoss, Measure, Terms};
use diorama_kernels::ops::spherical_harmonics;

/// Samples per ray.
const PER_RAY: usize = 32;

/// Calls between two waits for the device, where it is no software.
const BATCH: usize = 8;

/// Everything that was measured.
#[derive(Clone, Debug, serde::Serialize)]
pub struct GpuOpsReport {
    pub device: &'static str,
    pub name: String,
    pub software: bool,
    /// Bytes read and written per second by a plain copy.
    pub copy_gb_per_s: f64,
    pub ops: Vec<OpFigure>,
}

struct Table<'a> {
    gpu: &'a Gpu,
    repeats: usize,
    ops: Vec<OpFigure>,
    progress: &'a mut dyn FnMut(&OpFigure),
}

fn to_pipeline_error(e: GpuError) -> PipelineError {
    match e {
        GpuError::Lost(..) | GpuError::Memory(..) => PipelineError::Device(e.to_string()),
        _ => PipelineError::Usage(e.to_string()),
    }
}

impl Table<'_> {
    /// Seconds per call.
    fn seconds(&self, mut f: impl FnMut()) -> Result<f64> {
        let mut lost = None;
        let batch = if self.gpu.software { 1 } else { BATCH };
        let seconds = median_seconds(self.repeats, || {
            (0..batch).for_each(|_| f());
            lost = lost.take().or(self.gpu.sync().err());
        });
        lost.map_or(Ok(seconds / batch as f64), |e| Err(to_pipeline_error(e)))
    }

    /// `flops` and `bytes` per unit, which is given with how many a call does; 0: unknown.
    fn row(&mut self, op: &str, shape: &str, (unit, units): (&'static str, usize), flops: f64, bytes: f64, f: impl FnMut()) -> Result<()> {
        let ns = self.seconds(f)? * 1e9 / units as f64;
        let rate = |n: f64| (n > 0.0).then_some(n / ns);
        let figure =
            OpFigure { op: op.into(), shape: shape.into(), unit, ns, gflops: rate(flops), share_of_peak: None, gb_per_s: rate(bytes) };
        (self.progress)(&figure);
        self.ops.push(figure);
        Ok(())
    }
}

fn random(gpu: &Gpu, n: usize, stream: u64) -> Buffer {
    let rng = Rng::new(7, stream);
    gpu.upload(&(0..n).map(|i| rng.uniform(i as u64)).collect::<Vec<_>>())
}

/// Measures the ops on the named device; fewer samples where the CPU plays it.
///
/// # Errors
/// When the device is unknown, not part of the build, absent or lost.
pub fn run(device: &str, repeats: usize, progress: &mut dyn FnMut(&OpFigure)) -> Result<GpuOpsReport> {
    let gpu = Gpu::open(device.parse().map_err(PipelineError::Usage)?).map_err(to_pipeline_error)?;
    let samples = if gpu.software { 1 << 14 } else { 1 << 20 };
    let mut table = Table { gpu: &gpu, repeats, ops: Vec::new(), progress };
    let n = samples * 32;
    let (from, to): (Buffer, Buffer) = (gpu.zeros(n), gpu.empty(n));
    let copy_gb_per_s = n as f64 * 8.0 / table.seconds(|| gpu.copy(&from, &to))? / 1e9;
    encodings(&gpu, samples, &mut table)?;
    networks(&gpu, samples, &mut table)?;
    rays(&gpu, samples, &mut table)?;
    let ops = table.ops;
    Ok(GpuOpsReport { device: gpu.api.name(), software: gpu.software, name: gpu.name, copy_gb_per_s, ops })
}

fn encodings(gpu: &Gpu, s: usize, t: &mut Table) -> Result<()> {
    let grid = HashGrid::new(HashGridConfig { levels: 16, features: 2, log2_size: 19, base: 16, finest: 2048 });
    let (on_gpu, points, table) = (GpuHashGrid::new(gpu, &grid), random(gpu, s * 3, 1), random(gpu, grid.params_len(), 2));
    let rows = Rows::all(gpu, s);
    let (d, d_table) = (random(gpu, s * grid.output_dims(), 3), gpu.zeros(grid.params_len()));
    // Eight rows of two numbers per level and point, and the result.
    let bytes = 16.0 * (8.0 * 8.0 + 8.0);
    t.row("hash_grid", "16 x 2^19 x 2, random points", ("point", s), 0.0, bytes, || {
        on_gpu.forward(gpu, &rows, &points, &table);
    })?;
    t.row("hash_grid, backward", "16 x 2^19 x 2, random points", ("point", s), 0.0, bytes + 16.0 * 64.0, || {
        on_gpu.backward(gpu, &rows, &points, &d, &d_table);
    })?;
    let (p, m, v) = (random(gpu, grid.params_len(), 4), gpu.zeros(grid.params_len()), gpu.zeros(grid.params_len()));
    t.row("adam", "all rows touched", ("parameter", grid.params_len()), 0.0, 32.0, || {
        adam::gpu::step(gpu, &Adam::default(), (1, false), 0..p.len(), &p, [&m, &v], &d_table);
    })?;
    t.row("spherical_harmonics", "degree 4", ("direction", s), 0.0, 76.0, || {
        spherical_harmonics::gpu::forward(gpu, 4, &points);
    })
}

fn networks(gpu: &Gpu, s: usize, t: &mut Table) -> Result<()> {
    let (k, n, rows) = (64, 64, Rows::all(gpu, s));
    let (x, w, d) = (random(gpu, s * k, 1), random(gpu, k * n, 2), random(gpu, s * n, 3));
    let layer = linear::Dense::without_bias(k, n, Activation::Relu);
    let flops = (2 * k * n) as f64;
    let shape = format!("{s}x64x64 f32");
    t.row("linear", &shape, ("row", s), flops, 0.0, || {
        linear::gpu::forward(gpu, &rows, &layer, &x, &w, None);
    })?;
    t.row("linear, forward and backward", &shape, ("row", s), 3.0 * flops, 0.0, || {
        let out = linear::gpu::forward(gpu, &rows, &layer, &x, &w, None);
        linear::gpu::backward(gpu, &rows, &layer, &x, &w, &out, &d);
    })?;
    // The standard field's network: layer by layer, in one launch, and on tensor cores.
    let grid = HashGridConfig { levels: 16, features: 2, log2_size: 4, base: 4, finest: 16 };
    let field = fields::ngp(grid, Space::Cube(1.0), 1e-2, 0, 0, 1);
    let (net, density) = (&field.net, field.density_net(Precision::F32));
    let (params, features, flops) = (gpu.upload(&field.weights.values), random(gpu, s * 32, 4), 2.0 * net.mlp.macs() as f64);
    let p = evenly(gpu, s);
    let direction = random(gpu, p.rays() * 16, 5);
    let g = GpuGradients { sigma: random(gpu, s, 6), features: random(gpu, s * 3, 7), background: gpu.zeros(p.rays() * 3) };
    let input = FieldInput { packed: &p, features: &features, codes: &[&direction], beside: None };
    for (arithmetic, name) in [(Arithmetic::Layers, "layers"), (Arithmetic::Exact, "one launch"), (Arithmetic::Best, "tensor cores")] {
        let net = GpuNet::new(gpu, net, &density, 2, &[true, false], arithmetic);
        let element = net.element();
        if matches!((arithmetic, element), (Arithmetic::Exact, None) | (Arithmetic::Best, None | Some(Element::F32))) {
            continue;
        }
        let shape = format!("32 -> 64 -> 16, 32 -> 64 -> 64 -> 16 {name}");
        t.row("field network", &shape, ("sample", s), flops, 0.0, || {
            net.evaluate(gpu, &params, &input, false);
        })?;
        t.row("field network, forward and backward", &shape, ("sample", s), 3.0 * flops, 0.0, || {
            let at = net.evaluate(gpu, &params, &input, true);
            net.gradients(gpu, &params, &at, &g);
        })?;
    }
    Ok(())
}

/// Samples of rays with [`PER_RAY`] each.
fn evenly(gpu: &Gpu, s: usize) -> GpuPacked {
    let offsets: Vec<u32> = (0..=s / PER_RAY).map(|r| (r * PER_RAY) as u32).collect();
    let (starts, lengths): (Vec<f32>, Vec<f32>) = (0..s).map(|i| ((i % PER_RAY) as f32 * 0.1, 0.1)).unzip();
    GpuPacked::upload(gpu, &Packed { offsets: &offsets, t: &starts, dt: &lengths })
}

fn rays(gpu: &Gpu, s: usize, t: &mut Table) -> Result<()> {
    let p = evenly(gpu, s);
    let (sigma, rgb, background) = (random(gpu, s, 1), random(gpu, s * 3, 2), gpu.zeros(p.rays() * 3));
    let out = composite::forward(gpu, &p, &sigma, &rgb, 3, &background);
    let d = composite::forward(gpu, &p, &sigma, &rgb, 3, &background);
    t.row("composite", "3 channels, 32 samples per ray", ("sample", s), 0.0, 28.0, || {
        composite::forward(gpu, &p, &sigma, &rgb, 3, &background);
    })?;
    t.row("composite, backward", "3 channels, 32 samples per ray", ("sample", s), 0.0, 52.0, || {
        composite::backward(gpu, &p, &rgb, 3, &background, &out, &d);
    })?;
    let (target, left_out, sums) = (random(gpu, p.rays() * 4, 8), gpu.upload(&vec![0u32; p.rays()]), gpu.zeros(SUMS));
    let distance = gpu.empty(0);
    let target = Target { rgba: &target, background: &background, left_out: &left_out, distance: &distance };
    let terms = Terms { color: ColorLoss::Mse, distortion: 0.0, depth: 0.0, alpha: 0.0 };
    t.row("composite, loss and backward", "3 channels, 32 samples per ray", ("sample", s), 0.0, 64.0, || {
        let figures = Figures { sums: &sums, marched: &p.offsets, cut: &left_out, is_main: true };
        loss::composite_and_loss(gpu, (terms, Measure::default()), &p, (&sigma, &rgb), target, 0.0, figures);
    })
}
