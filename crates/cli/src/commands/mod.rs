//! One file per verb.

pub mod bench;
pub mod compare;
pub mod doctor;
pub mod eval;
pub mod export;
pub mod info;
pub mod manual;
pub mod prepare;
pub mod quickstart;
pub mod render;
pub mod train;
pub mod view;

use crate::arguments::MaskArgs;
use diorama_data::masks::{self, MaskOptions, MaskUse};
use diorama_pipelines::{PipelineError, Result};
use std::sync::atomic::{AtomicBool, Ordering};

/// How a command ended, errors apart.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    Done,
    Interrupted,
}

/// Set by the first Ctrl-C; the second ends the program at once.
pub static INTERRUPT: AtomicBool = AtomicBool::new(false);

/// Lets Ctrl-C end long work cleanly.
pub fn watch_interrupts() {
    // A handler may already be there when verbs call verbs.
    let _ = ctrlc::set_handler(|| {
        if INTERRUPT.swap(true, Ordering::Relaxed) {
            std::process::exit(130);
        }
        eprintln!("stopping after this step; press Ctrl-C again to stop at once");
    });
}

/// What flags say of masks.
pub fn mask_options(a: &MaskArgs) -> Result<MaskOptions> {
    let usage = |e: String| PipelineError::Usage(format!("--{e}"));
    Ok(MaskOptions {
        usage: a.mask.as_deref().map_or(Ok(MaskUse::Use), str::parse).map_err(usage)?,
        meaning: a.mask_meaning.as_deref().map_or(Ok(None), masks::parse_meaning).map_err(usage)?,
    })
}

/// Bounds the threads of all kernels.
pub fn use_threads(threads: Option<usize>) -> Result<()> {
    if threads == Some(0) {
        return Err(PipelineError::Usage("--threads 0: must be at least 1".into()));
    }
    if let Some(n) = threads {
        let _ = rayon::ThreadPoolBuilder::new().num_threads(n).build_global();
    }
    Ok(())
}

/// Tells what the user should know.
pub fn note(text: &str) {
    eprintln!("note: {text}");
}

/// Six numbers `x0,y0,z0,x1,y1,z1` in the input's frame, as a box in the world.
pub fn parse_clip(text: &str, world_from_capture: &diorama_geom::Similarity) -> Result<([f32; 3], [f32; 3])> {
    let bad = || PipelineError::Usage(format!("--clip {text}: expected x0,y0,z0,x1,y1,z1 with each second corner above the first"));
    let v: Vec<f64> = text.split(',').map(|s| s.trim().parse().map_err(|_| bad())).collect::<Result<_>>()?;
    if v.len() != 6 || v.iter().any(|x| !x.is_finite()) || (0..3).any(|k| v[k] >= v[k + 3]) {
        return Err(bad());
    }
    // The box that holds all eight turned corners.
    let (mut lo, mut hi) = ([f32::MAX; 3], [f32::MIN; 3]);
    for c in 0..8 {
        let corner: [f64; 3] = std::array::from_fn(|k| v[k + 3 * (c >> k & 1)]);
        let p = world_from_capture.point(diorama_geom::glam::DVec3::from_array(corner)).as_vec3().to_array();
        for k in 0..3 {
            lo[k] = lo[k].min(p[k]);
            hi[k] = hi[k].max(p[k]);
        }
    }
    Ok((lo, hi))
}

/// The box of `--clip`; without the flag that of the viewer, with `whole` none.
pub fn clip_or_crop(
    clip: Option<&str>,
    whole: &str,
    run: &std::path::Path,
    model: &diorama_pipelines::object::model::ObjectModel,
) -> Result<Option<([f32; 3], [f32; 3])>> {
    match clip {
        Some(c) if c == whole => Ok(None),
        Some(c) => parse_clip(c, &model.capture.world_from_capture).map(Some),
        None => {
            let crop = diorama_pipelines::object::viewing::read_crop(run)?;
            if crop.is_some() {
                eprintln!(
                    "note: within the crop box saved in the viewer ({}); --clip {whole} leaves it out",
                    run.join("crop.json").display()
                );
            }
            Ok(crop)
        }
    }
}
