//! One unit per pixel, or per ray where training pixels are drawn.

pub mod error_map;

use self::error_map::GpuErrorMap;
use super::{OBSERVED_EVERY, words_per_pixel};
use crate::gpu::random::{Wide, below, bits, halves, key, product, sum, uniform, widened};
use crate::gpu::{Buffer, Gpu, launch};
use cubecl::prelude::*;
use diorama_geom::PixelFormat;
use diorama_geom::rng::Rng;

/// `[R, 4]` for the pixels `at` `[R]` of packed RGBA.
pub fn gather(gpu: &Gpu, format: PixelFormat, pixels: &Buffer<u32>, at: &Buffer<u32>) -> Buffer {
    let n = at.len();
    let out = gpu.empty(n * 4);
    launch!(gpu, unpack, n, [pixels => pixels.len(), at => n, out => n * 4], n as u32, code(format));
    out
}

/// A format as kernels know it.
fn code(format: PixelFormat) -> u32 {
    match format {
        PixelFormat::Unorm8 => 0,
        PixelFormat::Unorm16 => 1,
        PixelFormat::Half => 2,
    }
}

/// Channel `k` of a pixel.
#[cube]
fn channel(pixels: &[u32], at: usize, #[comptime] k: usize, #[comptime] format: u32) -> f32 {
    if comptime!(format == 0) {
        f32::cast_from((pixels[at] >> comptime!(8 * k as u32)) & 255) / 255.0
    } else {
        let bits = (pixels[at * 2 + comptime!(k / 2)] >> comptime!(16 * (k % 2) as u32)) & 0xffff;
        if comptime!(format == 1) { f32::cast_from(bits) / 65535.0 } else { half(bits) }
    }
}

/// A finite half float: the bits of a float whose exponent is 112 too low. Devices may take the smallest ones for 0.
#[cube]
fn half(bits: u32) -> f32 {
    let mut out = f32::reinterpret((bits & 0x7fff) << 13) * comptime!(2.0f32.powi(112));
    if bits >= 0x8000 {
        out = -out;
    }
    out
}

/// Draws of a pixel before a ray whose pixels are all masked is left out.
const ATTEMPTS: u32 = 5;
/// Random numbers set aside per ray.
const NUMBERS: u32 = 16;
/// Numbers that describe a photograph.
const PHOTOGRAPH: usize = 5;
/// Rays of each 1024 that are drawn uniformly whatever the error map says.
const UNIFORM: u32 = 512;
/// Numbers that describe such a pixel: image, x, y, and the bits of the distance.
const OBSERVATION: usize = 4;
/// Cells per side of the error map of one image.
pub const CELLS: usize = 16;

/// Photographs on the device.
pub struct GpuPhotographs {
    count: usize,
    /// One of each `stride × stride` pixels is there.
    stride: u32,
    /// [`PHOTOGRAPH`] numbers of each: width, height, first pixel, and the key by which pixels were kept.
    sizes: Buffer<u32>,
    pixels: Buffer<u32>,
    format: PixelFormat,
    /// One bit per pixel that may be trained on; none: all may.
    mask: Option<Buffer<u32>>,
    /// [`OBSERVATION`] numbers of each pixel of known distance.
    observations: Option<Buffer<u32>>,
}

/// Drawn pixels.
pub struct Drawn {
    /// `[R]`
    pub images: Buffer<u32>,
    /// Centres, `[R, 2]`.
    pub pixels: Buffer,
    /// Straight RGBA, `[R, 4]`.
    pub target: Buffer,
    /// In `[0, 1)`, `[R]`.
    pub jitter: Buffer,
    /// 1 where masks refused every draw, `[R]`.
    pub left_out: Buffer<u32>,
    /// Distance of the surface along the ray, 0 where it is not known, `[R]`.
    pub distance: Buffer,
    /// `[R, 3]`
    pub background: Buffer,
}

/// What transparent pixels are composited on.
#[derive(Clone, Copy, Debug)]
pub enum Backdrop {
    Color([f32; 3]),
    /// Another colour for every ray.
    Random(Rng),
}

impl GpuPhotographs {
    /// Packed RGBA of all photographs, of the given widths and heights. Of each `stride ×
    /// stride` pixels one is there, which the photograph's random numbers name (the x of the square by the lower half
    /// of number `y << 32 | x` of its corner, the y by the upper).
    ///
    /// # Panics
    /// When the sizes do not add up to the pixels.
    pub fn upload(
        gpu: &Gpu,
        sizes: &[(u32, u32)],
        stride: u32,
        keys: &[Rng],
        (format, pixels): (PixelFormat, &[u32]),
        mask: Option<&[u32]>,
    ) -> Self {
        let mut first = 0;
        let mut rows = Vec::with_capacity(sizes.len() * PHOTOGRAPH);
        for ((w, h), rng) in sizes.iter().zip(keys) {
            let (high, low) = key(rng);
            rows.extend([*w, *h, first, high, low]);
            first += w.div_ceil(stride) * h.div_ceil(stride);
        }
        assert_eq!(first as usize * words_per_pixel(format), pixels.len(), "photographs: pixels");
        let mask = mask.map(|m| gpu.upload(m));
        GpuPhotographs {
            count: sizes.len(),
            stride,
            sizes: gpu.upload(&rows),
            pixels: gpu.upload(pixels),
            format,
            mask,
            observations: None,
        }
    }

    /// Draws some rays through pixels of known distance: image, x, y and distance of each.
    pub fn observe(&mut self, gpu: &Gpu, observations: &[(u32, u32, u32, f32)]) {
        let words: Vec<u32> = observations.iter().flat_map(|(image, x, y, d)| [*image, *x, *y, d.to_bits()]).collect();
        self.observations = (!words.is_empty()).then(|| gpu.upload(&words));
    }

    /// `n` random training pixels, half of them where `errors` are high; `first` counts those drawn before.
    pub fn draw(&self, gpu: &Gpu, n: usize, first: u64, rng: &Rng, errors: Option<&GpuErrorMap>, backdrop: Backdrop) -> Drawn {
        let d = Drawn {
            images: gpu.empty(n),
            pixels: gpu.empty(n * 2),
            target: gpu.empty(n * 4),
            jitter: gpu.empty(n),
            left_out: gpu.empty(n),
            distance: gpu.empty(n),
            background: gpu.empty(n * 3),
        };
        let ((key_high, key_low), (high, low)) = (key(rng), halves(first.wrapping_mul(NUMBERS as u64)));
        let (color, (back_high, back_low), is_random) = match backdrop {
            Backdrop::Color(c) => (c, (0, 0), false),
            Backdrop::Random(rng) => ([0.0; 3], key(&rng), true),
        };
        let (third_high, third_low) = halves(first.wrapping_mul(3));
        // Bound where there is no mask to read.
        let mask = self.mask.as_ref().unwrap_or(&self.sizes);
        let observations = self.observations.as_ref().unwrap_or(&self.sizes);
        let none = gpu.empty(0);
        let cdf = errors.map_or(&none, |e| e.cdf());
        let n_masked = if self.mask.is_some() { (self.pixels.len() / words_per_pixel(self.format)).div_ceil(32) } else { 0 };
        let n_cells = if errors.is_some() { self.count * CELLS * CELLS } else { 0 };
        launch!(
            gpu,
            draw_pixels,
            n,
            [
                self.sizes => self.count * PHOTOGRAPH,
                self.pixels => self.pixels.len(),
                mask => n_masked,
                cdf => n_cells,
                observations => observations.len(),
                d.images => n,
                d.pixels => n * 2,
                d.target => n * 4,
                d.jitter => n,
                d.left_out => n,
                d.distance => n,
            ],
            n as u32,
            self.count as u32,
            (observations.len() / OBSERVATION) as u32,
            key_high,
            key_low,
            high,
            low,
            self.stride,
            self.mask.is_some(),
            errors.is_some(),
            self.observations.is_some(),
            code(self.format),
        );
        launch!(
            gpu,
            fill_background,
            n * 3,
            [d.background => n * 3],
            (n * 3) as u32,
            color[0],
            color[1],
            color[2],
            back_high,
            back_low,
            third_high,
            third_low,
            is_random,
        );
        d
    }
}

/// A point of a photograph, in shares of its width and height.
#[derive(CubeType)]
struct Spot {
    image: u32,
    u: f32,
    v: f32,
}

/// A pixel of a photograph, and the distance of what it shows, 0 where that is not known.
#[derive(CubeType)]
struct Pixel {
    image: u32,
    x: u32,
    y: u32,
    distance: f32,
}

/// The first cell up to which the errors' roots sum to a share of all.
#[cube]
fn cell_by_error(cdf: &[f32], cells: usize, share: f32) -> usize {
    let wanted = share * cdf[cells - 1];
    let mut from = 0usize;
    let mut to = cells - 1;
    while from < to {
        let middle = (from + to) / 2;
        if cdf[middle] < wanted {
            from = middle + 1;
        } else {
            to = middle;
        }
    }
    from
}

/// A random point of all photographs; for some rays, of a cell that is drawn by its error.
#[allow(clippy::collapsible_if, reason = "the outer condition is decided when the kernel is built")]
#[cube]
fn draw_spot(r: usize, key: &Wide, draw: &Wide, cdf: &[f32], count: u32, #[comptime] by_error: bool) -> Spot {
    let mut image = below(key, draw, count);
    let mut u = uniform(key, &sum(draw, &widened(1u32)));
    let mut v = uniform(key, &sum(draw, &widened(2u32)));
    if comptime!(by_error) {
        if r as u32 % 1024 >= UNIFORM {
            let cell = cell_by_error(cdf, count as usize * comptime!(CELLS * CELLS), uniform(key, draw));
            image = u32::cast_from(cell / comptime!(CELLS * CELLS));
            u = (f32::cast_from(cell % CELLS) + u) / comptime!(CELLS as f32);
            v = (f32::cast_from(cell / CELLS % CELLS) + v) / comptime!(CELLS as f32);
        }
    }
    Spot { image, u, v }
}

/// The pixel that holds a point.
#[cube]
fn pixel_at(spot: &Spot, sizes: &[u32]) -> Pixel {
    let own = spot.image as usize * PHOTOGRAPH;
    let w = sizes[own];
    let h = sizes[own + 1];
    let x = min(u32::cast_from(spot.u * f32::cast_from(w)), w - 1);
    let y = min(u32::cast_from(spot.v * f32::cast_from(h)), h - 1);
    Pixel { image: spot.image, x, y, distance: 0.0f32 }
}

/// A random pixel of known distance.
#[cube]
fn draw_observed(key: &Wide, draw: &Wide, observations: &[u32], observed: u32) -> Pixel {
    let at = below(key, draw, observed) as usize * OBSERVATION;
    Pixel {
        image: observations[at],
        x: observations[at + 1],
        y: observations[at + 2],
        distance: f32::reinterpret(observations[at + 3]),
    }
}

/// The pixel that was kept of another one's `stride × stride` square.
#[cube]
fn kept_of_square(pixel: &Pixel, sizes: &[u32], stride: u32) -> Pixel {
    let own = pixel.image as usize * PHOTOGRAPH;
    let mut x = pixel.x;
    let mut y = pixel.y;
    if stride > 1 {
        let x0 = x / stride * stride;
        let y0 = y / stride * stride;
        let kept = bits(&Wide { high: sizes[own + 3], low: sizes[own + 4] }, &Wide { high: y0, low: x0 });
        x = x0 + kept.low % min(stride, sizes[own] - x0);
        y = y0 + kept.high % min(stride, sizes[own + 1] - y0);
    }
    Pixel { image: pixel.image, x, y, distance: pixel.distance }
}

/// Where a pixel's square is stored.
#[cube]
fn place_of(pixel: &Pixel, sizes: &[u32], stride: u32) -> u32 {
    let own = pixel.image as usize * PHOTOGRAPH;
    sizes[own + 2] + pixel.y / stride * sizes[own].div_ceil(stride) + pixel.x / stride
}

#[allow(clippy::collapsible_if, reason = "the outer condition is decided when the kernel is built")]
#[cube(launch_unchecked)]
fn draw_pixels(
    sizes: &[u32],
    pixels: &[u32],
    mask: &[u32],
    cdf: &[f32],
    observations: &[u32],
    images: &mut [u32],
    centres: &mut [f32],
    target: &mut [f32],
    jitter: &mut [f32],
    left_out: &mut [u32],
    distance: &mut [f32],
    n: u32,
    count: u32,
    observed: u32,
    key_high: u32,
    key_low: u32,
    high: u32,
    low: u32,
    stride: u32,
    #[comptime] is_masked: bool,
    #[comptime] by_error: bool,
    #[comptime] is_observed: bool,
    #[comptime] format: u32,
) {
    let r = ABSOLUTE_POS;
    if r >= n as usize {
        terminate!();
    }
    let key = Wide { high: key_high, low: key_low };
    let base = sum(&Wide { high, low }, &product(&widened(u32::cast_from(r)), &widened(NUMBERS)));
    jitter[r] = uniform(&key, &base);
    let mut refused = 1u32;
    let mut attempt = 0u32;
    let mut at = 0u32;
    while refused == 1 && attempt < ATTEMPTS {
        let draw = sum(&base, &widened(1 + attempt * 3));
        let pixel = pixel_at(&draw_spot(r, &key, &draw, cdf, count, by_error), sizes);
        at = place_of(&pixel, sizes, stride);
        put_pixel(&kept_of_square(&pixel, sizes, stride), r, images, centres, distance);
        if comptime!(is_observed) {
            if attempt == 0 && r as u32 % OBSERVED_EVERY < 1 {
                let pixel = draw_observed(&key, &draw, observations, observed);
                at = place_of(&pixel, sizes, stride);
                put_pixel(&kept_of_square(&pixel, sizes, stride), r, images, centres, distance);
            }
        }
        refused = 0u32;
        if comptime!(is_masked) {
            refused = 1 - ((mask[at as usize / 32] >> (at & 31)) & 1);
        }
        attempt += 1;
    }
    left_out[r] = refused;
    target[r * 4] = channel(pixels, at as usize, 0usize, format);
    target[r * 4 + 1] = channel(pixels, at as usize, 1usize, format);
    target[r * 4 + 2] = channel(pixels, at as usize, 2usize, format);
    target[r * 4 + 3] = channel(pixels, at as usize, 3usize, format);
}

/// Writes down the pixel of a ray.
#[cube]
fn put_pixel(pixel: &Pixel, r: usize, images: &mut [u32], centres: &mut [f32], distance: &mut [f32]) {
    images[r] = pixel.image;
    centres[r * 2] = f32::cast_from(pixel.x) + 0.5;
    centres[r * 2 + 1] = f32::cast_from(pixel.y) + 0.5;
    distance[r] = pixel.distance;
}

#[cube(launch_unchecked)]
fn fill_background(
    background: &mut [f32],
    n: u32,
    red: f32,
    green: f32,
    blue: f32,
    key_high: u32,
    key_low: u32,
    high: u32,
    low: u32,
    #[comptime] is_random: bool,
) {
    let i = ABSOLUTE_POS;
    if i >= n as usize {
        terminate!();
    }
    if comptime!(is_random) {
        let at = sum(&Wide { high, low }, &widened(u32::cast_from(i)));
        background[i] = uniform(&Wide { high: key_high, low: key_low }, &at);
    } else {
        let mut v = red;
        if i % 3 == 1 {
            v = green;
        }
        if i % 3 == 2 {
            v = blue;
        }
        background[i] = v;
    }
}

#[cube(launch_unchecked)]
fn unpack(pixels: &[u32], at: &[u32], out: &mut [f32], n: u32, #[comptime] format: u32) {
    let i = ABSOLUTE_POS;
    if i >= n as usize {
        terminate!();
    }
    out[i * 4] = channel(pixels, at[i] as usize, 0usize, format);
    out[i * 4 + 1] = channel(pixels, at[i] as usize, 1usize, format);
    out[i * 4 + 2] = channel(pixels, at[i] as usize, 2usize, format);
    out[i * 4 + 3] = channel(pixels, at[i] as usize, 3usize, format);
}
