//! `diorama bench raster`

use super::median_seconds;
use diorama_kernels::ops::interpolate::{self, Interpolate};
use diorama_kernels::ops::rasterize::{self, Raster, Rasterize};
use diorama_kernels::ops::texture::{self, Filter, Kind, Texture};
use diorama_kernels::simd;
use serde::Serialize;

/// Cells of the grid along each side; each is two triangles.
const CELLS: usize = 128;
/// Edge of the sheet in clip space; corners of the sheet lie on centers of pixels.
const EXTENT: f32 = 2.25;
/// Edge of the texture in texels.
const TEXELS: usize = 1024;

/// Time to draw one textured picture without gradients. All pixels show a triangle.
#[derive(Clone, Debug, Serialize)]
pub struct RasterReport {
    pub threads: usize,
    pub simd: &'static str,
    pub size: [usize; 2],
    pub triangles: usize,
    /// Medians of the stages of a picture whose texture is bilinear.
    pub rasterize_ms: f64,
    pub interpolate_ms: f64,
    pub texture_ms: f64,
    /// Median of all three.
    pub seconds: f64,
    pub pixels_per_s: f64,
    /// The same with screen derivatives, mip levels by footprint, and a trilinear texture.
    pub trilinear_seconds: f64,
    pub trilinear_pixels_per_s: f64,
}

/// A wavy sheet before the camera that is larger than the picture.
struct Sheet {
    /// `[V, 4]`, clip space.
    positions: Vec<f32>,
    /// `[V, 2]`
    uvs: Vec<f32>,
    triangles: Vec<[u32; 3]>,
}

impl Sheet {
    fn new() -> Sheet {
        let side = CELLS + 1;
        let mut sheet = Sheet { positions: Vec::new(), uvs: Vec::new(), triangles: Vec::new() };
        for i in 0..side * side {
            let [u, v] = [i % side, i / side].map(|k| k as f32 / CELLS as f32);
            let w = 3.0 + 0.5 * (9.0 * u).sin() * (7.0 * v).cos();
            sheet.positions.extend([EXTENT * (u - 0.5) * w, EXTENT * (v - 0.5) * w, w - 1.0, w]);
            sheet.uvs.extend([u, v]);
        }
        let at = |x: usize, y: usize| (y * side + x) as u32;
        for (x, y) in (0..CELLS * CELLS).map(|i| (i % CELLS, i / CELLS)) {
            let [a, b, c, d] = [at(x, y), at(x + 1, y), at(x + 1, y + 1), at(x, y + 1)];
            sheet.triangles.extend([[a, b, c], [a, c, d]]);
        }
        sheet
    }
}

/// Draws the sheet on `size²` pixels, `repeats` times.
pub fn run(size: usize, repeats: usize) -> RasterReport {
    let sheet = Sheet::new();
    let vertices = sheet.uvs.len() / 2;
    let raster = Rasterize { images: 1, vertices, size: [size; 2] };
    let attributes = Interpolate { images: 1, pixels: size * size, vertices, attributes: 2, per_image: false };
    let bilinear = Texture { kind: Kind::Repeat, filter: Filter::Bilinear, images: 1, size: [TEXELS; 2], channels: 3 };
    let trilinear = Texture { filter: Filter::Trilinear, ..bilinear };
    let mut texels = vec![0.0; trilinear.numbers()];
    texels.iter_mut().enumerate().for_each(|(i, t)| *t = (i * 2_654_435_761 % 256) as f32 / 255.0);
    texture::mips::forward(&trilinear, &mut texels);
    let finest = &texels[..bilinear.numbers()];
    let n = size * size;
    let (mut drawn, mut uv, mut color) = (Raster::default(), vec![0.0; 2 * n], vec![0.0; 3 * n]);
    let (mut slopes, mut level) = (vec![0.0; 4 * n], vec![0.0; n]);

    let rasterize = |out: &mut Raster| rasterize::cpu::forward(&raster, &sheet.positions, &sheet.triangles, false, out);
    let interpolate = |from: &Raster, out: &mut [f32]| {
        interpolate::cpu::forward(&attributes, &sheet.uvs, &sheet.triangles, &from.ids, &from.uv, out);
    };
    let rasterize_ms = 1e3 * median_seconds(repeats, || rasterize(&mut drawn));
    let interpolate_ms = 1e3 * median_seconds(repeats, || interpolate(&drawn, &mut uv));
    let texture_ms = 1e3 * median_seconds(repeats, || texture::cpu::forward(&bilinear, finest, &uv, &[], &mut color));
    let seconds = median_seconds(repeats, || {
        rasterize(&mut drawn);
        interpolate(&drawn, &mut uv);
        texture::cpu::forward(&bilinear, finest, &uv, &[], &mut color);
    });
    let trilinear_seconds = median_seconds(repeats, || {
        rasterize::cpu::forward(&raster, &sheet.positions, &sheet.triangles, true, &mut drawn);
        interpolate(&drawn, &mut uv);
        let (ids, along) = (&drawn.ids, &drawn.derivatives);
        interpolate::cpu::derivatives(&attributes, &[0, 1], &sheet.uvs, &sheet.triangles, ids, along, &mut slopes);
        texture::footprint::forward(&trilinear, &uv, &slopes, &mut level);
        texture::cpu::forward(&trilinear, &texels, &uv, &level, &mut color);
    });
    RasterReport {
        threads: rayon::current_num_threads(),
        simd: simd::level().name(),
        size: [size; 2],
        triangles: sheet.triangles.len(),
        rasterize_ms,
        interpolate_ms,
        texture_ms,
        seconds,
        pixels_per_s: n as f64 / seconds,
        trilinear_seconds,
        trilinear_pixels_per_s: n as f64 / trilinear_seconds,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_sheet_covers_every_pixel() {
        let sheet = Sheet::new();
        let raster = Rasterize { images: 1, vertices: sheet.uvs.len() / 2, size: [64; 2] };
        let mut drawn = Raster::default();
        rasterize::cpu::forward(&raster, &sheet.positions, &sheet.triangles, false, &mut drawn);
        let open: Vec<[usize; 2]> = (0..64 * 64).filter(|i| drawn.ids[*i] == 0).map(|i| [i % 64, i / 64]).collect();
        assert!(open.is_empty(), "{open:?}");
    }
}
