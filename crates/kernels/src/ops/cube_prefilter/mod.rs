//! Light as surfaces blur it: a cube map filtered by a cosine lobe, and by GGX lobes of several widths (Karis 2013). Linear, so its gradient
//! is the transposed filter.
//!
//! A texel of an output is `Σ w L / Σ w` over the texels of an input, where the sum runs over directions ω inside of the texel (its
//! [`SUBDIVISION`]² parts) with `w = k(n·ω) dω` and n the output texel's direction. Diffuse light has `k = max(n·ω, 0)`. A lobe has
//! `k = D(h) (n·ω)` with `h` halfway between n and ω and D the GGX distribution with `α = r²`; it ends where 99 % of it are inside.
//!
//! Outputs: diffuse light on faces of [`DIFFUSE`]², and lobes of the roughness that [`split_sum`](super::split_sum) reads at each level, on
//! faces of half the size per level. Inputs are the map's own mips: of its own size for the first lobe, of [`INPUT`]² else, since wider
//! lobes blur what lies below that.

pub mod cpu;
pub mod reference;
#[cfg(test)]
mod tests;

use super::split_sum::roughness_of;
use super::texture::{Filter, Kind, Texture, cube_direction};

/// Edge of the faces of diffuse light.
pub const DIFFUSE: usize = 8;
/// Edge of the faces that wide lobes read.
pub const INPUT: usize = 16;
/// Parts of an input's texel along each axis.
pub const SUBDIVISION: usize = 3;
/// Share of a lobe that is kept.
const KEPT: f64 = 0.99;

/// A cube map of `size`² texels per face and three channels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CubePrefilter {
    pub size: usize,
}

/// One of the filters.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Filtered {
    /// Edges of the faces read and written.
    pub from: usize,
    pub to: usize,
    /// Roughness of the lobe; none: diffuse.
    pub roughness: Option<f64>,
    /// Cosine at which the lobe ends.
    pub cutoff: f64,
}

impl CubePrefilter {
    /// # Panics
    /// Unless `size` is a power of two from 32 to 256.
    pub fn new(size: usize) -> CubePrefilter {
        assert!(size.is_power_of_two() && (32..=256).contains(&size), "cube prefilter: faces of {size}; expected 32, 64, 128 or 256");
        CubePrefilter { size }
    }

    /// Levels of lobes: down to faces of 16, of 8 for small maps.
    pub fn levels(&self) -> usize {
        let coarsest = if self.size >= 128 { INPUT } else { INPUT / 2 };
        (self.size / coarsest).trailing_zeros() as usize + 1
    }

    /// The light with its mips, and the layout of the lobes: coarser levels than [`CubePrefilter::levels`] are 0 and not looked up.
    pub fn texture(&self) -> Texture {
        Texture { kind: Kind::Cube, filter: Filter::Trilinear, images: 1, size: [self.size; 2], channels: 3 }
    }

    /// The layout of diffuse light.
    pub fn diffuse_texture(&self) -> Texture {
        Texture { kind: Kind::Cube, filter: Filter::Bilinear, images: 1, size: [DIFFUSE; 2], channels: 3 }
    }

    /// Numbers of the light itself.
    pub fn base_len(&self) -> usize {
        18 * self.size * self.size
    }

    /// The filters: diffuse first, then the lobes.
    pub fn filters(&self) -> Vec<Filtered> {
        let lobe = |level: usize| {
            let roughness = roughness_of(level, self.levels()) as f64;
            let from = if level == 0 { self.size } else { INPUT };
            Filtered { from, to: self.size >> level, roughness: Some(roughness), cutoff: lobe_end(roughness) }
        };
        let diffuse = Filtered { from: INPUT, to: DIFFUSE, roughness: None, cutoff: 0.0 };
        std::iter::once(diffuse).chain((0..self.levels()).map(lobe)).collect()
    }
}

impl Filtered {
    /// `k(cosine)`
    pub fn kernel(&self, cosine: f64) -> f64 {
        if cosine <= self.cutoff {
            return 0.0;
        }
        self.roughness.map_or(cosine, |r| cosine * distribution(r * r, 0.5 * (1.0 + cosine)))
    }
}

/// GGX's distribution by the squared cosine to the normal.
fn distribution(alpha: f64, cosine2: f64) -> f64 {
    let q = (1.0 - cosine2) + cosine2 * alpha * alpha;
    alpha * alpha / (std::f64::consts::PI * q * q)
}

/// Cosine that bounds the kept share of `∫ D(h) (n·ω) dω`.
fn lobe_end(roughness: f64) -> f64 {
    const STEPS: usize = 20_000;
    let alpha = roughness * roughness;
    // Steps that are finer near the axis, where narrow lobes are.
    let angle = |i: usize| 0.5 * std::f64::consts::PI * (i as f64 / STEPS as f64).powi(2);
    let mut sums = vec![0.0];
    for i in 0..STEPS {
        let (a, b) = (angle(i), angle(i + 1));
        let c = (0.5 * (a + b)).cos();
        sums.push(sums[i] + distribution(alpha, 0.5 * (1.0 + c)) * c * (a.cos() - b.cos()));
    }
    let kept = KEPT * sums[STEPS];
    angle(sums.partition_point(|s| *s < kept)).cos().max(0.0)
}

/// Unit direction and solid angle of a part of a texel, by its place (s, t) and edge on the face.
fn part(face: usize, s: f64, t: f64, edge: f64) -> ([f64; 3], f64) {
    let d = cube_direction(face, s as f32, t as f32).map(f64::from);
    let square = d.iter().map(|v| v * v).sum::<f64>();
    (d.map(|v| v / square.sqrt()), 4.0 * edge * edge / (square * square.sqrt()))
}

/// Unit direction of a texel's center.
fn center(texel: usize, size: usize) -> [f64; 3] {
    let (face, y, x) = (texel / (size * size), texel / size % size, texel % size);
    part(face, (x as f64 + 0.5) / size as f64, (y as f64 + 0.5) / size as f64, 0.0).0
}

/// Directions and solid angles of a texel's parts.
fn parts(texel: usize, size: usize) -> [([f64; 3], f64); SUBDIVISION * SUBDIVISION] {
    let (face, y, x) = (texel / (size * size), texel / size % size, texel % size);
    let edge = 1.0 / (size * SUBDIVISION) as f64;
    std::array::from_fn(|i| {
        let at = |first: usize, i: usize| ((first * SUBDIVISION + i) as f64 + 0.5) * edge;
        part(face, at(x, i % SUBDIVISION), at(y, i / SUBDIVISION), edge)
    })
}
