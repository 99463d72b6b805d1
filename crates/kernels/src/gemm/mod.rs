//! Small matrix products on blocks that stay in cache: `C = act(init + A·B)`.

#[cfg(target_arch = "x86_64")]
pub(crate) mod amx;

use crate::simd::{self, Lane, Level, Plain};
use std::cell::RefCell;

/// Arithmetic of a product's operands; sums are always f32.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Precision {
    #[default]
    F32,
    /// Operands rounded to bf16, where the CPU multiplies such tiles; f32 elsewhere.
    Bf16,
}

/// Whether [`Precision::Bf16`] differs from f32 on this machine.
pub fn has_bf16() -> bool {
    #[cfg(target_arch = "x86_64")]
    return simd::level() == Level::Avx512 && amx::is_available();
    #[cfg(not(target_arch = "x86_64"))]
    return false;
}

/// A left factor that is rounded to bf16 and packed once for several products; for CPUs with [`has_bf16`].
#[derive(Default)]
pub(crate) struct Rounded {
    #[cfg(target_arch = "x86_64")]
    a: Vec<amx::Line>,
    #[cfg(target_arch = "x86_64")]
    b: Vec<amx::Line>,
}

impl Rounded {
    /// Packs A of a product, whose B is not read.
    ///
    /// # Panics
    /// Without [`has_bf16`], or when A is too short for its shape.
    pub fn pack(&mut self, g: &Gemm) {
        assert!(has_bf16(), "no bf16 tiles here");
        assert!(g.m == 0 || g.k == 0 || g.a.data.len() > (g.m - 1) * g.a.row + (g.k - 1) * g.a.col, "gemm: a is too short");
        // SAFETY: asserted above.
        #[cfg(target_arch = "x86_64")]
        unsafe {
            amx::pack_a(g, &mut self.a);
        }
    }

    /// `c = init + A B` with the A that was packed last; `c` is addressed as the description says.
    ///
    /// # Safety
    /// The rows and terms are those that were packed; C exists.
    pub unsafe fn multiply(&mut self, g: &Gemm, c: *mut f32) {
        assert!(g.k == 0 || g.b.len() >= (g.k - 1) * g.ldb + g.n, "gemm: b is too short");
        // SAFETY: as the caller vouches; packing asserted what the CPU has.
        #[cfg(target_arch = "x86_64")]
        unsafe {
            amx::run_packed(g, &self.a, &mut self.b, c);
        }
        #[cfg(not(target_arch = "x86_64"))]
        let _ = c;
    }
}

/// Columns beyond which B is packed into panels that stay in the first-level cache.
const WIDE: usize = 64;
/// Rows of B per panel.
const PANEL: usize = 256;

thread_local! {
    static PACKED: RefCell<Vec<f32>> = const { RefCell::new(Vec::new()) };
}

/// Initial value of an output element's sum.
#[derive(Clone, Copy)]
pub enum Init<'a> {
    Zero,
    /// One value per column, `[n]`.
    Bias(&'a [f32]),
    /// The present content of `c`.
    Accumulate,
}

/// A matrix view: element `(i, j)` is `data[i * row + j * col]`.
#[derive(Clone, Copy)]
pub struct View<'a> {
    pub data: &'a [f32],
    pub row: usize,
    pub col: usize,
}

impl<'a> View<'a> {
    /// Row-major with the given row length.
    pub fn rows(data: &'a [f32], row: usize) -> Self {
        View { data, row, col: 1 }
    }

    /// The transpose of a row-major matrix.
    pub fn transposed(data: &'a [f32], row: usize) -> Self {
        View { data, row: 1, col: row }
    }
}

/// A product `act(init + A B)`, with `act` ReLU or nothing.
///
/// # Shapes
/// a: `[m, k]` any strides; b: `[k, n]` row-major, rows `ldb` apart; the result: `[m, n]`, rows `ldc` apart.
#[derive(Clone, Copy)]
pub struct Gemm<'a> {
    pub m: usize,
    pub n: usize,
    pub k: usize,
    pub a: View<'a>,
    pub b: &'a [f32],
    pub ldb: usize,
    pub ldc: usize,
    pub init: Init<'a>,
    pub relu: bool,
}

/// `c[i, j] = act(init + Σ_p a[i, p] b[p, j])`.
///
/// Sums run over `p` in a fixed order, so results do not depend on the thread count.
///
/// # Panics
/// When a slice is too short for its shape.
pub fn gemm(precision: Precision, g: Gemm, c: &mut [f32]) {
    let Gemm { m, n, k, a, b, ldb, ldc, init, .. } = g;
    if m == 0 || n == 0 {
        return;
    }
    assert!(k == 0 || a.data.len() > (m - 1) * a.row + (k - 1) * a.col, "gemm: a is too short");
    assert!(k == 0 || b.len() >= (k - 1) * ldb + n, "gemm: b is too short");
    assert!(c.len() >= (m - 1) * ldc + n, "gemm: c is too short");
    if let Init::Bias(bias) = init {
        assert!(bias.len() >= n, "gemm: bias is too short");
    }
    #[cfg(target_arch = "x86_64")]
    if precision == Precision::Bf16 && has_bf16() {
        // SAFETY: bounds were asserted above; the CPU and the system allow tiles.
        return unsafe { amx::run(&g, c) };
    }
    let _ = precision;
    // SAFETY: bounds were asserted above; `level()` only names sets that this CPU has.
    unsafe {
        match simd::level() {
            #[cfg(target_arch = "x86_64")]
            Level::Avx512 => g.run_avx512(c),
            #[cfg(target_arch = "x86_64")]
            Level::Avx2 => g.run_avx2(c),
            #[cfg(target_arch = "aarch64")]
            Level::Neon => g.run::<simd::Neon, 6, 4>(c),
            _ => g.run::<Plain, 4, 2>(c),
        }
    }
}

impl Gemm<'_> {
    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx512f,avx512dq,avx2,fma")]
    unsafe fn run_avx512(&self, c: &mut [f32]) {
        // SAFETY: compiled for the set; bounds asserted by `gemm`.
        unsafe { if self.n > WIDE && self.m >= 48 { self.run_packed::<simd::Avx512, 12, 2>(c) } else { self.run::<simd::Avx512, 6, 4>(c) } }
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2,fma")]
    unsafe fn run_avx2(&self, c: &mut [f32]) {
        // SAFETY: compiled for the set; bounds asserted by `gemm`.
        unsafe { self.run::<simd::Avx2, 6, 2>(c) }
    }

    /// Copies B panel by panel, so that a panel is read from the first-level cache by all rows.
    #[inline(always)]
    unsafe fn run_packed<L: Lane, const MR: usize, const NR: usize>(&self, c: &mut [f32]) {
        let width = NR * L::N;
        // Moved out and returned: a closure would not be compiled for the instruction set.
        let mut panel = PACKED.take();
        panel.resize(PANEL * width, 0.0);
        for p in (0..self.k.max(1)).step_by(PANEL) {
            let rows = PANEL.min(self.k - p);
            let last = p + rows == self.k;
            for j in (0..self.n).step_by(width) {
                let columns = width.min(self.n - j);
                for r in 0..rows {
                    let from = (p + r) * self.ldb + j;
                    panel[r * width..r * width + columns].copy_from_slice(&self.b[from..from + columns]);
                }
                let part = Gemm {
                    n: columns,
                    k: rows,
                    a: View { data: self.a.data.get(p * self.a.col..).unwrap_or(&[]), ..self.a },
                    b: &panel[..],
                    ldb: width,
                    init: match self.init {
                        _ if p > 0 => Init::Accumulate,
                        Init::Bias(bias) => Init::Bias(&bias[j..]),
                        init => init,
                    },
                    relu: self.relu && last,
                    ..*self
                };
                // SAFETY: a part of the shapes that `gemm` asserted.
                unsafe { part.run::<L, MR, NR>(&mut c[j..]) };
            }
        }
        PACKED.set(panel);
    }

    /// Computes the output in tiles of `MR` rows by `NR` vectors.
    #[inline(always)]
    unsafe fn run<L: Lane, const MR: usize, const NR: usize>(&self, c: &mut [f32]) {
        let cp = c.as_mut_ptr();
        let mut j = 0;
        // SAFETY: every tile lies inside the shapes that `gemm` asserted.
        unsafe {
            while j + NR * L::N <= self.n {
                self.column_tile::<L, MR, NR>(cp, j);
                j += NR * L::N;
            }
            if NR > 2 && j + 2 * L::N <= self.n {
                self.column_tile::<L, MR, 2>(cp, j);
                j += 2 * L::N;
            }
            while j + L::N <= self.n {
                self.column_tile::<L, MR, 1>(cp, j);
                j += L::N;
            }
            for i in 0..self.m {
                for j in j..self.n {
                    self.scalar(cp, i, j);
                }
            }
        }
    }

    #[inline(always)]
    unsafe fn column_tile<L: Lane, const MR: usize, const NR: usize>(&self, c: *mut f32, j: usize) {
        let mut i = 0;
        // SAFETY: as in `run`.
        unsafe {
            while i + MR <= self.m {
                self.tile::<L, MR, NR>(c, i, j);
                i += MR;
            }
            while i + 4 <= self.m {
                self.tile::<L, 4, NR>(c, i, j);
                i += 4;
            }
            while i < self.m {
                self.tile::<L, 1, NR>(c, i, j);
                i += 1;
            }
        }
    }

    #[inline(always)]
    unsafe fn tile<L: Lane, const MR: usize, const NR: usize>(&self, c: *mut f32, i: usize, j: usize) {
        // SAFETY: as in `run`: rows i..i+MR and columns j..j+NR*N exist.
        unsafe {
            let mut acc = [[L::splat(0.0); NR]; MR];
            match self.init {
                Init::Zero => {}
                Init::Bias(bias) => {
                    for row in &mut acc {
                        for (q, v) in row.iter_mut().enumerate() {
                            *v = L::load(bias.as_ptr().add(j + q * L::N));
                        }
                    }
                }
                Init::Accumulate => {
                    for (r, row) in acc.iter_mut().enumerate() {
                        for (q, v) in row.iter_mut().enumerate() {
                            *v = L::load(c.add((i + r) * self.ldc + j + q * L::N));
                        }
                    }
                }
            }
            let mut ap = self.a.data.as_ptr().add(i * self.a.row);
            let mut bp = self.b.as_ptr().add(j);
            for _ in 0..self.k {
                let mut bv = [L::splat(0.0); NR];
                for (q, v) in bv.iter_mut().enumerate() {
                    *v = L::load(bp.add(q * L::N));
                }
                for (r, row) in acc.iter_mut().enumerate() {
                    let av = L::splat(*ap.add(r * self.a.row));
                    for q in 0..NR {
                        row[q] = L::fma(av, bv[q], row[q]);
                    }
                }
                ap = ap.wrapping_add(self.a.col);
                bp = bp.wrapping_add(self.ldb);
            }
            let zero = L::splat(0.0);
            for (r, row) in acc.iter().enumerate() {
                for (q, v) in row.iter().enumerate() {
                    let v = if self.relu { L::max(*v, zero) } else { *v };
                    L::store(c.add((i + r) * self.ldc + j + q * L::N), v);
                }
            }
        }
    }

    #[inline(always)]
    unsafe fn scalar(&self, c: *mut f32, i: usize, j: usize) {
        // SAFETY: (i, j) lies inside the shapes that `gemm` asserted.
        unsafe {
            let out = c.add(i * self.ldc + j);
            let mut acc = match self.init {
                Init::Zero => 0.0,
                Init::Bias(bias) => bias[j],
                Init::Accumulate => *out,
            };
            for p in 0..self.k {
                acc += self.a.data[i * self.a.row + p * self.a.col] * self.b[p * self.ldb + j];
            }
            *out = if self.relu { acc.max(0.0) } else { acc };
        }
    }
}

/// `out[n, k] = b[k, n]ᵀ`.
pub fn transpose(k: usize, n: usize, b: &[f32], out: &mut Vec<f32>) {
    out.resize(k * n, 0.0);
    for p in 0..k {
        for j in 0..n {
            out[j * k + p] = b[p * n + j];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_testkit::{assert_close, random};

    #[test]
    fn every_level_and_shape_matches_plain_loops() {
        for level in Level::available() {
            simd::with_level(level, matches_plain_loops);
        }
    }

    fn matches_plain_loops() {
        for (m, n, k) in [
            (1, 1, 1),
            (6, 64, 64),
            (13, 80, 31),
            (7, 3, 5),
            (64, 17, 100),
            (101, 150, 300),
            (50, 256, 256),
            (0, 4, 4),
            (5, 16, 0),
            (64, 80, 0),
        ] {
            let a = random(m * k, 1);
            let at: Vec<f32> = (0..m * k).map(|i| if m > 0 { a[(i % m.max(1)) * k + i / m.max(1)] } else { 0.0 }).collect();
            let b = random(k * n, 2);
            let bias = random(n, 3);
            for relu in [false, true] {
                let want: Vec<f64> = (0..m * n)
                    .map(|e| {
                        let (i, j) = (e / n, e % n);
                        let s = bias[j] as f64 + (0..k).map(|p| a[i * k + p] as f64 * b[p * n + j] as f64).sum::<f64>();
                        if relu { s.max(0.0) } else { s }
                    })
                    .collect();
                let mut c = vec![9.0; m * n];
                gemm(Precision::F32, Gemm { m, n, k, a: View::rows(&a, k), b: &b, ldb: n, ldc: n, init: Init::Bias(&bias), relu }, &mut c);
                assert_close("rows", &c, &want, 1e-5);
                let mut c: Vec<f32> = (0..m * n).map(|e| bias[e % n]).collect();
                gemm(
                    Precision::F32,
                    Gemm { m, n, k, a: View::transposed(&at, m), b: &b, ldb: n, ldc: n, init: Init::Accumulate, relu },
                    &mut c,
                );
                assert_close("transposed", &c, &want, 1e-5);
            }
        }
    }

    #[test]
    fn bf16_equals_the_product_of_rounded_operands() {
        if !has_bf16() {
            println!("no bf16 tiles here");
            return;
        }
        let round = |v: &[f32]| -> Vec<f32> {
            v.iter()
                .map(|x| {
                    let b = x.to_bits();
                    f32::from_bits((b + 0x7fff + (b >> 16 & 1)) & 0xffff_0000)
                })
                .collect()
        };
        for (m, n, k) in [(1, 1, 1), (6, 64, 64), (33, 80, 31), (7, 3, 5), (64, 17, 100), (252, 256, 256), (16, 64, 253), (5, 16, 0)] {
            let (a, b, bias) = (random(m * k, 1), random(k * n, 2), random(n, 3));
            let at: Vec<f32> = (0..m * k).map(|i| a[(i % m) * k + i / m]).collect();
            let (ra, rb) = (round(&a), round(&b));
            for relu in [false, true] {
                let want: Vec<f64> = (0..m * n)
                    .map(|e| {
                        let (i, j) = (e / n, e % n);
                        let s = bias[j] as f64 + (0..k).map(|p| ra[i * k + p] as f64 * rb[p * n + j] as f64).sum::<f64>();
                        if relu { s.max(0.0) } else { s }
                    })
                    .collect();
                let mut c = vec![9.0; m * n];
                gemm(Precision::Bf16, Gemm { m, n, k, a: View::rows(&a, k), b: &b, ldb: n, ldc: n, init: Init::Bias(&bias), relu }, &mut c);
                assert_close("rows", &c, &want, 1e-5);
                let mut c: Vec<f32> = (0..m * n).map(|e| bias[e % n]).collect();
                gemm(
                    Precision::Bf16,
                    Gemm { m, n, k, a: View::transposed(&at, m), b: &b, ldb: n, ldc: n, init: Init::Accumulate, relu },
                    &mut c,
                );
                assert_close("transposed", &c, &want, 1e-5);
            }
        }
    }
}
