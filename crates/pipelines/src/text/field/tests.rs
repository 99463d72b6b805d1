use super::config::{Config, Preset, Stage};
use super::label_maps::{self, UNKNOWN};
use super::losses::{LabelLoss, SceneLoss};
use super::scores::{self, Overlap};
use crate::run::config::{self, Configuration};
use diorama_engine::renderers::view::View;
use diorama_geom::glam::{DMat3, DVec3};
use diorama_geom::{Camera, Pose};
use diorama_kernels::ops::field_step::{BatchLoss, RayGradients, RayOutputs};
use diorama_kernels::ops::ray_generation::PosedCamera;
use diorama_kernels::ops::s3im::{self, Tile};
use diorama_testkit::random;
use std::sync::Mutex;

/// Compares a loss's gradients of colors and opacities with differences.
fn check_gradients(loss: &dyn BatchLoss, channels: usize, values: &[f32], opacity: &[f32], at: &[usize]) {
    let depth = vec![0.0; opacity.len()];
    let of = |values: &[f32], opacity: &[f32]| {
        let mut g = RayGradients::default();
        g.clear(opacity.len(), channels);
        (loss.batch(&RayOutputs { values, opacity, depth: &depth }, &mut g), g)
    };
    let (_, g) = of(values, opacity);
    let step = 1e-3f32;
    let moved =
        |v: &[f32], i: usize, by: f32| -> Vec<f32> { v.iter().enumerate().map(|(k, v)| if k == i { v + by } else { *v }).collect() };
    for i in at {
        let d = of(&moved(values, *i, step), opacity).0 - of(&moved(values, *i, -step), opacity).0;
        let numeric = d / (2.0 * step as f64);
        assert!((numeric - g.values[*i] as f64).abs() < 1e-3 * numeric.abs() + 2e-5, "value {i}: {numeric} {}", g.values[*i]);
        let r = i / channels;
        let d = of(values, &moved(opacity, r, step)).0 - of(values, &moved(opacity, r, -step)).0;
        let numeric = d / (2.0 * step as f64);
        assert!((numeric - g.opacity[r] as f64).abs() < 1e-3 * numeric.abs() + 2e-5, "opacity {r}: {numeric} {}", g.opacity[r]);
    }
}

#[test]
fn the_losses_have_the_gradients_of_their_values() {
    let rays = 64;
    let unit = |n, stream| -> Vec<f32> { random(n, stream).iter().map(|v| 0.1 + 0.4 * (v + 1.0)).collect() };
    let (values, target, opacity) = (unit(3 * rays, 1), unit(3 * rays, 2), unit(rays, 3));
    let counts: Vec<bool> = (0..rays).map(|r| r % 9 != 4).collect();
    let arrangements = s3im::arrangements(rays, 3, &diorama_geom::rng::Rng::new(1, 1), 0);
    let loss = SceneLoss {
        target: &target,
        counts: &counts,
        tile: Tile { height: 8, width: 8 },
        arrangements: &arrangements,
        s3im: 1.0,
        distortion: 0.0,
        opacity: 0.1,
        distance: &[],
        depth: 0.0,
        empty: 0.0,
        mse: Mutex::default(),
    };
    check_gradients(&loss, 3, &values, &opacity, &[0, 14, 77, 191]);
    // Rays after them lead through what is empty.
    let (more, light) = (unit(3 * rays + 12, 1), unit(rays + 4, 3));
    let empty = SceneLoss { empty: 0.3, mse: Mutex::default(), ..loss };
    check_gradients(&empty, 3, &more, &light, &[14, 3 * rays, 3 * rays + 9]);
    // A pixel that does not count has no say.
    let mut g = RayGradients::default();
    g.clear(rays, 3);
    loss.batch(&RayOutputs { values: &values, opacity: &opacity, depth: &vec![0.0; rays] }, &mut g);
    assert!(g.values[12..15].iter().all(|v| *v == 0.0) && g.opacity[4] == 0.0 && g.values[9] != 0.0);
    let labels: Vec<(u8, f32)> = (0..rays).map(|r| ((r % 4) as u8, 1.0 / rays as f32)).collect();
    let shares = unit(4 * rays, 5);
    check_gradients(&LabelLoss { classes: 4, labels: &labels }, 4, &shares, &opacity, &[0, 5, 10, 200]);
}

#[test]
fn presets_are_sound_and_wrong_values_are_refused() {
    for preset in [Preset::Ci, Preset::Fast, Preset::Gpu] {
        Config::new(preset, "d".into()).check().unwrap();
    }
    let c = Config::template();
    for (key, value) in
        [("sampling.rays", "1000"), ("labels.width", "20"), ("loss.s3im", "-1"), ("field.space", "cube"), ("labels.share", "1")]
    {
        let e = config::set(&mut c.clone(), key, value).unwrap_err();
        assert!(e.is_input() && e.to_string().contains(key.split('.').next().unwrap()), "{e}");
    }
    assert_eq!(Config::new(Preset::Ci, "d".into()).stage(0.5), (Stage::Scene, 0.5 / 0.75));
}

#[test]
fn the_overlap_is_the_mean_of_the_text_classes_that_occur() {
    let mut o = Overlap::new(4);
    o.add(&[0, 1, 1, 2, 2, 0], &[0, 1, 0, 2, UNKNOWN, 2]);
    // Class 1: 1 of 2; class 2: 1 of 2; class 3 occurs nowhere.
    assert_eq!(o.mean(), Some(0.5));
    assert_eq!(Overlap::new(3).mean(), None);
    assert_eq!(scores::classes(&[0.1, 0.7, 0.2, 0.5, 0.1, 0.4], 3), [1, 0]);
}

/// A camera at `x` that looks at the plane z = 2 along z, and its exact view.
fn before_a_plane(x: f64) -> (PosedCamera, View) {
    let camera = Camera::pinhole(40, 30, 1.0);
    let pose = Pose { rotation: DMat3::IDENTITY, translation: DVec3::new(x, 0.0, 0.0) };
    let mut view = View::empty(40, 30);
    for i in 0..1200 {
        let d = camera.direction((i % 40) as f64 + 0.5, (i / 40) as f64 + 0.5).normalize();
        (view.depth.data[i], view.opacity.data[i]) = ((2.0 / d.z) as f32, 1.0);
    }
    (PosedCamera { camera, pose }, view)
}

#[test]
fn depth_carries_labels_to_what_shows_the_same_surface_and_to_nothing_else() {
    let (first, second) = (before_a_plane(0.0), before_a_plane(0.3));
    let world = |p: &PosedCamera, i: usize| {
        let d = p.camera.direction((i % 40) as f64 + 0.5, (i / 40) as f64 + 0.5);
        p.pose.translation.x + 2.0 * d.x / d.z
    };
    // The left half of the plane is a region.
    let map: Vec<u8> = (0..1200).map(|i| if world(&first.0, i) < 0.0 { 1 } else { 0 }).collect();
    let mut second_view = second.1;
    // A thing before the plane, and a hole.
    second_view.depth.data[15 * 40 + 12] = 1.0;
    second_view.opacity.data[15 * 40 + 30] = 0.5;
    let got = label_maps::proxies(&[first.0, second.0], &[first.1, second_view], &[Some(map), None], 2);
    assert!(got[0].iter().all(|c| *c == UNKNOWN), "what is labelled needs no proxies");
    let half_a_pixel = 0.5 * 2.0 / first.0.camera.fx;
    for (i, class) in got[1].iter().enumerate() {
        let x = world(&second.0, i);
        let edge = 2.0 * (0.5f64).tan();
        match i {
            _ if i == 15 * 40 + 12 || i == 15 * 40 + 30 => assert_eq!(*class, UNKNOWN, "{i}"),
            _ if x > edge + half_a_pixel => assert_eq!(*class, UNKNOWN, "{i}: beyond the first photograph"),
            _ if x < edge - half_a_pixel && x.abs() > 1.1 * half_a_pixel => assert_eq!(*class, (x < 0.0) as u8, "{i}"),
            _ => {}
        }
    }
    assert!(got[1].contains(&0) && got[1].contains(&1));
}
