//! `--clip`: the box to which rendering or extraction is limited.

use diorama_geom::Similarity;
use diorama_geom::glam::DVec3;
use diorama_pipelines::object::model::ObjectModel;
use diorama_pipelines::run::viewer_files::{self, Crop};
use diorama_pipelines::{PipelineError, Result};
use std::path::Path;

/// Parses `x0,y0,z0,x1,y1,z1` in the input's frame into a box in the world.
fn parse_clip(text: &str, world_from_capture: &Similarity) -> Result<Crop> {
    let bad = || PipelineError::Usage(format!("--clip {text}: expected x0,y0,z0,x1,y1,z1 with each second corner above the first"));
    let v: Vec<f64> = text.split(',').map(|s| s.trim().parse().map_err(|_| bad())).collect::<Result<_>>()?;
    if v.len() != 6 || v.iter().any(|x| !x.is_finite()) || (0..3).any(|k| v[k] >= v[k + 3]) {
        return Err(bad());
    }
    // The bounding box of all eight rotated corners.
    let (mut lo, mut hi) = ([f32::MAX; 3], [f32::MIN; 3]);
    for c in 0..8 {
        let corner: [f64; 3] = std::array::from_fn(|k| v[k + 3 * (c >> k & 1)]);
        let p = world_from_capture.point(DVec3::from_array(corner)).as_vec3().to_array();
        for k in 0..3 {
            lo[k] = lo[k].min(p[k]);
            hi[k] = hi[k].max(p[k]);
        }
    }
    Ok((lo, hi))
}

/// The box of `--clip`; without it, the viewer's crop box. `None` for the value `whole`.
pub fn clip_or_crop(clip: Option<&str>, whole: &str, run: &Path, model: &ObjectModel) -> Result<Option<Crop>> {
    match clip {
        Some(c) if c == whole => Ok(None),
        Some(c) => parse_clip(c, &model.capture.world_from_capture).map(Some),
        None => {
            let crop = viewer_files::read_crop(run)?;
            if crop.is_some() {
                eprintln!(
                    "note: limited to the crop box saved in the viewer ({}); --clip {whole} ignores it",
                    run.join("crop.json").display()
                );
            }
            Ok(crop)
        }
    }
}
