use super::patch_match::fill;
use super::{CannotFill, telea};
use diorama_geom::Image;

/// An image of a size from a function of its pixel centers.
fn image(width: usize, height: usize, color: impl Fn(f32, f32) -> [f32; 3]) -> Image {
    let at = |i: usize| color((i % width) as f32 + 0.5, (i / width) as f32 + 0.5);
    Image { width, height, channels: 3, data: (0..width * height).flat_map(at).collect() }
}

/// Strokes of letters, 9 px thick.
fn strokes(width: usize, height: usize) -> Vec<bool> {
    let is_stroke = |x: usize, y: usize| {
        let inside = x > 24 && x + 24 < width && y > 20 && y + 20 < height;
        inside && (x % 30 < 9 || (height / 2 - 4..height / 2 + 5).contains(&y))
    };
    (0..width * height).map(|i| is_stroke(i % width, i / width)).collect()
}

/// PSNR in the masked pixels for a peak of 1.
fn psnr(a: &Image, b: &Image, mask: &[bool]) -> f64 {
    let masked = |im: &Image| -> Vec<f64> {
        let pixels = im.data.chunks(3).zip(mask).filter(|(_, m)| **m);
        pixels.flat_map(|(c, _)| c.iter().map(|v| *v as f64).collect::<Vec<_>>()).collect()
    };
    let (a, b) = (masked(a), masked(b));
    let error = a.iter().zip(&b).map(|(x, y)| (x - y).powi(2)).sum::<f64>() / a.len() as f64;
    -10.0 * error.log10()
}

/// The image with its masked pixels white.
fn written(image: &Image, mask: &[bool]) -> Image {
    let mut out = image.clone();
    out.data.chunks_mut(3).zip(mask).filter(|(_, m)| **m).for_each(|(c, _)| c.fill(1.0));
    out
}

/// A brick-like pattern that repeats after 20x14 pixels, in a view's colors.
fn bricks(view: usize) -> Image {
    let gain = 0.6 + 0.05 * view as f32;
    image(200, 90, |x, y| {
        let row = (y / 7.0).floor();
        let mortar = (y % 7.0 < 1.5) || ((x + 10.0 * (row % 2.0)) % 20.0 < 2.0);
        let tone = 0.5 + 0.3 * (std::f32::consts::TAU * x / 20.0).sin() * (std::f32::consts::TAU * y / 14.0).cos();
        if mortar { [0.75 * gain; 3] } else { [gain * tone, 0.5 * gain * tone, 0.4 * gain * tone] }
    })
}

fn ramp() -> Image {
    image(160, 96, |x, y| [0.2 + 0.003 * x, 0.3 + 0.002 * y, 0.8 - 0.002 * x - 0.002 * y])
}

#[test]
fn a_periodic_texture_is_recovered_in_all_views_at_once() {
    let truth: Vec<Image> = (0..3).map(bricks).collect();
    let mask = strokes(200, 90);
    let views: Vec<Image> = truth.iter().map(|v| written(v, &mask)).collect();
    let filled = fill(&views, &mask, 3).unwrap();
    for (view, truth) in filled.iter().zip(&truth) {
        let psnr = psnr(view, truth, &mask);
        assert!(psnr > 32.0, "{psnr}");
    }
}

#[test]
fn views_share_one_field() {
    // The second view is the first with channels exchanged, so whatever is copied stays exchanged.
    let truth = image(96, 64, |x, y| [(0.7 * x + 0.3 * (0.5 * y).sin()).sin() * 0.4 + 0.5, (0.9 * y + x * 0.2).cos() * 0.4 + 0.5, 0.1]);
    let swapped = image(96, 64, |x, y| {
        let c = truth.pixel(x as usize, y as usize);
        [c[1], c[0], c[2]]
    });
    let mask = strokes(96, 64);
    let filled = fill(&[truth, swapped], &mask, 9).unwrap();
    for (a, b) in filled[0].data.chunks(3).zip(filled[1].data.chunks(3)) {
        assert_eq!([a[0], a[1], a[2]], [b[1], b[0], b[2]]);
    }
}

#[test]
fn a_gradient_is_recovered() {
    let truth = ramp();
    let mask = strokes(160, 96);
    let filled = fill(&[written(&truth, &mask)], &mask, 1).unwrap();
    let copied = psnr(&filled[0], &truth, &mask);
    assert!(copied > 36.0, "{copied}");
    let marched = psnr(&telea::fill(&written(&truth, &mask), &mask, telea::RADIUS_PX).unwrap(), &truth, &mask);
    assert!(marched > 45.0, "{marched}");
}

#[test]
fn marching_makes_no_colors_that_are_nowhere() {
    let (truth, mask) = (bricks(0), strokes(200, 90));
    let filled = telea::fill(&written(&truth, &mask), &mask, telea::RADIUS_PX).unwrap();
    for k in 0..3 {
        let channel = |im: &Image| -> Vec<f32> { im.data.iter().skip(k).step_by(3).copied().collect() };
        let least = |v: &[f32]| v.iter().copied().fold(f32::INFINITY, f32::min);
        let most = |v: &[f32]| v.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        let (found, known) = (channel(&filled), channel(&truth));
        assert!(least(&found) >= least(&known) && most(&found) <= most(&known));
    }
}

#[test]
fn only_masked_pixels_change() {
    let mask = strokes(200, 90);
    let view = written(&bricks(0), &mask);
    for filled in [fill(std::slice::from_ref(&view), &mask, 5).unwrap().remove(0), telea::fill(&view, &mask, 4.0).unwrap()] {
        for (i, (a, b)) in filled.data.chunks(3).zip(view.data.chunks(3)).enumerate() {
            assert_eq!(mask[i], a != b, "pixel {i}");
        }
    }
}

#[test]
fn a_seed_gives_the_same_bytes_for_any_number_of_threads() {
    let mask = strokes(200, 90);
    let views: Vec<Image> = (0..2).map(|v| written(&bricks(v), &mask)).collect();
    let with_threads = |n: usize, seed: u64| {
        rayon::ThreadPoolBuilder::new().num_threads(n).build().unwrap().install(|| fill(&views, &mask, seed).unwrap())
    };
    assert_eq!(with_threads(1, 5), with_threads(3, 5));
    assert_ne!(with_threads(2, 5), with_threads(2, 6));
}

#[test]
fn holes_at_the_border_and_without_pixels_are_fine() {
    let truth = image(64, 40, |x, _| [0.5 + 0.3 * (std::f32::consts::TAU * x / 8.0).sin(), 0.4, 0.2]);
    let mask: Vec<bool> = (0..64 * 40).map(|i| i % 64 < 6 || i / 64 < 5).collect();
    let filled = fill(&[written(&truth, &mask)], &mask, 2).unwrap();
    assert!(psnr(&filled[0], &truth, &mask) > 30.0, "{}", psnr(&filled[0], &truth, &mask));
    let none = vec![false; 64 * 40];
    assert_eq!(fill(std::slice::from_ref(&truth), &none, 2).unwrap()[0], truth);
    assert_eq!(telea::fill(&truth, &none, 5.0).unwrap(), truth);
}

#[test]
fn what_cannot_be_filled_is_said() {
    let view = ramp();
    let all = vec![true; 160 * 96];
    assert_eq!(fill(std::slice::from_ref(&view), &all, 0), Err(CannotFill::NothingToCopy(7)));
    assert_eq!(telea::fill(&view, &all, 5.0), Err(CannotFill::NothingKnown));
    assert_eq!(fill(&[], &all, 0), Err(CannotFill::NoViews));
    let sizes = CannotFill::Sizes { mask: 7, width: 160, height: 96 };
    assert_eq!(fill(std::slice::from_ref(&view), &[true; 7], 0), Err(sizes));
    assert_eq!(fill(&[view.clone(), bricks(0)], &all, 0).unwrap_err(), CannotFill::Sizes { mask: 160 * 96, width: 160, height: 96 });
    assert_eq!(telea::fill(&view, &[true; 7], 5.0), Err(sizes));
}
