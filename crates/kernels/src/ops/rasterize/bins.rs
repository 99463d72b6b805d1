//! Triangles sorted into tiles: counts per tile and chunk of triangles, prefix sum, fill. Within a tile, triangles keep their order.

use super::setup::Setup;
use super::{Rasterize, TILE};
use crate::tasks::{self, Parts};

/// Triangles per chunk at least.
const CHUNK: usize = 256;
/// Chunks of an image at most.
const CHUNKS: usize = 16;

/// Triangles of each tile of each image.
pub(super) struct Bins {
    /// `[N, F]`
    pub setups: Vec<Setup>,
    /// Where the triangles of tile `[n, y, x]` begin, `[N · tiles + 1]`.
    pub offsets: Vec<u32>,
    /// Triangles, tile by tile.
    pub triangles: Vec<u32>,
    /// Tiles along y and x.
    pub grid: [usize; 2],
}

fn setups(r: &Rasterize, positions: &[f32], triangles: &[[u32; 3]]) -> Vec<Setup> {
    let (n, f) = (r.images * triangles.len(), triangles.len());
    let mut setups: Vec<Setup> = Vec::with_capacity(n);
    let parts = Parts::new(&mut setups.spare_capacity_mut()[..n]);
    tasks::run(n.div_ceil(CHUNK), 32 * n, |task| {
        // SAFETY: each task has a chunk of its own.
        let setups = unsafe { parts.chunk(task, CHUNK) };
        for (i, setup) in (task * CHUNK..).zip(setups) {
            let vertices = &positions[i / f * r.vertices * 4..][..r.vertices * 4];
            setup.write(Setup::new(triangles[i % f].map(|v| std::array::from_fn(|k| vertices[4 * v as usize + k])), r.size));
        }
    });
    // SAFETY: the tasks wrote every element.
    unsafe { setups.set_len(n) };
    setups
}

impl Bins {
    pub fn new(r: &Rasterize, positions: &[f32], triangles: &[[u32; 3]]) -> Bins {
        let (f, grid) = (triangles.len(), r.size.map(|n| n.div_ceil(TILE)));
        let setups = setups(r, positions, triangles);
        let tiles = grid[0] * grid[1];
        let per_chunk = f.div_ceil(CHUNKS).max(CHUNK);
        let chunks = f.div_ceil(per_chunk);
        // [N, chunk, tile]
        let mut counts = vec![0u32; r.images * chunks * tiles];
        let parts = Parts::new(&mut counts);
        let chunk_of = |task: usize| {
            let first = task % chunks * per_chunk;
            (task / chunks * f + first..task / chunks * f + (first + per_chunk).min(f), first)
        };
        tasks::run(r.images * chunks, 32 * setups.len(), |task| {
            // SAFETY: each task has a chunk of its own.
            let counts = unsafe { parts.chunk(task, tiles) };
            for setup in &setups[chunk_of(task).0] {
                setup.each_tile(|x, y| counts[y * grid[1] + x] += 1);
            }
        });
        let mut offsets = Vec::with_capacity(r.images * tiles + 1);
        let mut sum = 0u32;
        for image in 0..r.images {
            for tile in 0..tiles {
                offsets.push(sum);
                for chunk in 0..chunks {
                    let count = &mut counts[(image * chunks + chunk) * tiles + tile];
                    let first = sum;
                    sum = sum.checked_add(*count).expect("rasterize: fewer than 2^32 triangles in all tiles");
                    *count = first;
                }
            }
        }
        offsets.push(sum);
        let mut sorted = vec![0u32; sum as usize];
        let (to, nexts) = (Parts::new(&mut sorted), Parts::new(&mut counts));
        tasks::run(r.images * chunks, 32 * setups.len(), |task| {
            // SAFETY: each task has a chunk of its own.
            let next = unsafe { nexts.chunk(task, tiles) };
            let (range, first) = chunk_of(task);
            for (triangle, setup) in (first..).zip(&setups[range]) {
                setup.each_tile(|x, y| {
                    let at = &mut next[y * grid[1] + x];
                    let place = *at as usize..*at as usize + 1;
                    // SAFETY: the counts give every chunk and tile places of their own.
                    unsafe { to.range(place) }.fill(triangle as u32);
                    *at += 1;
                });
            }
        });
        Bins { setups, offsets, triangles: sorted, grid }
    }
}
