//! Attention on the CPU, in tiles of 64 queries by up to 512 keys. Tiles are transposed, so that vectors run along queries.

use super::Attention;
use crate::gemm::{Gemm, Init, Precision, View, gemm};
use crate::tasks::{self, Parts};
use crate::vector::{exp, vectorized};

/// Queries per tile.
const QUERIES: usize = 64;
/// Keys per tile, at most.
const KEYS: usize = 512;
/// Wanted number of backward tasks: with a smaller batch, queries are split into groups to reach it.
const TASKS: usize = 8;

/// `c = a b`, or `c += a b` with `add`: a `[m, k]`, b `[k, n]`, c `[m, n]`; b and c are row-major.
fn product([m, n, k]: [usize; 3], a: View, b: &[f32], c: &mut [f32], add: bool) {
    gemm(Precision::F32, Gemm { m, n, k, a, b, ldb: n, ldc: n, init: if add { Init::Accumulate } else { Init::Zero }, relu: false }, c);
}

/// Transposed view of a tile `[keys, QUERIES]`.
fn turned(tile: &[f32]) -> View<'_> {
    View { data: tile, row: 1, col: QUERIES }
}

/// `out[c, i] = scale · x[i, c]` for `i < QUERIES`, 0 beyond the last row of `x`.
fn transpose(width: usize, scale: f32, x: &[f32], out: &mut [f32]) {
    out.fill(0.0);
    for (i, row) in x.chunks_exact(width).enumerate() {
        for (c, v) in row.iter().enumerate() {
            out[c * QUERIES + i] = scale * v;
        }
    }
}

vectorized! {
    /// One step of the online softmax of columns: updates the maxima `most`, then `tile ← e^(tile − most)`; `shrink` is the factor that
    /// rescales earlier sums and outputs to the new maxima.
    fn exponentials<const F>(tile: &mut [f32], most: &mut [f32; QUERIES], sums: &mut [f32; QUERIES], shrink: &mut [f32; QUERIES]) {
        let before = *most;
        let mut top = *most;
        for row in tile.chunks_exact(QUERIES) {
            for i in 0..QUERIES {
                top[i] = if row[i] > top[i] { row[i] } else { top[i] };
            }
        }
        let mut total = [0.0f32; QUERIES];
        for row in tile.chunks_exact_mut(QUERIES) {
            for i in 0..QUERIES {
                row[i] = exp::<F>(row[i] - top[i]);
                total[i] += row[i];
            }
        }
        for i in 0..QUERIES {
            shrink[i] = exp::<F>(before[i] - top[i]);
            sums[i] = sums[i] * shrink[i] + total[i];
        }
        *most = top;
    }
}

vectorized! {
    /// `tile ← e^(tile − log_sums)`
    fn weights<const F>(tile: &mut [f32], log_sums: &[f32; QUERIES]) {
        for row in tile.chunks_exact_mut(QUERIES) {
            for i in 0..QUERIES {
                row[i] = exp::<F>(row[i] - log_sums[i]);
            }
        }
    }
}

vectorized! {
    /// `tile ← tile (along − mean) scale`
    fn gradients<const F>(tile: &mut [f32], along: &[f32], mean: &[f32; QUERIES], scale: f32) {
        for (row, along) in tile.chunks_exact_mut(QUERIES).zip(along.chunks_exact(QUERIES)) {
            for i in 0..QUERIES {
                row[i] *= (along[i] - mean[i]) * scale;
            }
        }
    }
}

/// Causal mask: sets the scores of keys after their query to −∞.
fn hide(tile: &mut [f32], first_query: usize, first_key: usize) {
    for (j, row) in tile.chunks_exact_mut(QUERIES).enumerate() {
        let hidden = (first_key + j).saturating_sub(first_query).min(QUERIES);
        row[..hidden].fill(f32::NEG_INFINITY);
    }
}

impl Attention {
    fn check(&self, [q, k, v, out]: [usize; 4], log_sums: usize) {
        let (queries, keys) = (self.batch * self.queries, self.batch * self.keys);
        assert!(q == queries * self.width && out == q && log_sums == queries, "attention: queries");
        assert!(k == keys * self.width && v == k, "attention: keys");
        assert!(self.keys > 0 || queries == 0, "attention: no keys");
    }

    /// Tiles of keys that a tile of queries sees.
    fn key_tiles(&self, first_query: usize, rows: usize) -> impl Iterator<Item = std::ops::Range<usize>> {
        let end = if self.causal { (first_query + rows).min(self.keys) } else { self.keys };
        (0..end).step_by(KEYS).map(move |first| first..(first + KEYS).min(end))
    }

    fn tile_keys(&self) -> usize {
        KEYS.min(self.keys)
    }
}

/// Computes the output, and the logarithm of each query's sum of exponentials, which [`backward`] needs.
///
/// # Shapes
/// q, out `[batch, queries, width]`; k, v `[batch, keys, width]`; log_sums `[batch, queries]`.
pub fn forward(a: &Attention, q: &[f32], k: &[f32], v: &[f32], out: &mut [f32], log_sums: &mut [f32]) {
    a.check([q.len(), k.len(), v.len(), out.len()], log_sums.len());
    if out.is_empty() {
        return;
    }
    let (d, tiles) = (a.width, a.queries.div_ceil(QUERIES));
    let (parts, log_sums) = (Parts::new(out), Parts::new(log_sums));
    tasks::run(a.batch * tiles, a.batch * a.queries * a.keys, |task| {
        let (batch, first) = (task / tiles, task % tiles * QUERIES);
        let rows = QUERIES.min(a.queries - first);
        let at = batch * a.queries + first;
        // SAFETY: each task has queries of its own.
        let (out, log_sums) = unsafe { (parts.range(at * d..(at + rows) * d), log_sums.range(at..at + rows)) };
        let keys = batch * a.keys * d..(batch + 1) * a.keys * d;
        forward_tile(a, first, &q[at * d..][..rows * d], &k[keys.clone()], &v[keys], out, log_sums);
    });
}

fn forward_tile(a: &Attention, first: usize, q: &[f32], k: &[f32], v: &[f32], out: &mut [f32], log_sums: &mut [f32]) {
    let (d, rows) = (a.width, log_sums.len());
    let (mut most, mut sums, mut shrink) = ([f32::NEG_INFINITY; QUERIES], [0.0; QUERIES], [0.0; QUERIES]);
    tasks::with_buffer((d + a.tile_keys()) * QUERIES, |buffer| {
        let (columns, tile) = buffer.split_at_mut(d * QUERIES);
        transpose(d, a.scale, q, columns);
        for keys in a.key_tiles(first, rows) {
            let tile = &mut tile[..keys.len() * QUERIES];
            let span = keys.start * d..keys.end * d;
            product([keys.len(), QUERIES, d], View::rows(&k[span.clone()], d), columns, tile, false);
            if a.causal {
                hide(tile, first, keys.start);
            }
            exponentials(tile, &mut most, &mut sums, &mut shrink);
            if keys.start > 0 {
                for (out, s) in out.chunks_exact_mut(d).zip(&shrink) {
                    out.iter_mut().for_each(|o| *o *= s);
                }
            }
            product([rows, d, keys.len()], turned(tile), &v[span], out, keys.start > 0);
        }
    });
    for ((out, log_sum), (most, sum)) in out.chunks_exact_mut(d).zip(log_sums).zip(most.iter().zip(&sums)) {
        out.iter_mut().for_each(|o| *o /= sum);
        *log_sum = most + sum.ln();
    }
}

/// Inputs and outputs of [`forward`], and the gradient `d_out` of its output.
#[derive(Clone, Copy)]
pub struct Saved<'a> {
    pub q: &'a [f32],
    pub k: &'a [f32],
    pub v: &'a [f32],
    pub out: &'a [f32],
    pub log_sums: &'a [f32],
    pub d_out: &'a [f32],
}

/// Overwrites `dq`, `dk` and `dv` with the gradients of q, k and v. `scratch` is resized as needed and can be reused.
///
/// # Shapes
/// As in [`forward`].
pub fn backward(a: &Attention, s: &Saved, dq: &mut [f32], dk: &mut [f32], dv: &mut [f32], scratch: &mut Vec<f32>) {
    a.check([s.q.len(), s.k.len(), s.v.len(), s.out.len()], s.log_sums.len());
    a.check([dq.len(), dk.len(), dv.len(), s.d_out.len()], s.log_sums.len());
    dk.fill(0.0);
    dv.fill(0.0);
    if dq.is_empty() {
        return;
    }
    let (d, size, tiles) = (a.width, a.keys * a.width, a.queries.div_ceil(QUERIES));
    let groups = TASKS.div_ceil(a.batch).min(tiles);
    let per_group = tiles.div_ceil(groups) * QUERIES;
    // Every group except the first accumulates gradients of keys and values in `scratch`.
    let extra = groups - 1;
    scratch.resize(2 * a.batch * extra * size, 0.0);
    scratch.fill(0.0);
    let (dqs, dks, dvs, own) = (Parts::new(dq), Parts::new(dk), Parts::new(dv), Parts::new(scratch));
    tasks::run(a.batch * groups, a.batch * a.queries * a.keys, |task| {
        let (batch, group) = (task / groups, task % groups);
        // SAFETY: each task has gradients of its own.
        let (dk, dv) = unsafe {
            match group {
                0 => (dks.chunk(batch, size), dvs.chunk(batch, size)),
                _ => own.chunk(batch * extra + group - 1, 2 * size).split_at_mut(size),
            }
        };
        for first in (group * per_group..((group + 1) * per_group).min(a.queries)).step_by(QUERIES) {
            let (at, rows) = (batch * a.queries + first, QUERIES.min(a.queries - first));
            // SAFETY: as above.
            let dq = unsafe { dqs.range(at * d..(at + rows) * d) };
            backward_tile(a, s, (batch, first), dq, dk, dv);
        }
    });
    for (batch, partial) in scratch.chunks_exact(2 * size).enumerate().map(|(i, p)| (i / extra, p)) {
        let span = batch * size..(batch + 1) * size;
        dk[span.clone()].iter_mut().zip(partial).for_each(|(o, p)| *o += p);
        dv[span].iter_mut().zip(&partial[size..]).for_each(|(o, p)| *o += p);
    }
}

/// Computes the gradient of a tile's queries, and adds its contribution to the gradients of keys and values.
fn backward_tile(a: &Attention, s: &Saved, (batch, first): (usize, usize), dq: &mut [f32], dk: &mut [f32], dv: &mut [f32]) {
    let (d, at) = (a.width, batch * a.queries + first);
    let rows = dq.len() / d;
    let own = at * d..(at + rows) * d;
    let (q, d_out) = (&s.q[own.clone()], &s.d_out[own.clone()]);
    // Infinite log sums make the weights of missing queries 0.
    let (mut log_sums, mut mean) = ([f32::INFINITY; QUERIES], [0.0; QUERIES]);
    log_sums[..rows].copy_from_slice(&s.log_sums[at..at + rows]);
    for (mean, (o, g)) in mean.iter_mut().zip(s.out[own].chunks_exact(d).zip(d_out.chunks_exact(d))) {
        *mean = o.iter().zip(g).map(|(o, g)| o * g).sum();
    }
    tasks::with_buffer(2 * (d + a.tile_keys()) * QUERIES, |buffer| {
        let (queries, buffer) = buffer.split_at_mut(d * QUERIES);
        let (outs, buffer) = buffer.split_at_mut(d * QUERIES);
        let (tile, along) = buffer.split_at_mut(a.tile_keys() * QUERIES);
        transpose(d, a.scale, q, queries);
        transpose(d, 1.0, d_out, outs);
        dq.fill(0.0);
        for keys in a.key_tiles(first, rows) {
            let (n, span) = (keys.len(), keys.start * d..keys.end * d);
            let (tile, along) = (&mut tile[..n * QUERIES], &mut along[..n * QUERIES]);
            let offset = batch * a.keys * d;
            let k = &s.k[offset + span.start..offset + span.end];
            let v = &s.v[offset + span.start..offset + span.end];
            product([n, QUERIES, d], View::rows(k, d), queries, tile, false);
            if a.causal {
                hide(tile, first, keys.start);
            }
            weights(tile, &log_sums);
            product([n, d, rows], View::rows(tile, QUERIES), d_out, &mut dv[span.clone()], true);
            product([n, QUERIES, d], View::rows(v, d), outs, along, false);
            gradients(tile, along, &mean, a.scale);
            product([rows, d, n], turned(tile), k, dq, true);
            product([n, d, rows], View::rows(tile, QUERIES), q, &mut dk[span], true);
        }
    });
}
