//! Drawing of training pixels, optionally more often where the error is high.

use super::RayBatch;
use diorama_geom::rng::Rng;
use diorama_kernels::ops::pixel_gather::OBSERVED_EVERY;
use diorama_kernels::ops::ray_generation::PosedCamera;
use diorama_kernels::ops::{ray_aabb, ray_generation};
use rayon::prelude::*;

/// Access to training pixels, wherever they lie.
pub trait PixelSource: Sync {
    fn images(&self) -> usize;
    fn size(&self, image: usize) -> (u32, u32);
    /// The pixel to take in place of one that is not at hand: one close by, and always the same.
    fn snap(&self, _image: usize, x: u32, y: u32) -> (u32, u32) {
        (x, y)
    }
    /// Edge of the squares of which one pixel is at hand.
    fn stride(&self) -> u32 {
        1
    }
    /// Straight RGBA in the photographs' own space: sRGB, or linear light, which may exceed 1.
    fn rgba(&self, image: usize, x: u32, y: u32) -> [f32; 4];
    /// Whether the pixel may be trained on.
    fn counts(&self, image: usize, x: u32, y: u32) -> bool;
}

/// Cells per side of the error map of one image.
const CELLS: usize = 16;
/// Share of rays that are drawn uniformly whatever the error map says.
const UNIFORM_SHARE: f32 = 0.5;

/// Mean error of the parts of the training images, for drawing (instant-ngp, error-driven sampling).
#[derive(Clone, Debug)]
pub struct ErrorMap {
    /// `[images, CELLS, CELLS]`
    pub errors: Vec<f32>,
    /// The errors that draws go by: a copy as of the last refresh.
    pub drawn: Vec<f32>,
    cdf: Vec<f32>,
}

impl ErrorMap {
    pub fn new(images: usize) -> Self {
        let errors = vec![1.0; images * CELLS * CELLS];
        let mut map = ErrorMap { drawn: errors.clone(), errors, cdf: Vec::new() };
        map.rebuild();
        map
    }

    /// Mixes a ray's squared error into its cell.
    pub fn record(&mut self, image: usize, u: f32, v: f32, error: f32) {
        let cell = |t: f32| ((t * CELLS as f32) as usize).min(CELLS - 1);
        let e = &mut self.errors[(image * CELLS + cell(v)) * CELLS + cell(u)];
        *e = 0.9 * *e + 0.1 * error;
    }

    /// Brings the distribution up to date.
    pub fn refresh(&mut self) {
        self.drawn.copy_from_slice(&self.errors);
        self.rebuild();
    }

    /// Recomputes the distribution from `drawn`.
    pub fn rebuild(&mut self) {
        let mut sum = 0.0f64;
        self.cdf.clear();
        for e in &self.drawn {
            sum += (*e as f64).sqrt();
            self.cdf.push(sum as f32);
        }
    }

    fn draw(&self, x: f32) -> usize {
        let total = self.cdf.last().copied().unwrap_or(0.0);
        self.cdf.partition_point(|c| *c < x * total).min(self.errors.len() - 1)
    }
}

/// A pixel in which a point at a known distance is seen.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Observation {
    pub image: u32,
    pub x: u32,
    pub y: u32,
    /// From the camera, in model space.
    pub distance: f32,
}

/// Cameras, random numbers and optional guidance of [`draw`].
pub struct DrawOptions<'a> {
    pub cameras: &'a [PosedCamera],
    /// Counter of the first ray: the number of rays drawn so far.
    pub first: u64,
    pub rng: Rng,
    pub near: f32,
    /// The scene's outer cube in model space: lowest corner and edge.
    pub cube: (f32, f32),
    pub error_map: Option<&'a ErrorMap>,
    /// Pixels of known distance.
    pub observations: &'a [Observation],
}

/// Fills `batch` (already resized) with random training rays.
///
/// Errors weigh the draw but not the loss: the objective shifts towards hard pixels, as in instant-ngp.
pub fn draw(source: &dyn PixelSource, o: &DrawOptions, batch: &mut RayBatch) {
    let images = source.images() as u64;
    let picked = batch.images.par_iter_mut().zip(batch.pixels.par_chunks_mut(2)).zip(batch.target.par_chunks_mut(4)).zip(&mut batch.jitter);
    let known = batch.distance.par_iter_mut().zip(&mut batch.counts);
    picked.zip(known).enumerate().with_min_len(256).for_each(|(i, ((((image, pixel), target), jitter), (distance, counts)))| {
        // Sixteen numbers per ray: the draw may be repeated where a mask refuses the pixel.
        let base = (o.first + i as u64) * 16;
        *jitter = o.rng.uniform(base);
        for attempt in 0..5u64 {
            let at = base + 1 + attempt * 3;
            let seen = !o.observations.is_empty() && (i as u32).is_multiple_of(OBSERVED_EVERY) && attempt == 0;
            let seen = seen.then(|| o.observations[o.rng.below(at, o.observations.len() as u64) as usize]);
            *distance = seen.map_or(0.0, |s| s.distance);
            let (img, u, v) = match o.error_map {
                Some(map) if i as f32 % 1024.0 / 1024.0 >= UNIFORM_SHARE => {
                    let cell = map.draw(o.rng.uniform(at));
                    let within = |c: usize, r: f32| (c as f32 + r) / CELLS as f32;
                    let (cx, cy) = (cell % CELLS, cell / CELLS % CELLS);
                    ((cell / CELLS / CELLS) as u64, within(cx, o.rng.uniform(at + 1)), within(cy, o.rng.uniform(at + 2)))
                }
                _ => (o.rng.below(at, images), o.rng.uniform(at + 1), o.rng.uniform(at + 2)),
            };
            let (w, h) = source.size(img as usize);
            let (x, y) = (((u * w as f32) as u32).min(w - 1), ((v * h as f32) as u32).min(h - 1));
            let (img, x, y) = seen.map_or((img, x, y), |s| (s.image as u64, s.x, s.y));
            let (x, y) = source.snap(img as usize, x, y);
            *image = img as u32;
            pixel.copy_from_slice(&[x as f32 + 0.5, y as f32 + 0.5]);
            target.copy_from_slice(&source.rgba(img as usize, x, y));
            // Masked five times over, a ray is left out.
            *counts = source.counts(img as usize, x, y);
            if *counts {
                return;
            }
        }
    });
    rays(o.cameras, o.near, o.cube, batch);
}

/// Origins, directions and extents for the images and pixels in `batch`.
pub fn rays(cameras: &[PosedCamera], near: f32, cube: (f32, f32), batch: &mut RayBatch) {
    ray_generation::cpu::forward(cameras, &batch.images, &batch.pixels, &mut batch.origins, &mut batch.dirs);
    let (low, size) = cube;
    ray_aabb::cpu::intersect(&batch.origins, &batch.dirs, [low; 3], [low + size; 3], near, &mut batch.near_far);
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_geom::glam::DVec3;
    use diorama_geom::{Camera, Pose};

    struct Half;
    impl PixelSource for Half {
        fn images(&self) -> usize {
            2
        }
        fn size(&self, _: usize) -> (u32, u32) {
            (8, 4)
        }
        fn rgba(&self, image: usize, x: u32, y: u32) -> [f32; 4] {
            [x, y, image as u32, 255].map(|v| v as f32 / 255.0)
        }
        fn counts(&self, _: usize, x: u32, _: u32) -> bool {
            x >= 4
        }
    }

    fn draw_with(map: Option<&ErrorMap>) -> RayBatch {
        draw_through(map, &[])
    }

    fn draw_through(error_map: Option<&ErrorMap>, observations: &[Observation]) -> RayBatch {
        let camera =
            PosedCamera { camera: Camera::pinhole(8, 4, 1.0), pose: Pose::look_at(DVec3::new(2.0, 0.5, 0.5), DVec3::splat(0.5), DVec3::Z) };
        let mut batch = RayBatch::default();
        batch.resize(4096);
        let o =
            DrawOptions { cameras: &[camera, camera], first: 0, rng: Rng::new(1, 1), near: 0.1, cube: (0.0, 1.0), error_map, observations };
        draw(&Half, &o, &mut batch);
        batch
    }

    #[test]
    fn one_ray_in_eight_goes_through_a_pixel_of_known_distance_unless_it_is_masked() {
        let seen = [(0, 5, 1, 2.5), (1, 6, 3, 3.5), (0, 1, 0, 9.0)].map(|(image, x, y, distance)| Observation { image, x, y, distance });
        let b = draw_through(None, &seen);
        let mut of = [0; 3];
        for (r, d) in b.distance.iter().enumerate() {
            let Some(k) = seen.iter().position(|s| s.distance == *d) else {
                assert_eq!(*d, 0.0);
                continue;
            };
            assert!((r as u32).is_multiple_of(OBSERVED_EVERY), "ray {r}");
            assert_eq!(
                (b.images[r], b.pixels[2 * r], b.pixels[2 * r + 1]),
                (seen[k].image, seen[k].x as f32 + 0.5, seen[k].y as f32 + 0.5)
            );
            of[k] += 1;
        }
        assert!(of[0] > 120 && of[1] > 120 && of[2] == 0, "{of:?} of 512; the third is masked");
        assert!(draw_with(None).distance.iter().all(|d| *d == 0.0), "without observations no distance is known");
    }

    #[test]
    fn masked_pixels_are_not_trained_on_and_targets_match_their_pixel() {
        let b = draw_with(None);
        let mut refused = 0;
        for ((p, t), counts) in b.pixels.chunks_exact(2).zip(b.target.chunks_exact(4)).zip(&b.counts) {
            if !counts {
                refused += 1;
                continue;
            }
            assert!(p[0] >= 4.0);
            assert!((t[0] * 255.0 - (p[0] - 0.5)).abs() < 1e-3 && (t[1] * 255.0 - (p[1] - 0.5)).abs() < 1e-3);
        }
        assert!(refused < 400, "{refused} of 4096");
    }

    #[test]
    fn the_error_map_draws_where_the_error_is() {
        let mut map = ErrorMap::new(2);
        map.errors.fill(1e-6);
        for _ in 0..100 {
            map.record(1, 0.9, 0.9, 1.0);
        }
        map.refresh();
        let share =
            |b: &RayBatch| b.images.iter().zip(b.pixels.chunks_exact(2)).filter(|(i, p)| **i == 1 && p[0] > 6.0 && p[1] > 3.0).count();
        assert!(share(&draw_with(Some(&map))) > 3 * share(&draw_with(None)));
    }
}
