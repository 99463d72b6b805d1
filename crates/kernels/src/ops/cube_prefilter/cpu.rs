//! Sparse matrices, computed once, with their transposes.

use super::{CubePrefilter, Filtered, center, parts};
use crate::ops::texture::{Texture, mips};
use rayon::prelude::*;

/// Rows per task.
const ROWS: usize = 256;
/// Edge of the squares of texels that are skipped together, for inputs at least as large.
const SQUARE: usize = 4;

/// Weights by rows.
#[derive(Clone, Debug, Default)]
struct Sparse {
    offsets: Vec<u32>,
    entries: Vec<(u32, f32)>,
}

impl Sparse {
    fn of_rows(rows: Vec<Vec<(u32, f32)>>) -> Sparse {
        let mut offsets = vec![0u32];
        offsets.extend(rows.iter().scan(0, |sum, row| {
            *sum += row.len() as u32;
            Some(*sum)
        }));
        Sparse { offsets, entries: rows.into_iter().flatten().collect() }
    }

    fn transposed(&self, columns: usize) -> Sparse {
        let mut offsets = vec![0u32; columns + 1];
        self.entries.iter().for_each(|(j, _)| offsets[*j as usize + 1] += 1);
        (0..columns).for_each(|j| offsets[j + 1] += offsets[j]);
        let (mut next, mut entries) = (offsets.clone(), vec![(0, 0.0); self.entries.len()]);
        for (i, at) in self.offsets.windows(2).enumerate() {
            for (j, w) in &self.entries[at[0] as usize..at[1] as usize] {
                entries[next[*j as usize] as usize] = (i as u32, *w);
                next[*j as usize] += 1;
            }
        }
        Sparse { offsets, entries }
    }

    /// `out[i] = Σ w x[j]`, added to what is there if `adds`; three channels.
    fn multiply(&self, x: &[f32], out: &mut [f32], adds: bool) {
        let x = x.as_chunks::<3>().0;
        out.par_chunks_mut(3 * ROWS).enumerate().for_each(|(b, out)| {
            for (r, out) in out.as_chunks_mut::<3>().0.iter_mut().enumerate() {
                let i = b * ROWS + r;
                let mut sum = if adds { *out } else { [0.0; 3] };
                for (j, w) in &self.entries[self.offsets[i] as usize..self.offsets[i + 1] as usize] {
                    let x = x[*j as usize];
                    (0..3).for_each(|k| sum[k] += w * x[k]);
                }
                *out = sum;
            }
        });
    }
}

/// The filters of a map's size.
#[derive(Clone, Debug)]
pub struct Prefilter {
    pub shape: CubePrefilter,
    filters: Vec<(Filtered, Sparse, Sparse)>,
}

/// Blurred light, in the layouts of [`CubePrefilter::diffuse_texture`] and [`CubePrefilter::texture`].
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Blurred {
    pub diffuse: Vec<f32>,
    pub specular: Vec<f32>,
}

impl Prefilter {
    /// Computes the weights.
    pub fn new(shape: CubePrefilter) -> Prefilter {
        let of = |f: Filtered| {
            let rows = matrix(&f);
            let back = rows.transposed(6 * f.from * f.from);
            (f, rows, back)
        };
        Prefilter { shape, filters: shape.filters().into_iter().map(of).collect() }
    }

    /// Blurs light.
    ///
    /// # Shapes
    /// base `[6, size, size, 3]`.
    ///
    /// # Panics
    /// When the shape differs.
    pub fn forward(&self, base: &[f32], out: &mut Blurred) {
        assert_eq!(base.len(), self.shape.base_len(), "cube prefilter: light");
        let texture = self.shape.texture();
        let mut mipped = vec![0.0; texture.numbers()];
        mipped[..base.len()].copy_from_slice(base);
        mips::forward(&texture, &mut mipped);
        out.diffuse.resize(self.shape.diffuse_texture().numbers(), 0.0);
        out.specular.resize(texture.numbers(), 0.0);
        for (f, rows, _) in &self.filters {
            let to = if f.roughness.is_none() { &mut out.diffuse[..] } else { &mut out.specular[level(&texture, f.to)] };
            rows.multiply(&mipped[level(&texture, f.from)], to, false);
        }
    }

    /// Gradient of the light, overwritten, for gradients of what is blurred.
    ///
    /// # Panics
    /// When shapes differ.
    pub fn backward(&self, d: &Blurred, d_base: &mut [f32]) {
        let texture = self.shape.texture();
        assert!(d_base.len() == self.shape.base_len() && d.specular.len() == texture.numbers(), "cube prefilter: gradients");
        assert_eq!(d.diffuse.len(), self.shape.diffuse_texture().numbers(), "cube prefilter: gradients");
        let mut mipped = vec![0.0; texture.numbers()];
        for (f, _, back) in &self.filters {
            let from = if f.roughness.is_none() { &d.diffuse[..] } else { &d.specular[level(&texture, f.to)] };
            back.multiply(from, &mut mipped[level(&texture, f.from)], true);
        }
        mips::backward(&texture, &mut mipped);
        d_base.copy_from_slice(&mipped[..d_base.len()]);
    }
}

/// Numbers of the level whose faces have an edge of `size`.
fn level(texture: &Texture, size: usize) -> std::ops::Range<usize> {
    let levels = texture.levels();
    let found = levels.iter().find(|l| l.size[0] == size).expect("a level of the map");
    3 * found.first..3 * (found.first + 6 * size * size)
}

/// Normalized weights of a filter.
fn matrix(f: &Filtered) -> Sparse {
    let (from, square) = (f.from, SQUARE.min(f.from));
    let texels: Vec<_> = (0..6 * from * from).map(|j| parts(j, from)).collect();
    let across = from / square;
    let end = f.cutoff.acos();
    // Squares of texels: center, and the least cosine to it of directions whose lobe may reach a point of the square.
    let squares: Vec<([f64; 3], f64, Vec<u32>)> = (0..6 * across * across)
        .map(|q| {
            let (face, y, x) = (q / (across * across), q / across % across, q % across);
            let inside: Vec<u32> =
                (0..square * square).map(|i| ((face * from + y * square + i / square) * from + x * square + i % square) as u32).collect();
            let middle = center(q, across);
            let least = inside.iter().flat_map(|j| texels[*j as usize]).map(|(d, _)| dot(d, middle)).fold(1.0, f64::min);
            (middle, (end + least.min(1.0).acos()).min(std::f64::consts::PI).cos(), inside)
        })
        .collect();
    let row = |i: usize| {
        let n = center(i, f.to);
        let mut row = Vec::new();
        for (middle, reach, inside) in &squares {
            if dot(n, *middle) < *reach - 1e-9 {
                continue;
            }
            for j in inside {
                let w: f64 = texels[*j as usize].iter().map(|(d, solid)| f.kernel(dot(n, *d)) * solid).sum();
                if w > 0.0 {
                    row.push((*j, w));
                }
            }
        }
        let sum: f64 = row.iter().map(|(_, w)| w).sum();
        row.into_iter().map(|(j, w)| (j, (w / sum) as f32)).collect::<Vec<_>>()
    };
    Sparse::of_rows((0..6 * f.to * f.to).into_par_iter().with_min_len(16).map(row).collect())
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}
