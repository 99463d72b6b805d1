//! Slice by slice with shared vertices. Which points are inside is kept as bits, so that the many cells without surface cost a few
//! operations per 64 of them.

use super::{case_table, edge_corners};
use rayon::prelude::*;

/// Slices that are pushed into one mesher where a whole grid is at hand.
const SLAB: usize = 16;

/// Collects a surface from slices of density pushed in order of z.
pub struct Mesher {
    nx: usize,
    ny: usize,
    level: f32,
    table: Vec<Vec<[u8; 3]>>,
    z: usize,
    /// Place of the first slice.
    first_z: usize,
    below: Slice,
    above: Slice,
    /// Vertices on the edges between the last two slices; only those that the surface cuts are set.
    z_edges: Vec<u32>,
    /// Vertex positions in grid coordinates (x, y, z).
    pub positions: Vec<[f32; 3]>,
    pub faces: Vec<[u32; 3]>,
}

#[derive(Default)]
struct Slice {
    values: Vec<f32>,
    /// Which points lie inside, `[ny, words]`.
    inside: Vec<u64>,
    /// Vertices on the slice's x and y edges; only those that the surface cuts are set.
    x_edges: Vec<u32>,
    y_edges: Vec<u32>,
}

impl Slice {
    fn new(n: usize) -> Self {
        Slice { x_edges: vec![0; n], y_edges: vec![0; n], ..Slice::default() }
    }
}

impl Mesher {
    /// For slices of `ny` rows of `nx` values.
    pub fn new(nx: usize, ny: usize, level: f32) -> Self {
        let (below, above, z_edges) = (Slice::new(nx * ny), Slice::new(nx * ny), vec![0; nx * ny]);
        Mesher { nx, ny, level, table: case_table(), z: 0, first_z: 0, below, above, z_edges, positions: Vec::new(), faces: Vec::new() }
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

    /// Vertices on the newest slice's own edges and on those down to the slice below.
    fn cut_edges(&mut self) {
        let (nx, ny, z, level, words) = (self.nx, self.ny, self.z, self.level, self.words());
        for y in 0..ny {
            for k in 0..words {
                let row = y * words;
                let here = self.above.inside[row + k];
                let along_x = (here ^ Self::shifted(&self.above.inside, row, words, k)) & self.has_next(k);
                let along_y = if y + 1 < ny { here ^ self.above.inside[row + words + k] } else { 0 };
                let along_z = if z > 0 { here ^ self.below.inside[row + k] } else { 0 };
                let mut cut = along_x | along_y | along_z;
                while cut != 0 {
                    let bit = cut.trailing_zeros();
                    cut &= cut - 1;
                    let x = k * 64 + bit as usize;
                    let i = y * nx + x;
                    let s = &mut self.above;
                    let (base, a) = ([x as f32, y as f32, (self.first_z + z) as f32], s.values[i]);
                    let positions = &mut self.positions;
                    let mut vertex = |axis: usize, a: f32, b: f32, mut p: [f32; 3]| {
                        p[axis] += (level - a) / (b - a);
                        positions.push(p);
                        u32::try_from(positions.len() - 1).expect("fewer than 2^32 vertices")
                    };
                    if along_x >> bit & 1 == 1 {
                        s.x_edges[i] = vertex(0, a, s.values[i + 1], base);
                    }
                    if along_y >> bit & 1 == 1 {
                        s.y_edges[i] = vertex(1, a, s.values[i + nx], base);
                    }
                    if along_z >> bit & 1 == 1 {
                        self.z_edges[i] = vertex(2, self.below.values[i], a, [base[0], base[1], base[2] - 1.0]);
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
                    for t in &self.table[case] {
                        self.faces.push(t.map(|e| {
                            let (c, _) = edge_corners(e as usize);
                            let at = i + (c & 1) + nx * ((c >> 1) & 1);
                            match e / 4 {
                                0 => slices[c >> 2].x_edges[at],
                                1 => slices[c >> 2].y_edges[at],
                                _ => self.z_edges[at],
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
        for i in 0..s.values.len() {
            let inside = |i: usize| s.inside[i / nx * words + i % nx / 64] >> (i % nx % 64) & 1;
            if i % nx + 1 < nx && inside(i) != inside(i + 1) {
                out.push(s.x_edges[i]);
            }
            if i + nx < s.values.len() && inside(i) != inside(i + nx) {
                out.push(s.y_edges[i]);
            }
        }
        out
    }
}

/// Vertices in grid coordinates and faces of the surface in a whole grid `[nz, ny, nx]`; the same at any number of threads.
///
/// # Panics
/// When the grid has another size.
pub fn surface(grid: &[f32], [nx, ny, nz]: [usize; 3], level: f32) -> (Vec<[f32; 3]>, Vec<[u32; 3]>) {
    assert_eq!(grid.len(), nx * ny * nz, "marching cubes: grid");
    let slice = |z: usize| &grid[z * nx * ny..(z + 1) * nx * ny];
    // Slabs share a slice: its vertices come from the slab below.
    let slab = |z0: usize| {
        let mut m = Mesher { first_z: z0, ..Mesher::new(nx, ny, level) };
        m.push(slice(z0));
        let shared = m.positions.len();
        (z0 + 1..(z0 + SLAB + 1).min(nz)).for_each(|z| m.push(slice(z)));
        let top = m.top();
        (m.positions, m.faces, shared, top)
    };
    let starts: Vec<usize> = (0..nz.saturating_sub(1)).step_by(SLAB).collect();
    let (mut positions, mut faces): (Vec<[f32; 3]>, Vec<[u32; 3]>) = (Vec::new(), Vec::new());
    let mut below: Vec<u32> = Vec::new();
    // A few slabs at a time: what waits to be joined stays small.
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
