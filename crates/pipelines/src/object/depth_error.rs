//! Distance between the surfaces of held-out views and the sparse points that the views show. Scores of pixels do not tell it: a wall of
//! one color looks the same at any depth.

use super::fog::median;
use super::model::ObjectModel;
use super::scored_view::{ScoredView, admits};
use crate::run::sparse_points::LARGEST_ERROR;
use diorama_geom::capture::SparsePoint;
use rayon::prelude::*;
use serde::Serialize;

/// Fewest photographs that show a point, and fewest points that are asked in all views together.
const FEWEST_PHOTOGRAPHS: usize = 3;
const FEWEST_POINTS: usize = 50;
/// A surface this much nearer or farther than its point, as a share of the point's distance, is elsewhere.
const ELSEWHERE: f64 = 0.1;
/// Share of points elsewhere from which on the geometry is said to be wrong.
const WRONG: f64 = 0.3;

/// What is wrong where so many points are elsewhere, and what helps.
const MEANS: &str = "the surfaces are not where the sparse points are, whatever the pictures look like; more training, or \
                     more photographs between these help; loss.depth=0 leaves the points out (docs/troubleshooting.md)";

impl std::fmt::Display for DepthError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let (n, elsewhere) = (self.points, 100.0 * self.elsewhere);
        match self.median {
            m if m.is_finite() => write!(f, "depth: {:.1} % off (median of {n} sparse points)", 100.0 * m)?,
            _ => write!(f, "depth: most of {n} sparse points have no surface")?,
        }
        write!(f, ", {elsewhere:.0} % of them more than 10 % off")
    }
}

/// Distances of surfaces against those of sparse points.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct DepthError {
    /// Points that held-out views show, each counted once per view.
    pub points: usize,
    /// Median of |surface − point| / point, in distances from the camera.
    pub median: f64,
    /// Share of the points whose surface is more than a tenth of their distance away from them.
    pub elsewhere: f64,
}

impl DepthError {
    /// Of relative errors, infinite where rays end nowhere; none where there are too few.
    pub fn of(errors: Vec<f64>) -> Option<DepthError> {
        let points = errors.len();
        let off = errors.iter().filter(|e| **e > ELSEWHERE).count();
        let median = median(errors)?;
        (points >= FEWEST_POINTS).then(|| DepthError { points, median, elsewhere: off as f64 / points as f64 })
    }

    /// What many points elsewhere mean.
    pub fn advice(&self) -> Option<String> {
        (self.elsewhere > WRONG).then(|| format!("{:.0} % of the sparse points lie elsewhere: {MEANS}", 100.0 * self.elsewhere))
    }
}

/// Relative errors of the surfaces at the points that frame `frame` is said to show.
pub fn errors(model: &ObjectModel, frame: usize, scored: &ScoredView) -> Vec<f64> {
    let f = &model.capture.frames[frame];
    let (w, h) = (scored.view.rgb.width, scored.view.rgb.height);
    let (sx, sy) = (w as f64 / f.camera.width as f64, h as f64 / f.camera.height as f64);
    let unit = 1.0 / model.model_from_world.scale;
    let counts = admits(&scored.counts);
    let camera_from_world = f.world_from_camera.inverse();
    let is_shown = |p: &&SparsePoint| {
        p.frames.len() >= FEWEST_PHOTOGRAPHS && p.error <= LARGEST_ERROR && p.frames.binary_search(&(frame as u32)).is_ok()
    };
    let error = |p: &SparsePoint| {
        let q = camera_from_world.point(p.position);
        let px = f.camera.project(q)?;
        let (x, y) = (px.x * sx, px.y * sy);
        let is_inside = (0.0..w as f64).contains(&x) && (0.0..h as f64).contains(&y);
        let (x, y) = (x as usize, y as usize);
        (is_inside && counts(x, y)).then(|| match scored.view.opacity.data[y * w + x] {
            o if o > 0.5 => (scored.view.depth.data[y * w + x] as f64 * unit / q.length() - 1.0).abs(),
            _ => f64::INFINITY,
        })
    };
    model.capture.points.par_iter().filter(is_shown).filter_map(error).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn few_points_say_nothing_and_many_elsewhere_are_advice() {
        assert_eq!(DepthError::of(vec![0.01; 49]), None);
        let good = DepthError::of((0..100).map(|i| if i < 10 { 0.5 } else { 0.02 }).collect()).unwrap();
        assert_eq!((good.points, good.median, good.elsewhere), (100, 0.02, 0.1));
        assert_eq!(good.advice(), None);
        let wrong = DepthError::of((0..100).map(|i| if i < 40 { f64::INFINITY } else { 0.02 }).collect()).unwrap();
        assert!(wrong.advice().is_some_and(|a| a.starts_with("40 % of the sparse points")));
    }
}
