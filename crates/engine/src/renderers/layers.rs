//! Views of all that a field composites, for example albedo, shadow and normal.

use super::traced::Traced;
use super::volume::{Tracer, take_traced};
use crate::fields::{Batch, FieldBuffers};
use crate::samplers::{RayBatch, pixels};
use diorama_geom::Image;
use diorama_kernels::ops::composite::Packed;
use diorama_kernels::ops::ray_generation::PosedCamera;

/// Rays per call.
const CHUNK: usize = 1 << 12;

/// A rendered view with all channels of a field, before black.
#[derive(Clone, Debug)]
pub struct Layers {
    /// The network's outputs, then the normal `−Σ w ∇σ` (not of unit length) where the field has one, `[H, W, C]`.
    pub values: Image,
    /// `[H, W, 1]`
    pub opacity: Image,
    /// Expected distance along the ray in model units, 0 where nothing is hit, `[H, W, 1]`.
    pub depth: Image,
}

impl Tracer<'_> {
    /// Renders all layers of a camera's view on the CPU; `codes` are the vectors of [`crate::fields::RayCodes::given`], the same for all
    /// rays. `progress` receives the number of rows done since the last call. Backdrop and tolerance do not matter here.
    ///
    /// # Panics
    /// When the codes are not those that the field reads.
    pub fn layers(&self, camera: &PosedCamera, codes: &[&[f32]], progress: &mut dyn FnMut(usize)) -> Layers {
        let (w, h, c) = (camera.camera.width as usize, camera.camera.height as usize, self.field.channels());
        let mut out = Layers { values: Image::zeros(w, h, c), opacity: Image::zeros(w, h, 1), depth: Image::zeros(w, h, 1) };
        let (mut batch, mut buf) = (RayBatch::default(), FieldBuffers::default());
        for first in (0..w * h).step_by(CHUNK) {
            let last = (first + CHUNK).min(w * h);
            batch.resize(last - first);
            for (i, p) in (first..last).enumerate() {
                batch.pixels[i * 2..i * 2 + 2].copy_from_slice(&[(p % w) as f32 + 0.5, (p / w) as f32 + 0.5]);
                (batch.images[i], batch.jitter[i]) = (0, 0.5);
            }
            pixels::rays(std::slice::from_ref(camera), self.near, self.cube, &mut batch);
            let traced = self.trace_layers(&mut batch, codes, &mut buf);
            out.values.data[first * c..last * c].copy_from_slice(&traced.rgb);
            out.opacity.data[first..last].copy_from_slice(&traced.opacity);
            let depths = traced.depth.iter().zip(&traced.opacity).map(|(d, o)| if *o > 1e-3 { d / o } else { 0.0 });
            out.depth.data[first..last].iter_mut().zip(depths).for_each(|(to, d)| *to = d);
            progress(last / w - first / w);
        }
        out
    }

    /// [`Tracer::layers`] of the rays of a batch, whose origins, directions and extents are set: `[R, C]` in place of colors.
    ///
    /// # Panics
    /// When the codes are not those that the field reads.
    pub fn trace_layers(&self, batch: &mut RayBatch, codes: &[&[f32]], buf: &mut FieldBuffers) -> Traced {
        assert!(codes.iter().map(|c| c.len()).eq(self.field.codes.given.iter().copied()), "the field reads other codes");
        self.cut(batch);
        let n = batch.len();
        let given: Vec<Vec<f32>> = codes.iter().map(|c| c.repeat(n)).collect();
        let given: Vec<&[f32]> = given.iter().map(|c| &c[..]).collect();
        let mut on = self.place(batch, &given, buf);
        let (images, background) = (self.appearance.map(|i| vec![i; n]), vec![0.0; n * self.field.net.channels()]);
        let samples = Packed { offsets: &on.samples.offsets, t: &on.samples.t, dt: &on.samples.dt };
        let b = Batch {
            samples,
            positions: &on.positions,
            dirs: &batch.dirs,
            images: images.as_deref(),
            given: &given,
            background: &background,
            near_scaling: 0.0,
        };
        self.field.render(&b, &mut on.encoded, buf);
        self.restored(take_traced(buf), batch, buf)
    }
}
