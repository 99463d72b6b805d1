//! The folder of a run: `config.toml`, `capture.json`, `command.txt`, `metrics.jsonl`,
//! `events.tfevents`, `curves.svg` and `.png`, `summary.json`, `checkpoints/`.

use super::config::{self, Configuration};
use super::description::{self, RunDescription};
use super::kept_capture::{self, absolute};
use super::metrics::{self, Row};
use super::summary;
use crate::error::Result;
use diorama_data::checkpoint::{self, Checkpoint};
use diorama_data::plot;
use diorama_data::tfevents::TfEvents;
use diorama_data::{DataError, atomic, lock, photo};
use diorama_engine::train::Event;
use diorama_geom::Capture;
use serde::Serialize;
use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};

/// Folder of what a run keeps of another run that it began from.
pub const START: &str = "start";
/// Metrics for TensorBoard.
const EVENTS: &str = "events.tfevents";

/// An open, locked run folder.
pub struct RunFolder {
    path: PathBuf,
    metrics: Option<File>,
    tensorboard: Option<TfEvents>,
    _lock: File,
}

impl RunFolder {
    /// A folder for a new run. What an earlier run left there is replaced only with `force`, and only once the
    /// new run begins ([`RunFolder::write_description`]).
    ///
    /// # Errors
    /// When something else is there, or another process writes there.
    pub fn create(path: &Path, force: bool) -> Result<RunFolder> {
        if path.join(description::NAME).exists() && !force {
            return Err(
                DataError::input(path, "already holds a run; give --resume to go on, --force to replace it, or another --out").into()
            );
        }
        let occupied =
            path.is_dir() && !force && path.read_dir().map_err(DataError::io(path, "read"))?.flatten().any(|e| e.file_name() != lock::NAME);
        if occupied {
            return Err(DataError::input(path, "is not empty and holds no run; give --force or another --out").into());
        }
        if path.is_file() {
            return Err(DataError::input(path, "is a file; --out must name a folder").into());
        }
        std::fs::create_dir_all(path).map_err(DataError::io(path, "create"))?;
        Self::lock(path)
    }

    /// An existing run, with what it is.
    ///
    /// # Errors
    /// When there is no run, or another process writes there.
    pub fn open(path: &Path) -> Result<(RunFolder, RunDescription)> {
        let described = RunDescription::read(path)?;
        let folder = Self::lock(path)?;
        atomic::sweep(path)?;
        let checkpoints = folder.checkpoints();
        if checkpoints.is_dir() {
            atomic::sweep(&checkpoints)?;
        }
        Ok((folder, described))
    }

    fn lock(path: &Path) -> Result<RunFolder> {
        Ok(RunFolder { path: path.to_path_buf(), metrics: None, tensorboard: None, _lock: lock::take(path)? })
    }

    /// The folder.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The folder of the run's checkpoints.
    pub fn checkpoints(&self) -> PathBuf {
        checkpoints(&self.path)
    }

    /// Description of the run: its application and configuration.
    ///
    /// # Errors
    /// When its `config.toml` is damaged.
    pub fn description(&self) -> Result<RunDescription> {
        RunDescription::read(&self.path)
    }

    /// The capture as it was imported when the run began, with all of its photographs.
    ///
    /// # Errors
    /// When it is damaged, or photographs are missing.
    pub fn capture(&self) -> Result<Capture> {
        let capture = kept_capture::read(&self.path, None, &self.description()?.data_set())?;
        kept_capture::require_photographs(&capture)?;
        Ok(capture)
    }

    /// Present location of the data set that the run was trained on.
    ///
    /// # Errors
    /// When the run's capture is damaged.
    pub fn data_set(&self) -> Result<PathBuf> {
        kept_capture::data_set(&self.path, &self.description()?.data_set())
    }

    /// Records that the photographs are in `data` now; returns the changed configuration.
    ///
    /// # Errors
    /// When one is missing there.
    pub fn move_capture<C: Configuration>(&self, data: &Path) -> Result<C> {
        let described = self.description()?;
        let capture = kept_capture::read(&self.path, Some(data), &described.data_set())?;
        kept_capture::require_photographs(&capture)?;
        kept_capture::write(&self.path, data, &capture)?;
        let mut config: C = described.config()?;
        if let Some(path) = config.data_set() {
            *path = absolute(data);
        }
        atomic::write(&described.file, config::to_toml(&config).as_bytes())?;
        Ok(config)
    }

    /// Removes an earlier run and writes configuration, capture and command of this one.
    ///
    /// # Errors
    /// When a file cannot be written.
    pub fn write_description<C: Configuration>(&self, config: &C, capture: &Capture) -> Result<()> {
        self.clear();
        let mut config = config.clone();
        if let Some(data) = config.data_set() {
            kept_capture::write(&self.path, data, capture)?;
            // The run may be looked at from another folder.
            *data = absolute(data);
        }
        self.write_configuration(&config)
    }

    /// As [`RunFolder::write_description`], for a run without a capture.
    ///
    /// # Errors
    /// When a file cannot be written.
    pub fn begin<C: Configuration>(&self, config: &C) -> Result<()> {
        self.clear();
        self.write_configuration(config)
    }

    /// Removes an earlier run.
    fn clear(&self) {
        let results = [metrics::NAME, EVENTS, "curves.svg", "curves.png", summary::NAME];
        for name in [description::NAME, kept_capture::NAME, "command.txt"].into_iter().chain(results) {
            let _ = std::fs::remove_file(self.path.join(name));
        }
        let _ = std::fs::remove_dir_all(self.checkpoints());
    }

    fn write_configuration<C: Configuration>(&self, config: &C) -> Result<()> {
        let command: Vec<String> = std::env::args().collect();
        atomic::write(&self.path.join("command.txt"), format!("{}\n", command.join(" ")).as_bytes())?;
        atomic::write(&self.path.join(description::NAME), config::to_toml(config).as_bytes())?;
        Ok(())
    }

    /// Writes the results of the run so far; the peak of memory is that of all of its parts.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn write_summary(&self, figures: &impl Serialize) -> Result<()> {
        summary::write(&self.path, figures)
    }

    /// Drops metrics past `step` and writes the TensorBoard file anew from what is left.
    ///
    /// # Errors
    /// When a file cannot be written.
    pub fn cut_metrics(&mut self, step: u64) -> Result<()> {
        let rows: Vec<Row> = metrics::read_rows(&self.path).into_iter().filter(|r| r.step <= step).collect();
        let text: String = rows.iter().map(Row::line).collect();
        atomic::write(&self.path.join(metrics::NAME), text.as_bytes())?;
        let name = self.path.join(EVENTS);
        let mut t = TfEvents::create(&name).map_err(DataError::io(&name, "write"))?;
        for r in &rows {
            r.to_tensorboard(&mut t).map_err(DataError::io(&name, "write"))?;
        }
        self.tensorboard = Some(t);
        Ok(())
    }

    /// Appends the figures of an event to the metrics.
    ///
    /// # Errors
    /// When a file cannot be written.
    pub fn log(&mut self, event: &Event) -> Result<()> {
        if let Event::Recovered { to_step, .. } = *event {
            self.metrics = None;
            return self.cut_metrics(to_step);
        }
        let Some(row) = Row::of(event) else { return Ok(()) };
        let name = self.path.join(metrics::NAME);
        if self.metrics.is_none() {
            let file = File::options().create(true).append(true).open(&name).map_err(DataError::io(&name, "write"))?;
            self.metrics = Some(file);
        }
        let file = self.metrics.as_mut().expect("opened above");
        file.write_all(row.line().as_bytes()).map_err(DataError::io(&name, "write"))?;
        let events = self.path.join(EVENTS);
        if self.tensorboard.is_none() {
            self.tensorboard = Some(TfEvents::create(&events).map_err(DataError::io(&events, "write"))?);
        }
        let t = self.tensorboard.as_mut().expect("created above");
        row.to_tensorboard(t).map_err(DataError::io(&events, "write"))?;
        Ok(())
    }

    /// Draws the metrics against steps.
    ///
    /// # Errors
    /// When a file cannot be written.
    pub fn draw_curves(&self) -> Result<()> {
        let name = self.path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let charts = metrics::charts(&[(name, metrics::read_rows(&self.path))]);
        atomic::write(&self.path.join("curves.svg"), plot::svg(&charts).as_bytes())?;
        photo::save_png(&self.path.join("curves.png"), &plot::raster(&charts))?;
        Ok(())
    }
}

/// The folder of a run's checkpoints.
pub fn checkpoints(run: &Path) -> PathBuf {
    run.join("checkpoints")
}

/// The last checkpoint of a run, the file it is in, and what the user should know of it.
///
/// # Errors
/// When there is none, or neither it nor the one before it is whole.
pub fn last_checkpoint(run: &Path) -> Result<(Checkpoint, PathBuf, Option<String>)> {
    let folder = checkpoints(run);
    if !checkpoint::exists(&folder) {
        return Err(DataError::input(run, "holds no checkpoint yet; train it first").into());
    }
    let (loaded, note) = checkpoint::load(&folder)?;
    Ok((loaded, checkpoint::latest(&folder), note))
}
