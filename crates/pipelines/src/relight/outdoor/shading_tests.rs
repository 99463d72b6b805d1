//! The loss against central differences.

use super::shading::*;
use super::sunlit::{ARRIVES, LEFT, sunlit};
use super::visibility::{Ambient, Radiosity, Visibility, radiances};
use diorama_engine::fields::DensityQuery;
use diorama_engine::samplers::occupancy::Occupancy;
use diorama_geom::glam::Vec3;
use diorama_geom::rng::Rng;
use diorama_kernels::ops::field_step::{BatchLoss, RayGradients, RayOutputs};
use std::sync::{LazyLock, Mutex};

struct Case {
    values: Vec<f32>,
    opacity: Vec<f32>,
    dirs: Vec<f32>,
    target: Vec<f32>,
    lights: Vec<f32>,
    skies: Vec<f32>,
    gains: Vec<f32>,
    /// Empty: no suns apart.
    suns: Vec<f32>,
    /// Of the surfaces.
    normals: Vec<f32>,
    bends: bool,
}

/// Space without matter.
struct Empty;

impl DensityQuery for Empty {
    fn density(&self, _: &[f32], sigma: &mut [f32]) {
        sigma.fill(0.0);
    }
}

/// Space with matter above.
struct Ceiling;

impl DensityQuery for Ceiling {
    fn density(&self, model: &[f32], sigma: &mut [f32]) {
        sigma.iter_mut().zip(model.chunks_exact(3)).for_each(|(s, p)| *s = if p[2] > 0.8 { 1000.0 } else { 0.0 });
    }
}

static HALF: LazyLock<Visibility> = LazyLock::new(|| Visibility::of(&Ceiling, &Occupancy::new(16, 1, false), (0.0, 1.0), 16));
static EMPTY: LazyLock<Visibility> = LazyLock::new(|| Visibility::of(&Empty, &Occupancy::new(16, 1, false), (0.0, 1.0), 16));

const RAYS: usize = 5;
const LIGHTS: [u32; RAYS] = [0, 1, 1, 0, 1];

fn case() -> Case {
    let rng = Rng::new(3, 1);
    let draw = |n: usize, stream: u64| (0..n).map(|i| rng.uniform(stream * 1000 + i as u64)).collect::<Vec<f32>>();
    let mut values = draw(RAYS * CHANNELS, 1);
    values.chunks_exact_mut(CHANNELS).for_each(|v| v[NORMAL..NORMAL + 3].iter_mut().for_each(|n| *n = 20.0 * (*n - 0.5)));
    let mut dirs: Vec<f32> = draw(RAYS * 3, 2).iter().map(|d| d - 0.5).collect();
    dirs.chunks_exact_mut(3).for_each(|d| {
        let l = d.iter().map(|v| v * v).sum::<f32>().sqrt();
        d.iter_mut().for_each(|v| *v /= l);
    });
    let signed = |n: usize, stream: u64, by: f32| draw(n, stream).iter().map(|v| by * (v - 0.3)).collect::<Vec<f32>>();
    Case {
        values,
        opacity: draw(RAYS, 3),
        dirs,
        target: draw(RAYS * 3, 4),
        lights: signed(2 * LIGHT, 5, 2.0),
        skies: signed(2 * SKY, 6, 1.0),
        gains: signed(3 * RAYS, 7, 0.4),
        suns: Vec::new(),
        // Of slopes that the suns shine on.
        normals: (0..RAYS).flat_map(|r| [0.5, -0.6 + 0.1 * r as f32, 0.6]).collect(),
        bends: false,
    }
}

/// Of a sky, and of a ground that is as bright as the mean of one.
fn ambient(sky: &[f32], over: &[f32]) -> Ambient {
    let ground = Vec3::from_slice(over) * radiances(Vec3::Z)[0];
    Ambient { sky: sky.to_vec(), radiosity: Radiosity { ground, ..Radiosity::dark() } }
}

fn sunlit_case() -> Case {
    let sun = |toward: [f32; 3], power: f32| [toward[0], toward[1], toward[2], power, 0.8 * power, 0.6];
    let left = |(r, v): (usize, &[f32])| [v, &[0.2 + 0.15 * r as f32]].concat();
    let values = case().values.chunks_exact(CHANNELS).enumerate().flat_map(left).collect();
    Case { values, suns: [sun([0.6, 0.0, 0.8], 0.9), sun([0.0, -0.8, 0.6], 0.5)].concat(), ..case() }
}

/// Without what is left of any sun, which is taught by what the field says of those of training and does not teach that.
fn run(c: &Case) -> (f64, RayGradients, SceneGradients) {
    run_with(c, if c.suns.is_empty() { 0.3 } else { 0.0 }, &EMPTY)
}

fn run_with(c: &Case, traced: f32, visibility: &Visibility) -> (f64, RayGradients, SceneGradients) {
    let suns = [0.6, 0.0, 0.8, 0.9, 0.8, 0.6].repeat(RAYS);
    let over = case().lights;
    let ambients: [Ambient; 2] = std::array::from_fn(|l| ambient(&c.lights[LIGHT * l..][..LIGHT], &over[LIGHT * l..]));
    let skies = (0..LIGHT).map(|i| if i < 3 { 0.5 } else { 0.05 }).collect::<Vec<f32>>().repeat(RAYS);
    let loss = SceneLoss {
        weights: Weights { huber: 0.4, robust: 0.0, shadow: 0.2, traced, negative: 0.5, gauge: 0.0, tie: 0.3, retinex: 0.0 },
        target: &c.target,
        counts: &[1.0, 0.5, 1.0, 0.0, 1.0],
        normals: &c.normals,
        dirs: &c.dirs,
        light: &LIGHTS,
        image: &[0, 1, 2, 3, 4],
        lights: &c.lights,
        skies: &c.skies,
        gains: &c.gains,
        suns: (!c.suns.is_empty()).then(|| Suns { values: &c.suns, ambients: &ambients, visibility, origins: &[0.5; 3 * RAYS], seed: 0 }),
        bends: c.bends,
        traced: c.suns.is_empty().then(|| TracedLight {
            suns: &suns,
            skies: &skies,
            visibility: &HALF,
            origins: &[0.5; 3 * RAYS],
            seed: 0,
        }),
        out: Mutex::default(),
    };
    let mut d = RayGradients::default();
    d.clear(RAYS, c.values.len() / RAYS);
    let out = RayOutputs { values: &c.values, opacity: &c.opacity, depth: &[0.0; RAYS] };
    let value = loss.batch(&out, &mut d);
    (value, d, loss.out.into_inner().unwrap())
}

/// Compares a gradient with central differences of the loss.
fn check(name: &str, base: fn() -> Case, of: fn(&mut Case) -> &mut Vec<f32>, got: &[f32], step: f32) {
    let mut compared = 0;
    for i in 0..got.len() {
        let at = |by: f32| {
            let mut c = base();
            of(&mut c)[i] += by;
            run(&c).0
        };
        let (a, b) = (at(step), at(-step));
        let want = (a - b) / (2.0 * step as f64);
        // Not across a kink of max(0, ·).
        let curvature = ((a + b - 2.0 * run(&base()).0) / (step * step) as f64).abs();
        if curvature * (step as f64) < 0.05 * want.abs() + 0.02 {
            compared += (want.abs() > 1e-4) as usize;
            assert!((got[i] as f64 - want).abs() < 0.02 * want.abs() + 2e-3, "{name} {i}: {} {want}", got[i]);
        }
    }
    assert!(compared * 4 > got.len(), "{name}: {compared} of {}", got.len());
}

#[test]
fn gradients_are_those_of_the_loss() {
    let (_, d, tables) = run(&case());
    check("values", case, |c| &mut c.values, &d.values, 3e-3);
    check("lights", case, |c| &mut c.lights, &tables.lights, 3e-3);
    check("gains", case, |c| &mut c.gains, &tables.gains, 3e-3);
}

#[test]
fn gradients_with_suns_apart_are_those_of_the_loss() {
    let (_, d, tables) = run(&sunlit_case());
    check("values", sunlit_case, |c| &mut c.values, &d.values, 3e-3);
    check("lights", sunlit_case, |c| &mut c.lights, &tables.lights, 3e-3);
    // What surfaces send of a changed light does not follow at once, and suns stand where they are.
    assert!(tables.suns.chunks_exact(6).all(|s| s[..3] == [0.0; 3] && s[3..].iter().all(|d| *d != 0.0)));
    for (i, got) in tables.suns.iter().enumerate().filter(|(i, _)| i % 6 > 2) {
        let at = |by: f32| {
            let mut c = sunlit_case();
            c.suns[i] += by;
            run(&c).0
        };
        let want = (at(3e-3) - at(-3e-3)) / 6e-3;
        assert!((*got as f64 - want).abs() < 0.02 * want.abs() + 1e-3, "sun {i}: {got} {want}");
    }
}

fn bent_case() -> Case {
    let mut c = Case { bends: true, ..sunlit_case() };
    // Even skies: of others, the light from a few directions changes by leaps as the normal turns.
    c.lights.chunks_exact_mut(LIGHT).for_each(|l| l[3..].fill(0.0));
    // What the head says is lit by the suns, and short enough for its direction to change.
    c.values.chunks_exact_mut(SUNLIT_CHANNELS).enumerate().for_each(|(r, v)| {
        v[NORMAL..NORMAL + 3].copy_from_slice(&[0.5 - 0.1 * r as f32, -0.3, 0.7]);
    });
    c
}

#[test]
fn gradients_of_bent_normals_are_those_of_the_loss() {
    let (_, d, _) = run(&bent_case());
    check("values", bent_case, |c| &mut c.values, &d.values, 1e-3);
    let normals = |d: &RayGradients| d.values.chunks_exact(SUNLIT_CHANNELS).flat_map(|v| v[NORMAL..LEFT].to_vec()).collect::<Vec<f32>>();
    let stiff = run(&Case { bends: false, ..bent_case() }).1;
    assert!(normals(&d).iter().zip(normals(&stiff)).filter(|(a, b)| (**a - b).abs() > 1e-3).count() > RAYS, "colors do not bend normals");
}

/// Below a ceiling, which the traced rays meet.
#[test]
fn the_field_says_where_suns_of_training_arrive_and_tracing_where_others_do() {
    let (sun, dir, mut values) = ([0.6, 0.0, 0.8, 1.0, 1.0, 1.0], [0.0, 0.0, -1.0], [0.0; SUNLIT_CHANNELS]);
    values[..3].fill(1.0);
    (values[3], values[NORMAL + 2], values[LEFT]) = (0.7, 1.0, 0.5);
    let shade = |visibility: &Visibility, is_learned: bool| {
        let ambient = ambient(&[0.0; LIGHT], &[0.0; 3]);
        let sunlit = sunlit((visibility, &ambient), (&sun[..], is_learned), (8, 0), &values[NORMAL..], (1.0, 0.0), (&[0.5; 3], &dir));
        color(&values, 1.0, &dir, &[0.0; LIGHT], &[0.0; SKY], Some(sunlit)).rgb[0]
    };
    let some = ARRIVES[0] + 0.5 * ARRIVES[1];
    assert!(some > 0.5 && ARRIVES[0] + ARRIVES[1] <= 1.0, "less than the field says would be taken");
    for (visibility, is_learned, want) in [(&*HALF, true, 0.7), (&*EMPTY, true, 0.7), (&*HALF, false, 0.0), (&*EMPTY, false, some)] {
        let got = shade(visibility, is_learned);
        assert!((got - 0.8 * want).abs() < 0.01, "{is_learned}: {got} {want}");
    }
}

#[test]
fn what_is_left_of_any_sun_is_taught_by_those_of_training_where_rays_pass() {
    let values = |d: &RayGradients, k: usize| d.values.chunks_exact(SUNLIT_CHANNELS).map(|v| v[k]).collect::<Vec<f32>>();
    let (c, without) = (sunlit_case(), run(&sunlit_case()).1);
    assert!(c.opacity.iter().any(|o| *o > 0.5));
    for (visibility, most) in [(&*EMPTY, 1.0), (&*HALF, 0.5)] {
        let (d, untaught) = (run_with(&c, 0.3, visibility).1, run_with(&c, 0.0, visibility).1);
        for (r, v) in c.values.chunks_exact(SUNLIT_CHANNELS).enumerate() {
            let (normal, sun) = (Vec3::from_slice(&c.normals[3 * r..]).normalize(), &c.suns[6 * LIGHTS[r] as usize..]);
            let passes = visibility.from_sun(Vec3::splat(0.5), normal, Vec3::from_slice(sun));
            assert!(passes <= most);
            let passes = if c.opacity[r] > 0.5 { passes } else { 0.0 };
            // The square counts up to a tenth, the difference beyond; too little counts 7 : 3 of too much.
            let off = v[LEFT] - v[3];
            let want = 2.0 * 0.3 * passes * off.clamp(-0.1, 0.1) * if off < 0.0 { 1.4 } else { 0.6 } / RAYS as f32;
            let got = values(&d, LEFT)[r] - values(&untaught, LEFT)[r];
            assert!((got - want).abs() < 1e-3, "{r}: {got} {want}");
            let alone = 2.0 * 0.2 * (v[LEFT] - 1.0) / RAYS as f32;
            assert!((values(&untaught, LEFT)[r] - alone).abs() < 1e-5, "without suns, all is left");
        }
    }
    assert_eq!(values(&run_with(&c, 0.3, &EMPTY).1, 3), values(&without, 3), "it teaches what it is taught by");
    let near = |c: &Case, visibility: &Visibility| values(&run_with(c, 0.0, visibility).1, 3);
    let nothing = |c: Case| Case { target: vec![1.0; 3 * RAYS], gains: vec![3.0; 3 * RAYS], ..c };
    // Of colors that say nothing, the traced shadow remains.
    let bright = nothing(sunlit_case());
    assert!(
        near(&bright, &EMPTY).iter().any(|d| *d < 0.0)
            && near(&bright, &EMPTY).iter().all(|d| *d <= 0.0)
            && near(&bright, &HALF).iter().any(|d| *d > 0.0)
    );
}

#[test]
fn what_is_brighter_than_white_is_not_pulled_down() {
    let mut c = case();
    c.target.fill(1.0);
    c.gains.fill(3.0);
    c.values.chunks_exact_mut(CHANNELS).for_each(|v| v[..3].fill(0.9));
    c.opacity.fill(1.0);
    c.lights.fill(0.0);
    c.lights.chunks_exact_mut(LIGHT).for_each(|l| l[..3].fill(4.0));
    let of_color = |c: &Case| run(c).1.values.chunks_exact(CHANNELS).flat_map(|v| v[..3].to_vec()).collect::<Vec<f32>>();
    assert_eq!(run(&c).2.mse, 0.0);
    assert!(of_color(&c).iter().all(|d| *d == 0.0));
    c.target.fill(0.98);
    assert!(of_color(&c).iter().filter(|d| **d > 0.0).count() == 12, "of the four rays that count");
}

#[test]
fn the_light_of_a_perfect_explanation_has_no_loss() {
    let mut c = case();
    c.normals.fill(0.0);
    for r in 0..RAYS {
        let l = LIGHTS[r] as usize;
        let (light, sky) = (&c.lights[l * LIGHT..][..LIGHT], &c.skies[l * SKY..][..SKY]);
        let rgb = color(&c.values[r * CHANNELS..][..CHANNELS], c.opacity[r], &c.dirs[3 * r..3 * r + 3], light, sky, None).rgb;
        (0..3).for_each(|k| c.target[3 * r + k] = encode(rgb[k] * c.gains[3 * r + k].exp()).0);
    }
    let tables = run(&c).2;
    assert!(tables.mse < 1e-10 && tables.median < 1e-5, "{tables:?}");
}

/// The loss of a case's colors, with weights of robustness and of the Retinex prior, and its gradient.
fn plain(c: &Case, robust: f32, retinex: f32) -> (f64, Vec<f32>) {
    let loss = SceneLoss {
        weights: Weights { huber: 1.0, robust, shadow: 0.0, traced: 0.0, negative: 0.0, gauge: 0.0, tie: 0.0, retinex },
        target: &c.target,
        counts: &[1.0; RAYS],
        normals: &c.normals,
        dirs: &c.dirs,
        light: &[0; RAYS],
        image: &[0; RAYS],
        lights: &c.lights,
        skies: &c.skies,
        gains: &[],
        suns: None,
        bends: false,
        traced: None,
        out: Mutex::default(),
    };
    let mut d = RayGradients::default();
    d.clear(RAYS, CHANNELS);
    let value = loss.batch(&RayOutputs { values: &c.values, opacity: &c.opacity, depth: &[0.0; RAYS] }, &mut d);
    (value, d.values)
}

#[test]
fn pixels_that_fit_badly_count_less() {
    let with = |robust: f32| plain(&case(), robust, 0.0).0;
    assert!(with(0.05) < 0.2 * with(0.0), "{} {}", with(0.05), with(0.0));
}

#[test]
fn albedo_of_pairs_that_look_alike_is_drawn_together() {
    let mut c = case();
    c.opacity.fill(1.0);
    // The first pair looks alike, the second does not.
    c.target = vec![0.5; 3 * RAYS];
    c.target[3 * 3] = 0.6;
    let [with, without] = [0.7, 0.0].map(|retinex| plain(&c, 0.0, retinex));
    let albedo = |r: usize, k: usize| c.values[r * CHANNELS + k];
    let squares: f32 = (0..3).map(|k| (albedo(0, k) - albedo(1, k)).powi(2)).sum();
    assert!(squares > 0.01 && (with.0 - without.0 - (0.7 * squares / RAYS as f32) as f64).abs() < 1e-5);
    for (i, (a, b)) in with.1.iter().zip(&without.1).enumerate() {
        let (r, k) = (i / CHANNELS, i % CHANNELS);
        let want = if r < 2 && k < 3 { 2.0 * 0.7 / RAYS as f32 * (albedo(r, k) - albedo(1 - r, k)) } else { 0.0 };
        assert!((a - b - want).abs() < 1e-5, "ray {r}, channel {k}: {} {want}", a - b);
    }
}
