use super::*;
use diorama_geom::rng::Rng;
use diorama_kernels::ops::adam::Adam;
use diorama_kernels::ops::field_step::{Output, RayGradient, RayOutput};
use diorama_kernels::ops::fused_mlp::{Head, Layer, Mlp, Source};
use diorama_kernels::ops::linear::Activation;
use diorama_testkit::{random, random_unit};

/// A field of four feature channels beside color, over any encoder.
fn field(encoder: Encoder, codes: RayCodes) -> Field {
    use Source::{Input, Layer as L};
    let mut widths = vec![encoder.dims()];
    widths.extend(codes.widths());
    let color_reads = [L(1)].into_iter().chain((1..widths.len()).map(Input)).collect();
    let mlp = Mlp::new(
        widths,
        vec![
            Layer::new(vec![Input(0)], 16, Activation::LeakyRelu, true),
            Layer::new(vec![L(0)], 8, Activation::None, true),
            Layer::new(color_reads, 8, Activation::None, true),
        ],
    );
    let head = |layer, channel, activation| Head { layer, channel, activation, shift: 0.0 };
    let net = FieldNet {
        density: head(1, 0, Activation::Softplus),
        outputs: vec![
            Output { head: head(2, 0, Activation::Sigmoid), channels: 3, are_shares: false },
            Output { head: head(1, 4, Activation::None), channels: 4, are_shares: false },
        ],
        mlp,
    };
    let weights = ParamGroup::dense("weights", net.mlp.init(&Rng::new(1, 1)), Adam::default());
    Field { encoder, codes, net, space: Space::Cube(1.0), weights, normals: None, waves: None }
}

fn voxels() -> Encoder {
    let grid = VoxelGrid::new(4, 6, |x, y, z| (x + y + z) % 2 == 0 || x == 1);
    let table = ParamGroup::dense("table", random(grid.params_len(), 3), Adam::default());
    Encoder::VoxelCorners { grid, table }
}

/// Rays of three samples each, within the unit cube.
struct Rays {
    positions: Vec<f32>,
    dirs: Vec<f32>,
    background: Vec<f32>,
    style: Vec<f32>,
    offsets: Vec<u32>,
    t: Vec<f32>,
    dt: Vec<f32>,
}

impl Rays {
    fn new(n: usize) -> Rays {
        let dirs = random(n * 3, 2).chunks_exact(3).flat_map(unit).collect();
        Rays {
            positions: random_unit(n * 9, 1),
            dirs,
            background: random(n * 7, 4),
            style: random(n * 5, 5),
            offsets: (0..=n as u32).map(|r| r * 3).collect(),
            t: (0..n * 3).map(|i| (i % 3) as f32).collect(),
            dt: vec![0.7; n * 3],
        }
    }

    fn batch<'a>(&'a self, positions: &'a [f32], given: &'a [&'a [f32]]) -> Batch<'a> {
        let samples = Packed { offsets: &self.offsets, t: &self.t, dt: &self.dt };
        Batch { samples, positions, dirs: &self.dirs, images: None, given, background: &self.background, near_scaling: 0.0 }
    }
}

fn unit(d: &[f32]) -> [f32; 3] {
    let l = (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]).sqrt().max(1e-6);
    [d[0] / l, d[1] / l, d[2] / l]
}

/// Half the squared sum of all values of a batch: a loss that no sum over rays gives.
struct SquaredSum;

impl BatchLoss for SquaredSum {
    fn batch(&self, out: &RayOutputs, g: &mut RayGradients) -> f64 {
        let sum: f64 = out.values.iter().chain(out.depth).map(|v| *v as f64).sum();
        g.values.fill(sum as f32);
        g.depth.fill(sum as f32);
        0.5 * sum * sum
    }
}

/// `Σ values`, as a sum over rays.
struct Sum;

impl RayLoss for Sum {
    fn ray(&self, _: usize, out: &RayOutput, g: &mut RayGradient) -> f64 {
        g.values.fill(1.0);
        out.values.iter().map(|v| *v as f64).sum()
    }
}

#[test]
fn every_encoder_passes_gradients_to_its_table_and_to_positions() {
    let hash = diorama_kernels::ops::hash_grid::HashGrid::new(diorama_kernels::ops::hash_grid::HashGridConfig {
        levels: 3,
        features: 2,
        log2_size: 8,
        base: 3,
        finest: 9,
    });
    let table = ParamGroup::sparse("table", random(hash.params_len(), 6), Adam::default());
    let frequency = diorama_kernels::ops::frequency::Frequency { dims: 3, bands: 2, include_input: true, pi: true, window: None };
    let all = [Encoder::Hash { grid: hash, table }, Encoder::Frequency(frequency), Encoder::TriangleWave { bands: 2 }, voxels()];
    for encoder in all {
        let mut f = field(encoder, RayCodes::new(DirectionCode::SphericalHarmonics(2), None));
        let rays = Rays::new(6);
        let mut buf = FieldBuffers::default();
        let mut value = |f: &mut Field, positions: &[f32], d: Option<&mut Vec<f32>>| {
            let mut encoded = Encoded::default();
            f.encode(positions, &mut encoded);
            f.train(&rays.batch(positions, &[]), &mut encoded, Loss::Rays(&Sum), &mut buf, d);
            buf.out.loss
        };
        let mut d = Vec::new();
        value(&mut f, &rays.positions, Some(&mut d));
        let d_table = f.encoder.table().map(|t| t.grads.clone());
        let near = |numeric: f64, exact: f32, scale: f32| (numeric - exact as f64).abs() < 2e-2 * scale as f64 + 2e-3;
        let scale = d.iter().fold(0.0f32, |a, b| a.max(b.abs()));
        let (mut checked, step) = (0, 1e-3);
        for i in 0..rays.positions.len() {
            let mut at = [rays.positions.clone(), rays.positions.clone()];
            (at[0][i], at[1][i]) = (at[0][i] - step, at[1][i] + step);
            let [low, mid, high] = [&at[0], &rays.positions, &at[1]].map(|p| value(&mut f, p, None));
            // A kink between the two is no place to take a difference.
            if (high - 2.0 * mid + low).abs() < 1e-5 * scale as f64 {
                assert!(near((high - low) / (2.0 * step as f64), d[i], scale), "{:?} {i}: {} for {}", f.encoder.dims(), d[i], high - low);
                checked += 1;
            }
        }
        assert!(checked > rays.positions.len() / 2, "{checked}");
        let Some(d_table) = d_table else { continue };
        let scale = d_table.iter().fold(0.0f32, |a, b| a.max(b.abs()));
        let largest = (0..d_table.len()).max_by(|a, b| d_table[*a].abs().total_cmp(&d_table[*b].abs())).unwrap();
        let mut shifted = |by: f32| {
            f.encoder.table_mut().unwrap().values[largest] += by;
            let v = value(&mut f, &rays.positions, None);
            f.encoder.table_mut().unwrap().values[largest] -= by;
            v
        };
        assert!(near((shifted(step) - shifted(-step)) / (2.0 * step as f64), d_table[largest], scale));
    }
}

#[test]
fn voxels_share_corners_and_emptiness_has_no_features() {
    let Encoder::VoxelCorners { grid, table } = voxels() else { unreachable!() };
    // Of the corners of 4³ voxels, and the row of emptiness, no more.
    assert!(grid.rows().iter().all(|r| *r <= 125) && table.values.len() <= 126 * 6 + 16);
    let mut f = field(voxels(), RayCodes::new(DirectionCode::None, None));
    f.encoder.table_mut().unwrap().values[..6].fill(0.0);
    let empty = [0.125 + 0.25 * 2.0, 0.125, 0.125 + 0.25];
    let mut encoded = Encoded::default();
    f.encode(&empty, &mut encoded);
    assert_eq!(encoded.features, vec![0.0; 6]);
    // On a shared face both voxels say the same.
    let features = |x: f32| {
        let mut encoded = Encoded::default();
        f.encode(&[x, 0.3, 0.3], &mut encoded);
        encoded.features
    };
    let (left, right) = (features(0.25 - 1e-6), features(0.25 + 1e-6));
    assert!(left.iter().zip(&right).all(|(a, b)| (a - b).abs() < 1e-3), "{left:?} {right:?}");
}

#[test]
fn a_batch_loss_gives_the_gradient_of_its_value_and_given_codes_have_theirs() {
    let codes = RayCodes { given: vec![5], ..RayCodes::new(DirectionCode::SphericalHarmonics(2), None) };
    let mut f = field(Encoder::TriangleWave { bands: 3 }, codes);
    let rays = Rays::new(8);
    let mut buf = FieldBuffers::default();
    let mut value = |f: &mut Field, style: &[f32]| {
        let mut encoded = Encoded::default();
        f.encode(&rays.positions, &mut encoded);
        let given = [style];
        f.weights.grads.fill(0.0);
        f.train(&rays.batch(&rays.positions, &given), &mut encoded, Loss::Batch(&SquaredSum), &mut buf, None);
        (buf.out.loss, buf.d_given[0].clone())
    };
    let (_, d_style) = value(&mut f, &rays.style);
    let grads = f.weights.grads.clone();
    let step = 1e-3;
    for i in [0, 7, grads.len() - 3] {
        let mut at = |by: f32| {
            f.weights.values[i] += by;
            let v = value(&mut f, &rays.style).0;
            f.weights.values[i] -= by;
            v
        };
        let numeric = (at(step) - at(-step)) / (2.0 * step as f64);
        assert!((numeric - grads[i] as f64).abs() < 2e-2 * grads[i].abs() as f64 + 0.2, "{i}: {numeric} {}", grads[i]);
    }
    let most = (0..d_style.len()).max_by(|a, b| d_style[*a].abs().total_cmp(&d_style[*b].abs())).unwrap();
    let mut at = |by: f32| {
        let mut style = rays.style.clone();
        style[most] += by;
        value(&mut f, &style).0
    };
    let numeric = (at(step) - at(-step)) / (2.0 * step as f64);
    assert!(d_style[most] != 0.0 && (numeric - d_style[most] as f64).abs() < 2e-2 * d_style[most].abs() as f64 + 0.1);
}

#[test]
fn frozen_layers_stay_where_they_are() {
    let mut f = field(Encoder::TriangleWave { bands: 3 }, RayCodes::new(DirectionCode::None, None));
    f.freeze_layers(|j| j == 2);
    let rays = Rays::new(8);
    let before = f.weights.values.clone();
    let (mut buf, mut encoded) = (FieldBuffers::default(), Encoded::default());
    f.encode(&rays.positions, &mut encoded);
    f.train(&rays.batch(&rays.positions, &[]), &mut encoded, Loss::Rays(&Sum), &mut buf, None);
    f.weights.step(1, 1.0);
    let frozen = f.net.mlp.offsets[2];
    assert_eq!(f.weights.values[frozen..], before[frozen..]);
    assert!(f.weights.values[..frozen].iter().zip(&before).filter(|(a, b)| a != b).count() > frozen / 2);
}

#[test]
fn waves_that_are_read_last_are_the_encoding_of_the_same_positions() {
    let encoder = Encoder::TriangleWave { bands: 3 };
    let codes = || RayCodes::new(DirectionCode::SphericalHarmonics(2), None);
    let mut plain = field(encoder.clone(), codes());
    let mut beside = field(encoder, codes());
    let mut layers = beside.net.mlp.layers.clone();
    let last = beside.net.mlp.input_widths.len();
    layers.iter_mut().flat_map(|l| &mut l.inputs).filter(|i| **i == Source::Input(0)).for_each(|i| *i = Source::Input(last));
    beside.net.mlp = Mlp::new([&beside.net.mlp.input_widths[..], &[9]].concat(), layers);
    beside.waves = Some(3);
    let rays = Rays::new(8);
    let of = |f: &mut Field| {
        let (mut buf, mut encoded, mut d) = (FieldBuffers::default(), Encoded::default(), Vec::new());
        f.encode(&rays.positions, &mut encoded);
        f.train(&rays.batch(&rays.positions, &[]), &mut encoded, Loss::Rays(&Sum), &mut buf, Some(&mut d));
        (buf.out.values, f.weights.grads.clone(), d)
    };
    let want = of(&mut plain);
    assert!(want.2.iter().any(|d| *d != 0.0));
    assert_eq!(of(&mut beside), want);
}
