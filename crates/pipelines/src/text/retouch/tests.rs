use super::poisson::{Gradients, blend};
use diorama_geom::Image;
use diorama_geom::rng::Rng;

fn noisy(width: usize, height: usize, stream: u64) -> Image {
    let rng = Rng::new(4, stream);
    let n = width * height * 3;
    Image { width, height, channels: 3, data: (0..n as u64).map(|i| rng.uniform(i)).collect() }
}

fn largest_difference(a: &Image, b: &Image) -> f32 {
    a.data.iter().zip(&b.data).map(|(x, y)| (x - y).abs()).fold(0.0, f32::max)
}

#[test]
fn a_patch_is_reproduced_up_to_the_offset_of_the_border() {
    for (width, height) in [(64, 33), (3, 3), (7, 130), (101, 4)] {
        let patch = noisy(width, height, 0);
        let mut image = patch.clone();
        image.data.iter_mut().for_each(|v| *v += 0.25);
        // Inside, the image is noise, which the patch's gradients replace.
        let other = noisy(width, height, 1);
        let mut framed = image.clone();
        for y in 1..height - 1 {
            let row = (y * width + 1) * 3..(y * width + width - 1) * 3;
            framed.data[row.clone()].copy_from_slice(&other.data[row]);
        }
        let joined = blend(&patch, &framed, Gradients::Patch);
        assert!(largest_difference(&joined, &image) < 1e-5, "{width}x{height}: {}", largest_difference(&joined, &image));
    }
}

#[test]
fn a_flat_patch_interpolates_the_border_harmonically() {
    // x² − y² is harmonic on the grid, too.
    let (width, height) = (40, 30);
    let at = |i: usize| ((i % width) as f32 / 40.0).powi(2) - ((i / width) as f32 / 40.0).powi(2);
    let image = Image { width, height, channels: 1, data: (0..width * height).map(at).collect() };
    let joined = blend(&Image::zeros(width, height, 1), &image, Gradients::Patch);
    assert!(largest_difference(&joined, &image) < 1e-5);
}

#[test]
fn mixed_gradients_keep_the_image_under_a_flat_patch_and_the_patch_on_a_flat_image() {
    let image = noisy(50, 31, 2);
    let flat = Image { width: 50, height: 31, channels: 3, data: vec![0.3; 50 * 31 * 3] };
    assert!(largest_difference(&blend(&flat, &image, Gradients::Mixed), &image) < 1e-5);
    let mut patch = flat.clone();
    patch.data[(15 * 50 + 20) * 3..][..30].fill(0.9);
    assert!(largest_difference(&blend(&patch, &flat, Gradients::Mixed), &patch) < 1e-5);
}

#[test]
fn the_border_is_the_images_and_thin_images_have_nothing_else() {
    let (patch, image) = (noisy(21, 17, 5), noisy(21, 17, 6));
    let joined = blend(&patch, &image, Gradients::Mixed);
    for i in (0..21 * 17).filter(|i| i % 21 == 0 || i % 21 == 20 || i / 21 == 0 || i / 21 == 16) {
        assert_eq!(joined.pixel(i % 21, i / 21), image.pixel(i % 21, i / 21));
    }
    assert_eq!(blend(&noisy(2, 9, 0), &noisy(2, 9, 1), Gradients::Patch), noisy(2, 9, 1));
    assert_eq!(blend(&patch, &image, Gradients::Mixed), joined);
}
