//! `diorama relight scenario`

use crate::commands::process::{INTERRUPT, note, use_threads, watch_interrupts};
use crate::commands::{Outcome, Verb};
use crate::terminal::ShareShown;
use clap::Args;
use diorama_pipelines::relight::scenario::{self, Scenario as Kind, ScenarioOptions};
use diorama_pipelines::relight::{compose, path_tracer::PathTracer, picture, scene_file};
use diorama_pipelines::{PipelineError, Result};
use std::path::PathBuf;
use std::time::Instant;

/// Compose an object in a place, each synthetic or photographed, on generated data or your own
#[derive(Args, Clone, Debug)]
#[command(
    after_help = "Scenarios: synthetic-in-synthetic, synthetic-in-real, real-in-synthetic, real-in-real\n\nExamples:\n  diorama relight scenario synthetic-in-synthetic -o out\n  diorama relight scenario real-in-real --site site.glb --frame runs/site:12 --object chair.glb --light dusk.hdr -o out\n\nThe folder's scene.toml is kept: change it and run the command again, or `diorama relight compose`."
)]
pub struct Scenario {
    /// Which one
    name: String,
    /// Model of the place [default: a generated street]
    #[arg(long)]
    site: Option<PathBuf>,
    /// Photograph of the place that --site is a mesh of, RUN:NUMBER: its camera, and in real places the picture [default: of the generated street]
    #[arg(long)]
    frame: Option<String>,
    /// Model of the object [default: a generated chair]
    #[arg(long)]
    object: Option<PathBuf>,
    /// Environment map [default: a clear sky]
    #[arg(long)]
    light: Option<PathBuf>,
    /// Turn of the light about the vertical in degrees, counterclockwise from above
    #[arg(long, default_value_t = 0.0, allow_hyphen_values = true)]
    rotate: f64,
    /// Factor of the object's size [default: 1 for generated data, else a third of the picture's height]
    #[arg(long)]
    scale: Option<f64>,
    /// WIDTHxHEIGHT
    #[arg(long, default_value = "640x360")]
    size: String,
    /// Samples per pixel
    #[arg(long, default_value_t = 64)]
    spp: u32,
    /// Folder for scene.toml, generated models and composed.png
    #[arg(short, long, default_value = "scenario")]
    out: PathBuf,
    /// Replace the description and the picture
    #[arg(long)]
    force: bool,
    /// Number of CPU threads [default: all]
    #[arg(long)]
    threads: Option<usize>,
    /// Print one JSON object on stdout
    #[arg(long)]
    json: bool,
}

impl Verb for Scenario {
    fn json(&self) -> bool {
        self.json
    }

    fn run(&self) -> Result<Outcome> {
        use_threads(self.threads)?;
        let kind = Kind::named(&self.name)?;
        if self.spp == 0 || self.scale.is_some_and(|s| !(s.is_finite() && s > 0.0)) {
            return Err(PipelineError::Usage("--spp: must be at least 1; --scale: above 0".into()));
        }
        let options = ScenarioOptions {
            site: self.site.clone(),
            object: self.object.clone(),
            frame: self.frame.clone(),
            hdri: self.light.clone(),
            rotate_deg: self.rotate,
            scale: self.scale,
            size: crate::commands::render::parse_size(&self.size)?,
            samples: self.spp,
        };
        watch_interrupts();
        let start = Instant::now();
        let (description, interrupted) = scenario::prepare(&self.out, &kind, &options, self.force, &INTERRUPT)?;
        if interrupted {
            return Ok(Outcome::Interrupted);
        }
        let file = scene_file::read(&description)?;
        let (picture, mut composition) = (self.out.join("composed.png"), compose::load(&file)?);
        composition.notes.iter().for_each(|n| note(n));
        let (kept, mut shown) = (picture::kept_beside(&picture), ShareShown::new());
        let composed =
            compose::render(&mut composition, &file, &mut PathTracer::cpu(), &kept, &INTERRUPT, &mut |s| shown.show(s, &self.name))?;
        shown.finish();
        if composed.interrupted {
            eprintln!("interrupted: the unfinished picture is in {}; the same command without --force goes on", kept.display());
            return Ok(Outcome::Interrupted);
        }
        picture::save(&picture, &composed.rgba, file.render.exposure)?;
        picture::discard(&kept)?;
        let (seconds, triangles) = (start.elapsed().as_secs_f64(), composition.scene.triangles());
        if self.json {
            let told = serde_json::json!({ "scenario": kind.name, "thesis": kind.thesis, "scene": description, "picture": picture, "triangles": triangles, "seconds": seconds });
            println!("{told}");
        } else {
            println!("{triangles} triangles in {seconds:.1} s");
            println!("thesis     {}", kind.thesis);
            println!("{}\n{}", description.display(), picture.display());
        }
        Ok(Outcome::Done)
    }
}
