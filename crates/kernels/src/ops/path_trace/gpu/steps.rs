//! The steps of paths, one unit per path. The queue of a bounce names the paths that go on.

use super::bsdf;
use super::light;
use super::sampler::{Pair, one, pair};
use super::state::{
    ALBEDO, ARRIVAL, BACKDROP, Batch, COLOR, DENSITY, DEPTH, DIMENSION, DIRECTION, NORMAL, OPACITY, ORIGIN, THROUGHPUT, TOWARD, TRIANGLE,
    UNSHADOWED, add, hit, note, number, put, put_hit, put_number, sample, seed, vector,
};
use super::surface::{Surface, Vertex, chance_through, local, surface, through, vertex, world};
use crate::gpu::vector::{V3, dot, luminance, scale, times, unit};
use crate::ops::path_trace::tracer::PASSED;
use crate::ops::path_trace::wave::SURE;
use crate::ops::ray_triangles::binary::NOTHING;
use crate::ops::ray_triangles::gpu::{FAR, Found, nearest};
use cubecl::prelude::*;
use std::f32::consts::PI;

/// [`Strategy`](crate::ops::path_trace::Strategy) as a number.
pub const BOTH: u32 = 0;
pub const LIGHT: u32 = 1;
pub const SURFACE: u32 = 2;

/// `(a / (a + b))` of squares: the power heuristic.
#[cube]
fn heuristic(a: f32, b: f32) -> f32 {
    let q = b / a;
    1.0 / (1.0 + q * q)
}

/// Beginning of a ray behind a surface that it passed.
#[cube]
fn beyond(t: f32) -> f32 {
    t + t.abs() * 4e-7 + 1e-7
}

/// Follows rays to the surfaces that scatter them; holes and panes let them pass by chance.
#[cube(launch_unchecked)]
pub fn follow(
    queue: &[u32],
    counts: &[u32],
    tree: &[u32],
    surfaces: &[u32],
    texels: &[u32],
    paths: &mut [u32],
    b: Batch,
    bounce: u32,
    root: u32,
    #[comptime] stack: usize,
    #[comptime] porous: bool,
    #[comptime] textured: bool,
) {
    if ABSOLUTE_POS >= counts[bounce as usize] as usize {
        terminate!();
    }
    let path = queue[ABSOLUTE_POS] as usize;
    let n = b.paths as usize;
    let origin = vector(paths, ORIGIN, path, &b);
    let d = vector(paths, DIRECTION, path, &b);
    if comptime!(porous) {
        let mut throughput = vector(paths, THROUGHPUT, path, &b);
        let mut dimension = paths[DIMENSION * n + path];
        let random = seed(&b, path);
        let index = sample(&b, path);
        let mut near = 0.0f32;
        let mut steps = 0u32;
        let mut goes = true.runtime();
        while goes {
            let found = nearest(tree, root, origin, d, near, FAR, 0u32, stack);
            put_hit(paths, path, &b, &found);
            goes = false.runtime();
            if found.triangle != NOTHING {
                let s = surface(tree, surfaces, texels, &found, textured);
                if s.opacity < 1.0 || s.transmission > 0.0 {
                    dimension += 1;
                    let chance = one(random, index, dimension);
                    goes = true.runtime();
                    if chance < s.opacity {
                        let share = through(&s, dot(unit(d), s.normal));
                        let probability = chance_through(share);
                        if chance / s.opacity >= probability {
                            throughput = scale(throughput, 1.0 / (1.0 - probability));
                            goes = false.runtime();
                        } else {
                            throughput = times(throughput, scale(share, 1.0 / probability));
                        }
                    }
                    near = beyond(found.t);
                    steps += 1;
                    if goes && steps >= comptime!(PASSED as u32) {
                        throughput = scale(throughput, 0.0f32);
                        paths[TRIANGLE * n + path] = NOTHING;
                        goes = false.runtime();
                    }
                }
            }
        }
        put(paths, THROUGHPUT, path, &b, throughput);
        paths[DIMENSION * n + path] = dimension;
    } else {
        let found = nearest(tree, root, origin, d, 0.0f32, FAR, 0u32, stack);
        put_hit(paths, path, &b, &found);
    }
}

/// Asks for light on the first surfaces, for [`Pixel::direct`](crate::ops::path_trace::Pixel::direct) or with `sun` for the sun's visibility.
#[cube(launch_unchecked)]
pub fn ask_layers(
    tree: &[u32],
    surfaces: &[u32],
    texels: &[u32],
    lights: &[u32],
    paths: &mut [u32],
    samples: &mut [f32],
    b: Batch,
    #[comptime] sun: bool,
    #[comptime] textured: bool,
) {
    let path = ABSOLUTE_POS;
    if path >= b.paths as usize {
        terminate!();
    }
    let n = b.paths as usize;
    let mut arrives = 0.0f32;
    let found = hit(paths, path, &b);
    if found.triangle != NOTHING {
        let s = surface(tree, surfaces, texels, &found, textured);
        let v = vertex(surfaces, &s, vector(paths, DIRECTION, path, &b));
        if v.is_seen {
            let dimension = paths[DIMENSION * n + path] + 1;
            paths[DIMENSION * n + path] = dimension;
            let numbers = pair(seed(&b, path), sample(&b, path), dimension);
            let mut toward = V3 { x: 0.0f32.runtime(), y: 0.0f32.runtime(), z: 0.0f32.runtime() };
            if comptime!(sun) {
                if lights[light::SUN] == 1 {
                    toward = light::draw_sun(lights, numbers);
                    if dot(toward, v.flat) > 0.0 && dot(toward, v.frame.n) > 0.0 {
                        arrives = 1.0f32;
                    }
                }
            } else {
                let drawn = light::draw(lights, numbers);
                let cosine = dot(v.frame.n, drawn.direction);
                toward = drawn.direction;
                if cosine > 0.0 && drawn.density > 0.0 {
                    let unshadowed = luminance(drawn.radiance) * cosine / (PI * drawn.density);
                    note(samples, UNSHADOWED, path, &b, unshadowed);
                    if dot(toward, v.flat) > 0.0 {
                        arrives = unshadowed;
                    }
                }
            }
            put(paths, ORIGIN, path, &b, v.position);
            put(paths, TOWARD, path, &b, toward);
        }
    }
    put(paths, ARRIVAL, path, &b, V3 { x: arrives, y: arrives, z: arrives });
}

/// Notes what a path sees first.
#[cube]
fn see(samples: &mut [f32], path: usize, b: &Batch, s: &Surface, found: &Found, backdrop: u32) {
    note(samples, OPACITY, path, b, 1.0f32.runtime());
    note(samples, DEPTH, path, b, found.t);
    add(samples, ALBEDO, path, b, s.base);
    if s.instance < backdrop {
        note(samples, BACKDROP + 3, path, b, 1.0f32.runtime());
    }
}

/// A direction to light, and the share that a surface sends on of what arrives from there unless something is in the way.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
struct Asked {
    toward: V3,
    color: V3,
}

/// Light that a ray escapes to, weighted against the density with which its direction was drawn.
#[cube]
fn escape(lights: &[u32], direction: V3, density: f32, weighted: bool) -> V3 {
    let from = light::evaluate(lights, unit(direction));
    let mut weight = 1.0f32;
    if weighted {
        weight = heuristic(density, from.density);
    }
    scale(from.radiance, weight)
}

/// Draws a direction from the light.
#[cube]
fn ask(lights: &[u32], v: &Vertex, numbers: Pair, strategy: u32) -> Asked {
    let from = light::draw(lights, numbers);
    let mut color = V3 { x: 0.0f32.runtime(), y: 0.0f32.runtime(), z: 0.0f32.runtime() };
    if dot(from.direction, v.flat) > 0.0 && from.density > 0.0 {
        let reflected = bsdf::evaluate(&v.bsdf, local(&v.frame, from.direction));
        let mut weight = 1.0f32;
        if strategy == BOTH {
            weight = heuristic(from.density, reflected.density);
        }
        color = scale(times(reflected.color, from.radiance), weight / from.density);
    }
    Asked { toward: from.direction, color }
}

/// Adds the light that surfaces emit and that paths escape to. At surfaces that scatter, it asks for light from a direction drawn from the light,
/// and draws the next direction; the path ends if there is none, or by chance.
#[cube(launch_unchecked)]
pub fn scatter(
    queue: &[u32],
    counts: &[Atomic<u32>],
    next: &mut [u32],
    tree: &[u32],
    surfaces: &[u32],
    texels: &[u32],
    lights: &[u32],
    paths: &mut [u32],
    samples: &mut [f32],
    b: Batch,
    bounce: u32,
    bounces: u32,
    strategy: u32,
    shows_light: u32,
    backdrop: u32,
    #[comptime] textured: bool,
) {
    if ABSOLUTE_POS >= counts[bounce as usize].load() as usize {
        terminate!();
    }
    let path = queue[ABSOLUTE_POS] as usize;
    let n = b.paths as usize;
    let found = hit(paths, path, &b);
    let d = vector(paths, DIRECTION, path, &b);
    let throughput = vector(paths, THROUGHPUT, path, &b);
    let mut arrival = V3 { x: 0.0f32.runtime(), y: 0.0f32.runtime(), z: 0.0f32.runtime() };
    if found.triangle == NOTHING {
        if (bounce == 0 && shows_light == 1) || (bounce > 0 && strategy != LIGHT) {
            let weighted = bounce > 0 && strategy == BOTH;
            let radiance = escape(lights, d, number(paths, DENSITY, path, &b), weighted);
            add(samples, COLOR, path, &b, times(throughput, radiance));
        }
    } else {
        let s = surface(tree, surfaces, texels, &found, textured);
        add(samples, COLOR, path, &b, times(throughput, s.emission));
        if bounce == 0 {
            see(samples, path, &b, &s, &found, backdrop);
        }
        let v = vertex(surfaces, &s, d);
        if v.is_seen && (bounce == 0 || bounce < bounces) {
            let mut dimension = paths[DIMENSION * n + path];
            let random = seed(&b, path);
            let index = sample(&b, path);
            if bounce == 0 {
                add(samples, NORMAL, path, &b, v.frame.n);
            }
            put(paths, ORIGIN, path, &b, v.position);
            if strategy != SURFACE {
                dimension += 1;
                let asked = ask(lights, &v, pair(random, index, dimension), strategy);
                put(paths, TOWARD, path, &b, asked.toward);
                arrival = times(throughput, asked.color);
            }
            dimension += 1;
            let incoming = bsdf::draw(&v.bsdf, pair(random, index, dimension));
            let reflected = bsdf::evaluate(&v.bsdf, incoming);
            let direction = world(&v.frame, incoming);
            if reflected.density > 0.0 && dot(direction, v.flat) > 0.0 && bounce < bounces {
                let mut goes_on = times(throughput, scale(reflected.color, 1.0 / reflected.density));
                let mut survival = 1.0f32;
                if bounce >= SURE {
                    dimension += 1;
                    survival = min(max(max(goes_on.x, goes_on.y), goes_on.z), 0.95);
                }
                if bounce < SURE || one(random, index, dimension) < survival {
                    goes_on = scale(goes_on, 1.0 / survival);
                    put(paths, DIRECTION, path, &b, direction);
                    put(paths, THROUGHPUT, path, &b, goes_on);
                    put_number(paths, DENSITY, path, &b, reflected.density);
                    let to = counts[bounce as usize + 1].fetch_add(1u32);
                    next[to as usize] = u32::cast_from(path);
                }
            }
            paths[DIMENSION * n + path] = dimension;
        }
    }
    put(paths, ARRIVAL, path, &b, arrival);
}

/// Adds light that paths asked for to a field of their samples, as far as it is not in shadow.
#[cube(launch_unchecked)]
pub fn arrive(
    queue: &[u32],
    counts: &[u32],
    tree: &[u32],
    surfaces: &[u32],
    texels: &[u32],
    paths: &mut [u32],
    samples: &mut [f32],
    b: Batch,
    bounce: u32,
    field: u32,
    solid: u32,
    holes: u32,
    #[comptime] stack: usize,
    #[comptime] porous: bool,
    #[comptime] textured: bool,
) {
    if ABSOLUTE_POS >= counts[bounce as usize] as usize {
        terminate!();
    }
    let path = queue[ABSOLUTE_POS] as usize;
    let mut arrival = vector(paths, ARRIVAL, path, &b);
    if luminance(arrival) <= 0.0 {
        terminate!();
    }
    let origin = vector(paths, ORIGIN, path, &b);
    let d = vector(paths, TOWARD, path, &b);
    if comptime!(porous) {
        // First what light cannot pass, then what it can pass, from one to the next.
        let mut root = solid;
        let mut any = 1u32;
        let mut near = 0.0f32;
        let mut steps = 0u32;
        let mut goes = true.runtime();
        while goes {
            let found = nearest(tree, root, origin, d, near, FAR, any, stack);
            let is_met = found.triangle != NOTHING;
            if any == 1 {
                goes = !is_met;
                root = holes;
                any = 0;
                if is_met {
                    arrival = scale(arrival, 0.0f32);
                }
            } else {
                goes = is_met;
                if is_met {
                    let s = surface(tree, surfaces, texels, &found, textured);
                    let pane = through(&s, dot(d, s.normal));
                    let open = 1.0 - s.opacity;
                    let share = V3 { x: open + s.opacity * pane.x, y: open + s.opacity * pane.y, z: open + s.opacity * pane.z };
                    arrival = times(arrival, share);
                    near = beyond(found.t);
                    steps += 1;
                    if steps >= comptime!(PASSED as u32) {
                        arrival = scale(arrival, 0.0f32);
                    }
                    goes = luminance(arrival) > 0.0;
                }
            }
        }
    } else {
        let found = nearest(tree, solid, origin, d, 0.0f32, FAR, 1u32, stack);
        if found.triangle != NOTHING {
            arrival = scale(arrival, 0.0f32);
        }
    }
    if field == comptime!(COLOR as u32) {
        add(samples, COLOR, path, &b, arrival);
    } else {
        note(samples, field as usize, path, &b, luminance(arrival));
    }
}
