//! The density at which a run's surface lies: of five candidates, that whose mesh has the depth that the field renders.

use super::super::outdoor::surface_field::SurfaceField;
use diorama_geom::capture::Frame;
use diorama_geom::glam::DVec3;
use diorama_geom::{Camera, Image, Mesh};
use diorama_mesh::bake::DepthMap;
use diorama_mesh::extract::{Grid, Method};
use diorama_mesh::sparse_grid::{self, SparseGrid};
use serde::Serialize;

/// Candidates, as multiples of the density that an even slab would have.
const FACTORS: [f32; 5] = [0.25, 1.0, 4.0, 16.0, 64.0];
/// Cells along the longest side of the grid on which candidates are compared.
const RESOLUTION: usize = 160;
/// Cameras that compare, and pixels along the longer side of their views.
const CAMERAS: usize = 12;
const VIEW_PX: u32 = 96;
/// Relative error of a pixel at most, and of one where only the mesh or only the field has a surface.
const WORST: f64 = 0.2;

/// A density and the mean relative error of the depth of its mesh.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Candidate {
    pub level: f32,
    pub depth_error: f64,
}

/// Depth that a camera renders.
pub(super) struct DepthView {
    pub frame: Frame,
    pub camera: Camera,
    /// In units of the world.
    pub depth: Image,
    pub opacity: Image,
}

impl DepthView {
    /// Mean error of a mesh's depth, of pixels whose surface lies in the grid's box; with the number of these pixels.
    fn error(&self, mesh: &Mesh, grid: &Grid) -> (f64, usize) {
        let map = DepthMap::new(mesh, self.camera, &self.frame.world_from_camera);
        let (mut sum, mut n) = (0.0, 0);
        for (i, (got, want)) in map.depth().iter().zip(&self.depth.data).enumerate() {
            let is_opaque = self.opacity.data[i] > 0.5;
            if is_opaque && !inside(self.point(i, *want as f64), grid) {
                continue;
            }
            n += 1;
            sum += match (is_opaque, got.is_finite()) {
                (true, true) => ((got - want).abs() as f64 / (*want as f64).max(1e-9)).min(WORST),
                (false, false) => 0.0,
                _ => WORST,
            };
        }
        (sum, n)
    }

    /// Point of the world that a pixel shows at a distance.
    pub fn point(&self, i: usize, distance: f64) -> DVec3 {
        let w = self.camera.width as usize;
        self.frame.world_from_camera.point(self.camera.direction((i % w) as f64 + 0.5, (i / w) as f64 + 0.5) * distance)
    }
}

fn inside(p: DVec3, grid: &Grid) -> bool {
    let p = p.as_vec3().to_array();
    (0..3).all(|k| (grid.min[k]..=grid.max[k]).contains(&p[k]))
}

/// Depth in small views of at most `cameras` frames, spread over all.
pub(super) fn depth_views(field: &SurfaceField, frames: &[&Frame], cameras: usize, longest: u32) -> Vec<DepthView> {
    let n = frames.len().min(cameras);
    let of = |i: usize| {
        let frame = frames[i * frames.len() / n];
        let (layers, camera) = field.depth_view(frame, longest);
        DepthView { frame: frame.clone(), camera, depth: layers.depth, opacity: layers.opacity }
    };
    (0..n).map(of).collect()
}

/// The density at which a slab of 1/128 of the longest side transmits half the light, but at most half of what the densest of fifty points
/// has.
fn base(coarse: &SparseGrid) -> f32 {
    let grid = coarse.grid();
    let half_slab = std::f32::consts::LN_2 / (grid.cell() * grid.resolution as f32 / 128.0);
    half_slab.min(0.5 * coarse.quantile(0.98)).max(1e-6)
}

/// The candidates for a box.
pub(super) fn candidates(field: &SurfaceField, grid: &Grid, frames: &[&Frame]) -> Vec<Candidate> {
    let coarse = Grid { resolution: grid.resolution.min(RESOLUTION), ..*grid };
    let blocks = sparse_grid::candidates(&coarse, &|lo, hi| field.may_hold(lo, hi));
    let sampled = SparseGrid::sample(field, &coarse, &blocks, &mut |_, _| true);
    let (views, base) = (depth_views(field, frames, CAMERAS, VIEW_PX), base(&sampled));
    let of = |factor: &f32| {
        let level = base * factor;
        let mesh = sampled.surface(level, Method::Cubes, true);
        let (sum, n) = views.iter().map(|v| v.error(&mesh, grid)).fold((0.0, 0), |(s, n), (ds, dn)| (s + ds, n + dn));
        Candidate { level, depth_error: sum / n.max(1) as f64 }
    };
    FACTORS.iter().map(of).collect()
}

/// The candidate with the least error.
pub(super) fn best(candidates: &[Candidate]) -> Option<f32> {
    candidates.iter().min_by(|a, b| a.depth_error.total_cmp(&b.depth_error)).map(|c| c.level)
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_geom::Pose;

    /// A square of edge 2 at height `z` of many small faces, whose depth is exact.
    fn square(z: f32) -> Mesh {
        let n = 32;
        let at = |i: u32| [2.0 * (i % (n + 1)) as f32 / n as f32 - 1.0, 2.0 * (i / (n + 1)) as f32 / n as f32 - 1.0, z];
        let corners = (0..n * n).map(|i| i / n * (n + 1) + i % n);
        let faces = corners.flat_map(|i| [[i, i + 1, i + n + 2], [i, i + n + 2, i + n + 1]]).collect();
        Mesh { positions: (0..(n + 1) * (n + 1)).map(at).collect(), faces, ..Mesh::default() }
    }

    /// Seen from above by a camera at height 3 that rendered a plane at height 0.
    #[test]
    fn the_error_is_that_of_the_depth_and_of_what_is_missing() {
        let camera = Camera::pinhole(20, 20, 0.4);
        let pose = Pose::look_at(DVec3::new(0.0, 0.0, 3.0), DVec3::ZERO, DVec3::Y);
        let depth: Vec<f32> = (0..400)
            .map(|i| {
                let d = camera.direction((i % 20) as f64 + 0.5, (i / 20) as f64 + 0.5);
                (3.0 / d.z) as f32
            })
            .collect();
        let view = DepthView {
            frame: Frame::new("a", "", camera, pose),
            camera,
            depth: Image { width: 20, height: 20, channels: 1, data: depth },
            opacity: Image { width: 20, height: 20, channels: 1, data: vec![1.0; 400] },
        };
        let grid = Grid { min: [-1.0; 3], max: [1.0; 3], resolution: 8 };
        let error = |mesh: &Mesh| {
            let (sum, n) = view.error(mesh, &grid);
            assert_eq!(n, 400);
            sum / n as f64
        };
        assert!(error(&square(0.0)) < 1e-3, "{}", error(&square(0.0)));
        assert!((error(&square(0.3)) - 0.1).abs() < 5e-3, "{}", error(&square(0.3)));
        assert!((error(&Mesh::default()) - WORST).abs() < 1e-12);
        let all = [(1.0, 0.3), (2.0, 0.1), (4.0, 0.2)].map(|(level, depth_error)| Candidate { level, depth_error });
        assert_eq!(best(&all), Some(2.0));
    }
}
