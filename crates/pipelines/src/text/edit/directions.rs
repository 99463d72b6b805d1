//! Directions in which photographs see a region, in a few clusters, and the weights of the nearest ones.

use diorama_geom::glam::DVec3;

/// Most directions.
pub const MOST: usize = 9;
/// Directions that a view is interpolated from.
const NEAREST: usize = 3;
const ITERATIONS: usize = 50;

/// At most [`MOST`] mean directions of unit ones (k-means on the sphere, begun with those farthest from each other).
pub fn clustered(all: &[DVec3]) -> Vec<DVec3> {
    let Some(first) = all.first() else { return Vec::new() };
    let mut centers = vec![*first];
    while centers.len() < MOST {
        let off = |d: &DVec3| centers.iter().map(|c| 1.0 - c.dot(*d)).fold(f64::INFINITY, f64::min);
        let Some(next) = all.iter().max_by(|a, b| off(a).total_cmp(&off(b))).filter(|d| off(d) > 1e-9) else { break };
        centers.push(*next);
    }
    for _ in 0..ITERATIONS {
        let mut sums = vec![DVec3::ZERO; centers.len()];
        for d in all {
            let nearest = (0..centers.len()).max_by(|a, b| centers[*a].dot(*d).total_cmp(&centers[*b].dot(*d)));
            sums[nearest.expect("a center")] += *d;
        }
        let next: Vec<DVec3> = sums.iter().zip(&centers).map(|(s, c)| s.try_normalize().unwrap_or(*c)).collect();
        if next == centers {
            break;
        }
        centers = next;
    }
    centers
}

/// The nearest directions and their weights, which fall with the angle and sum to 1.
pub fn weights(centers: &[DVec3], direction: DVec3) -> Vec<(usize, f32)> {
    let mut near: Vec<(usize, f64)> = centers.iter().enumerate().map(|(k, c)| (k, c.dot(direction).clamp(-1.0, 1.0).acos())).collect();
    near.sort_by(|a, b| a.1.total_cmp(&b.1));
    near.truncate(NEAREST);
    let inverse: Vec<f64> = near.iter().map(|(_, angle)| 1.0 / (angle + 1e-6)).collect();
    let total: f64 = inverse.iter().sum();
    near.iter().zip(inverse).map(|((k, _), w)| (*k, (w / total) as f32)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn directions_are_grouped_and_the_nearest_weigh_most() {
        let d = |x: f64, y: f64| DVec3::new(x, y, 1.0).normalize();
        let all: Vec<DVec3> = (0..30).map(|k| d((k % 3) as f64 + 0.01 * (k / 3) as f64, 0.0)).collect();
        let centers = clustered(&all);
        assert_eq!(centers.len(), MOST);
        assert_eq!(clustered(&[d(0.0, 0.0), d(0.0, 0.0), d(1.0, 0.0)]).len(), 2);
        let centers = [d(0.0, 0.0), d(1.0, 0.0), d(0.0, 1.0), d(-1.0, -1.0)];
        let w = weights(&centers, d(0.9, 0.0));
        assert_eq!(w.len(), 3);
        assert!(w[0].0 == 1 && w[0].1 > 0.6 && (w.iter().map(|(_, v)| v).sum::<f32>() - 1.0).abs() < 1e-6);
        assert!(weights(&centers, d(1.0, 0.0))[0].1 > 0.999);
    }
}
