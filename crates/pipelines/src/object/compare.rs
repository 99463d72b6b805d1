//! Runs side by side: curves, held-out images, cost.

use super::evaluate;
use super::held_out;
use super::model::ObjectModel;
use super::run_folder::{load_model_of, read_summary};
use crate::error::{PipelineError, Result};
use crate::run::kept_capture::require_photographs;
use crate::run::metrics::{charts, read_rows};
use diorama_data::{DataError, atomic, photo, plot};
use diorama_engine::renderers::volume::Quality;
use diorama_geom::ImageU8;
use diorama_geom::capture::Split;
use serde::Serialize;
use std::path::{Path, PathBuf};

/// Held-out views that are shown, evenly taken from all.
const SHOWN: usize = 4;

/// One run's line.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Compared {
    pub run: PathBuf,
    pub method: String,
    pub steps: u64,
    pub seconds: f64,
    pub rays: u64,
    pub samples: u64,
    pub parameters: usize,
    pub psnr: f64,
    pub ssim: f64,
    pub mse: f64,
    /// Most bytes that training had in memory, where that is known.
    pub peak_memory_bytes: Option<u64>,
}

/// The table's file.
const TABLE: &str = "compare.json";

/// Reads a run with all that judging it takes.
fn complete(run: &Path, data: Option<&Path>) -> Result<(ObjectModel, Option<u64>)> {
    let (model, _) = load_model_of(run, data)?;
    require_photographs(&model.capture)?;
    if held_out::frames(&model.capture, Split::Test).is_empty() {
        return Err(PipelineError::Usage(format!("{}: holds no views out, so it cannot be compared", run.display())));
    }
    Ok((model, read_summary(run)?.and_then(|s| s.peak_memory_bytes)))
}

/// Refuses a folder that holds something but no comparison.
fn refuse_others(out: &Path) -> Result<()> {
    let is_filled = std::fs::read_dir(out).is_ok_and(|mut d| d.next().is_some());
    if is_filled && !out.join(TABLE).is_file() {
        return Err(DataError::input(out, "is not empty and holds no comparison; give another -o").into());
    }
    Ok(())
}

/// Scores every run, and writes `curves.svg`, `curves.png` and `views.png` (photograph, then each run)
/// into `out`, in place of an earlier comparison; `data` is where the photographs of all runs are now, if they moved. Every run is read before the first is
/// judged.
pub fn compare(runs: &[PathBuf], data: Option<&Path>, out: &Path, note: &mut dyn FnMut(&str)) -> Result<Vec<Compared>> {
    refuse_others(out)?;
    for run in runs {
        complete(run, data)?;
    }
    std::fs::create_dir_all(out).map_err(DataError::io(out, "create"))?;
    let mut table = Vec::new();
    let mut strips: Vec<Vec<ImageU8>> = Vec::new();
    for run in runs {
        note(&format!("judging {}", run.display()));
        let (model, peak_memory_bytes) = complete(run, data)?;
        let shown = held_out::spread(&held_out::frames(&model.capture, Split::Test), SHOWN);
        let shown: Vec<&String> = shown.iter().map(|i| &model.capture.frames[*i].name).collect();
        let mut views = Vec::new();
        let mut photos = Vec::new();
        let report = evaluate::evaluate(&model, Split::Test, Quality::Full, &mut |name, v| {
            if shown.iter().any(|s| *s == name) {
                views.push(v.view.rgb.to_u8());
                photos.push(v.photo.to_u8());
            }
            Ok(())
        })?;
        if strips.is_empty() {
            strips.extend([vec![plot::caption("photographs")], photos]);
        }
        strips.extend([vec![plot::caption(&format!("{}: {:.2} dB", run.display(), report.psnr))], views]);
        table.push(Compared {
            run: run.clone(),
            method: model.config.method.to_string(),
            steps: model.origin.step,
            seconds: model.origin.seconds,
            rays: model.rays,
            samples: model.samples,
            parameters: model
                .field
                .groups()
                .iter()
                .chain(model.coarse.iter().flat_map(|c| c.groups()).collect::<Vec<_>>().iter())
                .map(|g| g.values.len())
                .sum(),
            psnr: report.psnr,
            ssim: report.ssim,
            mse: report.mse,
            peak_memory_bytes,
        });
    }
    let named: Vec<_> = runs.iter().map(|r| (r.file_name().unwrap_or_default().to_string_lossy().into_owned(), read_rows(r))).collect();
    let charts = charts(&named);
    atomic::write(&out.join("curves.svg"), plot::svg(&charts).as_bytes())?;
    photo::save_png(&out.join("curves.png"), &plot::raster(&charts))?;
    photo::save_png(&out.join("views.png"), &tile(&strips))?;
    let json = serde_json::to_vec_pretty(&table).expect("a table is JSON");
    atomic::write(&out.join(TABLE), &json)?;
    Ok(table)
}

/// Rows of images, each scaled by its own size, left-aligned on white.
pub fn tile(rows: &[Vec<ImageU8>]) -> ImageU8 {
    let width = rows.iter().map(|r| r.iter().map(|i| i.width + 4).sum::<usize>()).max().unwrap_or(1).max(1);
    let heights: Vec<usize> = rows.iter().map(|r| r.iter().map(|i| i.height + 4).max().unwrap_or(0)).collect();
    let height = heights.iter().sum::<usize>().max(1);
    let mut out = ImageU8 { width, height, channels: 3, data: vec![255; width * height * 3] };
    let mut y0 = 0;
    for (row, h) in rows.iter().zip(heights) {
        let mut x0 = 0;
        for im in row {
            for y in 0..im.height {
                let at = ((y0 + y) * width + x0) * 3;
                out.data[at..at + im.width * 3].copy_from_slice(&im.data[y * im.width * 3..(y + 1) * im.width * 3]);
            }
            x0 += im.width + 4;
        }
        y0 += h;
    }
    out
}
