//! Reductions of slices by lanes of fixed number, so that they become vector code on every level and add up in
//! one order on all of them.

use crate::vector::fma;

/// Partial sums that are kept side by side.
pub(crate) const LANES: usize = 32;

/// Sum of the lanes, by halves.
#[inline(always)]
pub(crate) fn fold(mut lanes: [f32; LANES]) -> f32 {
    let mut half = LANES / 2;
    while half > 0 {
        for j in 0..half {
            lanes[j] += lanes[j + half];
        }
        half /= 2;
    }
    lanes[0]
}

/// Sum of a slice.
#[inline(always)]
pub(crate) fn sum(x: &[f32]) -> f32 {
    let mut lanes = [0.0f32; LANES];
    let blocks = x.chunks_exact(LANES);
    let tail: f32 = blocks.remainder().iter().sum();
    for block in blocks {
        for (lane, v) in lanes.iter_mut().zip(block) {
            *lane += v;
        }
    }
    fold(lanes) + tail
}

/// `Σ x y`
#[inline(always)]
pub(crate) fn dot<const F: bool>(x: &[f32], y: &[f32]) -> f32 {
    let mut lanes = [0.0f32; LANES];
    let (xs, ys) = (x.chunks_exact(LANES), y.chunks_exact(LANES));
    let tail: f32 = xs.remainder().iter().zip(ys.remainder()).map(|(x, y)| x * y).sum();
    for (x, y) in xs.zip(ys) {
        for j in 0..LANES {
            lanes[j] = fma::<F>(x[j], y[j], lanes[j]);
        }
    }
    fold(lanes) + tail
}

/// Mean of a slice and `Σ (x − mean)²`, from sums about the mean of the first elements, which is close enough to avoid cancellation.
#[inline(always)]
pub(crate) fn moments<const F: bool>(x: &[f32]) -> (f32, f32) {
    let (n, near) = (x.len() as f32, x.len().min(LANES));
    let origin = sum(&x[..near]) / near as f32;
    let (mut sums, mut squares) = ([0.0f32; LANES], [0.0f32; LANES]);
    let blocks = x.chunks_exact(LANES);
    let (mut sum, mut square) = (0.0, 0.0);
    for v in blocks.remainder() {
        let v = v - origin;
        sum += v;
        square = fma::<F>(v, v, square);
    }
    for block in blocks {
        for j in 0..LANES {
            let v = block[j] - origin;
            sums[j] += v;
            squares[j] = fma::<F>(v, v, squares[j]);
        }
    }
    (sum, square) = (sum + fold(sums), square + fold(squares));
    let shift = sum / n;
    let about = square - sum * shift;
    (origin + shift, if about < 0.0 { 0.0 } else { about })
}

/// Largest value of a slice, −∞ where it is empty. NaN is passed over.
#[inline(always)]
pub(crate) fn most(x: &[f32]) -> f32 {
    let mut lanes = [f32::NEG_INFINITY; LANES];
    let blocks = x.chunks_exact(LANES);
    let mut most = f32::NEG_INFINITY;
    for v in blocks.remainder() {
        most = if *v > most { *v } else { most };
    }
    for block in blocks {
        for (lane, v) in lanes.iter_mut().zip(block) {
            *lane = if *v > *lane { *v } else { *lane };
        }
    }
    lanes.iter().fold(most, |a, b| if *b > a { *b } else { a })
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_testkit::random;

    #[test]
    fn they_are_those_of_plain_loops() {
        for n in [0, 1, 31, 32, 33, 1000] {
            let (x, y) = (random(n, 1), random(n, 2));
            let close = |a: f32, b: f64| assert!((a as f64 - b).abs() < 1e-5 * n.max(1) as f64, "{n}: {a} {b}");
            close(sum(&x), x.iter().map(|v| *v as f64).sum());
            close(dot::<false>(&x, &y), x.iter().zip(&y).map(|(x, y)| (x * y) as f64).sum());
            if n > 0 {
                let (mean, squares) = moments::<false>(&x);
                let want = x.iter().map(|v| *v as f64).sum::<f64>() / n as f64;
                close(mean, want);
                close(squares, x.iter().map(|v| (*v as f64 - want).powi(2)).sum());
            }
            assert_eq!(most(&x), x.iter().fold(f32::NEG_INFINITY, |a, b| a.max(*b)));
        }
    }
}
