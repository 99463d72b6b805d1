//! Paths of one task, which take each step together: cameras, rays, surfaces, light, and the next directions. Steps are loops over many
//! paths, so that the memory that one waits for is fetched while others are computed.

use super::bsdf::Drawn as Scattered;
use super::geometry::Found;
use super::light::{Drawn, LANES};
use super::sampler::{self, Sampler};
use super::tracer::{Met, Tracer, Vertex, narrow};
use super::vector::{V3, along, dot, luminance, scale, times, unit};
use super::{Pixel, Strategy, View};
use crate::math::multiversion;
use crate::ops::ray_triangles::{Hit, Ray};
use diorama_geom::Lens;
use diorama_geom::glam::DVec3;
use std::ops::Range;

/// Paths that take their steps together at most.
const WAVE: usize = 512;
/// Surfaces after which a path may end by chance.
pub(super) const SURE: u32 = 3;

/// Paths between one that is computed and one whose surface is fetched.
const AHEAD: usize = 8;

/// What is known about a path besides its ray.
#[derive(Clone, Copy)]
struct Path {
    sampler: Sampler,
    throughput: V3,
    /// With which the direction of the ray was drawn at the surface that it leaves.
    density: f32,
    is_backdrop: bool,
    sample: Pixel,
}

/// Light that arrives if nothing is in the way of its ray.
#[derive(Clone, Copy)]
struct Arrival {
    path: u32,
    color: V3,
}

/// Paths and their current step. Rays and what they find are in the order of `alive`.
struct Wave<'a> {
    tracer: &'a Tracer<'a>,
    paths: Vec<Path>,
    /// Paths that go on.
    alive: Vec<u32>,
    rays: Vec<Ray>,
    found: Vec<Option<Found>>,
    hits: Vec<Hit>,
    /// Paths that met nothing, and their rays' directions.
    escaped: Vec<(u32, V3)>,
    /// Paths at a surface that scatters.
    standing: Vec<(u32, Vertex)>,
    arrivals: Vec<Arrival>,
    shadow_rays: Vec<Ray>,
}

multiversion! {
    /// Adds samples to the pixels of whole rows from `top` on.
    pub(super) fn render_strip(tracer: &Tracer, view: &View, top: usize, samples: Range<u32>, pixels: &mut [Pixel]) {
        let w = view.camera.width as usize;
        let (rows, spp) = (pixels.len() / w, samples.len());
        let mut sums = vec![[0.0f32; Pixel::LEN]; pixels.len()];
        let (mut wave, eye) = (Wave::new(tracer), Eye::new(view));
        let mut places = Places { x: 0, row: 0, sample: 0, rows, samples: spp };
        let total = pixels.len() * spp;
        for first in (0..total).step_by(WAVE) {
            let here = places.clone();
            wave.start(&eye, top, samples.start, places.by_ref().take(WAVE.min(total - first)));
            wave.run();
            for ([x, row, _], path) in here.zip(&wave.paths) {
                for (sum, value) in sums[row * w + x].iter_mut().zip(path.values()) {
                    *sum += value;
                }
            }
        }
        for (pixel, sums) in pixels.iter_mut().zip(&sums) {
            pixel.add(sums, spp as f32, samples.end as f32);
        }
    }
}

/// Columns, rows and samples of a strip without end: columns of few rows, so that neighboring paths meet the same triangles.
#[derive(Clone)]
struct Places {
    x: usize,
    row: usize,
    sample: usize,
    rows: usize,
    samples: usize,
}

impl Iterator for Places {
    type Item = [usize; 3];

    #[inline(always)]
    fn next(&mut self) -> Option<[usize; 3]> {
        let here = [self.x, self.row, self.sample];
        self.sample += 1;
        if self.sample == self.samples {
            (self.sample, self.row) = (0, self.row + 1);
        }
        if self.row == self.rows {
            (self.row, self.x) = (0, self.x + 1);
        }
        Some(here)
    }
}

/// Rays of a view.
struct Eye<'a> {
    view: &'a View,
    /// For a pinhole camera, directions in the world as `[x, y, one]` of pixel coordinates.
    pinhole: Option<[DVec3; 3]>,
}

impl Eye<'_> {
    fn new(view: &View) -> Eye<'_> {
        let (c, turn) = (&view.camera, view.world_from_camera.rotation);
        let is_plain = matches!(c.lens, Lens::Pinhole) && view.lens.is_none();
        let axes = [DVec3::new(1.0 / c.fx, 0.0, 0.0), DVec3::new(0.0, 1.0 / c.fy, 0.0), DVec3::new(-c.cx / c.fx, -c.cy / c.fy, 1.0)];
        Eye { view, pinhole: is_plain.then(|| axes.map(|axis| turn * axis)) }
    }

    /// A ray through a point of a pixel, and a random one of the lens.
    #[inline(always)]
    fn ray(&self, [x, y]: [usize; 2], [dx, dy]: [f32; 2], sampler: &mut Sampler) -> Ray {
        let (x, y) = (x as f64 + dx as f64, y as f64 + dy as f64);
        let pose = &self.view.world_from_camera;
        let ray = |origin, direction| Ray { origin, direction, range: [0.0, f32::INFINITY] };
        if let Some([right, down, ahead]) = self.pinhole {
            sampler.skip_pair();
            let d: V3 = std::array::from_fn(|k| (x * right[k] + y * down[k] + ahead[k]) as f32);
            return ray(narrow(pose.translation), unit(d));
        }
        let (mut origin, mut d) = (DVec3::ZERO, self.view.camera.direction(x, y));
        let lens_point = sampler.pair();
        if let Some(lens) = self.view.lens.filter(|_| d.z > 0.0) {
            let (radius, angle) = (lens.radius * (lens_point[0] as f64).sqrt(), std::f64::consts::TAU * lens_point[1] as f64);
            origin = DVec3::new(radius * angle.cos(), radius * angle.sin(), 0.0);
            d = (d * (lens.focus / d.z) - origin).normalize();
        }
        ray(narrow(pose.point(origin)), narrow(pose.rotation * d))
    }
}

/// `(a / (a + b))` of squares: the power heuristic.
#[inline(always)]
fn heuristic(a: f32, b: f32) -> f32 {
    let q = b / a;
    1.0 / (1.0 + q * q)
}

impl Path {
    /// Numbers of the finished sample.
    #[inline(always)]
    fn values(&self) -> [f32; Pixel::LEN] {
        let mut sample = self.sample;
        sample.square = luminance(sample.color) * luminance(sample.color);
        if self.is_backdrop {
            sample.backdrop = [sample.color[0], sample.color[1], sample.color[2], 1.0];
        }
        sample.values()
    }

    #[inline(always)]
    fn add(&mut self, color: V3) {
        self.sample.color = along(self.sample.color, 1.0, color);
    }
}

impl<'a> Wave<'a> {
    fn new(tracer: &'a Tracer<'a>) -> Wave<'a> {
        Wave {
            tracer,
            paths: Vec::with_capacity(WAVE),
            alive: Vec::with_capacity(WAVE),
            rays: Vec::with_capacity(WAVE),
            found: vec![None; WAVE],
            hits: vec![Hit::NONE; WAVE],
            escaped: Vec::with_capacity(WAVE),
            standing: Vec::with_capacity(WAVE),
            arrivals: Vec::with_capacity(WAVE),
            shadow_rays: Vec::with_capacity(WAVE),
        }
    }

    /// New paths through pixels of the rows from `top` on, of samples from `first` on.
    #[inline(always)]
    fn start(&mut self, eye: &Eye, top: usize, first: u32, mut places: impl Iterator<Item = [usize; 3]>) {
        self.paths.clear();
        self.rays.clear();
        let width = eye.view.camera.width as usize;
        loop {
            let (mut samplers, mut pixels, mut n) = ([Sampler::new(0, 0, 0); LANES], [[0; 2]; LANES], 0);
            for [x, row, sample] in places.by_ref().take(LANES) {
                pixels[n] = [x, top + row];
                samplers[n] = Sampler::new(self.tracer.settings.seed, ((top + row) * width + x) as u32, first + sample as u32);
                samplers[n].skip_pair();
                n += 1;
            }
            if n == 0 {
                break;
            }
            let [dx, dy] = sampler::pairs(&samplers);
            for i in 0..n {
                let mut sampler = samplers[i];
                self.rays.push(eye.ray(pixels[i], [dx[i], dy[i]], &mut sampler));
                self.paths.push(Path {
                    sampler,
                    throughput: [1.0; 3],
                    density: f32::INFINITY,
                    is_backdrop: false,
                    sample: Pixel::default(),
                });
            }
        }
        self.alive.clear();
        self.alive.extend(0..self.paths.len() as u32);
    }

    /// Follows all paths to their ends.
    #[inline(always)]
    fn run(&mut self) {
        for bounce in 0..=self.tracer.settings.bounces {
            if self.alive.is_empty() {
                break;
            }
            let n = self.rays.len();
            self.tracer.scene.geometry.nearest_each(&self.rays, bounce == 0, &mut self.hits[..n], &mut self.found[..n]);
            self.meet(bounce);
            self.escape(bounce);
            if self.tracer.settings.strategy != Strategy::Surface {
                self.gather_light();
            }
            self.scatter(bounce);
        }
    }

    /// Sorts paths into those that escape and those that stand at a surface.
    #[inline(always)]
    fn meet(&mut self, bounce: u32) {
        self.escaped.clear();
        self.standing.clear();
        let (tracer, settings) = (self.tracer, self.tracer.settings);
        self.found[..self.rays.len()].iter().flatten().for_each(|found| tracer.scene.geometry.prefetch_face(found));
        for (i, ((&at, ray), found)) in self.alive.iter().zip(&self.rays).zip(&self.found).enumerate() {
            if let Some(Some(found)) = self.found.get(i + AHEAD) {
                tracer.scene.geometry.prefetch_vertices(found);
            }
            let path = &mut self.paths[at as usize];
            let meeting = tracer.meet(*ray, *found, &mut path.sampler);
            path.throughput = times(path.throughput, meeting.passed);
            let Some(met) = meeting.found else {
                self.escaped.push((at, unit(ray.direction)));
                continue;
            };
            path.add(times(path.throughput, met.surface.emission));
            if bounce == settings.bounces && bounce > 0 {
                continue;
            }
            if bounce == 0 {
                path.see(tracer, &met);
            }
            let Some(vertex) = Vertex::new(&met, ray.direction) else { continue };
            if bounce == 0 {
                path.sample.normal = vertex.frame[2];
                if settings.light_layers {
                    tracer.light_layers(&vertex, &mut path.sampler, &mut path.sample);
                }
            }
            self.standing.push((at, vertex));
        }
    }

    /// Adds the light that paths escape to.
    #[inline(always)]
    fn escape(&mut self, bounce: u32) {
        let (settings, light) = (self.tracer.settings, &self.tracer.scene.light);
        if bounce == 0 && !settings.shows_light || bounce > 0 && settings.strategy == Strategy::Light {
            return;
        }
        for escaped in self.escaped.chunks(LANES) {
            let mut directions = [[0.0; LANES]; 3];
            for (i, (_, direction)) in escaped.iter().enumerate() {
                (0..3).for_each(|k| directions[k][i] = direction[k]);
            }
            let values = light.evaluate_lanes(&directions, escaped.len());
            for ((at, _), (radiance, light_density)) in escaped.iter().zip(values) {
                let path = &mut self.paths[*at as usize];
                let weight = match settings.strategy {
                    Strategy::Both if bounce > 0 => heuristic(path.density, light_density),
                    _ => 1.0,
                };
                path.sample.color = along(path.sample.color, weight, times(path.throughput, radiance));
            }
        }
    }

    /// Adds light from directions that are drawn from the light.
    #[inline(always)]
    fn gather_light(&mut self) {
        let (tracer, paths) = (self.tracer, &mut self.paths);
        let is_weighted = tracer.settings.strategy == Strategy::Both;
        self.arrivals.clear();
        self.shadow_rays.clear();
        for standing in self.standing.chunks(LANES) {
            let numbers = next_pairs(paths, standing);
            let drawn = tracer.scene.light.draw_lanes(&numbers, standing.len());
            for ((at, vertex), Drawn { direction, radiance, density }) in standing.iter().zip(drawn) {
                if dot(direction, vertex.flat) <= 0.0 || density <= 0.0 {
                    continue;
                }
                let (reflected, surface_density) = vertex.bsdf.evaluate(vertex.local(direction));
                let weight = if is_weighted { heuristic(density, surface_density) } else { 1.0 };
                let value = scale(times(reflected, radiance), weight / density);
                if luminance(value) <= 0.0 {
                    continue;
                }
                self.arrivals.push(Arrival { path: *at, color: times(paths[*at as usize].throughput, value) });
                self.shadow_rays.push(Ray { origin: vertex.position, direction, range: [0.0, f32::INFINITY] });
            }
        }
        let n = self.shadow_rays.len();
        tracer.scene.geometry.blocking_each(&self.shadow_rays, &mut self.hits[..n]);
        tracer.count_rays(n);
        for ((arrival, ray), hit) in self.arrivals.iter().zip(&self.shadow_rays).zip(&self.hits) {
            if !hit.is_some() {
                let share = tracer.passing(*ray);
                paths[arrival.path as usize].add(times(arrival.color, share));
            }
        }
    }

    /// Draws the next directions; paths end where there is none, or by chance.
    #[inline(always)]
    fn scatter(&mut self, bounce: u32) {
        self.alive.clear();
        self.rays.clear();
        for standing in self.standing.chunks(LANES) {
            let [first, second] = next_pairs(&mut self.paths, standing);
            for (i, (at, vertex)) in standing.iter().enumerate() {
                let path = &mut self.paths[*at as usize];
                let Some(Scattered { incoming, weight, density }) = vertex.bsdf.draw([first[i], second[i]]) else { continue };
                let direction = vertex.world(incoming);
                if dot(direction, vertex.flat) <= 0.0 {
                    continue;
                }
                path.throughput = times(path.throughput, weight);
                path.density = density;
                if bounce >= SURE {
                    let survival = path.throughput.iter().fold(0.0f32, |a, b| a.max(*b)).min(0.95);
                    if path.sampler.one() >= survival {
                        continue;
                    }
                    path.throughput = scale(path.throughput, 1.0 / survival);
                }
                self.alive.push(*at);
                self.rays.push(Ray { origin: vertex.position, direction, range: [0.0, f32::INFINITY] });
            }
        }
    }
}

/// The next two numbers of paths that stand at surfaces.
#[inline(always)]
fn next_pairs(paths: &mut [Path], standing: &[(u32, Vertex)]) -> [[f32; LANES]; 2] {
    let mut samplers = [Sampler::new(0, 0, 0); LANES];
    for (sampler, (at, _)) in samplers.iter_mut().zip(standing) {
        paths[*at as usize].sampler.skip_pair();
        *sampler = paths[*at as usize].sampler;
    }
    sampler::pairs(&samplers)
}

impl Path {
    /// Notes the first surface.
    #[inline(always)]
    fn see(&mut self, tracer: &Tracer, met: &Met) {
        self.sample.opacity = 1.0;
        self.sample.depth = met.t;
        self.sample.albedo = met.surface.material.base_color;
        self.is_backdrop = tracer.scene.is_backdrop[met.point.instance as usize];
    }
}
