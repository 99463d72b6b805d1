//! Points of a pixel's samples: Sobol's first two dimensions, scrambled after Owen by hashes and shuffled anew for each pair of dimensions
//! (Burley 2020, "Practical Hash-based Owen Scrambling"). A point is a pure function of seed, pixel, sample and dimension.

/// Numbers of one sample of one pixel.
#[derive(Clone, Copy, Debug)]
pub struct Sampler {
    seed: u32,
    index: u32,
    dimension: u32,
}

/// A hash of good avalanche (Wellons 2018, "lowbias32").
#[inline(always)]
fn hash(mut x: u32) -> u32 {
    x = (x ^ (x >> 16)).wrapping_mul(0x7feb_352d);
    x = (x ^ (x >> 15)).wrapping_mul(0x846c_a68b);
    x ^ (x >> 16)
}

/// Owen scrambling of reversed bits: each bit is flipped by a hash of those below it (Laine and Karras 2011, constants of Burley).
#[inline(always)]
fn scramble_reversed(mut x: u32, seed: u32) -> u32 {
    x = x.wrapping_add(seed);
    x ^= x.wrapping_mul(0x6c50_b47c);
    x ^= x.wrapping_mul(0xb82f_1e52);
    x ^= x.wrapping_mul(0xc7af_e638);
    x ^ x.wrapping_mul(0x8d22_f6e6)
}

/// Sobol's second dimension with reversed bits: the Pascal matrix modulo 2, factor by factor.
#[inline(always)]
fn pascal(mut x: u32) -> u32 {
    x ^= (x >> 1) & 0x5555_5555;
    x ^= (x >> 2) & 0x3333_3333;
    x ^= (x >> 4) & 0x0f0f_0f0f;
    x ^= (x >> 8) & 0x00ff_00ff;
    x ^ ((x >> 16) & 0x0000_ffff)
}

/// The highest 24 bits as a number in `[0, 1)`.
#[inline(always)]
fn unit(bits: u32) -> f32 {
    (bits >> 8) as f32 * (1.0 / (1 << 24) as f32)
}

/// The part of a pixel's seed that all pixels share.
#[inline(always)]
pub fn seed_of(seed: u64) -> u32 {
    hash(seed as u32 ^ hash((seed >> 32) as u32 ^ 0x9e37_79b9))
}

impl Sampler {
    #[inline(always)]
    pub fn new(seed: u64, pixel: u32, sample: u32) -> Sampler {
        Sampler { seed: hash(pixel ^ seed_of(seed)), index: sample, dimension: 0 }
    }

    /// The next two numbers in `[0, 1)`; over the samples of a pixel they fill the square evenly.
    #[inline(always)]
    pub fn pair(&mut self) -> [f32; 2] {
        self.skip_pair();
        pair_of(self.seed, self.index, self.dimension)
    }

    /// Leaves out the next two numbers.
    #[inline(always)]
    pub fn skip_pair(&mut self) {
        self.dimension = self.dimension.wrapping_add(1);
    }

    /// The next number in `[0, 1)`, without regard to the other samples: for decisions between two ways.
    #[inline(always)]
    pub fn one(&mut self) -> f32 {
        self.dimension = self.dimension.wrapping_add(1);
        unit(hash(self.seed ^ self.index.wrapping_mul(0x85eb_ca6b) ^ self.dimension.wrapping_mul(0x9e37_79b9)))
    }
}

#[inline(always)]
fn pair_of(seed: u32, index: u32, dimension: u32) -> [f32; 2] {
    let seed = hash(seed ^ dimension.wrapping_mul(0x9e37_79b9));
    let index = scramble_reversed(index.reverse_bits(), seed).reverse_bits();
    // Both dimensions with reversed bits.
    let (first, second) = (index, pascal(index));
    let scrambled = |bits: u32, salt: u32| unit(scramble_reversed(bits, hash(seed ^ salt)).reverse_bits());
    [scrambled(first, 0x68bc_21eb), scrambled(second, 0x02e5_be93)]
}

/// The two numbers that samplers came to: the first ones, and the second ones.
#[inline(always)]
pub fn pairs<const N: usize>(samplers: &[Sampler; N]) -> [[f32; N]; 2] {
    let mut numbers = [[0.0; N]; 2];
    for i in 0..N {
        let Sampler { seed, index, dimension } = samplers[i];
        [numbers[0][i], numbers[1][i]] = pair_of(seed, index, dimension);
    }
    numbers
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn powers_of_two_of_points_are_stratified_in_all_elementary_intervals() {
        for pixel in 0..5 {
            let points: Vec<[f32; 2]> = (0..64)
                .map(|i| {
                    let mut s = Sampler::new(7, pixel, i);
                    s.pair();
                    s.pair()
                })
                .collect();
            for log in 0..=6 {
                let (columns, rows) = (1 << log, 64 >> log);
                let mut seen = vec![0; 64];
                points.iter().for_each(|p| seen[(p[0] * columns as f32) as usize * rows + (p[1] * rows as f32) as usize] += 1);
                assert!(seen.iter().all(|n| *n == 1), "pixel {pixel}, {columns} × {rows}");
            }
        }
    }

    #[test]
    fn pixels_dimensions_and_seeds_are_independent() {
        let draw = |seed: u64, pixel: u32, dimension: usize, i: u32| {
            let mut s = Sampler::new(seed, pixel, i);
            (0..dimension).for_each(|_| {
                s.pair();
            });
            s.pair()[0] as f64 - 0.5
        };
        let n = 4096;
        let correlation = |a: &dyn Fn(u32) -> f64, b: &dyn Fn(u32) -> f64| 12.0 * (0..n).map(|i| a(i) * b(i)).sum::<f64>() / n as f64;
        assert!(correlation(&|i| draw(1, 5, 0, i), &|i| draw(1, 5, 1, i)).abs() < 0.06);
        assert!(correlation(&|i| draw(1, 5, 0, i), &|i| draw(1, 6, 0, i)).abs() < 0.06);
        assert!(correlation(&|i| draw(1, 5, 0, i), &|i| draw(2, 5, 0, i)).abs() < 0.06);
        assert!((correlation(&|i| draw(1, 5, 0, i), &|i| draw(1, 5, 0, i)) - 1.0).abs() < 0.01);
        // Sample 0 of neighboring pixels is not the same either.
        let first: Vec<f64> = (0..n).map(|pixel| draw(1, pixel, 0, 0)).collect();
        let mean = first.iter().sum::<f64>() / n as f64;
        let spread = first.iter().map(|v| v * v).sum::<f64>() / n as f64;
        assert!(mean.abs() < 0.02 && (12.0 * spread - 1.0).abs() < 0.05, "{mean} {spread}");
    }
}
