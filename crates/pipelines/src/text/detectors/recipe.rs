//! Training of a detector and its use, to be read from top to bottom.

use super::config::{Backbone, Config, Kind};
use super::network::Detector;
use super::samples::Pictures;
use super::trainer::{Trainer, metadata};
use crate::error::{PipelineError, Result};
use crate::run::config::Configuration;
use crate::run::{RunDescription, RunFolder, training};
use diorama_data::text_set::detector_set::{self, DetectorImage};
use diorama_data::{DataError, atomic, checkpoint, weights};
use diorama_engine::train::{Event, RunOptions, Summary};
use diorama_geom::NamedArray;
use diorama_nets::param;
use diorama_nets::weights::{KeyMap, Rule, Strictness, load};
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

/// File of the trained weights in a run's folder.
pub const WEIGHTS: &str = "detector.safetensors";

/// Result of training.
pub struct Trained {
    pub detector: Detector,
    pub summary: Summary,
    /// The file of the weights.
    pub weights: PathBuf,
}

/// Trains into `folder`, from the start, from weights of `begin` or from its checkpoint.
///
/// # Errors
/// When the data set, the weights or a checkpoint cannot be read, or training diverges.
pub fn train(
    config: &Config,
    folder: &mut RunFolder,
    (resume, begin): (bool, Option<&Path>),
    interrupt: &AtomicBool,
    events: &mut dyn FnMut(&Event),
) -> Result<Trained> {
    config.check()?;
    let set = labelled(&config.data.path)?;
    let detector = Detector::new(config.model, config.backbone, config.seed);
    if let Some(file) = begin {
        events(&Event::Note(begin_from(&detector, file)?));
    }
    let pictures = Pictures::new(set, config.data.most_px, config.data.memory_budget)?;
    let checkpoints = folder.checkpoints();
    let mut trainer = Trainer::new(config.clone(), detector, pictures, &checkpoints);
    if resume {
        if checkpoint::exists(&checkpoints) {
            trainer.restore()?.into_iter().for_each(|n| events(&Event::Note(n)));
        }
        folder.cut_metrics(trainer.origin.step)?;
    } else {
        let _ = std::fs::remove_file(folder.path().join(WEIGHTS));
        folder.begin(config)?;
    }
    let (origin, options) = (trainer.origin, run_options(config));
    let summary = training::train((&options, origin), &mut trainer, folder, interrupt, events)?;
    let file = folder.path().join(WEIGHTS);
    weights::save(&file, &param::arrays(&trainer.detector), metadata(config))?;
    Ok(Trained { detector: trainer.detector, summary, weights: file })
}

fn run_options(config: &Config) -> RunOptions {
    let r = &config.run;
    RunOptions {
        steps: (r.steps > 0).then_some(r.steps),
        seconds: (r.seconds > 0.0).then_some(r.seconds),
        log_every: r.log_every,
        save_every_seconds: r.save_every_seconds,
        save_every_steps: None,
        evaluate_every: None,
    }
}

/// A data set with at least one word to learn.
///
/// # Errors
/// When it cannot be read or has none.
pub fn labelled(folder: &Path) -> Result<Vec<DetectorImage>> {
    let set = detector_set::read_set(folder)?;
    if set.iter().all(|i| i.labels.iter().all(|l| l.region.ignore)) {
        let labels = folder.join(detector_set::LABELS);
        return Err(DataError::input(labels, "labels no word that counts; write lines such as 10,8,90,10,90,30,10,28,CAFE").into());
    }
    Ok(set)
}

/// Fills a detector, or its backbone alone, with weights of a file; says which.
fn begin_from(detector: &Detector, file: &Path) -> Result<String> {
    /// torchvision's backbones have the names of ours, without `backbone.` before them.
    const OF_BACKBONE: KeyMap = KeyMap {
        rules: &[
            Rule::rename("conv1", "backbone.conv1"),
            Rule::rename("bn1", "backbone.bn1"),
            Rule::rename("layer1", "backbone.layer1"),
            Rule::rename("layer2", "backbone.layer2"),
            Rule::rename("layer3", "backbone.layer3"),
            Rule::rename("layer4", "backbone.layer4"),
        ],
        ignored: &["num_batches_tracked", "fc.weight", "fc.bias"],
    };
    let mut arrays = weights::read(file, &|_| true)?;
    let is_backbone = arrays.iter().any(|a| a.name == "conv1.weight");
    let map = if is_backbone { OF_BACKBONE } else { KeyMap::PLAIN };
    if is_backbone {
        // The rest of the detector stays as it is.
        let rest = param::arrays(detector).into_iter().filter(|a| !a.name.starts_with("backbone."));
        arrays.extend(rest.collect::<Vec<NamedArray>>());
    }
    load(detector, &arrays, &map, Strictness::Exact)
        .map_err(|e| DataError::input(file, format!("{e}; give weights of the same network")))?;
    Ok(format!("begins from {} ({})", file.display(), if is_backbone { "the backbone" } else { "the whole detector" }))
}

/// A detector of a run's folder or of a file of weights, and its configuration. What `model` and `backbone` say must be so; where neither
/// they nor the file say it, it is missing.
///
/// # Errors
/// When the file cannot be read or is of another detector.
pub fn open(path: &Path, model: Option<Kind>, backbone: Option<Backbone>) -> Result<(Detector, Config)> {
    let is_run = path.is_dir();
    let file = if is_run { path.join(WEIGHTS) } else { path.to_path_buf() };
    let said = match is_run {
        true => Some(RunDescription::read(path)?.config::<Config>()?),
        false => None,
    };
    if is_run && !file.is_file() {
        return Err(DataError::input(path, format!("holds no {WEIGHTS} yet; let the training end, or interrupt it with Ctrl-C")).into());
    }
    let metadata = weights::metadata(&file)?;
    let text = |key: &str| metadata.get(key).map(String::as_str);
    let told_model = text("model").map(Kind::named).transpose()?;
    let told_backbone = text("backbone").map(Backbone::named).transpose()?;
    let model = agreed("--model", model, told_model, &file, Kind::name)?;
    let backbone = agreed("--backbone", backbone, told_backbone, &file, Backbone::name)?;
    let config = said.unwrap_or_else(|| Config::new(model, backbone, PathBuf::new()));
    let detector = Detector::new(model, backbone, 0);
    let arrays = weights::read(&file, &|_| true)?;
    load(&detector, &arrays, &KeyMap::PLAIN, Strictness::Exact)
        .map_err(|e| DataError::input(&file, format!("{e}; check --model and --backbone")))?;
    Ok((detector, config))
}

/// What an option and a file say alike.
fn agreed<T: PartialEq + Copy>(option: &str, given: Option<T>, told: Option<T>, file: &Path, name: fn(T) -> &'static str) -> Result<T> {
    match (given, told) {
        (Some(a), Some(b)) if a != b => {
            let text = format!("holds a detector of {option} {}, not {}; leave {option} out", name(b), name(a));
            Err(DataError::input(file, text).into())
        }
        (Some(a), _) => Ok(a),
        (None, Some(b)) => Ok(b),
        (None, None) => Err(PipelineError::Usage(format!("{option}: {} does not say it; give {option}", file.display()))),
    }
}

/// Writes a detector as an ONNX file.
///
/// # Errors
/// When the file cannot be written.
pub fn write_onnx(detector: &Detector, config: &Config, file: &Path) -> Result<()> {
    let metadata = [("model", config.model.name()), ("backbone", config.backbone.name())];
    let bytes = detector.to_onnx().encode("detector", &metadata);
    Ok(atomic::write(file, &bytes)?)
}

/// Description of a run for `diorama info`.
///
/// # Errors
/// When the run is damaged.
pub fn describe(run: &Path) -> Result<serde_json::Value> {
    let config: Config = RunDescription::read(run)?.config()?;
    let (checkpoint, _, note) = crate::run::folder::last_checkpoint(run)?;
    let number = |key: &str| checkpoint.metadata.get(key).and_then(|v| v.parse::<f64>().ok());
    Ok(serde_json::json!({
        "kind": "detector run",
        "data": config.data.path,
        "model": config.model.name(),
        "backbone": config.backbone.name(),
        "steps": number("step").map(|s| s as u64),
        "seconds": number("seconds"),
        "parameters": param::count(&Detector::new(config.model, config.backbone, 0)),
        "weights": run.join(WEIGHTS).is_file(),
        "notes": note.into_iter().collect::<Vec<_>>(),
    }))
}
