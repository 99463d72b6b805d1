//! The folder of a run: `config.toml`, `capture.json`, `command.txt`, `metrics.jsonl`,
//! `events.tfevents`, `curves.svg` and `.png`, `summary.json`, `checkpoints/`.

use super::config::Config;
use super::kept_capture::{self, absolute};
use super::model::ObjectModel;
use crate::error::{PipelineError, Result};
use diorama_data::plot::{Chart, Series};
use diorama_data::tfevents::TfEvents;
use diorama_data::{DataError, atomic, checkpoint, error, lock};
use diorama_engine::train::Event;
use diorama_geom::Capture;
use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};

const LIMIT: u64 = 1 << 30;

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
    pub fn create(path: &Path, force: bool) -> Result<RunFolder> {
        if path.join("config.toml").exists() && !force {
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

    /// An existing run, with its configuration.
    pub fn open(path: &Path) -> Result<(RunFolder, Config)> {
        let config = read_config(path)?;
        let folder = Self::lock(path)?;
        atomic::sweep(path)?;
        let checkpoints = folder.checkpoints();
        if checkpoints.is_dir() {
            atomic::sweep(&checkpoints)?;
        }
        Ok((folder, config))
    }

    fn lock(path: &Path) -> Result<RunFolder> {
        Ok(RunFolder { path: path.to_path_buf(), metrics: None, tensorboard: None, _lock: lock::take(path)? })
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    pub fn checkpoints(&self) -> PathBuf {
        self.path.join("checkpoints")
    }

    /// The capture as it was imported when the run began, with all of its photographs.
    pub fn capture(&self) -> Result<Capture> {
        let capture = kept_capture::read(&self.path, None, &read_config(&self.path)?.data.path)?;
        kept_capture::require_photographs(&capture)?;
        Ok(capture)
    }

    /// [`RunFolder::capture`] with its sparse points; a note says so where they cannot be had.
    pub fn capture_with_points(&self) -> Result<Capture> {
        let mut capture = self.capture()?;
        kept_capture::add_points(&mut capture, &read_config(&self.path)?, &self.data_set()?);
        Ok(capture)
    }

    /// The data set that the run was trained on, where it is now.
    pub fn data_set(&self) -> Result<PathBuf> {
        kept_capture::data_set(&self.path, &read_config(&self.path)?.data.path)
    }

    /// Takes note that the photographs are in `data` now.
    ///
    /// # Errors
    /// When one is missing there.
    pub fn move_capture(&self, data: &Path) -> Result<()> {
        let mut config = read_config(&self.path)?;
        let capture = kept_capture::read(&self.path, Some(data), &config.data.path)?;
        kept_capture::require_photographs(&capture)?;
        kept_capture::write(&self.path, data, &capture)?;
        config.data.path = absolute(data);
        Ok(atomic::write(&self.path.join("config.toml"), config.to_toml().as_bytes())?)
    }

    /// Clears an earlier run and writes what this one was started with.
    pub fn write_description(&self, config: &Config, capture: &Capture) -> Result<()> {
        let results = ["metrics.jsonl", "events.tfevents", "curves.svg", "curves.png", SUMMARY];
        for name in ["config.toml", "capture.json", "command.txt"].into_iter().chain(results) {
            let _ = std::fs::remove_file(self.path.join(name));
        }
        let _ = std::fs::remove_dir_all(self.checkpoints());
        kept_capture::write(&self.path, &config.data.path, capture)?;
        let command: Vec<String> = std::env::args().collect();
        atomic::write(&self.path.join("command.txt"), format!("{}\n", command.join(" ")).as_bytes())?;
        // The run may be looked at from another folder.
        let mut config = config.clone();
        config.data.path = absolute(&config.data.path);
        atomic::write(&self.path.join("config.toml"), config.to_toml().as_bytes())?;
        Ok(())
    }

    /// Writes what the run came to so far; the peak of memory is that of all of its parts.
    pub fn write_summary(&self, summary: &RunSummary) -> Result<()> {
        // One that is damaged is replaced.
        let before = read_summary(&self.path).ok().flatten().and_then(|s| s.peak_memory_bytes);
        let peak_memory_bytes = summary.peak_memory_bytes.into_iter().chain(before).max();
        let json = serde_json::to_vec_pretty(&RunSummary { peak_memory_bytes, ..summary.clone() }).expect("a summary is JSON");
        Ok(atomic::write(&self.path.join(SUMMARY), &json)?)
    }

    /// Drops metrics past `step` and writes the TensorBoard file anew from what is left.
    pub fn cut_metrics(&mut self, step: u64) -> Result<()> {
        let path = self.path.join("metrics.jsonl");
        let rows: Vec<Row> = read_rows(&self.path).into_iter().filter(|r| r.step <= step).collect();
        let text: String = rows.iter().map(|r| format!("{}\n", serde_json::to_string(r).expect("a row is JSON"))).collect();
        atomic::write(&path, text.as_bytes())?;
        let name = self.path.join("events.tfevents");
        let mut t = TfEvents::create(&name).map_err(DataError::io(&name, "write"))?;
        for r in &rows {
            r.to_tensorboard(&mut t).map_err(DataError::io(&name, "write"))?;
        }
        self.tensorboard = Some(t);
        Ok(())
    }

    /// Appends what an event says to the metrics.
    pub fn log(&mut self, event: &Event) -> Result<()> {
        let row = match *event {
            Event::Progress { step, seconds, loss, mse, psnr, rays, samples, rays_per_s, .. } => Row {
                step,
                seconds,
                loss: Some(loss),
                mse: Some(mse),
                psnr: Some(psnr),
                rays: Some(rays),
                samples: Some(samples),
                rays_per_s: Some(rays_per_s),
                ..Row::default()
            },
            Event::Evaluated { step, seconds, psnr, mse, .. } => {
                Row { step, seconds, val_psnr: Some(psnr), val_mse: Some(mse), ..Row::default() }
            }
            Event::Recovered { to_step, .. } => {
                self.metrics = None;
                return self.cut_metrics(to_step);
            }
            _ => return Ok(()),
        };
        let name = self.path.join("metrics.jsonl");
        if self.metrics.is_none() {
            let file = File::options().create(true).append(true).open(&name).map_err(DataError::io(&name, "write"))?;
            self.metrics = Some(file);
        }
        let line = format!("{}\n", serde_json::to_string(&row).expect("a row is JSON"));
        let file = self.metrics.as_mut().expect("opened above");
        file.write_all(line.as_bytes()).map_err(DataError::io(&name, "write"))?;
        let events = self.path.join("events.tfevents");
        if self.tensorboard.is_none() {
            self.tensorboard = Some(TfEvents::create(&events).map_err(DataError::io(&events, "write"))?);
        }
        let t = self.tensorboard.as_mut().expect("created above");
        row.to_tensorboard(t).map_err(DataError::io(&events, "write"))?;
        Ok(())
    }

    /// Draws PSNR and MSE against steps.
    pub fn draw_curves(&self) -> Result<()> {
        let name = self.path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let charts = charts(&[(name, read_rows(&self.path))]);
        atomic::write(&self.path.join("curves.svg"), diorama_data::plot::svg(&charts).as_bytes())?;
        diorama_data::photo::save_png(&self.path.join("curves.png"), &diorama_data::plot::raster(&charts))?;
        Ok(())
    }
}

/// One line of `metrics.jsonl`.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Row {
    pub step: u64,
    pub seconds: f64,
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub loss: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub mse: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub psnr: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub rays: Option<u64>,
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub samples: Option<u64>,
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub rays_per_s: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub val_psnr: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub val_mse: Option<f64>,
}

impl Row {
    fn to_tensorboard(&self, t: &mut TfEvents) -> std::io::Result<()> {
        let tags = [
            ("train/loss", self.loss),
            ("train/mse", self.mse),
            ("train/psnr", self.psnr),
            ("train/rays_per_s", self.rays_per_s),
            ("val/psnr", self.val_psnr),
            ("val/mse", self.val_mse),
        ];
        for (tag, value) in tags {
            if let Some(v) = value {
                t.scalar(tag, self.step, self.seconds, v as f32)?;
            }
        }
        Ok(())
    }
}

/// The metrics of a run, without lines that a crash cut short.
pub fn read_rows(path: &Path) -> Vec<Row> {
    let text = std::fs::read_to_string(path.join("metrics.jsonl")).unwrap_or_default();
    text.lines().filter_map(|l| serde_json::from_str(l).ok()).collect()
}

/// PSNR and MSE curves of named runs; held-out values where there are any.
pub fn charts(runs: &[(String, Vec<Row>)]) -> Vec<Chart> {
    let series = |f: fn(&Row) -> Option<f64>, suffix: &str| -> Vec<Series> {
        runs.iter()
            .map(|(name, rows)| Series {
                name: format!("{name}{suffix}"),
                points: rows.iter().filter_map(|r| f(r).map(|v| (r.step as f64, v))).collect(),
            })
            .filter(|s| !s.points.is_empty())
            .collect()
    };
    let both = |train: fn(&Row) -> Option<f64>, val: fn(&Row) -> Option<f64>| {
        let mut s = series(train, " train");
        s.extend(series(val, " held out"));
        s
    };
    vec![
        Chart { title: "PSNR".into(), x: "step".into(), y: "dB".into(), series: both(|r| r.psnr, |r| r.val_psnr) },
        Chart { title: "MSE".into(), x: "step".into(), y: "mean squared error".into(), series: both(|r| r.mse, |r| r.val_mse) },
    ]
}

/// The configuration of a run.
pub fn read_config(path: &Path) -> Result<Config> {
    let file = path.join("config.toml");
    if !file.exists() {
        return Err(DataError::input(path, "is not a run folder: it holds no config.toml; give the --out of a training run").into());
    }
    let text = error::read(&file, LIMIT)?;
    let text = String::from_utf8(text).map_err(|_| DataError::input(&file, "is not UTF-8 text"))?;
    let config = Config::from_toml(&text).map_err(|e| PipelineError::from(DataError::input(&file, e)))?;
    config.check()?;
    Ok(config)
}

/// What a run came to, as `summary.json` keeps it.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct RunSummary {
    pub steps: u64,
    pub seconds: f64,
    /// `cpu`, or what the GPU calls itself.
    pub device: String,
    /// Of training rays, and of held-out pixels when they were judged last; dB.
    pub psnr_train: Option<f64>,
    pub psnr_held_out: Option<f64>,
    /// Names of held-out views that lie far below the training views.
    #[serde(default)]
    pub behind_fog: Vec<String>,
    /// Most bytes that training had in memory, where the system tells.
    pub peak_memory_bytes: Option<u64>,
}

const SUMMARY: &str = "summary.json";

/// What a run came to; none before its end.
///
/// # Errors
/// When the file is malformed.
pub fn read_summary(path: &Path) -> Result<Option<RunSummary>> {
    let file = path.join(SUMMARY);
    if !file.exists() {
        return Ok(None);
    }
    let wrong = |e: serde_json::Error| DataError::input(&file, format!("is damaged: {e}; remove it"));
    Ok(Some(serde_json::from_slice(&error::read(&file, LIMIT)?).map_err(wrong)?))
}

/// A trained model, read from its folder.
pub fn load_model(path: &Path) -> Result<(ObjectModel, Vec<String>)> {
    load_model_of(path, None)
}

/// Reads the sparse points of a model's capture, whose photographs are in `data` now, if that is given; else a note says why not.
///
/// # Errors
/// When the run's capture is damaged.
pub fn add_points(model: &mut ObjectModel, path: &Path, data: Option<&Path>) -> Result<Vec<String>> {
    let data = match data {
        Some(moved) => moved.to_path_buf(),
        None => kept_capture::data_set(path, &model.config.data.path)?,
    };
    let n_notes = model.capture.notes.len();
    kept_capture::add_points(&mut model.capture, &model.config, &data);
    Ok(model.capture.notes.split_off(n_notes))
}

/// A trained model whose photographs are in `data` now, if that is given.
pub fn load_model_of(path: &Path, data: Option<&Path>) -> Result<(ObjectModel, Vec<String>)> {
    let config = read_config(path)?;
    let capture = kept_capture::read(path, data, &config.data.path)?;
    let folder = path.join("checkpoints");
    if !checkpoint::exists(&folder) {
        return Err(DataError::input(path, "holds no checkpoint yet; train it first").into());
    }
    let (c, note) = checkpoint::load(&folder)?;
    // The field's space depends on it.
    let has_alpha = c.metadata.get("has_alpha").is_some_and(|v| v == "true");
    let mut model = ObjectModel::new(config, capture, has_alpha)?;
    model.restore(c, &checkpoint::latest(&folder))?;
    Ok((model, note.into_iter().collect()))
}
