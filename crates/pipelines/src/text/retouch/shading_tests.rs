use super::{Shading, blur, edge_width, noise_level, with_noise};
use diorama_geom::Image;
use diorama_geom::rng::Rng;

const SIZE: [usize; 2] = [120, 50];

/// The log of a known shading at a position from −1 to 1, of mean 0 over the rectangle.
fn log_shading(k: usize, x: f64, y: f64) -> f64 {
    let [a, b, c] = [[0.5, -0.3, 0.2], [0.4, -0.2, 0.25], [0.1, 0.3, -0.4]][k];
    a * x + b * y + c * (x * x - 1.0 / 3.0) - 0.15 * x * y + 0.1 * (y * y - 1.0 / 3.0)
}

fn center(i: usize) -> [f64; 2] {
    [2.0 * ((i % SIZE[0]) as f64 + 0.5) / SIZE[0] as f64 - 1.0, 2.0 * ((i / SIZE[0]) as f64 + 0.5) / SIZE[1] as f64 - 1.0]
}

/// An image under the known shading, of an albedo per pixel.
fn shaded(albedo: impl Fn(usize) -> [f32; 3]) -> Image {
    let color = |i: usize| [0, 1, 2].map(|k| albedo(i)[k] * log_shading(k, center(i)[0], center(i)[1]).exp() as f32);
    Image { width: SIZE[0], height: SIZE[1], channels: 3, data: (0..SIZE[0] * SIZE[1]).flat_map(color).collect() }
}

/// Largest relative error of a fitted shading.
fn largest_error(shading: &Shading) -> f64 {
    let error = |i: usize| {
        let [x, y] = center(i);
        let found = shading.at(0.5 + 0.5 * x, 0.5 + 0.5 * y);
        (0..3).map(|k| (found[k] as f64 / log_shading(k, x, y).exp() - 1.0).abs()).fold(0.0, f64::max)
    };
    (0..SIZE[0] * SIZE[1]).map(error).fold(0.0, f64::max)
}

/// Writing in the middle.
fn glyphs() -> Vec<bool> {
    (0..SIZE[0] * SIZE[1]).map(|i| (12..38).contains(&(i / SIZE[0])) && i % SIZE[0] % 12 < 5).collect()
}

const GROUND: [f32; 3] = [0.7, 0.6, 0.2];
const INK: [f32; 3] = [0.05, 0.1, 0.3];

#[test]
fn shading_and_albedos_are_found_under_noise_and_outliers() {
    let rng = Rng::new(8, 0);
    let mask = glyphs();
    // One pixel in five belongs to neither.
    let albedo = |i: usize| {
        let stray = rng.uniform(2 * i as u64) < 0.2;
        let noise = 1.0 + 0.02 * rng.normal(1000 + i as u64);
        let base = if mask[i] { INK } else { GROUND };
        if stray { [0.02, 0.9, 0.9] } else { base.map(|b| b * noise) }
    };
    let image = shaded(albedo);
    let shading = Shading::fit(&image, &mask);
    assert!(largest_error(&shading) < 0.01, "{}", largest_error(&shading));
    let albedos = shading.albedos(&image, &mask);
    for k in 0..3 {
        assert!((albedos.ground_linear[k] / GROUND[k] - 1.0).abs() < 0.02, "{albedos:?}");
        assert!((albedos.ink_linear[k] / INK[k] - 1.0).abs() < 0.03, "{albedos:?}");
    }
}

#[test]
fn a_drawing_under_the_shading_is_the_image() {
    let mask = glyphs();
    let image = shaded(|i| if mask[i] { INK } else { GROUND });
    let shading = Shading::fit(&image, &mask);
    let ink: Vec<f32> = mask.iter().map(|m| *m as u8 as f32).collect();
    let drawn = shading.lit(&shading.albedos(&image, &mask).drawn(&ink, SIZE[0], SIZE[1]));
    for (a, b) in drawn.data.iter().zip(&image.data) {
        assert!((a - b).abs() < 1e-3 * b, "{a} {b}");
    }
    let flat = shading.unlit(&image);
    assert!(flat.pixel(60, 3).iter().zip(GROUND).all(|(a, g)| (a - g).abs() < 1e-3));
}

#[test]
fn too_few_pixels_and_black_images_give_finite_shading() {
    let image = shaded(|_| GROUND);
    let all = vec![true; SIZE[0] * SIZE[1]];
    assert_eq!(Shading::fit(&image, &all).at(0.2, 0.9), [1.0; 3]);
    // One row determines no slope down; that slope is 0.
    let row: Vec<bool> = (0..all.len()).map(|i| i / SIZE[0] != 20).collect();
    let shading = Shading::fit(&image, &row);
    assert!((shading.at(0.3, 0.0)[0] / shading.at(0.3, 1.0)[0]).ln().abs() < 1.0);
    let black = Image::zeros(SIZE[0], SIZE[1], 3);
    assert_eq!(Shading::fit(&black, &glyphs()).at(0.5, 0.5), [1.0; 3]);
    assert_eq!(Shading::fit(&black, &all).albedos(&black, &all).ground_linear, [0.0; 3]);
}

/// Slanted and straight edges, supersampled, blurred by a sigma, with noise; and their mask.
fn edges(sigma: f32, noise: f32) -> (Image, Vec<bool>) {
    let (width, height, fine) = (160, 60, 4);
    let is_ink = |x: f32, y: f32| (10.0..50.0).contains(&y) && ((x + 0.37 * y).rem_euclid(34.0) < 15.0 || (x + y) > 190.0);
    let (fw, fh) = (width * fine, height * fine);
    let value = |i: usize| if is_ink((i % fw) as f32 / fine as f32, (i / fw) as f32 / fine as f32) { 0.1 } else { 0.6 };
    let sharp = Image { width: fw, height: fh, channels: 1, data: (0..fw * fh).map(value).collect() };
    let image = with_noise(&blur(&sharp, sigma * fine as f32).downsampled(width, height), &[noise], 3);
    let mask = (0..width * height).map(|i| is_ink((i % width) as f32 + 0.5, (i / width) as f32 + 0.5)).collect();
    (image, mask)
}

#[test]
fn the_width_of_edges_is_measured() {
    for sigma in [0.8f32, 1.2, 2.0, 3.0] {
        let (image, mask) = edges(sigma, 0.004);
        let found = edge_width(&image, &mask).unwrap();
        // A pixel's own area adds a variance of 1/12.
        let expected = (sigma * sigma + 1.0 / 12.0).sqrt();
        assert!((found / expected - 1.0).abs() < 0.1, "{found} instead of {expected}");
    }
    let (image, mask) = edges(0.0, 0.004);
    assert!(edge_width(&image, &mask).unwrap() < 0.5);
    assert_eq!(edge_width(&image, &vec![false; mask.len()]), None);
}

#[test]
fn noise_is_measured_beside_edges_and_matched() {
    for level in [0.002f32, 0.01, 0.05] {
        let (image, mask) = edges(1.0, level);
        let found = noise_level(&image, &mask)[0];
        assert!((found / level - 1.0).abs() < 0.12, "{found} instead of {level}");
    }
    let flat = Image { width: 90, height: 80, channels: 3, data: vec![0.4; 90 * 80 * 3] };
    let noisy = with_noise(&flat, &[0.01, 0.02, 0.0], 5);
    let found = noise_level(&noisy, &vec![false; 90 * 80]);
    assert!((found[0] - 0.01).abs() < 5e-4 && (found[1] - 0.02).abs() < 1e-3 && found[2] < 1e-6, "{found:?}");
    assert_eq!(with_noise(&flat, &[0.01, 0.02, 0.0], 5), noisy);
    assert_ne!(with_noise(&flat, &[0.01, 0.02, 0.0], 6), noisy);
    assert_eq!(noise_level(&flat, &vec![true; 90 * 80]), [0.0; 3]);
}

#[test]
fn blur_keeps_the_mean_and_adds_its_variance() {
    let mut point = Image::zeros(41, 41, 1);
    point.data[20 * 41 + 20] = 1.0;
    let blurred = blur(&point, 2.0);
    let moment = |p: i32| -> f32 { (0..41 * 41).map(|i| blurred.data[i] * ((i % 41) as f32 - 20.0).powi(p)).sum() };
    assert!((moment(0) - 1.0).abs() < 1e-5 && (moment(2) - 4.0).abs() < 0.02, "{} {}", moment(0), moment(2));
    assert_eq!(blur(&point, 0.0), point);
}
