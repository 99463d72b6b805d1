//! Folder of a study: what it is made of, and which of its stages are done.

use crate::error::{PipelineError, Result};
use crate::text::synth::dataset::differing;
use diorama_data::{DataError, atomic, error, lock};
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::Value;
use std::fs::File;
use std::path::{Path, PathBuf};

/// What a study is made of.
const OPTIONS: &str = "options.json";
/// Results of stages that are done, a file each.
const STAGES: &str = "stages";
const LIMIT: u64 = 1 << 26;

/// A folder that this process alone writes to.
pub struct StudyFolder {
    path: PathBuf,
    _lock: File,
}

impl StudyFolder {
    /// Begins a study, or goes on with one of the same options but for the keys of `free`; `force` replaces an earlier one.
    ///
    /// # Errors
    /// When the folder holds something else or a study of other options, whose keys are named, or another process works there.
    pub fn begin(path: &Path, options: &Value, free: &[&str], force: bool) -> Result<StudyFolder> {
        let file = path.join(OPTIONS);
        if !file.exists() && path.is_dir() && entries(path)?.iter().any(|e| !e.ends_with(lock::NAME)) {
            return Err(DataError::input(path, "is not empty and holds no study; give another --out").into());
        }
        std::fs::create_dir_all(path).map_err(DataError::io(path, "create"))?;
        let folder = StudyFolder { path: path.to_path_buf(), _lock: lock::take(path)? };
        if file.exists() && force {
            folder.clear()?;
        } else if file.exists() {
            let before: Value = read(&file)?;
            let other = differing("", &before, options).into_iter().filter(|key| !free.contains(&key.as_str()));
            let other: Vec<String> = other.collect();
            if !other.is_empty() {
                let (at, other) = (path.display(), other.join(", "));
                let what = format!("{at}: holds a study of other {other}; give --force to replace it, or another --out");
                return Err(PipelineError::Usage(what));
            }
        }
        let stages = path.join(STAGES);
        std::fs::create_dir_all(&stages).map_err(DataError::io(&stages, "create"))?;
        atomic::write(&file, &serde_json::to_vec_pretty(options).expect("plain values"))?;
        Ok(folder)
    }

    /// The folder.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Removes all but the lock.
    fn clear(&self) -> Result<()> {
        for entry in entries(&self.path)?.into_iter().filter(|e| !e.ends_with(lock::NAME)) {
            let removed = if entry.is_dir() { std::fs::remove_dir_all(&entry) } else { std::fs::remove_file(&entry) };
            removed.map_err(DataError::io(&entry, "remove"))?;
        }
        Ok(())
    }

    /// Does a stage, or returns what it told when it was done before; its work is done anew where `made`, a file or folder that it makes,
    /// is gone. None after an interrupt.
    ///
    /// # Errors
    /// When the work fails, or what is kept of it cannot be read or written.
    pub fn once<T: Serialize + DeserializeOwned>(
        &self,
        stage: &str,
        made: &Path,
        work: impl FnOnce() -> Result<Option<T>>,
    ) -> Result<Option<T>> {
        let file = self.path.join(STAGES).join(format!("{stage}.json"));
        if file.exists() && made.exists() {
            return Ok(Some(read(&file)?));
        }
        let Some(done) = work()? else { return Ok(None) };
        atomic::write(&file, &serde_json::to_vec_pretty(&done).expect("plain values"))?;
        Ok(Some(done))
    }
}

fn entries(folder: &Path) -> Result<Vec<PathBuf>> {
    let all = std::fs::read_dir(folder).map_err(DataError::io(folder, "list"))?;
    Ok(all.map(|e| e.map(|e| e.path())).collect::<std::io::Result<_>>().map_err(DataError::io(folder, "list"))?)
}

fn read<T: DeserializeOwned>(file: &Path) -> Result<T> {
    let bytes = error::read(file, LIMIT)?;
    Ok(serde_json::from_slice(&bytes).map_err(|e| DataError::input(file, format!("{e}; give --force to begin the study again")))?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn a_stage_is_done_once_unless_what_it_made_is_gone() {
        let dir = tempfile::tempdir().unwrap();
        let made = dir.path().join("made.txt");
        let mut times = 0;
        let mut again = |done: Option<usize>| {
            let folder = StudyFolder::begin(dir.path(), &json!({"scenes": 2}), &[], false).unwrap();
            let work = || {
                times += 1;
                std::fs::write(&made, "x").unwrap();
                Ok(done)
            };
            let told = folder.once("set-random", &made, work).unwrap();
            (told, times)
        };
        assert_eq!(again(None), (None, 1), "interrupted");
        assert_eq!(again(Some(3)), (Some(3), 2));
        assert_eq!(again(Some(4)), (Some(3), 2), "what it told the first time");
        std::fs::remove_file(&made).unwrap();
        assert_eq!(again(Some(5)), (Some(5), 3));
    }

    #[test]
    fn changed_options_are_named_and_free_ones_may_change() {
        let dir = tempfile::tempdir().unwrap();
        let begin = |options: Value, force| StudyFolder::begin(dir.path(), &options, &["seeds"], force).map(|_| ());
        begin(json!({"scenes": 2, "limit": {"steps": 5, "seconds": 0}, "seeds": 1}), false).unwrap();
        begin(json!({"scenes": 2, "limit": {"steps": 5, "seconds": 0}, "seeds": 3}), false).unwrap();
        let changed = json!({"scenes": 3, "limit": {"steps": 6, "seconds": 0}, "seeds": 3});
        let e = begin(changed.clone(), false).unwrap_err();
        let said = e.to_string();
        let expected = ["a study of other", "limit.steps", "scenes", "give --force"];
        assert!(
            e.is_input() && expected.iter().all(|t| said.contains(t)) && !said.contains("seeds") && !said.contains("seconds"),
            "{said}"
        );
        std::fs::write(dir.path().join("stages/old.json"), "1").unwrap();
        begin(changed, true).unwrap();
        assert!(!dir.path().join("stages/old.json").exists());
        let folder = StudyFolder::begin(dir.path(), &json!({}), &["scenes", "limit", "seeds"], false).unwrap();
        assert!(StudyFolder::begin(dir.path(), &json!({}), &[], false).err().unwrap().to_string().contains("in use"));
        drop(folder);
        let other = tempfile::tempdir().unwrap();
        std::fs::write(other.path().join("letter.txt"), "dear").unwrap();
        let e = StudyFolder::begin(other.path(), &json!({}), &[], true).err().unwrap();
        assert!(e.is_input() && e.to_string().contains("holds no study") && other.path().join("letter.txt").exists(), "{e}");
    }
}
