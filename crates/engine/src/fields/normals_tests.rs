//! Normals against difference quotients.

use super::*;
use diorama_geom::rng::Rng;
use diorama_kernels::ops::frequency::Frequency;
use diorama_kernels::ops::hash_grid::HashGridConfig;
use diorama_kernels::ops::linear::Activation;
use diorama_testkit::{random, random_unit};

/// Fields of every encoding that has normals, in bounded and unbounded space.
fn fields_with_normals(slope: DensitySlope) -> Vec<Field> {
    let config = HashGridConfig { levels: 3, features: 2, log2_size: 10, base: 3, finest: 9 };
    let frequency = Frequency { dims: 3, bands: 2, include_input: true, pi: true, window: None };
    let mut all = Vec::new();
    for space in [Space::Cube(1.0), Space::Cube(1.7), Space::Contracted(1.0)] {
        let mut hash = ngp(config, space, 1e-2, 0, 0, 3);
        let table = hash.encoder.table_mut().expect("a table");
        table.values = random(table.values.len(), 8);
        hash.net.density.activation = Activation::Softplus;
        let mut plain = mlp(space, 1e-3, 3);
        plain.encoder = Encoder::Frequency(frequency);
        plain.net.mlp = diorama_kernels::ops::fused_mlp::Mlp::chain(vec![frequency.output_dims()], &[32, 32, 16], true);
        (plain.net.density.layer, plain.net.outputs[0].head.layer) = (2, 2);
        plain.weights.values = plain.net.mlp.init(&Rng::new(2, 2));
        plain.weights.grads = vec![0.0; plain.weights.values.len()];
        all.extend([hash, plain]);
    }
    all.iter_mut().for_each(|f| f.set_normals(Some(Normals { slope, min_weight: 0.0 })).expect("piecewise linear densities"));
    all
}

/// Samples of six rays, inside and (in contracted space) outside of the inner cube.
struct Rays {
    positions: Vec<f32>,
    dirs: Vec<f32>,
    background: Vec<f32>,
    offsets: Vec<u32>,
    t: Vec<f32>,
    dt: Vec<f32>,
}

impl Rays {
    fn new(space: Space) -> Rays {
        let reach = if matches!(space, Space::Contracted(_)) { 2.5 } else { 0.9 };
        Rays {
            positions: random_unit(54, 1).iter().map(|v| 0.5 + reach * (v - 0.5)).collect(),
            dirs: [0.0, 0.6, 0.8].repeat(6),
            background: random(18, 4),
            offsets: (0..=6).map(|r| r * 3).collect(),
            t: (0..18).map(|i| (i % 3) as f32).collect(),
            dt: vec![0.7; 18],
        }
    }

    fn batch(&self) -> Batch<'_> {
        let (samples, positions, dirs) = (Packed { offsets: &self.offsets, t: &self.t, dt: &self.dt }, &self.positions[..], &self.dirs[..]);
        Batch { samples, positions, dirs, images: None, given: &[], background: &self.background, near_scaling: 0.0 }
    }
}

/// A smooth function of colors and of the directions of normals.
struct OfNormals(Vec<f32>);

impl BatchLoss for OfNormals {
    fn batch(&self, out: &RayOutputs, g: &mut RayGradients) -> f64 {
        let mut loss = 0.0;
        for ((v, d), w) in out.values.chunks_exact(6).zip(g.values.chunks_exact_mut(6)).zip(self.0.chunks_exact(6)) {
            let l = v[3..].iter().map(|n| n * n).sum::<f32>().sqrt();
            let along: f32 = (3..6).map(|k| w[k] * v[k] / l).sum();
            loss += (along + (0..3).map(|k| w[k] * v[k]).sum::<f32>()) as f64;
            d[..3].copy_from_slice(&w[..3]);
            (3..6).for_each(|k| d[k] = (w[k] - along * v[k] / l) / l);
        }
        loss
    }
}

/// Loss and gradients of weights and table.
fn trained(f: &mut Field, rays: &Rays) -> (f64, Vec<f32>, Vec<f32>) {
    let (mut encoded, mut buf, loss) = (Encoded::default(), FieldBuffers::default(), OfNormals(random(36, 12)));
    f.groups_mut().into_iter().for_each(|g| g.grads.fill(0.0));
    f.encode(&rays.positions, &mut encoded);
    f.train(&rays.batch(), &mut encoded, Loss::Batch(&loss), &mut buf, None);
    assert_eq!((buf.out.values.len(), buf.out.d_background.len()), (36, 18));
    (buf.out.loss, f.weights.grads.clone(), f.encoder.table().map(|t| t.grads.clone()).unwrap_or_default())
}

#[test]
fn the_gradient_of_the_density_is_its_slope_in_model_space() {
    for f in fields_with_normals(DensitySlope::Exact) {
        let rays = Rays::new(f.space);
        let (sigma, got) = f.density_with_gradient(&rays.positions).unwrap();
        let at = |i: usize, k: usize, by: f32| {
            let mut p = rays.positions[i * 3..i * 3 + 3].to_vec();
            p[k] += by;
            let mut sigma = [0.0];
            f.density(&p, &mut sigma);
            sigma[0]
        };
        let scale = got.iter().fold(0.0f32, |a, b| a.max(b.abs()));
        let (mut checked, step) = (0, 1e-3);
        for (i, k) in (0..18).flat_map(|i| [(i, 0), (i, 1), (i, 2)]) {
            assert!((at(i, k, 0.0) - sigma[i]).abs() < 1e-4 * sigma[i].max(1.0));
            let (low, high) = (at(i, k, -step), at(i, k, step));
            // A kink is no place to take a difference.
            if (high - 2.0 * sigma[i] + low).abs() < 2e-2 * scale * step {
                let numeric = (high - low) / (2.0 * step);
                assert!((numeric - got[i * 3 + k]).abs() < 2e-2 * scale, "{:?} {i} {k}: {} for {numeric}", f.space, got[i * 3 + k]);
                checked += 1;
            }
        }
        assert!(checked > 27, "{:?}: {checked}", f.space);
    }
}

#[test]
fn fields_learn_from_their_normals() {
    for slope in [DensitySlope::Exact, DensitySlope::Taps { distance: 0.05 }] {
        for mut f in fields_with_normals(slope) {
            let rays = Rays::new(f.space);
            let (_, weights, table) = trained(&mut f, &rays);
            let mut check = |name: &str, grads: &[f32], value: &dyn Fn(&mut Field) -> &mut Vec<f32>| {
                let mut order: Vec<usize> = (0..grads.len()).collect();
                order.sort_by(|a, b| grads[*b].abs().total_cmp(&grads[*a].abs()));
                let mut agreeing = 0;
                for &i in &order[..12] {
                    let mut at = |by: f32| {
                        value(&mut f)[i] += by;
                        let loss = trained(&mut f, &rays).0;
                        value(&mut f)[i] -= by;
                        loss
                    };
                    let numeric = ((at(3e-4) - at(-3e-4)) / 6e-4) as f32;
                    agreeing += ((numeric - grads[i]).abs() < 0.01 * grads[i].abs()) as usize;
                }
                // A kink between the two spoils a difference.
                assert!(agreeing >= 10, "{name}, {slope:?}: {agreeing} of 12 agree");
            };
            check("weights", &weights, &|f| &mut f.weights.values);
            if !table.is_empty() {
                check("table", &table, &|f| &mut f.encoder.table_mut().expect("a table").values);
            }
        }
    }
}

#[test]
fn normals_are_composited_behind_the_outputs_and_light_samples_have_no_part() {
    for mut f in fields_with_normals(DensitySlope::Exact) {
        let rays = Rays::new(f.space);
        let render = |f: &Field| {
            let (mut encoded, mut buf) = (Encoded::default(), FieldBuffers::default());
            f.encode(&rays.positions, &mut encoded);
            f.render(&rays.batch(), &mut encoded, &mut buf);
            buf.out
        };
        let (all, slopes) = (render(&f), f.density_with_gradient(&rays.positions).unwrap().1);
        for r in 0..6 {
            for k in 0..3 {
                let want: f32 = (r * 3..r * 3 + 3).map(|i| -all.weights[i] * slopes[i * 3 + k]).sum();
                assert!((all.values[r * 6 + 3 + k] - want).abs() < 1e-4 * want.abs().max(1.0), "{r} {k}");
            }
        }
        f.normals = Some(Normals { min_weight: 2.0, ..Normals::default() });
        assert!(render(&f).values.chunks_exact(6).all(|v| v[3..] == [0.0; 3]));
        f.normals = None;
        let plain = render(&f).values;
        assert!(plain.chunks_exact(3).zip(all.values.chunks_exact(6)).all(|(a, b)| *a == b[..3]));
    }
}

#[test]
fn a_density_without_a_gradient_is_refused() {
    let mut f = baseline(Space::Cube(1.0), 1e-3, 1);
    f.net.mlp.layers[0].activation = Activation::Softplus;
    let why = f.set_normals(Some(Normals::default())).unwrap_err().to_string();
    assert!(why.contains("layer 0") && why.contains("Softplus"), "{why}");
    assert_eq!(f.channels(), 3);
}
