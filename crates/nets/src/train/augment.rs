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
    /// Most that is added to all values.
    pub brightness: f32,
    /// Most that the factor of the distance to the mean differs from 1.
    pub contrast: f32,
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
        if self.flip && draws.uniform() < 0.5 {
            out = mirrored(&out);
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
        let all = Augmentation { flip: true, crop: Some((5, 4)), shift_px: 2, brightness: 0.1, contrast: 0.2, blur_px: 1.0, noise: 0.05 };
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
    fn blur_keeps_constants_and_spreads_points() {
        let flat = Image { data: vec![0.3; 105], ..image() };
        assert!(blurred(&flat, 1.5).data.iter().all(|v| (v - 0.3).abs() < 1e-6));
        let mut point = Image::zeros(15, 15, 1);
        point.data[7 * 15 + 7] = 1.0;
        let b = blurred(&point, 1.0);
        assert!((b.pixel(7, 7)[0] - 0.159).abs() < 2e-3 && (b.pixel(8, 7)[0] - 0.0965).abs() < 2e-3);
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
