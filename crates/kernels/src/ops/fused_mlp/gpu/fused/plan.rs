//! How the layers of a network lie in memory: packed weights, a tile's activations and gradients, what is kept.

use super::{BLOCK, PLANES};
use crate::ops::fused_mlp::{Head, Mlp, Source};
use crate::ops::linear::Activation;
use crate::ops::linear::gpu::code;

/// Most inputs and heads.
const INPUTS: usize = 3;
const HEADS: usize = 2;
/// Widest layer, and widest input of a layer.
const MOST_WIDTH: usize = 128;
/// Numbers between rows in shared memory, so that rows begin in different banks.
const PAD: usize = 8;

/// Source of a layer.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub(super) struct Feed {
    pub source: Source,
    pub width: usize,
    pub padded: usize,
    /// First row in the layer's packed weight.
    pub at: usize,
    /// First column among a tile's activations in the forward pass.
    pub column: usize,
    /// First column among a tile's gradients in the backward pass; `None` if its gradient is not wanted.
    pub gradient: Option<usize>,
    /// Whether no later layer has written a gradient there.
    pub fresh: bool,
}

impl Feed {
    /// Whether its gradient is added to that of later layers.
    pub fn adds(&self) -> bool {
        !self.fresh && matches!(self.source, Source::Layer(_))
    }
}

#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub(super) struct PlannedLayer {
    pub feeds: Vec<Feed>,
    pub inputs: Vec<usize>,
    pub width: usize,
    pub padded: usize,
    /// Rows of the packed weight.
    pub rows: usize,
    pub relu: bool,
    /// First number in the packed weights.
    pub weight: usize,
    /// First number among the parameters, and in the packed gradients.
    pub bias: Option<(usize, usize)>,
    /// First column among a tile's activations; `None` if no layer reads it.
    pub column: Option<usize>,
    /// First column among the values that are kept for the backward pass.
    pub kept: Option<usize>,
    /// First column among a tile's gradients; `None` if only heads give it a gradient.
    pub gradient: Option<usize>,
}

impl PlannedLayer {
    /// Blocks of its weight.
    fn blocks(&self) -> usize {
        (self.rows / BLOCK) * (self.padded / BLOCK)
    }
}

#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub(super) struct PlannedInput {
    pub width: usize,
    pub padded: usize,
    /// Numbers per level where levels come one after another, `[L, S, F]`; 0: rows `[S, K]`.
    pub per_level: usize,
    pub column: usize,
    pub wanted: bool,
}

#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub(super) struct PlannedHead {
    pub layer: usize,
    pub channel: usize,
    pub channels: usize,
    pub activation: u32,
    pub shift: u32,
}

/// A network as its kernels are built for it.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub(super) struct Plan {
    pub tile: usize,
    pub tensor: bool,
    /// Greatest number of an element, as bits of an f32.
    pub largest: u32,
    pub layers: Vec<PlannedLayer>,
    pub inputs: Vec<PlannedInput>,
    pub heads: Vec<PlannedHead>,
    /// Numbers per row: activations, sums of a layer, kept values, and in the backward pass inputs, gradient, gradients of earlier layers.
    pub stride: usize,
    pub stage: usize,
    pub kept: usize,
    pub x: usize,
    pub g: usize,
    pub gradients: usize,
    /// Weights and biases of the packed gradients.
    pub packed: usize,
    pub keep: bool,
}

fn padded(n: usize) -> usize {
    n.next_multiple_of(BLOCK)
}

/// Columns in use, allocated first fit.
#[derive(Default)]
struct Columns {
    taken: Vec<(usize, usize)>,
    most: usize,
}

impl Columns {
    fn take(&mut self, width: usize) -> usize {
        let mut at = 0;
        for (first, w) in &self.taken {
            if at + width <= *first {
                break;
            }
            at = at.max(first + w);
        }
        self.taken.push((at, width));
        self.taken.sort_unstable();
        self.most = self.most.max(at + width);
        at
    }

    fn free(&mut self, at: usize) {
        self.taken.retain(|(first, _)| *first != at);
    }
}

/// Where the layers up to the last that a head needs lie on the way forward.
struct Layout {
    layers: Vec<PlannedLayer>,
    inputs: Vec<PlannedInput>,
    forward: Columns,
    /// Numbers of all weights, and of what is kept per row.
    weight: usize,
    kept: usize,
}

impl Layout {
    /// Adds layer `j`, of `count`; none where it is too large, reads too much, is modulated, frozen or has an activation other than ReLU.
    fn add(&mut self, mlp: &Mlp, j: usize, count: usize) -> Option<()> {
        let l = &mlp.layers[j];
        let readers = |s: Source| (0..count).filter(|j| mlp.layers[*j].inputs.contains(&s)).collect::<Vec<_>>();
        let mut loaded = Vec::new();
        for s in &l.inputs {
            if let Source::Input(i) = *s
                && readers(*s)[0] == j
                && !loaded.contains(&i)
            {
                self.inputs[i].column = self.forward.take(self.inputs[i].padded);
                loaded.push(i);
            }
        }
        let (mut feeds, mut at) = (Vec::new(), 0);
        for s in &l.inputs {
            let width = mlp.source_width(*s);
            let column = match *s {
                Source::Input(i) => self.inputs[i].column,
                Source::Layer(i) => self.layers[i].column.expect("a layer that is read has a place"),
            };
            feeds.push(Feed { source: *s, width, padded: padded(width), at, column, gradient: None, fresh: true });
            at += padded(width);
        }
        for f in &feeds {
            if readers(f.source).last() == Some(&j) {
                self.forward.free(f.column);
            }
        }
        let read = !readers(Source::Layer(j)).is_empty();
        let p = padded(l.width);
        let column = read.then(|| self.forward.take(p));
        let relu = l.activation == Activation::Relu;
        if l.modulation.is_some() || l.frozen || !(relu || l.activation == Activation::None) {
            return None;
        }
        if at > MOST_WIDTH || p > MOST_WIDTH || l.inputs.iter().enumerate().any(|(i, s)| l.inputs[..i].contains(s)) {
            return None;
        }
        let keeps = read || relu;
        self.layers.push(PlannedLayer {
            feeds,
            inputs: loaded,
            width: l.width,
            padded: p,
            rows: at,
            relu,
            weight: self.weight,
            bias: l.bias.then_some((mlp.offsets[j] + mlp.fan_in(j) * l.width, 0)),
            column,
            kept: keeps.then_some(self.kept),
            gradient: None,
        });
        self.kept += if keeps { p } else { 0 };
        self.weight += at * p;
        Some(())
    }

    /// Places the biases behind the weights.
    fn place_biases(&mut self) {
        for l in &mut self.layers {
            if let Some((_, at)) = &mut l.bias {
                *at = self.weight;
                self.weight += l.padded;
            }
        }
    }

    /// Allocates the gradients' columns in the backward pass, and returns how many they take.
    fn place_gradients(&mut self) -> usize {
        let mut gradients = Columns::default();
        let mut seen = vec![false; self.inputs.len()];
        let layers = &mut self.layers;
        for j in (0..layers.len()).rev() {
            // A layer's gradient is read for the last time before those of its sources are formed.
            if let Some(at) = layers[j].gradient {
                gradients.free(at);
            }
            let mut passing = Vec::new();
            for e in 0..layers[j].feeds.len() {
                let (source, width) = (layers[j].feeds[e].source, layers[j].feeds[e].padded);
                let (place, fresh) = match source {
                    Source::Input(i) if !self.inputs[i].wanted => (None, true),
                    Source::Input(i) => {
                        let at = gradients.take(width);
                        passing.push(at);
                        (Some(at), !std::mem::replace(&mut seen[i], true))
                    }
                    Source::Layer(i) => {
                        let fresh = layers[i].gradient.is_none();
                        let at = *layers[i].gradient.get_or_insert_with(|| gradients.take(width));
                        (Some(at), fresh)
                    }
                };
                (layers[j].feeds[e].gradient, layers[j].feeds[e].fresh) = (place, fresh);
            }
            passing.into_iter().for_each(|at| gradients.free(at));
        }
        gradients.most
    }
}

impl Plan {
    /// Plans layers up to the last that a head needs; none where the network is too large, reads too much, is modulated, frozen in part
    /// or has activations other than ReLU.
    pub fn new(mlp: &Mlp, heads: &[(Head, usize)], per_level: usize, wanted: &[bool]) -> Option<Plan> {
        let count = heads.iter().map(|(h, _)| h.layer + 1).max()?;
        let n_inputs = mlp.input_widths.len();
        if n_inputs > INPUTS || heads.len() > HEADS {
            return None;
        }
        let input = |i: usize| {
            let width = mlp.input_widths[i];
            let per_level = if i == 0 { per_level } else { 0 };
            PlannedInput { width, padded: padded(width), per_level, column: 0, wanted: wanted[i] }
        };
        let inputs = (0..n_inputs).map(input).collect();
        let mut layout = Layout { layers: Vec::new(), inputs, forward: Columns::default(), weight: 0, kept: 0 };
        for j in 0..count {
            layout.add(mlp, j, count)?;
        }
        layout.place_biases();
        let gradients = layout.place_gradients();
        let heads = heads.iter().map(|(h, channels)| PlannedHead {
            layer: h.layer,
            channel: h.channel,
            channels: *channels,
            activation: code(h.activation),
            shift: h.shift.to_bits(),
        });
        let Layout { layers, inputs, forward, weight, kept } = layout;
        let widest = |f: &dyn Fn(&PlannedLayer) -> usize| layers.iter().map(f).max().unwrap_or(0);
        let (stage, x, g) = (widest(&|l| l.padded) + PAD, widest(&|l| l.rows) + PAD, widest(&|l| l.padded) + PAD);
        Some(Plan {
            tile: 0,
            tensor: false,
            largest: f32::MAX.to_bits(),
            stride: forward.most + PAD,
            stage,
            kept: kept.max(1),
            x,
            g,
            gradients: gradients.max(BLOCK) + PAD,
            packed: weight,
            keep: true,
            heads: heads.collect(),
            layers,
            inputs,
        })
    }

    /// Results that a unit keeps until the last tile.
    pub fn sums(&self) -> usize {
        self.sums_before(self.layers.len())
    }

    pub fn biases(&self) -> usize {
        self.biases_before(self.layers.len())
    }

    /// [`Plan::sums`] of the layers before `j`.
    pub fn sums_before(&self, j: usize) -> usize {
        self.layers[..j].iter().map(PlannedLayer::blocks).sum()
    }

    /// Blocks of each plane for the weights of the layers before `j`.
    pub fn blocks_before(&self, j: usize) -> usize {
        self.layers[..j].iter().map(|l| l.blocks().div_ceil(PLANES)).sum()
    }

    /// Biases of the layers before `j`.
    pub fn biases_before(&self, j: usize) -> usize {
        self.layers[..j].iter().filter(|l| l.bias.is_some()).count()
    }

    /// Shared memory of either kernel, the larger.
    pub fn bytes(&self, tile: usize, element: usize) -> usize {
        let stage = if self.tensor { self.stage } else { 0 };
        let forward = self.stride * element + stage * 4;
        let backward = (self.x + self.g) * element + self.gradients * 4;
        tile * forward.max(backward)
    }
}
