//! Views behind fog: matter close to their cameras that explains other cameras' photographs.
//!
//! A held-out view is behind fog where its PSNR lies 6 dB below the median training view; or 3 dB below it while, over
//! 30 % of its pixels, matter stands in less than half the distance at which training views have their surfaces there.

use super::extent;
use super::held_out::{FOG_DB, GAP_DB, spread};
use super::model::ObjectModel;
use diorama_engine::renderers::volume::Quality;
use diorama_geom::glam::DVec3;
use diorama_geom::{Camera, Pose, Reduction};

/// Most training views whose surfaces are asked, and pixels along the shorter side of the views that are compared.
const VIEWS: usize = 24;
const VIEW_PX: u32 = 24;
/// Matter in less than this share of the surfaces' distance is near.
const NEAR: f64 = 0.5;
/// Share of near pixels from which on a view that is [`GAP_DB`] worse is behind fog.
const NEAR_SHARE: f64 = 0.3;
/// Fewest pixels that are compared.
const FEWEST: usize = 30;
/// Of the distances of all surfaces in a pixel this quantile counts: what lies behind others is hidden.
const FRONT: f64 = 0.25;

/// Surfaces as training views see them, in the world.
pub struct Surfaces(Vec<DVec3>);

impl Surfaces {
    /// Of up to `VIEWS` training views, at `VIEW_PX`.
    pub fn of(model: &ObjectModel) -> Surfaces {
        let frames = spread(&model.train, VIEWS);
        let tracer = model.tracer(Quality::Fast);
        Surfaces(frames.into_iter().flat_map(|i| extent::surface_points(model, &tracer, &model.capture.frames[i], 2 * VIEW_PX)).collect())
    }

    /// Share of a frame's pixels whose matter stands near; none where too few can be compared.
    pub fn near_share(&self, model: &ObjectModel, frame: usize) -> Option<f64> {
        let f = &model.capture.frames[frame];
        let camera = f.camera.reduced(Reduction::ShortestSide(VIEW_PX));
        let view = model.tracer(Quality::Fast).view(&model.to_model(camera, &f.world_from_camera), &mut |_| {});
        let unit = 1.0 / model.model_from_world.scale;
        let met: Vec<Option<f64>> =
            view.depth.data.iter().zip(&view.opacity.data).map(|(d, o)| (*o > 0.5).then_some(*d as f64 * unit)).collect();
        near_share(&self.distances(&camera, &f.world_from_camera), &met)
    }

    /// Distance of the surfaces in each pixel of a camera.
    fn distances(&self, camera: &Camera, world_from_camera: &Pose) -> Vec<Option<f64>> {
        let (w, h) = (camera.width as usize, camera.height as usize);
        let mut in_pixel = vec![Vec::new(); w * h];
        let camera_from_world = world_from_camera.inverse();
        for p in &self.0 {
            let q = camera_from_world.point(*p);
            let Some(px) = camera.project(q) else { continue };
            if (0.0..w as f64).contains(&px.x) && (0.0..h as f64).contains(&px.y) {
                in_pixel[px.y as usize * w + px.x as usize].push(q.length());
            }
        }
        let front = |mut v: Vec<f64>| {
            v.sort_by(f64::total_cmp);
            v.get((v.len() as f64 * FRONT) as usize).copied()
        };
        in_pixel.into_iter().map(front).collect()
    }
}

fn near_share(surfaces: &[Option<f64>], met: &[Option<f64>]) -> Option<f64> {
    let both: Vec<(f64, f64)> = surfaces.iter().zip(met).filter_map(|(s, m)| s.zip(*m)).collect();
    let near = both.iter().filter(|(surface, met)| *met < NEAR * surface).count();
    (both.len() >= FEWEST).then(|| near as f64 / both.len() as f64)
}

/// Whether a held-out view is behind fog, by its PSNR, the median PSNR of training views, and the share of near pixels.
pub fn is_behind(psnr: f64, training: f64, near: Option<f64>) -> bool {
    psnr < training - FOG_DB || (psnr < training - GAP_DB && near.is_some_and(|n| n >= NEAR_SHARE))
}

/// Whether depth decides on such a view.
pub fn depends_on_depth(psnr: f64, training: f64) -> bool {
    is_behind(psnr, training, Some(1.0)) != is_behind(psnr, training, None)
}

/// The middle of some scores.
pub fn median(mut scores: Vec<f64>) -> Option<f64> {
    scores.sort_by(f64::total_cmp);
    scores.get(scores.len() / 2).copied()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_view_is_behind_fog_by_its_score_or_by_score_and_depth() {
        let cases = [
            (29.0, Some(0.9), false, "a good view may have matter before it"),
            (26.0, Some(0.1), false, "worse, but its matter stands where it should"),
            (26.0, None, false, "worse, and nothing can be compared"),
            (26.0, Some(0.4), true, "worse, with matter before its camera"),
            (23.0, Some(0.0), true, "far below all training views"),
        ];
        for (psnr, near, behind, why) in cases {
            assert_eq!(is_behind(psnr, 30.0, near), behind, "{why}");
            assert_eq!(depends_on_depth(psnr, 30.0), psnr == 26.0);
        }
    }

    #[test]
    fn matter_counts_as_near_in_less_than_half_the_distance_of_the_surfaces() {
        let surfaces = vec![Some(4.0); 40];
        let mut met = vec![Some(3.9); 40];
        assert_eq!(near_share(&surfaces, &met), Some(0.0));
        met[..10].fill(Some(1.5));
        met[10..20].fill(None);
        assert_eq!(near_share(&surfaces, &met), Some(10.0 / 30.0));
        assert_eq!(near_share(&surfaces[..20], &met[..20]), None, "too few");
    }

    #[test]
    fn surfaces_that_others_hide_do_not_count() {
        let camera = Camera::pinhole(24, 24, 0.8);
        let pose = Pose::look_at(DVec3::new(0.0, -4.0, 0.0), DVec3::ZERO, DVec3::Z);
        // A thing four away, seen by two of five, before a wall nine away.
        let points = [0.0, 0.0, 5.0, 5.0, 5.0].map(|y| DVec3::new(0.0, y, 0.0)).to_vec();
        let distances = Surfaces(points).distances(&camera, &pose);
        let seen: Vec<f64> = distances.into_iter().flatten().collect();
        assert!(seen.len() == 1 && (seen[0] - 4.0).abs() < 1e-9, "{seen:?}");
    }
}
