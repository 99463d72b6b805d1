//! Layer after layer through `linear`, parameters in one buffer as on the CPU.

pub mod fused;

use super::{Mlp, Source};
use crate::gpu::{Buffer, Gpu, Rows, launch};
use crate::ops::linear::gpu::{self as linear, Part};
use crate::ops::linear::{Activation, BiasKind, Dense};
use cubecl::prelude::*;

/// Activations of a network that its backward pass needs.
pub struct Values {
    /// Outputs `[N, width]` of every layer.
    pub layers: Vec<Buffer>,
    /// Inputs of the activations whose slope needs them.
    pub pre: Vec<Option<Buffer>>,
}

/// Runs all layers.
pub fn forward(gpu: &Gpu, mlp: &Mlp, params: &Buffer, inputs: &[&Buffer], rows: &Rows) -> Values {
    let mut values = Values { layers: Vec::new(), pre: Vec::new() };
    for (j, layer) in mlp.layers.iter().enumerate() {
        let x = joined(gpu, mlp, j, inputs, &values.layers, rows);
        let (k, n) = (mlp.fan_in(j), layer.width);
        let (w, bias) = parts(mlp, j, params);
        let dense = Dense { k, n, bias: kind(mlp, j), activation: layer.activation };
        if layer.modulation.is_none() && layer.activation.is_monotonic() {
            values.layers.push(linear::forward_part(gpu, rows, &dense, &x, w, bias));
            values.pre.push(None);
            continue;
        }
        let x = layer.modulation.map_or(x.clone(), |m| {
            let scaled = gpu.empty(rows.most * k);
            multiply(gpu, rows, k, (&x, k, 0), (inputs[m], k + n, 0), (&scaled, k, 0), false);
            scaled
        });
        let out = linear::forward_part(gpu, rows, &Dense { activation: Activation::None, ..dense }, &x, w, bias);
        if let Some(m) = layer.modulation {
            columns(gpu, rows, n, (inputs[m], k + n, k), (&out, n, 0), true);
        }
        values.pre.push((!layer.activation.is_monotonic()).then(|| {
            let pre = gpu.empty(out.len());
            gpu.copy(&out, &pre);
            pre
        }));
        linear::finish(gpu, &out, rows, &Dense { bias: BiasKind::None, ..dense }, None);
        values.layers.push(out);
    }
    values
}

/// Gradients of the parameters (0 of frozen layers) and of each input, given those of layers' outputs; none where a layer's
/// is zero.
pub fn backward(
    gpu: &Gpu,
    mlp: &Mlp,
    params: &Buffer,
    inputs: &[&Buffer],
    values: &Values,
    rows: &Rows,
    mut d: Vec<Option<Buffer>>,
) -> (Buffer, Vec<Buffer>) {
    let d_params = gpu.zeros(params.len());
    let d_inputs: Vec<Buffer> = inputs.iter().map(|i| gpu.zeros(i.len())).collect();
    for (j, layer) in mlp.layers.iter().enumerate().rev() {
        let Some(d_out) = d[j].take() else { continue };
        let plain = joined(gpu, mlp, j, inputs, &values.layers, rows);
        let (k, n) = (mlp.fan_in(j), layer.width);
        let x = layer.modulation.map_or(plain.clone(), |m| {
            let scaled = gpu.empty(rows.most * k);
            multiply(gpu, rows, k, (&plain, k, 0), (inputs[m], k + n, 0), (&scaled, k, 0), false);
            scaled
        });
        let (w, _) = parts(mlp, j, params);
        let basis = values.pre[j].as_ref().unwrap_or(&values.layers[j]);
        let g = linear::before_activation(gpu, rows, n, layer.activation, basis, &d_out);
        let mut d_x = if layer.frozen {
            linear::input_gradient(gpu, rows, (k, n), w, &g)
        } else {
            if layer.bias {
                linear::sum_rows_part(gpu, rows, n, &g, Part { buffer: &d_params, at: mlp.offsets[j] + k * n });
            }
            linear::backward_part(gpu, rows, (k, n), &x, w, &g, Part { buffer: &d_params, at: mlp.offsets[j] })
        };
        if let Some(m) = layer.modulation {
            multiply(gpu, rows, k, (&d_x, k, 0), (&plain, k, 0), (&d_inputs[m], k + n, 0), true);
            columns(gpu, rows, n, (&g, n, 0), (&d_inputs[m], k + n, k), true);
            let of_rows = gpu.empty(rows.most * k);
            multiply(gpu, rows, k, (&d_x, k, 0), (inputs[m], k + n, 0), (&of_rows, k, 0), false);
            d_x = of_rows;
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

fn parts<'a>(mlp: &Mlp, j: usize, params: &'a Buffer) -> (Part<'a>, Option<Part<'a>>) {
    let at = mlp.offsets[j];
    let bias = Part { buffer: params, at: at + mlp.fan_in(j) * mlp.layers[j].width };
    (Part { buffer: params, at }, mlp.layers[j].bias.then_some(bias))
}

/// Concatenated inputs of layer `j`, `[N, K]`.
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

/// Columns of a matrix: its buffer, its width, and the first of them.
pub type Columns<'a> = (&'a Buffer, usize, usize);

/// Copies or adds `width` columns.
pub fn columns(gpu: &Gpu, rows: &Rows, width: usize, from: Columns, to: Columns, add: bool) {
    assert!(from.2 + width <= from.1 && to.2 + width <= to.1, "columns beyond a matrix");
    let m = rows.most;
    launch!(
        gpu,
        copy,
        m * width,
        [rows.live => rows.at + 1, from.0 => m * from.1, to.0 => m * to.1],
        rows.place(),
        width as u32,
        from.1 as u32,
        from.2 as u32,
        to.1 as u32,
        to.2 as u32,
        add,
    );
}

/// Multiplies `width` columns of two matrices into those of a third, or adds the products to them.
fn multiply(gpu: &Gpu, rows: &Rows, width: usize, a: Columns, b: Columns, to: Columns, add: bool) {
    assert!([a, b, to].iter().all(|m| m.2 + width <= m.1), "columns beyond a matrix");
    let m = rows.most;
    launch!(
        gpu,
        product,
        m * width,
        [rows.live => rows.at + 1, a.0 => m * a.1, b.0 => m * b.1, to.0 => m * to.1],
        rows.place(),
        width as u32,
        a.1 as u32,
        a.2 as u32,
        b.1 as u32,
        b.2 as u32,
        to.1 as u32,
        to.2 as u32,
        add,
    );
}

#[cube(launch_unchecked)]
fn product(
    live: &[u32],
    a: &[f32],
    b: &[f32],
    to: &mut [f32],
    at: u32,
    width: u32,
    a_width: u32,
    a_at: u32,
    b_width: u32,
    b_at: u32,
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
    let v = a[row * a_width as usize + a_at as usize + col] * b[row * b_width as usize + b_at as usize + col];
    let at = row * to_width as usize + to_at as usize + col;
    if comptime!(add) {
        to[at] += v;
    } else {
        to[at] = v;
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
