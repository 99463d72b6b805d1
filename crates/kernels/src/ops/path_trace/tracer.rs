//! What rays meet: surfaces, panes and holes, and how much light they let pass.

use super::bsdf::Bsdf;
use super::geometry::{Found, Point};
use super::sampler::Sampler;
use super::surface::Surface;
use super::vector::{V3, along, dot, frame, luminance, scale, times, unit};
use super::{Pixel, Scene, Settings};
use crate::ops::ray_triangles::Ray;
use diorama_geom::glam::DVec3;
use std::cell::Cell;
use std::f32::consts::PI;

/// Surfaces that one ray passes through at most.
pub(super) const PASSED: usize = 64;
/// Reflectance of a pane at normal incidence (index of refraction 1.5).
pub(super) const PANE: f32 = 0.04;

#[inline(always)]
pub fn narrow(v: DVec3) -> V3 {
    [v.x as f32, v.y as f32, v.z as f32]
}

/// A point beside a surface, on the side that `normal` points to, from which rays do not meet it again (Wächter and Binder 2019).
#[inline(always)]
fn beside(p: V3, normal: V3) -> V3 {
    std::array::from_fn(|k| {
        if p[k].abs() < 1.0 / 32.0 {
            return p[k] + normal[k] / 65536.0;
        }
        let steps = (256.0 * normal[k]) as i32;
        f32::from_bits((p[k].to_bits() as i32 + if p[k] < 0.0 { -steps } else { steps }) as u32)
    })
}

pub struct Tracer<'a> {
    pub scene: &'a Scene,
    pub settings: &'a Settings,
    /// Rays that were traced.
    rays: Cell<u64>,
}

/// What a ray comes to, after it passed holes and panes.
pub struct Meeting {
    /// Share of the light that passes on the way.
    pub passed: V3,
    pub found: Option<Met>,
}

pub struct Met {
    pub point: Point,
    pub surface: Surface,
    pub t: f32,
}

/// Where a path is, seen from the side that it came from.
pub struct Vertex {
    pub position: V3,
    pub flat: V3,
    pub frame: [V3; 3],
    pub bsdf: Bsdf,
}

impl Vertex {
    #[inline(always)]
    pub fn new(met: &Met, direction: V3) -> Option<Vertex> {
        let toward = scale(direction, -1.0);
        let flip = |n: V3| if dot(met.point.flat_normal, toward) < 0.0 { scale(n, -1.0) } else { n };
        let (flat, mut normal) = (flip(met.point.flat_normal), flip(met.surface.normal));
        // An interpolated normal may point away from where the surface is seen from: then it is bent just far enough.
        let cosine = dot(normal, toward);
        if cosine < 1e-3 {
            normal = unit(along(normal, 1e-3 - cosine, toward));
        }
        let frame = frame(normal);
        let outgoing = frame.map(|axis| dot(axis, toward));
        let mut material = met.surface.material;
        // Light that passes is not scattered.
        let scattered = 1.0 - met.surface.transmission;
        if scattered < 1.0 {
            material.base_color = scale(material.base_color, scattered);
        }
        let bsdf = Bsdf::new(&material, outgoing)?;
        Some(Vertex { position: beside(met.point.position, flat), flat, frame, bsdf })
    }

    #[inline(always)]
    pub fn local(&self, d: V3) -> V3 {
        self.frame.map(|axis| dot(axis, d))
    }

    #[inline(always)]
    pub fn world(&self, d: V3) -> V3 {
        let [s, t, n] = self.frame;
        std::array::from_fn(|k| d[0] * s[k] + d[1] * t[k] + d[2] * n[k])
    }
}

/// Share of the light that a thin pane lets pass: neither reflected nor absorbed.
#[inline(always)]
fn through(surface: &Surface, cosine: f32) -> V3 {
    let m = (1.0 - cosine.abs()).clamp(0.0, 1.0);
    let reflected = PANE + (1.0 - PANE) * m * m * m * m * m;
    scale(surface.material.base_color, surface.transmission * (1.0 - reflected))
}

impl<'a> Tracer<'a> {
    pub fn new(scene: &'a Scene, settings: &'a Settings) -> Tracer<'a> {
        Tracer { scene, settings, rays: Cell::new(0) }
    }

    /// How many rays were traced.
    pub fn rays(&self) -> u64 {
        self.rays.get()
    }

    #[inline(always)]
    pub fn count_rays(&self, n: usize) {
        self.rays.set(self.rays.get() + n as u64);
    }

    /// Follows a ray, of which the nearest surface is known, to the surface that scatters it; holes and panes let it pass by chance.
    #[inline(always)]
    pub fn meet(&self, mut ray: Ray, mut nearest: Option<Found>, sampler: &mut Sampler) -> Meeting {
        let mut passed = [1.0; 3];
        for _ in 0..PASSED {
            self.count_rays(1);
            let Some(found) = nearest else { return Meeting { passed, found: None } };
            let (point, surface) = self.scene.at(&found);
            let t = found.hit.t;
            if surface.opacity >= 1.0 && surface.transmission == 0.0 {
                return Meeting { passed, found: Some(Met { point, surface, t }) };
            }
            let chance = sampler.one();
            if chance < surface.opacity {
                let share = through(&surface, dot(unit(ray.direction), surface.normal));
                let probability = luminance(share).clamp(0.0, 0.98);
                if chance / surface.opacity >= probability {
                    passed = scale(passed, 1.0 / (1.0 - probability));
                    return Meeting { passed, found: Some(Met { point, surface, t }) };
                }
                passed = times(passed, scale(share, 1.0 / probability));
            }
            ray.range[0] = beyond(t);
            nearest = self.scene.geometry.nearest(&ray);
        }
        Meeting { passed: [0.0; 3], found: None }
    }

    /// Share of distant light that arrives from a direction.
    #[inline(always)]
    fn visible(&self, origin: V3, direction: V3) -> V3 {
        let ray = Ray { origin, direction, range: [0.0, f32::INFINITY] };
        self.count_rays(1);
        if self.scene.geometry.is_blocked(&ray) { [0.0; 3] } else { self.passing(ray) }
    }

    /// Share of light that panes and holes let pass along a ray.
    #[inline(always)]
    pub fn passing(&self, mut ray: Ray) -> V3 {
        let mut share = [1.0; 3];
        for _ in 0..PASSED {
            let Some(found) = self.scene.geometry.nearest_porous(&ray) else { return share };
            let (_, surface) = self.scene.at(&found);
            let pane = through(&surface, dot(ray.direction, surface.normal));
            share = std::array::from_fn(|k| share[k] * (1.0 - surface.opacity + surface.opacity * pane[k]));
            if share == [0.0; 3] {
                return share;
            }
            ray.range[0] = beyond(found.hit.t);
        }
        [0.0; 3]
    }

    /// Irradiance with and without shadows, and the sun's visibility.
    #[inline(always)]
    pub fn light_layers(&self, vertex: &Vertex, sampler: &mut Sampler, out: &mut Pixel) {
        let drawn = self.scene.light.draw(sampler.pair());
        let cosine = dot(vertex.frame[2], drawn.direction);
        if cosine > 0.0 && drawn.density > 0.0 {
            out.unshadowed = luminance(drawn.radiance) * cosine / (PI * drawn.density);
            if dot(drawn.direction, vertex.flat) > 0.0 {
                out.direct = out.unshadowed * luminance(self.visible(vertex.position, drawn.direction));
            }
        }
        if let Some(direction) = self.scene.light.draw_sun(sampler.pair())
            && dot(direction, vertex.flat) > 0.0
            && dot(direction, vertex.frame[2]) > 0.0
        {
            out.sun = luminance(self.visible(vertex.position, direction));
        }
    }
}

/// Beginning of a ray behind a surface that it passed.
#[inline(always)]
fn beyond(t: f32) -> f32 {
    t + t.abs() * 4e-7 + 1e-7
}
