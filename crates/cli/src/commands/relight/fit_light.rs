//! `diorama relight fit-light`

use crate::commands::process::{INTERRUPT, note, usage, use_threads, watch_interrupts};
use crate::commands::{Outcome, Verb};
use crate::terminal::ShareShown;
use clap::Args;
use diorama_data::{photo, sh_text};
use diorama_geom::color::luminance;
use diorama_pipelines::Result;
use diorama_pipelines::relight::fit_light::{self, FitOptions, FittedLight};
use diorama_pipelines::relight::outdoor::recipe;
use std::path::PathBuf;

/// Find the light of a photograph that training never saw: spherical harmonics, and a sun where the run tells suns apart
#[derive(Args, Clone, Debug)]
#[command(
    after_help = "Examples:\n  diorama relight fit-light runs/site data/site/images/new.jpg -o light.txt\n  diorama relight fit-light runs/site new.jpg --camera pose.json --region left --pictures fit\n  diorama relight render runs/site --light light.txt"
)]
pub struct FitLight {
    /// Folder of the run
    run: PathBuf,
    /// The photograph
    photo: PathBuf,
    /// Camera that took it: a frame's name or number, or a transforms.json that lists the photograph [default: the frame of its name]
    #[arg(long, value_name = "FRAME|FILE.json")]
    camera: Option<String>,
    /// Part of the photograph that is fitted; the rest is scored: all, left, right, or x0,y0,x1,y1 in pixels
    #[arg(long, default_value = "all")]
    region: String,
    /// Fit and score surfaces that fewer than two training photographs show, too
    #[arg(long)]
    all_surfaces: bool,
    /// Nine rows of spherical harmonics and perhaps a sun, for --light of the other commands
    #[arg(short, long, default_value = "light.txt")]
    out: PathBuf,
    /// Folder for the photograph, the model's picture in its light and in the mean light of training, and which pixels are scored
    #[arg(long)]
    pictures: Option<PathBuf>,
    /// Number of CPU threads [default: all]
    #[arg(long)]
    threads: Option<usize>,
    /// Print one JSON object on stdout
    #[arg(long)]
    json: bool,
}

impl Verb for FitLight {
    fn json(&self) -> bool {
        self.json
    }

    fn run(&self) -> Result<Outcome> {
        use_threads(self.threads)?;
        let options = FitOptions {
            photo: self.photo.clone(),
            camera: self.camera.clone(),
            region: self.region.parse().map_err(usage)?,
            all_surfaces: self.all_surfaces,
        };
        let (model, notes) = recipe::load(&self.run)?;
        notes.iter().for_each(|n| note(n));
        watch_interrupts();
        let mut shown = ShareShown::new();
        let fitted = fit_light::fit(&model, &options, &INTERRUPT, &mut |s| shown.show(s, "light"))?;
        shown.finish();
        let Some(fitted) = fitted else { return Ok(Outcome::Interrupted) };
        sh_text::save(&self.out, &fitted.light, fitted.sun.as_ref())?;
        if let Some(folder) = &self.pictures {
            std::fs::create_dir_all(folder).map_err(diorama_data::DataError::io(folder, "create"))?;
            let all = [&fitted.photograph, &fitted.picture, &fitted.mean_picture, &fitted.scored];
            for (name, image) in ["photograph", "fitted", "mean_light", "scored"].into_iter().zip(all) {
                photo::save_png(&folder.join(format!("{name}.png")), image)?;
            }
        }
        self.print(&fitted);
        Ok(Outcome::Done)
    }
}

impl FitLight {
    fn print(&self, f: &FittedLight) {
        if self.json {
            println!(
                "{}",
                serde_json::json!({
                    "light": self.out, "sun": f.sun.map(|(d, e)| (d.to_array(), e)), "gain": f.gain, "pixels": f.pixels,
                    "fitted_psnr": f.fitted_psnr, "rest_psnr": f.rest_psnr,
                    "mean_light_fitted_psnr": f.mean_light_fitted_psnr, "mean_light_rest_psnr": f.mean_light_rest_psnr,
                    "alike_rest_psnr": f.alike_rest_psnr, "mean_light_alike_rest_psnr": f.mean_light_alike_rest_psnr,
                })
            );
            return;
        }
        println!(
            "fitted region: {:.2} dB (mean light of training: {:.2} dB), light {:.2} times as bright as the mean",
            f.fitted_psnr, f.mean_light_fitted_psnr, f.gain
        );
        if let (Some(rest), Some(mean)) = (f.rest_psnr, f.mean_light_rest_psnr) {
            println!("the rest: {rest:.2} dB (mean light of training: {mean:.2} dB)");
        }
        if let (Some(rest), Some(mean)) = (f.alike_rest_psnr, f.mean_light_alike_rest_psnr) {
            println!("of it, what looks like the model: {rest:.2} dB (mean light of training: {mean:.2} dB)");
        }
        if let Some((d, irradiance)) = f.sun {
            let (elevation, power) = (d.z.clamp(-1.0, 1.0).asin().to_degrees(), luminance(irradiance));
            println!("a sun {elevation:.0}° above the horizon, azimuth {:.0}°, irradiance {power:.2}", d.x.atan2(d.y).to_degrees());
        }
        println!("{}", self.out.display());
    }
}
