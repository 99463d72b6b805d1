//! Homographies between photographs: `[u, v, 1] ∝ H [x, y, 1]`, from matches with outliers (Fischler and Bolles 1981).

use diorama_geom::glam::{DMat3, DVec2, DVec3};
use diorama_geom::rng::Rng;
use nalgebra::{DMatrix, SymmetricEigen};

/// Pixels by which a match may miss its place.
pub const INLIER_PX: f64 = 2.5;
/// Samples of four matches.
const SAMPLES: u64 = 400;
const STREAM: u64 = 85;
/// Second smallest eigenvalue of the equations over the largest, below which they do not tell a homography.
const LEAST_SPREAD: f64 = 1e-9;

/// A match: a pixel of one photograph, and the same point in the other.
pub type Match = (DVec2, DVec2);

/// Where a homography takes a pixel; none behind its horizon.
pub fn apply(h: &DMat3, p: DVec2) -> Option<DVec2> {
    let q = *h * DVec3::new(p.x, p.y, 1.0);
    (q.z > 1e-9).then(|| DVec2::new(q.x, q.y) / q.z)
}

/// The homography that takes most matches to within [`INLIER_PX`], by least squares over these; and their number. None of fewer than four
/// matches, or where no four of them have one.
pub fn ransac(matches: &[Match], seed: u64) -> Option<(DMat3, usize)> {
    if matches.len() < 4 {
        return None;
    }
    let rng = Rng::new(seed, STREAM);
    let sample = |s: u64| {
        let chosen: Vec<Match> = (0..4).map(|k| matches[rng.below(4 * s + k, matches.len() as u64) as usize]).collect();
        let h = least_squares(&chosen)?;
        Some((h, inliers(&h, matches).count()))
    };
    // Of equals, the first.
    let best = (0..SAMPLES).filter_map(sample).reduce(|best, next| if next.1 > best.1 { next } else { best })?;
    let own: Vec<Match> = inliers(&best.0, matches).copied().collect();
    let refined = least_squares(&own).map(|h| (h, inliers(&h, matches).count()));
    match refined {
        Some(refined) if refined.1 >= best.1 => Some(refined),
        _ => (best.1 >= 4).then_some(best),
    }
}

fn inliers<'a>(h: &'a DMat3, matches: &'a [Match]) -> impl Iterator<Item = &'a Match> {
    matches.iter().filter(|(from, to)| apply(h, *from).is_some_and(|p| p.distance(*to) < INLIER_PX))
}

/// The direct linear transform of at least four matches (Hartley and Zisserman 2004, section 4.1), on coordinates of mean 0 and mean length √2.
fn least_squares(matches: &[Match]) -> Option<DMat3> {
    if matches.len() < 4 {
        return None;
    }
    let (from, to) = (normalization(matches.iter().map(|m| m.0))?, normalization(matches.iter().map(|m| m.1))?);
    let mut squares = DMatrix::<f64>::zeros(9, 9);
    for (p, q) in matches {
        let (p, q) = (from * DVec3::new(p.x, p.y, 1.0), to * DVec3::new(q.x, q.y, 1.0));
        let p = [p.x, p.y, 1.0];
        for (row, v) in [(0, q.x), (1, q.y)] {
            let mut a = [0.0; 9];
            for k in 0..3 {
                (a[3 * row + k], a[6 + k]) = (p[k], -v * p[k]);
            }
            for (i, j) in (0..9).flat_map(|i| (0..9).map(move |j| (i, j))) {
                squares[(i, j)] += a[i] * a[j];
            }
        }
    }
    let eigen = SymmetricEigen::new(squares);
    let mut order: Vec<usize> = (0..9).collect();
    order.sort_by(|a, b| eigen.eigenvalues[*a].total_cmp(&eigen.eigenvalues[*b]));
    // Points of a line leave more than one.
    if eigen.eigenvalues[order[1]] < LEAST_SPREAD * eigen.eigenvalues[order[8]] {
        return None;
    }
    let v = eigen.eigenvectors.column(order[0]);
    let normalized = DMat3::from_cols_array(&[v[0], v[3], v[6], v[1], v[4], v[7], v[2], v[5], v[8]]);
    let h = to.inverse() * normalized * from;
    // Of both signs, the one by which the matches are before the horizon.
    let first = h * DVec3::new(matches[0].0.x, matches[0].0.y, 1.0);
    let h = if first.z < 0.0 { h * -1.0 } else { h };
    (h.is_finite() && h.determinant().abs() > 1e-12 * h.to_cols_array().iter().fold(0.0f64, |m, v| m.max(v.abs())).powi(3)).then_some(h)
}

/// Moves points to mean 0 and mean length √2; none where they are all the same.
fn normalization(points: impl Iterator<Item = DVec2> + Clone) -> Option<DMat3> {
    let n = points.clone().count() as f64;
    let mean = points.clone().sum::<DVec2>() / n;
    let length = points.map(|p| p.distance(mean)).sum::<f64>() / n;
    (length > 1e-9).then(|| {
        let scale = std::f64::consts::SQRT_2 / length;
        DMat3::from_scale(DVec2::splat(scale)) * DMat3::from_translation(-mean)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// One that turns, shears and foreshortens.
    fn truth() -> DMat3 {
        DMat3::from_cols_array(&[0.9, 0.2, 8e-4, -0.15, 1.1, 5e-4, 12.0, -7.0, 1.0])
    }

    fn matches(n: u64, outliers: u64) -> Vec<Match> {
        let rng = Rng::new(3, 0);
        let at = |i: u64, s: f32| DVec2::new((s * rng.uniform(2 * i)) as f64, (s * rng.uniform(2 * i + 1)) as f64);
        let right = (0..n).map(|i| at(i, 200.0)).map(|p| (p, apply(&truth(), p).unwrap()));
        right.chain((0..outliers).map(|i| (at(1000 + i, 200.0), at(5000 + i, 200.0)))).collect()
    }

    #[test]
    fn a_third_of_outliers_changes_nothing() {
        let (h, inliers) = ransac(&matches(40, 20), 0).unwrap();
        assert!((40..45).contains(&inliers), "{inliers}");
        for p in [DVec2::ZERO, DVec2::new(200.0, 0.0), DVec2::new(90.0, 160.0)] {
            assert!(apply(&h, p).unwrap().distance(apply(&truth(), p).unwrap()) < 0.5);
        }
    }

    #[test]
    fn exact_matches_give_the_exact_homography() {
        let (h, inliers) = ransac(&matches(12, 0), 1).unwrap();
        let scaled = h * (1.0 / h.z_axis.z);
        assert_eq!(inliers, 12);
        let worst = scaled.to_cols_array().iter().zip(truth().to_cols_array()).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        assert!(worst < 1e-6, "{worst}");
    }

    #[test]
    fn a_line_has_no_homography() {
        let line: Vec<Match> = (0..9).map(|i| (DVec2::splat(i as f64), DVec2::splat(2.0 * i as f64))).collect();
        assert!(ransac(&line, 0).is_none());
        assert!(ransac(&line[..3], 0).is_none());
    }
}
