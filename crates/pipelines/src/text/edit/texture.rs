//! Images on a rectangle: lookup between pixels, and halved copies for small views.

use diorama_geom::Image;
use diorama_geom::glam::{DVec2, dvec2};

/// An image and its copies of half the size each.
#[derive(Clone, Debug)]
pub struct Texture {
    levels: Vec<Image>,
}

impl Texture {
    pub fn new(image: Image) -> Texture {
        let mut levels = vec![image];
        while levels.last().is_some_and(|l| l.width > 1 && l.height > 1) {
            levels.push(halved(&levels[levels.len() - 1]));
        }
        Texture { levels }
    }

    /// Values at a place in widths and heights from the upper left, where `footprint` pixels of the full image are one; `out` has a number per
    /// channel, which is added times `weight`.
    pub fn add(&self, at: DVec2, footprint: f64, weight: f32, out: &mut [f32]) {
        let level = (footprint.max(1.0).log2() as usize).min(self.levels.len() - 1);
        let image = &self.levels[level];
        let (w, h) = (image.width as f64, image.height as f64);
        let p = (at * dvec2(w, h) - 0.5).clamp(DVec2::ZERO, dvec2(w - 1.0, h - 1.0));
        let (x, y) = (p.x as usize, p.y as usize);
        let (fx, fy) = ((p.x - x as f64) as f32, (p.y - y as f64) as f32);
        let (x1, y1) = ((x + 1).min(image.width - 1), (y + 1).min(image.height - 1));
        let corners = [(x, y, (1.0 - fx) * (1.0 - fy)), (x1, y, fx * (1.0 - fy)), (x, y1, (1.0 - fx) * fy), (x1, y1, fx * fy)];
        for (x, y, share) in corners {
            let from = &image.data[(y * image.width + x) * image.channels..][..image.channels];
            out.iter_mut().zip(from).for_each(|(o, v)| *o += weight * share * v);
        }
    }

    /// The full image.
    pub fn image(&self) -> &Image {
        &self.levels[0]
    }
}

/// Means of 2 × 2 pixels; a last odd row or column is its own partner.
fn halved(image: &Image) -> Image {
    let (w, h, c) = (image.width.div_ceil(2), image.height.div_ceil(2), image.channels);
    let mut out = Image::zeros(w, h, c);
    for y in 0..h {
        for x in 0..w {
            let at = |dx: usize, dy: usize| {
                let (x, y) = ((2 * x + dx).min(image.width - 1), (2 * y + dy).min(image.height - 1));
                &image.data[(y * image.width + x) * c..][..c]
            };
            let parts = [at(0, 0), at(1, 0), at(0, 1), at(1, 1)];
            for k in 0..c {
                out.data[(y * w + x) * c + k] = 0.25 * parts.iter().map(|p| p[k]).sum::<f32>();
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lookups_are_linear_between_pixels_and_means_of_larger_ones() {
        let ramp = Image { width: 8, height: 4, channels: 1, data: (0..32).map(|i| (i % 8) as f32).collect() };
        let texture = Texture::new(ramp.clone());
        let at = |x: f64, footprint: f64| {
            let mut out = [0.0];
            texture.add(dvec2(x / 8.0, 0.5), footprint, 1.0, &mut out);
            out[0]
        };
        assert!((at(3.5, 1.0) - 3.0).abs() < 1e-6 && (at(4.25, 1.0) - 3.75).abs() < 1e-6 && at(-3.0, 1.0) == 0.0 && at(11.0, 1.0) == 7.0);
        // Cells of two: 0.5, 2.5, 4.5, 6.5.
        assert!((at(3.0, 2.0) - 2.5).abs() < 1e-6 && (at(4.0, 3.9) - 3.5).abs() < 1e-6);
    }
}
