//! Triangles sorted into tiles: counts per tile and chunk of triangles, prefix sum, fill. Within a tile, triangles keep their order.

use super::setup::{Setup, Span, Vertex};
use super::{Rasterize, TILE};
use crate::math::multiversion;
use crate::tasks::{self, Parts};
use std::mem::MaybeUninit;

/// Triangles per chunk at least.
const CHUNK: usize = 256;
/// Chunks of an image at most.
const CHUNKS: usize = 16;

/// Triangles of each tile of each image.
pub(super) struct Bins {
    /// `[N, F]`
    pub setups: Vec<(Setup, Span)>,
    /// Where the triangles of tile `[n, y, x]` begin, `[N · tiles + 1]`.
    pub offsets: Vec<u32>,
    /// Triangles, tile by tile.
    pub triangles: Vec<u32>,
    /// Tiles along y and x.
    pub grid: [usize; 2],
}

/// Writes all elements of a new vector, in chunks of tasks: `write(first index, chunk)`.
fn collect<T: Send>(n: usize, write: impl Fn(usize, &mut [MaybeUninit<T>]) + Sync) -> Vec<T> {
    let mut all: Vec<T> = Vec::with_capacity(n);
    let parts = Parts::new(&mut all.spare_capacity_mut()[..n]);
    tasks::run(n.div_ceil(CHUNK), 32 * n, |task| {
        // SAFETY: each task has a chunk of its own.
        write(task * CHUNK, unsafe { parts.chunk(task, CHUNK) });
    });
    // SAFETY: the tasks wrote every element.
    unsafe { all.set_len(n) };
    all
}

multiversion! {
    /// Vertices from `first` on.
    fn place(size: [usize; 2], positions: &[f32], first: usize, to: &mut [MaybeUninit<Vertex>]) {
        for (to, p) in to.iter_mut().zip(&positions.as_chunks::<4>().0[first..]) {
            to.write(Vertex::new(*p, size));
        }
    }
}

multiversion! {
    /// Triangles from number `first` of all images on.
    fn set_up(r: &Rasterize, vertices: &[Vertex], triangles: &[[u32; 3]], first: usize, to: &mut [MaybeUninit<(Setup, Span)>]) {
        let f = triangles.len();
        for (i, to) in (first..).zip(to) {
            let image = &vertices[i / f * r.vertices..][..r.vertices];
            to.write(Setup::new(triangles[i % f].map(|v| &image[v as usize]), r.size));
        }
    }
}

impl Bins {
    pub fn new(r: &Rasterize, positions: &[f32], triangles: &[[u32; 3]]) -> Bins {
        let (f, grid) = (triangles.len(), r.size.map(|n| n.div_ceil(TILE)));
        let vertices = collect(r.images * r.vertices, |first, to| place(r.size, positions, first, to));
        let setups = collect(r.images * f, |first, to| set_up(r, &vertices, triangles, first, to));
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
            for (setup, span) in &setups[chunk_of(task).0] {
                span.each_tile(setup, |x, y| counts[y * grid[1] + x] += 1);
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
            for (triangle, (setup, span)) in (first..).zip(&setups[range]) {
                span.each_tile(setup, |x, y| {
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
