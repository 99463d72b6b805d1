//! Pictures and single rays; strips of a picture are tasks.

use super::sampler::Sampler;
use super::tracer::{Tracer, narrow};
use super::{Film, FirstHit, Scene, Settings, View, wave};
use crate::ops::ray_triangles::Ray;
use crate::tasks::{self, Parts};
use diorama_geom::glam::DVec3;
use std::sync::atomic::{AtomicU64, Ordering};

/// Rows of a task.
const STRIP: usize = 4;
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
        wave::render_strip(&tracer, view, strip * STRIP, first..first + samples, pixels);
        rays.fetch_add(tracer.rays(), Ordering::Relaxed);
    });
    film.samples += samples;
    rays.into_inner()
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
                scene.geometry.nearest(&ray).map(|f| (scene.at(&f).0, f.hit.t))
            } else {
                let nearest = scene.geometry.nearest(&ray);
                Tracer::new(scene, &Settings::default()).meet(ray, nearest, &mut sampler).found.map(|m| (m.point, m.t))
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
        let point = scene.at(&found).0;
        FirstHit { instance: point.instance, position: DVec3::from(point.position.map(f64::from)), depth: found.hit.t as f64 }
    })
}

/// Whether something is between two points; panes count, and holes.
pub fn is_between(scene: &Scene, from: DVec3, to: DVec3) -> bool {
    let ray = Ray { origin: narrow(from), direction: narrow(to - from), range: [0.0, 1.0] };
    scene.geometry.is_blocked(&ray) || scene.geometry.nearest_porous(&ray).is_some()
}
