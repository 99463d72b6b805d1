//! `diorama bench ops`

use super::median_seconds;
use diorama_geom::glam::DVec3;
use diorama_geom::rng::Rng;
use diorama_geom::{Camera, Pose};
use diorama_kernels::gemm::{Precision, has_bf16};
use diorama_kernels::ops::adam::{self, Adam};
use diorama_kernels::ops::composite::{self, Packed};
use diorama_kernels::ops::frequency::{self, Frequency};
use diorama_kernels::ops::fused_mlp::{self, Mlp};
use diorama_kernels::ops::hash_grid::{self, HashGrid, HashGridConfig};
use diorama_kernels::ops::linear::{self, Activation, BiasKind, Gradients, Linear};
use diorama_kernels::ops::march::{self, MarchConfig, MarchRays, Marched, OccupancyBits};
use diorama_kernels::ops::ray_generation::{self, PosedCamera};
use diorama_kernels::ops::{spherical_harmonics, ssim};
use diorama_kernels::probe;
use serde::Serialize;

/// Limits of this machine, measured on one thread: the best that was seen before and between the ops.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Limits {
    pub fma_gflops: f64,
    pub read_gb_per_s: f64,
}

/// One line of the table.
#[derive(Clone, Debug, Serialize)]
pub struct OpFigure {
    pub op: String,
    pub shape: String,
    /// Unit of `ns`: a sample, a ray, a parameter…
    pub unit: &'static str,
    /// Nanoseconds per unit, all threads together.
    pub ns: f64,
    /// Device of the op.
    pub gflops: Option<f64>,
    /// Of the measured multiply-add peak of the threads in use.
    pub share_of_peak: Option<f64>,
    /// Useful bytes read and written, where the op moves data.
    pub gb_per_s: Option<f64>,
}

/// Everything `bench ops` measures.
#[derive(Clone, Debug, Serialize)]
pub struct OpsReport {
    pub threads: usize,
    pub simd: &'static str,
    pub limits: Limits,
    pub ops: Vec<OpFigure>,
}

impl OpsReport {
    /// Multiply-add peak of all threads in use, in GFLOP/s.
    fn peak(&self) -> f64 {
        self.limits.fma_gflops * self.threads as f64
    }
}

/// Work per unit: floating-point operations and bytes.
#[derive(Clone, Copy)]
enum Work {
    Flops(f64),
    Bytes(f64),
    Unknown,
}

struct Table<'a> {
    report: OpsReport,
    repeats: usize,
    progress: &'a mut (dyn FnMut(&OpFigure) + Send),
}

impl Table<'_> {
    fn row(&mut self, op: &str, shape: &str, unit: &'static str, units: usize, work: Work, f: impl FnMut()) {
        let ns = median_seconds(self.repeats, f) * 1e9 / units as f64;
        let (gflops, gb_per_s) = match work {
            Work::Flops(n) => (Some(n / ns), None),
            Work::Bytes(n) => (None, Some(n / ns)),
            Work::Unknown => (None, None),
        };
        if gflops.is_some() {
            // A neighbour that slowed the first look down may be gone by now.
            let limits = &mut self.report.limits;
            limits.fma_gflops = limits.fma_gflops.max(fma_gflops());
        }
        let share_of_peak = gflops.map(|g| g / self.report.peak());
        let figure = OpFigure { op: op.into(), shape: shape.into(), unit, ns, gflops, share_of_peak, gb_per_s };
        (self.progress)(&figure);
        self.report.ops.push(figure);
    }
}

/// Limits of one thread: the best of several tries.
fn limits() -> Limits {
    let buffer = vec![1u64; 1 << 25];
    Limits { fma_gflops: fma_gflops(), read_gb_per_s: best(9, || probe::read_bandwidth(&buffer)) / 1e9 }
}

/// Multiply-add peak of this thread, the best of many short tries: what interrupts a thread spoils few of them.
pub(super) fn fma_gflops() -> f64 {
    best(32, || probe::fma_peak(1 << 18)) / 1e9
}

fn best(tries: usize, f: impl Fn() -> f64) -> f64 {
    (0..tries).map(|_| f()).fold(0.0, f64::max)
}

fn random(n: usize, stream: u64) -> Vec<f32> {
    let rng = Rng::new(7, stream);
    (0..n).map(|i| rng.uniform(i as u64) * 2.0 - 1.0).collect()
}

/// Measures all ops on `threads` threads; `progress` hears of each line.
pub fn run(threads: usize, repeats: usize, progress: &mut (dyn FnMut(&OpFigure) + Send)) -> OpsReport {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a thread pool");
    let report = OpsReport { threads, simd: diorama_kernels::simd::level().name(), limits: limits(), ops: Vec::new() };
    let mut table = Table { report, repeats, progress };
    // All of it on a thread of the pool: entering the pool takes a sleeping thread's wake-up, as long as a small op.
    pool.install(|| {
        networks(&mut table);
        encodings(&mut table);
        rays(&mut table);
    });
    let mut report = table.report;
    let peak = report.peak();
    report.ops.iter_mut().for_each(|o| o.share_of_peak = o.gflops.map(|g| g / peak));
    report
}

fn networks(t: &mut Table) {
    for width in [64, 256] {
        let (m, k, n) = (4096, width, width);
        let (x, w, d) = (random(m * k, 1), random(k * n, 2), random(m * n, 3));
        let (mut out, mut dx, mut dw) = (vec![0.0; m * n], vec![0.0; m * k], vec![0.0; k * n]);
        let shape = format!("{m}x{width}x{width} f32");
        let flops = (2 * k * n) as f64;
        let l = Linear { rows: m, inputs: k, outputs: n, bias: BiasKind::None, activation: Activation::Relu, precision: Precision::F32 };
        t.row("linear", &shape, "row", m, Work::Flops(flops), || linear::cpu::forward(&l, &x, &w, &[], &mut out));
        t.row("linear, forward and backward", &shape, "row", m, Work::Flops(3.0 * flops), || {
            linear::cpu::forward(&l, &x, &w, &[], &mut out);
            linear::cpu::backward(&l, &x, &w, &out, &d, Gradients { x: Some(&mut dx), w: Some(&mut dw), bias: None });
        });
    }
    for (name, inputs, widths) in [("fused_mlp", 32, &[64, 64, 16][..]), ("fused_mlp", 60, &[256, 256, 256, 16])] {
        for precision in [Precision::F32, Precision::Bf16] {
            if precision == Precision::Bf16 && !has_bf16() {
                continue;
            }
            let mlp = Mlp { precision, ..Mlp::chain(vec![inputs], widths, false) };
            let n = 1 << 14;
            let params = mlp.init(&Rng::new(1, 1));
            let (x, d) = (random(n * inputs, 1), random(n * 16, 2));
            let (mut out, mut dp, mut dx) = (vec![0.0; n * 16], vec![0.0; params.len()], vec![vec![0.0; n * inputs]]);
            let shape = format!(
                "{inputs} -> {} {}",
                widths.iter().map(|w| w.to_string()).collect::<Vec<_>>().join(" -> "),
                if precision == Precision::F32 { "f32" } else { "bf16" }
            );
            let flops = 2.0 * mlp.macs() as f64;
            t.row(name, &shape, "sample", n, Work::Flops(flops), || {
                fused_mlp::cpu::forward(&mlp, &params, &[&x], n, &mut out);
            });
            t.row(&format!("{name}, backward"), &shape, "sample", n, Work::Flops(3.0 * flops), || {
                fused_mlp::cpu::backward(&mlp, &params, &[&x], n, &d, &mut dp, &mut dx);
            });
        }
    }
}

fn encodings(t: &mut Table) {
    let grid = HashGrid::new(HashGridConfig { levels: 16, features: 2, log2_size: 19, base: 16, finest: 2048 });
    let n = 1 << 17;
    let points: Vec<f32> = random(n * 3, 1).iter().map(|v| 0.5 + 0.5 * v).collect();
    let table = random(grid.params_len(), 2);
    let mut out = vec![0.0; n * grid.output_dims()];
    let (mut d_table, mut touched) = (vec![0.0; grid.params_len()], vec![0u8; grid.params_len() / adam::cpu::LINE]);
    let d = random(n * grid.output_dims(), 3);
    // Eight rows of two floats per level; backward reads and writes them.
    let bytes = (16 * 8 * 8) as f64;
    t.row("hash_grid", "16 x 2^19 x 2, random points", "point", n, Work::Bytes(bytes), || {
        hash_grid::cpu::forward(&grid, &points, &table, &mut out);
    });
    t.row("hash_grid, backward", "16 x 2^19 x 2, random points", "point", n, Work::Bytes(2.0 * bytes), || {
        hash_grid::cpu::backward(&grid, &points, &d, &mut d_table, Some(&mut touched));
    });
    let (mut p, mut m, mut v) = (table.clone(), vec![0.0; table.len()], vec![0.0; table.len()]);
    let a = Adam::default();
    t.row("adam, touched rows", "all rows touched", "parameter", p.len(), Work::Bytes(32.0), || {
        touched.fill(1);
        adam::cpu::sparse(&a, 1, &mut p, &mut m, &mut v, &mut d_table, &mut touched);
    });
    let f = Frequency { dims: 3, bands: 10, include_input: true, pi: true, window: None };
    let x = random(n * 3, 4);
    let mut out = vec![0.0; n * f.output_dims()];
    t.row("frequency", "10 bands", "point", n, Work::Bytes(4.0 * (3 + f.output_dims()) as f64), || {
        frequency::cpu::forward(&f, &x, &mut out);
    });
    let mut out = vec![0.0; n * 16];
    t.row("spherical_harmonics", "degree 4", "direction", n, Work::Bytes(4.0 * 19.0), || {
        spherical_harmonics::cpu::forward(4, &x, &mut out);
    });
}

fn rays(t: &mut Table) {
    let n = 4096;
    let camera =
        PosedCamera { camera: Camera::pinhole(64, 64, 0.7), pose: Pose::look_at(DVec3::new(0.5, -1.2, 0.8), DVec3::splat(0.5), DVec3::Z) };
    let index = vec![0u32; n];
    let pixels: Vec<f32> = (0..n).flat_map(|i| [(i % 64) as f32 + 0.5, (i / 64) as f32 + 0.5]).collect();
    let (mut origins, mut dirs) = (vec![0.0; n * 3], vec![0.0; n * 3]);
    t.row("ray_generation", "pinhole", "ray", n, Work::Unknown, || {
        ray_generation::cpu::forward(&[camera], &index, &pixels, &mut origins, &mut dirs);
    });
    let mut grid = OccupancyBits::full(128, 1);
    // A ball's shell, as after some training.
    grid.fill_with(|cell| {
        let at = [cell % 128, cell / 128 % 128, cell / 16384].map(|v| (v as f32 - 63.5) / 64.0);
        (0.4..0.6).contains(&at.iter().map(|v| v * v).sum::<f32>().sqrt())
    });
    let near_far: Vec<f32> = (0..n).flat_map(|_| [0.1, 3.0]).collect();
    let jitter = vec![0.5; n];
    let rays = MarchRays { origins: &origins, dirs: &dirs, near_far: &near_far, jitter: &jitter, resumed: false };
    let config = MarchConfig { cone: 0.0, dt_min: 1.732 / 1024.0, dt_max: 1.0, max_samples: 1024, ..MarchConfig::default() };
    let (mut scratch, mut marched) = (march::cpu::MarchScratch::default(), Marched::default());
    t.row("march", "128^3, a shell", "ray", n, Work::Unknown, || {
        march::cpu::march(&grid, &rays, &config, &mut scratch, &mut marched);
    });
    let s = marched.t.len();
    let packed = Packed { offsets: &marched.offsets, t: &marched.t, dt: &marched.dt };
    let sigma: Vec<f32> = random(s, 1).iter().map(|v| 5.0 + 4.0 * v).collect();
    let rgb = random(s * 3, 2);
    let background = vec![0.0; n * 3];
    t.row("composite", "3 channels", "sample", s, Work::Bytes(4.0 * 7.0), || {
        composite::cpu::forward(&packed, &sigma, &rgb, 3, &background);
    });
    let d = random(n * 3, 3);
    let upstream = composite::cpu::Upstream { color: Some(&d), ..Default::default() };
    t.row("composite, backward", "3 channels", "sample", s, Work::Bytes(4.0 * 10.0), || {
        composite::cpu::backward(&packed, &sigma, &rgb, 3, &background, &upstream);
    });
    let (w, h) = (480, 270);
    let (x, y) = (random(w * h * 3, 1), random(w * h * 3, 2));
    t.row("ssim", "480x270x3", "pixel", w * h, Work::Unknown, || {
        ssim::cpu::ssim(w, h, 3, &x, &y);
    });
}
