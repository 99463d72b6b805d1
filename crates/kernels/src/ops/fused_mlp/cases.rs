//! Cases of the op, for its tests and for `bench check`.

#[cfg(feature = "gpu")]
use super::gpu::{self as on_gpu, fused};
#[cfg(feature = "gpu")]
use super::{Head, gpu::fused::Element, gpu::fused::Fused, reference};
use super::{Layer, Mlp, Source};
#[cfg(feature = "gpu")]
use crate::gpu::table::{TOLERANCE, Table};
#[cfg(feature = "gpu")]
use crate::gpu::{Buffer, Gpu, GpuError, Rows};
use crate::ops::linear::Activation;
use diorama_geom::rng::Rng;
use diorama_testkit::random;
#[cfg(feature = "gpu")]
use diorama_testkit::{compare, wide};

/// `n` rows of each input, parameters, and gradients of every layer's output.
pub struct Case {
    pub mlp: Mlp,
    pub n: usize,
    pub params: Vec<f32>,
    pub inputs: Vec<Vec<f32>>,
    pub d: Vec<Vec<f32>>,
}

/// Skip connections, a split head and biases, with two inputs.
fn branched() -> Mlp {
    let layer = |inputs: Vec<Source>, width, relu: bool, bias| {
        Layer::new(inputs, width, if relu { Activation::Relu } else { Activation::None }, bias)
    };
    use Source::{Input, Layer as L};
    Mlp::new(
        vec![9, 5],
        vec![
            layer(vec![Input(0)], 24, true, true),
            layer(vec![Input(0), L(0)], 17, true, false),
            layer(vec![L(1)], 1, false, true),
            layer(vec![L(1), Input(1), L(2), L(0)], 4, false, true),
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

/// Two modulated layers beside each other, one of whose sources is frozen.
fn modulated_twice() -> Mlp {
    let by = |inputs, width, activation| Layer { modulation: Some(1), ..Layer::new(inputs, width, activation, true) };
    use Source::{Input, Layer as L};
    Mlp::new(
        vec![7, 17],
        vec![
            by(vec![Input(0)], 10, Activation::Silu),
            Layer { frozen: true, ..Layer::new(vec![L(0)], 12, Activation::Relu, true) },
            by(vec![L(0)], 7, Activation::LeakyRelu),
            Layer::new(vec![L(1), L(2), Input(0)], 5, Activation::None, true),
        ],
    )
}

/// Small networks of every kind; layer 1 of the last one is frozen.
pub fn networks() -> [Mlp; 4] {
    [Mlp::chain(vec![32], &[64, 64, 16], false), branched(), modulated(), modulated_twice()]
}

pub fn cases() -> Vec<Case> {
    // As wide as networks of fields become.
    let wide_chain = Mlp::chain(vec![60], &[384, 512, 16], true);
    let of = |(mlp, n): (Mlp, usize)| Case {
        params: mlp.init(&Rng::new(3, 1)),
        inputs: mlp.input_widths.iter().map(|w| random(n * w, *w as u64)).collect(),
        d: mlp.layers.iter().map(|l| random(n * l.width, 8)).collect(),
        mlp,
        n,
    };
    networks().into_iter().chain([wide_chain]).flat_map(|mlp| [0, 1, 259].map(|n| (mlp.clone(), n))).map(of).collect()
}

/// Largest root mean square error of values and of gradients in half precision (11 bits), relative to the root mean square of the
/// reference. Gradients differ more, because sums close to 0 fall on the other side of a ReLU's kink.
#[cfg(feature = "gpu")]
const HALF_TOLERANCE: [f64; 2] = [5e-3, 5e-2];
/// The same for bfloat16 (8 bits).
#[cfg(feature = "gpu")]
const BRAIN_TOLERANCE: [f64; 2] = [3e-2, 2e-1];

/// Compares a result with its reference, with the tolerance of the element type that computed it.
#[cfg(feature = "gpu")]
pub fn compare_as(element: Option<Element>, result: &str, got: &[f32], want: &[f64]) -> Result<f64, String> {
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

#[cfg(feature = "gpu")]
pub fn check(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    for c in cases() {
        let (mlp, shape) = (&c.mlp, format!("N={} {} layers", c.n, c.mlp.layers.len()));
        let inputs: Vec<Buffer> = c.inputs.iter().map(|i| gpu.upload(i)).collect();
        let refs: Vec<&Buffer> = inputs.iter().collect();
        let (params, rows) = (gpu.upload(&c.params), Rows::all(gpu, c.n));
        let values = on_gpu::forward(gpu, mlp, &params, &refs, &rows);
        let wide_inputs: Vec<Vec<f64>> = c.inputs.iter().map(|i| wide(i)).collect();
        let wide_refs: Vec<&[f64]> = wide_inputs.iter().map(|i| &i[..]).collect();
        let want = reference::forward(mlp, &wide(&c.params), &wide_refs, c.n);
        table.close("fused MLP", "forward", &shape, values.layers.last().expect("layers"), want.last().expect("layers"))?;
        let seeds = c.d.iter().map(|d| Some(gpu.upload(d))).collect();
        let (dp, di) = on_gpu::backward(gpu, mlp, &params, &refs, &values, &rows, seeds);
        let wide_d: Vec<Vec<f64>> = c.d.iter().map(|d| wide(d)).collect();
        let (wp, wi) = reference::backward(mlp, &wide(&c.params), &wide_refs, c.n, &wide_d);
        table.close("fused MLP", "d parameters", &shape, &dp, &wp)?;
        for (got, want) in di.iter().zip(&wi) {
            table.close("fused MLP", "d input", &shape, got, want)?;
        }
        in_one_launch(gpu, table, &c, &params, &refs)?;
    }
    Ok(())
}

/// The whole network in one launch, in f32 and on tensor cores, with its last layer as a head.
#[cfg(feature = "gpu")]
fn in_one_launch(gpu: &Gpu, table: &mut Table, c: &Case, params: &Buffer, inputs: &[&Buffer]) -> Result<(), GpuError> {
    let (mlp, n, last) = (&c.mlp, c.n, c.mlp.layers.len() - 1);
    let width = mlp.layers[last].width;
    let head = Head { layer: last, channel: 0, activation: Activation::None, shift: 0.0 };
    let wide_inputs: Vec<Vec<f64>> = c.inputs.iter().map(|i| wide(i)).collect();
    let wide_inputs: Vec<&[f64]> = wide_inputs.iter().map(|i| &i[..]).collect();
    let mut wide_d: Vec<Vec<f64>> = mlp.layers.iter().map(|l| vec![0.0; n * l.width]).collect();
    wide_d[last] = wide(&c.d[last]);
    let want = reference::forward(mlp, &wide(&c.params), &wide_inputs, n);
    let (want_params, want_inputs) = reference::backward(mlp, &wide(&c.params), &wide_inputs, n, &wide_d);
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
        let (dp, di) = net.backward(gpu, params, inputs, &kept, &rows, (&[&gpu.upload(&c.d[last])], 64.0));
        close("d parameters", &dp, &want_params)?;
        for (got, want) in di.iter().zip(&want_inputs) {
            close("d input", got.as_ref().expect("wanted"), want)?;
        }
    }
    Ok(())
}
