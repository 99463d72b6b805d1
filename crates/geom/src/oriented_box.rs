//! Boxes with any orientation.

use crate::Pose;
use glam::{DMat3, DVec3};

/// A box given by its center, axes and side lengths.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OrientedBox {
    /// Center, and axes as columns.
    pub place: Pose,
    /// Lengths along the axes.
    pub sides: DVec3,
}

impl OrientedBox {
    /// Whether a point lies inside or on the surface.
    pub fn contains(&self, p: DVec3) -> bool {
        let q = self.place.inverse().point(p).abs();
        q.cmple(0.5 * self.sides).all()
    }

    /// First and last `t` of the part of the ray `origin + t dir` inside the box; `None` if the ray misses.
    pub fn intersect(&self, origin: DVec3, dir: DVec3) -> Option<(f64, f64)> {
        let to_box: DMat3 = self.place.rotation.transpose();
        let (o, d) = (to_box * (origin - self.place.translation), to_box * dir);
        let (mut near, mut far) = (f64::NEG_INFINITY, f64::INFINITY);
        for k in 0..3 {
            let half = 0.5 * self.sides[k];
            let (a, b) = ((-half - o[k]) / d[k], (half - o[k]) / d[k]);
            // A ray parallel to a side gives ±∞ outside its planes and NaN on them; min and max ignore NaN.
            (near, far) = (near.max(a.min(b)), far.min(a.max(b)));
        }
        (near < far && far > 0.0).then_some((near, far))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Rng;

    #[test]
    fn rays_enter_and_leave_at_the_walls() {
        let rng = Rng::new(1, 2);
        let at = |i: u64| DVec3::from_array(std::array::from_fn(|k| rng.uniform(i * 3 + k as u64) as f64 * 4.0 - 2.0));
        let place = Pose::look_at(DVec3::new(0.3, -0.2, 0.1), DVec3::new(1.0, 2.0, -0.5), DVec3::Z);
        let b = OrientedBox { place, sides: DVec3::new(1.0, 2.0, 1.5) };
        let mut hits = 0;
        for i in 0..500 {
            let (o, d) = (at(2 * i), at(2 * i + 1).normalize());
            let inside = |t: f64| b.contains(o + d * t);
            match b.intersect(o, d) {
                Some((near, far)) => {
                    hits += 1;
                    assert!(inside(near + 1e-9) && inside(far - 1e-9) && !inside(near - 1e-6) && !inside(far + 1e-6));
                }
                None => assert!((0..400).all(|k| !inside(k as f64 * 0.02))),
            }
        }
        assert!(hits > 50, "{hits}");
        assert_eq!(b.intersect(place.translation + DVec3::new(0.0, 0.0, 9.0), DVec3::Z), None, "behind the ray");
    }
}
