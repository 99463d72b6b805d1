//! What a data set is to hold: `scenes.toml`, options, and the samples of a shard.

use super::super::fnv;
use super::super::styling::MaskMode;
use super::sampling::Sampling;
use crate::error::{PipelineError, Result};
use crate::run::folder;
use diorama_data::text_set::SetFormat;
use diorama_data::{DataError, error};
use serde::{Deserialize, Serialize};
use std::ops::Range;
use std::path::{Path, PathBuf};

const LIMIT: u64 = 1 << 20;

/// Scenes of a data set: `[[scene]]` tables of a TOML file, or one run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Scenes {
    #[serde(rename = "scene")]
    pub scenes: Vec<SceneEntry>,
}

/// A scene.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SceneEntry {
    /// Folder of a run, relative to the file.
    pub run: PathBuf,
    /// Name in the data set; none: that of the run's folder.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// Whether images show the writing as it was filmed when there are edits, too.
    #[serde(default)]
    pub original: bool,
}

impl SceneEntry {
    pub fn name(&self) -> String {
        let folder = || self.run.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_else(|| "scene".into());
        self.name.clone().unwrap_or_else(folder)
    }
}

impl Scenes {
    /// Reads `scenes.toml`, or takes a run as the only scene.
    ///
    /// # Errors
    /// When the file is missing or malformed, lists no scene, or two of one name.
    pub fn read(path: &Path) -> Result<Scenes> {
        if path.is_dir() {
            return Ok(Scenes { scenes: vec![SceneEntry { run: path.to_path_buf(), name: None, original: false }] });
        }
        let bytes = error::read(path, LIMIT)?;
        let wrong = |e: String| DataError::input(path, format!("{e}; expected tables such as [[scene]] with run = \"runs/room\""));
        let text = std::str::from_utf8(&bytes).map_err(|e| wrong(e.to_string()))?;
        let mut out: Scenes = toml::from_str(text).map_err(|e| wrong(e.message().to_string()))?;
        let folder = path.parent().unwrap_or(Path::new("."));
        out.scenes.iter_mut().for_each(|s| s.run = folder.join(&s.run));
        let mut names: Vec<String> = out.scenes.iter().map(SceneEntry::name).collect();
        names.sort();
        if let Some(pair) = names.windows(2).find(|p| p[0] == p[1]) {
            return Err(wrong(format!("two scenes are named {:?}; give one a name = of its own", pair[0])).into());
        }
        if out.scenes.is_empty() {
            return Err(wrong("lists no scene".into()).into());
        }
        Ok(out)
    }
}

/// A data set. Its images are the same however it is divided into shards.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SynthOptions {
    pub count: usize,
    pub size: (u32, u32),
    pub sampling: Sampling,
    pub clusters: usize,
    /// Clusters that are drawn; empty: all.
    pub only: Vec<usize>,
    /// A prior's file; none: the default.
    pub prior: Option<PathBuf>,
    pub formats: Vec<SetFormat>,
    pub seed: u64,
    /// Looks of which each image takes one, as [`Style::read`](super::super::styling::Style::read) takes them; empty: as the scenes are.
    pub styles: Vec<String>,
    /// What keeps its detail under a style.
    pub mask: MaskMode,
}

impl SynthOptions {
    /// # Errors
    /// With what cannot be, and what can.
    pub fn check(&self) -> Result<()> {
        let fault = |text: &str| Err(PipelineError::Usage(text.into()));
        if self.count == 0 || self.count > 99_999_999 {
            return fault("--count: expected 1 to 99999999");
        }
        if !(1..=256).contains(&self.clusters) {
            return fault("--clusters: expected a number from 1 to 256");
        }
        if let Some(c) = self.only.iter().find(|c| **c >= self.clusters) {
            return fault(&format!("--only {c}: there is no such cluster; they are 0 to {}", self.clusters - 1));
        }
        if self.sampling == Sampling::Random && !self.only.is_empty() {
            return fault("--only, or a list of --clusters: goes with --sampling balanced alone");
        }
        Ok(())
    }
}

/// A part of a data set, from 1 on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Shard {
    pub part: usize,
    pub of: usize,
}

impl Shard {
    pub const WHOLE: Shard = Shard { part: 1, of: 1 };

    /// `PART/OF`.
    ///
    /// # Errors
    /// When it is none.
    pub fn parse(text: &str) -> Result<Shard> {
        let parts = text.split_once('/').and_then(|(a, b)| Some((a.parse().ok()?, b.parse().ok()?)));
        match parts {
            Some((part, of)) if (1..=of).contains(&part) => Ok(Shard { part, of }),
            _ => Err(PipelineError::Usage(format!("--shard {text:?}: expected PART/OF, such as 3/8"))),
        }
    }

    /// Its samples of a data set of `count`.
    pub fn samples(&self, count: usize) -> Range<usize> {
        let at = |part: usize| (part as u128 * count as u128 / self.of as u128) as usize;
        at(self.part - 1)..at(self.part)
    }
}

/// The scene of a sample of a data set, and its number in the scene: scenes follow each other, with equal numbers of samples.
pub fn place(sample: usize, count: usize, scenes: usize) -> (usize, usize) {
    let first = |scene: usize| scene * count / scenes;
    let scene = (sample * scenes / count).min(scenes - 1);
    let scene = if sample >= first(scene + 1) { scene + 1 } else { scene };
    let scene = if sample < first(scene) { scene - 1 } else { scene };
    (scene, sample - first(scene))
}

/// What identifies the state of a run that images depend on: a hash of its checkpoint's, regions' and edits' bytes.
///
/// # Errors
/// When a file cannot be read.
pub fn fingerprint(run: &Path) -> Result<String> {
    let (_, checkpoint, _) = folder::last_checkpoint(run)?;
    let mut files = vec![checkpoint, run.join(super::super::placed::REGIONS)];
    files.extend(super::super::edit::Edit::files(run)?);
    let mut hash = fnv::hash([]);
    for file in files {
        hash = fnv::with(hash, error::read(&file, u64::MAX)?);
    }
    Ok(format!("{hash:016x}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shards_and_scenes_share_all_samples() {
        for (count, of) in [(10, 3), (1, 8), (1000, 7), (12_520, 8)] {
            let all: Vec<usize> = (1..=of).flat_map(|part| Shard { part, of }.samples(count)).collect();
            assert!(all.into_iter().eq(0..count));
        }
        for (count, scenes) in [(10, 3), (5, 5), (2, 5), (100, 7)] {
            let places: Vec<(usize, usize)> = (0..count).map(|s| place(s, count, scenes)).collect();
            let mut counts = vec![0; scenes];
            for (scene, index) in &places {
                assert_eq!(*index, counts[*scene], "numbers of a scene follow each other: {places:?}");
                counts[*scene] += 1;
            }
            assert!(places.is_sorted() && counts.iter().max().unwrap() - counts.iter().min().unwrap() <= 1);
        }
        assert_eq!(Shard::parse("3/8").unwrap(), Shard { part: 3, of: 8 });
        assert!(["0/3", "4/3", "x", "1/0"].iter().all(|s| Shard::parse(s).unwrap_err().to_string().contains("expected PART/OF")));
    }

    #[test]
    fn scene_lists_are_read_and_wrong_ones_named() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("scenes.toml");
        std::fs::write(&file, "[[scene]]\nrun = \"a/room\"\n[[scene]]\nrun = \"b/room\"\nname = \"second\"\n").unwrap();
        let scenes = Scenes::read(&file).unwrap();
        assert_eq!(scenes.scenes[0].run, folder.path().join("a/room"));
        assert_eq!(scenes.scenes.iter().map(SceneEntry::name).collect::<Vec<_>>(), ["room", "second"]);
        for (text, expected) in [
            ("[[scene]]\nrun = \"a/room\"\n[[scene]]\nrun = \"b/room\"\n", "two scenes are named \"room\""),
            ("scene = []\n", "lists no scene"),
            ("[[scene]]\nrum = \"a\"\n", "unknown field `rum`"),
        ] {
            std::fs::write(&file, text).unwrap();
            let e = Scenes::read(&file).unwrap_err();
            assert!(e.is_input() && e.to_string().contains(expected), "{e}");
        }
    }
}
