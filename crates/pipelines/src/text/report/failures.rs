//! What a detector misses: its scores on a data set by scene and by pose, the weakest pose clusters, and the command that draws more of them.

use super::super::detectors::config::Config;
use super::super::detectors::evaluation::Evaluation;
use super::super::detectors::judge::{self, Judged};
use super::super::detectors::network::Detector;
use super::super::detectors::recipe;
use super::super::synth::dataset::MANIFEST;
use crate::error::Result;
use diorama_data::{DataError, error};
use serde::Deserialize;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

/// Most clusters that are named, and words from which on a cluster's score tells anything.
const WEAKEST: usize = 3;
const LEAST_WORDS: usize = 5;
const LIMIT: u64 = 1 << 26;

/// What of a data set's manifest a command repeats; the rest may be of any version.
#[derive(Deserialize)]
struct Made {
    options: MadeOptions,
    /// Names, and states of the runs.
    scenes: Vec<(String, String)>,
}

#[derive(Deserialize)]
struct MadeOptions {
    size: (u32, u32),
    clusters: usize,
    seed: u64,
    #[serde(default)]
    prior: Option<PathBuf>,
}

/// What a data set was made of; none where `text synth` did not write it.
fn made(set: &Path) -> Result<Option<Made>> {
    let path = set.join(MANIFEST);
    if !path.is_file() {
        return Ok(None);
    }
    let bytes = error::read(&path, LIMIT)?;
    Ok(Some(serde_json::from_slice(&bytes).map_err(|e| DataError::input(&path, format!("{e}; make the data set anew with --force")))?))
}

/// A detector's scores on a data set.
#[derive(Clone, Debug)]
pub struct Failures {
    pub detector: String,
    pub set: String,
    /// Whether the detector has learned from these very images.
    pub is_trained_on: bool,
    /// The data set that it has learned from, as its run names it; empty where that is not known.
    pub learned_from: String,
    pub judged: Judged,
    pub weakest: Vec<usize>,
    /// Draws images of the weakest clusters; none where the clusters are not those of `text synth`.
    pub command: Option<String>,
}

/// At most three clusters whose F is below that of all words together, the lowest first; clusters of fewer than five words are left out.
pub fn weakest(e: &Evaluation) -> Vec<usize> {
    let mut below: Vec<_> = e.clusters.iter().filter(|c| c.labels >= LEAST_WORDS && c.score.f < e.instance.f).collect();
    below.sort_by(|a, b| a.score.f.total_cmp(&b.score.f).then(a.cluster.cmp(&b.cluster)));
    below.iter().take(WEAKEST).map(|c| c.cluster).collect()
}

/// The command that draws images of clusters of the scenes of a data set, other ones than any set below `seed` has; none where the folder
/// was not written by `text synth`. A run of `runs` whose folder has the name of the only scene is named in place of the list of scenes.
///
/// # Errors
/// When the data set's manifest is malformed.
pub fn filling(set: &Path, clusters: &[usize], runs: &[PathBuf], seed: u64) -> Result<Option<String>> {
    let Some(made) = made(set)?.filter(|_| !clusters.is_empty()) else { return Ok(None) };
    let run = match &made.scenes[..] {
        [(name, _)] => runs.iter().find(|r| r.file_name().is_some_and(|f| f.to_string_lossy() == *name)),
        _ => None,
    };
    let scenes = run.map_or_else(|| "scenes.toml".into(), |r| quoted(r));
    let (o, numbers) = (&made.options, clusters.iter().map(usize::to_string).collect::<Vec<_>>().join(","));
    let prior = o.prior.as_ref().map_or(String::new(), |p| format!(" --prior {}", quoted(p)));
    let (w, h) = o.size;
    Ok(Some(format!(
        "diorama text synth {scenes} --clusters {} --only {numbers} --size {w}x{h}{prior} --seed {seed} -o data/weak",
        o.clusters
    )))
}

/// A path as a shell takes it.
fn quoted(path: &Path) -> String {
    let text = path.display().to_string();
    if text.contains(|c: char| c.is_whitespace() || "'\"$`\\&;()<>|*?".contains(c)) {
        format!("'{}'", text.replace('\'', "'\\''"))
    } else {
        text
    }
}

/// The seed after those of all data sets that `text synth` wrote.
///
/// # Errors
/// When a manifest is malformed.
pub fn unused_seed(sets: &[&Path]) -> Result<u64> {
    let mut most = 0;
    for set in sets {
        most = made(set)?.map_or(0, |m| m.options.seed).max(most);
    }
    Ok(most.saturating_add(1))
}

/// What is judged, and what it is called.
pub struct Judging<'a> {
    pub detector: (&'a Detector, &'a Config),
    pub name: &'a str,
    pub set: &'a Path,
    /// Field runs of the page.
    pub runs: &'a [PathBuf],
    /// Of images to be drawn.
    pub seed: u64,
}

impl Judging<'_> {
    /// Judges; none after an interrupt.
    ///
    /// # Errors
    /// When the data set has no labels in `icdar15/`, or an image cannot be read.
    pub fn judge(&self, stop: &AtomicBool, share: &mut dyn FnMut(f64)) -> Result<Option<Failures>> {
        let (detector, config) = self.detector;
        let mut images = recipe::labelled(self.set)?;
        let labels = || images.iter().flat_map(|i| &i.labels).filter(|l| !l.region.ignore);
        let are_told = labels().any(|l| l.cluster.is_some());
        if labels().any(|l| l.quaternion.is_some()) {
            judge::find_clusters(&mut images, self.set, 0)?;
        }
        let n = images.len() as f64;
        let judged = judge::judge(detector, config, &images, stop, &mut |i| share(i as f64 / n))?;
        judged.map(|j| self.failures(j, are_told)).transpose()
    }

    /// What scores say; `are_told` where the data set tells its clusters.
    ///
    /// # Errors
    /// When the data set's manifest is malformed.
    pub fn failures(&self, judged: Judged, are_told: bool) -> Result<Failures> {
        let weakest = weakest(&judged.evaluation);
        let command = if are_told { filling(self.set, &weakest, self.runs, self.seed)? } else { None };
        let place = |p: &Path| std::fs::canonicalize(p).ok();
        let is_trained_on = place(self.set).is_some_and(|s| place(&self.detector.1.data.path) == Some(s));
        let learned_from = self.detector.1.data.path.display().to_string();
        let set = self.set.display().to_string();
        Ok(Failures { detector: self.name.into(), set, is_trained_on, learned_from, judged, weakest, command })
    }
}
