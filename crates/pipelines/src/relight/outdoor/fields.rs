//! The fields of a scene: of surfaces and how they look in each light, then, on the same surfaces, of albedo, shadow and normal; or, as
//! printed, of all at once.

use super::config::Config;
use crate::error::{PipelineError, Result};
use diorama_engine::fields::{self, DirectionCode, Encoder, Field, Normals, RayCodes};
use diorama_engine::params::{ParamGroup, Schedule};
use diorama_geom::contraction::Space;
use diorama_geom::rng::Rng;
use diorama_geom::sh_light::ShLight;
use diorama_kernels::gemm::Precision;
use diorama_kernels::ops::adam::Adam;
use diorama_kernels::ops::field_step::{FieldNet, Output};
use diorama_kernels::ops::frequency::Frequency;
use diorama_kernels::ops::fused_mlp::{Head, Layer, Mlp, Source};
use diorama_kernels::ops::hash_grid::HashGridConfig;
use diorama_kernels::ops::linear::Activation;

/// Stream of initial values.
const MATERIALS: u64 = 4;
/// Output layers are padded to a whole vector.
const PADDED: usize = 16;
/// Shift of the shadow before its sigmoid: at first, little is in shadow.
const LIT: f32 = 2.0;
/// Layers of the density, which come first.
const DENSITY: usize = 2;

fn layer(inputs: Vec<Source>, width: usize, activation: Activation) -> Layer {
    Layer::new(inputs, width, activation, true)
}

fn head(layer: usize, activation: Activation, shift: f32) -> Head {
    Head { layer, channel: 0, activation, shift }
}

/// Even light with a little more from above.
pub fn first_lights(n: usize) -> Vec<f32> {
    let mut light = ShLight::uniform([0.9; 3]);
    light.0[2] = [0.3; 3];
    (0..n).flat_map(|_| light.0.into_iter().flatten().map(|v| v as f32)).collect()
}

/// Course of the rates over each stage.
pub fn schedule(config: &Config) -> Schedule {
    Schedule { warmup: 0.01, final_scale: config.optim.final_scale, decay_from: 0.3 }
}

/// Course of the rates where all is learned at once: none, unless `optim.final_scale` asks for a fall.
pub fn joint_schedule(config: &Config) -> Schedule {
    Schedule { warmup: 0.0, final_scale: config.optim.final_scale, decay_from: 0.0 }
}

/// A group of the model that learns all at once.
pub fn joint_group(config: &Config, name: &'static str, values: Vec<f32>, rate: f32) -> ParamGroup {
    ParamGroup { schedule: joint_schedule(config), ..ParamGroup::dense(name, values, joint_adam(rate)) }
}

/// Its optimizer.
pub fn joint_adam(rate: f32) -> Adam {
    Adam { rate, beta2: 0.999, epsilon: 1e-8, ..Adam::default() }
}

/// Surfaces, and their colors in sRGB as seen from a direction in each of `lights` lights, which have codes: instant-ngp's field with an
/// appearance code (Müller et al. 2022; Martin-Brualla et al. 2021).
pub fn of_surfaces(config: &Config, space: Space, lights: usize) -> Field {
    let (f, o) = (&config.field, &config.optim);
    let cubes = match space {
        Space::Contracted(edge) => 2.0 * edge,
        Space::Cube(edge) => edge,
    };
    let finest = (f.finest as f32 * cubes) as u32;
    let grid = HashGridConfig { levels: f.levels, features: 2, log2_size: f.log2_size, base: f.base, finest };
    let mut field = fields::ngp(grid, space, o.grid_rate, lights, f.appearance, config.seed);
    field.net.density.shift = f.first_density.ln();
    field.net.mlp.precision = Precision::Bf16;
    field.encoder.table_mut().into_iter().for_each(|t| t.adam.weight_decay = o.table_decay);
    field.groups_mut().into_iter().for_each(|g| g.schedule = schedule(config));
    field
}

/// Albedo, shadow and normal on the surfaces of a field, which stay as they are: the grid's and the density's features → albedo and normal;
/// these and gray light → shadow. Where suns are apart, the shadow reads the sun of a light of training, and the share that is left of any sun
/// whose traced ray passes reads its direction.
///
/// # Errors
/// When the field is not one of surfaces.
pub fn of_materials(config: &Config, surfaces: Field) -> Result<Field> {
    use Source::{Input, Layer as L};
    let (net, width) = (&surfaces.net.mlp, config.field.width);
    if net.layers.len() <= DENSITY || surfaces.codes.appearance.is_none() {
        return Err(PipelineError::Usage("the field has no surfaces to begin with".into()));
    }
    let mut layers = net.layers[..DENSITY].to_vec();
    let is_apart = config.light.has_sun();
    let heads: &[&[Source]] = if is_apart { &[&[], &[Input(2)], &[], &[Input(1)]] } else { &[&[], &[Input(1)], &[]] };
    for given in heads {
        let first = layers.len();
        layers.extend([
            layer([Input(0), L(1)].iter().chain(*given).copied().collect(), width, Activation::Relu),
            layer(vec![L(first)], width, Activation::Relu),
            layer(vec![L(first + 1)], PADDED, Activation::None),
        ]);
    }
    let mut outputs = vec![
        Output { head: head(4, Activation::Sigmoid, 0.0), channels: 3, are_shares: false },
        Output { head: head(7, Activation::Sigmoid, LIT), channels: 1, are_shares: false },
        Output { head: head(10, Activation::Tanh, 0.0), channels: 3, are_shares: false },
    ];
    let mut given = vec![9];
    if is_apart {
        outputs.push(Output { head: head(13, Activation::Sigmoid, LIT), channels: 1, are_shares: false });
        given.push(9);
    }
    let inputs = std::iter::once(surfaces.encoder.dims()).chain(given.iter().copied()).collect();
    let net = FieldNet { density: surfaces.net.density, outputs, mlp: Mlp { precision: Precision::Bf16, ..Mlp::new(inputs, layers) } };
    let mut weights = net.mlp.init(&Rng::new(config.seed, MATERIALS));
    let kept = net.mlp.offsets[DENSITY];
    weights[..kept].copy_from_slice(&surfaces.weights.values[..kept]);
    let adam = Adam { rate: config.optim.net_rate, ..Adam::default() };
    let mut field = Field {
        weights: ParamGroup { schedule: schedule(config), ..ParamGroup::dense("weights", weights, adam) },
        codes: RayCodes { direction: DirectionCode::None, appearance: None, given },
        net,
        ..surfaces
    };
    field.freeze_layers(|j| j < DENSITY);
    field.encoder.table_mut().into_iter().for_each(|t| t.frozen = true);
    Ok(field)
}

/// Density, albedo in sRGB, shadow and normals in one network of eight layers and two heads; the shadow's reads the gray light (Rudnev et al.
/// 2022, section 4). `stream` tells the coarse from the fine network.
pub fn of_all(config: &Config, edge: f32, stream: u64) -> Field {
    use Source::{Input, Layer as L};
    let (f, o) = (&config.field, &config.optim);
    let encoding = Frequency { dims: 3, bands: f.bands, include_input: true, pi: false, window: None };
    let mut layers = fields::trunk(f.width);
    let trunk = layers.len();
    layers.push(layer(vec![L(trunk - 1)], PADDED, Activation::None));
    layers.push(layer(vec![L(trunk - 1)], f.width, Activation::None));
    let features = trunk + 1;
    for given in [&[][..], &[Input(1)]] {
        let first = layers.len();
        layers.push(layer([L(features)].iter().chain(given).copied().collect(), f.width / 2, Activation::Relu));
        layers.push(layer(vec![L(first)], PADDED, Activation::None));
    }
    let net = FieldNet {
        density: head(trunk, Activation::Relu, 0.0),
        outputs: vec![
            Output { head: head(trunk + 3, Activation::Sigmoid, 0.0), channels: 3, are_shares: false },
            Output { head: head(trunk + 5, Activation::Sigmoid, 0.0), channels: 1, are_shares: false },
        ],
        mlp: Mlp::new(vec![encoding.output_dims(), 9], layers),
    };
    let weights = net.mlp.init(&Rng::new(config.seed, stream));
    let mut field = Field {
        weights: joint_group(config, "weights", weights, o.net_rate),
        encoder: Encoder::Frequency(encoding),
        codes: RayCodes { direction: DirectionCode::None, appearance: None, given: vec![9] },
        space: Space::Cube(edge),
        net,
        normals: None,
        waves: None,
    };
    // All samples, however thin: normals are those of the whole ray.
    let all = Normals { min_weight: 0.0, ..Normals::default() };
    field.set_normals(Some(all)).expect("rectified layers that read the position alone");
    field
}
