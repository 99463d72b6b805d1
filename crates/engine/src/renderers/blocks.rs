//! Volume rendering of hash-grid fields, block of rays by block of rays. A block's rays lie side by side in the picture
//! and advance a few samples at a time, so that their rows of the table, features and activations stay in cache and
//! little is computed behind opaque matter. Neighbouring samples of a ray that together weigh little share one color.

use super::traced::Traced;
use crate::fields::{Encoder, Field, Pruning};
use diorama_kernels::math;
use diorama_kernels::ops::field_step::infer::{Codes, InferBuffers, Inference};
use diorama_kernels::ops::march::{self, MarchConfig, MarchRays, Marched, OccupancyBits};
use rayon::prelude::*;
use std::cell::RefCell;

/// Pixels along the edge of a block, and its rays.
pub(super) const EDGE: usize = 8;
const RAYS: usize = EDGE * EDGE;
/// Samples that an advance aims at, and bounds of the samples per ray.
const SAMPLES: usize = 512;
const ADVANCE: (usize, usize) = (8, 32);
/// Weight below which a sample takes no part in colors: what all such samples weigh goes to those that do.
const FAINT: f32 = 1e-5;

thread_local! {
    static SCRATCH: RefCell<Scratch> = RefCell::default();
}

/// Field, grid and limits that all blocks share.
#[derive(Clone, Copy)]
pub(super) struct Blocks<'a> {
    pub field: &'a Field,
    pub grid: &'a OccupancyBits,
    pub march: MarchConfig,
    pub pruning: Pruning,
    /// Weight up to which samples of a ray share one color.
    pub shared_weight: f32,
}

/// Memory of a thread.
#[derive(Default)]
struct Scratch {
    near_far: Vec<f32>,
    light: Vec<f32>,
    /// Weight of the samples that have a color.
    held: Vec<f32>,
    groups: Vec<Group>,
    active: Vec<u32>,
    going_on: Vec<u32>,
    samples: Marched,
    spans: Vec<(usize, usize)>,
    /// By coordinate.
    points: [Vec<f32>; 3],
    sigma: Vec<f32>,
    alpha: Vec<f32>,
    geometry: Vec<f32>,
    colors: Colors,
    buf: InferBuffers,
}

/// Samples of a ray that wait for the color that they share.
#[derive(Clone, Default)]
struct Group {
    weight: f32,
    /// Distance at which the last of them ends: what begins far behind it does not belong to the group.
    end: f32,
    /// `Σ w g` of their geometry features.
    geometry: Vec<f32>,
}

/// Colors that are wanted.
#[derive(Default)]
struct Colors {
    geometry: Vec<f32>,
    rays: Vec<u32>,
    weights: Vec<f32>,
    rgb: Vec<f32>,
}

impl Blocks<'_> {
    /// Composites rays before black; none where the field is not one that can be evaluated this way.
    pub fn trace(&self, rays: &MarchRays, images: Option<&[u32]>) -> Option<Traced> {
        let Encoder::Hash { grid, table } = &self.field.encoder else { return None };
        let inference = Inference::new(grid, &table.values, &self.field.net, &self.field.weights.values)?;
        let (mut direction, mut appearance) = (Vec::new(), Vec::new());
        self.field.codes.encode(rays.dirs, images, &mut direction, &mut appearance);
        let codes: Vec<Codes> = [(&direction, self.field.codes.direction.dims())]
            .into_iter()
            .chain(self.field.codes.appearance.iter().map(|a| (&appearance, a.dims)))
            .filter(|c| c.1 > 0)
            .map(|(values, width)| (&values[..], width))
            .collect();
        let n = rays.jitter.len();
        let mut out = Traced::nothing(n);
        let parts = out.rgb.par_chunks_mut(RAYS * 3).zip(out.opacity.par_chunks_mut(RAYS)).zip(out.depth.par_chunks_mut(RAYS));
        parts.enumerate().for_each(|(block, ((rgb, opacity), depth))| {
            let (first, n) = (block * RAYS, opacity.len());
            let own = |width: usize| first * width..(first + n) * width;
            let rays = MarchRays {
                origins: &rays.origins[own(3)],
                dirs: &rays.dirs[own(3)],
                near_far: &rays.near_far[own(2)],
                jitter: &rays.jitter[own(1)],
                resumed: rays.resumed,
            };
            let codes: Vec<Codes> = codes.iter().map(|&(v, w)| (&v[first * w..(first + n) * w], w)).collect();
            SCRATCH.with_borrow_mut(|scratch| self.block(&inference, &rays, &codes, scratch, Traces { rgb, opacity, depth }));
        });
        Some(out)
    }

    fn block(&self, inference: &Inference, rays: &MarchRays, codes: &[Codes], s: &mut Scratch, mut out: Traces) {
        s.begin(rays, inference.geometry_width());
        let (mut taken, mut resumed) = (0, rays.resumed);
        while !s.active.is_empty() && taken < self.march.max_samples {
            let size = (SAMPLES / s.active.len()).clamp(ADVANCE.0, ADVANCE.1).min(self.march.max_samples - taken);
            s.samples.clear();
            s.spans.clear();
            s.points.iter_mut().for_each(Vec::clear);
            let own = MarchRays { near_far: &s.near_far, resumed, ..*rays };
            for &r in &s.active {
                let first = s.samples.t.len();
                march::cpu::march_ray(self.grid, &own, r as usize, &MarchConfig { max_samples: size, ..self.march }, &mut s.samples);
                s.spans.push((first, s.samples.t.len()));
                for (k, p) in s.points.iter_mut().enumerate() {
                    let (o, d) = (rays.origins[r as usize * 3 + k], rays.dirs[r as usize * 3 + k]);
                    p.extend(s.samples.t[first..].iter().zip(&s.samples.dt[first..]).map(|(t, dt)| o + (t + 0.5 * dt) * d));
                }
            }
            march::cpu::normalize(self.field.space, &mut s.points);
            inference.density(&s.points, &mut s.sigma, &mut s.geometry, &mut s.buf);
            s.alpha.resize(s.sigma.len(), 0.0);
            math::alphas(&s.sigma, &s.samples.dt, &mut s.alpha);
            self.absorb(s, &mut out, size);
            s.colors.settle(inference, codes, &mut s.buf, &mut s.held, out.rgb);
            (taken, resumed) = (taken + size, true);
        }
        for r in 0..s.light.len() {
            s.close(r);
        }
        s.colors.settle(inference, codes, &mut s.buf, &mut s.held, out.rgb);
        for (r, light) in s.light.iter().enumerate() {
            // What the samples that were left out would have stopped goes to what the ray has met.
            let stopped = 1.0 - light;
            out.opacity[r] = if *light < self.pruning.stop { 1.0 } else { stopped };
            if s.held[r] > 0.0 {
                out.rgb[r * 3..r * 3 + 3].iter_mut().for_each(|v| *v *= out.opacity[r] / s.held[r]);
                out.depth[r] *= out.opacity[r] / stopped;
            }
        }
    }

    /// Lets light through the samples of an advance of at most `size` per ray, and decides which colors are wanted.
    fn absorb(&self, s: &mut Scratch, out: &mut Traces, size: usize) {
        let width = s.groups.first().map_or(0, |g| g.geometry.len());
        s.going_on.clear();
        for k in 0..s.active.len() {
            let (r, (first, last)) = (s.active[k] as usize, s.spans[k]);
            for i in first..last {
                if s.light[r] < self.pruning.stop {
                    break;
                }
                let weight = s.light[r] * s.alpha[i];
                s.light[r] -= weight;
                out.depth[r] += weight * (s.samples.t[i] + 0.5 * s.samples.dt[i]);
                if weight < FAINT {
                    continue;
                }
                let (t, dt) = (s.samples.t[i], s.samples.dt[i]);
                if t > s.groups[r].end + dt {
                    s.close(r);
                }
                let group = &mut s.groups[r];
                group.weight += weight;
                group.end = t + dt;
                for (o, g) in group.geometry.iter_mut().zip(&s.geometry[i * width..(i + 1) * width]) {
                    *o += weight * g;
                }
                if group.weight >= self.shared_weight {
                    s.close(r);
                }
            }
            if last - first == size && s.light[r] >= self.pruning.stop {
                s.near_far[r * 2] = s.samples.t[last - 1] + s.samples.dt[last - 1];
                s.going_on.push(r as u32);
            }
        }
        std::mem::swap(&mut s.active, &mut s.going_on);
    }
}

/// Output rows of a block.
struct Traces<'a> {
    rgb: &'a mut [f32],
    opacity: &'a mut [f32],
    depth: &'a mut [f32],
}

impl Scratch {
    fn begin(&mut self, rays: &MarchRays, geometry: usize) {
        let n = rays.jitter.len();
        self.near_far.clear();
        self.near_far.extend_from_slice(rays.near_far);
        for (v, start) in [(&mut self.light, 1.0), (&mut self.held, 0.0)] {
            v.clear();
            v.resize(n, start);
        }
        self.groups.resize_with(n.max(1), Group::default);
        for g in &mut self.groups {
            (g.weight, g.end) = (0.0, 0.0);
            g.geometry.clear();
            g.geometry.resize(geometry, 0.0);
        }
        self.active.clear();
        self.active.extend((0..n).filter(|r| rays.near_far[r * 2] < rays.near_far[r * 2 + 1]).map(|r| r as u32));
        self.colors.clear();
    }

    /// Asks for the color of the samples of ray `r` that wait.
    fn close(&mut self, r: usize) {
        let group = &mut self.groups[r];
        if group.weight > 0.0 {
            self.colors.geometry.extend(group.geometry.iter().map(|g| g / group.weight));
            self.colors.rays.push(r as u32);
            self.colors.weights.push(group.weight);
        }
        group.weight = 0.0;
        group.geometry.fill(0.0);
    }
}

impl Colors {
    fn clear(&mut self) {
        self.geometry.clear();
        self.rays.clear();
        self.weights.clear();
    }

    /// Evaluates all colors that are wanted and adds them to their rays.
    fn settle(&mut self, inference: &Inference, codes: &[Codes], buf: &mut InferBuffers, held: &mut [f32], rgb: &mut [f32]) {
        if self.rays.is_empty() {
            return;
        }
        inference.color(&self.geometry, &self.rays, codes, &mut self.rgb, buf);
        for ((c, &r), w) in self.rgb.chunks_exact(3).zip(&self.rays).zip(&self.weights) {
            let r = r as usize;
            held[r] += w;
            for k in 0..3 {
                rgb[r * 3 + k] += w * c[k];
            }
        }
        self.clear();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fields::{self, FieldBuffers};
    use crate::renderers::volume::{Backdrop, Quality, Tracer};
    use crate::samplers::RayBatch;
    use crate::samplers::occupancy::Occupancy;
    use crate::samplers::placement::Placement;
    use diorama_geom::contraction::Space;
    use diorama_geom::rng::Rng;
    use diorama_kernels::gemm::Precision;
    use diorama_kernels::ops::hash_grid::HashGridConfig;

    /// More than one block, the last one not full.
    const RAYS: usize = 150;

    /// A field of varying density and color, foggy in places and opaque in others.
    fn field(space: Space, images: usize, precision: Precision) -> Field {
        let config = HashGridConfig { levels: 6, features: 2, log2_size: 12, base: 4, finest: 64 };
        let mut field = fields::ngp(config, space, 1e-2, images, if images > 0 { 4 } else { 0 }, 1);
        let rng = Rng::new(3, 3);
        let table = &mut field.encoder.table_mut().expect("a hash field").values;
        table.iter_mut().enumerate().for_each(|(i, v)| *v = rng.normal(i as u64) * 0.7);
        field.net.density.shift = 2.0;
        field.net.mlp.precision = precision;
        field
    }

    /// Rays side by side into the cube; some miss it.
    fn batch() -> RayBatch {
        let mut b = RayBatch::default();
        b.resize(RAYS);
        for r in 0..RAYS {
            b.origins[r * 3..r * 3 + 3].copy_from_slice(&[0.5, 0.5, -0.6]);
            let d = [(r % 10) as f32 / 25.0 - 0.18, (r / 10) as f32 / 30.0 - 0.2, 1.0f32];
            let l = d.iter().map(|v| v * v).sum::<f32>().sqrt();
            (0..3).for_each(|k| b.dirs[r * 3 + k] = d[k] / l);
            b.near_far[r * 2..r * 2 + 2].copy_from_slice(&if r % 13 == 5 { [1.0, 0.0] } else { [0.3, [4.0, 4.0, 0.42][r % 3]] });
            b.jitter[r] = 0.5;
        }
        b
    }

    fn traced(field: &Field, occupancy: &Occupancy, stop: f32, shared_weight: f32, appearance: Option<u32>) -> Traced {
        let pruning = Pruning { stop, min_alpha: 0.0, thin: f32::INFINITY, min_weight: 0.0 };
        let tracer = Tracer {
            occupancy: Some(occupancy),
            backdrop: Backdrop::Color([0.2, 0.5, 0.9]),
            near: 0.1,
            shared_weight,
            appearance,
            ..Tracer::new(field, Placement::occupied(occupancy, 700, pruning), (0.0, 1.0))
        };
        tracer.trace(&mut batch(), &mut FieldBuffers::default())
    }

    fn farthest(a: &[f32], b: &[f32]) -> f32 {
        a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
    }

    #[test]
    fn blocks_equal_samples_on_their_own() {
        for (space, unbounded, images) in [(Space::Cube(1.0), false, 0), (Space::Contracted(1.0), true, 3)] {
            for precision in [Precision::F32, Precision::Bf16] {
                let f = field(space, images, precision);
                let mut occupancy = Occupancy::new(16, 2, unbounded);
                let rng = Rng::new(5, 5);
                occupancy.grid.bits.fill_with(|i| rng.uniform(i as u64) > 0.4);
                let own = traced(&f, &occupancy, 1e-4, 0.0, None);
                assert!(
                    own.opacity.iter().any(|o| *o > 0.999) && own.opacity.iter().filter(|o| **o > 0.1 && **o < 0.9).count() > 10,
                    "{:?}",
                    own.opacity
                );
                // A color per sample: only roundings differ.
                let each = traced(&f, &occupancy, 1e-4, 1e-9, None);
                let bound = if precision == Precision::F32 { 1e-3 } else { 4e-3 };
                let off = farthest(&each.rgb, &own.rgb);
                assert!(off < bound, "{space:?} {precision:?}: {off}");
                assert!(farthest(&each.opacity, &own.opacity) < bound && farthest(&each.depth, &own.depth) < 8.0 * bound);
                let full = traced(&f, &occupancy, 1e-4, Quality::Full.shared_weight(), None);
                let off = farthest(&full.rgb, &own.rgb);
                let mean = full.rgb.iter().zip(&own.rgb).map(|(a, b)| (a - b).abs()).sum::<f32>() / (3 * RAYS) as f32;
                assert!(off < 0.02 && mean < 0.002, "{space:?} {precision:?}: {off}, {mean} in the mean with shared colors");
                assert_eq!((&full.opacity, &full.depth), (&each.opacity, &each.depth), "colors alone are shared");
                // The bounds tell: samples of little weight that go missing exceed them.
                let cut = traced(&f, &occupancy, 0.1, 1e-9, None);
                assert!(farthest(&cut.rgb, &own.rgb) > bound, "rays that end early are seen");
                if images > 0 {
                    let worn = traced(&f, &occupancy, 1e-4, 1e-9, Some(1));
                    let want = traced(&f, &occupancy, 1e-4, 0.0, Some(1));
                    assert!(farthest(&worn.rgb, &want.rgb) < bound && farthest(&want.rgb, &own.rgb) > 0.0);
                }
            }
        }
    }

    #[test]
    fn sharing_makes_fewer_colors_and_loses_no_weight() {
        let f = field(Space::Cube(1.0), 0, Precision::F32);
        let Encoder::Hash { grid: encoding, table } = &f.encoder else { unreachable!() };
        let inference = Inference::new(encoding, &table.values, &f.net, &f.weights.values).expect("a field that splits");
        let mut s = Scratch::default();
        let (origins, dirs, near_far, jitter) = ([0.5, 0.5, -0.6], [0.0, 0.0, 1.0], [0.3, 4.0], [0.5]);
        let rays = MarchRays { origins: &origins, dirs: &dirs, near_far: &near_far, jitter: &jitter, resumed: false };
        s.begin(&rays, inference.geometry_width());
        // Samples of weight 0.004 side by side, then one far behind.
        for i in 0..51 {
            s.samples.t.push(if i == 50 { 3.0 } else { 1.0 + 0.01 * i as f32 });
            s.samples.dt.push(0.01);
            s.alpha.push(0.004 / (1.0 - 0.004 * i as f32));
            s.geometry.extend([i as f32; 16]);
        }
        s.spans.push((0, 51));
        let grid = OccupancyBits::full(16, 1);
        let pruning = Pruning { stop: 1e-4, min_alpha: 0.0, thin: f32::INFINITY, min_weight: 0.0 };
        let blocks = Blocks { field: &f, grid: &grid, march: MarchConfig::default(), pruning, shared_weight: 0.0159 };
        let (mut rgb, mut opacity, mut depth) = ([0.0; 3], [0.0], [0.0]);
        blocks.absorb(&mut s, &mut Traces { rgb: &mut rgb, opacity: &mut opacity, depth: &mut depth }, 51);
        s.close(0);
        // Fours, what is left of them before the gap, and the one behind it.
        assert_eq!(s.colors.rays.len(), 14, "{:?}", s.colors.weights);
        assert!((s.colors.weights.iter().sum::<f32>() - 51.0 * 0.004).abs() < 1e-5);
        assert!(s.colors.weights.iter().all(|w| *w < 0.0159 + 0.0041));
        let first = |k: usize| s.colors.geometry[k * 16];
        assert!((first(0) - 1.5).abs() < 1e-3 && (first(12) - 48.5).abs() < 1e-2 && (first(13) - 50.0).abs() < 1e-3);
    }
}
