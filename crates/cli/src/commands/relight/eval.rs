//! `diorama relight eval`

use crate::commands::process::{note, use_threads};
use crate::commands::{Outcome, Verb};
use crate::terminal::ShareShown;
use clap::Args;
use diorama_data::{DataError, photo};
use diorama_geom::ImageU8;
use diorama_pipelines::relight::object;
use diorama_pipelines::relight::outdoor::{recipe, scores};
use diorama_pipelines::{Application, Result};
use std::path::PathBuf;

/// Samples per pixel of path-traced scores of objects.
const SAMPLES: u32 = 32;
/// Rays per pixel and axis of pictures of scenes.
const RAYS: u32 = 2;

/// Score a run of the scene model or of the object model on a generated benchmark
#[derive(Args, Clone, Debug)]
pub struct Eval {
    /// Folder of the run
    run: PathBuf,
    /// Folder for pictures of the held-out views, each above the exact picture, with its layers [default: RUN/eval]
    #[arg(short, long)]
    out: Option<PathBuf>,
    /// Number of CPU threads [default: all]
    #[arg(long)]
    threads: Option<usize>,
    /// Print one JSON object on stdout
    #[arg(long)]
    json: bool,
}

impl Verb for Eval {
    fn json(&self) -> bool {
        self.json
    }

    fn run(&self) -> Result<Outcome> {
        use_threads(self.threads)?;
        if Application::of_run(&self.run)? == Application::RelightObject {
            return self.object();
        }
        let (model, notes) = recipe::load(&self.run)?;
        notes.iter().for_each(|n| note(n));
        let out = self.out.clone().unwrap_or_else(|| self.run.join("eval"));
        std::fs::create_dir_all(&out).map_err(DataError::io(&out, "create"))?;
        let mut shown = ShareShown::new();
        let look = &mut |name: &str, sheet: &scores::Sheet| {
            Ok(photo::save_png(&out.join(format!("{name}.png")), &rows(&[&sheet.ours, &sheet.exact]))?)
        };
        let s = scores::judge(&model, &model.config.data.path, RAYS, look, &mut |s| shown.show(s, "held-out photographs"))?;
        shown.finish();
        if self.json {
            println!("{}", serde_json::to_string(&s).expect("plain values"));
        } else {
            println!(
                "unseen light     {:.2} dB (exact layers {:.2}, mean light {:.2})",
                s.unseen_light_psnr, s.oracle_psnr, s.mean_light_psnr
            );
            if s.veiled_light_psnr.is_finite() {
                println!(
                    "veiled sun       {:.2} dB (exact layers {:.2}, mean light {:.2})",
                    s.veiled_light_psnr, s.veiled_oracle_psnr, s.veiled_mean_psnr
                );
            }
            println!("seen lights      {:.2} dB (with a sun {:.2}), light {}", s.seen_light_psnr, s.sunlit_psnr, s.light);
            println!("albedo           {:.2} dB", s.albedo_psnr);
            println!("normals          {:.1}° median", s.normal_median_deg);
            println!("distance         {:.1} % median", 100.0 * s.depth_median);
            println!("shadow           {:.2} correlation", s.shadow_correlation);
            println!("{} views in {}", s.views, out.display());
        }
        Ok(Outcome::Done)
    }
}

impl Eval {
    /// Scores of a run of the object model.
    fn object(&self) -> Result<Outcome> {
        let (model, capture, notes) = object::recipe::load(&self.run)?;
        notes.iter().for_each(|n| note(n));
        let out = self.out.clone().unwrap_or_else(|| self.run.join("eval"));
        std::fs::create_dir_all(&out).map_err(DataError::io(&out, "create"))?;
        let look = &mut |name: &str, image: &ImageU8| Ok(photo::save_png(&out.join(format!("{name}.png")), image)?);
        let scores = object::scores::judge(&model, &capture, SAMPLES, look)?;
        if self.json {
            println!("{}", serde_json::to_string(&scores).expect("plain values"));
        } else {
            super::object::print(&scores);
            println!("{} views in {}", scores.views, out.display());
        }
        Ok(Outcome::Done)
    }
}

/// Rows of pictures of one size.
fn rows(of: &[&[ImageU8]]) -> ImageU8 {
    let (w, h, n) = (of[0][0].width, of[0][0].height, of[0].len());
    let pixel = |x: usize, y: usize| {
        let image = &of[y / h][x / w];
        let at = image.channels * ((y % h) * w + x % w);
        [image.data[at], image.data[at + 1], image.data[at + 2]]
    };
    let data = (0..h * of.len()).flat_map(|y| (0..w * n).flat_map(move |x| pixel(x, y))).collect();
    ImageU8 { width: w * n, height: h * of.len(), channels: 3, data }
}
