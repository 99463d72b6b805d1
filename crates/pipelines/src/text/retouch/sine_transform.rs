//! The discrete sine transform (DST-I) of any length in O(n log n), as a convolution with a chirp (Bluestein 1970).

use nalgebra::Complex;
use std::f64::consts::PI;

type C = Complex<f64>;

/// The transform `S_k = Σ x_j sin(π (j+1)(k+1) / (n+1))` of one length.
pub(super) struct SineTransform {
    /// `w_j = exp(i π (j+1)² / (2(n+1)))`: the kernel is the imaginary part of `w_j w_k / w_(k−j)`.
    chirp: Vec<C>,
    /// Spectrum of `1 / w_d` over differences d, divided by the length of the convolution.
    spectrum: Vec<C>,
    fourier: Fourier,
}

impl SineTransform {
    pub fn new(n: usize) -> SineTransform {
        let size = (2 * n).next_power_of_two();
        // The exponent repeats with the square modulo 4(n+1), which keeps its argument small.
        let chirp_at = |j: usize| C::from_polar(1.0, PI * ((j * j) % (4 * (n + 1))) as f64 / (2 * (n + 1)) as f64);
        let fourier = Fourier::new(size);
        let mut spectrum = vec![C::new(0.0, 0.0); size];
        for d in 0..n {
            let value = chirp_at(d).conj() / size as f64;
            spectrum[d] = value;
            spectrum[(size - d) % size] = value;
        }
        fourier.transform(&mut spectrum);
        SineTransform { chirp: (1..=n).map(chirp_at).collect(), spectrum, fourier }
    }

    /// Scratch memory for [`SineTransform::apply`].
    pub fn scratch(&self) -> Vec<C> {
        vec![C::new(0.0, 0.0); self.spectrum.len()]
    }

    /// Transforms values in place; twice gives them times `(n + 1) / 2`.
    pub fn apply(&self, values: &mut [f64], scratch: &mut [C]) {
        scratch.fill(C::new(0.0, 0.0));
        scratch.iter_mut().zip(values.iter().zip(&self.chirp)).for_each(|(s, (x, w))| *s = w * *x);
        self.fourier.transform(scratch);
        // The conjugate's transform is the inverse, up to the length that the spectrum holds already.
        scratch.iter_mut().zip(&self.spectrum).for_each(|(s, f)| *s = (*s * f).conj());
        self.fourier.transform(scratch);
        values.iter_mut().zip(scratch.iter().zip(&self.chirp)).for_each(|(x, (s, w))| *x = (s.conj() * w).im);
    }
}

/// The discrete Fourier transform of a power of two (Cooley and Tukey 1965).
struct Fourier {
    /// `exp(−2πi k / n)` for the first half of k.
    roots: Vec<C>,
}

impl Fourier {
    fn new(n: usize) -> Fourier {
        Fourier { roots: (0..n / 2).map(|k| C::from_polar(1.0, -2.0 * PI * k as f64 / n as f64)).collect() }
    }

    fn transform(&self, values: &mut [C]) {
        let n = values.len();
        if n < 2 {
            return;
        }
        let shift = usize::BITS - n.trailing_zeros();
        for i in 0..n {
            let j = i.reverse_bits() >> shift;
            if i < j {
                values.swap(i, j);
            }
        }
        let mut half = 1;
        while half < n {
            let stride = n / (2 * half);
            for block in values.chunks_exact_mut(2 * half) {
                let (low, high) = block.split_at_mut(half);
                for ((a, b), root) in low.iter_mut().zip(high).zip(self.roots.iter().step_by(stride)) {
                    let turned = *b * root;
                    (*a, *b) = (*a + turned, *a - turned);
                }
            }
            half *= 2;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_geom::rng::Rng;

    #[test]
    fn the_fast_transform_equals_the_sum() {
        for n in [1, 2, 3, 7, 16, 31, 100, 254] {
            let rng = Rng::new(1, n as u64);
            let x: Vec<f64> = (0..n as u64).map(|i| rng.normal(i) as f64).collect();
            let transform = SineTransform::new(n);
            let mut fast = x.clone();
            transform.apply(&mut fast, &mut transform.scratch());
            for (k, fast) in fast.iter().enumerate() {
                let term = |(j, x): (usize, &f64)| x * (PI * ((j + 1) * (k + 1)) as f64 / (n + 1) as f64).sin();
                let sum: f64 = x.iter().enumerate().map(term).sum();
                assert!((fast - sum).abs() < 1e-10, "{n} {k}: {fast} instead of {sum}");
            }
        }
    }

    #[test]
    fn twice_is_the_identity_times_half_the_period() {
        let n = 1022;
        let x: Vec<f64> = (0..n).map(|i| Rng::new(2, 0).normal(i) as f64).collect();
        let transform = SineTransform::new(n as usize);
        let (mut y, mut scratch) = (x.clone(), transform.scratch());
        transform.apply(&mut y, &mut scratch);
        transform.apply(&mut y, &mut scratch);
        assert!(x.iter().zip(&y).all(|(x, y)| (x - y * 2.0 / (n + 1) as f64).abs() < 1e-12));
    }
}
