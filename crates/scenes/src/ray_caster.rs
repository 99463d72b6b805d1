//! Primitives, procedural textures, one sun with hard shadows, and a box filter over sub-pixels.

use diorama_geom::color::{srgb_from_linear, u8_from_unit};
use diorama_geom::glam::DVec3;
use diorama_geom::{Camera, ImageU8, Pose, Ray};
use rayon::prelude::*;

/// Solid shapes.
#[derive(Clone, Copy, Debug)]
pub enum Shape {
    Sphere {
        center: DVec3,
        radius: f64,
    },
    /// Axis-aligned, then rotated by `angle` about z through its center.
    Box {
        center: DVec3,
        half: DVec3,
        angle: f64,
    },
    /// Upright, with caps.
    Cylinder {
        center: DVec3,
        radius: f64,
        half_height: f64,
    },
}

/// Procedural linear color of a surface point.
#[derive(Clone, Copy, Debug)]
pub enum Texture {
    Checker {
        a: DVec3,
        b: DVec3,
        size: f64,
    },
    Stripes {
        a: DVec3,
        b: DVec3,
        axis: DVec3,
        size: f64,
    },
    /// Rings around the vertical axis through `center`.
    Rings {
        a: DVec3,
        b: DVec3,
        center: DVec3,
        size: f64,
    },
    /// Round dots on a cubic lattice.
    Dots {
        a: DVec3,
        b: DVec3,
        size: f64,
    },
}

/// A shape with its surface.
#[derive(Clone, Copy, Debug)]
pub struct Object {
    pub shape: Shape,
    pub texture: Texture,
    /// Strength of the highlight.
    pub gloss: f64,
}

/// Objects lit by one sun.
#[derive(Clone, Debug)]
pub struct Scene {
    pub objects: Vec<Object>,
    /// Unit direction toward the sun.
    pub sun: DVec3,
    /// Ambient light.
    pub ambient: f64,
}

struct Hit {
    t: f64,
    normal: DVec3,
}

impl Shape {
    fn intersect(&self, ray: &Ray, near: f64) -> Option<Hit> {
        match *self {
            Shape::Sphere { center, radius } => {
                let o = ray.origin - center;
                let b = o.dot(ray.direction);
                let d = b * b - o.length_squared() + radius * radius;
                let root = if d > 0.0 { d.sqrt() } else { return None };
                let t = [-b - root, -b + root].into_iter().find(|t| *t > near)?;
                Some(Hit { t, normal: (o + ray.direction * t) / radius })
            }
            Shape::Box { center, half, angle } => {
                let turn = diorama_geom::glam::DMat3::from_rotation_z(-angle);
                let (o, d) = (turn * (ray.origin - center), turn * ray.direction);
                let (a, b) = ((-half - o) / d, (half - o) / d);
                let (lo, hi) = (a.min(b), a.max(b));
                let (enter, exit) = (lo.max_element(), hi.min_element());
                if enter >= exit {
                    return None;
                }
                let t = [enter, exit].into_iter().find(|t| *t > near)?;
                let q = (o + d * t) / half;
                let m = q.abs();
                let n = if m.x >= m.y && m.x >= m.z {
                    DVec3::new(q.x.signum(), 0.0, 0.0)
                } else if m.y >= m.z {
                    DVec3::new(0.0, q.y.signum(), 0.0)
                } else {
                    DVec3::new(0.0, 0.0, q.z.signum())
                };
                Some(Hit { t, normal: turn.transpose() * n })
            }
            Shape::Cylinder { center, radius, half_height } => {
                let (o, d) = (ray.origin - center, ray.direction);
                let mut best: Option<Hit> = None;
                let mut offer = |t: f64, normal: DVec3| {
                    if t > near && best.as_ref().is_none_or(|h| t < h.t) {
                        best = Some(Hit { t, normal });
                    }
                };
                let (a, b, c) = (d.x * d.x + d.y * d.y, o.x * d.x + o.y * d.y, o.x * o.x + o.y * o.y - radius * radius);
                let disc = b * b - a * c;
                if a > 1e-12 && disc > 0.0 {
                    for t in [(-b - disc.sqrt()) / a, (-b + disc.sqrt()) / a] {
                        let p = o + d * t;
                        if p.z.abs() <= half_height {
                            offer(t, DVec3::new(p.x, p.y, 0.0) / radius);
                        }
                    }
                }
                for side in [-1.0, 1.0] {
                    let t = (side * half_height - o.z) / d.z;
                    let p = o + d * t;
                    if t.is_finite() && p.x * p.x + p.y * p.y <= radius * radius {
                        offer(t, DVec3::new(0.0, 0.0, side));
                    }
                }
                best
            }
        }
    }
}

impl Texture {
    /// Linear color at a point of the surface.
    pub fn color(&self, p: DVec3) -> DVec3 {
        let odd = |v: f64| v.floor() as i64 & 1 == 1;
        let pick = |a: DVec3, b: DVec3, first: bool| if first { a } else { b };
        // A small offset keeps flat faces away from cell borders.
        let p = p + DVec3::new(1.3e-3, 2.1e-3, 3.7e-3);
        match *self {
            Texture::Checker { a, b, size } => {
                let q = (p / size).floor();
                pick(a, b, odd(q.x + q.y + q.z))
            }
            Texture::Stripes { a, b, axis, size } => pick(a, b, odd(p.dot(axis) / size)),
            Texture::Rings { a, b, center, size } => {
                let d = p - center;
                pick(a, b, odd(d.x.hypot(d.y) / size))
            }
            Texture::Dots { a, b, size } => {
                let q = p / size;
                pick(a, b, (q - q.round()).length() < 0.35)
            }
        }
    }
}

impl Scene {
    fn nearest(&self, ray: &Ray, near: f64) -> Option<(&Object, Hit)> {
        let hits = self.objects.iter().filter_map(|o| o.shape.intersect(ray, near).map(|h| (o, h)));
        hits.min_by(|a, b| a.1.t.total_cmp(&b.1.t))
    }

    /// Linear color along a ray, and the distance to the hit.
    pub fn trace(&self, ray: &Ray) -> Option<(DVec3, f64)> {
        let (object, hit) = self.nearest(ray, 1e-6)?;
        let p = ray.origin + ray.direction * hit.t;
        let facing = hit.normal.dot(self.sun);
        let shadow = Ray { origin: p + hit.normal * 1e-5, direction: self.sun };
        let lit = facing > 0.0 && self.nearest(&shadow, 1e-6).is_none();
        let sun = if lit { facing } else { 0.0 };
        let mut c = object.texture.color(p) * (self.ambient * (0.75 + 0.25 * hit.normal.z) + (1.0 - self.ambient) * sun);
        if lit && object.gloss > 0.0 {
            let half = (self.sun - ray.direction).normalize();
            c += DVec3::splat(object.gloss * hit.normal.dot(half).max(0.0).powi(40));
        }
        Some((c, hit.t))
    }

    /// RGBA image of a camera, with `samples²` rays per pixel; transparent where no object is hit.
    pub fn render(&self, camera: &Camera, world_from_camera: &Pose, samples: usize) -> ImageU8 {
        let (w, h) = (camera.width as usize, camera.height as usize);
        let mut data = vec![0u8; w * h * 4];
        data.par_chunks_mut(w * 4).enumerate().for_each(|(y, row)| {
            for (x, px) in row.chunks_exact_mut(4).enumerate() {
                let (mut sum, mut hits) = (DVec3::ZERO, 0.0);
                for s in 0..samples * samples {
                    let at = |i: usize, v: usize| v as f64 + (i as f64 + 0.5) / samples as f64;
                    let d = camera.direction(at(s % samples, x), at(s / samples, y));
                    let ray = Ray { origin: world_from_camera.translation, direction: world_from_camera.rotation * d };
                    if let Some((c, _)) = self.trace(&ray) {
                        // Averaged after the sRGB encoding, so that reduced photographs and renders agree.
                        sum += DVec3::from_array(c.to_array().map(|v| srgb_from_linear(v.clamp(0.0, 1.0) as f32) as f64));
                        hits += 1.0;
                    }
                }
                if hits > 0.0 {
                    let c = sum / hits;
                    px[..3].copy_from_slice(&[c.x, c.y, c.z].map(|v| u8_from_unit(v as f32)));
                    px[3] = u8_from_unit((hits / (samples * samples) as f64) as f32);
                }
            }
        });
        ImageU8 { width: w, height: h, channels: 4, data }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ray(o: [f64; 3], d: [f64; 3]) -> Ray {
        Ray { origin: DVec3::from_array(o), direction: DVec3::from_array(d).normalize() }
    }

    #[test]
    fn shapes_are_hit_where_they_are() {
        let shapes = [
            Shape::Sphere { center: DVec3::ZERO, radius: 1.0 },
            Shape::Box { center: DVec3::ZERO, half: DVec3::ONE, angle: 0.0 },
            Shape::Cylinder { center: DVec3::ZERO, radius: 1.0, half_height: 1.0 },
        ];
        for s in shapes {
            for d in [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]] {
                let h = s.intersect(&ray(d.map(|v: f64| -4.0 * v), d), 0.0).unwrap();
                assert!((h.t - 3.0).abs() < 1e-9, "{s:?}");
                assert!((h.normal + DVec3::from_array(d)).length() < 1e-9, "{s:?} {:?}", h.normal);
            }
            assert!(s.intersect(&ray([5.0, 5.0, 5.0], [1.0, 0.0, 0.0]), 0.0).is_none());
        }
    }

    #[test]
    fn what_the_sun_does_not_reach_is_darker() {
        let white = Texture::Checker { a: DVec3::ONE, b: DVec3::ONE, size: 1.0 };
        let object = |shape| Object { shape, texture: white, gloss: 0.0 };
        let floor = object(Shape::Box { center: DVec3::new(0.0, 0.0, -1.0), half: DVec3::new(5.0, 5.0, 1.0), angle: 0.0 });
        let ball = object(Shape::Sphere { center: DVec3::new(0.0, 0.0, 2.0), radius: 0.5 });
        let scene = Scene { objects: vec![floor, ball], sun: DVec3::Z, ambient: 0.3 };
        let under = scene.trace(&ray([1.0, 0.0, 1.0], [-1.0, 0.0, -1.0])).unwrap().0;
        let beside = scene.trace(&ray([4.0, 0.0, 1.0], [-1.0, 0.0, -1.0])).unwrap().0;
        assert!(under.x < 0.5 * beside.x);
    }
}
