//! Slice by slice with shared vertices. Which points are inside is kept as bits, so that the many cells without surface cost a few
//! operations per 64 of them.

use super::CaseTable;
use rayon::prelude::*;

/// Slices that are pushed into one mesher where a whole grid is at hand.
const SLAB: usize = 16;

/// Collects a surface from slices of density pushed in order of z.
pub struct Mesher<'a> {
    nx: usize,
    ny: usize,
    level: f32,
    table: &'a CaseTable,
    z: usize,
    /// Place of the first slice.
    first_z: usize,
    below: Slice,
    above: Slice,
    /// Vertices on the edges of each direction from the slice below to that above; only those that the surface cuts are set.
    between: [Vec<u32>; 4],
    /// Vertex positions in grid coordinates (x, y, z).
    pub positions: Vec<[f32; 3]>,
    pub faces: Vec<[u32; 3]>,
}

#[derive(Default)]
struct Slice {
    values: Vec<f32>,
    /// Which points lie inside, `[ny, words]`.
    inside: Vec<u64>,
    /// Vertices on the edges of each direction within the slice; only those that the surface cuts are set.
    within: [Vec<u32>; 3],
}

impl<'a> Mesher<'a> {
    /// For slices of `ny` rows of `nx` values, cut by `table`.
    pub fn new(table: &'a CaseTable, nx: usize, ny: usize, level: f32) -> Self {
        let room = |d: usize| vec![0; if table.directions.contains(&d) { nx * ny } else { 0 }];
        let slice = || Slice { within: std::array::from_fn(|k| room(k + 1)), ..Slice::default() };
        let between = std::array::from_fn(|k| room(k + 4));
        let (below, above) = (slice(), slice());
        Mesher { nx, ny, level, table, z: 0, first_z: 0, below, above, between, positions: Vec::new(), faces: Vec::new() }
    }

    /// Adds the next slice, `[ny, nx]`.
    ///
    /// # Panics
    /// When the slice has another size, or more than 2³² − 1 vertices arise.
    pub fn push(&mut self, values: &[f32]) {
        assert_eq!(values.len(), self.nx * self.ny, "marching cubes: slice");
        std::mem::swap(&mut self.below, &mut self.above);
        let (nx, words) = (self.nx, self.words());
        let s = &mut self.above;
        s.values.clear();
        s.values.extend_from_slice(values);
        s.inside.clear();
        for row in values.chunks_exact(nx) {
            for part in row.chunks(64) {
                s.inside.push(part.iter().enumerate().fold(0, |bits, (k, v)| bits | ((*v > self.level) as u64) << k));
            }
        }
        debug_assert_eq!(s.inside.len(), words * self.ny);
        self.cut_edges();
        if self.z > 0 {
            self.connect();
        }
        self.z += 1;
    }

    fn words(&self) -> usize {
        self.nx.div_ceil(64)
    }

    /// Bits of the points one further along x than those of a word.
    fn shifted(inside: &[u64], row: usize, words: usize, k: usize) -> u64 {
        let next = if k + 1 < words { inside[row + k + 1] } else { 0 };
        inside[row + k] >> 1 | next << 63
    }

    /// Bits of a row's word that have a point further along x.
    fn has_next(&self, k: usize) -> u64 {
        let left = (self.nx - 1).saturating_sub(k * 64);
        if left >= 64 { u64::MAX } else { (1 << left) - 1 }
    }

    /// Vertices on the newest slice's own edges and on those from the slice below.
    fn cut_edges(&mut self) {
        let (nx, ny, level, words) = (self.nx, self.ny, self.level, self.words());
        let directions: Vec<usize> = self.table.directions.iter().copied().filter(|d| d & 4 == 0 || self.z > 0).collect();
        for y in 0..ny {
            for k in 0..words {
                // Bits of the points from which an edge of each direction is cut.
                let (mut cut, mut any) = ([0u64; 8], 0);
                for &d in &directions {
                    if d & 2 != 0 && y + 1 == ny {
                        continue;
                    }
                    let from = if d & 4 == 0 { &self.above.inside } else { &self.below.inside };
                    let row = (y + (d >> 1 & 1)) * words;
                    let to = if d & 1 == 0 { self.above.inside[row + k] } else { Self::shifted(&self.above.inside, row, words, k) };
                    cut[d] = (from[y * words + k] ^ to) & if d & 1 == 0 { u64::MAX } else { self.has_next(k) };
                    any |= cut[d];
                }
                while any != 0 {
                    let bit = any.trailing_zeros();
                    any &= any - 1;
                    let x = k * 64 + bit as usize;
                    let i = y * nx + x;
                    for &d in directions.iter().filter(|d| cut[**d] >> bit & 1 == 1) {
                        let from = if d & 4 == 0 { &self.above } else { &self.below };
                        let (a, b) = (from.values[i], self.above.values[i + (d & 1) + nx * (d >> 1 & 1)]);
                        let low = self.first_z + self.z - (d >> 2);
                        let mut p = [x as f32, y as f32, low as f32];
                        let along = (level - a) / (b - a);
                        (0..3).filter(|axis| d >> axis & 1 == 1).for_each(|axis| p[axis] += along);
                        self.positions.push(p);
                        let id = u32::try_from(self.positions.len() - 1).expect("fewer than 2^32 vertices");
                        if d & 4 == 0 {
                            self.above.within[d - 1][i] = id;
                        } else {
                            self.between[d - 4][i] = id;
                        }
                    }
                }
            }
        }
    }

    /// Faces of the cells between the two slices.
    fn connect(&mut self) {
        let (nx, words) = (self.nx, self.words());
        let slices = [&self.below, &self.above];
        for y in 0..self.ny.saturating_sub(1) {
            for k in 0..words {
                // Bit c of the case is corner c: x, y, z.
                let mut corners = [0u64; 8];
                for (c, bits) in corners.iter_mut().enumerate() {
                    let inside = &slices[c >> 2].inside;
                    let row = (y + (c >> 1 & 1)) * words;
                    *bits = if c & 1 == 1 { Self::shifted(inside, row, words, k) } else { inside[row + k] };
                }
                let any = corners.iter().fold(0, |a, b| a | b);
                let all = corners.iter().fold(u64::MAX, |a, b| a & b);
                let mut cells = any & !all & self.has_next(k);
                while cells != 0 {
                    let bit = cells.trailing_zeros();
                    cells &= cells - 1;
                    let case = corners.iter().enumerate().fold(0, |n, (c, bits)| n | ((bits >> bit & 1) as usize) << c);
                    let i = y * nx + k * 64 + bit as usize;
                    for t in &self.table.triangles[case] {
                        self.faces.push(t.map(|e| {
                            let at = i + (e.corner & 1) + nx * (e.corner >> 1 & 1);
                            if e.direction & 4 == 0 {
                                slices[e.corner >> 2].within[e.direction - 1][at]
                            } else {
                                self.between[e.direction - 4][at]
                            }
                        }));
                    }
                }
            }
        }
    }

    /// Vertices on the newest slice in the order of its edges.
    fn top(&self) -> Vec<u32> {
        let (nx, words, s) = (self.nx, self.words(), &self.above);
        let mut out = Vec::new();
        let inside = |i: usize| s.inside[i / nx * words + i % nx / 64] >> (i % nx % 64) & 1;
        for i in 0..s.values.len() {
            for &d in self.table.directions.iter().filter(|d| **d < 4) {
                let fits = (d & 1 == 0 || i % nx + 1 < nx) && (d & 2 == 0 || i + nx < s.values.len());
                if fits && inside(i) != inside(i + (d & 1) + nx * (d >> 1)) {
                    out.push(s.within[d - 1][i]);
                }
            }
        }
        out
    }
}

/// Vertices in grid coordinates and faces of the surface in a whole grid `[nz, ny, nx]`; the same at any number of threads.
///
/// # Panics
/// When the grid has another size.
pub fn surface(table: &CaseTable, grid: &[f32], [nx, ny, nz]: [usize; 3], level: f32) -> (Vec<[f32; 3]>, Vec<[u32; 3]>) {
    assert_eq!(grid.len(), nx * ny * nz, "marching cubes: grid");
    let slice = |z: usize| &grid[z * nx * ny..(z + 1) * nx * ny];
    // Slabs share a slice: its vertices come from the slab below.
    let slab = |z0: usize| {
        let mut m = Mesher { first_z: z0, ..Mesher::new(table, nx, ny, level) };
        m.push(slice(z0));
        let shared = m.positions.len();
        (z0 + 1..(z0 + SLAB + 1).min(nz)).for_each(|z| m.push(slice(z)));
        let top = m.top();
        (m.positions, m.faces, shared, top)
    };
    let starts: Vec<usize> = (0..nz.saturating_sub(1)).step_by(SLAB).collect();
    let (mut positions, mut faces): (Vec<[f32; 3]>, Vec<[u32; 3]>) = (Vec::new(), Vec::new());
    let mut below: Vec<u32> = Vec::new();
    // A few slabs at a time, so that few unjoined vertices are in memory.
    for starts in starts.chunks(rayon::current_num_threads() * 2) {
        let slabs: Vec<_> = starts.par_iter().map(|z| slab(*z)).collect();
        for (own, own_faces, shared, top) in slabs {
            let first = positions.len();
            // The first slice's vertices arise in the order of its edges, which is that of the slab below.
            let skipped = below.len();
            debug_assert!(skipped == 0 || skipped == shared);
            let at = |i: u32| if (i as usize) < skipped { below[i as usize] } else { i - skipped as u32 + first as u32 };
            faces.extend(own_faces.iter().map(|f| f.map(at)));
            let above: Vec<u32> = top.into_iter().map(at).collect();
            positions.extend(&own[skipped..]);
            below = above;
        }
    }
    (positions, faces)
}
