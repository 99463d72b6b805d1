//! Cases of the op, for its tests and for `bench check`.

#[cfg(feature = "gpu")]
use super::gpu::{Arithmetic, FieldInput, GpuNet, look_up, look_up_backward, scale_near_gradients};
use super::reference::{self, Step};
use super::{FieldNet, Output};
use crate::ops::composite::Composited;
use crate::ops::composite::cases::{Scene, scene};
use crate::ops::fused_mlp::{Head, Layer, Mlp, Source};
#[cfg(feature = "gpu")]
use crate::ops::fused_mlp::{cases::compare_as, gpu::fused::Element};
use crate::ops::linear::Activation;
use crate::ops::triangle_wave;
#[cfg(feature = "gpu")]
use crate::{
    gpu::{Buffer, Gpu, GpuError, table::Table},
    ops::composite::gpu::{GpuComposited, GpuPacked},
    ops::embedding,
};
use diorama_geom::rng::Rng;
use diorama_testkit::{random, wide};

/// Levels of the features, and numbers of each.
pub const LEVELS: (usize, usize) = (4, 2);
/// Lengths of the codes that the color reads.
pub const CODES: [usize; 2] = [16, 5];

/// A density network and a color network that also reads two codes, as instant-ngp's.
pub fn ngp_net(features: usize) -> FieldNet {
    use Source::{Input, Layer as L};
    let layer =
        |inputs: Vec<Source>, width, relu: bool| Layer::new(inputs, width, if relu { Activation::Relu } else { Activation::None }, false);
    let layers = vec![
        layer(vec![Input(0)], 32, true),
        layer(vec![L(0)], 16, false),
        layer(vec![L(1), Input(1), Input(2)], 32, true),
        layer(vec![L(2)], 16, false),
    ];
    FieldNet::of_color(
        Mlp::new(vec![features, CODES[0], CODES[1]], layers),
        Head { layer: 1, channel: 0, activation: Activation::TruncatedExp, shift: 0.5 },
        Head { layer: 3, channel: 0, activation: Activation::Sigmoid, shift: 0.0 },
    )
}

/// The same network with eleven more channels (ten of another layer, one of the color's), and the density in another channel.
fn with_labels(features: usize) -> FieldNet {
    let mut net = ngp_net(features);
    let mut layers = net.mlp.layers.clone();
    layers.push(Layer::new(vec![Source::Layer(1)], 10, Activation::None, true));
    net.mlp = Mlp::new(net.mlp.input_widths.clone(), layers);
    net.density.channel = 2;
    let head = |layer, channel, activation| Head { layer, channel, activation, shift: 0.1 };
    net.outputs.push(Output { head: head(4, 0, Activation::None), channels: 10, are_shares: false });
    net.outputs.push(Output { head: head(3, 2, Activation::Tanh), channels: 1, are_shares: false });
    net
}

/// Bands of the second encoding, where the network reads one.
pub const BANDS: usize = 3;

/// The network with six shares more, of a layer that reads triangle waves of the positions besides.
fn with_shares(features: usize) -> FieldNet {
    let mut net = ngp_net(features);
    let mut layers = net.mlp.layers.clone();
    layers.push(Layer::new(vec![Source::Input(3), Source::Layer(1)], 16, Activation::Relu, true));
    layers.push(Layer::new(vec![Source::Layer(4)], 8, Activation::None, true));
    net.mlp = Mlp::new([&net.mlp.input_widths[..], &[3 * BANDS]].concat(), layers);
    let head = Head { layer: 5, channel: 1, activation: Activation::None, shift: 0.1 };
    net.outputs.push(Output { head, channels: 6, are_shares: true });
    net
}

/// Samples of rays as a network reads them, and gradients of all that compositing gives.
pub struct Case {
    pub net: FieldNet,
    pub rays: usize,
    pub scene: Scene,
    pub params: Vec<f32>,
    /// Level by level, `[L, S, F]`.
    pub features: Vec<f32>,
    /// `[R, K]` of each code.
    pub codes: [Vec<f32>; 2],
    /// Positions of the second encoding `[S, 3]`, where the network reads one.
    pub points: Option<Vec<f32>>,
    pub background: Vec<f32>,
    /// Of color, depth, opacity and weights.
    pub d: [Vec<f32>; 4],
}

pub fn cases() -> Vec<Case> {
    let of = |(net, rays): (FieldNet, usize)| {
        let (scene, c) = (scene(rays, 3), net.channels());
        let s = scene.t.len();
        Case {
            rays,
            params: net.mlp.init(&Rng::new(1, 1)),
            features: random(s * LEVELS.0 * LEVELS.1, 6),
            codes: [random(rays * CODES[0], 7), random(rays * CODES[1], 8)],
            points: (net.mlp.input_widths.len() == 4).then(|| random(s * 3, 10)),
            background: random(rays * c, 9),
            d: [random(rays * c, 1), random(rays, 2), random(rays, 3), random(s, 4)],
            scene,
            net,
        }
    };
    let width = LEVELS.0 * LEVELS.1;
    let nets = [ngp_net(width), with_labels(width), with_shares(width)];
    nets.into_iter().flat_map(|net| [0, 1, 90].map(|rays| (net.clone(), rays))).map(of).collect()
}

impl Case {
    /// Results and gradients, composed of the other ops' references.
    pub fn want(&self) -> Step {
        let (p, s) = (self.scene.packed(), self.scene.t.len());
        let (levels, f) = LEVELS;
        let rows: Vec<f64> =
            (0..s * levels * f).map(|e| self.features[(e % (levels * f) / f * s + e / (levels * f)) * f + e % f] as f64).collect();
        let codes = [0, 1].map(|i| -> Vec<f64> {
            let w = CODES[i];
            (0..self.rays).flat_map(|r| p.range(r).flat_map(move |_| wide(&self.codes[i][r * w..(r + 1) * w]))).collect()
        });
        let [color, depth, opacity, weights] = self.d.each_ref().map(|v| wide(v));
        let d = Composited { color, depth, opacity, weights };
        let waves = self.points.as_ref().map(|points| triangle_wave::reference::forward(BANDS, &wide(points)));
        let inputs: Vec<&[f64]> = [&rows, &codes[0], &codes[1]].into_iter().chain(&waves).map(|v| &v[..]).collect();
        reference::step(&self.net, &wide(&self.params), &p, &inputs, &wide(&self.background), &d)
    }

    /// Gradients of [`Case::points`].
    pub fn want_points(&self, want: &Step) -> Option<Vec<f64>> {
        self.points.as_ref().map(|points| triangle_wave::reference::backward(BANDS, &wide(points), &want.d_inputs[3]))
    }

    /// Gradients of the features, level by level.
    pub fn want_features(&self, want: &Step) -> Vec<f64> {
        let (s, (levels, f)) = (self.scene.t.len(), LEVELS);
        (0..levels * s * f).map(|i| want.d_inputs[0][i / f % s * levels * f + i / (s * f) * f + i % f]).collect()
    }

    /// Gradients of code `i`, ray by ray.
    pub fn want_code(&self, want: &Step, i: usize) -> Vec<f64> {
        let (p, w) = (self.scene.packed(), CODES[i]);
        (0..self.rays * w).map(|e| p.range(e / w).map(|k| want.d_inputs[i + 1][k * w + e % w]).sum()).collect()
    }
}

#[cfg(feature = "gpu")]
pub fn check(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    for case in cases() {
        for way in [(Arithmetic::Layers, "layers"), (Arithmetic::Exact, "one launch"), (Arithmetic::Best, "tensor cores")] {
            check_case(gpu, table, &case, way)?;
        }
        check_near_scaling(gpu, table, &case)?;
    }
    check_look_up(gpu, table)
}

/// Rows of codes per ray, and the gradient of their table.
#[cfg(feature = "gpu")]
fn check_look_up(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    let (rows, width) = (7, 5);
    for n in [0, 1, 200] {
        let (codes, d, shape) = (random(rows * width, 1), random(n * width, 2), format!("R={n}"));
        let index: Vec<u32> = (0..n as u32).map(|i| i * 3 % rows as u32).collect();
        let names: Vec<i64> = index.iter().map(|i| *i as i64).collect();
        let on_gpu = gpu.upload(&index);
        let want = embedding::reference::forward(width, &wide(&codes), &names);
        table.close("look up", "forward", &shape, &look_up(gpu, &gpu.upload(&codes), &on_gpu, width), &want)?;
        let got = gpu.zeros(rows * width);
        look_up_backward(gpu, &gpu.upload(&d), &on_gpu, width, &got);
        table.close("look up", "d table", &shape, &got, &embedding::reference::backward(rows, width, &names, &wide(&d)))?;
    }
    Ok(())
}

/// Gradients close to the camera.
#[cfg(feature = "gpu")]
fn check_near_scaling(gpu: &Gpu, table: &mut Table, case: &Case) -> Result<(), GpuError> {
    let (p, c, reach) = (case.scene.packed(), case.net.channels(), 1.0);
    let (d_sigma, d_outputs) = (random(p.samples(), 3), random(p.samples() * c, 4));
    let (got_sigma, got_outputs) = (gpu.upload(&d_sigma), gpu.upload(&d_outputs));
    scale_near_gradients(gpu, &GpuPacked::upload(gpu, &p), &got_sigma, &got_outputs, reach);
    let scaled = |d: &[f32], width: usize| -> Vec<f64> {
        d.iter().zip(0..).map(|(d, i)| *d as f64 * reference::near_share(&p, i / width, reach)).collect()
    };
    let shape = format!("R={} S={} C={c}", case.rays, p.samples());
    table.close("near scaling", "d sigma", &shape, &got_sigma, &scaled(&d_sigma, 1))?;
    table.close("near scaling", "d outputs", &shape, &got_outputs, &scaled(&d_outputs, c))
}

#[cfg(feature = "gpu")]
fn check_case(gpu: &Gpu, table: &mut Table, case: &Case, (arithmetic, name): (Arithmetic, &str)) -> Result<(), GpuError> {
    let (net, p) = (&case.net, case.scene.packed());
    let density = Mlp::new(net.mlp.input_widths[..1].to_vec(), net.mlp.layers[..=net.density.layer].to_vec());
    let on_gpu = GpuNet::new(gpu, net, &density, LEVELS.1, &[true; 4][..net.mlp.input_widths.len()], arithmetic);
    let element = on_gpu.element();
    if matches!((arithmetic, element), (Arithmetic::Exact, None) | (Arithmetic::Best, None | Some(Element::F32))) {
        // The device has no arithmetic besides those checked before.
        return Ok(());
    }
    let want = case.want();
    let shape = format!("R={} S={} C={} {name}", case.rays, p.t.len(), net.channels());
    let up = |v: &[f32]| gpu.upload(v);
    let (packed, params, background) = (GpuPacked::upload(gpu, &p), up(&case.params), up(&case.background));
    let codes = case.codes.each_ref().map(|c| up(c));
    let features = on_gpu.features(gpu, &packed.rows(), up(&case.features));
    let mut close = |result, got: &Buffer, want: &[f64]| {
        let got = gpu.read(got)?;
        table.row("field", result, shape.clone(), compare_as(element, result, &got, want));
        Ok::<_, GpuError>(())
    };
    close("density", &on_gpu.density(gpu, &params, &features, &packed.rows()), &want.sigma)?;
    let waves = case.points.as_ref().map(|points| triangle_wave::gpu::forward(gpu, BANDS, &up(points)));
    let input = FieldInput { packed: &packed, features: &features, codes: &codes.each_ref(), beside: waves.as_ref() };
    let step = on_gpu.forward(gpu, &params, &input, &background, true);
    close("color", &step.out.color, &want.out.color)?;
    close("weights", &step.out.weights, &want.out.weights)?;
    let [color, depth, opacity, weights] = case.d.each_ref().map(|v| up(v));
    let g = on_gpu.backward(gpu, &params, &step, &GpuComposited { color, depth, opacity, weights }, 0.0);
    close("d parameters", &g.params, &want.d_params)?;
    close("d background", &g.background, &want.d_background)?;
    close("d features", g.features.as_ref().expect("wanted"), &case.want_features(&want))?;
    if let (Some(points), Some(want)) = (&case.points, case.want_points(&want)) {
        let d = triangle_wave::gpu::backward(gpu, BANDS, &up(points), g.beside.as_ref().expect("wanted"));
        close("d points", &d, &want)?;
    }
    for i in 0..CODES.len() {
        close("d code", g.codes[i].as_ref().expect("wanted"), &case.want_code(&want, i))?;
    }
    Ok(())
}
