//! A discriminator of patches (Isola et al. 2017) whose convolutions have spectral norm 1 (Miyato et al. 2018).

use crate::bridge::{Forward, Kept, OpError, SliceOp, Values, ValuesMut, apply_one, expect_inputs};
use crate::layers::{Conv2d, Init};
use crate::ops::{self, Activation, Conv};
use crate::param::{Kind, Mode, Module, Param, Visitor};
use burn::tensor::Tensor;

/// A weight divided by its largest singular value `σ = uᵀ W v`, of which u and v are held fixed in the gradient.
#[derive(Debug)]
struct DivideOp {
    u: Vec<f32>,
    v: Vec<f32>,
}

impl DivideOp {
    fn sigma(&self, w: &[f32]) -> f32 {
        let rows = w.chunks_exact(self.v.len()).zip(&self.u);
        rows.map(|(row, u)| *u as f64 * dot(row, &self.v)).sum::<f64>() as f32
    }
}

fn dot(a: &[f32], b: &[f32]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a * b) as f64).sum()
}

impl SliceOp for DivideOp {
    fn name(&self) -> &'static str {
        "spectral norm"
    }

    fn check(&self, shapes: &[&[usize]]) -> Result<(), OpError> {
        expect_inputs(self.name(), shapes, 1)
    }

    fn forward(&self, x: &[Values], _: &[bool]) -> Forward {
        let inverse = 1.0 / self.sigma(&x[0]);
        let mut out = ValuesMut::any(x[0].shape());
        out.iter_mut().zip(&x[0][..]).for_each(|(o, w)| *o = w * inverse);
        Forward::one(out.freeze(), Kept::of(x))
    }

    fn backward(&self, kept: &Kept, d: &[Option<Values>], _: &[bool]) -> Vec<Option<Values>> {
        let w = &kept.values[0];
        let inverse = 1.0 / self.sigma(w);
        vec![d[0].as_ref().map(|d| {
            // d(W / σ) = dW / σ − W (uᵀ dW v) / σ².
            let along = (dot(d, w) as f32) * inverse * inverse;
            let mut out = ValuesMut::any(w.shape());
            let rows = out.chunks_exact_mut(self.v.len()).zip(d.chunks_exact(self.v.len())).zip(&self.u);
            rows.for_each(|((o, d), u)| o.iter_mut().zip(d).zip(&self.v).for_each(|((o, d), v)| *o = d * inverse - along * u * v));
            out.freeze()
        })]
    }
}

/// A convolution whose weight, as a matrix `[out, in · h · w]`, has spectral norm 1.
#[derive(Debug)]
pub struct SpectralConv {
    pub conv: Conv2d,
    /// Estimate of the first left singular vector.
    pub u: Param,
    /// Estimate of the first right singular vector.
    pub v: Param,
}

const EPSILON: f32 = 1e-12;

fn normalize(x: &mut [f32]) {
    let inverse = 1.0 / (dot(x, x).sqrt() as f32).max(EPSILON);
    x.iter_mut().for_each(|x| *x *= inverse);
}

impl SpectralConv {
    pub fn new(init: &mut Init, channels: [usize; 2], kernel: usize, settings: Conv) -> SpectralConv {
        let conv = Conv2d::new(init, channels, kernel, settings);
        let columns = conv.weight.len() / channels[1];
        let vector = |init: &mut Init, n: usize| {
            let p = init.constant(Kind::Statistic, &[n], 0.0);
            let random = init.normal(&[n], 1.0).values();
            p.write(|x| {
                x.copy_from_slice(&random);
                normalize(x);
            });
            p
        };
        SpectralConv { u: vector(init, channels[1]), v: vector(init, columns), conv }
    }

    /// One power iteration: `v ← Wᵀ u / |Wᵀ u|`, `u ← W v / |W v|`.
    fn iterate(&self) {
        self.conv.weight.read(|w| {
            self.u.write(|u| {
                self.v.write(|v| {
                    let columns = v.len();
                    v.fill(0.0);
                    for (row, u) in w.chunks_exact(columns).zip(&*u) {
                        v.iter_mut().zip(row).for_each(|(v, w)| *v += w * u);
                    }
                    normalize(v);
                    u.iter_mut().zip(w.chunks_exact(columns)).for_each(|(u, row)| *u = dot(row, v) as f32);
                    normalize(u);
                });
            });
        });
    }

    /// In training the estimates are improved by one power iteration first.
    pub fn forward(&self, x: Tensor<4>, mode: Mode) -> Result<Tensor<4>, OpError> {
        if mode == Mode::Train {
            self.iterate();
        }
        let op = DivideOp { u: self.u.values(), v: self.v.values() };
        let weight = apply_one(op, vec![self.conv.weight.tensor::<4>(mode).into_dispatch()])?;
        ops::conv2d(x, weight, self.conv.bias.as_ref().map(|b| b.tensor(mode)), self.conv.settings)
    }
}

impl Module for SpectralConv {
    fn visit(&self, v: &mut Visitor) {
        v.param("weight", &self.conv.weight);
        if let Some(b) = &self.conv.bias {
            v.param("bias", b);
        }
        v.param("u", &self.u);
        v.param("v", &self.v);
    }
}

/// Tells for each patch whether it is real.
#[derive(Debug)]
pub struct Discriminator {
    convs: Vec<SpectralConv>,
}

impl Discriminator {
    /// `halvings` convolutions of stride 2 that double the channels up to eight times `width`, and two of stride 1.
    pub fn new(init: &mut Init, inputs: usize, width: usize, halvings: usize) -> Discriminator {
        let leaky = Conv { padding: [1; 2], ..Conv::default() }.activation(Activation::LeakyRelu(0.2));
        let mut from = inputs;
        let mut convs = Vec::new();
        for i in 0..=halvings {
            let to = width << i.min(3);
            convs.push(SpectralConv::new(init, [from, to], 4, leaky.stride(if i < halvings { 2 } else { 1 })));
            from = to;
        }
        convs.push(SpectralConv::new(init, [from, 1], 4, leaky.activation(Activation::None)));
        Discriminator { convs }
    }

    /// Logits of patches.
    ///
    /// # Shapes
    /// x `[N, inputs, H, W]`; result `[N, 1, H', W']`.
    pub fn forward(&self, mut x: Tensor<4>, mode: Mode) -> Result<Tensor<4>, OpError> {
        for conv in &self.convs {
            x = conv.forward(x, mode)?;
        }
        Ok(x)
    }
}

impl Module for Discriminator {
    fn visit(&self, v: &mut Visitor) {
        v.parts("convs", &self.convs);
    }
}
