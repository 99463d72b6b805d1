//! Rays and axis-aligned boxes.

use glam::DVec3;

/// `x(t) = origin + t * direction`. The direction has unit length, so t is a distance.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ray {
    pub origin: DVec3,
    pub direction: DVec3,
}

/// A box given by its lowest and highest corner.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Aabb {
    pub min: DVec3,
    pub max: DVec3,
}

impl Aabb {
    /// A cube with edges of length `2 half`.
    pub fn cube(center: DVec3, half: f64) -> Aabb {
        Aabb { min: center - DVec3::splat(half), max: center + DVec3::splat(half) }
    }

    /// Whether a point lies inside or on the surface.
    pub fn contains(&self, x: DVec3) -> bool {
        x.cmpge(self.min).all() && x.cmple(self.max).all()
    }

    /// Entry and exit distance (slab method), clipped to t ≥ 0; `None` if the ray misses.
    pub fn intersect(&self, ray: &Ray) -> Option<(f64, f64)> {
        let inv = ray.direction.recip();
        let a = (self.min - ray.origin) * inv;
        let b = (self.max - ray.origin) * inv;
        let near = a.min(b).max_element().max(0.0);
        let far = a.max(b).min_element();
        (near < far).then_some((near, far))
    }
}
