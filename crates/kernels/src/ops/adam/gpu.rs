//! One unit per parameter.

use super::Adam;
use crate::gpu::{Buffer, Gpu, launch};
use cubecl::prelude::*;
use std::ops::Range;

/// One step `t ≥ 1` of the parameters `p` in `range` with their first and second moments; `sparse` leaves elements without gradient
/// alone. Their gradients are cleared.
pub fn step(gpu: &Gpu, a: &Adam, (t, sparse): (u32, bool), range: Range<usize>, p: &Buffer, [m, v]: [&Buffer; 2], g: &Buffer) {
    let end = range.end;
    let (b1, b2) = (a.beta1 as f64, a.beta2 as f64);
    let scale = (a.rate as f64 / (1.0 - b1.powi(t as i32))) as f32;
    let root = (1.0 / (1.0 - b2.powi(t as i32))).sqrt() as f32;
    launch!(
        gpu,
        adam,
        range.len(),
        [p => end, m => end, v => end, g => end],
        range.start as u32,
        range.len() as u32,
        scale,
        root,
        a.beta1,
        a.beta2,
        a.epsilon,
        a.weight_decay,
        sparse,
    );
}

#[allow(clippy::collapsible_if, reason = "the outer condition is decided when the kernel is built")]
#[cube(launch_unchecked)]
fn adam(
    p: &mut [f32],
    m: &mut [f32],
    v: &mut [f32],
    g: &mut [f32],
    first: u32,
    n: u32,
    scale: f32,
    root: f32,
    beta1: f32,
    beta2: f32,
    epsilon: f32,
    decay: f32,
    #[comptime] sparse: bool,
) {
    let unit = ABSOLUTE_POS;
    if unit >= n as usize {
        terminate!();
    }
    let i = first as usize + unit;
    let mut d = g[i];
    if comptime!(sparse) {
        if d == 0.0 {
            terminate!();
        }
    }
    d += decay * p[i];
    let m1 = beta1 * m[i] + (1.0 - beta1) * d;
    let v1 = beta2 * v[i] + (1.0 - beta2) * d * d;
    m[i] = m1;
    v[i] = v1;
    p[i] -= scale * m1 / (v1.sqrt() * root + epsilon);
    g[i] = 0.0;
}
