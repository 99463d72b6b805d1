//! Held-out photographs: their selection, the pixels that score training while it runs, and views behind fog.

use super::config::Method;
use super::model::ObjectModel;
use crate::error::Result;
use crate::run::photographs::StoredPhotographs;
use diorama_data::pixel_store::{PixelStore, StoreOptions};
use diorama_engine::fields::FieldBuffers;
use diorama_engine::metrics::psnr;
use diorama_engine::renderers::volume::Quality;
use diorama_engine::samplers::RayBatch;
use diorama_engine::samplers::pixels::{self, DrawOptions};
use diorama_engine::train::{Scalar, Scores};
use diorama_geom::Capture;
use diorama_geom::capture::Split;
use diorama_geom::rng::Rng;
use diorama_kernels::ops::photometric_loss::squared_error;

/// Stream of the random numbers by which held-out pixels are drawn.
const PIXELS: u64 = 20;
/// Most views that pixels are drawn from, and pixels of all of them together: with a grid, and without one, where a ray
/// takes a hundred times as long.
const VIEWS: usize = 16;
const RAYS: usize = 4096;
const SLOW_RAYS: usize = 256;
/// Bytes of photographs that are kept while pixels are drawn.
const BUDGET: u64 = 64 << 20;

/// A held-out view this many dB below the training views is behind fog, whatever its depth says.
pub const FOG_DB: f64 = 6.0;
/// Mean gap in dB between training and held-out views from which on its meaning is explained to users.
pub const GAP_DB: f64 = 3.0;

/// Explanation of a gap, and its cures.
pub const GAP_MEANS: &str = "photographs are explained in ways that do not hold from other places: fog, surfaces at wrong distances, mostly \
where few photographs look; what helps: more photographs between these, poses that were checked (diorama doctor DATA), \
--set field.appearance=8 where light or exposure vary (docs/troubleshooting.md)";

/// Frames of a split; held-out ones fall back to validation where there is no test split.
pub fn frames(capture: &Capture, split: Split) -> Vec<usize> {
    let frames = capture.indices(split);
    if frames.is_empty() && split == Split::Test { capture.indices(Split::Val) } else { frames }
}

/// `count` of `all`, evenly spread.
pub fn spread(all: &[usize], count: usize) -> Vec<usize> {
    let n = count.min(all.len());
    (0..n).map(|i| all[i * all.len() / n]).collect()
}

/// Frames whose PSNR lies so far below the training rays' that they are behind fog.
pub fn far_below(views: &[(usize, f64)], training: f64) -> Vec<usize> {
    views.iter().filter(|(_, psnr)| *psnr < training - FOG_DB).map(|v| v.0).collect()
}

/// Scores of held-out pixels.
#[derive(Clone, Debug, PartialEq)]
pub struct Judged {
    /// Of all pixels together.
    pub mse: f64,
    /// PSNR of each view, named by its frame, dB.
    pub views: Vec<(usize, f64)>,
}

impl Judged {
    /// The figures of all pixels together.
    pub fn scores(&self) -> Scores {
        Scores::from([Scalar::psnr("psnr", self.mse), Scalar::new("mse", self.mse).logged_only()])
    }
}

/// Pixels of held-out photographs, the same whenever they are judged.
pub struct HeldOutPixels {
    batch: RayBatch,
    /// Frame of each of the batch's images.
    frames: Vec<usize>,
}

impl HeldOutPixels {
    /// Draws from up to `VIEWS` held-out photographs; `None` where none is held out.
    ///
    /// # Errors
    /// When a photograph or its mask cannot be read.
    pub fn draw(model: &ObjectModel) -> Result<Option<HeldOutPixels>> {
        let frames = spread(&self::frames(&model.capture, Split::Test), VIEWS);
        if frames.is_empty() {
            return Ok(None);
        }
        let listed: Vec<_> = frames.iter().map(|&i| &model.capture.frames[i]).collect();
        let options = StoreOptions {
            reduction: model.config.reduction(),
            budget: BUDGET,
            masks: model.capture.masks,
            white: model.config.data.white,
        };
        let photographs = StoredPhotographs::new(PixelStore::load(&listed, &options, &|| {})?);
        let cameras: Vec<_> = frames.iter().map(|&i| model.posed(i)).collect();
        let mut batch = RayBatch::default();
        batch.resize(if model.config.method == Method::Ngp { RAYS } else { SLOW_RAYS });
        let (near, cube) = (model.config.sampling.near, model.cube());
        let rng = Rng::new(model.config.seed, PIXELS);
        pixels::draw(
            &photographs,
            &DrawOptions { cameras: &cameras, first: 0, rng, near, cube, error_map: None, observations: &[] },
            &mut batch,
        );
        batch.jitter.fill(0.5);
        Ok(Some(HeldOutPixels { batch, frames }))
    }

    /// Number of pixels, each of which takes a ray.
    pub fn rays(&self) -> usize {
        self.batch.len()
    }

    /// Traces the pixels on the CPU and compares them; not numbers where no pixel counts.
    pub fn judge(&self, model: &ObjectModel) -> Judged {
        let mut batch = self.batch.clone();
        let seen = model.tracer(Quality::Full).trace(&mut batch, &mut FieldBuffers::default());
        let (back, is_linear) = (model.backdrop_color(), model.is_linear());
        let mut sums = vec![(0.0f64, 0usize); self.frames.len()];
        for (r, t) in batch.target.chunks_exact(4).enumerate().filter(|(r, _)| batch.counts[*r]) {
            let got = [0, 1, 2].map(|k| if is_linear { seen.rgb[r * 3 + k] } else { seen.rgb[r * 3 + k].clamp(0.0, 1.0) });
            let want = [0, 1, 2].map(|k| t[k] * t[3] + back[k] * (1.0 - t[3]));
            let sum = &mut sums[batch.images[r] as usize];
            *sum = (sum.0 + squared_error(got, want, is_linear) as f64, sum.1 + 1);
        }
        let (error, n) = sums.iter().fold((0.0, 0), |a, b| (a.0 + b.0, a.1 + b.1));
        let mse = error / n as f64;
        let views = self.frames.iter().zip(&sums).filter(|(_, s)| s.1 > 0).map(|(f, s)| (*f, psnr(s.0 / s.1 as f64))).collect();
        Judged { mse, views }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::error::PipelineError;
    use crate::object::config::Config;
    use crate::object::{quickstart, recipe};

    fn model(folder: &std::path::Path, split: &str) -> Result<ObjectModel> {
        let mut c = Config::new(Method::Ngp, folder.into());
        c.set("field.log2_size", "8")?;
        c.set("data.split", split)?;
        let capture = recipe::load_capture(&c)?;
        ObjectModel::new(c, capture, true)
    }

    #[test]
    fn the_same_pixels_are_judged_each_time_and_each_view_has_its_own_score() {
        let dir = tempfile::tempdir().unwrap();
        quickstart::write_capture(dir.path(), 9, 24).unwrap();
        let m = model(dir.path(), "every:3").unwrap();
        let pixels = HeldOutPixels::draw(&m).unwrap().unwrap();
        let (a, b) = (pixels.judge(&m), pixels.judge(&m));
        assert_eq!(a, b);
        assert_eq!(a.views.iter().map(|v| v.0).collect::<Vec<_>>(), [0, 3, 6]);
        let all = psnr(a.mse);
        assert!((5.0..40.0).contains(&all) && a.scores().get("mse") == Some(a.mse));
        let (low, high) = a.views.iter().fold((f64::MAX, f64::MIN), |(l, h), v| (l.min(v.1), h.max(v.1)));
        assert!(low <= all && all <= high);
        assert!(HeldOutPixels::draw(&model(dir.path(), "all").unwrap()).unwrap().is_none());
    }

    #[test]
    fn a_held_out_photograph_that_cannot_be_read_is_named() {
        let dir = tempfile::tempdir().unwrap();
        quickstart::write_capture(dir.path(), 9, 24).unwrap();
        let m = model(dir.path(), "every:3").unwrap();
        // Spoiled after the import, which reads heads.
        std::fs::write(dir.path().join("images/view_03.png"), b"no picture").unwrap();
        let e = HeldOutPixels::draw(&m).err().unwrap();
        assert!(matches!(&e, PipelineError::Data(d) if d.is_input()) && e.to_string().contains("view_03.png"), "{e}");
    }

    #[test]
    fn spreading_takes_all_or_evenly() {
        assert_eq!(spread(&[1, 2, 3], 8), [1, 2, 3]);
        assert_eq!(spread(&(0..16).collect::<Vec<_>>(), 4), [0, 4, 8, 12]);
        assert!(spread(&[], 4).is_empty());
    }
}
