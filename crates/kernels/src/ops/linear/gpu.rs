//! Products by cubes of 16 × 16 units, each with up to 4 × 4 results of its own, through shared memory. Weight gradients, sums over very many rows, are
//! formed by slices of rows and then added up.

mod product;

use super::{Activation, BiasKind, Dense};
use crate::gpu::{Buffer, Gpu, Rows, launch};
use cubecl::prelude::*;
use product::{outer, product};

pub(crate) use product::add_outer;

/// Rows per slice of a sum over rows, and most slices.
const SLICE: usize = 1024;
const MAX_SLICES: usize = 256;

pub(crate) fn code(a: Activation) -> u32 {
    match a {
        Activation::None => 0,
        Activation::Relu => 1,
        Activation::Sigmoid => 2,
        Activation::Softplus => 3,
        Activation::TruncatedExp => 4,
        Activation::LeakyRelu => 5,
        Activation::Tanh => 6,
        Activation::Silu => 7,
    }
}

/// A matrix that begins somewhere in a buffer.
#[derive(Clone, Copy)]
pub(crate) struct Part<'a> {
    pub buffer: &'a Buffer,
    pub at: usize,
}

impl<'a> From<&'a Buffer> for Part<'a> {
    fn from(buffer: &'a Buffer) -> Self {
        Part { buffer, at: 0 }
    }
}

/// Sums of `slices` rows of `n` numbers.
fn add_up(gpu: &Gpu, parts: &Buffer, slices: usize, n: usize, out: Part) {
    launch!(gpu, total, n, [parts => slices * n, out.buffer => out.at + n], out.at as u32, slices as u32, n as u32);
}

/// [`forward`] with a weight and bias that lie in a larger buffer.
pub(crate) fn forward_part(gpu: &Gpu, rows: &Rows, layer: &Dense, x: &Buffer, w: Part, bias: Option<Part>) -> Buffer {
    let out = gpu.empty(rows.most * layer.n);
    product(gpu, false, rows, (layer.k, layer.n), x, w, (&out).into());
    finish(gpu, &out, rows, layer, bias);
    out
}

/// `act(x W + b)`, `[M, N]`, for W `[K, N]`.
pub fn forward(gpu: &Gpu, rows: &Rows, layer: &Dense, x: &Buffer, w: &Buffer, bias: Option<&Buffer>) -> Buffer {
    forward_part(gpu, rows, layer, x, w.into(), bias.map(Part::from))
}

/// Adds a layer's bias and activates, in place.
pub(crate) fn finish(gpu: &Gpu, out: &Buffer, rows: &Rows, &Dense { n, bias: kind, activation, .. }: &Dense, bias: Option<Part>) {
    if kind == BiasKind::None && activation == Activation::None {
        return;
    }
    // Bound where there is no bias to read.
    let spare = gpu.empty(0);
    let bias = bias.unwrap_or(Part::from(&spare));
    let bias_len = kind.len(rows.most, n);
    let bias_kind = match kind {
        BiasKind::None => 0u32,
        BiasKind::Shared => 1,
        BiasKind::PerRow => 2,
    };
    launch!(
        gpu,
        activate,
        rows.most * n,
        [rows.live => rows.at + 1, bias.buffer => bias.at + bias_len, out => rows.most * n],
        rows.place(),
        bias.at as u32,
        n as u32,
        bias_kind,
        code(activation),
    );
}

/// Channels of a layer's output `[M, width]`, shifted and activated, `[M, channels]`.
pub(crate) fn head(gpu: &Gpu, rows: &Rows, from: (&Buffer, usize, usize), channels: usize, shift: f32, a: Activation) -> Buffer {
    let n = rows.most * channels;
    let out = gpu.empty(n);
    let (values, width, first) = from;
    launch!(
        gpu,
        pick,
        n,
        [rows.live => rows.at + 1, values => rows.most * width, out => n],
        rows.place(),
        width as u32,
        first as u32,
        channels as u32,
        shift,
        code(a),
    );
    out
}

/// Gradients of x, W and the bias.
pub struct Gradients {
    pub x: Buffer,
    pub w: Buffer,
    pub bias: Option<Buffer>,
}

/// From the layer's output, which gives the slope, and its gradient.
pub fn backward(gpu: &Gpu, rows: &Rows, layer: &Dense, x: &Buffer, w: &Buffer, out: &Buffer, d_out: &Buffer) -> Gradients {
    let &Dense { k, n, bias, activation } = layer;
    let g = before_activation(gpu, rows, n, activation, out, d_out);
    let d_w = gpu.empty(k * n);
    let d_x = backward_part(gpu, rows, (k, n), x, w.into(), &g, (&d_w).into());
    let bias = match bias {
        BiasKind::None => None,
        BiasKind::Shared => {
            let out = gpu.empty(n);
            sum_rows_part(gpu, rows, n, &g, (&out).into());
            Some(out)
        }
        BiasKind::PerRow => Some(g),
    };
    Gradients { x: d_x, w: d_w, bias }
}

/// `d_out · act'`, from the activated output; for SiLU from its input.
pub(crate) fn before_activation(gpu: &Gpu, rows: &Rows, n: usize, a: Activation, out: &Buffer, d_out: &Buffer) -> Buffer {
    let all = rows.most * n;
    let g = gpu.empty(all);
    launch!(
        gpu,
        chain,
        all,
        [rows.live => rows.at + 1, out => all, d_out => all, g => all],
        rows.place(),
        n as u32,
        code(a),
    );
    g
}

/// Gradient of x; that of the weight is written where `d_w` says.
pub(crate) fn backward_part(gpu: &Gpu, rows: &Rows, size: (usize, usize), x: &Buffer, w: Part, g: &Buffer, d_w: Part) -> Buffer {
    outer(gpu, rows, size, x, g, d_w);
    input_gradient(gpu, rows, size, w, g)
}

/// Gradient of x alone.
pub(crate) fn input_gradient(gpu: &Gpu, rows: &Rows, (k, n): (usize, usize), w: Part, g: &Buffer) -> Buffer {
    let d_x = gpu.empty(rows.most * k);
    product(gpu, true, rows, (n, k), g, w, (&d_x).into());
    d_x
}

/// Sums of columns, the gradient of a shared bias.
pub(crate) fn sum_rows_part(gpu: &Gpu, rows: &Rows, n: usize, g: &Buffer, out: Part) {
    let slices = (rows.most / SLICE).clamp(1, MAX_SLICES);
    let parts = gpu.empty(slices * n);
    launch!(
        gpu,
        sum_rows,
        slices * n,
        [rows.live => rows.at + 1, g => rows.most * n, parts => slices * n],
        rows.place(),
        slices as u32,
        n as u32,
    );
    add_up(gpu, &parts, slices, n, out);
}

#[cube(launch_unchecked)]
fn total(parts: &[f32], out: &mut [f32], out_at: u32, slices: u32, n: u32) {
    let i = ABSOLUTE_POS;
    if i >= n as usize {
        terminate!();
    }
    let mut sum = 0.0f32;
    for s in 0..slices as usize {
        sum += parts[s * n as usize + i];
    }
    out[out_at as usize + i] = sum;
}

#[cube]
pub(crate) fn apply(x: f32, #[comptime] activation: u32) -> f32 {
    let mut y = x;
    if comptime!(activation == 1) {
        y = max(x, 0.0);
    }
    if comptime!(activation == 2) {
        y = 1.0 / (1.0 + (-x).exp());
    }
    if comptime!(activation == 3) {
        y = max(x, 0.0) + (-x.abs()).exp().log1p();
    }
    if comptime!(activation == 4) {
        y = x.exp();
    }
    if comptime!(activation == 5) {
        let leaked: f32 = 0.2f32 * x;
        y = max(x, leaked);
    }
    if comptime!(activation == 6) {
        let twice: f32 = -2.0f32 * x.abs();
        let e: f32 = twice.exp();
        y = (1.0 - e) / (1.0 + e);
        if x < 0.0 {
            y = -y;
        }
    }
    if comptime!(activation == 7) {
        y = x / (1.0 + (-x).exp());
    }
    y
}

#[cube(launch_unchecked)]
fn activate(
    live: &[u32],
    bias: &[f32],
    out: &mut [f32],
    at: u32,
    bias_at: u32,
    n: u32,
    #[comptime] bias_kind: u32,
    #[comptime] activation: u32,
) {
    let i = ABSOLUTE_POS;
    if i >= live[at as usize] as usize * n as usize {
        terminate!();
    }
    let mut v = out[i];
    if comptime!(bias_kind == 1) {
        v += bias[bias_at as usize + i % n as usize];
    }
    if comptime!(bias_kind == 2) {
        v += bias[bias_at as usize + i];
    }
    out[i] = apply(v, activation);
}

#[cube(launch_unchecked)]
fn pick(
    live: &[u32],
    values: &[f32],
    out: &mut [f32],
    at: u32,
    width: u32,
    first: u32,
    channels: u32,
    shift: f32,
    #[comptime] activation: u32,
) {
    let i = ABSOLUTE_POS;
    let c = channels as usize;
    if i >= live[at as usize] as usize * c {
        terminate!();
    }
    out[i] = apply(values[i / c * width as usize + first as usize + i % c] + shift, activation);
}

/// The activation's slope, from the activated output; that of SiLU from its input.
#[allow(clippy::collapsible_if, reason = "the outer condition is decided when the kernel is built")]
#[cube]
pub(crate) fn slope(y: f32, #[comptime] activation: u32) -> f32 {
    let mut slope = 1.0f32;
    if comptime!(activation == 1) {
        if y <= 0.0 {
            slope = 0.0;
        }
    }
    if comptime!(activation == 2) {
        slope = y * (1.0 - y);
    }
    if comptime!(activation == 3) {
        slope = 1.0 - (-y).exp();
    }
    if comptime!(activation == 4) {
        slope = min(y, 3_269_017.5);
    }
    if comptime!(activation == 5) {
        if y <= 0.0 {
            slope = 0.2;
        }
    }
    if comptime!(activation == 6) {
        slope = 1.0 - y * y;
    }
    if comptime!(activation == 7) {
        let s: f32 = 1.0 / (1.0 + (-y).exp());
        slope = s * (1.0 + y * (1.0 - s));
    }
    slope
}

/// `d_out · act'`, as [`slope`] gives it.
#[cube(launch_unchecked)]
fn chain(live: &[u32], out: &[f32], d_out: &[f32], g: &mut [f32], at: u32, n: u32, #[comptime] activation: u32) {
    let i = ABSOLUTE_POS;
    if i >= live[at as usize] as usize * n as usize {
        terminate!();
    }
    g[i] = d_out[i] * slope(out[i], activation);
}

#[cube(launch_unchecked)]
fn sum_rows(live: &[u32], g: &[f32], parts: &mut [f32], at: u32, slices: u32, n: u32) {
    let unit = ABSOLUTE_POS;
    let n = n as usize;
    if unit >= slices as usize * n {
        terminate!();
    }
    let m = live[at as usize] as usize;
    let per = m.div_ceil(slices as usize);
    let first = min(unit / n * per, m);
    let mut sum = 0.0f32;
    for row in first..min(first + per, m) {
        sum += g[row * n + unit % n];
    }
    parts[unit] = sum;
}
