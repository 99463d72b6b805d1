//! Paths, one after the other; strips of the picture are tasks.

use super::bsdf::Bsdf;
use super::geometry::Point;
use super::light::Drawn;
use super::sampler::Sampler;
use super::surface::Surface;
use super::vector::{V3, along, dot, frame, luminance, scale, times, unit};
use super::{Film, FirstHit, Pixel, Scene, Settings, Strategy, View};
use crate::math::multiversion;
use crate::ops::ray_triangles::Ray;
use crate::tasks::{self, Parts};
use diorama_geom::glam::DVec3;
use std::cell::Cell;
use std::f32::consts::PI;
use std::ops::Range;
use std::sync::atomic::{AtomicU64, Ordering};

/// Rows of a task.
const STRIP: usize = 4;
/// Surfaces after which a path may end by chance.
const SURE: u32 = 3;
/// Surfaces that one ray passes through at most.
const PASSED: usize = 64;
/// Reflectance of a pane at normal incidence (index of refraction 1.5).
const PANE: f32 = 0.04;

/// Adds `samples` samples to each pixel of a film, and returns how many rays that took.
///
/// # Panics
/// When film and camera differ in size.
pub fn render(scene: &Scene, view: &View, settings: &Settings, samples: u32, film: &mut Film) -> u64 {
    let (w, h) = (view.camera.width as usize, view.camera.height as usize);
    assert_eq!((w, h), (film.width, film.height), "path_trace: film and camera differ in size");
    let (first, rays) = (film.samples, AtomicU64::new(0));
    let parts = Parts::new(&mut film.pixels);
    tasks::run(h.div_ceil(STRIP), usize::MAX, |strip| {
        // SAFETY: each task has a strip of its own.
        let pixels = unsafe { parts.chunk(strip, STRIP * w) };
        let tracer = Tracer::new(scene, settings);
        render_strip(&tracer, view, strip * STRIP, first..first + samples, pixels);
        rays.fetch_add(tracer.rays.get(), Ordering::Relaxed);
    });
    film.samples += samples;
    rays.into_inner()
}

multiversion! {
    /// Adds samples to the pixels of whole rows from `top` on.
    fn render_strip(tracer: &Tracer, view: &View, top: usize, samples: Range<u32>, pixels: &mut [Pixel]) {
        let w = view.camera.width as usize;
        // Columns of few rows, so that neighboring paths meet the same triangles.
        for x in 0..w {
            for row in 0..pixels.len() / w {
                let (pixel, y) = (&mut pixels[row * w + x], top + row);
                let (mut sums, mut mean) = ([0.0; Pixel::LEN], pixel.values());
                for sample in samples.clone() {
                    let mut sampler = Sampler::new(tracer.settings.seed, (y * w + x) as u32, sample);
                    let ray = camera_ray(view, [x, y], &mut sampler);
                    let values = tracer.path(ray, &mut sampler).values();
                    for (sum, value) in sums.iter_mut().zip(values) {
                        *sum += value;
                    }
                }
                let added = samples.len() as f32;
                let share = added / samples.end as f32;
                for (mean, sum) in mean.iter_mut().zip(sums) {
                    *mean += share * (sum / added - *mean);
                }
                *pixel = Pixel::of(mean);
            }
        }
    }
}

/// The first surface behind each pixel's center, `[H, W]`; panes and holes count as surfaces if `porous`.
pub fn first_hits(scene: &Scene, view: &View, porous: bool) -> Vec<Option<FirstHit>> {
    let (w, h) = (view.camera.width as usize, view.camera.height as usize);
    let mut hits = vec![None; w * h];
    let parts = Parts::new(&mut hits);
    tasks::run(h, usize::MAX, |y| {
        // SAFETY: each task has a row of its own.
        for (x, out) in unsafe { parts.chunk(y, w) }.iter_mut().enumerate() {
            let d = view.world_from_camera.rotation * view.camera.direction(x as f64 + 0.5, y as f64 + 0.5);
            let ray = Ray { origin: narrow(view.world_from_camera.translation), direction: narrow(d), range: [0.0, f32::INFINITY] };
            let mut sampler = Sampler::new(0, (y * w + x) as u32, 0);
            let found = if porous {
                scene.geometry.nearest(&ray).map(|f| (scene.geometry.point(&f), f.hit.t))
            } else {
                Tracer::new(scene, &Settings::default()).meet(ray, &mut sampler).found.map(|m| (m.point, m.t))
            };
            *out = found.map(|(point, t)| FirstHit {
                instance: point.instance,
                position: DVec3::from(point.position.map(f64::from)),
                depth: t as f64,
            });
        }
    });
    hits
}

/// The first surface along a ray from a point, whose direction has length 1; panes count, and holes.
pub fn first_hit(scene: &Scene, origin: DVec3, direction: DVec3) -> Option<FirstHit> {
    let ray = Ray { origin: narrow(origin), direction: narrow(direction), range: [0.0, f32::INFINITY] };
    scene.geometry.nearest(&ray).map(|found| {
        let point = scene.geometry.point(&found);
        FirstHit { instance: point.instance, position: DVec3::from(point.position.map(f64::from)), depth: found.hit.t as f64 }
    })
}

/// Whether something is between two points; panes count, and holes.
pub fn is_between(scene: &Scene, from: DVec3, to: DVec3) -> bool {
    let ray = Ray { origin: narrow(from), direction: narrow(to - from), range: [0.0, 1.0] };
    scene.geometry.is_blocked(&ray) || scene.geometry.nearest_porous(&ray).is_some()
}

#[inline(always)]
fn narrow(v: DVec3) -> V3 {
    [v.x as f32, v.y as f32, v.z as f32]
}

/// A ray through a random point of a pixel and of the lens.
#[inline(always)]
fn camera_ray(view: &View, [x, y]: [usize; 2], sampler: &mut Sampler) -> Ray {
    let [dx, dy] = sampler.pair();
    let pose = &view.world_from_camera;
    let (mut origin, mut d) = (DVec3::ZERO, view.camera.direction(x as f64 + dx as f64, y as f64 + dy as f64));
    let lens_point = sampler.pair();
    if let Some(lens) = view.lens.filter(|_| d.z > 0.0) {
        let (radius, angle) = (lens.radius * (lens_point[0] as f64).sqrt(), std::f64::consts::TAU * lens_point[1] as f64);
        origin = DVec3::new(radius * angle.cos(), radius * angle.sin(), 0.0);
        d = (d * (lens.focus / d.z) - origin).normalize();
    }
    Ray { origin: narrow(pose.point(origin)), direction: narrow(pose.rotation * d), range: [0.0, f32::INFINITY] }
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

/// `(a / (a + b))` of squares: the power heuristic.
#[inline(always)]
fn heuristic(a: f32, b: f32) -> f32 {
    let q = b / a;
    1.0 / (1.0 + q * q)
}

struct Tracer<'a> {
    scene: &'a Scene,
    settings: &'a Settings,
    /// Rays that were traced.
    rays: Cell<u64>,
}

/// What a ray comes to, after it passed holes and panes.
struct Meeting {
    /// Share of the light that passes on the way.
    passed: V3,
    found: Option<Met>,
}

struct Met {
    point: Point,
    surface: Surface,
    t: f32,
}

/// Where a path is, seen from the side that it came from.
struct Vertex {
    position: V3,
    flat: V3,
    frame: [V3; 3],
    bsdf: Bsdf,
}

impl Vertex {
    #[inline(always)]
    fn new(met: &Met, direction: V3) -> Option<Vertex> {
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
    fn local(&self, d: V3) -> V3 {
        self.frame.map(|axis| dot(axis, d))
    }

    #[inline(always)]
    fn world(&self, d: V3) -> V3 {
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
    fn new(scene: &'a Scene, settings: &'a Settings) -> Tracer<'a> {
        Tracer { scene, settings, rays: Cell::new(0) }
    }

    #[inline(always)]
    fn count_ray(&self) {
        self.rays.set(self.rays.get() + 1);
    }

    /// Follows a ray to the surface that scatters it; holes and panes let it pass by chance.
    #[inline(always)]
    fn meet(&self, mut ray: Ray, sampler: &mut Sampler) -> Meeting {
        let mut passed = [1.0; 3];
        for _ in 0..PASSED {
            self.count_ray();
            let Some(found) = self.scene.geometry.nearest(&ray) else { return Meeting { passed, found: None } };
            let point = self.scene.geometry.point(&found);
            let surface = self.scene.surfaces.at(&point);
            let t = found.hit.t;
            if surface.opacity >= 1.0 && surface.transmission == 0.0 {
                return Meeting { passed, found: Some(Met { point, surface, t }) };
            }
            let mut chance = sampler.one();
            if chance >= surface.opacity {
                ray.range[0] = beyond(t);
                continue;
            }
            chance /= surface.opacity;
            let share = through(&surface, dot(unit(ray.direction), surface.normal));
            let probability = luminance(share).clamp(0.0, 0.98);
            if chance >= probability {
                passed = scale(passed, 1.0 / (1.0 - probability));
                return Meeting { passed, found: Some(Met { point, surface, t }) };
            }
            passed = times(passed, scale(share, 1.0 / probability));
            ray.range[0] = beyond(t);
        }
        Meeting { passed: [0.0; 3], found: None }
    }

    /// Share of distant light that arrives from a direction.
    #[inline(always)]
    fn visible(&self, origin: V3, direction: V3) -> V3 {
        let mut ray = Ray { origin, direction, range: [0.0, f32::INFINITY] };
        self.count_ray();
        if self.scene.geometry.is_blocked(&ray) {
            return [0.0; 3];
        }
        let mut share = [1.0; 3];
        for _ in 0..PASSED {
            let Some(found) = self.scene.geometry.nearest_porous(&ray) else { return share };
            let surface = self.scene.surfaces.at(&self.scene.geometry.point(&found));
            let pane = through(&surface, dot(direction, surface.normal));
            share = std::array::from_fn(|k| share[k] * (1.0 - surface.opacity + surface.opacity * pane[k]));
            if share == [0.0; 3] {
                return share;
            }
            ray.range[0] = beyond(found.hit.t);
        }
        [0.0; 3]
    }

    /// One sample of a pixel.
    #[inline(always)]
    fn path(&self, mut ray: Ray, sampler: &mut Sampler) -> Pixel {
        let mut out = Pixel::default();
        let (mut throughput, mut density) = ([1.0; 3], f32::INFINITY);
        let mut is_backdrop = false;
        for bounce in 0..=self.settings.bounces {
            let Meeting { passed, found } = self.meet(ray, sampler);
            throughput = times(throughput, passed);
            let Some(met) = found else {
                self.escape(&ray, bounce, density, throughput, &mut out);
                break;
            };
            out.color = along(out.color, 1.0, times(throughput, met.surface.emission));
            if bounce == self.settings.bounces && bounce > 0 {
                break;
            }
            if bounce == 0 {
                out.opacity = 1.0;
                out.depth = met.t;
                out.albedo = met.surface.material.base_color;
                is_backdrop = self.scene.is_backdrop[met.point.instance as usize];
            }
            let Some(vertex) = Vertex::new(&met, ray.direction) else { break };
            if bounce == 0 {
                out.normal = vertex.frame[2];
                if self.settings.light_layers {
                    self.light_layers(&vertex, sampler, &mut out);
                }
            }
            if self.settings.strategy != Strategy::Surface {
                out.color = along(out.color, 1.0, times(throughput, self.direct(&vertex, sampler)));
            }
            let Some(drawn) = vertex.bsdf.draw(sampler.pair()) else { break };
            let direction = vertex.world(drawn.incoming);
            if dot(direction, vertex.flat) <= 0.0 {
                break;
            }
            throughput = times(throughput, drawn.weight);
            density = drawn.density;
            if bounce >= SURE {
                let survival = throughput.iter().fold(0.0f32, |a, b| a.max(*b)).min(0.95);
                if sampler.one() >= survival {
                    break;
                }
                throughput = scale(throughput, 1.0 / survival);
            }
            ray = Ray { origin: vertex.position, direction, range: [0.0, f32::INFINITY] };
        }
        out.square = luminance(out.color) * luminance(out.color);
        if is_backdrop {
            out.backdrop = [out.color[0], out.color[1], out.color[2], 1.0];
        }
        out
    }

    /// Adds the light that a path escapes to.
    #[inline(always)]
    fn escape(&self, ray: &Ray, bounce: u32, density: f32, throughput: V3, out: &mut Pixel) {
        if bounce == 0 && !self.settings.shows_light {
            return;
        }
        let (radiance, light_density) = self.scene.light.evaluate(unit(ray.direction));
        let weight = match self.settings.strategy {
            _ if bounce == 0 => 1.0,
            Strategy::Both => heuristic(density, light_density),
            Strategy::Light => 0.0,
            Strategy::Surface => 1.0,
        };
        out.color = along(out.color, weight, times(throughput, radiance));
    }

    /// Light from a direction that is drawn from the light.
    #[inline(always)]
    fn direct(&self, vertex: &Vertex, sampler: &mut Sampler) -> V3 {
        let Drawn { direction, radiance, density } = self.scene.light.draw(sampler.pair());
        if dot(direction, vertex.flat) <= 0.0 || density <= 0.0 {
            return [0.0; 3];
        }
        let (reflected, surface_density) = vertex.bsdf.evaluate(vertex.local(direction));
        let weight = if self.settings.strategy == Strategy::Both { heuristic(density, surface_density) } else { 1.0 };
        let value = scale(times(reflected, radiance), weight / density);
        if luminance(value) <= 0.0 {
            return [0.0; 3];
        }
        times(value, self.visible(vertex.position, direction))
    }

    /// Irradiance with and without shadows, and the sun's visibility.
    #[inline(always)]
    fn light_layers(&self, vertex: &Vertex, sampler: &mut Sampler, out: &mut Pixel) {
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
