use super::*;
use crate::ops::path_trace::{Film, Pixel};
use diorama_testkit::random;

/// A floor of two albedos and a wall, lit by a smooth light, with noise of a standard deviation that 16 samples leave.
fn film(w: usize, h: usize, noise: f32) -> (Film, Vec<[f32; 3]>) {
    let values = random(3 * w * h, 5);
    let (mut pixels, mut exact) = (Vec::new(), Vec::new());
    for i in 0..w * h {
        let (x, y) = (i % w, i / w);
        let albedo = if x < w / 2 { [0.8, 0.2, 0.1] } else { [0.1, 0.3, 0.7] };
        let light = 1.0 + 0.5 * (x as f32 / w as f32) + if y < h / 2 { 0.7 } else { 0.0 };
        let color = albedo.map(|a| a * light);
        // Uniform in ±√3: of variance 1.
        let grain = 1.0 + noise * 3f32.sqrt() * values[3 * i];
        let luminance = |c: [f32; 3]| 0.2126 * c[0] + 0.7152 * c[1] + 0.0722 * c[2];
        let spread = 16.0 * (noise * luminance(color)).powi(2);
        let noisy = color.map(|c| c * grain);
        pixels.push(Pixel {
            color: noisy,
            albedo,
            normal: if y < h / 2 { [0.0, 1.0, 0.0] } else { [0.0, 0.0, 1.0] },
            depth: 3.0 + 0.01 * y as f32,
            opacity: 1.0,
            square: luminance(noisy).powi(2) + spread,
            ..Pixel::default()
        });
        exact.push(color);
    }
    (Film { width: w, height: h, samples: 16, pixels }, exact)
}

fn rms(a: impl Iterator<Item = [f32; 3]>, b: &[[f32; 3]]) -> f32 {
    let sum: f32 = a.zip(b).map(|(p, q)| (0..3).map(|k| (p[k] - q[k]).powi(2)).sum::<f32>()).sum();
    (sum / (3 * b.len()) as f32).sqrt()
}

#[test]
fn the_filter_matches_the_reference() {
    for (w, h) in [(33, 21), (1, 1), (7, 40)] {
        let (mut film, _) = film(w, h, 0.3);
        let want = reference::run(&film);
        cpu::run(&mut film);
        for (p, q) in film.pixels.iter().zip(want) {
            assert!((0..3).all(|k| (p.color[k] as f64 - q[k]).abs() < 1e-4), "{:?} {q:?}", p.color);
        }
    }
}

#[test]
fn noise_goes_and_edges_stay() {
    let (mut noisy, exact) = film(96, 64, 0.2);
    let before = rms(noisy.pixels.iter().map(|p| p.color), &exact);
    cpu::run(&mut noisy);
    let after = rms(noisy.pixels.iter().map(|p| p.color), &exact);
    assert!(after < 0.25 * before, "{before} {after}");
    // Next to the edges of albedo and of light, too.
    let at_edges = |i: usize| (46..50).contains(&(i % 96)) || (30..34).contains(&(i / 96));
    let edges: Vec<usize> = (0..96 * 64).filter(|i| at_edges(*i)).collect();
    let exact: Vec<[f32; 3]> = edges.iter().map(|i| exact[*i]).collect();
    let there = rms(edges.iter().map(|i| noisy.pixels[*i].color), &exact);
    assert!(there < 0.4 * before, "{before} {there}");
}

#[test]
fn exact_pictures_stay_as_they_are() {
    let (mut film, exact) = film(40, 40, 0.0);
    cpu::run(&mut film);
    let error = rms(film.pixels.iter().map(|p| p.color), &exact);
    assert!(error < 2e-4, "{error}");
}
