//! The occupancy grid of a field ([`occupancy_update`](diorama_kernels::ops::occupancy_update)): which cells cameras see, and how rays march
//! through it.

use crate::fields::DensityQuery;
use diorama_geom::Lens;
use diorama_geom::glam::DVec3;
use diorama_geom::rng::Rng;
use diorama_kernels::ops::march::{MarchConfig, OccupancyBits};
use diorama_kernels::ops::occupancy_update::{OccupancyGrid, UNSEEN};
use diorama_kernels::ops::ray_generation::PosedCamera;
use std::f64::consts::PI;

/// Length of a step over the distance from the camera (instant-ngp).
pub const CONE: f32 = 1.0 / 256.0;

/// Smallest step of marching: the diagonal of the model cube in 1024 steps.
pub const MIN_STEP: f32 = 1.732_050_8 / 1024.0;

/// Optical thickness of a smallest step above which a cell is occupied.
const THRESHOLD: f32 = 0.01;

/// Density above which a cell of the innermost cascade is occupied.
const OCCUPIED: f32 = THRESHOLD / MIN_STEP;

/// Longest step in unbounded space, in inner cubes.
const LONGEST_STEP: f32 = 1e6;

/// Distance from the camera, in inner cubes, beyond which unbounded space is sampled evenly in disparity.
const DISPARITY_FROM: f32 = 2.0;

/// Points per side of an image's rim at which its extent is measured.
const RIM: usize = 8;

/// Cells per axis of the blocks in which visibility is decided.
const SEEN_BLOCK: usize = 8;

/// Where a field's matter may be, within its space.
#[derive(Clone, Debug)]
pub struct Occupancy {
    /// Cells that no camera sees are never sampled and never occupied.
    pub grid: OccupancyGrid,
    /// Whether there is space beyond the outermost cascade.
    pub unbounded: bool,
    /// Length of a step over the distance from the camera, where there is more than one cascade.
    pub cone: f32,
}

impl Occupancy {
    pub fn new(resolution: usize, cascades: usize, unbounded: bool) -> Self {
        // Steps of a march grow with the cascades, so that thinner matter counts in the outer ones.
        let threshold = |cascade: usize| OCCUPIED / if unbounded { (1u32 << cascade) as f32 } else { 1.0 };
        Occupancy { grid: OccupancyGrid::new(resolution, (0..cascades).map(threshold).collect()), unbounded, cone: CONE }
    }

    /// What marching reads.
    pub fn bits(&self) -> &OccupancyBits {
        &self.grid.bits
    }

    /// Step lengths of marching through this grid; `max_samples` bounds the samples of a ray.
    pub fn march_config(&self, max_samples: usize) -> MarchConfig {
        let (cascades, resolution) = (self.grid.bits.cascades, self.grid.bits.resolution);
        let cone = if cascades > 1 { self.cone } else { 0.0 };
        let dt_max = MIN_STEP * 1024.0 / resolution as f32 * (1u32 << (cascades - 1)) as f32;
        if self.unbounded {
            let (disparity_from, dt_max) = (DISPARITY_FROM, LONGEST_STEP);
            return MarchConfig { cone, dt_min: MIN_STEP, dt_max, disparity_from, unbounded: true, max_samples };
        }
        MarchConfig { cone, dt_min: MIN_STEP, dt_max: dt_max.max(MIN_STEP), max_samples, ..MarchConfig::default() }
    }

    /// Rules out cells that fewer than `min_views` cameras see, and cells of a coarser cascade that a finer one covers.
    pub fn keep_visible(&mut self, cameras: &[PosedCamera], min_views: usize) {
        let n = self.grid.bits.resolution;
        let blocks = n / SEEN_BLOCK;
        let sights: Vec<Sight> = cameras.iter().map(Sight::new).collect();
        for c in 0..self.grid.bits.cascades {
            let (low, size) = OccupancyBits::cube(c);
            let edge = (size / blocks as f32) as f64;
            let radius = edge * 0.5 * 3f64.sqrt();
            for b in 0..blocks.pow(3) {
                let p = [b % blocks, b / blocks % blocks, b / blocks / blocks];
                let center = DVec3::from_array(p.map(|i| low as f64 + (i as f64 + 0.5) * edge));
                let covered = c > 0 && p.iter().all(|&i| i >= blocks / 4 && i < blocks - blocks / 4);
                let seen = sights.iter().filter(|s| s.sees(center, radius)).count();
                if covered || seen < min_views.min(cameras.len()) {
                    for k in 0..SEEN_BLOCK.pow(3) {
                        let q = [k % SEEN_BLOCK, k / SEEN_BLOCK % SEEN_BLOCK, k / SEEN_BLOCK / SEEN_BLOCK];
                        let at = [0, 1, 2].map(|a: usize| p[a] * SEEN_BLOCK + q[a]);
                        self.grid.density[((c * n + at[2]) * n + at[1]) * n + at[0]] = UNSEEN;
                    }
                }
            }
        }
        self.grid.refresh();
    }

    /// Samples the field at `count` random points of the cells that a camera sees, and updates the grid with their densities and those
    /// that were recorded. Blocks of `block³` cells share one point (1 once the field has settled).
    pub fn update(&mut self, field: &dyn DensityQuery, rng: &Rng, counter: u64, count: usize, block: usize) {
        if self.grid.live.is_empty() {
            return;
        }
        let (points, cells) = self.grid.probe(rng, counter, count, block);
        let mut sigma = vec![0.0; count];
        field.density(&points, &mut sigma);
        self.grid.update(&cells, &sigma, block);
    }
}

/// A camera, and how far from its axis its image reaches.
struct Sight<'a> {
    posed: &'a PosedCamera,
    /// Greatest angle between the axis and a ray of the image, radians.
    widest: f64,
}

impl<'a> Sight<'a> {
    fn new(posed: &'a PosedCamera) -> Self {
        let c = &posed.camera;
        let (w, h) = (c.width as f64, c.height as f64);
        let rim = (0..=RIM).flat_map(|i| {
            let (x, y) = (w * i as f64 / RIM as f64, h * i as f64 / RIM as f64);
            [(x, 0.0), (x, h), (0.0, y), (w, y)]
        });
        let widest = rim.map(|(x, y)| c.direction(x, y).angle_between(DVec3::Z)).fold(0.0, f64::max);
        Sight { posed, widest: if matches!(c.lens, Lens::Equirectangular) { PI } else { widest } }
    }

    /// Whether a ball may be seen: where its center projects (or, for one beyond the image's rim, its point nearest to the
    /// axis), widened by the ball's angular radius.
    fn sees(&self, center: DVec3, radius: f64) -> bool {
        let c = &self.posed.camera;
        let p = self.posed.pose.inverse().point(center);
        let distance = p.length();
        if distance <= radius || matches!(c.lens, Lens::Equirectangular) {
            return true;
        }
        let size = (radius / distance).asin();
        let nearest = (p.angle_between(DVec3::Z) - size).max(0.0);
        // Lens polynomials mean nothing beyond the image, so ask for its rim first.
        if nearest > 1.02 * self.widest {
            return false;
        }
        let across = DVec3::new(p.x, p.y, 0.0).normalize_or_zero();
        let angle = p.angle_between(DVec3::Z);
        let angle = if angle <= self.widest { angle } else { nearest };
        let Some(x) = c.project(across * angle.sin() + DVec3::Z * angle.cos()) else { return false };
        let (w, h) = (c.width as f64, c.height as f64);
        // A perspective image stretches towards its rim.
        let stretch = if matches!(c.lens, Lens::Fisheye { .. }) { 1.0 } else { angle.cos().max(0.05).powi(-2) };
        let margin = size * c.fx.max(c.fy) * stretch + 0.05 * w.max(h);
        x.x > -margin && x.x < w + margin && x.y > -margin && x.y < h + margin
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fields::{self, Field};
    use diorama_geom::contraction::Space;
    use diorama_geom::{Camera, Pose};
    use diorama_kernels::ops::hash_grid::HashGridConfig;

    fn field() -> Field {
        let grid = HashGridConfig { levels: 2, features: 2, log2_size: 8, base: 4, finest: 8 };
        fields::ngp(grid, Space::Cube(1.0), 1e-2, 0, 0, 1)
    }

    #[test]
    fn cells_that_the_field_leaves_empty_are_cleared() {
        let mut o = Occupancy::new(16, 1, false);
        let mut f = field();
        // A field of density e^-20 everywhere.
        f.net.density.shift = -20.0;
        for i in 0..60 {
            o.update(&f, &Rng::new(1, 1), i, 4096, 1);
        }
        assert!(o.grid.density.iter().all(|d| *d < 1.0));
        f.net.density.shift = 5.0;
        for i in 0..10 {
            o.update(&f, &Rng::new(1, 1), i, 4096, 1);
        }
        assert!(o.grid.bits.fill() > 0.4, "{}", o.grid.bits.fill());
    }

    #[test]
    fn what_no_camera_sees_is_never_occupied() {
        let mut o = Occupancy::new(32, 2, false);
        let pose = Pose::look_at(DVec3::new(0.5, -1.0, 0.5), DVec3::splat(0.5), DVec3::Z);
        o.keep_visible(&[PosedCamera { camera: Camera::pinhole(64, 64, 0.6), pose }], 1);
        let n = 32;
        let cell = |c: usize, x: usize, y: usize, z: usize| ((c * n + z) * n + y) * n + x;
        assert!(o.grid.bits.get(cell(0, 16, 16, 16)), "the middle is in view");
        assert!(!o.grid.bits.get(cell(1, 1, 1, 1)), "a corner beside the camera is not");
    }
    /// Whether the ball of this radius at `distance` and `degrees` from the axis of a camera at the origin is seen.
    fn seen(camera: Camera, degrees: f64, distance: f64, radius: f64) -> bool {
        let posed = PosedCamera { camera, pose: Pose::IDENTITY };
        let a = degrees.to_radians();
        Sight::new(&posed).sees(DVec3::new(a.sin(), 0.0, a.cos()) * distance, radius)
    }

    #[test]
    fn wide_lenses_see_what_lies_beside_and_behind_them() {
        let lens = Lens::Fisheye { k: [0.02, -0.005, 0.001, -0.0001], p: [0.0; 2], s: [0.0; 2] };
        let theta = 100f64.to_radians();
        let edge = lens.distort(diorama_geom::glam::DVec2::new(theta, 0.0)).x;
        let fisheye = Camera { fx: 500.0 / edge, fy: 500.0 / edge, lens, ..Camera::pinhole(1000, 1000, 1.0) };
        for degrees in [0.0, 60.0, 89.0, 95.0, 99.0] {
            assert!(seen(fisheye, degrees, 2.0, 0.01), "{degrees} degrees, of 200");
        }
        assert!(!seen(fisheye, 150.0, 2.0, 0.01) && !seen(fisheye, 180.0, 2.0, 0.01));
        let sphere = Camera { lens: Lens::Equirectangular, ..Camera::pinhole(200, 100, 1.0) };
        assert!((0..=180).step_by(10).all(|d| seen(sphere, d as f64, 2.0, 0.01)));
    }

    #[test]
    fn a_distorting_lens_is_judged_as_itself() {
        // Barrel distortion: the image of a half width of 0.5 reaches farther than a pinhole's 26.6 degrees.
        let lens = Lens::Brown { k: [-0.3, 0.0, 0.0, 0.0, 0.0, 0.0], p: [0.0; 2] };
        let barrel = Camera { width: 1000, height: 1000, fx: 1000.0, fy: 1000.0, cx: 500.0, cy: 500.0, lens };
        let widest = barrel.direction(1000.0, 500.0).angle_between(DVec3::Z).to_degrees();
        assert!(widest > 28.0 && seen(barrel, widest, 2.0, 1e-3));
        assert!(!seen(barrel, 60.0, 2.0, 1e-3) && !seen(barrel, 120.0, 2.0, 1e-3));
        assert!(seen(barrel, 60.0, 2.0, 1.5), "a ball that reaches into the picture");
    }
}
