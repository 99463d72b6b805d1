//! Measured limits of the machine, with which the speed of kernels is compared.

use crate::simd::{self, Lane, Level, Plain};
use std::hint::black_box;
use std::time::Instant;

/// Independent sums that keep the multiply-add units busy, and fit 16 registers beside two constants.
const CHAINS: usize = 12;

#[inline(always)]
unsafe fn chains<L: Lane>(rounds: usize) -> f32 {
    // SAFETY: the caller runs this on a CPU that has the set; the store fits 64 floats.
    unsafe {
        let (a, b) = (L::splat(black_box(0.999)), L::splat(black_box(1e-3)));
        let mut x: [L::V; CHAINS] = [L::splat(1.0); CHAINS];
        for _ in 0..rounds {
            for v in &mut x {
                *v = L::fma(*v, a, b);
            }
        }
        let mut out = [0.0f32; 64];
        for v in &x {
            L::store(out.as_mut_ptr(), *v);
            black_box(&out);
        }
        out[0]
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512dq,avx2,fma")]
unsafe fn chains_avx512(rounds: usize) -> f32 {
    // SAFETY: compiled for the set.
    unsafe { chains::<simd::Avx512>(rounds) }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
unsafe fn chains_avx2(rounds: usize) -> f32 {
    // SAFETY: compiled for the set.
    unsafe { chains::<simd::Avx2>(rounds) }
}

/// Multiply-adds of the active SIMD level on this thread, in FLOP/s (two per multiply-add).
pub fn fma_peak(rounds: usize) -> f64 {
    let (n, run): (usize, fn(usize) -> f32) = match simd::level() {
        // SAFETY: `level()` only names sets that this CPU has.
        #[cfg(target_arch = "x86_64")]
        Level::Avx512 => (16, |r| unsafe { chains_avx512(r) }),
        // SAFETY: as above.
        #[cfg(target_arch = "x86_64")]
        Level::Avx2 => (8, |r| unsafe { chains_avx2(r) }),
        // SAFETY: as above.
        #[cfg(target_arch = "aarch64")]
        Level::Neon => (4, |r| unsafe { chains::<simd::Neon>(r) }),
        // SAFETY: plain Rust.
        _ => (8, |r| unsafe { chains::<Plain>(r) }),
    };
    let begin = Instant::now();
    black_box(run(rounds));
    (rounds * CHAINS * n * 2) as f64 / begin.elapsed().as_secs_f64()
}

/// Sequential reads of a buffer on this thread, in bytes per second.
pub fn read_bandwidth(buffer: &[u64]) -> f64 {
    let begin = Instant::now();
    let sum = buffer.chunks_exact(64).fold([0u64; 64], |mut s, c| {
        s.iter_mut().zip(c).for_each(|(s, v)| *s = s.wrapping_add(*v));
        s
    });
    black_box(sum);
    size_of_val(buffer) as f64 / begin.elapsed().as_secs_f64()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn figures_are_plausible() {
        // Between what the slowest CPU in use and the fastest one can do.
        let peak = fma_peak(1 << 16);
        assert!((1e8..1e13).contains(&peak), "{peak}");
        let bandwidth = read_bandwidth(&vec![1; 1 << 18]);
        assert!((1e7..1e13).contains(&bandwidth), "{bandwidth}");
    }
}
