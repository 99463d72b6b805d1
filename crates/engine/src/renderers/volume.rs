//! Volume rendering of whole images.

use super::blocks::{self, Blocks};
use super::supervised::Unserved;
use crate::background::LearnedBackground;
use crate::fields::{Batch, Field, FieldBuffers, Pruning};
use crate::samplers::occupancy::Occupancy;
use crate::samplers::{RayBatch, pixels, stratified};
use diorama_geom::color::srgb_from_linear;
use diorama_geom::glam::DVec3;
use diorama_geom::{Image, OrientedBox};
use diorama_kernels::ops::composite::Packed;
use diorama_kernels::ops::march::{self, MarchConfig, MarchRays, Marched};
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

/// How samples are placed, for who has the field and its grid already.
#[derive(Clone, Copy, Debug)]
pub enum Placement {
    March(MarchConfig),
    Stratified { samples: usize },
    Hierarchical { samples: usize, more: usize },
}

/// Evaluates a field elsewhere than on the CPU.
pub trait Accelerator: Send + Sync {
    /// What rays come to before black, and of marched ones the share of light that passes each.
    ///
    /// # Errors
    /// When the device failed.
    fn trace(
        &self,
        batch: &RayBatch,
        placement: &Placement,
        pruning: Pruning,
        appearance: Option<u32>,
    ) -> Result<(Traced, Option<Vec<f32>>), Unserved>;

    /// Densities `[N]` at model points `[N, 3]`.
    ///
    /// # Errors
    /// When the device failed.
    fn density(&self, model: &[f32]) -> Result<Vec<f32>, Unserved>;

    /// The field's own colours `[N, 3]` at model points, seen along unit directions, wearing the mean appearance.
    ///
    /// # Errors
    /// When the device failed.
    fn color(&self, model: &[f32], dirs: &[f32]) -> Result<Vec<f32>, Unserved>;

    /// Rays that are worth a call.
    fn rays(&self) -> usize;
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
    /// And only what lies in this box, which may be turned (model space).
    pub crop: Option<OrientedBox>,
    /// Samples that are left out where an occupancy grid places them.
    pub pruning: Pruning,
    /// Training image whose appearance is worn; none: the mean.
    pub appearance: Option<u32>,
    /// Whether colors are linear light, which [`Tracer::view`] encodes to sRGB; values above 1 go on along the curve.
    pub is_linear: bool,
    /// Weight up to which neighbouring samples of a ray share one color on the CPU; 0: each has its own.
    pub shared_weight: f32,
    /// Pixels are interpolated where traced neighbours differ by no more than this; 0: all are traced.
    pub tolerance: f32,
    /// Traces instead of the CPU, which goes on where it fails; rays of an abandoned device come back empty.
    pub accelerator: Option<&'a dyn Accelerator>,
}

/// How much care a view gets.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Quality {
    /// Every pixel is traced until a thousandth of the light is left, no sample that light reaches is left out.
    #[default]
    Full,
    /// For previews: rays end earlier, faint samples and pixels between like neighbours are left out.
    Fast,
}

impl Quality {
    /// What is left out of a view.
    pub fn pruning(self) -> Pruning {
        match self {
            Quality::Full => Pruning { stop: 1e-3, min_alpha: 0.0, thin: f32::INFINITY, min_weight: 0.0 },
            Quality::Fast => Pruning { stop: 3e-2, min_alpha: 1e-2, thin: f32::INFINITY, min_weight: 1e-2 },
        }
    }

    /// The [`Tracer::shared_weight`].
    pub fn shared_weight(self) -> f32 {
        match self {
            Quality::Full => 1.0 / 16.0,
            Quality::Fast => 1.0 / 8.0,
        }
    }

    /// The [`Tracer::tolerance`].
    pub fn tolerance(self) -> f32 {
        match self {
            Quality::Full => 0.0,
            Quality::Fast => 0.05,
        }
    }
}

impl std::str::FromStr for Quality {
    type Err = String;

    fn from_str(s: &str) -> Result<Self, String> {
        match s {
            "full" => Ok(Quality::Full),
            "fast" => Ok(Quality::Fast),
            _ => Err(format!("quality {s:?}: expected full or fast")),
        }
    }
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

/// Shortens rays to what lies in a box.
fn cut_to(crop: &OrientedBox, batch: &mut RayBatch) {
    let vector = |v: &[f32]| DVec3::new(v[0] as f64, v[1] as f64, v[2] as f64);
    let rays = batch.origins.chunks_exact(3).zip(batch.dirs.chunks_exact(3));
    for ((o, d), near_far) in rays.zip(batch.near_far.chunks_exact_mut(2)) {
        let (near, far) = crop.intersect(vector(o), vector(d)).unwrap_or((0.0, 0.0));
        let (near, far) = (near_far[0].max(near as f32), near_far[1].min(far as f32));
        near_far.copy_from_slice(&if near < far { [near, far] } else { [0.0, 0.0] });
    }
}

/// Rays per chunk of an image, and where blocks of them need no memory of their own.
const CHUNK: usize = 1 << 12;
const CHUNK_OF_BLOCKS: usize = 1 << 14;
/// Pixels between those that are traced first where pixels may be interpolated.
const COARSEST: usize = 4;

/// Colour, opacity and `Σ w t` of rays.
#[derive(Clone, Debug, Default)]
pub struct Traced {
    pub rgb: Vec<f32>,
    pub opacity: Vec<f32>,
    pub depth: Vec<f32>,
}

impl Traced {
    /// Rays that meet nothing.
    fn nothing(rays: usize) -> Traced {
        Traced { rgb: vec![0.0; rays * 3], opacity: vec![0.0; rays], depth: vec![0.0; rays] }
    }

    /// Scales each ray to the opacity `1 − light` that it has with the samples that were left out.
    fn make_up(&mut self, light: &[f32], stop: f32) {
        for (r, light) in light.iter().enumerate() {
            let full = if *light < stop { 1.0 } else { 1.0 - light };
            let kept = self.opacity[r];
            if kept > 1e-3 && full > kept {
                let by = full / kept;
                self.rgb[r * 3..r * 3 + 3].iter_mut().for_each(|v| *v *= by);
                (self.opacity[r], self.depth[r]) = (full, self.depth[r] * by);
            }
        }
    }
}

impl Tracer<'_> {
    /// Renders the view of a camera that stands in model space; `progress` is told the rows done.
    pub fn view(&self, camera: &PosedCamera, progress: &mut dyn FnMut(usize)) -> View {
        let (w, h) = (camera.camera.width as usize, camera.camera.height as usize);
        let mut out = View { rgb: Image::zeros(w, h, 3), opacity: Image::zeros(w, h, 1), depth: Image::zeros(w, h, 1) };
        let (mut batch, mut buf) = (RayBatch::default(), FieldBuffers::default());
        let mut wanted = Vec::with_capacity(w * h);
        let coarsest = if self.tolerance > 0.0 { COARSEST } else { 1 };
        let tile = blocks::EDGE * coarsest;
        for (top, left) in (0..h).step_by(tile).flat_map(|y| (0..w).step_by(tile).map(move |x| (y, x))) {
            for y in (top..h.min(top + tile)).step_by(coarsest) {
                wanted.extend((left..w.min(left + tile)).step_by(coarsest).map(|x| (y * w + x) as u32));
            }
        }
        self.pixels(camera, &wanted, &mut batch, &mut buf, &mut out, progress);
        let mut stride = coarsest;
        while stride > 1 {
            wanted.clear();
            between(&mut out, stride, self.tolerance, &mut wanted);
            in_tiles(&mut wanted, w, blocks::EDGE * stride / 2);
            self.pixels(camera, &wanted, &mut batch, &mut buf, &mut out, progress);
            stride /= 2;
        }
        out
    }

    /// Traces the listed pixels of a view; `progress` is told how many rows' worth.
    fn pixels(
        &self,
        camera: &PosedCamera,
        wanted: &[u32],
        batch: &mut RayBatch,
        buf: &mut FieldBuffers,
        out: &mut View,
        progress: &mut dyn FnMut(usize),
    ) {
        let (w, mut done) = (out.rgb.width, 0);
        let in_blocks = self.shared_weight > 0.0 && matches!(self.sampling, Sampling::Occupancy { .. });
        let on_cpu = if in_blocks { CHUNK_OF_BLOCKS } else { CHUNK };
        for part in wanted.chunks(self.accelerator.map_or(on_cpu, |a| a.rays())) {
            batch.resize(part.len());
            for (i, &p) in part.iter().enumerate() {
                batch.pixels[i * 2] = (p as usize % w) as f32 + 0.5;
                batch.pixels[i * 2 + 1] = (p as usize / w) as f32 + 0.5;
                batch.images[i] = 0;
                batch.jitter[i] = 0.5;
            }
            pixels::rays(std::slice::from_ref(camera), self.near, self.cube, batch);
            let traced = self.trace(batch, buf);
            for (i, &p) in part.iter().enumerate() {
                let (p, o) = (p as usize, traced.opacity[i]);
                let rgb = &traced.rgb[i * 3..i * 3 + 3];
                for (o, v) in out.rgb.data[p * 3..p * 3 + 3].iter_mut().zip(rgb) {
                    *o = if self.is_linear { srgb_from_linear(*v) } else { *v };
                }
                out.opacity.data[p] = o;
                out.depth.data[p] = if o > 1e-3 { traced.depth[i] / o } else { 0.0 };
            }
            progress((done + part.len()) / w - done / w);
            done += part.len();
        }
    }

    /// Traces the rays of a batch, whose origins, directions and extents are set; colors stay as the field has them.
    pub fn trace(&self, batch: &mut RayBatch, buf: &mut FieldBuffers) -> Traced {
        if let Some((min, max)) = self.clip {
            diorama_kernels::ops::ray_aabb::cpu::intersect(&batch.origins, &batch.dirs, min, max, self.near, &mut batch.near_far);
        }
        if let Some(crop) = &self.crop {
            cut_to(crop, batch);
        }
        let placement = match self.sampling {
            Sampling::Occupancy { grid, max_samples } => Placement::March(grid.march_config(max_samples)),
            Sampling::Stratified { samples } => Placement::Stratified { samples },
            Sampling::Hierarchical { samples, more, .. } => Placement::Hierarchical { samples, more },
        };
        match self.accelerator.map(|a| a.trace(batch, &placement, self.pruning, self.appearance)) {
            Some(Ok((mut out, light))) => {
                if let Some(light) = light
                    && (self.pruning.min_alpha > 0.0 || self.pruning.min_weight > 0.0)
                {
                    out.make_up(&light, self.pruning.stop);
                }
                return self.before_backdrop(batch, out);
            }
            Some(Err(Unserved::Abandoned)) => return Traced::nothing(batch.len()),
            Some(Err(Unserved::Failed(_))) | None => {}
        }
        let out = match self.sampling {
            Sampling::Occupancy { grid, max_samples } => {
                let rays = MarchRays {
                    origins: &batch.origins,
                    dirs: &batch.dirs,
                    near_far: &batch.near_far,
                    jitter: &batch.jitter,
                    resumed: false,
                };
                let march = grid.march_config(max_samples);
                if self.shared_weight > 0.0 {
                    let images = self.appearance.map(|i| vec![i; batch.len()]);
                    let (field, pruning, shared_weight) = (self.field, self.pruning, self.shared_weight);
                    let blocks = Blocks { field, grid: &grid.bits, march, pruning, shared_weight };
                    if let Some(out) = blocks.trace(&rays, images.as_deref()) {
                        return self.before_backdrop(batch, out);
                    }
                }
                let (mut marched, mut positions) = (Marched::default(), Vec::new());
                self.field.visible(&grid.bits, &rays, &march, self.pruning, &mut marched, &mut positions, buf);
                self.composite(self.field, batch, &marched, &positions, buf);
                let mut out = taken(buf);
                if self.pruning.min_alpha > 0.0 || self.pruning.min_weight > 0.0 {
                    out.make_up(&buf.visible.light(batch.len()), self.pruning.stop);
                }
                out
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
        self.before_backdrop(batch, out)
    }

    /// Lets the backdrop show through.
    fn before_backdrop(&self, batch: &RayBatch, mut out: Traced) -> Traced {
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

/// Orders pixels by square tiles of the given edge, so that neighbours are traced together.
fn in_tiles(pixels: &mut [u32], width: usize, edge: usize) {
    let (width, edge) = (width as u32, edge as u32);
    pixels.sort_by_cached_key(|p| (p / width / edge, p % width / edge, *p));
}

/// Fills pixels half way between those `stride` apart: interpolated where the corners around them are alike,
/// else listed in `wanted`.
fn between(view: &mut View, stride: usize, tolerance: f32, wanted: &mut Vec<u32>) {
    let (w, h, half) = (view.rgb.width, view.rgb.height, stride / 2);
    for y in (0..h).step_by(half) {
        for x in (0..w).step_by(half) {
            let (dx, dy) = (x % stride, y % stride);
            if dx == 0 && dy == 0 {
                continue;
            }
            let (x0, y0) = (x - dx, y - dy);
            let (x1, y1) = (x0 + stride, y0 + stride);
            let at = y * w + x;
            if x1 >= w || y1 >= h {
                wanted.push(at as u32);
                continue;
            }
            let corners = [y0 * w + x0, y0 * w + x1, y1 * w + x0, y1 * w + x1];
            let alike = |data: &[f32], channels: usize, k: usize, slack: f32| {
                let v = corners.map(|c| data[c * channels + k]);
                v.iter().copied().fold(f32::MIN, f32::max) - v.iter().copied().fold(f32::MAX, f32::min) <= slack
            };
            let depth = view.depth.data[corners[0]];
            let flat = (0..3).all(|k| alike(&view.rgb.data, 3, k, tolerance))
                && alike(&view.opacity.data, 1, 0, tolerance)
                && alike(&view.depth.data, 1, 0, tolerance * depth);
            if !flat {
                wanted.push(at as u32);
                continue;
            }
            let of = |dx: usize| if dx == 0 { [1.0, 0.0] } else { [0.5, 0.5] };
            let (fx, fy) = (of(dx), of(dy));
            let weights = [fy[0] * fx[0], fy[0] * fx[1], fy[1] * fx[0], fy[1] * fx[1]];
            let mix = |data: &mut [f32], channels: usize| {
                for k in 0..channels {
                    data[at * channels + k] = corners.iter().zip(weights).map(|(c, w)| w * data[c * channels + k]).sum();
                }
            };
            mix(&mut view.rgb.data, 3);
            mix(&mut view.opacity.data, 1);
            mix(&mut view.depth.data, 1);
        }
    }
}

fn taken(buf: &mut FieldBuffers) -> Traced {
    let o = &mut buf.out;
    Traced { rgb: std::mem::take(&mut o.values), opacity: std::mem::take(&mut o.opacity), depth: std::mem::take(&mut o.depth) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fields;
    use diorama_geom::contraction::Space;
    use diorama_geom::glam::DVec3;
    use diorama_geom::{Camera, Pose};
    use diorama_kernels::ops::hash_grid::HashGridConfig;

    #[test]
    fn waves_equal_one_long_march() {
        let grid = HashGridConfig { levels: 3, features: 2, log2_size: 10, base: 4, finest: 16 };
        let mut field = fields::ngp(grid, Space::Cube(1.0), 1e-2, 0, 0, 1);
        field.net.density.shift = 1.2;
        let occupancy = Occupancy::new(16, 1, false);
        let pose = Pose::look_at(DVec3::new(1.9, 1.2, 1.0), DVec3::splat(0.5), DVec3::Z);
        let camera = PosedCamera { camera: Camera::pinhole(12, 10, 0.6), pose };
        let tracer = Tracer {
            field: &field,
            sampling: Sampling::Occupancy { grid: &occupancy, max_samples: 4096 },
            backdrop: Backdrop::Color([0.2, 0.5, 0.9]),
            near: 0.1,
            cube: (0.0, 1.0),
            clip: None,
            crop: None,
            is_linear: false,
            shared_weight: 0.0,
            pruning: Pruning { stop: 0.0, min_alpha: 0.0, thin: f32::INFINITY, min_weight: 0.0 },
            appearance: None,
            tolerance: 0.0,
            accelerator: None,
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
                let want = buf.out.values[r * 3 + k] + (1.0 - buf.out.opacity[r]) * [0.2, 0.5, 0.9][k];
                assert!((view.rgb.data[r * 3 + k] - want).abs() < 2e-3, "{r} {} {want}", view.rgb.data[r * 3 + k]);
            }
        }
    }

    #[test]
    fn the_clip_box_hides_what_lies_outside() {
        let grid = HashGridConfig { levels: 2, features: 2, log2_size: 8, base: 4, finest: 8 };
        let mut field = fields::ngp(grid, Space::Cube(1.0), 1e-2, 0, 0, 1);
        field.net.density.shift = 6.0;
        let occupancy = Occupancy::new(16, 1, false);
        let pose = Pose::look_at(DVec3::new(0.5, -1.5, 0.5), DVec3::splat(0.5), DVec3::Z);
        let camera = PosedCamera { camera: Camera::pinhole(9, 9, 0.8), pose };
        let mut tracer = Tracer {
            field: &field,
            sampling: Sampling::Occupancy { grid: &occupancy, max_samples: 1024 },
            backdrop: Backdrop::Color([0.0; 3]),
            near: 0.1,
            cube: (0.0, 1.0),
            clip: None,
            crop: None,
            is_linear: false,
            shared_weight: 0.0,
            pruning: Pruning { stop: 1e-4, min_alpha: 0.0, thin: f32::INFINITY, min_weight: 0.0 },
            appearance: None,
            tolerance: 0.0,
            accelerator: None,
        };
        assert!(tracer.view(&camera, &mut |_| {}).opacity.data[40 + 2] > 0.9);
        tracer.clip = Some(([0.45, 0.0, 0.45], [0.55, 1.0, 0.55]));
        let v = tracer.view(&camera, &mut |_| {});
        assert!(v.opacity.data[40] > 0.9 && v.opacity.data[42] == 0.0);
        // A turned box hides the rest of it: standing on its edge it is seen through its corner.
        tracer.clip = None;
        let turned = diorama_geom::glam::DMat3::from_rotation_y(std::f64::consts::FRAC_PI_4);
        let place = Pose { rotation: turned, translation: DVec3::splat(0.5) };
        tracer.crop = Some(OrientedBox { place, sides: DVec3::new(0.4, 0.9, 0.4) });
        let v = tracer.view(&camera, &mut |_| {});
        let at = |x: usize, y: usize| v.opacity.data[y * 9 + x];
        assert!(at(4, 4) > 0.9 && at(3, 4) > 0.5 && at(4, 3) > 0.5, "within");
        assert!([(0, 0), (8, 8), (0, 4), (2, 2)].iter().all(|(x, y)| at(*x, *y) == 0.0), "beside");
    }

    #[test]
    fn linear_light_is_seen_along_the_srgb_curve() {
        let grid = HashGridConfig { levels: 2, features: 2, log2_size: 8, base: 4, finest: 8 };
        let field = fields::ngp(grid, Space::Cube(1.0), 1e-2, 0, 0, 1);
        let pose = Pose::look_at(DVec3::new(0.5, -1.5, 0.5), DVec3::new(0.5, -9.0, 0.5), DVec3::Z);
        let camera = PosedCamera { camera: Camera::pinhole(2, 2, 0.8), pose };
        let tracer = Tracer {
            field: &field,
            sampling: Sampling::Stratified { samples: 2 },
            backdrop: Backdrop::Color([0.214_041, 1.0, 7.0]),
            near: 0.1,
            cube: (0.0, 1.0),
            clip: None,
            crop: None,
            is_linear: true,
            shared_weight: 0.0,
            pruning: Pruning { stop: 1e-4, min_alpha: 0.0, thin: f32::INFINITY, min_weight: 0.0 },
            appearance: None,
            tolerance: 0.0,
            accelerator: None,
        };
        let v = tracer.view(&camera, &mut |_| {});
        let want = [0.5, 1.0, srgb_from_linear(7.0)];
        assert!((0..3).all(|k| (v.rgb.data[k] - want[k]).abs() < 1e-3), "{:?}", &v.rgb.data[..3]);
    }

    fn picture(w: usize, h: usize, f: impl Fn(usize, usize) -> f32) -> View {
        let mut v = View { rgb: Image::zeros(w, h, 3), opacity: Image::zeros(w, h, 1), depth: Image::zeros(w, h, 1) };
        for i in 0..w * h {
            v.rgb.data[i * 3..i * 3 + 3].fill(f(i % w, i / w));
            (v.opacity.data[i], v.depth.data[i]) = (1.0, 2.0);
        }
        v
    }

    #[test]
    fn pixels_are_interpolated_where_neighbours_agree_and_traced_where_not() {
        let (w, h) = (17, 13);
        let ramp = |x: usize, y: usize| 0.001 * x as f32 + 0.002 * y as f32;
        let mut v = picture(w, h, |x, y| if x % 4 == 0 && y % 4 == 0 { ramp(x, y) } else { 9.0 });
        let mut wanted = Vec::new();
        for stride in [4, 2] {
            wanted.clear();
            between(&mut v, stride, 0.05, &mut wanted);
            // Lattice cells that reach beyond the picture have no corners to go by.
            assert!(wanted.iter().all(|&p| p as usize % w >= 16 || p as usize / w >= 12), "{wanted:?}");
            wanted.iter().for_each(|&p| v.rgb.data[p as usize * 3..][..3].fill(ramp(p as usize % w, p as usize / w)));
        }
        for i in (0..w * h).filter(|i| i % w < 16 && i / w < 12) {
            assert!((v.rgb.data[i * 3] - ramp(i % w, i / w)).abs() < 1e-6, "pixel {i}");
        }
        let mut edge = picture(w, h, |x, _| (x > 7) as u8 as f32);
        wanted.clear();
        between(&mut edge, 4, 0.05, &mut wanted);
        assert!(wanted.contains(&(2 * w as u32 + 6)) && !wanted.contains(&(2 * w as u32 + 2)), "{wanted:?}");
    }

    #[test]
    fn a_fast_view_is_close_to_a_full_one() {
        let grid = HashGridConfig { levels: 3, features: 2, log2_size: 10, base: 4, finest: 16 };
        let mut field = fields::ngp(grid, Space::Cube(1.0), 1e-2, 0, 0, 1);
        field.net.density.shift = 3.0;
        let occupancy = Occupancy::new(16, 1, false);
        let pose = Pose::look_at(DVec3::new(1.9, 1.2, 1.0), DVec3::splat(0.5), DVec3::Z);
        let camera = PosedCamera { camera: Camera::pinhole(40, 32, 0.6), pose };
        let draw = |quality: Quality| {
            let tracer = Tracer {
                field: &field,
                sampling: Sampling::Occupancy { grid: &occupancy, max_samples: 1024 },
                backdrop: Backdrop::Color([0.2, 0.5, 0.9]),
                near: 0.1,
                cube: (0.0, 1.0),
                clip: None,
                crop: None,
                is_linear: false,
                pruning: quality.pruning(),
                shared_weight: quality.shared_weight(),
                appearance: None,
                tolerance: quality.tolerance(),
                accelerator: None,
            };
            let mut rays = 0;
            let view = tracer.view(&camera, &mut |rows| rays += rows * 40);
            (view.rgb.data, rays)
        };
        let ((full, all), (fast, some)) = (draw(Quality::Full), draw(Quality::Fast));
        let mse = full.iter().zip(&fast).map(|(a, b)| (a - b).powi(2)).sum::<f32>() / full.len() as f32;
        assert!(mse > 0.0 && mse < 1e-3, "{mse}");
        assert!(some < all, "{some} of {all} pixels");
    }
}
