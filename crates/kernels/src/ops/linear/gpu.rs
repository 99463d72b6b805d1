//! Products in tiles of 16 × 16 through shared memory.

use super::{Activation, BiasKind};
use crate::gpu::{Buffer, CUBE, Gpu, units};
use cubecl::prelude::*;

/// Edge of a tile.
const TILE: usize = 16;
/// Most rows of tiles in one launch.
const MAX_TILES: usize = 65_535;

/// How a product reads its factors.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
enum Order {
    /// `A B`, `[M, K] [K, N]`
    Plain,
    /// `A Bᵀ`, `[M, K] [N, K]`
    SecondTurned,
    /// `Aᵀ B`, `[K, M] [K, N]`
    FirstTurned,
}

fn code(a: Activation) -> u32 {
    match a {
        Activation::None => 0,
        Activation::Relu => 1,
        Activation::Sigmoid => 2,
        Activation::Softplus => 3,
        Activation::TruncatedExp => 4,
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

fn product(gpu: &Gpu, order: Order, (m, k, n): (usize, usize, usize), a: &Buffer, b: Part, out: Part) {
    if m * n == 0 {
        return;
    }
    assert!(a.len() == m * k && b.buffer.len() >= b.at + k * n && out.buffer.len() >= out.at + m * n, "linear: {m} x {k} x {n}");
    let (tiles_m, tiles_n) = (m.div_ceil(TILE), n.div_ceil(TILE));
    assert!(tiles_n <= MAX_TILES && tiles_m <= MAX_TILES * MAX_TILES, "linear: {m} x {n}");
    let count = CubeCount::Static(tiles_n as u32, tiles_m.min(MAX_TILES) as u32, tiles_m.div_ceil(MAX_TILES) as u32);
    let (first, second) = (order == Order::FirstTurned, order == Order::SecondTurned);
    // SAFETY: the kernel checks rows and columns against the sizes.
    unsafe {
        multiply::launch_unchecked(
            &gpu.client,
            count,
            CubeDim::new_2d(TILE as u32, TILE as u32),
            a.arg(),
            b.buffer.arg(),
            out.buffer.arg(),
            b.at as u32,
            out.at as u32,
            m as u32,
            k as u32,
            n as u32,
            first,
            second,
            gpu.shared,
        );
    }
}

/// [`forward`] with a weight and bias that lie in a larger buffer.
pub(crate) fn forward_part(
    gpu: &Gpu,
    size: (usize, usize, usize),
    x: &Buffer,
    w: Part,
    bias: Option<Part>,
    kind: BiasKind,
    a: Activation,
) -> Buffer {
    let out = gpu.empty(size.0 * size.2);
    product(gpu, Order::Plain, size, x, w, (&out).into());
    finish(gpu, &out, size.2, bias, kind, a);
    out
}

/// `act(x W + b)`, `[M, N]`.
pub fn forward(
    gpu: &Gpu,
    size: (usize, usize, usize),
    x: &Buffer,
    w: &Buffer,
    bias: Option<&Buffer>,
    kind: BiasKind,
    a: Activation,
) -> Buffer {
    forward_part(gpu, size, x, w.into(), bias.map(Part::from), kind, a)
}

pub(crate) fn finish(gpu: &Gpu, out: &Buffer, n: usize, bias: Option<Part>, kind: BiasKind, a: Activation) {
    if out.is_empty() || (kind == BiasKind::None && a == Activation::None) {
        return;
    }
    let spare = gpu.empty(1);
    let bias = bias.unwrap_or(Part::from(&spare));
    let bias_kind = match kind {
        BiasKind::None => 0u32,
        BiasKind::Shared => 1,
        BiasKind::PerRow => 2,
    };
    // SAFETY: units past the length stop.
    unsafe {
        activate::launch_unchecked(
            &gpu.client,
            units(out.len()),
            CubeDim::new_1d(CUBE),
            bias.buffer.arg(),
            out.arg(),
            bias.at as u32,
            out.len() as u32,
            n as u32,
            bias_kind,
            code(a),
        );
    }
}

/// Gradients of x, W and the bias.
pub struct Gradients {
    pub x: Buffer,
    pub w: Buffer,
    pub bias: Option<Buffer>,
}

/// From the layer's output, which gives the slope, and its gradient.
#[allow(clippy::too_many_arguments)]
pub fn backward(
    gpu: &Gpu,
    (m, k, n): (usize, usize, usize),
    x: &Buffer,
    w: &Buffer,
    kind: BiasKind,
    a: Activation,
    out: &Buffer,
    d_out: &Buffer,
) -> Gradients {
    let g = before_activation(gpu, a, out, d_out);
    let d_w = gpu.zeros(k * n);
    let d_x = backward_part(gpu, (m, k, n), x, w.into(), &g, (&d_w).into());
    let bias = match kind {
        BiasKind::None => None,
        BiasKind::Shared => {
            let out = gpu.empty(n);
            sum_rows_part(gpu, (m, n), &g, (&out).into());
            Some(out)
        }
        BiasKind::PerRow => Some(g),
    };
    Gradients { x: d_x, w: d_w, bias }
}

/// `d_out · act'`.
pub(crate) fn before_activation(gpu: &Gpu, a: Activation, out: &Buffer, d_out: &Buffer) -> Buffer {
    let g = gpu.empty(out.len());
    if !out.is_empty() {
        // SAFETY: units past the length stop.
        unsafe {
            chain::launch_unchecked(
                &gpu.client,
                units(out.len()),
                CubeDim::new_1d(CUBE),
                out.arg(),
                d_out.arg(),
                g.arg(),
                out.len() as u32,
                code(a),
            );
        }
    }
    g
}

/// Gradient of x; that of the weight is written where `d_w` says, unless there are no rows.
pub(crate) fn backward_part(gpu: &Gpu, (m, k, n): (usize, usize, usize), x: &Buffer, w: Part, g: &Buffer, d_w: Part) -> Buffer {
    if m > 0 {
        product(gpu, Order::FirstTurned, (k, m, n), x, g.into(), d_w);
    }
    let d_x = gpu.empty(m * k);
    product(gpu, Order::SecondTurned, (m, n, k), g, w, (&d_x).into());
    d_x
}

/// Sums of columns, the gradient of a shared bias.
pub(crate) fn sum_rows_part(gpu: &Gpu, (m, n): (usize, usize), g: &Buffer, out: Part) {
    // SAFETY: units past `n` stop.
    unsafe {
        sum_rows::launch_unchecked(
            &gpu.client,
            units(n),
            CubeDim::new_1d(CUBE),
            g.arg(),
            out.buffer.arg(),
            out.at as u32,
            m as u32,
            n as u32,
        );
    }
}

#[cube(launch_unchecked)]
fn multiply(
    a: &[f32],
    b: &[f32],
    out: &mut [f32],
    b_at: u32,
    out_at: u32,
    m: u32,
    k: u32,
    n: u32,
    #[comptime] first_turned: bool,
    #[comptime] second_turned: bool,
    #[comptime] shared: bool,
) {
    let m = m as usize;
    let k = k as usize;
    let n = n as usize;
    let b_at = b_at as usize;
    let tx = UNIT_POS_X as usize;
    let ty = UNIT_POS_Y as usize;
    let row = (CUBE_POS_Y as usize + CUBE_POS_Z as usize * 65_535usize) * 16usize + ty;
    let col = CUBE_POS_X as usize * 16usize + tx;
    let mut sum = 0.0f32;
    if comptime!(shared) {
        let mut left = Shared::<[f32]>::new_slice(256usize);
        let mut right = Shared::<[f32]>::new_slice(256usize);
        for step in 0..k.div_ceil(16usize) {
            let ka = step * 16usize + tx;
            let kb = step * 16usize + ty;
            let mut va = 0.0f32;
            if row < m && ka < k {
                va = left_factor(a, row, ka, m, k, first_turned);
            }
            let mut vb = 0.0f32;
            if kb < k && col < n {
                vb = right_factor(b, b_at, kb, col, k, n, second_turned);
            }
            left[ty * 16usize + tx] = va;
            right[ty * 16usize + tx] = vb;
            sync_cube();
            #[unroll]
            for i in 0..16usize {
                sum += left[ty * 16usize + i] * right[i * 16usize + tx];
            }
            sync_cube();
        }
    } else if row < m && col < n {
        for i in 0..k {
            sum += left_factor(a, row, i, m, k, first_turned) * right_factor(b, b_at, i, col, k, n, second_turned);
        }
    }
    if row < m && col < n {
        out[out_at as usize + row * n + col] = sum;
    }
}

#[cube]
fn left_factor(a: &[f32], row: usize, i: usize, m: usize, k: usize, #[comptime] turned: bool) -> f32 {
    if comptime!(turned) { a[i * m + row] } else { a[row * k + i] }
}

#[cube]
fn right_factor(b: &[f32], at: usize, i: usize, col: usize, k: usize, n: usize, #[comptime] turned: bool) -> f32 {
    if comptime!(turned) { b[at + col * k + i] } else { b[at + i * n + col] }
}

#[cube]
fn apply(x: f32, #[comptime] activation: u32) -> f32 {
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
    y
}

#[cube(launch_unchecked)]
fn activate(bias: &[f32], out: &mut [f32], bias_at: u32, len: u32, n: u32, #[comptime] bias_kind: u32, #[comptime] activation: u32) {
    let i = ABSOLUTE_POS;
    if i >= len as usize {
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

/// `d_out · act'` from the activated output.
#[allow(clippy::collapsible_if, reason = "the outer condition is decided when the kernel is built")]
#[cube(launch_unchecked)]
fn chain(out: &[f32], d_out: &[f32], g: &mut [f32], len: u32, #[comptime] activation: u32) {
    let i = ABSOLUTE_POS;
    if i >= len as usize {
        terminate!();
    }
    let y = out[i];
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
    g[i] = d_out[i] * slope;
}

#[cube(launch_unchecked)]
fn sum_rows(g: &[f32], out: &mut [f32], out_at: u32, m: u32, n: u32) {
    let col = ABSOLUTE_POS;
    if col >= n as usize {
        terminate!();
    }
    let mut sum = 0.0f32;
    for row in 0..m as usize {
        sum += g[row * n as usize + col];
    }
    out[out_at as usize + col] = sum;
}
