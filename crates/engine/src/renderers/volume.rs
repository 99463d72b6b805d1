//! Volume rendering of whole images.

use crate::background::LearnedBackground;
use crate::fields::{Batch, Field, FieldBuffers, Pruning};
use crate::samplers::occupancy::Occupancy;
use crate::samplers::{RayBatch, pixels, stratified};
use diorama_geom::Image;
use diorama_kernels::ops::composite::Packed;
use diorama_kernels::ops::march::{self, MarchRays, Marched};
use diorama_kernels::ops::ray_generation::PosedCamera;

/// What stands behind the scene.
#[derive(Clone, Copy)]
pub enum Backdrop<'a> {
    Color([f32; 3]),
    Learned(&'a LearnedBackground),
}

/// How samples are placed.
#[derive(Clone, Copy)]
pub enum Sampling<'a> {
    Occupancy {
        grid: &'a Occupancy,
        max_samples: usize,
    },
    Stratified {
        samples: usize,
    },
    /// `samples` for the coarse field decide where `more` go for the main one.
    Hierarchical {
        coarse: &'a Field,
        samples: usize,
        more: usize,
    },
}

/// A field ready to be looked at.
#[derive(Clone, Copy)]
pub struct Tracer<'a> {
    pub field: &'a Field,
    pub sampling: Sampling<'a>,
    pub backdrop: Backdrop<'a>,
    pub near: f32,
    /// The scene's outer cube in model space: lowest corner and edge.
    pub cube: (f32, f32),
    /// Only what lies in this box (lowest and highest corner, model space) is shown.
    pub clip: Option<([f32; 3], [f32; 3])>,
    /// Samples that are left out where an occupancy grid places them.
    pub pruning: Pruning,
    /// Training image whose appearance is worn; none: the mean.
    pub appearance: Option<u32>,
}

/// Layers of a rendered view.
#[derive(Clone, Debug)]
pub struct View {
    /// sRGB with the background, `[H, W, 3]`.
    pub rgb: Image,
    /// `[H, W, 1]`
    pub opacity: Image,
    /// Expected distance along the ray in model units, 0 where nothing is hit, `[H, W, 1]`.
    pub depth: Image,
}

/// Rays per chunk of an image.
const CHUNK: usize = 1 << 12;

/// Colour, opacity and `Σ w t` of rays.
#[derive(Clone, Debug, Default)]
pub struct Traced {
    pub rgb: Vec<f32>,
    pub opacity: Vec<f32>,
    pub depth: Vec<f32>,
}

impl Tracer<'_> {
    /// Renders the view of a camera that stands in model space; `progress` is told the rows done.
    pub fn view(&self, camera: &PosedCamera, progress: &mut dyn FnMut(usize)) -> View {
        let (w, h) = (camera.camera.width as usize, camera.camera.height as usize);
        let mut out = View { rgb: Image::zeros(w, h, 3), opacity: Image::zeros(w, h, 1), depth: Image::zeros(w, h, 1) };
        let (mut batch, mut buf) = (RayBatch::default(), FieldBuffers::default());
        let rows = (CHUNK / w).max(1);
        for first in (0..h).step_by(rows) {
            let n = rows.min(h - first) * w;
            batch.resize(n);
            for i in 0..n {
                batch.pixels[i * 2] = (i % w) as f32 + 0.5;
                batch.pixels[i * 2 + 1] = (first + i / w) as f32 + 0.5;
                batch.images[i] = 0;
                batch.jitter[i] = 0.5;
            }
            pixels::rays(std::slice::from_ref(camera), self.near, self.cube, &mut batch);
            let traced = self.trace(&mut batch, &mut buf);
            let at = first * w;
            out.rgb.data[at * 3..(at + n) * 3].copy_from_slice(&traced.rgb);
            out.opacity.data[at..at + n].copy_from_slice(&traced.opacity);
            for (d, (t, o)) in out.depth.data[at..at + n].iter_mut().zip(traced.depth.iter().zip(&traced.opacity)) {
                *d = if *o > 1e-3 { t / o } else { 0.0 };
            }
            progress(first + n / w);
        }
        out
    }

    /// Traces the rays of a batch, whose origins, directions and extents are set.
    pub fn trace(&self, batch: &mut RayBatch, buf: &mut FieldBuffers) -> Traced {
        if let Some((min, max)) = self.clip {
            diorama_kernels::ops::ray_aabb::cpu::intersect(&batch.origins, &batch.dirs, min, max, self.near, &mut batch.near_far);
        }
        let mut out = match self.sampling {
            Sampling::Occupancy { grid, max_samples } => {
                let rays = MarchRays {
                    origins: &batch.origins,
                    dirs: &batch.dirs,
                    near_far: &batch.near_far,
                    jitter: &batch.jitter,
                    resumed: false,
                };
                let (mut marched, mut positions) = (Marched::default(), Vec::new());
                self.field.visible(&grid.bits, &rays, &grid.march_config(max_samples), self.pruning, &mut marched, &mut positions, buf);
                self.composite(self.field, batch, &marched, &positions, buf);
                taken(buf)
            }
            Sampling::Stratified { samples } => {
                let mut marched = Marched::default();
                stratified::stratified(batch, samples, None, &mut marched);
                self.evaluate(self.field, batch, &marched, buf);
                taken(buf)
            }
            Sampling::Hierarchical { coarse, samples, more } => {
                let (mut first, mut second) = (Marched::default(), Marched::default());
                stratified::stratified(batch, samples, None, &mut first);
                self.evaluate(coarse, batch, &first, buf);
                stratified::refine(&first, &buf.out.weights, samples, more, None, &mut second);
                self.evaluate(self.field, batch, &second, buf);
                taken(buf)
            }
        };
        let mut behind = Vec::new();
        match self.backdrop {
            Backdrop::Color(c) => behind.extend((0..batch.len()).flat_map(|_| c)),
            Backdrop::Learned(l) => l.forward(&batch.dirs, &mut behind),
        }
        for (r, o) in out.opacity.iter().enumerate() {
            for k in 0..3 {
                out.rgb[r * 3 + k] += (1.0 - o) * behind[r * 3 + k];
            }
        }
        out
    }

    fn evaluate(&self, field: &Field, batch: &RayBatch, marched: &Marched, buf: &mut FieldBuffers) {
        let rays =
            MarchRays { origins: &batch.origins, dirs: &batch.dirs, near_far: &batch.near_far, jitter: &batch.jitter, resumed: false };
        let mut positions = Vec::new();
        march::cpu::positions(&rays, marched, &mut positions);
        self.composite(field, batch, marched, &positions, buf);
    }

    fn composite(&self, field: &Field, batch: &RayBatch, marched: &Marched, positions: &[f32], buf: &mut FieldBuffers) {
        let background = vec![0.0; batch.len() * 3];
        let images = self.appearance.map(|i| vec![i; batch.len()]);
        let samples = Packed { offsets: &marched.offsets, t: &marched.t, dt: &marched.dt };
        let b = Batch { samples, positions, dirs: &batch.dirs, images: images.as_deref(), background: &background, near_scaling: 0.0 };
        field.render(&b, buf);
    }
}

fn taken(buf: &mut FieldBuffers) -> Traced {
    let o = &mut buf.out;
    Traced { rgb: std::mem::take(&mut o.rgb), opacity: std::mem::take(&mut o.opacity), depth: std::mem::take(&mut o.depth) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fields;
    use diorama_geom::glam::DVec3;
    use diorama_geom::{Camera, Pose};
    use diorama_kernels::ops::hash_grid::HashGridConfig;

    #[test]
    fn waves_equal_one_long_march() {
        let grid = HashGridConfig { levels: 3, features: 2, log2_size: 10, base: 4, finest: 16 };
        let mut field = fields::ngp(grid, 1.0, false, 1e-2, 0, 0, 1);
        field.net.sigma.shift = 1.2;
        let occupancy = Occupancy::new(16, 1);
        let pose = Pose::look_at(DVec3::new(1.9, 1.2, 1.0), DVec3::splat(0.5), DVec3::Z);
        let camera = PosedCamera { camera: Camera::pinhole(12, 10, 0.6), pose };
        let tracer = Tracer {
            field: &field,
            sampling: Sampling::Occupancy { grid: &occupancy, max_samples: 4096 },
            backdrop: Backdrop::Color([0.2, 0.5, 0.9]),
            near: 0.1,
            cube: (0.0, 1.0),
            clip: None,
            pruning: Pruning { stop: 0.0, min_alpha: 0.0, min_weight: 0.0 },
            appearance: None,
        };
        let view = tracer.view(&camera, &mut |_| {});
        let mut batch = RayBatch::default();
        batch.resize(120);
        for i in 0..120 {
            batch.pixels[i * 2] = (i % 12) as f32 + 0.5;
            batch.pixels[i * 2 + 1] = (i / 12) as f32 + 0.5;
            batch.jitter[i] = 0.5;
        }
        pixels::rays(&[camera], 0.1, (0.0, 1.0), &mut batch);
        let rays =
            MarchRays { origins: &batch.origins, dirs: &batch.dirs, near_far: &batch.near_far, jitter: &batch.jitter, resumed: false };
        let mut marched = Marched::default();
        march::cpu::march(&occupancy.bits, &rays, &occupancy.march_config(4096), &mut Default::default(), &mut marched);
        let mut buf = FieldBuffers::default();
        tracer.evaluate(&field, &batch, &marched, &mut buf);
        for r in 0..120 {
            for k in 0..3 {
                let want = buf.out.rgb[r * 3 + k] + (1.0 - buf.out.opacity[r]) * [0.2, 0.5, 0.9][k];
                assert!((view.rgb.data[r * 3 + k] - want).abs() < 2e-3, "{r} {} {want}", view.rgb.data[r * 3 + k]);
            }
        }
    }

    #[test]
    fn the_clip_box_hides_what_lies_outside() {
        let grid = HashGridConfig { levels: 2, features: 2, log2_size: 8, base: 4, finest: 8 };
        let mut field = fields::ngp(grid, 1.0, false, 1e-2, 0, 0, 1);
        field.net.sigma.shift = 6.0;
        let occupancy = Occupancy::new(16, 1);
        let pose = Pose::look_at(DVec3::new(0.5, -1.5, 0.5), DVec3::splat(0.5), DVec3::Z);
        let camera = PosedCamera { camera: Camera::pinhole(9, 9, 0.8), pose };
        let mut tracer = Tracer {
            field: &field,
            sampling: Sampling::Occupancy { grid: &occupancy, max_samples: 1024 },
            backdrop: Backdrop::Color([0.0; 3]),
            near: 0.1,
            cube: (0.0, 1.0),
            clip: None,
            pruning: Pruning { stop: 1e-4, min_alpha: 0.0, min_weight: 0.0 },
            appearance: None,
        };
        assert!(tracer.view(&camera, &mut |_| {}).opacity.data[40 + 2] > 0.9);
        tracer.clip = Some(([0.45, 0.0, 0.45], [0.55, 1.0, 0.55]));
        let v = tracer.view(&camera, &mut |_| {});
        assert!(v.opacity.data[40] > 0.9 && v.opacity.data[42] == 0.0);
    }
}
