//! `--from-run` of `diorama relight object`: mesh and cut-out photographs of a run of the object application, kept in the new run's folder.

use crate::commands::clip::clip_or_crop;
use crate::commands::process::{INTERRUPT, note, usage};
use crate::terminal::ShareShown;
use diorama_data::DataError;
use diorama_geom::Capture;
use diorama_pipelines::object::cut_out::{self, CutOptions, CutOut};
use diorama_pipelines::object::model::ObjectModel;
use diorama_pipelines::object::{device, run_folder};
use diorama_pipelines::relight::object::capture;
use diorama_pipelines::relight::object::config::Config;
use diorama_pipelines::run::RunFolder;
use diorama_pipelines::run::folder::START;
use diorama_pipelines::{Application, Result};
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Faces of the mesh over the squared number of cells of the tetrahedral grid: about as many as the first stage would give.
const FACES: usize = 24;

/// The run to begin from.
pub struct Source<'a> {
    pub run: &'a Path,
    /// `--clip`
    pub clip: Option<&'a str>,
    pub resolution: Option<usize>,
    pub faces: Option<usize>,
    pub device: &'a str,
}

impl Source<'_> {
    /// The model of the run, on its device.
    fn model(&self) -> Result<ObjectModel> {
        let instead = match Application::of_run(self.run)? {
            Application::Object => None,
            of @ Application::Relight => Some((of, "diorama relight mesh")),
            of @ Application::RelightObject => Some((of, "diorama relight object --resume, which writes the GLB again")),
            of @ (Application::Text | Application::Detector) => Some((of, "a run of object")),
        };
        if let Some((of, instead)) = instead {
            return Err(of.refuse(self.run, instead));
        }
        let (mut model, notes) = run_folder::load_model(self.run)?;
        notes.iter().for_each(|n| note(n));
        let files = model.capture.frames.iter().flat_map(|f| [Some(&f.image), f.mask.as_ref()]).flatten();
        if let Some(lost) = files.into_iter().find(|f| !f.is_file()) {
            return Err(
                DataError::input(lost, "does not exist; the photographs that the run was trained on must be where they were").into()
            );
        }
        device::accelerate(&mut model, self.device, Box::new(note))?;
        Ok(model)
    }

    /// Makes the folder of a new run with mesh and photographs of this one, which `config` then names; none when it was interrupted. On errors
    /// and interrupts nothing stays behind.
    pub fn begin(&self, config: &mut Config, run: &Path, force: bool) -> Result<Option<(RunFolder, Capture)>> {
        let model = self.model()?;
        let clip = clip_or_crop(self.clip, "auto", self.run, &model)?;
        if run.canonicalize().is_ok_and(|r| self.run.canonicalize().is_ok_and(|own| own == r)) {
            return Err(usage(format!("run {}: is the run to begin from; give the folder of a new run", run.display())));
        }
        let was_there = run.exists();
        let folder = RunFolder::create(run, force)?;
        let options = CutOptions {
            clip,
            resolution: self.resolution.unwrap_or(cut_out::RESOLUTION),
            faces: self.faces.unwrap_or(FACES * config.grid.cells * config.grid.cells),
        };
        let partial = run.join(format!("{START}.partial"));
        let made = cut(&model, &options, &partial).and_then(|made| made.map_or(Ok(None), |_| keep(config, &partial, run).map(Some)));
        if !matches!(made, Ok(Some(_))) {
            let _ = std::fs::remove_dir_all(&partial);
            drop(folder);
            if !was_there {
                let _ = std::fs::remove_dir_all(run);
            }
            return made.map(|_| None);
        }
        Ok(made?.map(|capture| (folder, capture)))
    }
}

/// Cuts the object out into an empty folder.
fn cut(model: &ObjectModel, options: &CutOptions, into: &Path) -> Result<Option<CutOut>> {
    // Of a call that was killed.
    if into.exists() {
        std::fs::remove_dir_all(into).map_err(DataError::io(into, "remove"))?;
    }
    let (start, mut shown) = (Instant::now(), ShareShown::new());
    let made = cut_out::write(model, into, options, &INTERRUPT, &mut |stage, i, n| shown.show(i as f64 / n.max(1) as f64, stage));
    shown.finish();
    let Some(made) = made? else { return Ok(None) };
    made.notes.iter().for_each(|n| note(n));
    let seconds = start.elapsed().as_secs_f64();
    note(&format!(
        "{} faces and {} photographs, {} of them to train on, cut out in {seconds:.0} s",
        made.faces, made.photographs, made.training
    ));
    Ok(Some(made))
}

/// Moves what was cut out to its place, once it is known that training can begin from it.
fn keep(config: &mut Config, partial: &Path, run: &Path) -> Result<Capture> {
    let at = |folder: &Path| {
        let folder = std::path::absolute(folder).unwrap_or_else(|_| folder.to_path_buf());
        (folder.join(cut_out::MESH), folder)
    };
    (config.base_mesh, config.data.path) = at(partial);
    capture::load(config, &capture::import(config)?)?;
    let kept: PathBuf = run.join(START);
    if kept.exists() {
        std::fs::remove_dir_all(&kept).map_err(DataError::io(&kept, "remove"))?;
    }
    std::fs::rename(partial, &kept).map_err(DataError::io(&kept, "create"))?;
    (config.base_mesh, config.data.path) = at(&kept);
    capture::import(config)
}
