//! Counter-based random numbers: the value is a pure function of (seed, stream, counter), so a run
//! resumes exactly without storing generator state.

/// A stream of random numbers addressed by counter.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Rng {
    key: u64,
}

/// The finalizer of SplitMix64 (Steele, Lea, Flood 2014): a bijection with full avalanche.
fn mix(mut z: u64) -> u64 {
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

const GOLDEN: u64 = 0x9e37_79b9_7f4a_7c15;

impl Rng {
    /// Streams with different `(seed, stream)` are independent.
    pub fn new(seed: u64, stream: u64) -> Self {
        Self { key: mix(mix(seed.wrapping_add(GOLDEN)) ^ stream.wrapping_mul(GOLDEN)) }
    }

    /// The key that, besides the counter, determines the bits: `mix(key ^ mix(counter · golden + key))`.
    pub fn key(&self) -> u64 {
        self.key
    }

    /// 64 random bits at `counter`.
    #[inline]
    pub fn bits(&self, counter: u64) -> u64 {
        mix(self.key ^ mix(counter.wrapping_mul(GOLDEN).wrapping_add(self.key)))
    }

    /// A number in [0, 1) with 24 random bits.
    #[inline]
    pub fn uniform(&self, counter: u64) -> f32 {
        (self.bits(counter) >> 40) as f32 * (1.0 / (1u64 << 24) as f32)
    }

    /// An integer in `0..n`; `n` must not be 0.
    #[inline]
    pub fn below(&self, counter: u64, n: u64) -> u64 {
        ((self.bits(counter) as u128 * n as u128) >> 64) as u64
    }

    /// A standard normal number (Box–Muller on counters `2c` and `2c + 1`).
    pub fn normal(&self, counter: u64) -> f32 {
        let u = 1.0 - self.uniform(2 * counter);
        let v = self.uniform(2 * counter + 1);
        (-2.0 * u.ln()).sqrt() * (std::f32::consts::TAU * v).cos()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn uniform_has_the_right_moments() {
        let rng = Rng::new(7, 3);
        let n = 100_000;
        let mean: f64 = (0..n).map(|i| rng.uniform(i) as f64).sum::<f64>() / n as f64;
        let var: f64 = (0..n).map(|i| (rng.uniform(i) as f64 - 0.5).powi(2)).sum::<f64>() / n as f64;
        assert!((mean - 0.5).abs() < 5e-3, "{mean}");
        assert!((var - 1.0 / 12.0).abs() < 1e-3, "{var}");
    }

    #[test]
    fn streams_differ_and_repeat() {
        assert_eq!(Rng::new(1, 2).bits(3), Rng::new(1, 2).bits(3));
        assert_ne!(Rng::new(1, 2).bits(3), Rng::new(1, 3).bits(3));
        assert_ne!(Rng::new(1, 2).bits(3), Rng::new(2, 2).bits(3));
    }

    #[test]
    fn below_stays_below() {
        let rng = Rng::new(0, 0);
        assert!((0..10_000).all(|i| rng.below(i, 7) < 7));
    }
}
