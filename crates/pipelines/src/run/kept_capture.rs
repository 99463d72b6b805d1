//! The capture of a run as `capture.json` keeps it, so that runs and photographs may move.
//!
//! Paths are relative to the data set's folder, which is kept both as it was and as seen from the run.

use crate::error::Result;
use diorama_data::{DataError, atomic, error, import};
use diorama_geom::Capture;
use diorama_geom::capture::Frame;
use serde::{Deserialize, Serialize};
use std::path::{Component, Path, PathBuf};

/// File of the capture.
pub const NAME: &str = "capture.json";
const LIMIT: u64 = 1 << 30;

/// Contents of the file. Files of earlier versions have no folders; their paths are relative to the folder that the
/// program was called in.
#[derive(Serialize, Deserialize)]
struct KeptCapture {
    /// Folder of the data set, absolute.
    #[serde(default)]
    data: Option<PathBuf>,
    /// The same as seen from the run's folder.
    #[serde(default)]
    data_from_run: Option<PathBuf>,
    #[serde(flatten)]
    capture: Capture,
}

/// Writes the capture, which was read from `data`, into a run's folder.
///
/// # Errors
/// When the file cannot be written.
pub fn write(run: &Path, data: &Path, capture: &Capture) -> Result<()> {
    let (root, run_at) = (absolute(&import::root(data)?), absolute(run));
    let mut capture = capture.clone();
    each_path(&mut capture, |p| {
        let full = absolute(p);
        *p = full.strip_prefix(&root).map(Path::to_path_buf).unwrap_or(full);
    });
    let kept = KeptCapture { data_from_run: relative(&root, &run_at), data: Some(root), capture };
    Ok(atomic::write(&run.join(NAME), &serde_json::to_vec(&kept).expect("a capture is JSON"))?)
}

/// Reads the capture of a run; `data` is where its photographs are now, else they are where they were, or where they
/// lay as seen from the run.
///
/// # Errors
/// When the file is damaged, or `data` lacks a photograph that the run has.
pub fn read(run: &Path, data: Option<&Path>, trained_on: &Path) -> Result<Capture> {
    let mut kept = open(run)?;
    if kept.data.is_none() && data.is_some() {
        // Of an earlier version: the folder is the beginning of its paths.
        let before = import::root(trained_on).unwrap_or_else(|_| trained_on.to_path_buf());
        each_path(&mut kept.capture, |p| *p = p.strip_prefix(&before).map(Path::to_path_buf).unwrap_or(p.clone()));
    }
    let root = match data {
        Some(moved) => import::root(moved)?,
        None => root(run, &kept),
    };
    each_path(&mut kept.capture, |p| *p = root.join(&*p));
    if let Some(moved) = data
        && let Some(lost) = kept.capture.frames.iter().map(|f| &f.image).find(|i| !i.is_file())
    {
        let name = lost.strip_prefix(&root).unwrap_or(lost).display();
        return Err(DataError::input(moved, format!("--data: holds no {name}, which {} was trained on", run.display())).into());
    }
    Ok(kept.capture)
}

/// The data set that a run was trained on: `trained_on` where that is still there, else its folder as seen from the run.
///
/// # Errors
/// When the run's capture is damaged.
pub fn data_set(run: &Path, trained_on: &Path) -> Result<PathBuf> {
    let kept = open(run)?;
    Ok(if trained_on.exists() || kept.data.is_none() { trained_on.to_path_buf() } else { root(run, &kept) })
}

fn open(run: &Path) -> Result<KeptCapture> {
    let file = run.join(NAME);
    let bytes = error::read(&file, LIMIT)?;
    Ok(serde_json::from_slice(&bytes).map_err(|e| DataError::input(&file, format!("is damaged: {e}; train again")))?)
}

/// Whether photographs have the same names and poses: else the points are of another world.
fn has_same_views(a: &Capture, b: &Capture) -> bool {
    let close = 1e-5 * b.scene.half;
    let is_same = |(a, b): (&Frame, &Frame)| {
        let (p, q) = (&a.world_from_camera, &b.world_from_camera);
        a.name == b.name && (p.translation - q.translation).length() <= close && p.rotation.abs_diff_eq(q.rotation, 1e-5)
    };
    a.frames.len() == b.frames.len() && a.frames.iter().zip(&b.frames).all(is_same)
}

/// Gives a kept capture the sparse points of its data set as it is read now, which a run has not kept; a note says so where they cannot be had.
pub fn add_points(kept: &mut Capture, fresh: Result<Capture>) {
    match fresh {
        Ok(fresh) if has_same_views(&fresh, kept) => kept.points = fresh.points,
        Ok(_) => kept.notes.push("the capture has changed since the run began: its sparse points are not used".into()),
        Err(e) => kept.notes.push(format!("the capture's sparse points cannot be read again: {e}")),
    }
}

/// The folder in which the first photograph lies: where it was, else where it lay as seen from the run.
fn root(run: &Path, kept: &KeptCapture) -> PathBuf {
    let first = kept.capture.frames.first().map(|f| f.image.clone()).unwrap_or_default();
    let from_run = kept.data_from_run.as_ref().map(|d| run.join(d));
    let places: Vec<PathBuf> = kept.data.iter().cloned().chain(from_run).collect();
    let found = places.iter().find(|p| p.join(&first).exists()).or(places.first());
    found.cloned().unwrap_or_default()
}

/// # Errors
/// When a photograph or mask of a capture is not there.
pub fn require_photographs(capture: &Capture) -> Result<()> {
    let files = capture.frames.iter().flat_map(|f| [Some(&f.image), f.mask.as_ref()]).flatten();
    match files.into_iter().find(|f| !f.is_file()) {
        Some(lost) => Err(DataError::input(lost, "does not exist; if the photographs moved, give their folder as --data FOLDER").into()),
        None => Ok(()),
    }
}

fn each_path(capture: &mut Capture, mut change: impl FnMut(&mut PathBuf)) {
    for f in &mut capture.frames {
        change(&mut f.image);
        [&mut f.mask, &mut f.depth, &mut f.labels].into_iter().flatten().for_each(&mut change);
    }
}

/// A path that does not depend on the folder that the program was called in; links on the way are kept.
pub fn absolute(path: &Path) -> PathBuf {
    std::path::absolute(path).unwrap_or_else(|_| path.to_path_buf())
}

/// An absolute path as seen from another; none on another drive, or where a folder above leads elsewhere.
fn relative(to: &Path, from: &Path) -> Option<PathBuf> {
    let (to, from): (Vec<Component>, Vec<Component>) = (to.components().collect(), from.components().collect());
    let same = to.iter().zip(&from).take_while(|(a, b)| a == b).count();
    if same == 0 || to.iter().chain(&from).any(|c| matches!(c, Component::ParentDir)) {
        return None;
    }
    let up = std::iter::repeat_n(Component::ParentDir, from.len() - same);
    Some(up.chain(to[same..].iter().copied()).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_data::import::ImportOptions;
    use diorama_data::{photo, transforms_json};
    use diorama_scenes::still_life;

    /// Four photographs of the still life with their poses.
    fn write_capture(data: &Path) {
        std::fs::create_dir_all(data.join("images")).unwrap();
        let frame = |p: still_life::Photo| {
            let image = data.join(format!("images/{}.png", p.name));
            photo::save_png(&image, &p.image).unwrap();
            Frame::new(p.name, image, p.camera, p.world_from_camera)
        };
        let capture = Capture::new(still_life::photographs(4, 16).into_iter().map(frame).collect(), still_life::scene_box());
        transforms_json::write(&data.join("transforms.json"), data, &capture, None).unwrap();
    }

    /// A data set and a run beside each other.
    fn pair(dir: &Path) -> (PathBuf, PathBuf) {
        let (data, run) = (dir.join("data/chair"), dir.join("runs/chair"));
        write_capture(&data);
        std::fs::create_dir_all(&run).unwrap();
        write(&run, &data, &import::import(&data, &ImportOptions::default()).unwrap()).unwrap();
        (data, run)
    }

    #[test]
    fn photographs_are_found_where_they_were_beside_a_moved_run_and_where_one_says() {
        let dir = tempfile::tempdir().unwrap();
        let (data, run) = pair(dir.path());
        let found = |run: &Path, moved: Option<&Path>| {
            let c = read(run, moved, &data)?;
            require_photographs(&c).map(|()| c.frames[1].image.clone())
        };
        assert_eq!(found(&run, None).unwrap(), data.join("images/view_01.png"));
        // The run alone.
        let elsewhere = dir.path().join("elsewhere");
        std::fs::rename(&run, &elsewhere).unwrap();
        assert_eq!(found(&elsewhere, None).unwrap(), data.join("images/view_01.png"));
        std::fs::rename(&elsewhere, &run).unwrap();
        // Both together.
        let all = dir.path().join("all");
        std::fs::create_dir(&all).unwrap();
        for part in ["data", "runs"] {
            std::fs::rename(dir.path().join(part), all.join(part)).unwrap();
        }
        let run = all.join("runs/chair");
        assert!(found(&run, None).unwrap().is_file());
        assert_eq!(data_set(&run, &data).unwrap().canonicalize().unwrap(), all.join("data/chair").canonicalize().unwrap());
        // The photographs alone.
        let far = dir.path().join("far");
        std::fs::rename(all.join("data/chair"), &far).unwrap();
        let lost = found(&run, None).unwrap_err().to_string();
        assert!(lost.contains("view_00.png") && lost.contains("--data"), "{lost}");
        assert_eq!(found(&run, Some(&far)).unwrap(), far.join("images/view_01.png"));
        assert_eq!(found(&run, Some(&far.join("transforms.json"))).unwrap(), far.join("images/view_01.png"));
        std::fs::remove_file(far.join("images/view_02.png")).unwrap();
        let wrong = found(&run, Some(&far)).unwrap_err().to_string();
        assert!(wrong.contains("far") && wrong.contains("view_02.png"), "{wrong}");
    }

    #[test]
    fn captures_of_earlier_versions_are_read() {
        let dir = tempfile::tempdir().unwrap();
        let (data, run) = pair(dir.path());
        let capture = import::import(&data, &ImportOptions::default()).unwrap();
        std::fs::write(run.join(NAME), serde_json::to_vec(&capture).unwrap()).unwrap();
        assert_eq!(read(&run, None, &data).unwrap(), capture);
        let far = dir.path().join("far");
        std::fs::rename(&data, &far).unwrap();
        assert_eq!(read(&run, Some(&far), &data).unwrap().frames[1].image, far.join("images/view_01.png"));
    }

    #[test]
    fn relative_paths_lead_back() {
        let path = |to: &str, from: &str| relative(Path::new(to), Path::new(from)).map(|p| p.to_string_lossy().replace('\\', "/"));
        assert_eq!(path("/a/data", "/a/runs/x").as_deref(), Some("../../data"));
        assert_eq!(path("/a/runs/x/capture", "/a/runs/x").as_deref(), Some("capture"));
        assert_eq!(path("/a/../b", "/a/runs"), None);
    }
}
