//! Plain images, row-major, channels interleaved.

use crate::color::u8_from_unit;

/// Number format of stored pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PixelFormat {
    /// 8 bits for 0 to 1.
    Unorm8,
    /// 16 bits for 0 to 1.
    Unorm16,
    /// 16-bit floats (IEEE 754 binary16).
    Half,
}

impl PixelFormat {
    /// Bytes of a pixel with four values.
    pub fn bytes(self) -> usize {
        if self == PixelFormat::Unorm8 { 4 } else { 8 }
    }
}

/// `[H, W, C]` of f32.
#[derive(Clone, Debug, PartialEq)]
pub struct Image {
    pub width: usize,
    pub height: usize,
    pub channels: usize,
    pub data: Vec<f32>,
}

/// `[H, W, C]` of u8; color is sRGB-encoded, a fourth channel is straight alpha.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ImageU8 {
    pub width: usize,
    pub height: usize,
    pub channels: usize,
    pub data: Vec<u8>,
}

impl Image {
    /// An image of zeros.
    pub fn zeros(width: usize, height: usize, channels: usize) -> Image {
        Image { width, height, channels, data: vec![0.0; width * height * channels] }
    }

    /// The values of one pixel, `[C]`.
    pub fn pixel(&self, x: usize, y: usize) -> &[f32] {
        let i = (y * self.width + x) * self.channels;
        &self.data[i..i + self.channels]
    }

    /// Area average over the exact pixel footprint; color is weighted by alpha where there is one.
    pub fn downsampled(&self, width: usize, height: usize) -> Image {
        if (width, height) == (self.width, self.height) {
            return self.clone();
        }
        let data = averages((self.width, self.height), (width, height), self.channels, |i| self.data[i]);
        Image { width, height, channels: self.channels, data }
    }

    /// Rounds values in [0, 1] to 8 bits.
    pub fn to_u8(&self) -> ImageU8 {
        let data = self.data.iter().map(|&v| u8_from_unit(v)).collect();
        ImageU8 { width: self.width, height: self.height, channels: self.channels, data }
    }
}

impl ImageU8 {
    /// The values of one pixel, `[C]`.
    pub fn pixel(&self, x: usize, y: usize) -> &[u8] {
        let i = (y * self.width + x) * self.channels;
        &self.data[i..i + self.channels]
    }

    /// Converts 8-bit values to [0, 1].
    pub fn to_f32(&self) -> Image {
        let data = self.data.iter().map(|&v| v as f32 / 255.0).collect();
        Image { width: self.width, height: self.height, channels: self.channels, data }
    }

    /// Area average over the exact pixel footprint; color is weighted by alpha where there is one.
    pub fn downsampled(&self, width: usize, height: usize) -> ImageU8 {
        if (width, height) == (self.width, self.height) {
            return self.clone();
        }
        let data = averages((self.width, self.height), (width, height), self.channels, |i| self.data[i] as f32);
        ImageU8 { width, height, channels: self.channels, data: data.into_iter().map(|v| (v + 0.5) as u8).collect() }
    }
}

/// Averages `at` over the footprints of a smaller image's pixels.
fn averages(from: (usize, usize), to: (usize, usize), channels: usize, at: impl Fn(usize) -> f32) -> Vec<f32> {
    let (xs, ys) = (footprints(from.0, to.0), footprints(from.1, to.1));
    let mut out = vec![0.0; to.0 * to.1 * channels];
    for (y, rows) in ys.iter().enumerate() {
        for (x, cols) in xs.iter().enumerate() {
            let (mut sum, mut total, mut alpha_total) = ([0.0f32; 4], 0.0f32, 0.0f32);
            for &(sy, wy) in rows {
                for &(sx, wx) in cols {
                    let p = (sy * from.0 + sx) * channels;
                    let w = wx * wy;
                    let a = if channels == 4 { at(p + 3) * w } else { w };
                    total += w;
                    alpha_total += a;
                    for k in 0..channels.min(3) {
                        sum[k] += a * at(p + k);
                    }
                }
            }
            let o = &mut out[(y * to.0 + x) * channels..][..channels];
            for k in 0..channels.min(3) {
                o[k] = if alpha_total > 0.0 { sum[k] / alpha_total } else { 0.0 };
            }
            if channels == 4 {
                o[3] = alpha_total / total;
            }
        }
    }
    out
}

/// For each output pixel, the input pixels that it covers, with their weights.
fn footprints(from: usize, to: usize) -> Vec<Vec<(usize, f32)>> {
    let step = from as f64 / to as f64;
    (0..to)
        .map(|i| {
            let (a, b) = (i as f64 * step, ((i + 1) as f64 * step).min(from as f64));
            (a as usize..(b.ceil() as usize).min(from))
                .map(|s| (s, ((b.min(s as f64 + 1.0)) - a.max(s as f64)) as f32))
                .filter(|&(_, w)| w > 1e-6)
                .collect()
        })
        .collect()
}

/// Means of values `[H, W]` over squares of a radius around each, in which border pixels are repeated.
pub fn box_means(values: &[f64], w: usize, h: usize, radius: usize) -> Vec<f64> {
    let pass = |values: &[f64], n: usize, lines: usize, at: &dyn Fn(usize, usize) -> usize| -> Vec<f64> {
        let mut out = vec![0.0; values.len()];
        let r = radius as isize;
        for line in 0..lines {
            let v = |k: isize| values[at(line, k.clamp(0, n as isize - 1) as usize)];
            let mut sum: f64 = (-r..=r).map(v).sum();
            for k in 0..n as isize {
                out[at(line, k as usize)] = sum / (2 * r + 1) as f64;
                sum += v(k + r + 1) - v(k - r);
            }
        }
        out
    };
    let rows = pass(values, w, h, &|y, x| y * w + x);
    pass(&rows, h, w, &|x, y| y * w + x)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn downsampling_averages_whole_blocks() {
        let im = ImageU8 { width: 4, height: 2, channels: 1, data: vec![0, 100, 10, 20, 200, 100, 30, 40] };
        assert_eq!(im.downsampled(2, 1).data, vec![100, 25]);
    }

    #[test]
    fn transparent_pixels_do_not_bleed_color() {
        let im = ImageU8 { width: 2, height: 1, channels: 4, data: vec![255, 0, 0, 255, 0, 255, 0, 0] };
        assert_eq!(im.downsampled(1, 1).data, vec![255, 0, 0, 128]);
    }

    #[test]
    fn box_means_repeat_the_border() {
        let values = [0.0, 3.0, 6.0, 0.0, 3.0, 6.0];
        let means = box_means(&values, 3, 2, 1);
        assert!(means.iter().zip([1.0, 3.0, 5.0, 1.0, 3.0, 5.0]).all(|(m, want)| (m - want).abs() < 1e-12), "{means:?}");
    }

    #[test]
    fn uneven_footprints_cover_everything_once() {
        for (from, to) in [(770, 192), (1368, 342), (7, 3)] {
            let total: f32 = footprints(from, to).iter().flatten().map(|f| f.1).sum();
            assert!((total - from as f32).abs() < 1e-2);
        }
    }
}
