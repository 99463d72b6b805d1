//! Random changes of images, so that a network sees more than its data: each is a function of the image and of a sample's random
//! numbers.

use diorama_geom::Image;
use diorama_geom::rng::Rng;

/// Draws numbers one after the other from a sample's stream.
pub struct Draws {
    rng: Rng,
    counter: u64,
}

impl Draws {
    pub fn new(rng: Rng) -> Draws {
        Draws { rng, counter: 0 }
    }

    /// In [0, 1).
    pub fn uniform(&mut self) -> f32 {
        self.counter += 1;
        self.rng.uniform(self.counter)
    }

    /// In `[-most, most)`.
    pub fn symmetric(&mut self, most: f32) -> f32 {
        (self.uniform() * 2.0 - 1.0) * most
    }

    /// In `0..n`; 0 for an empty range.
    pub fn below(&mut self, n: usize) -> usize {
        self.counter += 1;
        if n == 0 { 0 } else { self.rng.below(self.counter, n as u64) as usize }
    }

    /// Standard normal.
    pub fn normal(&mut self) -> f32 {
        // Two counters each, of another half of the stream.
        self.counter += 1;
        self.rng.normal(1 << 40 | self.counter)
    }
}

/// What changes and how much; the default changes nothing.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Augmentation {
    /// Whether half of the images are mirrored left to right.
    pub flip: bool,
    /// Size of a window at a random place, `(width, height)`, at most the image's.
    pub crop: Option<(usize, usize)>,
    /// Most pixels that the image is moved by; border pixels are repeated.
    pub shift_px: usize,
    /// Largest angle that the image is turned by about its center, in radians; border pixels are repeated here and below.
    pub rotation: f32,
    /// Most that the factor of its size differs from 1.
    pub scale: f32,
    /// Largest slant: how far a row is moved sideways for each row of distance to the center.
    pub shear: f32,
    /// Most that is added to all values.
    pub brightness: f32,
    /// Most that the factor of the distance to the mean differs from 1.
    pub contrast: f32,
    /// Whether half of the images become their negatives, `1 − v`.
    pub negative: bool,
    /// Largest standard deviation of a Gaussian blur, in pixels.
    pub blur_px: f32,
    /// Largest standard deviation of noise that is added.
    pub noise: f32,
}

impl Augmentation {
    /// A changed copy of an image.
    pub fn apply(&self, image: &Image, rng: Rng) -> Image {
        let mut draws = Draws::new(rng);
        let mut out = image.clone();
        if let Some((width, height)) = self.crop {
            let (width, height) = (width.min(out.width), height.min(out.height));
            let (x, y) = (draws.below(out.width - width + 1), draws.below(out.height - height + 1));
            out = window(&out, (x as isize, y as isize), (width, height));
        }
        if self.shift_px > 0 {
            let mut by = || draws.below(2 * self.shift_px + 1) as isize - self.shift_px as isize;
            let at = (by(), by());
            out = window(&out, at, (out.width, out.height));
        }
        if self.rotation > 0.0 || self.scale > 0.0 || self.shear > 0.0 {
            let (angle, slant) = (draws.symmetric(self.rotation), draws.symmetric(self.shear));
            out = warped(&out, target_from_source(angle, 1.0 + draws.symmetric(self.scale), slant));
        }
        if self.flip && draws.uniform() < 0.5 {
            out = mirrored(&out);
        }
        if self.negative && draws.uniform() < 0.5 {
            out.data.iter_mut().for_each(|v| *v = 1.0 - *v);
        }
        let (factor, add) = (1.0 + draws.symmetric(self.contrast), draws.symmetric(self.brightness));
        if self.contrast > 0.0 || self.brightness > 0.0 {
            let mean = out.data.iter().map(|v| *v as f64).sum::<f64>() as f32 / out.data.len().max(1) as f32;
            out.data.iter_mut().for_each(|v| *v = (*v - mean) * factor + mean + add);
        }
        if self.blur_px > 0.0 {
            out = blurred(&out, draws.uniform() * self.blur_px);
        }
        if self.noise > 0.0 {
            let std = draws.uniform() * self.noise;
            out.data.iter_mut().for_each(|v| *v += std * draws.normal());
        }
        out
    }
}

/// A window at `at`; pixels outside of the image are those of its border.
pub fn window(image: &Image, at: (isize, isize), (width, height): (usize, usize)) -> Image {
    let mut out = Image::zeros(width, height, image.channels);
    let c = image.channels;
    for y in 0..height {
        let sy = (y as isize + at.1).clamp(0, image.height as isize - 1) as usize;
        for x in 0..width {
            let sx = (x as isize + at.0).clamp(0, image.width as isize - 1) as usize;
            out.data[(y * width + x) * c..][..c].copy_from_slice(image.pixel(sx, sy));
        }
    }
    out
}

/// Rotation after slant after scaling, as rows; angles turn x towards y.
fn target_from_source(angle: f32, scale: f32, slant: f32) -> [[f32; 2]; 2] {
    let (sin, cos) = angle.sin_cos();
    [[scale * cos, scale * (slant * cos - sin)], [scale * sin, scale * (slant * sin + cos)]]
}

/// The image under a linear map about its center, sampled bilinearly; pixels outside of the image are those of its border.
///
/// # Panics
/// When the map has no inverse.
pub fn warped(image: &Image, target_from_source: [[f32; 2]; 2]) -> Image {
    let [[a, b], [c, d]] = target_from_source;
    let determinant = a * d - b * c;
    assert!(determinant != 0.0, "a map with an inverse");
    let (width, height, channels) = (image.width as f32, image.height as f32, image.channels);
    let mut out = Image::zeros(image.width, image.height, channels);
    for (i, o) in out.data.chunks_exact_mut(channels).enumerate() {
        // Pixel centers lie at halves.
        let (x, y) = ((i % image.width) as f32 + 0.5 - width / 2.0, (i / image.width) as f32 + 0.5 - height / 2.0);
        let sx = ((d * x - b * y) / determinant + width / 2.0 - 0.5).clamp(0.0, width - 1.0);
        let sy = ((a * y - c * x) / determinant + height / 2.0 - 0.5).clamp(0.0, height - 1.0);
        let (x0, y0) = (sx as usize, sy as usize);
        let (x1, y1) = ((x0 + 1).min(image.width - 1), (y0 + 1).min(image.height - 1));
        let (u, v) = (sx - x0 as f32, sy - y0 as f32);
        let corners = [image.pixel(x0, y0), image.pixel(x1, y0), image.pixel(x0, y1), image.pixel(x1, y1)];
        for (k, o) in o.iter_mut().enumerate() {
            let [p, q, r, s] = corners.map(|p| p[k]);
            *o = (p * (1.0 - u) + q * u) * (1.0 - v) + (r * (1.0 - u) + s * u) * v;
        }
    }
    out
}

/// The image mirrored left to right.
pub fn mirrored(image: &Image) -> Image {
    let (w, c) = (image.width, image.channels);
    let mut out = image.clone();
    for (row, from) in out.data.chunks_exact_mut(w * c).zip(image.data.chunks_exact(w * c)) {
        for x in 0..w {
            row[x * c..(x + 1) * c].copy_from_slice(&from[(w - 1 - x) * c..(w - x) * c]);
        }
    }
    out
}

/// Gaussian blur of a standard deviation in pixels, with border pixels repeated.
pub fn blurred(image: &Image, std_px: f32) -> Image {
    let radius = (3.0 * std_px).ceil() as isize;
    if radius == 0 {
        return image.clone();
    }
    let mut weights: Vec<f32> = (-radius..=radius).map(|i| (-0.5 * (i as f32 / std_px).powi(2)).exp()).collect();
    let sum: f32 = weights.iter().sum();
    weights.iter_mut().for_each(|w| *w /= sum);
    let pass = |image: &Image, step: (isize, isize)| {
        let mut out = Image::zeros(image.width, image.height, image.channels);
        for y in 0..image.height {
            for x in 0..image.width {
                let o = &mut out.data[(y * image.width + x) * image.channels..][..image.channels];
                for (i, w) in weights.iter().enumerate() {
                    let i = i as isize - radius;
                    let sx = (x as isize + i * step.0).clamp(0, image.width as isize - 1) as usize;
                    let sy = (y as isize + i * step.1).clamp(0, image.height as isize - 1) as usize;
                    o.iter_mut().zip(image.pixel(sx, sy)).for_each(|(o, v)| *o += w * v);
                }
            }
        }
        out
    };
    pass(&pass(image, (1, 0)), (0, 1))
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_testkit::random_unit;

    fn image() -> Image {
        Image { width: 7, height: 5, channels: 3, data: random_unit(105, 1) }
    }

    #[test]
    fn nothing_is_changed_unless_told_and_samples_repeat() {
        assert_eq!(Augmentation::default().apply(&image(), Rng::new(1, 1)), image());
        let all = Augmentation {
            flip: true,
            crop: Some((5, 4)),
            shift_px: 2,
            rotation: 0.2,
            scale: 0.1,
            shear: 0.2,
            brightness: 0.1,
            contrast: 0.2,
            negative: true,
            blur_px: 1.0,
            noise: 0.05,
        };
        let a = all.apply(&image(), Rng::new(1, 1));
        assert_eq!((a.width, a.height), (5, 4));
        assert_eq!(a, all.apply(&image(), Rng::new(1, 1)));
        assert_ne!(a, all.apply(&image(), Rng::new(1, 2)));
    }

    #[test]
    fn windows_repeat_the_border_and_mirrors_are_their_own_inverse() {
        let i = image();
        let w = window(&i, (-2, -1), (7, 5));
        assert_eq!((w.pixel(0, 0), w.pixel(2, 1), w.pixel(6, 4)), (i.pixel(0, 0), i.pixel(0, 0), i.pixel(4, 3)));
        assert_eq!(mirrored(&i).pixel(0, 2), i.pixel(6, 2));
        assert_eq!(mirrored(&mirrored(&i)), i);
    }

    #[test]
    fn quarter_turns_slants_and_sizes_move_pixels_where_they_should() {
        let square = Image { width: 5, height: 5, channels: 2, data: random_unit(50, 2) };
        let near = |a: &[f32], b: &[f32]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-5);
        let turned = warped(&square, target_from_source(std::f32::consts::FRAC_PI_2, 1.0, 0.0));
        let slanted = warped(&square, target_from_source(0.0, 1.0, 1.0));
        let doubled = warped(&square, target_from_source(0.0, 2.0, 0.0));
        for (x, y) in (0..5).flat_map(|y| (0..5).map(move |x| (x, y))) {
            // x turns towards y: what was right of the center is below it.
            assert!(near(turned.pixel(4 - y, x), square.pixel(x, y)), "{x} {y}");
            let moved = x as isize + y as isize - 2;
            if (0..5).contains(&moved) {
                assert!(near(slanted.pixel(moved as usize, y), square.pixel(x, y)), "{x} {y}");
            }
        }
        assert!(near(doubled.pixel(4, 0), square.pixel(3, 1)) && near(doubled.pixel(0, 2), square.pixel(1, 2)));
        let whole = target_from_source(0.3, 1.2, 0.4);
        let part = |p: [[f32; 2]; 2], q: [[f32; 2]; 2]| p.map(|r| [0, 1].map(|j| r[0] * q[0][j] + r[1] * q[1][j]));
        let parts = part(part(target_from_source(0.3, 1.0, 0.0), target_from_source(0.0, 1.0, 0.4)), target_from_source(0.0, 1.2, 0.0));
        assert!(near(&whole.concat(), &parts.concat()));
    }

    #[test]
    fn each_change_stays_within_its_limit_and_happens() {
        let square = Image { width: 9, height: 9, channels: 1, data: random_unit(81, 5) };
        for (name, a) in [
            ("rotation", Augmentation { rotation: 0.3, ..Augmentation::default() }),
            ("scale", Augmentation { scale: 0.3, ..Augmentation::default() }),
            ("shear", Augmentation { shear: 0.3, ..Augmentation::default() }),
            ("contrast", Augmentation { contrast: 0.3, ..Augmentation::default() }),
            ("brightness", Augmentation { brightness: 0.3, ..Augmentation::default() }),
        ] {
            let changed: Vec<Image> = (0..200).map(|i| a.apply(&square, Rng::new(6, i))).collect();
            assert!(changed.iter().all(|c| *c != square), "{name}");
            // The center stays under all maps, and brightness and contrast are bounded.
            let most = changed.iter().map(|c| (c.pixel(4, 4)[0] - square.pixel(4, 4)[0]).abs()).fold(0.0, f32::max);
            let (least, limit) = if name == "brightness" { (0.25, 0.3) } else { (0.0, 0.2) };
            assert!(most >= least && most <= limit + 1e-5, "{name}: {most}");
        }
    }

    #[test]
    fn blur_keeps_constants_and_spreads_points() {
        let flat = Image { data: vec![0.3; 105], ..image() };
        assert!(blurred(&flat, 1.5).data.iter().all(|v| (v - 0.3).abs() < 1e-6));
        let mut point = Image::zeros(15, 15, 1);
        point.data[7 * 15 + 7] = 1.0;
        let b = blurred(&point, 1.0);
        assert!((b.pixel(7, 7)[0] - 0.159).abs() < 2e-3 && (b.pixel(8, 7)[0] - 0.0965).abs() < 2e-3);
    }

    #[test]
    fn half_of_the_images_become_negatives() {
        let negative = Augmentation { negative: true, ..Augmentation::default() };
        let inverse = Image { data: image().data.iter().map(|v| 1.0 - v).collect(), ..image() };
        let changed: Vec<Image> = (0..400).map(|i| negative.apply(&image(), Rng::new(7, i))).collect();
        let n = changed.iter().filter(|c| **c == inverse).count();
        assert!((150..250).contains(&n) && changed.iter().filter(|c| **c == image()).count() == 400 - n, "{n}");
    }

    #[test]
    fn half_of_the_images_are_mirrored_and_crops_reach_everywhere() {
        let flip = Augmentation { flip: true, ..Augmentation::default() };
        let n = (0..400).filter(|i| flip.apply(&image(), Rng::new(3, *i)) != image()).count();
        assert!((150..250).contains(&n), "{n}");
        let crop = Augmentation { crop: Some((6, 4)), ..Augmentation::default() };
        let corners: std::collections::HashSet<u32> = (0..100).map(|i| crop.apply(&image(), Rng::new(4, i)).data[0].to_bits()).collect();
        assert_eq!(corners.len(), 4);
    }
}
