//! Volume rendering of views: `Σ_i T_i α_i c_i` along each ray (Mildenhall et al. 2020, equation 3).

pub use super::accelerator::Accelerator;
pub use super::quality::Quality;
pub use super::traced::Traced;
pub use super::view::View;

use super::accelerator::Unserved;
use super::blocks::{self, Blocks};
use super::view::{interpolate_between, sort_by_tiles};
use crate::background::LearnedBackground;
use crate::fields::{Batch, Field, FieldBuffers, Pruning, Sphere, VisibleSamples};
use crate::samplers::occupancy::Occupancy;
use crate::samplers::placement::{self, PlaceOn, PlacedSamples, Placement};
use crate::samplers::{RayBatch, pixels};
use diorama_geom::OrientedBox;
use diorama_geom::color::srgb_from_linear;
use diorama_geom::glam::DVec3;
use diorama_kernels::ops::composite::Packed;
use diorama_kernels::ops::march::MarchRays;
use diorama_kernels::ops::ray_generation::PosedCamera;

/// Background of rendered views.
#[derive(Clone, Copy)]
pub enum Backdrop<'a> {
    Color([f32; 3]),
    Learned(&'a LearnedBackground),
}

/// Renders views of a field.
#[derive(Clone, Copy)]
pub struct Tracer<'a> {
    pub field: &'a Field,
    /// Places samples for the main field ([`Placement::Hierarchical`]).
    pub coarse: Option<&'a Field>,
    /// Occupied cells ([`Placement::Occupancy`]).
    pub occupancy: Option<&'a Occupancy>,
    pub placement: Placement,
    pub backdrop: Backdrop<'a>,
    pub near: f32,
    /// The scene's outer cube in model space: lowest corner and edge.
    pub cube: (f32, f32),
    /// Only what lies in this box (lowest and highest corner, model space) is shown.
    pub clip: Option<([f32; 3], [f32; 3])>,
    /// Only what also lies in this box, which may be rotated, is shown (model space).
    pub crop: Option<OrientedBox>,
    /// Rays end where they leave this sphere, in which they begin.
    pub within: Option<Sphere>,
    /// Training image whose appearance code is used; none: the mean code.
    pub appearance: Option<u32>,
    /// Unit direction in which colors are seen; none: each ray's own. Then the CPU traces, whatever the accelerator.
    pub seen_along: Option<[f32; 3]>,
    /// Whether colors are linear light, which [`Tracer::view`] encodes to sRGB; values above 1 go on along the curve.
    pub is_linear: bool,
    /// Weight up to which neighbouring samples of a ray share one color on the CPU; 0: each has its own.
    pub shared_weight: f32,
    /// Pixels are interpolated where traced neighbours differ by no more than this; 0: all are traced.
    pub tolerance: f32,
    /// Device that traces instead of the CPU. Where it fails, the CPU goes on; rays of an abandoned device come back empty.
    pub accelerator: Option<&'a dyn Accelerator>,
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

impl<'a> Tracer<'a> {
    /// Full quality before black, without bounds besides the outer `cube` (lowest corner and edge, model space).
    pub fn new(field: &'a Field, placement: Placement, cube: (f32, f32)) -> Tracer<'a> {
        Tracer {
            field,
            coarse: None,
            occupancy: None,
            placement,
            backdrop: Backdrop::Color([0.0; 3]),
            near: 0.0,
            cube,
            clip: None,
            crop: None,
            within: None,
            appearance: None,
            seen_along: None,
            is_linear: false,
            shared_weight: Quality::Full.shared_weight(),
            tolerance: Quality::Full.tolerance(),
            accelerator: None,
        }
    }
}

impl Tracer<'_> {
    /// Renders the view of a camera that stands in model space; `progress` receives the number of rows done since the last call.
    ///
    /// # Panics
    /// When the field's network has other than three channels.
    pub fn view(&self, camera: &PosedCamera, progress: &mut dyn FnMut(usize)) -> View {
        let (w, h) = (camera.camera.width as usize, camera.camera.height as usize);
        let mut out = View::empty(w, h);
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
            interpolate_between(&mut out, stride, self.tolerance, &mut wanted);
            sort_by_tiles(&mut wanted, w, blocks::EDGE * stride / 2);
            self.pixels(camera, &wanted, &mut batch, &mut buf, &mut out, progress);
            stride /= 2;
        }
        out
    }

    /// Traces the listed pixels of a view; `progress` receives the number of rows' worth of pixels.
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
        let in_blocks = self.shared_weight > 0.0 && matches!(self.placement, Placement::Occupancy { .. });
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
    ///
    /// # Panics
    /// When the field's network has other than three channels.
    pub fn trace(&self, batch: &mut RayBatch, buf: &mut FieldBuffers) -> Traced {
        assert_eq!(self.field.net.channels(), 3, "a tracer draws three channels; Tracer::layers renders any");
        self.cut(batch);
        match self.accelerator.filter(|_| self.seen_along.is_none()).map(|a| a.trace(batch, &self.placement, self.appearance)) {
            Some(Ok((out, light))) => {
                let out = match (self.placement, light) {
                    (Placement::Occupancy { pruning, .. }, Some(light)) => restored(out, &light, pruning),
                    _ => out,
                };
                return self.before_backdrop(batch, out);
            }
            Some(Err(Unserved::Abandoned)) => return Traced::nothing(batch.len()),
            Some(Err(Unserved::Failed(_))) | None => {}
        }
        if let Some(out) = self.trace_blocks(batch) {
            return self.before_backdrop(batch, out);
        }
        let mut samples = self.place(batch, &[], buf);
        self.composite(self.field, batch, &[], &mut samples, buf);
        let out = self.restored(take_traced(buf), batch, buf);
        self.before_backdrop(batch, out)
    }

    /// Shortens rays to what is shown.
    pub(super) fn cut(&self, batch: &mut RayBatch) {
        if let Some((min, max)) = self.clip {
            diorama_kernels::ops::ray_aabb::cpu::intersect(&batch.origins, &batch.dirs, min, max, self.near, &mut batch.near_far);
        }
        if let Some(crop) = &self.crop {
            cut_to(crop, batch);
        }
        if let Some(sphere) = &self.within {
            sphere.cut(&batch.origins, &batch.dirs, &mut batch.near_far);
        }
    }

    /// Samples of the main field, encoded; `given` are the codes that fields read, `[R, width]` each.
    pub(super) fn place(&self, batch: &RayBatch, given: &[&[f32]], buf: &mut FieldBuffers) -> VisibleSamples {
        let mut samples = PlacedSamples::default();
        let on = PlaceOn { field: self.field, occupancy: self.occupancy.map(Occupancy::bits), batch, first: 0 };
        self.placement.place(&on, &mut samples, buf, &mut |samples, buf| {
            let coarse = self.coarse.expect("a coarse field");
            placement::encode(coarse, batch, samples);
            self.composite(coarse, batch, given, samples, buf);
        });
        samples.main
    }

    /// Rays of samples that [`Tracer::place`] placed, with the opacity of those that it dropped.
    pub(super) fn restored(&self, out: Traced, batch: &RayBatch, buf: &FieldBuffers) -> Traced {
        match self.placement {
            Placement::Occupancy { pruning, .. } => restored(out, &buf.visible.light(batch.len()), pruning),
            _ => out,
        }
    }

    /// Traces block by block; none where samples are not placed by a grid, or the field cannot be evaluated this way.
    fn trace_blocks(&self, batch: &RayBatch) -> Option<Traced> {
        let Placement::Occupancy { march, pruning } = self.placement else { return None };
        if self.shared_weight == 0.0 || self.seen_along.is_some() {
            return None;
        }
        let RayBatch { origins, dirs, near_far, jitter, .. } = batch;
        let images = self.appearance.map(|i| vec![i; batch.len()]);
        let grid = self.occupancy.expect("an occupancy grid").bits();
        let blocks = Blocks { field: self.field, grid, march, pruning, shared_weight: self.shared_weight };
        blocks.trace(&MarchRays { origins, dirs, near_far, jitter, resumed: false }, images.as_deref())
    }

    /// Adds the background, weighted by the transmittance.
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

    /// Evaluates and composites encoded samples before black.
    fn composite(&self, field: &Field, batch: &RayBatch, given: &[&[f32]], on: &mut VisibleSamples, buf: &mut FieldBuffers) {
        let background = vec![0.0; batch.len() * field.net.channels()];
        let images = self.appearance.map(|i| vec![i; batch.len()]);
        let samples = Packed { offsets: &on.samples.offsets, t: &on.samples.t, dt: &on.samples.dt };
        let given_dirs = self.seen_along.map(|d| d.repeat(batch.len()));
        let dirs = given_dirs.as_deref().unwrap_or(&batch.dirs);
        let (images, background) = (images.as_deref(), &background[..]);
        let b = Batch { samples, positions: &on.positions, dirs, images, given, background, near_scaling: 0.0 };
        field.render_outputs(&b, &mut on.encoded, buf);
    }
}

fn restored(mut out: Traced, light: &[f32], pruning: Pruning) -> Traced {
    if pruning.min_alpha > 0.0 || pruning.min_weight > 0.0 {
        out.restore_opacity(light, pruning.stop);
    }
    out
}

/// Moves a field's rendered rays out of its buffers.
pub(super) fn take_traced(buf: &mut FieldBuffers) -> Traced {
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
    use diorama_kernels::ops::march;

    #[test]
    fn waves_equal_one_long_march() {
        let grid = HashGridConfig { levels: 3, features: 2, log2_size: 10, base: 4, finest: 16 };
        let mut field = fields::ngp(grid, Space::Cube(1.0), 1e-2, 0, 0, 1);
        field.net.density.shift = 1.2;
        let occupancy = Occupancy::new(16, 1, false);
        let pose = Pose::look_at(DVec3::new(1.9, 1.2, 1.0), DVec3::splat(0.5), DVec3::Z);
        let camera = PosedCamera { camera: Camera::pinhole(12, 10, 0.6), pose };
        let pruning = Pruning { stop: 0.0, min_alpha: 0.0, thin: f32::INFINITY, min_weight: 0.0 };
        let tracer = Tracer {
            occupancy: Some(&occupancy),
            backdrop: Backdrop::Color([0.2, 0.5, 0.9]),
            near: 0.1,
            shared_weight: 0.0,
            ..Tracer::new(&field, Placement::occupied(&occupancy, 4096, pruning), (0.0, 1.0))
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
        let mut long = VisibleSamples::default();
        march::cpu::march(occupancy.bits(), &rays, &occupancy.march_config(4096), &mut Default::default(), &mut long.samples);
        let mut buf = FieldBuffers::default();
        placement::encode(&field, &batch, &mut long);
        tracer.composite(&field, &batch, &[], &mut long, &mut buf);
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
        let pruning = Pruning { stop: 1e-4, min_alpha: 0.0, thin: f32::INFINITY, min_weight: 0.0 };
        let placement = Placement::occupied(&occupancy, 1024, pruning);
        let mut tracer =
            Tracer { occupancy: Some(&occupancy), near: 0.1, shared_weight: 0.0, ..Tracer::new(&field, placement, (0.0, 1.0)) };
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
    fn colors_are_seen_along_a_given_direction_and_opacities_are_not() {
        let grid = HashGridConfig { levels: 2, features: 2, log2_size: 8, base: 4, finest: 8 };
        let mut field = fields::ngp(grid, Space::Cube(1.0), 1e-2, 0, 0, 1);
        field.net.density.shift = 3.0;
        let occupancy = Occupancy::new(16, 1, false);
        let pose = Pose::look_at(DVec3::new(1.9, 1.2, 1.0), DVec3::splat(0.5), DVec3::Z);
        let camera = PosedCamera { camera: Camera::pinhole(3, 3, 0.1), pose };
        let pruning = Pruning { stop: 1e-4, min_alpha: 0.0, thin: f32::INFINITY, min_weight: 0.0 };
        let placement = Placement::occupied(&occupancy, 1024, pruning);
        let mut tracer =
            Tracer { occupancy: Some(&occupancy), near: 0.1, shared_weight: 0.0, ..Tracer::new(&field, placement, (0.0, 1.0)) };
        let own = tracer.view(&camera, &mut |_| {});
        // The middle pixel's own direction changes nothing there; another one changes its color.
        let along = (pose.rotation * DVec3::Z).to_array().map(|v| v as f32);
        tracer.seen_along = Some(along);
        let same = tracer.view(&camera, &mut |_| {});
        tracer.seen_along = Some(along.map(|v| -v));
        let other = tracer.view(&camera, &mut |_| {});
        let off = |v: &View| (12..15).map(|k| (v.rgb.data[k] - own.rgb.data[k]).abs()).fold(0.0, f32::max);
        assert!(off(&same) < 1e-5 && off(&other) > 1e-4, "{} {}", off(&same), off(&other));
        assert!(own.opacity.data.iter().zip(&other.opacity.data).all(|(a, b)| (a - b).abs() < 1e-6));
    }

    #[test]
    fn linear_light_is_seen_along_the_srgb_curve() {
        let grid = HashGridConfig { levels: 2, features: 2, log2_size: 8, base: 4, finest: 8 };
        let field = fields::ngp(grid, Space::Cube(1.0), 1e-2, 0, 0, 1);
        let pose = Pose::look_at(DVec3::new(0.5, -1.5, 0.5), DVec3::new(0.5, -9.0, 0.5), DVec3::Z);
        let camera = PosedCamera { camera: Camera::pinhole(2, 2, 0.8), pose };
        let tracer = Tracer {
            backdrop: Backdrop::Color([0.214_041, 1.0, 7.0]),
            near: 0.1,
            is_linear: true,
            ..Tracer::new(&field, Placement::Stratified { samples: 2, noise: None }, (0.0, 1.0))
        };
        let v = tracer.view(&camera, &mut |_| {});
        let want = [0.5, 1.0, srgb_from_linear(7.0)];
        assert!((0..3).all(|k| (v.rgb.data[k] - want[k]).abs() < 1e-3), "{:?}", &v.rgb.data[..3]);
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
                occupancy: Some(&occupancy),
                backdrop: Backdrop::Color([0.2, 0.5, 0.9]),
                near: 0.1,
                shared_weight: quality.shared_weight(),
                tolerance: quality.tolerance(),
                ..Tracer::new(&field, Placement::occupied(&occupancy, 1024, quality.pruning()), (0.0, 1.0))
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
