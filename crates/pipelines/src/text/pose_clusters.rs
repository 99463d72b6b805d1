//! Clusters of rotations: k-means on unit quaternions, where `q` and `−q` are one rotation.
//!
//! The distance is `1 − ⟨q₁, q₂⟩²`, a cluster's mean the eigenvector of `Σ q qᵀ` with the largest eigenvalue (Markley et al. 2007), which
//! minimizes the sum of these distances; k-means++ begins (Arthur and Vassilvitskii 2007), and the best of several beginnings is kept.

use diorama_geom::glam::DQuat;
use diorama_geom::rng::Rng;
use nalgebra::{Matrix4, SymmetricEigen, Vector4};

/// Beginnings of which the best is kept.
const RESTARTS: u64 = 20;
const ITERATIONS: usize = 100;
/// Random numbers that a beginning may draw.
const DRAWS: u64 = 1 << 20;

/// Rotations in clusters.
#[derive(Clone, Debug, PartialEq)]
pub struct Clusters {
    pub centers: Vec<DQuat>,
    /// Cluster of each rotation.
    pub of: Vec<usize>,
    /// Sum of the distances to the centers.
    pub spread: f64,
}

/// `1 − ⟨a, b⟩²`: the squared sine of half the angle between two rotations.
pub fn distance(a: DQuat, b: DQuat) -> f64 {
    (1.0 - a.dot(b).powi(2)).max(0.0)
}

/// Mean rotation; the identity of none.
pub fn mean(rotations: &[DQuat]) -> DQuat {
    if rotations.is_empty() {
        return DQuat::IDENTITY;
    }
    let sum: Matrix4<f64> = rotations.iter().map(|q| Vector4::from(q.to_array())).map(|v| v * v.transpose()).sum();
    let eigen = SymmetricEigen::new(sum);
    let largest = eigen.eigenvalues.imax();
    DQuat::from_array(std::array::from_fn(|k| eigen.eigenvectors[(k, largest)])).normalize()
}

/// At most `k` clusters of unit quaternions, fewer where there are not so many different ones; the same for the same seed.
pub fn clusters(rotations: &[DQuat], k: usize, seed: u64) -> Clusters {
    let mut best: Option<Clusters> = None;
    for restart in 0..RESTARTS {
        let found = lloyd(rotations, seed_centers(rotations, k, &Rng::new(seed, restart)));
        if best.as_ref().is_none_or(|b| found.spread < b.spread) {
            best = Some(found);
        }
    }
    best.unwrap_or(Clusters { centers: Vec::new(), of: Vec::new(), spread: 0.0 })
}

/// Centers by k-means++: each next one is drawn with a probability in proportion to its distance from those before.
fn seed_centers(rotations: &[DQuat], k: usize, rng: &Rng) -> Vec<DQuat> {
    let mut centers: Vec<DQuat> = Vec::new();
    let mut off = vec![1.0; rotations.len()];
    let mut draw = 0;
    while centers.len() < k.min(rotations.len()) && draw < DRAWS {
        let total: f64 = off.iter().sum();
        if total < 1e-12 {
            break;
        }
        let mut left = total * rng.uniform(draw) as f64;
        draw += 1;
        let at = off.iter().position(|d| {
            left -= d;
            left < 0.0
        });
        let center = rotations[at.unwrap_or(rotations.len() - 1)];
        off.iter_mut().zip(rotations).for_each(|(d, q)| *d = d.min(distance(*q, center)));
        centers.push(center);
    }
    centers
}

/// Lloyd's iterations until nothing changes.
fn lloyd(rotations: &[DQuat], mut centers: Vec<DQuat>) -> Clusters {
    let nearest = |centers: &[DQuat], q: &DQuat| {
        let by_distance = |a: &usize, b: &usize| distance(*q, centers[*a]).total_cmp(&distance(*q, centers[*b]));
        (0..centers.len()).min_by(by_distance).unwrap_or(0)
    };
    let mut of: Vec<usize> = Vec::new();
    for _ in 0..ITERATIONS {
        let now: Vec<usize> = rotations.iter().map(|q| nearest(&centers, q)).collect();
        if now == of {
            break;
        }
        of = now;
        for (c, center) in centers.iter_mut().enumerate() {
            let own: Vec<DQuat> = rotations.iter().zip(&of).filter(|(_, k)| **k == c).map(|(q, _)| *q).collect();
            if !own.is_empty() {
                *center = mean(&own);
            }
        }
    }
    let spread = rotations.iter().zip(&of).map(|(q, c)| distance(*q, centers[*c])).sum();
    Clusters { centers, of, spread }
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_geom::glam::DVec3;

    /// Rotations within an angle of some, signs at random.
    fn around(center: DQuat, angle: f64, n: usize, seed: u64) -> Vec<DQuat> {
        let rng = Rng::new(seed, 3);
        let v = |k: u64| 2.0 * rng.uniform(k) as f64 - 1.0;
        let near = |i: u64| {
            let axis = DVec3::new(v(5 * i), v(5 * i + 1), v(5 * i + 2)).normalize();
            let q = DQuat::from_axis_angle(axis, angle * v(5 * i + 3)) * center;
            if v(5 * i + 4) < 0.0 { -q } else { q }
        };
        (0..n as u64).map(near).collect()
    }

    #[test]
    fn the_mean_minimizes_the_sum_of_distances_whatever_the_signs() {
        let center = DQuat::from_axis_angle(DVec3::new(1.0, 2.0, -0.5).normalize(), 1.1);
        let all = around(center, 0.5, 200, 1);
        let m = mean(&all);
        let cost = |q: DQuat| all.iter().map(|p| distance(*p, q)).sum::<f64>();
        assert!(distance(m, center) < 0.005 && (m.length() - 1.0).abs() < 1e-12);
        for axis in [DVec3::X, DVec3::Y, DVec3::Z, -DVec3::X, -DVec3::Y, -DVec3::Z] {
            assert!(cost(DQuat::from_axis_angle(axis, 1e-3) * m) > cost(m));
        }
        // Half turns about another axis, an eigenvector too, do not hold it.
        let turned = |axis: DVec3, degrees: f64| DQuat::from_axis_angle(axis, degrees.to_radians());
        let mut spread = vec![turned(DVec3::X, 180.0); 5];
        for axis in [DVec3::Y, DVec3::Z] {
            spread.extend([turned(axis, 90.0); 3].into_iter().chain([turned(axis, -90.0); 3]));
        }
        assert!(distance(mean(&spread), DQuat::IDENTITY) < 1e-12);
        // Half a turn apart about one axis: the distance is 1.
        assert!((distance(center, DQuat::from_axis_angle(DVec3::X, std::f64::consts::PI) * center) - 1.0).abs() < 1e-12);
    }

    #[test]
    fn separate_groups_are_found_whatever_the_order() {
        let centers: Vec<DQuat> =
            (0..5).map(|k| DQuat::from_axis_angle(DVec3::new(1.0, k as f64, 2.0 - k as f64).normalize(), 0.9 + 0.5 * k as f64)).collect();
        let mut all: Vec<(DQuat, usize)> = Vec::new();
        for (k, c) in centers.iter().enumerate() {
            all.extend(around(*c, 0.08, 30 + 10 * k, k as u64).into_iter().map(|q| (q, k)));
        }
        let n = all.len();
        let mixed: Vec<(DQuat, usize)> = (0..n).map(|i| all[i * 37 % n]).collect();
        let found = clusters(&mixed.iter().map(|(q, _)| *q).collect::<Vec<_>>(), 5, 9);
        for (i, (_, a)) in mixed.iter().enumerate() {
            for (j, (_, b)) in mixed.iter().enumerate() {
                assert_eq!(a == b, found.of[i] == found.of[j]);
            }
        }
        assert!(found.centers.iter().all(|c| centers.iter().any(|d| distance(*c, *d) < 1e-3)));
        assert_eq!(found, clusters(&mixed.iter().map(|(q, _)| *q).collect::<Vec<_>>(), 5, 9));
    }

    #[test]
    fn there_are_no_more_clusters_than_different_rotations() {
        let one = clusters(&[DQuat::IDENTITY, -DQuat::IDENTITY, DQuat::IDENTITY], 16, 0);
        assert!(one.centers.len() == 1 && one.spread < 1e-12 && one.of == [0, 0, 0]);
        assert!(clusters(&[], 16, 0).centers.is_empty());
    }
}
