//! Scores of a detector on a data set.

use super::config::Config;
use super::det_eval;
use super::evaluation::{self, Evaluation, JudgedImage, Score};
use super::network::Detector;
use super::samples;
use crate::error::{PipelineError, Result};
use crate::text::pose_clusters;
use diorama_data::photo;
use diorama_data::text_set::{ANNOTATIONS, detector_set::DetectorImage};
use diorama_geom::glam::{DQuat, DVec2, dvec2};
use serde::Serialize;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

/// Clusters of poses where the data set names none.
const CLUSTERS: usize = 16;

/// A detector's scores and its speed.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Judged {
    #[serde(flatten)]
    pub evaluation: Evaluation,
    /// Over all instances, where labels may be split and joined.
    pub det_eval: Score,
    /// Images per second of detection, decoding of files included.
    pub images_per_s: f64,
}

/// Scores a detector; `look` sees how many images are done. None after an interrupt.
///
/// # Errors
/// When an image cannot be read.
pub fn judge(
    detector: &Detector,
    config: &Config,
    set: &[DetectorImage],
    interrupt: &AtomicBool,
    look: &mut dyn FnMut(usize),
) -> Result<Option<Judged>> {
    let begin = Instant::now();
    let mut images = Vec::with_capacity(set.len());
    for (i, image) in set.iter().enumerate() {
        if interrupt.load(Ordering::Relaxed) {
            return Ok(None);
        }
        look(i);
        let full = photo::size(&image.path)?;
        let small = photo::load_small(&image.path, config.data.most_px)?;
        let scale = dvec2(full.0 as f64 / small.width as f64, full.1 as f64 / small.height as f64);
        let found = detector.detect(&small, &config.decode)?;
        let detections = found.iter().map(|d| d.corners.map(|c| c * scale).to_vec()).collect();
        images.push(JudgedImage { scene: image.scene.clone(), labels: samples::labels(image, DVec2::ONE), detections });
    }
    let images_per_s = set.len() as f64 / begin.elapsed().as_secs_f64().max(1e-9);
    Ok(Some(Judged { evaluation: evaluation::evaluate(&images), det_eval: det_eval::evaluate(&images), images_per_s }))
}

/// Gives labels the clusters of their poses where the data set tells poses but no clusters.
///
/// # Errors
/// When it tells neither.
pub fn find_clusters(set: &mut [DetectorImage], folder: &Path, seed: u64) -> Result<()> {
    let mut labels: Vec<_> = set.iter_mut().flat_map(|i| &mut i.labels).filter(|l| !l.region.ignore).collect();
    if labels.iter().any(|l| l.cluster.is_some()) {
        return Ok(());
    }
    labels.retain(|l| l.quaternion.is_some());
    if labels.is_empty() {
        let file = folder.join(ANNOTATIONS);
        return Err(PipelineError::Usage(format!("--by-pose: {} tells no poses of the words; leave --by-pose out", file.display())));
    }
    let rotation = |[w, x, y, z]: [f64; 4]| DQuat::from_xyzw(x, y, z, w).normalize();
    let rotations: Vec<DQuat> = labels.iter().filter_map(|l| l.quaternion).map(rotation).collect();
    let found = pose_clusters::clusters(&rotations, CLUSTERS, seed);
    labels.iter_mut().zip(found.of).for_each(|(l, c)| l.cluster = Some(c));
    Ok(())
}
