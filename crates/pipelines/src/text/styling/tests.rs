use super::haar::{Haar, LOW_GAIN};
use super::mask::dilated;
use super::{MaskMode, Moments, Preset, Transfer, blend, importance, protection};
use diorama_geom::Image;
use diorama_geom::rng::Rng;

/// A picture of smooth color, edges and texture.
fn picture(width: usize, height: usize, seed: u64) -> Image {
    let rng = Rng::new(seed, 1);
    let phase = 6.0 * rng.uniform(0);
    let color = |i: usize| {
        let (x, y) = ((i % width) as f32 / 40.0, (i / width) as f32 / 40.0);
        let edge = if (x + 0.6 * y + phase) % 1.5 < 0.7 { 0.25 } else { 0.0 };
        let noise = |k: u64| 0.04 * rng.normal(4 * i as u64 + k);
        let common = noise(0);
        [
            0.3 + 0.1 * (x + phase).sin() + edge + common + 0.5 * noise(1),
            0.35 + 0.15 * (0.7 * y).cos() + 0.6 * edge + common + 0.5 * noise(2),
            0.45 - 0.1 * (x - y).sin() - 0.3 * edge + common + 0.5 * noise(3),
        ]
    };
    Image { width, height, channels: 3, data: (0..width * height).flat_map(color).collect() }
}

fn energy(image: &Image) -> f64 {
    image.data.iter().map(|v| (*v as f64).powi(2)).sum()
}

fn largest_difference(a: &Image, b: &Image) -> f32 {
    a.data.iter().zip(&b.data).map(|(x, y)| (x - y).abs()).fold(0.0, f32::max)
}

fn psnr(a: &Image, b: &Image) -> f64 {
    let squares: f64 = a.data.iter().zip(&b.data).map(|(x, y)| ((x - y) as f64).powi(2)).sum();
    -10.0 * (squares / a.data.len() as f64).max(1e-30).log10()
}

/// Mean and covariance of pixels.
fn colors(image: &Image) -> (nalgebra::Vector3<f64>, nalgebra::Matrix3<f64>) {
    let pixels: Vec<nalgebra::Vector3<f64>> =
        image.data.chunks(3).map(|c| nalgebra::Vector3::new(c[0] as f64, c[1] as f64, c[2] as f64)).collect();
    let n = pixels.len() as f64;
    let mean = pixels.iter().sum::<nalgebra::Vector3<f64>>() / n;
    (mean, pixels.iter().map(|p| (p - mean) * (p - mean).transpose()).sum::<nalgebra::Matrix3<f64>>() / n)
}

#[test]
fn the_transform_is_undone_for_any_size() {
    for (width, height) in [(1, 1), (2, 3), (8, 8), (37, 21), (64, 40), (5, 100), (9, 16)] {
        let image = picture(width, height, 1);
        let back = Haar::of(&image).inverse();
        assert_eq!((back.width, back.height), (width, height));
        assert!(largest_difference(&image, &back) < 1e-5, "{width}x{height}");
    }
}

#[test]
fn the_transform_keeps_energy_and_the_mean() {
    let image = picture(64, 40, 2);
    let haar = Haar::of(&image);
    let total = energy(&haar.low) + haar.details.iter().map(energy).sum::<f64>();
    assert!((total / energy(&image) - 1.0).abs() < 1e-5);
    let flat = Image { width: 13, height: 9, channels: 3, data: vec![0.5; 13 * 9 * 3] };
    let haar = Haar::of(&flat);
    assert!(haar.low.data.iter().all(|v| (*v as f64 - 0.5 * LOW_GAIN).abs() < 1e-5));
    assert!(haar.details.iter().all(|d| d.data.iter().all(|v| v.abs() < 1e-6)));
}

#[test]
fn a_scenes_own_style_changes_nothing() {
    let images: Vec<Image> = (0..3).map(|s| picture(90, 61, s)).collect();
    let own = Moments::of(&images).unwrap();
    let transfer = Transfer::new(&own, &own);
    for image in &images {
        assert!(psnr(&transfer.stylized(image), image) > 45.0, "{}", psnr(&transfer.stylized(image), image));
        assert!(psnr(&transfer.recolored(image), image) > 45.0);
        assert!(largest_difference(&transfer.stylized(image), image) < 1e-4);
    }
}

#[test]
fn results_have_the_moments_of_the_style() {
    let image = picture(160, 96, 3);
    let mut style_image = picture(128, 120, 4);
    style_image.data.chunks_mut(3).for_each(|c| c.copy_from_slice(&[0.9 * c[0] + 0.1 * c[1], 0.3 * c[1] + 0.2 * c[2], 0.1 + 0.4 * c[2]]));
    let (content, style) = (Moments::of(std::slice::from_ref(&image)).unwrap(), Moments::of(&[style_image.clone()]).unwrap());
    let transfer = Transfer::new(&content, &style);
    let found = Moments::of(&[transfer.stylized(&image)]).unwrap();
    assert!((found.mean - style.mean).amax() < 1e-5);
    assert!((found.low - style.low).amax() < 1e-5, "{} {}", found.low, style.low);
    let (mean, covariance) = colors(&transfer.recolored(&image));
    let (style_mean, style_covariance) = colors(&style_image);
    assert!((mean - style_mean).amax() < 1e-5);
    assert!((covariance - style_covariance).amax() < 1e-5, "{covariance} {style_covariance}");
}

#[test]
fn bands_add_up_to_the_covariance_of_pixels() {
    let image = picture(64, 40, 5);
    let moments = Moments::of(std::slice::from_ref(&image)).unwrap();
    let (mean, covariance) = colors(&image);
    assert!((moments.mean - mean).amax() < 1e-6);
    assert!((moments.colors() - covariance).amax() < 1e-6);
}

#[test]
fn moments_of_several_images_are_pooled_and_repeat() {
    let (a, b) = (picture(64, 40, 6), picture(64, 24, 7));
    let mut stacked = a.clone();
    stacked.data.extend(&b.data);
    stacked.height += b.height;
    let (pooled, whole) = (Moments::of(&[a.clone(), b.clone()]).unwrap(), Moments::of(&[stacked]).unwrap());
    assert!((pooled.low - whole.low).amax() < 1e-9 && (pooled.mean - whole.mean).amax() < 1e-9);
    assert!((0..3).all(|l| (pooled.details[l] - whole.details[l]).amax() < 1e-9));
    let with_threads = |n: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(n).build().unwrap();
        let transfer = || Transfer::new(&Moments::of(&[a.clone(), b.clone()]).unwrap(), &Preset::Autumn.moments());
        pool.install(|| (transfer(), transfer().stylized(&a)))
    };
    assert_eq!(with_threads(1), with_threads(3));
    assert_eq!(Moments::of(&[]), None);
}

#[test]
fn flat_and_gray_scenes_stay_finite_and_noise_is_not_amplified() {
    let flat = Image { width: 32, height: 32, channels: 3, data: vec![0.4; 32 * 32 * 3] };
    let mut gray = picture(32, 32, 8);
    gray.data.chunks_mut(3).for_each(|c| c.copy_from_slice(&[c[0]; 3]));
    let mut grain = flat.clone();
    let rng = Rng::new(0, 0);
    grain.data.iter_mut().enumerate().for_each(|(i, v)| *v += 0.001 * rng.normal(i as u64));
    for image in [&flat, &gray, &grain] {
        for preset in Preset::ALL {
            let transfer = Transfer::new(&Moments::of(std::slice::from_ref(image)).unwrap(), &preset.moments());
            let out = transfer.stylized(image);
            assert!(out.data.iter().all(|v| v.is_finite() && v.abs() < 3.0));
        }
    }
    let transfer = Transfer::new(&Moments::of(std::slice::from_ref(&grain)).unwrap(), &Preset::Winter.moments());
    let (_, covariance) = colors(&transfer.stylized(&grain));
    assert!(covariance.diagonal().amax().sqrt() < 0.005, "{covariance}");
}

#[test]
fn presets_are_named_valid_and_different() {
    for preset in Preset::ALL {
        assert_eq!(Preset::named(preset.name()), Some(preset));
        let moments = preset.moments();
        assert!(moments.low.symmetric_eigenvalues().min() > 0.0);
        assert!(moments.details.iter().all(|d| d.symmetric_eigenvalues().min() > 0.0));
        assert!(moments.mean.iter().all(|m| (0.05..0.95).contains(m)), "{}", moments.mean);
        let image = picture(96, 64, 9);
        let transfer = Transfer::new(&Moments::of(std::slice::from_ref(&image)).unwrap(), &moments);
        assert!((colors(&transfer.stylized(&image)).0 - moments.mean).amax() < 1e-4);
    }
    assert_eq!(Preset::named("spring"), None);
    let [autumn, winter, night, rain, evening] = Preset::ALL.map(|p| p.moments().mean);
    assert!(night.mean() < 0.5 * rain.mean() && winter.mean() > rain.mean());
    assert!(autumn[0] > 1.5 * autumn[2] && evening[0] > 1.3 * evening[2] && night[2] > night[0]);
}

#[test]
fn rare_places_are_important() {
    let (width, height) = (200, 100);
    let counts: Vec<u16> = (0..width * height).map(|i| if i % width < 60 { 1 } else { 16 }).collect();
    let found = importance(&counts, width, height);
    assert!(found.pixel(20, 50)[0] > 0.99 && found.pixel(150, 50)[0] < 0.01);
    let edge = found.pixel(60, 50)[0];
    assert!((0.2..0.8).contains(&edge), "{edge}");
    assert!(importance(&vec![7; width * height], width, height).data.iter().all(|v| *v == 0.0));
    assert!(importance(&[], 0, 0).data.is_empty());
}

#[test]
fn text_is_protected_with_a_margin() {
    let (width, height) = (60, 40);
    let text: Vec<f32> = (0..width * height).map(|i| if (20..40).contains(&(i % width)) && i / width == 20 { 0.9 } else { 0.0 }).collect();
    let text = Image { width, height, channels: 1, data: text };
    let wide = dilated(&text, 4);
    assert!(wide.data.iter().zip(&text.data).all(|(w, t)| w >= t));
    assert!(wide.pixel(30, 23)[0] > 0.5 && wide.pixel(30, 32)[0] < 0.01);
    assert_eq!(dilated(&text, 0), text);
    let rare = Image { width, height, channels: 1, data: (0..width * height).map(|i| if i % width < 10 { 0.7 } else { 0.0 }).collect() };
    let ours = protection(&rare, &text, 4, MaskMode::Text);
    assert_eq!([ours.pixel(3, 3)[0], ours.pixel(30, 20)[0]], [0.7, 0.9]);
    assert_eq!(protection(&rare, &text, 4, MaskMode::Paper), rare);
    assert!(protection(&rare, &text, 4, MaskMode::Off).data.iter().all(|m| *m == 0.0));
}

#[test]
fn blending_mixes_by_the_mask_and_limits_values() {
    let constant = |v: f32| Image { width: 2, height: 1, channels: 3, data: vec![v; 6] };
    let mask = Image { width: 2, height: 1, channels: 1, data: vec![0.25, 1.0] };
    let mixed = |a: f32, b: f32| blend(&constant(a), &constant(b), &mask).data;
    let close = |found: Vec<f32>, want: [f32; 2]| found.iter().enumerate().all(|(i, v)| (v - want[i / 3]).abs() < 1e-6);
    assert!(close(mixed(0.8, 0.4), [0.7, 0.4]));
    assert!(close(mixed(-0.5, 1.7), [0.05, 1.0]));
}
