//! Gradient of a function of the features with respect to the points, `Jᵀ g` with `J = ∂features/∂point`, and its backward pass.
//! `J` is linear in the table, so that the backward pass is a scatter with derivatives of the corners' weights.

use super::super::{HashGrid, Level};
use super::{LINE, cell, trilinear_slopes, weights};
#[cfg(target_arch = "x86_64")]
use crate::simd;
use rayon::prelude::*;

/// Points per task of derivatives, and bounds of those of gradients, multiples of sixteen: a task runs through all levels, whose parts of
/// the table should stay in cache for many points.
const CHUNK: usize = 8192;
const LONG: (usize, usize) = (2048, 32768);

/// Directions of a backward pass.
#[derive(Clone, Copy)]
pub struct Along<'a> {
    /// Factor of the features themselves, `[S]`.
    pub value: &'a [f32],
    /// Direction of the derivative, `[S, 3]`.
    pub direction: &'a [f32],
}

/// Gradient of a table, added to, and the marks of its touched lines.
pub struct TableGradient<'a> {
    /// `[rows, F]`
    pub grads: &'a mut [f32],
    /// `[rows · F / LINE]`; may be empty.
    pub touched: &'a mut [u8],
}

/// Gradients `Jᵀ g` of the points, overwritten.
///
/// # Shapes
/// points and out `[S, 3]`, table `[rows, F]`, g `[L, S, F]`.
///
/// # Panics
/// When a slice does not fit.
pub fn gradient(grid: &HashGrid, points: &[f32], table: &[f32], g: &[f32], out: &mut [f32]) {
    let (s, width) = (points.len() / 3, grid.config.features);
    assert!(table.len() == grid.params_len() && g.len() == s * grid.output_dims() && out.len() == s * 3, "hash grid: gradient");
    let size = s.div_ceil(rayon::current_num_threads()).clamp(LONG.0, LONG.1).next_multiple_of(16);
    out.par_chunks_mut(size * 3).zip(points.par_chunks(size * 3)).enumerate().for_each(|(chunk, (out, points))| {
        out.fill(0.0);
        let n = points.len() / 3;
        for (l, level) in grid.levels.iter().enumerate() {
            let rows = &table[level.offset * width..(level.offset + level.rows) * width];
            let g = &g[(l * s + chunk * size) * width..][..n * width];
            match width {
                1 => gradient_level::<1>(level, points, rows, g, out),
                2 => gradient_level2(level, points, rows, g, out),
                4 => gradient_level::<4>(level, points, rows, g, out),
                _ => gradient_level::<8>(level, points, rows, g, out),
            }
        }
    });
}

fn gradient_level<const F: usize>(level: &Level, points: &[f32], rows: &[f32], g: &[f32], out: &mut [f32]) {
    for ((p, g), o) in points.chunks_exact(3).zip(g.chunks_exact(F)).zip(out.chunks_exact_mut(3)) {
        let (idx, f, clamped) = cell(level, p);
        let v = idx.map(|r| rows[r * F..r * F + F].iter().zip(g).map(|(r, g)| r * g).sum());
        let slopes = trilinear_slopes(v, f);
        for k in 0..3 {
            o[k] += if clamped[k] { 0.0 } else { slopes[k] * level.cells as f32 };
        }
    }
}

fn gradient_level2(level: &Level, points: &[f32], rows: &[f32], g: &[f32], out: &mut [f32]) {
    #[cfg(target_arch = "x86_64")]
    if simd::level() == simd::Level::Avx512 {
        let whole = points.len() / 3 / 16 * 16;
        assert!(rows.len() >= level.rows * 2 && g.len() >= whole * 2 && out.len() >= whole * 3, "hash grid: level");
        // SAFETY: the CPU has AVX-512; `whole` points are a multiple of 16 inside all slices; every row index is below `level.rows` by
        // construction.
        unsafe { x86::gradient16(level, &points[..whole * 3], rows, g, out) };
        return gradient_level::<2>(level, &points[whole * 3..], rows, &g[whole * 2..], &mut out[whole * 3..]);
    }
    gradient_level::<2>(level, points, rows, g, out);
}

/// Derivatives `J d` of the features along directions `d`, overwritten.
///
/// # Shapes
/// points and directions `[S, 3]`, table `[rows, F]`, out `[L, S, F]`.
///
/// # Panics
/// When a slice does not fit.
pub fn derivatives(grid: &HashGrid, points: &[f32], table: &[f32], directions: &[f32], out: &mut [f32]) {
    let (s, width) = (points.len() / 3, grid.config.features);
    assert!(table.len() == grid.params_len() && out.len() == s * grid.output_dims(), "hash grid: derivatives");
    assert_eq!(directions.len(), s * 3, "hash grid: directions");
    out.par_chunks_mut((s * width).max(1)).zip(&grid.levels).for_each(|(out, level)| {
        let rows = &table[level.offset * width..(level.offset + level.rows) * width];
        let parts = out.par_chunks_mut(CHUNK * width).zip(points.par_chunks(CHUNK * 3)).zip(directions.par_chunks(CHUNK * 3));
        parts.for_each(|((out, points), directions)| match width {
            1 => derivatives_level::<1>(level, points, rows, directions, out),
            2 => derivatives_level2(level, points, rows, directions, out),
            4 => derivatives_level::<4>(level, points, rows, directions, out),
            _ => derivatives_level::<8>(level, points, rows, directions, out),
        });
    });
}

/// The rows of a point's cell with the weights' derivatives along `d`, and the weights.
#[inline(always)]
fn slopes_along(level: &Level, p: &[f32], d: &[f32]) -> ([usize; 8], [f32; 8], [f32; 8]) {
    let (idx, f, clamped) = cell(level, p);
    let step: [f32; 3] = std::array::from_fn(|k| if clamped[k] { 0.0 } else { d[k] * level.cells as f32 });
    let along = |c: usize| {
        let w = |k: usize| if (c >> k) & 1 == 1 { f[k] } else { 1.0 - f[k] };
        let s = |k: usize| if (c >> k) & 1 == 1 { step[k] } else { -step[k] };
        s(0) * w(1) * w(2) + w(0) * s(1) * w(2) + w(0) * w(1) * s(2)
    };
    (idx, std::array::from_fn(along), weights(f))
}

fn derivatives_level<const F: usize>(level: &Level, points: &[f32], rows: &[f32], directions: &[f32], out: &mut [f32]) {
    for ((p, d), o) in points.chunks_exact(3).zip(directions.chunks_exact(3)).zip(out.chunks_exact_mut(F)) {
        let (idx, along, _) = slopes_along(level, p, d);
        let mut sums = [0.0f32; F];
        for (row, along) in idx.iter().zip(along) {
            (0..F).for_each(|k| sums[k] += along * rows[row * F + k]);
        }
        o.copy_from_slice(&sums);
    }
}

fn derivatives_level2(level: &Level, points: &[f32], rows: &[f32], directions: &[f32], out: &mut [f32]) {
    #[cfg(target_arch = "x86_64")]
    if simd::level() == simd::Level::Avx512 {
        let whole = points.len() / 3 / 16 * 16;
        assert!(rows.len() >= level.rows * 2 && directions.len() >= whole * 3 && out.len() >= whole * 2, "hash grid: level");
        // SAFETY: the CPU has AVX-512; `whole` points are a multiple of 16 inside all slices; every row index is below `level.rows` by
        // construction.
        unsafe { x86::derivatives16(level, &points[..whole * 3], rows, directions, out) };
        return derivatives_level::<2>(level, &points[whole * 3..], rows, &directions[whole * 3..], &mut out[whole * 2..]);
    }
    derivatives_level::<2>(level, points, rows, directions, out);
}

/// Adds the gradient of `Σ g · (value · features + J d)` with respect to the table, `d = along.direction`. With `g` the gradient of a
/// function of the features, this is the table's part of the backward pass of [`gradient`] and of the features together.
///
/// # Shapes
/// points `[S, 3]`, g `[L, S, F]`.
///
/// # Panics
/// When a slice does not fit.
pub fn gradient_backward(grid: &HashGrid, points: &[f32], g: &[f32], along: Along, to: TableGradient) {
    let (s, width) = (points.len() / 3, grid.config.features);
    assert!(g.len() == s * grid.output_dims() && along.value.len() == s && along.direction.len() == s * 3, "hash grid: gradient");
    let marked = [0, grid.params_len() / LINE].contains(&to.touched.len());
    assert!(to.grads.len() == grid.params_len() && marked, "hash grid: table gradient");
    if s == 0 {
        return;
    }
    let (mut rest, mut marks) = (to.grads, to.touched);
    let mut tasks = Vec::with_capacity(grid.levels.len());
    for (level, g) in grid.levels.iter().zip(g.chunks_exact(s * width)) {
        let (own, tail) = rest.split_at_mut(level.rows * width);
        let (own_marks, other_marks) = marks.split_at_mut((level.rows * width / LINE).min(marks.len()));
        (rest, marks) = (tail, other_marks);
        tasks.push((LevelTask { level, points, g, along }, own, own_marks));
    }
    tasks.into_par_iter().with_max_len(1).for_each(|(task, own, marks)| match width {
        1 => task.run::<1>(own, marks),
        2 => task.run2(own, marks),
        4 => task.run::<4>(own, marks),
        _ => task.run::<8>(own, marks),
    });
}

/// Inputs of the backward pass of a level.
#[derive(Clone, Copy)]
struct LevelTask<'a> {
    level: &'a Level,
    points: &'a [f32],
    g: &'a [f32],
    along: Along<'a>,
}

impl LevelTask<'_> {
    /// `marks` is empty where none are wanted.
    fn run<const F: usize>(&self, d_rows: &mut [f32], marks: &mut [u8]) {
        let per_point = self.points.chunks_exact(3).zip(self.along.direction.chunks_exact(3)).zip(self.along.value);
        for (((p, d), value), g) in per_point.zip(self.g.chunks_exact(F)) {
            let (idx, along, weights) = slopes_along(self.level, p, d);
            for c in 0..8 {
                let (row, share) = (idx[c] * F, along[c] + value * weights[c]);
                (0..F).for_each(|k| d_rows[row + k] += share * g[k]);
                if let Some(mark) = marks.get_mut(row / LINE) {
                    *mark = 1;
                }
            }
        }
    }

    fn run2(&self, d_rows: &mut [f32], marks: &mut [u8]) {
        #[cfg(target_arch = "x86_64")]
        if simd::level() == simd::Level::Avx512 && !marks.is_empty() {
            let (first, rest) = self.split(self.points.len() / 3 / 16 * 16);
            let n = self.level.rows * 2;
            assert!(d_rows.len() >= n && marks.len() * LINE >= n, "hash grid: level");
            // SAFETY: the CPU has AVX-512; the points are a multiple of 16 inside all slices, which `split` cut; every row index is
            // below `level.rows`, which gradient and marks cover.
            unsafe { x86::backward16(&first, d_rows, marks) };
            return rest.run::<2>(d_rows, marks);
        }
        self.run::<2>(d_rows, marks);
    }

    /// The first `n` points of rows of two features, and the others.
    #[cfg(target_arch = "x86_64")]
    fn split(&self, n: usize) -> (Self, Self) {
        let ((p, p_rest), (g, g_rest)) = (self.points.split_at(n * 3), self.g.split_at(n * 2));
        let ((v, v_rest), (d, d_rest)) = (self.along.value.split_at(n), self.along.direction.split_at(n * 3));
        let of = |points, g, value, direction| LevelTask { points, g, along: Along { value, direction }, ..*self };
        (of(p, g, v, d), of(p_rest, g_rest, v_rest, d_rest))
    }
}

#[cfg(target_arch = "x86_64")]
mod x86 {
    use super::super::x86::{Corners, Hash, by_coordinate};
    use super::{LINE, Level, LevelTask};
    use std::arch::x86_64::*;

    /// Lanes of the features of the first and the last eight of sixteen points.
    const LOW: [i32; 16] = [0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5, 6, 6, 7, 7];
    const HIGH: [i32; 16] = [8, 8, 9, 9, 10, 10, 11, 11, 12, 12, 13, 13, 14, 14, 15, 15];
    /// First and second feature of sixteen points.
    const EVEN: [i32; 16] = [0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30];
    const ODD: [i32; 16] = [1, 3, 5, 7, 9, 11, 13, 15, 17, 19, 21, 23, 25, 27, 29, 31];

    #[inline]
    #[target_feature(enable = "avx512f,avx512dq,avx2,fma")]
    fn lanes(of: &[i32; 16]) -> __m512i {
        // SAFETY: sixteen numbers.
        unsafe { _mm512_loadu_si512(of.as_ptr().cast()) }
    }

    /// Both features of sixteen rows: the first eight rows' and the others'.
    ///
    /// # Safety
    /// The rows exist behind `base`.
    #[inline]
    #[target_feature(enable = "avx512f,avx512dq,avx2,fma")]
    unsafe fn gather(row: __m512i, base: *const i64) -> (__m512, __m512) {
        // SAFETY: as the caller vouches.
        unsafe {
            let first = _mm512_i32gather_epi64::<8>(_mm512_castsi512_si256(row), base);
            let second = _mm512_i32gather_epi64::<8>(_mm512_extracti64x4_epi64::<1>(row), base);
            (_mm512_castsi512_ps(first), _mm512_castsi512_ps(second))
        }
    }

    /// Cells per axis where a coordinate was not clamped, else 0.
    #[inline]
    #[target_feature(enable = "avx512f,avx512dq,avx2,fma")]
    fn scale(n: __m512, x: __m512) -> __m512 {
        let inside = _mm512_min_ps(_mm512_max_ps(x, _mm512_setzero_ps()), _mm512_set1_ps(1.0));
        _mm512_maskz_mov_ps(_mm512_cmp_ps_mask::<_CMP_EQ_OQ>(x, inside), n)
    }

    #[inline]
    #[target_feature(enable = "avx512f,avx512dq,avx2,fma")]
    fn mix(a: __m512, b: __m512, t: __m512) -> __m512 {
        _mm512_fmadd_ps(_mm512_sub_ps(b, a), t, a)
    }

    /// Adds a level's gradients of sixteen points at a time, two features per row.
    ///
    /// # Safety
    /// AVX-512F and DQ; a multiple of 16 points; `rows` holds every row of `level`; `g` and `out` cover the points.
    #[target_feature(enable = "avx512f,avx512dq,avx2,fma")]
    pub unsafe fn gradient16(level: &Level, points: &[f32], rows: &[f32], g: &[f32], out: &mut [f32]) {
        let hash = Hash::new(level);
        let (base, even, odd) = (rows.as_ptr().cast::<i64>(), lanes(&EVEN), lanes(&ODD));
        let mut buffer = [[0.0f32; 16]; 3];
        for group in 0..points.len() / 48 {
            // SAFETY: all loads lie inside the slices, see the caller.
            let slopes = unsafe {
                let at = by_coordinate(points.as_ptr().add(group * 48));
                let (rows, f) = hash.cells(at);
                let g_lo = _mm512_loadu_ps(g.as_ptr().add(group * 32));
                let g_hi = _mm512_loadu_ps(g.as_ptr().add(group * 32 + 16));
                let mut v = [g_lo; 8];
                for (v, row) in v.iter_mut().zip(rows) {
                    let (lo, hi) = gather(row, base);
                    let (lo, hi) = (_mm512_mul_ps(lo, g_lo), _mm512_mul_ps(hi, g_hi));
                    *v = _mm512_add_ps(_mm512_permutex2var_ps(lo, even, hi), _mm512_permutex2var_ps(lo, odd, hi));
                }
                let sub = |a: usize, b: usize| _mm512_sub_ps(v[a], v[b]);
                let x = mix(mix(sub(1, 0), sub(3, 2), f[1]), mix(sub(5, 4), sub(7, 6), f[1]), f[2]);
                let y = mix(mix(sub(2, 0), sub(3, 1), f[0]), mix(sub(6, 4), sub(7, 5), f[0]), f[2]);
                let z = mix(mix(sub(4, 0), sub(5, 1), f[0]), mix(sub(6, 2), sub(7, 3), f[0]), f[1]);
                [(x, at[0]), (y, at[1]), (z, at[2])].map(|(s, x)| _mm512_mul_ps(s, scale(hash.n, x)))
            };
            for (b, s) in buffer.iter_mut().zip(slopes) {
                // SAFETY: sixteen numbers.
                unsafe { _mm512_storeu_ps(b.as_mut_ptr(), s) };
            }
            for (p, o) in out[group * 48..group * 48 + 48].chunks_exact_mut(3).enumerate() {
                (0..3).for_each(|k| o[k] += buffer[k][p]);
            }
        }
    }

    /// The weights' derivatives along `d` of the corners of sixteen points, given by coordinate, and the weights.
    #[inline]
    #[target_feature(enable = "avx512f,avx512dq,avx2,fma")]
    fn slopes_along(n: __m512, at: [__m512; 3], d: [__m512; 3], f: [__m512; 3]) -> [(__m512, __m512); 8] {
        let (zero, one) = (_mm512_setzero_ps(), _mm512_set1_ps(1.0));
        let [wx, wy, wz] = f.map(|f| [_mm512_sub_ps(one, f), f]);
        let mut s = [[zero; 2]; 3];
        for k in 0..3 {
            let step = _mm512_mul_ps(d[k], scale(n, at[k]));
            s[k] = [_mm512_sub_ps(zero, step), step];
        }
        let mut out = [(zero, zero); 8];
        for (c, out) in out.iter_mut().enumerate() {
            let (i, j, k) = (c & 1, (c >> 1) & 1, c >> 2);
            let yz = _mm512_mul_ps(wy[j], wz[k]);
            let across = _mm512_fmadd_ps(s[1][j], wz[k], _mm512_mul_ps(wy[j], s[2][k]));
            *out = (_mm512_fmadd_ps(s[0][i], yz, _mm512_mul_ps(wx[i], across)), _mm512_mul_ps(wx[i], yz));
        }
        out
    }

    /// Derivatives of the features of sixteen points at a time, two features per row.
    ///
    /// # Safety
    /// As for [`gradient16`]; `directions` and `out` cover the points.
    #[target_feature(enable = "avx512f,avx512dq,avx2,fma")]
    pub unsafe fn derivatives16(level: &Level, points: &[f32], rows: &[f32], directions: &[f32], out: &mut [f32]) {
        let hash = Hash::new(level);
        let (base, low, high) = (rows.as_ptr().cast::<i64>(), lanes(&LOW), lanes(&HIGH));
        for group in 0..points.len() / 48 {
            let (mut lo, mut hi) = (_mm512_setzero_ps(), _mm512_setzero_ps());
            // SAFETY: all loads and stores lie inside the slices, see the caller.
            unsafe {
                let at = by_coordinate(points.as_ptr().add(group * 48));
                let d = by_coordinate(directions.as_ptr().add(group * 48));
                let (rows, f) = hash.cells(at);
                for (row, (along, _)) in rows.into_iter().zip(slopes_along(hash.n, at, d, f)) {
                    let (first, second) = gather(row, base);
                    lo = _mm512_fmadd_ps(_mm512_permutexvar_ps(low, along), first, lo);
                    hi = _mm512_fmadd_ps(_mm512_permutexvar_ps(high, along), second, hi);
                }
                _mm512_storeu_ps(out.as_mut_ptr().add(group * 32), lo);
                _mm512_storeu_ps(out.as_mut_ptr().add(group * 32 + 16), hi);
            }
        }
    }

    /// [`LevelTask::run`] for sixteen points at a time, two features per row; the rows of the next sixteen are prefetched.
    ///
    /// # Safety
    /// AVX-512F and DQ; a multiple of 16 points; `d_rows` and `marks` cover all rows of the level.
    #[target_feature(enable = "avx512f,avx512dq,avx2,fma")]
    pub unsafe fn backward16(task: &LevelTask, d_rows: &mut [f32], marks: &mut [u8]) {
        let hash = Hash::new(task.level);
        let groups = task.points.len() / 48;
        let empty = || Corners { rows: [[0; 16]; 8], weights: [[0.0; 16]; 8] };
        let mut buffers = [empty(), empty()];
        let (base, marks) = (d_rows.as_mut_ptr(), marks.as_mut_ptr());
        for group in 0..=groups {
            // SAFETY: all loads and stores lie inside the slices, see the caller.
            unsafe {
                if group < groups {
                    let at = by_coordinate(task.points.as_ptr().add(group * 48));
                    let d = by_coordinate(task.along.direction.as_ptr().add(group * 48));
                    let value = _mm512_loadu_ps(task.along.value.as_ptr().add(group * 16));
                    let (rows, f) = hash.cells(at);
                    let next = &mut buffers[group % 2];
                    for (c, (row, (along, weight))) in rows.into_iter().zip(slopes_along(hash.n, at, d, f)).enumerate() {
                        _mm512_store_si512(next.rows[c].as_mut_ptr().cast(), row);
                        _mm512_store_ps(next.weights[c].as_mut_ptr(), _mm512_fmadd_ps(value, weight, along));
                        for row in &next.rows[c] {
                            _mm_prefetch::<_MM_HINT_ET0>(base.add(*row as usize * 2).cast());
                        }
                    }
                }
                if group == 0 {
                    continue;
                }
                let now = &buffers[(group - 1) % 2];
                let g = task.g.as_ptr().add((group - 1) * 32);
                for p in 0..16 {
                    let g = _mm_castsi128_ps(_mm_loadl_epi64(g.add(2 * p).cast()));
                    for c in 0..8 {
                        let row = now.rows[c][p] as usize;
                        let at = base.add(row * 2);
                        let sum = _mm_fmadd_ps(_mm_set1_ps(now.weights[c][p]), g, _mm_castsi128_ps(_mm_loadl_epi64(at.cast())));
                        _mm_storel_epi64(at.cast(), _mm_castps_si128(sum));
                        *marks.add(row * 2 / LINE) = 1;
                    }
                }
            }
        }
    }
}
