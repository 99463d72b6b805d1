//! Stands in for `gemm`, the matrix product of burn's CPU back end.
//!
//! Layers and networks of diorama call `diorama-kernels`; burn's own product is left to a `matmul` that somebody writes in burn's
//! words. The crate in whose place this stands is mostly complex numbers, f16 and instruction sets that nobody calls here:
//! four of its megabytes of code stood in the program.

use half::f16;
use std::any::TypeId;
use std::ops::{Add, Mul};

/// Who computes a product.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Parallelism {
    None,
    /// All threads of rayon's pool; the number that the interface asks for is not heeded.
    #[cfg(feature = "rayon")]
    Rayon(usize),
}

/// A strided view: element (row, column) at `start + row * rows + column * columns`.
#[derive(Clone, Copy)]
struct View<P> {
    start: P,
    rows: isize,
    columns: isize,
}

/// The elements of a product and the numbers it is summed in.
trait Element: Copy + Send + Sync + 'static {
    type Sum: Copy + Default + Send + Sync + Add<Output = Self::Sum> + Mul<Output = Self::Sum>;
    fn widen(self) -> Self::Sum;
    fn narrow(sum: Self::Sum) -> Self;
}

macro_rules! element {
    ($t:ty) => {
        impl Element for $t {
            type Sum = $t;
            fn widen(self) -> $t {
                self
            }
            fn narrow(sum: $t) -> $t {
                sum
            }
        }
    };
}
element!(f32);
element!(f64);

impl Element for f16 {
    type Sum = f32;
    fn widen(self) -> f32 {
        self.to_f32()
    }
    fn narrow(sum: f32) -> f16 {
        f16::from_f32(sum)
    }
}

/// dst := alpha dst + beta lhs rhs with lhs (m, k) and rhs (k, n), of `f32`, `f64` or `f16` (summed in f32); dst is read only where
/// `read_dst` is set. Panics for other types.
///
/// # Safety
/// Every element of the three views must lie inside its memory, and dst must not overlap lhs or rhs.
#[allow(clippy::too_many_arguments)]
pub unsafe fn gemm<T: 'static>(
    m: usize,
    n: usize,
    k: usize,
    dst: *mut T,
    dst_cs: isize,
    dst_rs: isize,
    read_dst: bool,
    lhs: *const T,
    lhs_cs: isize,
    lhs_rs: isize,
    rhs: *const T,
    rhs_cs: isize,
    rhs_rs: isize,
    alpha: T,
    beta: T,
    _conj_dst: bool,
    _conj_lhs: bool,
    _conj_rhs: bool,
    parallelism: Parallelism,
) {
    let scale = [&raw const alpha, &raw const beta];
    macro_rules! product_of {
        ($t:ty) => {
            if TypeId::of::<T>() == TypeId::of::<$t>() {
                let dst = View { start: dst.cast::<$t>(), rows: dst_rs, columns: dst_cs };
                let lhs = View { start: lhs.cast::<$t>(), rows: lhs_rs, columns: lhs_cs };
                let rhs = View { start: rhs.cast::<$t>(), rows: rhs_rs, columns: rhs_cs };
                // SAFETY: T is $t, and the views are the caller's.
                let [alpha, beta] = scale.map(|s| unsafe { s.cast::<$t>().read() });
                return unsafe { product([m, n, k], dst, read_dst.then_some(alpha), lhs, rhs, beta, parallelism) };
            }
        };
    }
    product_of!(f32);
    product_of!(f64);
    product_of!(f16);
    panic!("no matrix product of {}", std::any::type_name::<T>());
}

/// Pointers cross threads with the rows that each thread owns.
struct Shared<T>(T);
// SAFETY: every thread works on rows of its own.
unsafe impl<T> Sync for Shared<T> {}

/// # Safety
/// As [`gemm`].
unsafe fn product<T: Element>(
    [m, n, k]: [usize; 3],
    dst: View<*mut T>,
    keep: Option<T>,
    lhs: View<*const T>,
    rhs: View<*const T>,
    beta: T,
    parallelism: Parallelism,
) {
    // SAFETY: inside rhs by the caller's word.
    let packed: Vec<T::Sum> =
        (0..k * n).map(|i| unsafe { *rhs.start.offset((i / n) as isize * rhs.rows + (i % n) as isize * rhs.columns) }.widen()).collect();
    let views = Shared((dst, lhs));
    let row = |i: usize| {
        let (dst, lhs) = (&views).0;
        let mut sums = vec![T::Sum::default(); n];
        for (p, of_row) in packed.chunks_exact(n.max(1)).enumerate() {
            // SAFETY: inside lhs by the caller's word.
            let a = unsafe { *lhs.start.offset(i as isize * lhs.rows + p as isize * lhs.columns) }.widen();
            for (sum, &b) in sums.iter_mut().zip(of_row) {
                *sum = *sum + a * b;
            }
        }
        for (j, &sum) in sums.iter().enumerate() {
            // SAFETY: inside dst by the caller's word; nobody else holds row i.
            let to = unsafe { &mut *dst.start.offset(i as isize * dst.rows + j as isize * dst.columns) };
            let sum = beta.widen() * sum;
            *to = T::narrow(keep.map_or(sum, |alpha| alpha.widen() * to.widen() + sum));
        }
    };
    match parallelism {
        #[cfg(feature = "rayon")]
        Parallelism::Rayon(_) => {
            use rayon::prelude::*;
            (0..m).into_par_iter().for_each(row);
        }
        Parallelism::None => (0..m).for_each(row),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check<T: Element + std::fmt::Debug>(of: impl Fn(f64) -> T, to: impl Fn(T) -> f64, parallelism: Parallelism) {
        let (m, n, k) = (5, 7, 3);
        let lhs: Vec<T> = (0..m * k).map(|i| of((i % 5) as f64 - 2.0)).collect();
        let rhs: Vec<T> = (0..k * n).map(|i| of((i % 7) as f64 * 0.5)).collect();
        for (transposed, read) in [(false, false), (true, false), (false, true)] {
            let mut dst = vec![of(4.0); m * n];
            let (lhs_cs, lhs_rs) = if transposed { (m as isize, 1) } else { (1, k as isize) };
            let [d, l, r] = [dst.as_mut_ptr(), lhs.as_ptr().cast_mut(), rhs.as_ptr().cast_mut()];
            // SAFETY: shapes and strides are those of the vectors.
            unsafe { gemm(m, n, k, d, 1, n as isize, read, l, lhs_cs, lhs_rs, r, 1, n as isize, of(0.5), of(2.0), false, false, false, parallelism) };
            for i in 0..m {
                for j in 0..n {
                    let at = |p| to(lhs[if transposed { p * m + i } else { i * k + p }]);
                    let sum: f64 = (0..k).map(|p| at(p) * to(rhs[p * n + j])).sum();
                    assert_eq!(to(dst[i * n + j]), 2.0 * sum + if read { 2.0 } else { 0.0 }, "{i} {j}");
                }
            }
        }
    }

    #[test]
    fn products_of_every_type_and_layout() {
        check(|x| x as f32, f64::from, Parallelism::None);
        check(|x| x, |x| x, Parallelism::None);
        check(f16::from_f64, f16::to_f64, Parallelism::None);
        #[cfg(feature = "rayon")]
        check(|x| x as f32, f64::from, Parallelism::Rayon(0));
    }
}
