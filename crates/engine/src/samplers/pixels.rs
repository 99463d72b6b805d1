//! Rays through random training pixels.

use super::RayBatch;
use diorama_geom::rng::Rng;
use diorama_kernels::ops::pixel_draw::{Draw, cpu};
use diorama_kernels::ops::ray_generation::PosedCamera;
use diorama_kernels::ops::{ray_aabb, ray_generation};

pub use diorama_kernels::ops::error_map::ErrorMap;
pub use diorama_kernels::ops::pixel_draw::{OBSERVED_EVERY, Observation, PixelSource};

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
pub fn draw(source: &dyn PixelSource, o: &DrawOptions, batch: &mut RayBatch) {
    let draw = Draw { rng: o.rng, first: o.first, error_map: o.error_map, observations: o.observations };
    let out = cpu::Drawn {
        images: &mut batch.images,
        pixels: &mut batch.pixels,
        target: &mut batch.target,
        jitter: &mut batch.jitter,
        distance: &mut batch.distance,
        counts: &mut batch.counts,
    };
    cpu::draw(source, &draw, out);
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
