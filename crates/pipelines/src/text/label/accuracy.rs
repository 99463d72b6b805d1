//! Labels of a generated scene against its truth.

use super::super::placed::{angle_between, from_rows};
use super::super::truth::{Shown, Truth, ViewTruth};
use super::in_view::READABLE;
use diorama_data::text_set::SetWord;
use diorama_geom::glam::DVec2;
use serde::Serialize;

/// Errors of labels, over regions of views that the truth says are readable.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Accuracy {
    /// Region views that the truth has, and that were labelled.
    pub regions: usize,
    pub labelled: usize,
    /// Median over region views of the mean distance of the four corners in pixels; none where none was labelled.
    pub corner_error_px: Option<f64>,
    /// Medians of the angle between poses in degrees, and of the distance of centers over that from the camera; none where labels have no
    /// poses.
    pub pose_error_deg: Option<f64>,
    pub center_error: Option<f64>,
    /// Mean absolute difference of visibilities, over all regions that either has.
    pub visibility_error: f64,
}

/// Collects errors view by view.
#[derive(Default)]
pub struct Collected {
    regions: usize,
    corners: Vec<f64>,
    angles: Vec<f64>,
    centers: Vec<f64>,
    visibilities: Vec<f64>,
}

impl Collected {
    /// Adds a view of the truth and its labels.
    pub fn add(&mut self, view: &ViewTruth, words: &[SetWord]) {
        for shown in &view.regions {
            let word = words.iter().find(|w| w.id as usize == shown.id);
            self.visibilities.push((word.map_or(0.0, |w| w.visibility) - shown.visibility).abs());
            if shown.visibility < READABLE {
                continue;
            }
            self.regions += 1;
            let Some(word) = word else { continue };
            self.corners.push(corner_error(shown, word));
            if let Some(pose) = &word.pose {
                let ((rotation, center), truth) = (from_rows(&pose.text_pose), shown.pose());
                self.angles.push(angle_between(&rotation, &truth.rotation).to_degrees());
                self.centers.push(center.distance(truth.translation) / truth.translation.length());
            }
        }
        let is_extra = |w: &&SetWord| view.regions.iter().all(|s| s.id != w.id as usize);
        self.visibilities.extend(words.iter().filter(is_extra).map(|w| w.visibility));
    }

    /// The figures; none without a view.
    pub fn accuracy(mut self) -> Option<Accuracy> {
        let n = self.visibilities.len();
        (n > 0).then(|| Accuracy {
            regions: self.regions,
            labelled: self.corners.len(),
            corner_error_px: median(&mut self.corners),
            pose_error_deg: median(&mut self.angles),
            center_error: median(&mut self.centers),
            visibility_error: self.visibilities.iter().sum::<f64>() / n as f64,
        })
    }
}

fn corner_error(shown: &Shown, word: &SetWord) -> f64 {
    (0..4).map(|k| DVec2::from(shown.quad[k]).distance(DVec2::from(word.quad[k]))).sum::<f64>() / 4.0
}

/// None of nothing.
fn median(values: &mut [f64]) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied()
}

/// The view of the truth of a frame's name.
pub fn view_of<'a>(truth: &'a Truth, name: &str) -> Option<&'a ViewTruth> {
    truth.views.iter().find(|v| v.name == name)
}
