//! Layer after layer through `linear`, parameters in one buffer as on the CPU.

pub mod fused;

use super::{Mlp, Source};
use crate::gpu::{Buffer, CUBE, Gpu, Rows, units};
use crate::ops::linear::gpu::{self as linear, Part};
use crate::ops::linear::{Activation, BiasKind};
use cubecl::prelude::*;

/// Outputs `[N, width]` of every layer.
pub fn forward(gpu: &Gpu, mlp: &Mlp, params: &Buffer, inputs: &[&Buffer], rows: &Rows) -> Vec<Buffer> {
    let mut values: Vec<Buffer> = Vec::new();
    for (j, layer) in mlp.layers.iter().enumerate() {
        let x = joined(gpu, mlp, j, inputs, &values, rows);
        let size = (mlp.fan_in(j), layer.width);
        let (w, bias) = parts(mlp, j, params);
        values.push(linear::forward_part(gpu, rows, size, &x, w, bias, kind(mlp, j), activation(mlp, j)));
    }
    values
}

/// Gradients of the parameters and of each input, given those of layers' outputs; none where a layer's is zero.
pub fn backward(
    gpu: &Gpu,
    mlp: &Mlp,
    params: &Buffer,
    inputs: &[&Buffer],
    values: &[Buffer],
    rows: &Rows,
    mut d: Vec<Option<Buffer>>,
) -> (Buffer, Vec<Buffer>) {
    let d_params = gpu.zeros(params.len());
    let d_inputs: Vec<Buffer> = inputs.iter().map(|i| gpu.zeros(i.len())).collect();
    for (j, layer) in mlp.layers.iter().enumerate().rev() {
        let Some(d_out) = d[j].take() else { continue };
        let x = joined(gpu, mlp, j, inputs, values, rows);
        let k = mlp.fan_in(j);
        let (w, _) = parts(mlp, j, params);
        let g = linear::before_activation(gpu, rows, layer.width, activation(mlp, j), &values[j], &d_out);
        let d_x = linear::backward_part(gpu, rows, (k, layer.width), &x, w, &g, Part { buffer: &d_params, at: mlp.offsets[j] });
        if layer.bias {
            linear::sum_rows_part(gpu, rows, layer.width, &g, Part { buffer: &d_params, at: mlp.offsets[j] + k * layer.width });
        }
        let mut at = 0;
        for s in &layer.inputs {
            let width = mlp.source_width(*s);
            let to = match *s {
                Source::Input(i) => &d_inputs[i],
                Source::Layer(i) => d[i].get_or_insert_with(|| gpu.zeros(rows.most * width)),
            };
            columns(gpu, rows, width, (&d_x, k, at), (to, width, 0), true);
            at += width;
        }
    }
    (d_params, d_inputs)
}

fn kind(mlp: &Mlp, j: usize) -> BiasKind {
    if mlp.layers[j].bias { BiasKind::Shared } else { BiasKind::None }
}

fn activation(mlp: &Mlp, j: usize) -> Activation {
    if mlp.layers[j].relu { Activation::Relu } else { Activation::None }
}

fn parts<'a>(mlp: &Mlp, j: usize, params: &'a Buffer) -> (Part<'a>, Option<Part<'a>>) {
    let at = mlp.offsets[j];
    let bias = Part { buffer: params, at: at + mlp.fan_in(j) * mlp.layers[j].width };
    (Part { buffer: params, at }, mlp.layers[j].bias.then_some(bias))
}

/// What layer `j` reads, side by side, `[N, K]`.
fn joined(gpu: &Gpu, mlp: &Mlp, j: usize, inputs: &[&Buffer], values: &[Buffer], rows: &Rows) -> Buffer {
    let of = |s: Source| match s {
        Source::Input(i) => inputs[i],
        Source::Layer(i) => &values[i],
    };
    if let [one] = mlp.layers[j].inputs[..] {
        return of(one).clone();
    }
    let k = mlp.fan_in(j);
    let out = gpu.empty(rows.most * k);
    let mut at = 0;
    for s in &mlp.layers[j].inputs {
        let width = mlp.source_width(*s);
        columns(gpu, rows, width, (of(*s), width, 0), (&out, k, at), false);
        at += width;
    }
    out
}

/// Copies or adds `width` columns between matrices given as (buffer, width, first column).
pub(crate) fn columns(gpu: &Gpu, rows: &Rows, width: usize, from: (&Buffer, usize, usize), to: (&Buffer, usize, usize), add: bool) {
    if rows.most * width == 0 {
        return;
    }
    let (live, at) = rows.arg();
    // SAFETY: units past the rows stop; the columns lie within both matrices.
    unsafe {
        copy::launch_unchecked(
            &gpu.client,
            units(rows.most * width),
            CubeDim::new_1d(CUBE),
            live,
            from.0.arg(),
            to.0.arg(),
            at,
            width as u32,
            from.1 as u32,
            from.2 as u32,
            to.1 as u32,
            to.2 as u32,
            add,
        );
    }
}

#[cube(launch_unchecked)]
fn copy(
    live: &[u32],
    from: &[f32],
    to: &mut [f32],
    at: u32,
    width: u32,
    from_width: u32,
    from_at: u32,
    to_width: u32,
    to_at: u32,
    #[comptime] add: bool,
) {
    let i = ABSOLUTE_POS;
    if i >= live[at as usize] as usize * width as usize {
        terminate!();
    }
    let row = i / width as usize;
    let col = i % width as usize;
    let v = from[row * from_width as usize + from_at as usize + col];
    let at = row * to_width as usize + to_at as usize + col;
    if comptime!(add) {
        to[at] += v;
    } else {
        to[at] = v;
    }
}
