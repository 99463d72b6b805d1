//! Rows of one channel: depthwise convolutions and their weight gradients.

use crate::simd::Lane;

/// Rows of outputs of one channel: `c[i] = start + Σ_t weights[t] b[offsets[t].1 + i]`, in whole groups of four vectors.
pub struct Rows<'a> {
    pub weights: &'a [f32],
    pub offsets: &'a [(u32, u32)],
    pub b: *const f32,
    pub b_pitch: usize,
    pub rows: usize,
    pub columns: usize,
    pub start: f32,
    pub c: *mut f32,
    pub c_pitch: usize,
}

/// A row of outputs of one channel, read from the input in place: `c[i] = start + Σ_t weights[t] from[offsets[t] + step · i]`.
pub struct Line<'a> {
    pub weights: &'a [f32],
    pub offsets: &'a [u32],
    pub from: *const f32,
    /// 1 or 2.
    pub step: usize,
    /// At least one vector.
    pub columns: usize,
    pub start: f32,
    pub c: *mut f32,
}

/// Products of a gradient's rows with shifted rows of an input: `sums[t, i mod lanes] += Σ_rows Σ_i d[i] b[offsets[t].1 + i]`.
pub struct Dots<'a> {
    pub d: *const f32,
    pub d_pitch: usize,
    pub b: *const f32,
    pub b_pitch: usize,
    pub rows: usize,
    /// Columns of a row, a multiple of the lanes.
    pub columns: usize,
    /// At most [`MOST_DOTS`].
    pub offsets: &'a [(u32, u32)],
    /// `[offsets.len(), lanes]`
    pub sums: *mut f32,
}

/// Most taps of one [`Dots`].
pub const MOST_DOTS: usize = 9;

#[inline(always)]
pub(super) unsafe fn rows_of<L: Lane>(r: &Rows) {
    const VECTORS: usize = 4;
    // SAFETY: `Kernel::depthwise` states what must exist.
    unsafe {
        for y in 0..r.rows {
            let (from, to) = (r.b.add(y * r.b_pitch), r.c.add(y * r.c_pitch));
            let mut i = 0;
            while i < r.columns {
                let mut acc = [L::splat(r.start); VECTORS];
                for (w, &(_, offset)) in r.weights.iter().zip(r.offsets) {
                    let (w, b) = (L::splat(*w), from.add(offset as usize + i));
                    for (q, v) in acc.iter_mut().enumerate() {
                        *v = L::fma(w, L::load(b.add(q * L::N)), *v);
                    }
                }
                for (q, v) in acc.iter().enumerate() {
                    L::store(to.add(i + q * L::N), *v);
                }
                i += VECTORS * L::N;
            }
        }
    }
}

#[inline(always)]
pub(super) unsafe fn line<L: Lane, const STEP: usize>(l: &Line) {
    // SAFETY: `Kernel::line` states what must exist.
    unsafe {
        let mut i = 0;
        while i + 4 * L::N <= l.columns {
            part_of_line::<L, STEP, 4>(l, i);
            i += 4 * L::N;
        }
        while i + L::N <= l.columns {
            part_of_line::<L, STEP, 1>(l, i);
            i += L::N;
        }
        if i < l.columns {
            // The last vector recomputes some outputs.
            part_of_line::<L, STEP, 1>(l, l.columns - L::N);
        }
    }
}

#[inline(always)]
unsafe fn part_of_line<L: Lane, const STEP: usize, const VECTORS: usize>(l: &Line, first: usize) {
    // SAFETY: `Kernel::line` states what must exist.
    unsafe {
        let mut acc = [L::splat(l.start); VECTORS];
        for (w, offset) in l.weights.iter().zip(l.offsets) {
            let (w, from) = (L::splat(*w), l.from.wrapping_add(*offset as usize + STEP * first));
            for (q, v) in acc.iter_mut().enumerate() {
                let from = from.add(STEP * q * L::N);
                *v = L::fma(w, if STEP == 1 { L::load(from) } else { L::load_pairs(from).0 }, *v);
            }
        }
        for (q, v) in acc.iter().enumerate() {
            L::store(l.c.add(first + q * L::N), *v);
        }
    }
}

#[inline(always)]
pub(super) unsafe fn dots<L: Lane>(s: &Dots) {
    // SAFETY: `Kernel::dots` states what must exist.
    unsafe {
        match s.offsets.len() {
            9 => dots_of::<L, 9>(s, s.offsets, s.sums),
            _ => {
                for (t, offset) in s.offsets.iter().enumerate() {
                    dots_of::<L, 1>(s, std::slice::from_ref(offset), s.sums.add(t * L::N));
                }
            }
        }
    }
}

#[inline(always)]
unsafe fn dots_of<L: Lane, const T: usize>(s: &Dots, offsets: &[(u32, u32)], sums: *mut f32) {
    // SAFETY: `Kernel::dots` states what must exist.
    unsafe {
        let mut acc = [L::splat(0.0); T];
        for y in 0..s.rows {
            let (d, b) = (s.d.add(y * s.d_pitch), s.b.add(y * s.b_pitch));
            let mut i = 0;
            while i < s.columns {
                let v = L::load(d.add(i));
                for (t, sum) in acc.iter_mut().enumerate() {
                    *sum = L::fma(v, L::load(b.add(offsets[t].1 as usize + i)), *sum);
                }
                i += L::N;
            }
        }
        let one = L::splat(1.0);
        for (t, sum) in acc.iter().enumerate() {
            let to = sums.add(t * L::N);
            L::store(to, L::fma(*sum, one, L::load(to)));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simd::Level;
    use crate::tile::kernel;
    use diorama_testkit::{assert_close, random};

    #[test]
    fn every_line_of_every_level_matches_plain_loops_and_writes_nothing_else() {
        for kernel in Level::available().into_iter().map(kernel) {
            let n = kernel.lanes;
            for (step, columns) in [1, 2].into_iter().flat_map(|s| [n, n + 1, 4 * n, 4 * n + 3, 9 * n - 1].map(|c| (s, c))) {
                let (offsets, weights) = ([7, 0, 3], random(3, 1));
                let from = random(step * columns + 7, 2);
                let mut out = vec![9.0; columns + 2];
                let c = out[1..].as_mut_ptr();
                let line = Line { weights: &weights, offsets: &offsets, from: from.as_ptr(), step, columns, start: 0.5, c };
                // SAFETY: the input extends to the last tap, and by one more float with step 2.
                unsafe { kernel.line(&line) };
                let sum = |i: usize| 0.5 + (0..3).map(|t| weights[t] as f64 * from[offsets[t] as usize + step * i] as f64).sum::<f64>();
                let want: Vec<f64> = (0..columns).map(sum).collect();
                assert_close("line", &out[1..=columns], &want, 1e-5);
                assert_eq!([out[0], out[columns + 1]], [9.0; 2]);
            }
        }
    }
}
