//! The four methods' fields (object.md, section 4).

use super::{Appearance, DirectionCode, Encoder, Field, RayCodes};
use crate::params::ParamGroup;
use diorama_geom::contraction::Space;
use diorama_geom::rng::Rng;
use diorama_kernels::ops::adam::Adam;
use diorama_kernels::ops::field_step::FieldNet;
use diorama_kernels::ops::frequency::Frequency;
use diorama_kernels::ops::fused_mlp::{Head, Layer, Mlp, Source};
use diorama_kernels::ops::hash_grid::{HashGrid, HashGridConfig};
use diorama_kernels::ops::linear::Activation;

/// Output layers are padded to a whole vector; unused channels get no gradient.
const PADDED: usize = 16;

/// Streams of initial values.
const WEIGHTS: u64 = 1;
const TABLE: u64 = 2;
const CODES: u64 = 3;

fn appearance(images: usize, dims: usize, seed: u64) -> Option<Appearance> {
    let rng = Rng::new(seed, CODES);
    let values = (0..images * dims).map(|i| rng.normal(i as u64) * 0.01).collect();
    let adam = Adam { rate: 1e-3, ..Adam::default() };
    (dims > 0).then(|| Appearance { dims, group: ParamGroup::dense("appearance", values, adam) })
}

fn layer(inputs: Vec<Source>, width: usize, relu: bool, bias: bool) -> Layer {
    Layer::new(inputs, width, if relu { Activation::Relu } else { Activation::None }, bias)
}

/// Inputs of the view-dependent part: direction code, then appearance code.
fn ray_inputs(first: usize, count: usize) -> impl Iterator<Item = Source> {
    (0..count).map(move |i| Source::Input(first + i))
}

/// Hash grid 32 → 64 → 16 with truncated exponential density, then 16 + 16 (+ appearance) → 64 → 64 → 3
/// (Müller et al. 2022, section 5.4).
pub fn ngp(grid: HashGridConfig, space: Space, rate: f32, images: usize, dims: usize, seed: u64) -> Field {
    use Source::{Input, Layer as L};
    let grid = HashGrid::new(grid);
    let appearance = appearance(images, dims, seed);
    let codes = 1 + appearance.is_some() as usize;
    let mut widths = vec![grid.output_dims(), 16];
    widths.extend(appearance.as_ref().map(|a| a.dims));
    let layers = vec![
        layer(vec![Input(0)], 64, true, false),
        layer(vec![L(0)], PADDED, false, false),
        layer([L(1)].into_iter().chain(ray_inputs(1, codes)).collect(), 64, true, false),
        layer(vec![L(2)], 64, true, false),
        layer(vec![L(3)], PADDED, false, false),
    ];
    let net = FieldNet::of_color(
        Mlp::new(widths, layers),
        Head { layer: 1, channel: 0, activation: Activation::TruncatedExp, shift: 0.0 },
        Head { layer: 4, channel: 0, activation: Activation::Sigmoid, shift: 0.0 },
    );
    let table_rng = Rng::new(seed, TABLE);
    let table = (0..grid.params_len()).map(|i| (table_rng.uniform(i as u64) * 2.0 - 1.0) * 1e-4).collect();
    let adam = Adam { rate, ..Adam::default() };
    Field {
        weights: ParamGroup::dense("weights", net.mlp.init(&Rng::new(seed, WEIGHTS)), adam),
        encoder: Encoder::Hash { grid, table: ParamGroup::sparse("table", table, adam) },
        codes: RayCodes::new(DirectionCode::SphericalHarmonics(4), appearance),
        net,
        space,
        normals: None,
        waves: None,
    }
}

/// The first eight layers of NeRF's network, of which the sixth reads the position again (Mildenhall et al. 2020, figure 7).
pub fn trunk(width: usize) -> Vec<Layer> {
    use Source::{Input, Layer as L};
    let inputs = |j: usize| match j {
        0 => vec![Input(0)],
        5 => vec![Input(0), L(4)],
        _ => vec![L(j - 1)],
    };
    (0..8).map(|j| layer(inputs(j), width, true, true)).collect()
}

/// γ with 10 and 4 bands, 8 × 256 with a skip to the fifth layer, 128-wide view branch
/// (Mildenhall et al. 2020, figure 7). `stream` tells the coarse from the fine network.
pub fn nerf(space: Space, rate: f32, images: usize, dims: usize, seed: u64, stream: u64) -> Field {
    use Source::Layer as L;
    let encoding = Frequency { dims: 3, bands: 10, include_input: true, pi: true, window: None };
    let view = Frequency { bands: 4, pi: false, ..encoding };
    let appearance = appearance(images, dims, seed);
    let codes = 1 + appearance.is_some() as usize;
    let mut widths = vec![encoding.output_dims(), view.output_dims()];
    widths.extend(appearance.as_ref().map(|a| a.dims));
    let mut layers = trunk(256);
    layers.push(layer(vec![L(7)], PADDED, false, true));
    layers.push(layer(vec![L(7)], 256, false, true));
    layers.push(layer([L(9)].into_iter().chain(ray_inputs(1, codes)).collect(), 128, true, true));
    layers.push(layer(vec![L(10)], PADDED, false, true));
    let net = FieldNet::of_color(
        Mlp::new(widths, layers),
        Head { layer: 8, channel: 0, activation: Activation::Softplus, shift: 0.0 },
        Head { layer: 11, channel: 0, activation: Activation::Sigmoid, shift: 0.0 },
    );
    let codes = RayCodes::new(DirectionCode::Frequency(view), appearance);
    frequency_field(net, encoding, codes, space, rate, seed.wrapping_add(stream << 32))
}

/// The report's primary network: sin and cos of position to 60 values, 4 fully connected layers of 256,
/// ReLU; density and color.
pub fn mlp(space: Space, rate: f32, seed: u64) -> Field {
    let encoding = Frequency { dims: 3, bands: 10, include_input: false, pi: true, window: None };
    plain(encoding, &[256, 256, 256, 256, PADDED], space, rate, seed)
}

/// The report's baseline: raw input, 2 fully connected layers of 256; density and color.
pub fn baseline(space: Space, rate: f32, seed: u64) -> Field {
    let encoding = Frequency { dims: 3, bands: 0, include_input: true, pi: true, window: None };
    plain(encoding, &[256, 256, PADDED], space, rate, seed)
}

fn plain(encoding: Frequency, widths: &[usize], space: Space, rate: f32, seed: u64) -> Field {
    let last = widths.len() - 1;
    let net = FieldNet::of_color(
        Mlp::chain(vec![encoding.output_dims()], widths, true),
        Head { layer: last, channel: 3, activation: Activation::Softplus, shift: 0.0 },
        Head { layer: last, channel: 0, activation: Activation::Sigmoid, shift: 0.0 },
    );
    frequency_field(net, encoding, RayCodes::new(DirectionCode::None, None), space, rate, seed)
}

fn frequency_field(net: FieldNet, encoding: Frequency, codes: RayCodes, space: Space, rate: f32, seed: u64) -> Field {
    let adam = Adam { rate, beta2: 0.999, epsilon: 1e-8, ..Adam::default() };
    Field {
        weights: ParamGroup::dense("weights", net.mlp.init(&Rng::new(seed, WEIGHTS)), adam),
        encoder: Encoder::Frequency(encoding),
        codes,
        net,
        space,
        normals: None,
        waves: None,
    }
}
