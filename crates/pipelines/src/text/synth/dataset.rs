//! Making of a data set: sample by sample into a journal, then annotations of all formats.
//!
//! Every sample depends on the data set's seed, its scene and its number in the scene alone. A journal keeps what is done, so that an
//! interrupted call goes on; images are verified by their hashes.

use super::super::styling::Style;
use super::journal::{self, Done, JOURNAL, Journal};
use super::maker::Maker;
use super::plan::{self, Scenes, Shard, SynthOptions};
use super::prior::Prior;
use crate::error::{PipelineError, Result};
use diorama_data::text_set::{self, SetImage};
use diorama_data::{DataError, atomic, error};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

/// What a folder's data set is made of.
pub const MANIFEST: &str = "synth.json";
const LIMIT: u64 = 1 << 26;

/// What a data set, or a shard of one, was made of.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    pub options: SynthOptions,
    /// Name of each scene, and the state of its run.
    pub scenes: Vec<(String, String)>,
    /// Hashes of the image files among the styles; empty for the others.
    pub styles: Vec<String>,
    pub shard: Shard,
}

/// What was made.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Synthesized {
    pub images: usize,
    pub words: usize,
    pub unreadable: usize,
    /// Labels of new words that were compared with their glyphs, those that are more than 2 pixels off, and the largest distance.
    pub compared: usize,
    pub misfits: usize,
    pub largest_misfit_px: f64,
    /// Images of each cluster of text poses.
    pub clusters: Vec<usize>,
    /// Images whose look was changed, and the share of the time of all images that this took.
    pub styled: usize,
    pub styling_share: f64,
    pub seconds: f64,
    pub images_per_s: f64,
    pub notes: Vec<String>,
    pub interrupted: bool,
}

/// Makes a shard of a data set in a folder, or goes on with it.
///
/// # Errors
/// When the folder holds something else and is not replaced by `force`, a style is unknown, a run cannot be read, a cluster that was asked for
/// has no valid camera, or a file cannot be written; the journal then keeps what is done.
pub fn synthesize(
    out: &Path,
    (scenes, options, shard): (&Scenes, &SynthOptions, Shard),
    force: bool,
    stop: &AtomicBool,
    progress: &mut dyn FnMut(f64, &str),
) -> Result<Synthesized> {
    options.check()?;
    let prior = options.prior.as_deref().map(Prior::read).transpose()?.unwrap_or_default();
    let states = scenes.scenes.iter().map(|s| Ok((s.name(), plan::fingerprint(&s.run)?))).collect::<Result<Vec<_>>>()?;
    let styles = Style::read_all(&options.styles, options.size.0.max(options.size.1) as usize)?;
    let hashes = styles.iter().map(|s| s.hash.clone()).collect();
    let manifest = Manifest { options: options.clone(), scenes: states, styles: hashes, shard };
    let mut done = begin(out, &manifest, force)?;
    let (mut result, start) = (Synthesized::default(), Instant::now());
    let before = done.len();
    let samples = shard.samples(options.count);
    let wanted: Vec<usize> = samples.clone().filter(|s| !done.contains_key(s)).collect();
    let mut styling = 0.0;
    if !wanted.is_empty() {
        let mut maker = Maker::new((scenes, options), prior, styles, progress)?;
        let mut kept = Journal::open(out, &done)?;
        let mut left = &wanted[..];
        while !left.is_empty() {
            if stop.load(Ordering::Relaxed) {
                result.interrupted = true;
                break;
            }
            progress((done.len()) as f64 / samples.len() as f64, "images");
            let drawn = maker.side_by_side(left, out, &mut result.notes)?;
            for made in drawn.done {
                kept.add(&made)?;
                done.insert(made.sample, made);
            }
            if let Some(failure) = drawn.failure {
                return Err(failure);
            }
            left = drawn.rest;
        }
        styling = maker.styling_share();
    }
    result.styling_share = styling;
    result.seconds = start.elapsed().as_secs_f64();
    result.images_per_s = (done.len() - before) as f64 / result.seconds.max(1e-9);
    if !result.interrupted {
        finish(out, &manifest.options, &done)?;
    }
    count(&mut result, &done, options.clusters);
    Ok(result)
}

/// Writes all annotations of the samples of a folder.
///
/// # Errors
/// When a file cannot be written.
pub fn finish(out: &Path, options: &SynthOptions, done: &BTreeMap<usize, Done>) -> Result<()> {
    let images: Vec<SetImage> = done.values().map(|d| d.record.clone()).collect();
    text_set::write(out, &images, &options.formats)?;
    // Written last: it says that the rest is there.
    Ok(text_set::save(out, &images)?)
}

/// Figures of samples.
pub fn count(result: &mut Synthesized, done: &BTreeMap<usize, Done>, clusters: usize) {
    result.images = done.len();
    result.clusters = vec![0; clusters];
    for d in done.values() {
        result.words += d.record.words.len();
        result.styled += d.record.style.is_some() as usize;
        result.unreadable += d.record.words.iter().filter(|w| w.ignore).count();
        if let Some(c) = result.clusters.get_mut(d.cluster) {
            *c += 1;
        }
        result.compared += d.compared;
        result.misfits += d.misfits;
        result.largest_misfit_px = result.largest_misfit_px.max(d.misfit_px);
    }
    while result.clusters.last() == Some(&0) {
        result.clusters.pop();
    }
}

/// Prepares a folder; returns what is done there.
fn begin(out: &Path, manifest: &Manifest, force: bool) -> Result<BTreeMap<usize, Done>> {
    let path = out.join(MANIFEST);
    let now = serde_json::to_value(manifest).expect("plain values");
    if path.exists() && force {
        let earlier: Vec<SetImage> = journal::lines(out)?.into_iter().map(|d| d.record).collect();
        text_set::remove(out, &earlier)?;
        for file in earlier.iter().map(|i| out.join(journal::glyphs(&i.image))).chain([out.join(JOURNAL)]).filter(|f| f.exists()) {
            std::fs::remove_file(&file).map_err(DataError::io(&file, "remove"))?;
        }
    } else if path.exists() {
        let before = serde_json::to_value(read_manifest(out)?).expect("plain values");
        let differing = differing("", &before, &now);
        if !differing.is_empty() {
            let (out, differing) = (out.display(), differing.join(", "));
            let what = format!("{out}: holds a data set of other {differing}; give --force to replace it, or another --out");
            return Err(PipelineError::Usage(what));
        }
    }
    for sub in ["images", "glyphs"] {
        let sub = out.join(sub);
        std::fs::create_dir_all(&sub).map_err(DataError::io(&sub, "create"))?;
    }
    atomic::write(&path, &serde_json::to_vec_pretty(&now).expect("plain values"))?;
    journal::read(out)
}

/// Keys whose values differ.
pub(in crate::text) fn differing(at: &str, a: &serde_json::Value, b: &serde_json::Value) -> Vec<String> {
    match (a.as_object(), b.as_object()) {
        (Some(a), Some(b)) => {
            let null = serde_json::Value::Null;
            b.iter()
                .flat_map(|(k, v)| differing(&format!("{at}{}{k}", if at.is_empty() { "" } else { "." }), a.get(k).unwrap_or(&null), v))
                .collect()
        }
        _ if a == b => Vec::new(),
        _ => vec![at.to_string()],
    }
}

/// # Errors
/// When the folder holds no data set.
pub fn read_manifest(folder: &Path) -> Result<Manifest> {
    let path = folder.join(MANIFEST);
    let bytes = error::read(&path, LIMIT)?;
    Ok(serde_json::from_slice(&bytes).map_err(|e| DataError::input(&path, format!("{e}; make the data set anew with --force")))?)
}
