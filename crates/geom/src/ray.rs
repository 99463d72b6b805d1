//! Rays and axis-aligned boxes.

use glam::DVec3;

/// `x(t) = origin + t * direction`, direction of unit length, so t is metric.
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
    pub fn cube(center: DVec3, half: f64) -> Aabb {
        Aabb { min: center - DVec3::splat(half), max: center + DVec3::splat(half) }
    }

    pub fn contains(&self, x: DVec3) -> bool {
        x.cmpge(self.min).all() && x.cmple(self.max).all()
    }

    /// Entry and exit distance (slab method), clipped to t ≥ 0; `None` when the ray misses.
    pub fn intersect(&self, ray: &Ray) -> Option<(f64, f64)> {
        let inv = ray.direction.recip();
        let a = (self.min - ray.origin) * inv;
        let b = (self.max - ray.origin) * inv;
        let near = a.min(b).max_element().max(0.0);
        let far = a.max(b).min_element();
        (near < far).then_some((near, far))
    }
}
