//! Vectorized over points, parallel over (level, chunk of points) forward and over levels backward,
//! so that every gradient row has one writer and sums are in a fixed order.

mod gradient;
mod jacobian;

use super::{HashGrid, Level};
use crate::simd;
use rayon::prelude::*;

pub use gradient::{Along, TableGradient, derivatives, gradient, gradient_backward};
pub use jacobian::{jacobian, jacobian_backward};

/// Points per task.
const CHUNK: usize = 8192;

/// Floats per cache line: the unit in which `touched` marks the table.
pub const LINE: usize = 16;

/// The eight rows of a point's cell and the fractions along the axes.
#[inline(always)]
fn cell(level: &Level, p: &[f32]) -> ([usize; 8], [f32; 3], [bool; 3]) {
    let n = level.cells as f32;
    let (mut i, mut f, mut clamped) = ([0u32; 3], [0.0f32; 3], [false; 3]);
    for k in 0..3 {
        let c = p[k].clamp(0.0, 1.0);
        clamped[k] = c != p[k];
        let x = c * n;
        i[k] = (x as u32).min(level.cells - 1);
        f[k] = x - i[k] as f32;
    }
    let rows = if level.dense {
        let s1 = level.cells as usize + 1;
        let s2 = s1 * s1;
        let base = i[0] as usize + s1 * i[1] as usize + s2 * i[2] as usize;
        std::array::from_fn(|c| base + (c & 1) + s1 * ((c >> 1) & 1) + s2 * (c >> 2))
    } else {
        let mask = level.rows as u32 - 1;
        let y = [i[1].wrapping_mul(2_654_435_761), (i[1] + 1).wrapping_mul(2_654_435_761)];
        let z = [i[2].wrapping_mul(805_459_861), (i[2] + 1).wrapping_mul(805_459_861)];
        std::array::from_fn(|c| (((i[0] + (c as u32 & 1)) ^ y[(c >> 1) & 1] ^ z[c >> 2]) & mask) as usize)
    };
    (rows, f, clamped)
}

#[inline(always)]
fn weights(f: [f32; 3]) -> [f32; 8] {
    let g = [1.0 - f[0], 1.0 - f[1], 1.0 - f[2]];
    let yz = [g[1] * g[2], f[1] * g[2], g[1] * f[2], f[1] * f[2]];
    std::array::from_fn(|c| yz[c >> 1] * if c & 1 == 1 { f[0] } else { g[0] })
}

/// Features of points.
///
/// # Shapes
/// points `[S, 3]`, table `[rows, F]`, out `[L, S, F]`, all of it written.
///
/// # Panics
/// When a slice does not fit.
pub fn forward(grid: &HashGrid, points: &[f32], table: &[f32], out: &mut [f32]) {
    let (s, width) = (points.len() / 3, grid.config.features);
    assert_eq!(table.len(), grid.params_len(), "hash grid: table");
    assert_eq!(out.len(), s * grid.output_dims(), "hash grid: out");
    if s == 0 {
        return;
    }
    out.par_chunks_mut(s * width).enumerate().for_each(|(l, out)| {
        let level = &grid.levels[l];
        let rows = &table[level.offset * width..(level.offset + level.rows) * width];
        out.par_chunks_mut(CHUNK * width).zip(points.par_chunks(CHUNK * 3)).for_each(|(out, points)| match width {
            1 => forward_level::<1>(level, points, rows, out),
            2 => forward_level2(level, points, rows, out),
            4 => forward_level::<4>(level, points, rows, out),
            _ => forward_level::<8>(level, points, rows, out),
        });
    });
}

/// [`forward`] on the calling thread alone, for callers that are parallel themselves.
///
/// # Shapes
/// As for [`forward`].
pub fn forward_serial(grid: &HashGrid, points: &[f32], table: &[f32], out: &mut [f32]) {
    let (s, width) = (points.len() / 3, grid.config.features);
    assert!(table.len() == grid.params_len() && out.len() == s * grid.output_dims(), "hash grid: shapes");
    for (level, out) in grid.levels.iter().zip(out.chunks_exact_mut((s * width).max(1))) {
        let rows = &table[level.offset * width..(level.offset + level.rows) * width];
        match width {
            1 => forward_level::<1>(level, points, rows, out),
            2 => forward_level2(level, points, rows, out),
            4 => forward_level::<4>(level, points, rows, out),
            _ => forward_level::<8>(level, points, rows, out),
        }
    }
}

/// Whether this CPU has [`forward_lines`] for the grid: it needs rows of two features, all levels within one line.
#[cfg(target_arch = "x86_64")]
pub(crate) fn has_lines(grid: &HashGrid) -> bool {
    crate::gemm::has_bf16() && grid.config.features == 2 && grid.levels.len() <= 16
}

/// Encodes points, given by coordinate, to rows of bf16, zeros beyond the levels: one line `[L · 2]` per point.
///
/// # Panics
/// When the points are not a multiple of 16, or a slice does not fit.
#[cfg(target_arch = "x86_64")]
pub(crate) fn forward_lines(grid: &HashGrid, points: [&[f32]; 3], table: &[f32], out: &mut [crate::gemm::amx::Line]) {
    let n = points[0].len();
    assert!(has_lines(grid) && n.is_multiple_of(16) && points.iter().all(|p| p.len() == n), "hash grid: lines");
    assert!(table.len() == grid.params_len() && out.len() >= n, "hash grid: shapes");
    // SAFETY: the CPU has AVX-512 with bf16; shapes were asserted.
    unsafe { x86::forward_lines(&grid.levels, points, table, out) };
}

fn forward_level<const F: usize>(level: &Level, points: &[f32], rows: &[f32], out: &mut [f32]) {
    for (p, o) in points.chunks_exact(3).zip(out.chunks_exact_mut(F)) {
        let (idx, f, _) = cell(level, p);
        let w = weights(f);
        let mut acc = [0.0f32; F];
        for c in 0..8 {
            let row = &rows[idx[c] * F..idx[c] * F + F];
            for k in 0..F {
                acc[k] += w[c] * row[k];
            }
        }
        o.copy_from_slice(&acc);
    }
}

fn forward_level2(level: &Level, points: &[f32], rows: &[f32], out: &mut [f32]) {
    #[cfg(target_arch = "x86_64")]
    if simd::level() == simd::Level::Avx512 {
        let whole = points.len() / 3 / 16 * 16;
        // SAFETY: the CPU has AVX-512; `whole` points are a multiple of 16 inside both slices; every
        // row index is below `level.rows` by construction (masked, or a vertex of a dense level).
        unsafe { x86::forward16(level, &points[..whole * 3], rows, &mut out[..whole * 2]) };
        return forward_level::<2>(level, &points[whole * 3..], rows, &mut out[whole * 2..]);
    }
    forward_level::<2>(level, points, rows, out);
}

/// Adds the table's gradient and, where asked, marks each touched line of [`LINE`] floats.
///
/// # Shapes
/// d_out `[L, S, F]`; d_table `[rows, F]`, added to; touched `[rows · F / LINE]`.
///
/// # Panics
/// When a slice does not fit.
pub fn backward(grid: &HashGrid, points: &[f32], d_out: &[f32], d_table: &mut [f32], touched: Option<&mut [u8]>) {
    let (s, width) = (points.len() / 3, grid.config.features);
    assert_eq!(d_table.len(), grid.params_len(), "hash grid: gradient");
    assert_eq!(d_out.len(), s * grid.output_dims(), "hash grid: d_out");
    if s == 0 {
        return;
    }
    let mut tasks = Vec::with_capacity(grid.levels.len());
    let (mut rest, mut marks) = (d_table, touched);
    for (l, level) in grid.levels.iter().enumerate() {
        let (own, tail) = rest.split_at_mut(level.rows * width);
        rest = tail;
        let own_marks = marks.take().map(|m| {
            let (own, tail) = m.split_at_mut(level.rows * width / LINE);
            marks = Some(tail);
            own
        });
        tasks.push((level, &d_out[l * s * width..(l + 1) * s * width], own, own_marks));
    }
    tasks.into_par_iter().with_max_len(1).for_each(|(level, d, own, marks)| match width {
        1 => backward_level::<1>(level, points, d, own, marks),
        2 => backward_level2(level, points, d, own, marks),
        4 => backward_level::<4>(level, points, d, own, marks),
        _ => backward_level::<8>(level, points, d, own, marks),
    });
}

fn backward_level<const F: usize>(level: &Level, points: &[f32], d_out: &[f32], d_rows: &mut [f32], marks: Option<&mut [u8]>) {
    let mut none = [0u8; 0];
    let (marks, marking) = match marks {
        Some(m) => (m, true),
        None => (&mut none[..], false),
    };
    for (p, d) in points.chunks_exact(3).zip(d_out.chunks_exact(F)) {
        if d.iter().all(|&v| v == 0.0) {
            continue;
        }
        let (idx, f, _) = cell(level, p);
        let w = weights(f);
        for c in 0..8 {
            let row = &mut d_rows[idx[c] * F..idx[c] * F + F];
            for k in 0..F {
                row[k] += w[c] * d[k];
            }
            if marking {
                marks[idx[c] * F / LINE] = 1;
            }
        }
    }
}

fn backward_level2(level: &Level, points: &[f32], d_out: &[f32], d_rows: &mut [f32], marks: Option<&mut [u8]>) {
    #[cfg(target_arch = "x86_64")]
    if simd::level() == simd::Level::Avx512
        && let Some(marks) = marks
    {
        let whole = points.len() / 3 / 16 * 16;
        assert!(d_rows.len() >= level.rows * 2 && marks.len() * LINE >= level.rows * 2, "hash grid: level");
        // SAFETY: the CPU has AVX-512; `whole` points are a multiple of 16 inside both slices; every
        // row index is below `level.rows`, which both outputs cover.
        unsafe { x86::backward16(level, &points[..whole * 3], &d_out[..whole * 2], d_rows, marks) };
        return backward_level::<2>(level, &points[whole * 3..], &d_out[whole * 2..], d_rows, Some(marks));
    }
    backward_level::<2>(level, points, d_out, d_rows, marks);
}

/// Gradient of the points, overwritten.
///
/// # Shapes
/// points and d_points `[S, 3]`, table `[rows, F]`, d_out `[L, S, F]`.
pub fn backward_positions(grid: &HashGrid, points: &[f32], table: &[f32], d_out: &[f32], d_points: &mut [f32]) {
    let (s, width) = (points.len() / 3, grid.config.features);
    assert_eq!(d_out.len(), s * grid.output_dims(), "hash grid: d_out");
    d_points.par_chunks_mut(3 * 256).enumerate().for_each(|(chunk, d_points)| {
        for (i, dp) in d_points.chunks_exact_mut(3).enumerate() {
            let i = chunk * 256 + i;
            dp.fill(0.0);
            for (l, level) in grid.levels.iter().enumerate() {
                let d = &d_out[(l * s + i) * width..][..width];
                let (idx, f, clamped) = cell(level, &points[i * 3..i * 3 + 3]);
                // Contribution of each corner's row to the loss, per unit of weight.
                let v: [f32; 8] = std::array::from_fn(|c| {
                    let row = &table[(level.offset + idx[c]) * width..][..width];
                    row.iter().zip(d).map(|(r, d)| r * d).sum()
                });
                let slopes = trilinear_slopes(v, f);
                for k in 0..3 {
                    if !clamped[k] {
                        dp[k] += slopes[k] * level.cells as f32;
                    }
                }
            }
        }
    });
}

/// Slopes along the axes of the trilinear interpolant with corner values `v` (bit k = axis k).
#[inline(always)]
fn trilinear_slopes(v: [f32; 8], f: [f32; 3]) -> [f32; 3] {
    let mix = |a: f32, b: f32, t: f32| a + (b - a) * t;
    let x = mix(mix(v[1] - v[0], v[3] - v[2], f[1]), mix(v[5] - v[4], v[7] - v[6], f[1]), f[2]);
    let y = mix(mix(v[2] - v[0], v[3] - v[1], f[0]), mix(v[6] - v[4], v[7] - v[5], f[0]), f[2]);
    let z = mix(mix(v[4] - v[0], v[5] - v[1], f[0]), mix(v[6] - v[2], v[7] - v[3], f[0]), f[1]);
    [x, y, z]
}

#[cfg(target_arch = "x86_64")]
mod x86 {
    use super::Level;
    use crate::gemm::amx::{Line, transpose16};
    use std::arch::x86_64::*;

    /// Indices and weights of the eight corners of sixteen points.
    #[repr(C, align(64))]
    pub(super) struct Corners {
        pub(super) rows: [[u32; 16]; 8],
        pub(super) weights: [[f32; 16]; 8],
    }

    /// Constants of a level.
    #[derive(Clone, Copy)]
    pub(super) struct Hash {
        pub(super) n: __m512,
        last: __m512i,
        v1: __m512i,
        v2: __m512i,
        mask: __m512i,
        xor: bool,
    }

    /// The coordinates of the sixteen points `[16, 3]` at `src`.
    #[inline]
    #[target_feature(enable = "avx512f,avx512dq,avx2,fma")]
    pub(super) unsafe fn by_coordinate(src: *const f32) -> [__m512; 3] {
        let lane3 = _mm512_setr_epi32(0, 3, 6, 9, 12, 15, 18, 21, 24, 27, 30, 33, 36, 39, 42, 45);
        // SAFETY: the caller vouches for 48 floats.
        unsafe {
            let x = _mm512_i32gather_ps::<4>(lane3, src);
            let y = _mm512_i32gather_ps::<4>(lane3, src.add(1));
            let z = _mm512_i32gather_ps::<4>(lane3, src.add(2));
            [x, y, z]
        }
    }

    impl Hash {
        #[inline]
        #[target_feature(enable = "avx512f,avx512dq,avx2,fma")]
        pub(super) fn new(level: &Level) -> Self {
            let (p1, p2, mask, xor) = if level.dense {
                let s = level.cells as i32 + 1;
                (s, s * s, -1i32, false)
            } else {
                (2_654_435_761u32 as i32, 805_459_861u32 as i32, level.rows as i32 - 1, true)
            };
            Hash {
                n: _mm512_set1_ps(level.cells as f32),
                last: _mm512_set1_epi32(level.cells as i32 - 1),
                v1: _mm512_set1_epi32(p1),
                v2: _mm512_set1_epi32(p2),
                mask: _mm512_set1_epi32(mask),
                xor,
            }
        }

        /// Rows of the corners of sixteen points, given by coordinate, and the fractions along the axes.
        #[inline]
        #[target_feature(enable = "avx512f,avx512dq,avx2,fma")]
        pub(super) fn cells(&self, points: [__m512; 3]) -> ([__m512i; 8], [__m512; 3]) {
            let (zero, one, unit) = (_mm512_setzero_ps(), _mm512_set1_ps(1.0), _mm512_set1_epi32(1));
            let axis = |x: __m512| {
                let x = _mm512_mul_ps(_mm512_min_ps(_mm512_max_ps(x, zero), one), self.n);
                let i = _mm512_min_epi32(_mm512_cvttps_epi32(x), self.last);
                (i, _mm512_sub_ps(x, _mm512_cvtepi32_ps(i)))
            };
            let ((ix, fx), (iy, fy), (iz, fz)) = (axis(points[0]), axis(points[1]), axis(points[2]));
            let y0 = _mm512_mullo_epi32(iy, self.v1);
            let z0 = _mm512_mullo_epi32(iz, self.v2);
            let xs = [ix, _mm512_add_epi32(ix, unit)];
            let ys = [y0, _mm512_add_epi32(y0, self.v1)];
            let zs = [z0, _mm512_add_epi32(z0, self.v2)];
            let mut rows = [unit; 8];
            for (c, row) in rows.iter_mut().enumerate() {
                let (a, b, d) = (c & 1, (c >> 1) & 1, c >> 2);
                *row = if self.xor {
                    _mm512_and_epi32(_mm512_xor_epi32(_mm512_xor_epi32(xs[a], ys[b]), zs[d]), self.mask)
                } else {
                    _mm512_add_epi32(_mm512_add_epi32(xs[a], ys[b]), zs[d])
                };
            }
            (rows, [fx, fy, fz])
        }

        /// Corners of sixteen points, given by coordinate.
        #[inline]
        #[target_feature(enable = "avx512f,avx512dq,avx2,fma")]
        fn corners(&self, points: [__m512; 3]) -> [(__m512i, __m512); 8] {
            let (rows, f) = self.cells(points);
            let one = _mm512_set1_ps(1.0);
            let [wx, wy, wz] = f.map(|f| [_mm512_sub_ps(one, f), f]);
            let mut out = [(rows[0], one); 8];
            for (c, out) in out.iter_mut().enumerate() {
                *out = (rows[c], _mm512_mul_ps(wx[c & 1], _mm512_mul_ps(wy[(c >> 1) & 1], wz[c >> 2])));
            }
            out
        }

        /// Features of sixteen points, two of each: the first eight points' and the others'.
        #[inline]
        #[target_feature(enable = "avx512f,avx512dq,avx2,fma")]
        unsafe fn mix(&self, points: [__m512; 3], base: *const i64) -> (__m512, __m512) {
            let low = _mm512_setr_epi32(0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5, 6, 6, 7, 7);
            let high = _mm512_setr_epi32(8, 8, 9, 9, 10, 10, 11, 11, 12, 12, 13, 13, 14, 14, 15, 15);
            let (mut lo, mut hi) = (_mm512_setzero_ps(), _mm512_setzero_ps());
            // SAFETY: the caller vouches for the level's rows.
            unsafe {
                for (row, w) in self.corners(points) {
                    let first = _mm512_i32gather_epi64::<8>(_mm512_castsi512_si256(row), base);
                    let second = _mm512_i32gather_epi64::<8>(_mm512_extracti64x4_epi64::<1>(row), base);
                    lo = _mm512_fmadd_ps(_mm512_permutexvar_ps(low, w), _mm512_castsi512_ps(first), lo);
                    hi = _mm512_fmadd_ps(_mm512_permutexvar_ps(high, w), _mm512_castsi512_ps(second), hi);
                }
            }
            (lo, hi)
        }
    }

    /// Sixteen points at a time through all levels.
    ///
    /// # Safety
    /// AVX-512F, DQ, BW and BF16; a multiple of 16 points, one line each; `table` holds the rows of `levels`, 16 at most.
    #[target_feature(enable = "avx512f,avx512dq,avx512bw,avx512bf16,avx2,fma")]
    pub unsafe fn forward_lines(levels: &[Level], points: [&[f32]; 3], table: &[f32], out: &mut [Line]) {
        let empty = Hash::new(&levels[0]);
        let mut hashes = [empty; 16];
        for (h, level) in hashes.iter_mut().zip(levels) {
            *h = Hash::new(level);
        }
        for g in 0..points[0].len() / 16 {
            let mut words = [_mm512_setzero_si512(); 16];
            // SAFETY: all loads and stores lie inside the slices, see the caller.
            unsafe {
                let [x, y, z] = &points;
                let at = g * 16;
                let points =
                    [_mm512_loadu_ps(x.as_ptr().add(at)), _mm512_loadu_ps(y.as_ptr().add(at)), _mm512_loadu_ps(z.as_ptr().add(at))];
                for ((word, hash), level) in words.iter_mut().zip(&hashes).zip(levels) {
                    let (lo, hi) = hash.mix(points, table.as_ptr().add(level.offset * 2).cast());
                    *word = std::mem::transmute::<__m512bh, __m512i>(_mm512_cvtne2ps_pbh(hi, lo));
                }
                for (p, line) in transpose16(words).into_iter().enumerate() {
                    _mm512_store_si512(out.as_mut_ptr().add(g * 16 + p).cast(), line);
                }
            }
        }
    }

    /// Sixteen points at a time, two features per row.
    ///
    /// # Safety
    /// AVX-512F and DQ; a multiple of 16 points; `rows` holds every row of `level`.
    #[target_feature(enable = "avx512f,avx512dq,avx2,fma")]
    pub unsafe fn forward16(level: &Level, points: &[f32], rows: &[f32], out: &mut [f32]) {
        let hash = Hash::new(level);
        let base = rows.as_ptr().cast::<i64>();
        for g in 0..points.len() / 48 {
            // SAFETY: all loads and stores lie inside the slices, see the caller.
            unsafe {
                let (lo, hi) = hash.mix(by_coordinate(points.as_ptr().add(g * 48)), base);
                _mm512_storeu_ps(out.as_mut_ptr().add(g * 32), lo);
                _mm512_storeu_ps(out.as_mut_ptr().add(g * 32 + 16), hi);
            }
        }
    }

    /// Adds the gradients of sixteen points at a time; the rows of the next sixteen are prefetched.
    ///
    /// # Safety
    /// As for [`forward16`]; `marks` covers `rows`.
    #[target_feature(enable = "avx512f,avx512dq,avx2,fma")]
    pub unsafe fn backward16(level: &Level, points: &[f32], d_out: &[f32], rows: &mut [f32], marks: &mut [u8]) {
        let hash = Hash::new(level);
        let groups = points.len() / 48;
        let empty = || Corners { rows: [[0; 16]; 8], weights: [[0.0; 16]; 8] };
        let mut buffers = [empty(), empty()];
        let (base, marks) = (rows.as_mut_ptr(), marks.as_mut_ptr());
        for g in 0..=groups {
            // SAFETY: all loads and stores lie inside the slices, see the caller.
            unsafe {
                if g < groups {
                    let next = &mut buffers[g % 2];
                    for (c, (row, w)) in hash.corners(by_coordinate(points.as_ptr().add(g * 48))).into_iter().enumerate() {
                        _mm512_store_si512(next.rows[c].as_mut_ptr().cast(), row);
                        _mm512_store_ps(next.weights[c].as_mut_ptr(), w);
                        for row in &next.rows[c] {
                            _mm_prefetch::<_MM_HINT_ET0>(base.add(*row as usize * 2).cast());
                        }
                    }
                }
                if g == 0 {
                    continue;
                }
                let now = &buffers[(g - 1) % 2];
                let d = d_out.as_ptr().add((g - 1) * 32);
                for p in 0..16 {
                    let d = _mm_castsi128_ps(_mm_loadl_epi64(d.add(2 * p).cast()));
                    for c in 0..8 {
                        let row = now.rows[c][p] as usize;
                        let at = base.add(row * 2);
                        let sum = _mm_fmadd_ps(_mm_set1_ps(now.weights[c][p]), d, _mm_castsi128_ps(_mm_loadl_epi64(at.cast())));
                        _mm_storel_epi64(at.cast(), _mm_castps_si128(sum));
                        *marks.add(row * 2 / super::LINE) = 1;
                    }
                }
            }
        }
    }
}
