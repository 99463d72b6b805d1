//! Seamless procedural textures: linear color, height, roughness and metalness on the unit square, which repeats.

mod masonry;
mod nature;
mod noise;
mod workshop;

use diorama_geom::ImageU8;
use diorama_geom::color::{srgb_from_linear, u8_from_unit};

pub use masonry::{blocks, bricks, cobbles, roof_tiles, slabs, slates};
pub use nature::{asphalt, bark, leaves, plaster, soil, stone};
pub use noise::Noise;
pub use workshop::{brocade, gilding, painted, stripes, wood};

/// Bounds of the linear colors of textures; materials in the world are neither darker nor brighter.
pub const ALBEDO: [f32; 2] = [0.045, 0.82];

/// Values of a texture at one point.
#[derive(Clone, Copy, Debug)]
pub struct Texel {
    /// Linear RGB.
    pub color: [f32; 3],
    pub alpha: f32,
    /// Height in meters.
    pub height: f32,
    pub roughness: f32,
    pub metallic: f32,
}

impl Texel {
    /// An opaque point of a material that is not a metal.
    pub fn matte(color: [f32; 3], height: f32, roughness: f32) -> Texel {
        Texel { color, alpha: 1.0, height, roughness, metallic: 0.0 }
    }
}

/// A square texture, row by row from the top.
#[derive(Clone, Debug)]
pub struct Tile {
    size: usize,
    texels: Vec<Texel>,
}

impl Tile {
    /// Evaluates `at(u, v)` in the centers of `size × size` pixels.
    pub fn paint(size: usize, at: impl Fn(f32, f32) -> Texel) -> Tile {
        let center = |k: usize| (k as f32 + 0.5) / size as f32;
        Tile { size, texels: (0..size * size).map(|k| at(center(k % size), center(k / size))).collect() }
    }

    fn image(&self, channels: usize, of: impl Fn(&Texel) -> [f32; 4]) -> ImageU8 {
        let data = self.texels.iter().flat_map(|t| of(t).into_iter().take(channels).map(u8_from_unit)).collect();
        ImageU8 { width: self.size, height: self.size, channels, data }
    }

    /// sRGB colors, with opacity where a texel is a hole.
    pub fn color_image(&self) -> ImageU8 {
        let channels = if self.texels.iter().any(|t| t.alpha < 1.0) { 4 } else { 3 };
        self.image(channels, |t| {
            let [r, g, b] = t.color.map(|c| srgb_from_linear(c.clamp(ALBEDO[0], ALBEDO[1])));
            [r, g, b, t.alpha]
        })
    }

    /// Roughness in green, metalness in blue.
    pub fn metallic_roughness_image(&self) -> ImageU8 {
        self.image(3, |t| [1.0, t.roughness.max(0.03), t.metallic, 1.0])
    }

    /// Normals of the heights where the texture covers `tile_m` meters; `None` if the heights are all the same.
    pub fn normal_image(&self, tile_m: f64) -> Option<ImageU8> {
        let first = self.texels[0].height;
        if self.texels.iter().all(|t| t.height == first) {
            return None;
        }
        let n = self.size;
        let height = |x: usize, y: usize| self.texels[(y % n) * n + x % n].height;
        // Central differences over two pixels; y points against v.
        let per_meter = n as f32 / (2.0 * tile_m as f32);
        let data = (0..n * n).flat_map(|k| {
            let (x, y) = (k % n, k / n);
            let dx = (height(x + n - 1, y) - height(x + 1, y)) * per_meter;
            let dy = (height(x, y + 1) - height(x, y + n - 1)) * per_meter;
            let length = (dx * dx + dy * dy + 1.0).sqrt();
            [dx, dy, 1.0].map(|c| u8_from_unit(0.5 + 0.5 * c / length))
        });
        Some(ImageU8 { width: n, height: n, channels: 3, data: data.collect() })
    }
}

/// Linear interpolation of colors.
pub fn mix(a: [f32; 3], b: [f32; 3], t: f32) -> [f32; 3] {
    std::array::from_fn(|k| a[k] + (b[k] - a[k]) * t)
}

/// A color times a number.
pub fn scale(a: [f32; 3], s: f32) -> [f32; 3] {
    a.map(|v| v * s)
}

/// Hermite step from 0 at `a` to 1 at `b`.
pub fn smooth_step(a: f32, b: f32, x: f32) -> f32 {
    let t = ((x - a) / (b - a)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn normals_are_those_of_the_height() {
        // A wave of 1 mm along u over a tile of 1 m: the slope is known everywhere.
        let (amplitude, turn) = (0.02, std::f32::consts::TAU);
        let tile = Tile::paint(128, |u, _| Texel::matte([0.5; 3], amplitude * (turn * u).sin(), 1.0));
        let image = tile.normal_image(1.0).unwrap();
        for x in 0..128 {
            let slope = amplitude * turn * (turn * (x as f32 + 0.5) / 128.0).cos();
            let expected = -slope / (1.0 + slope * slope).sqrt();
            let pixel = image.pixel(x, 7);
            assert!((pixel[0] as f32 / 127.5 - 1.0 - expected).abs() < 0.01, "{x}");
            assert!((pixel[1] as f32 / 127.5 - 1.0).abs() < 0.01);
        }
        // Height that rises with v falls against v: y of the normal is positive.
        let tile = Tile::paint(64, |_, v| Texel::matte([0.5; 3], amplitude * (turn * v).sin(), 1.0));
        assert!(tile.normal_image(1.0).unwrap().pixel(3, 0)[1] > 130);
    }

    #[test]
    fn every_texture_repeats_without_a_seam_and_keeps_its_bounds() {
        for (name, tile) in all() {
            let image = tile.color_image();
            let n = image.width;
            let difference = |a: &[u8], b: &[u8]| a.iter().zip(b).take(3).map(|(a, b)| a.abs_diff(*b) as f64).sum::<f64>();
            let columns = |a: usize, b: usize| (0..n).map(|y| difference(image.pixel(a, y), image.pixel(b, y))).sum::<f64>() / n as f64;
            let rows = |a: usize, b: usize| (0..n).map(|x| difference(image.pixel(x, a), image.pixel(x, b))).sum::<f64>() / n as f64;
            // Across the seam the colors differ no more than across the roughest pair of neighbors inside.
            let worst = |of: &dyn Fn(usize, usize) -> f64| (0..n - 1).map(|k| of(k, k + 1)).fold(0.0, f64::max);
            assert!(columns(n - 1, 0) <= 1.15 * worst(&columns) + 1.0, "{name}: {} {}", columns(n - 1, 0), worst(&columns));
            assert!(rows(n - 1, 0) <= 1.15 * worst(&rows) + 1.0, "{name}: {} {}", rows(n - 1, 0), worst(&rows));
            let roughness = tile.metallic_roughness_image();
            assert!(roughness.data.chunks_exact(3).all(|p| p[1] >= 8), "{name}");
        }
    }

    fn all() -> Vec<(&'static str, Tile)> {
        vec![
            ("bricks", bricks(1)),
            ("blocks", blocks(1)),
            ("cobbles", cobbles(1)),
            ("slabs", slabs(1)),
            ("roof tiles", roof_tiles(1)),
            ("slates", slates(1)),
            ("plaster", plaster(1)),
            ("asphalt", asphalt(1)),
            ("bark", bark(1)),
            ("stone", stone(1)),
            ("soil", soil(1)),
            ("wood", wood(1, [0.3, 0.15, 0.07], [0.1, 0.06, 0.05])),
            ("painted", painted(1)),
            ("brocade", brocade(1)),
            ("gilding", gilding(1)),
            ("stripes", stripes([0.5, 0.05, 0.05], [0.7, 0.7, 0.6])),
        ]
    }
}
