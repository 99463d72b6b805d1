//! Tiles of 16² pixels as tasks: each tests its triangles in their order, a row of pixels at a time, and then divides once per pixel.

use super::bins::Bins;
use super::setup::{self, Setup, Span};
use super::{Raster, Rasterize, TILE};
use crate::tasks::{self, Parts};
use crate::vector::{fma, vectorized};

type Row<T> = [T; TILE];

/// What is known about the pixels of a tile.
struct Tile {
    depth: [Row<f32>; TILE],
    ids: [Row<u32>; TILE],
    /// Edge functions of the first two corners, and the sum of all three.
    first: [Row<f32>; TILE],
    second: [Row<f32>; TILE],
    sum: [Row<f32>; TILE],
    /// Depths and ids that hits must come behind.
    front: [Row<f32>; TILE],
    front_ids: [Row<u32>; TILE],
}

/// Larger than every visible depth.
const NOTHING: f32 = 1.0 + f32::EPSILON;
/// Centers of a row of pixels.
const CENTERS: Row<f32> = [0.5, 1.5, 2.5, 3.5, 4.5, 5.5, 6.5, 7.5, 8.5, 9.5, 10.5, 11.5, 12.5, 13.5, 14.5, 15.5];

/// Functions of a triangle relative to a tile's corner.
struct Local {
    x: [f32; 4],
    y: [f32; 4],
    one: [f32; 4],
    /// Smallest value of an edge function that counts as inside: 0 or the next number.
    least: [f32; 3],
    /// Exact edge functions of column and row.
    edge_x: [i32; 3],
    edge_y: [i32; 3],
    edge_one: [i32; 3],
}

/// Beyond what exact edge functions change by within a tile.
const FAR: i64 = 1 << 30;
/// Columns of a row of pixels.
const COLUMNS: Row<i32> = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15];

impl Local {
    #[inline(always)]
    fn new(s: &Setup, corner: [usize; 2]) -> Local {
        let [left, top] = corner.map(|v| v as f64);
        let one = std::array::from_fn(|i| (s.one[i] + s.x[i] * left + s.y[i] * top) as f32);
        let least = std::array::from_fn(|i| if setup::is_top_left(s.x[i], s.y[i]) { 0.0 } else { f32::from_bits(1) });
        let edge_one = std::array::from_fn(|i| {
            let at = s.edge_one[i] + s.edge_x[i] as i64 * corner[0] as i64 + s.edge_y[i] as i64 * corner[1] as i64;
            // Edges that are so far away do not cross the tile.
            at.clamp(-FAR, FAR) as i32
        });
        let Setup { edge_x, edge_y, .. } = *s;
        Local { x: s.x.map(|v| v as f32), y: s.y.map(|v| v as f32), one, least, edge_x, edge_y, edge_one }
    }
}

/// Tests one triangle at the pixels of one row.
#[inline(always)]
fn cover_row<const F: bool, const PEEL: bool, const EXACT: bool>(t: &Local, id: u32, y: usize, tile: &mut Tile) {
    let start: [f32; 4] = std::array::from_fn(|i| fma::<F>(t.y[i], CENTERS[y], t.one[i]));
    let edge: [i32; 3] = std::array::from_fn(|i| t.edge_one[i] + t.edge_y[i] * COLUMNS[y]);
    let (depth, ids) = (&mut tile.depth[y], &mut tile.ids[y]);
    let (first, second, sum) = (&mut tile.first[y], &mut tile.second[y], &mut tile.sum[y]);
    let (front, front_ids) = (&tile.front[y], &tile.front_ids[y]);
    let at = |i: usize, x: usize| fma::<F>(t.x[i], CENTERS[x], start[i]);
    let mut any = 0u32;
    let mut hits = [0u32; TILE];
    for x in 0..TILE {
        let mut hit = if EXACT {
            let [a, b, c] = [0, 1, 2].map(|i| edge[i] + t.edge_x[i] * COLUMNS[x]);
            (a | b | c) >= 0
        } else {
            (at(0, x) >= t.least[0]) & (at(1, x) >= t.least[1]) & (at(2, x) >= t.least[2])
        };
        let z = at(3, x);
        hit &= (z < depth[x]) & (z >= -1.0);
        if PEEL {
            hit &= (z > front[x]) | ((z == front[x]) & (id > front_ids[x]));
        }
        hits[x] = if hit { u32::MAX } else { 0 };
        any |= hits[x];
    }
    if any == 0 {
        return;
    }
    for x in 0..TILE {
        let (a, b, c, z) = (at(0, x), at(1, x), at(2, x), at(3, x));
        let hit = hits[x] != 0;
        depth[x] = if hit { z } else { depth[x] };
        ids[x] = if hit { id } else { ids[x] };
        first[x] = if hit { a } else { first[x] };
        second[x] = if hit { b } else { second[x] };
        sum[x] = if hit { a + b + c } else { sum[x] };
    }
}

#[inline(always)]
fn cover_all<const F: bool, const PEEL: bool>(setups: &[(Setup, Span)], triangles: &[u32], corner: [usize; 2], tile: &mut Tile) {
    for triangle in triangles {
        let (s, span) = &setups[*triangle as usize];
        let local = Local::new(s, corner);
        let top = corner[1] as i32;
        let (first, last) = ((span.first[1] - top).max(0) as usize, (span.last[1] - top).min(TILE as i32 - 1) as usize);
        for y in first..=last {
            if s.is_exact {
                cover_row::<F, PEEL, true>(&local, triangle + 1, y, tile);
            } else {
                cover_row::<F, PEEL, false>(&local, triangle + 1, y, tile);
            }
        }
    }
}

vectorized! {
    /// Tests triangles at the pixels of the tile whose first pixel is `corner` (x, y).
    fn cover<const F>(setups: &[(Setup, Span)], triangles: &[u32], corner: [usize; 2], peel: bool, tile: &mut Tile) {
        if peel {
            cover_all::<F, true>(setups, triangles, corner, tile);
        } else {
            cover_all::<F, false>(setups, triangles, corner, tile);
        }
    }
}

vectorized! {
    /// Divides the edge functions by their sums, and makes depths without a triangle 0.
    fn divide<const F>(tile: &mut Tile) {
        for y in 0..TILE {
            for x in 0..TILE {
                let hit = tile.ids[y][x] != 0;
                let inverse = if hit { 1.0 / tile.sum[y][x] } else { 0.0 };
                tile.first[y][x] *= inverse;
                tile.second[y][x] *= inverse;
                tile.sum[y][x] = inverse;
                tile.depth[y][x] = if hit { tile.depth[y][x] } else { 0.0 };
            }
        }
    }
}

/// `(∂E/∂X − u ∂ΣE/∂X) / ΣE` and the like at the pixels of a row.
fn derive(setups: &[(Setup, Span)], tile: &Tile, y: usize, out: &mut [f32]) {
    for (x, out) in out.as_chunks_mut::<4>().0.iter_mut().enumerate() {
        let Some(triangle) = tile.ids[y][x].checked_sub(1) else {
            *out = [0.0; 4];
            continue;
        };
        let s = &setups[triangle as usize].0;
        let (u, v, inverse) = (tile.first[y][x], tile.second[y][x], tile.sum[y][x]);
        for (k, slopes) in [&s.x, &s.y].into_iter().enumerate() {
            let [a, b, c, _] = slopes.map(|v| v as f32);
            let sum = a + b + c;
            out[k] = (a - u * sum) * inverse;
            out[2 + k] = (b - v * sum) * inverse;
        }
    }
}

/// Writes the pixels of tiles, which are tasks, to the rows of images.
struct Target<'a> {
    ids: Parts<'a, u32>,
    uv: Parts<'a, f32>,
    depth: Parts<'a, f32>,
    derivatives: Option<Parts<'a, f32>>,
}

impl Target<'_> {
    /// Writes row `y` of a tile to the pixels from `start` on.
    ///
    /// # Safety
    /// No other task may write these pixels.
    unsafe fn write(&self, setups: &[(Setup, Span)], tile: &Tile, y: usize, start: usize, columns: usize) {
        let pixels = start..start + columns;
        // SAFETY: as the caller vouches.
        unsafe {
            self.ids.range(pixels.clone()).copy_from_slice(&tile.ids[y][..columns]);
            self.depth.range(pixels.clone()).copy_from_slice(&tile.depth[y][..columns]);
            let uv = self.uv.range(2 * pixels.start..2 * pixels.end);
            for (x, uv) in uv.as_chunks_mut::<2>().0.iter_mut().enumerate().take(TILE) {
                *uv = [tile.first[y][x], tile.second[y][x]];
            }
            if let Some(derivatives) = &self.derivatives {
                derive(setups, tile, y, derivatives.range(4 * pixels.start..4 * pixels.end));
            }
        }
    }
}

/// Nearest triangles, or of those behind the `front` layer the nearest ones.
fn run(r: &Rasterize, positions: &[f32], triangles: &[[u32; 3]], front: Option<&Raster>, derivatives: bool, out: &mut Raster) {
    r.check(positions.len(), triangles);
    let ([h, w], n) = (r.size, r.pixels());
    out.ids.resize(n, 0);
    out.uv.resize(2 * n, 0.0);
    out.depth.resize(n, 0.0);
    out.derivatives.resize(if derivatives { 4 * n } else { 0 }, 0.0);
    let bins = Bins::new(r, positions, triangles);
    let target = Target {
        ids: Parts::new(&mut out.ids),
        uv: Parts::new(&mut out.uv),
        depth: Parts::new(&mut out.depth),
        derivatives: derivatives.then(|| Parts::new(&mut out.derivatives)),
    };
    let (tiles, columns) = (bins.grid[0] * bins.grid[1], bins.grid[1]);
    tasks::run(r.images * tiles, n, |task| {
        let (image, corner) = (task / tiles, [task % columns * TILE, task % tiles / columns * TILE]);
        let setups = &bins.setups[image * triangles.len()..(image + 1) * triangles.len()];
        let bin = &bins.triangles[bins.offsets[task] as usize..bins.offsets[task + 1] as usize];
        let (rows, across) = ((h - corner[1]).min(TILE), (w - corner[0]).min(TILE));
        let pixel = |y: usize| (image * h + corner[1] + y) * w + corner[0];
        let mut tile = Tile::EMPTY;
        if let Some(front) = front {
            for y in 0..rows {
                for x in 0..across {
                    let (id, depth) = (front.ids[pixel(y) + x], front.depth[pixel(y) + x]);
                    tile.front_ids[y][x] = id;
                    tile.front[y][x] = if id == 0 { f32::INFINITY } else { depth };
                }
            }
        }
        if !bin.is_empty() {
            cover(setups, bin, corner, front.is_some(), &mut tile);
        }
        divide(&mut tile);
        for y in 0..rows {
            // SAFETY: each task has pixels of its own.
            unsafe { target.write(setups, &tile, y, pixel(y), across) };
        }
    });
}

impl Tile {
    const EMPTY: Tile = Tile {
        depth: [[NOTHING; TILE]; TILE],
        ids: [[0; TILE]; TILE],
        first: [[0.0; TILE]; TILE],
        second: [[0.0; TILE]; TILE],
        sum: [[0.0; TILE]; TILE],
        front: [[0.0; TILE]; TILE],
        front_ids: [[0; TILE]; TILE],
    };
}

/// Nearest triangle of every pixel. Buffers of `out` are kept between calls.
///
/// # Shapes
/// positions `[N, V, 4]` in clip space, triangles `[F, 3]`, out as [`Raster`] says.
///
/// # Panics
/// When shapes disagree, or a triangle names a vertex that is not there.
pub fn forward(r: &Rasterize, positions: &[f32], triangles: &[[u32; 3]], derivatives: bool, out: &mut Raster) {
    run(r, positions, triangles, None, derivatives, out);
}

/// The next layer behind `front` (depth peeling): the nearest triangle that is farther than the one there, or as far with a higher index.
/// Pixels that show none in `front` show none here.
///
/// # Shapes
/// As [`forward`]; `front` is what it, or this function, gave for the same positions.
///
/// # Panics
/// As [`forward`].
pub fn peel(r: &Rasterize, positions: &[f32], triangles: &[[u32; 3]], front: &Raster, derivatives: bool, out: &mut Raster) {
    assert!(front.ids.len() == r.pixels() && front.depth.len() == r.pixels(), "rasterize: layer in front");
    run(r, positions, triangles, Some(front), derivatives, out);
}
