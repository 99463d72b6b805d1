use super::*;
use crate::ops::composite::Composited;
use crate::ops::field_step::{RayGradient, RayLoss, RayOutput};
use diorama_testkit::{assert_close, assert_gradient};

const LOSSES: [ColorLoss; 3] = [ColorLoss::Mse, ColorLoss::Huber(0.1), ColorLoss::Huber(2.0)];
const DIFFERENCES: [f32; 6] = [-0.7, -0.05, 0.0, 0.03, 0.4, 3.0];

#[test]
fn differences_match_the_reference_both_ways() {
    for loss in LOSSES {
        let (values, slopes): (Vec<f32>, Vec<f32>) = DIFFERENCES.iter().map(|d| cpu::color_error(loss, *d)).unzip();
        assert_close("value", &values, &DIFFERENCES.map(|d| reference::color_loss(loss, d as f64)), 1e-6);
        assert_close("slope", &slopes, &DIFFERENCES.map(|d| reference::color_slope(loss, d as f64)), 1e-6);
    }
}

#[test]
fn rays_match_the_reference_both_ways() {
    for case in cases::cases() {
        let (want, loss, p) = (case.want(), case.loss(), case.scene.packed());
        let narrow = |v: &[f64]| v.iter().map(|v| *v as f32).collect::<Vec<f32>>();
        let (color, opacity, weights) = (narrow(&want.out.color), narrow(&want.out.opacity), narrow(&want.out.weights));
        let (mut values, mut errors, mut d_opacity) = (Vec::new(), Vec::new(), Vec::new());
        let (mut d_color, mut d_weights) = (vec![0.0; color.len()], vec![0.0; weights.len()]);
        for r in 0..case.counts.len() {
            let (span, values_of_ray) = (p.range(r), &color[r * 3..r * 3 + 3]);
            let out =
                RayOutput { values: values_of_ray, opacity: opacity[r], depth: 0.0, weights: &weights[span.clone()], first: span.start };
            let mut g =
                RayGradient { values: &mut d_color[r * 3..r * 3 + 3], opacity: 0.0, depth: 0.0, weights: &mut d_weights[span] };
            values.push(loss.ray(r, &out, &mut g) as f32 * case.counts.len() as f32);
            d_opacity.push(g.opacity);
            let rgb = std::array::from_fn(|k| color[r * 3 + k]);
            let error = squared_error(rgb, loss.targets.color(r), case.measure.relative > 0.0);
            errors.push(if case.counts[r] { error } else { 0.0 });
        }
        assert_close("loss", &values, &want.values, 1e-4);
        assert_close("squared error", &errors, &want.errors, 1e-4);
        assert_close("d color", &d_color, &want.d.color, 1e-4);
        assert_close("d opacity", &d_opacity, &want.d.opacity, 1e-4);
        assert_close("d weights", &d_weights, &want.d.weights, 1e-4);
    }
}

#[test]
fn reference_gradients_match_central_differences() {
    for loss in LOSSES {
        let d = DIFFERENCES.map(f64::from);
        let slopes = d.map(|d| reference::color_slope(loss, d));
        assert_gradient("d", &slopes, &d, 1e-6, |d| d.iter().map(|d| reference::color_loss(loss, *d)).sum());
    }
    for mut case in cases::cases() {
        let rays = case.counts.len().min(6);
        // Few rays: every number of theirs is moved.
        case.scene = crate::ops::composite::cases::scene(rays, 3);
        (case.rgb.truncate(case.scene.t.len() * 3), case.counts.truncate(rays), case.distance.truncate(rays));
        let (want, l) = (case.want(), case.loss());
        let mean = |out: &Composited<f64>| reference::forward(&l, out, &want.out.color).0.iter().sum::<f64>() / rays.max(1) as f64;
        let moved = |set: &dyn Fn(&mut Composited<f64>)| {
            let mut out = want.out.clone();
            set(&mut out);
            mean(&out)
        };
        assert_gradient("d color", &want.d.color, &want.out.color, 1e-5, |x| moved(&|out| out.color = x.to_vec()));
        assert_gradient("d opacity", &want.d.opacity, &want.out.opacity, 1e-5, |x| moved(&|out| out.opacity = x.to_vec()));
        assert_gradient("d weights", &want.d.weights, &want.out.weights, 1e-5, |x| moved(&|out| out.weights = x.to_vec()));
    }
}

/// Loss of one ray, and the gradient of its red.
fn of_ray(l: &Photometric, r: usize, rgb: [f32; 3], opacity: f32, weights: &[f32]) -> (f64, f32) {
    let (mut d_weights, mut d) = (vec![0.0; weights.len()], [0.0; 3]);
    let out = RayOutput { values: &rgb, opacity, depth: 1.0, weights, first: l.samples.range(r).start };
    let loss = l.ray(r, &out, &mut RayGradient { values: &mut d, opacity: 0.0, depth: 0.0, weights: &mut d_weights });
    (loss, d[0])
}

#[test]
fn relative_differences_count_alike_in_shadow_and_in_light() {
    let rgba = [0.02, 0.02, 0.02, 1.0, 40.0, 40.0, 40.0, 1.0];
    let targets = Targets { rgba: &rgba, background: &[1.0; 6], counts: &[true; 2], distance: &[0.0; 2] };
    let samples = Packed { offsets: &[0, 1, 2], t: &[0.0, 1.0], dt: &[0.5, 0.5] };
    for color in [ColorLoss::Mse, ColorLoss::Huber(0.1)] {
        let terms = Terms { color, distortion: 0.0, depth: 0.0, alpha: 0.0 };
        let l = Photometric::new(terms, Measure { relative: 1e-6, normalized: false }, targets, samples);
        let run = |r: usize, v: f32| of_ray(&l, r, [v; 3], 1.0, &[1.0]);
        let ((dark, d_dark), (light, d_light)) = (run(0, 0.022), run(1, 44.0));
        assert!((dark - light).abs() < 1e-3 * light, "{dark} {light}");
        // A step in proportion to the value.
        assert!((d_dark * 0.022 - d_light * 44.0).abs() < 1e-3 * d_light * 44.0 && d_light > 0.0);
    }
}

#[test]
fn each_term_changes_the_loss_and_masked_rays_do_not_count() {
    let samples = Packed { offsets: &[0, 2], t: &[0.0, 1.0], dt: &[0.5, 0.5] };
    let run = |counts: bool, distance: f32, terms: Terms| {
        let targets =
            Targets { rgba: &[0.2, 0.4, 0.6, 0.5], background: &[1.0; 3], counts: &[counts], distance: &[distance] };
        of_ray(&Photometric::new(terms, Measure::default(), targets, samples), 0, [0.5; 3], 0.9, &[0.4, 0.5]).0
    };
    let none = Terms { color: ColorLoss::Mse, distortion: 0.0, depth: 0.0, alpha: 0.0 };
    let base = run(true, 0.0, none);
    assert!(run(true, 0.0, Terms { distortion: 0.1, ..none }) > base && run(true, 0.0, Terms { alpha: 0.1, ..none }) > base);
    assert_ne!(run(true, 0.0, Terms { color: ColorLoss::Huber(0.1), ..none }), base);
    assert_eq!(run(true, 0.0, Terms { depth: 0.1, ..none }), base, "no surface is known");
    assert!(run(true, 9.0, Terms { depth: 0.1, ..none }) > base, "all light ends before the surface");
    assert_eq!(run(false, 9.0, Terms { distortion: 0.1, depth: 0.1, alpha: 0.1, ..none }), 0.0);
}
