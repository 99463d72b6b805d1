//! Shards of one data set joined to the whole.

use super::dataset::{self, Synthesized};
use super::journal::{self, Done};
use super::plan::Shard;
use crate::error::{PipelineError, Result};
use diorama_data::{DataError, atomic};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Joins shards, made anywhere, in a folder.
///
/// # Errors
/// When they are of different data sets, one is unfinished or missing, the folder is not empty, or a file cannot be read or written.
pub fn merge(out: &Path, shards: &[PathBuf]) -> Result<Synthesized> {
    let usage = |text: String| Err(PipelineError::Usage(text));
    if out.join(dataset::MANIFEST).exists() {
        return usage(format!("{}: holds a data set already; give another --out", out.display()));
    }
    let mut all: BTreeMap<usize, (Done, &PathBuf)> = BTreeMap::new();
    let mut first: Option<dataset::Manifest> = None;
    for folder in shards {
        let manifest = dataset::read_manifest(folder)?;
        let whole = dataset::Manifest { shard: Shard::WHOLE, ..manifest.clone() };
        if first.as_ref().is_some_and(|f| *f != whole) {
            return usage(format!("{}: is of another data set than {}", folder.display(), shards[0].display()));
        }
        first = Some(whole);
        let done = journal::read(folder)?;
        let wanted = manifest.shard.samples(manifest.options.count).len();
        if done.len() < wanted {
            let what = format!("has {} of its {wanted} images; finish it with `diorama text synth` first", done.len());
            return usage(format!("{}: {what}", folder.display()));
        }
        all.extend(done.into_iter().map(|(k, d)| (k, (d, folder))));
    }
    let Some(manifest) = first else { return usage("give the folders of shards".into()) };
    let count = manifest.options.count;
    if let Some(missing) = (0..count).find(|s| !all.contains_key(s)) {
        return usage(format!("sample {missing} of {count} is in none of the folders; add the shard that has it"));
    }
    for sub in ["images", "glyphs"] {
        let sub = out.join(sub);
        std::fs::create_dir_all(&sub).map_err(DataError::io(&sub, "create"))?;
    }
    for (done, folder) in all.values() {
        for file in [done.record.image.clone(), journal::glyphs(&done.record.image)] {
            let (from, to) = (folder.join(&file), out.join(&file));
            std::fs::copy(&from, &to).map_err(DataError::io(&from, "copy"))?;
        }
    }
    let done: BTreeMap<usize, Done> = all.into_iter().map(|(k, (d, _))| (k, d)).collect();
    let lines: String = done.values().map(|d| serde_json::to_string(d).expect("plain values") + "\n").collect();
    atomic::write(&out.join(journal::JOURNAL), lines.as_bytes())?;
    dataset::finish(out, &manifest.options, &done)?;
    atomic::write(&out.join(dataset::MANIFEST), &serde_json::to_vec_pretty(&manifest).expect("plain values"))?;
    let mut result = Synthesized::default();
    dataset::count(&mut result, &done, manifest.options.clusters);
    Ok(result)
}
