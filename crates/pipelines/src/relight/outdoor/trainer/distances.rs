//! Distances that are taken as observed in the surfaces' stage: of sparse points, of planes through what is learned by then, and of what
//! comparing photographs tells.

use super::super::normal_maps::NormalMaps;
use super::Trainer;
use diorama_engine::fields::FieldBuffers;
use diorama_engine::renderers::volume::{Quality, Tracer};
use diorama_engine::samplers::RayBatch;
use diorama_engine::samplers::pixels::{self, Observation, PixelSource};
use diorama_engine::train::Event;

/// Times that surfaces are flattened in their stage, and pixels that then tell distances.
const FLATTENED: u64 = 3;
const FLAT_PIXELS: usize = 100_000;
/// Error of a color over the median from which a pixel shows something else than the surface that is found there.
const EXPLAINED: f32 = 2.5;

/// Pixels whose distance is known before anything is learned.
pub(in super::super) struct Given {
    pub pixels: Vec<Observation>,
    /// Whether they show points that many photographs agree on; else photographs were compared.
    pub are_sparse_points: bool,
}

impl Trainer<'_> {
    /// Flattens what is nearly flat if that is due: from then on, distances to planes through the surfaces are observed, and those that
    /// comparing photographs tells; not where a photograph shows another color than the surface found there: something thin stands before it,
    /// which would never be learned. For the same reason, neither is observed before surfaces are flattened first.
    pub(super) fn flatten(&mut self, share: f32, events: &mut dyn FnMut(&Event)) {
        let due = (share * (FLATTENED + 1) as f32) as u64;
        if due.min(FLATTENED) <= self.model.flattened || self.model.config.loss.depth == 0.0 {
            return;
        }
        self.model.flattened = due;
        events(&Event::Preparing { what: "flattening surfaces", share: due as f64 / FLATTENED as f64 });
        let mut all = NormalMaps::of_some(&self.model, &self.cameras, due as usize).observations(FLAT_PIXELS);
        if !self.given.are_sparse_points {
            all.extend(&self.given.pixels);
        }
        all.retain(|o| self.is_stored(o));
        let errors = self.errors(&all);
        let explained = explained(&all, &errors);
        self.model.flat = explained.iter().flat_map(|o| [o.image as f32, o.x as f32, o.y as f32, o.distance]).collect();
        self.observe();
    }

    /// Greatest difference, over the channels, between what is learned and the photographs at each of these pixels.
    fn errors(&self, pixels: &[Observation]) -> Vec<f32> {
        let (m, mut errors) = (&self.model, vec![0.0; pixels.len()]);
        let mut order: Vec<usize> = (0..pixels.len()).collect();
        order.sort_by_key(|i| pixels[*i].image);
        let (mut batch, mut buffers) = (RayBatch::default(), FieldBuffers::default());
        for of_image in order.chunk_by(|a, b| pixels[*a].image == pixels[*b].image) {
            let image = pixels[of_image[0]].image;
            batch.resize(of_image.len());
            for (r, i) in of_image.iter().enumerate() {
                (batch.images[r], batch.jitter[r]) = (image, 0.5);
                batch.pixels[2 * r..2 * r + 2].copy_from_slice(&[pixels[*i].x, pixels[*i].y].map(|v| v as f32 + 0.5));
            }
            pixels::rays(&self.cameras, m.config.sampling.near, m.cube(), &mut batch);
            let tracer = Tracer { appearance: Some(image), ..m.tracer(Quality::Full) };
            let traced = tracer.trace_layers(&mut batch, &[], &mut buffers);
            for (color, i) in traced.rgb.chunks_exact(3).zip(of_image) {
                let shown = self.photographs.rgba(image as usize, pixels[*i].x, pixels[*i].y);
                errors[*i] = color.iter().zip(shown).map(|(c, s)| (c - s).abs()).fold(0.0, f32::max);
            }
        }
        errors
    }

    /// Observes sparse points and the model's distances.
    pub(super) fn observe(&mut self) {
        let mut all = observed(&self.given, &self.model.flat, self.model.config.sampling.near);
        all.retain(|o| self.is_stored(o));
        self.observations = all;
    }

    /// Whether memory holds the pixel itself, and not another one in its place.
    fn is_stored(&self, o: &Observation) -> bool {
        self.photographs.snap(o.image as usize, o.x, o.y) == (o.x, o.y)
    }
}

/// What is observed: the model's `flat` distances `[N, 4]` beyond `near`, and from the first step on sparse points, without which few photographs
/// do not find the surfaces.
fn observed(given: &Given, flat: &[f32], near: f32) -> Vec<Observation> {
    let sparse: &[Observation] = if given.are_sparse_points { &given.pixels } else { &[] };
    let known = flat.chunks_exact(4).filter(|f| f[3] > near);
    let flat = known.map(|f| Observation { image: f[0] as u32, x: f[1] as u32, y: f[2] as u32, distance: f[3] });
    sparse.iter().copied().chain(flat).collect()
}

/// Pixels whose error is not far above the median.
fn explained(pixels: &[Observation], errors: &[f32]) -> Vec<Observation> {
    let mut sorted = errors.to_vec();
    sorted.sort_by(f32::total_cmp);
    let most = sorted.get(errors.len() / 2).map_or(0.0, |median| EXPLAINED * median);
    pixels.iter().zip(errors).filter(|(_, e)| **e <= most).map(|(o, _)| *o).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sparse_points_are_observed_from_the_first_step_and_compared_photographs_are_not() {
        let pixels = vec![Observation { image: 1, x: 2, y: 3, distance: 4.0 }];
        let distances = |are_sparse_points: bool, flat: &[f32]| -> Vec<f32> {
            let given = Given { pixels: pixels.clone(), are_sparse_points };
            observed(&given, flat, 0.5).iter().map(|o| o.distance).collect()
        };
        let flat = [0.0, 1.0, 2.0, 3.0, 0.0, 1.0, 3.0, 0.4];
        assert_eq!(distances(true, &[]), [4.0]);
        assert_eq!(distances(false, &[]), [0.0; 0]);
        assert_eq!(distances(true, &flat), [4.0, 3.0]);
        assert_eq!(distances(false, &flat), [3.0], "what stands nearer than rays begin is not observed");
    }

    #[test]
    fn pixels_of_another_color_than_the_surface_tell_no_distance() {
        let pixels: Vec<Observation> = (0..7).map(|x| Observation { image: 0, x, y: 0, distance: 1.0 }).collect();
        let kept = explained(&pixels, &[0.02, 0.04, 0.3, 0.01, 0.04, 0.09, 0.11]);
        assert_eq!(kept.iter().map(|o| o.x).collect::<Vec<_>>(), [0, 1, 3, 4, 5]);
        assert_eq!(explained(&pixels, &[0.0; 7]).len(), 7, "what is learned exactly");
        assert!(explained(&[], &[]).is_empty());
    }
}
