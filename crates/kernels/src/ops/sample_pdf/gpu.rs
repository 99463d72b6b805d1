//! One unit per new distance.

use super::FLOOR;
use crate::gpu::{Buffer, Gpu, launch};
use cubecl::prelude::*;

/// Distances `[R, M]` for edges `[R, N + 1]`, weights `[R, N]` and numbers `u` `[R, M]` in [0, 1).
pub fn sample(gpu: &Gpu, n: usize, edges: &Buffer, weights: &Buffer, m: usize, u: &Buffer) -> Buffer {
    let (len, rays) = (u.len(), u.len() / m.max(1));
    let out = gpu.empty(len);
    launch!(
        gpu,
        invert,
        len,
        [edges => rays * (n + 1), weights => rays * n, u => len, out => len],
        len as u32,
        n as u32,
        m as u32,
    );
    out
}

#[cube(launch_unchecked)]
fn invert(edges: &[f32], weights: &[f32], u: &[f32], out: &mut [f32], len: u32, bins: u32, m: u32) {
    let at = ABSOLUTE_POS;
    if at >= len as usize {
        terminate!();
    }
    let n = bins as usize;
    let r = at / m as usize;
    let mut total = 0.0f32;
    for i in 0..n {
        total += weights[r * n + i] + FLOOR;
    }
    let mut rest = u[at] * total;
    let mut bin = 0usize;
    let mut w = weights[r * n] + FLOOR;
    while bin + 1 < n && rest > w {
        rest -= w;
        bin += 1;
        w = weights[r * n + bin] + FLOOR;
    }
    let a = edges[r * (n + 1) + bin];
    let b = edges[r * (n + 1) + bin + 1];
    out[at] = a + (b - a) * min(rest / w, 1.0);
}
