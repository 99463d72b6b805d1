//! `diorama relight object`

use crate::commands::process::{INTERRUPT, note, usage, use_threads, watch_interrupts};
use crate::commands::{Outcome, Verb};
use crate::terminal::Progress;
use clap::Args;
use diorama_data::{DataError, photo};
use diorama_pipelines::relight::object::capture;
use diorama_pipelines::relight::object::config::{Config, Preset};
use diorama_pipelines::relight::object::recipe::{self, Trained};
use diorama_pipelines::relight::object::scores::{self, ObjectScores};
use diorama_pipelines::run::{RunFolder, config};
use diorama_pipelines::{PipelineError, Result};
use std::path::PathBuf;

/// Turn photographs of an object with opacity into a mesh with materials, and the light it stood in
#[derive(Args, Clone, Debug)]
#[command(
    after_help = "Examples:\n  diorama relight object data/chair -o chair.glb\n  diorama relight object --resume --run runs/chair -o chair.glb"
)]
pub struct Object {
    /// Folder of the capture: RGBA photographs or masks, and poses
    data: Option<PathBuf>,
    /// ci or fast
    #[arg(long, default_value = "fast")]
    preset: Preset,
    /// File of the object; its light is written beside it as NAME.probe.hdr
    #[arg(short, long, default_value = "object.glb")]
    out: PathBuf,
    /// Run folder
    #[arg(long, default_value = "runs/object")]
    run: PathBuf,
    /// Tetrahedral grid: 32, 64 or 128 [default: by preset]
    #[arg(long)]
    grid: Option<u32>,
    /// Edge of the textures in texels [default: by preset]
    #[arg(long)]
    texture: Option<usize>,
    /// Steps of each stage [default: by preset]
    #[arg(long)]
    steps: Option<u64>,
    /// Add a third stage of as many steps, with traced shadows and light between surfaces; it tells base color from light better
    #[arg(long)]
    mc: bool,
    /// Environment map of the photographs, which is not learned then
    #[arg(long, value_name = "FILE")]
    fixed_light: Option<PathBuf>,
    /// Mesh to begin with, in the capture's coordinates; its triangles are kept
    #[arg(long, value_name = "FILE")]
    base: Option<PathBuf>,
    #[arg(long)]
    seed: Option<u64>,
    /// KEY=VALUE of the configuration; may be repeated
    #[arg(long)]
    set: Vec<String>,
    /// Go on from the last checkpoint
    #[arg(long)]
    resume: bool,
    /// Replace an earlier run
    #[arg(long)]
    force: bool,
    /// Samples per pixel of path-traced scores; 0: no scores
    #[arg(long, default_value_t = 32)]
    score_spp: u32,
    /// Number of CPU threads [default: all]
    #[arg(long)]
    threads: Option<usize>,
    /// Print one JSON object on stdout
    #[arg(long)]
    json: bool,
}

/// Cubes of the lattice that has about as many tetrahedra as a grid of the usual names.
fn cells(grid: u32) -> Result<usize> {
    match grid {
        32 => Ok(13),
        64 => Ok(26),
        128 => Ok(52),
        _ => Err(usage(format!("grid {grid}: expected 32, 64 or 128; other sizes with --set grid.cells=N"))),
    }
}

impl Object {
    fn config(&self, begun: Option<Config>) -> Result<Config> {
        let mut config = match (begun, &self.data) {
            (Some(_), Some(_)) => return Err(PipelineError::Usage("--resume: the run knows its capture; leave out the folder".into())),
            (None, None) => return Err(PipelineError::Usage("give the folder of a capture, or --resume".into())),
            (Some(config), None) => {
                let fixed =
                    [self.grid.is_some(), self.texture.is_some(), self.steps.is_some(), self.base.is_some(), self.fixed_light.is_some()];
                if fixed.contains(&true) || self.seed.is_some() || self.mc || !self.set.is_empty() {
                    return Err(PipelineError::Usage("--resume: the run has its configuration; leave out what would change it".into()));
                }
                return Ok(config);
            }
            (None, Some(data)) => Config::new(self.preset, data.clone()),
        };
        if let Some(grid) = self.grid {
            config.grid.cells = cells(grid)?;
        }
        self.texture.iter().for_each(|t| config.material.texture = *t);
        self.steps.iter().for_each(|s| (config.run.topology_steps, config.run.texture_steps) = (*s, *s));
        if self.mc {
            config.run.traced_steps = config.run.texture_steps;
        }
        self.seed.iter().for_each(|s| config.seed = *s);
        for (name, file, into) in [("base", &self.base, &mut config.base_mesh), ("fixed-light", &self.fixed_light, &mut config.light.fixed)]
        {
            if let Some(file) = file {
                if !file.is_file() {
                    return Err(usage(format!("{name} {}: there is no such file", file.display())));
                }
                *into = std::path::absolute(file).unwrap_or_else(|_| file.clone());
            }
        }
        config::set_all(&mut config, &self.set)?;
        diorama_pipelines::run::config::Configuration::check(&config)?;
        Ok(config)
    }
}

impl Verb for Object {
    fn json(&self) -> bool {
        self.json
    }

    fn run(&self) -> Result<Outcome> {
        use_threads(self.threads)?;
        if self.out.extension().is_none_or(|e| !e.eq_ignore_ascii_case("glb")) {
            return Err(usage(format!("out {}: objects are written as .glb", self.out.display())));
        }
        let opened = if self.resume { Some(RunFolder::open(&self.run)?) } else { None };
        let (folder, begun) = match opened {
            Some((folder, description)) => (Some(folder), Some(description.config::<Config>()?)),
            None => (None, None),
        };
        let config = self.config(begun)?;
        // Nothing is written before the request is known to be sound.
        let (mut folder, imported) = match folder {
            Some(folder) => {
                let capture = folder.capture()?;
                (folder, capture)
            }
            None => {
                let imported = capture::import(&config)?;
                capture::load(&config, &imported)?;
                (RunFolder::create(&self.run, self.force)?, imported)
            }
        };
        watch_interrupts();
        let mut progress = Progress::new();
        let trained = recipe::train(&config, &imported, &mut folder, self.resume, &INTERRUPT, &mut |e| progress.event(e))?;
        if trained.summary.interrupted {
            note(&format!("stopped at step {}; go on with --resume --run {}", trained.summary.step, self.run.display()));
            return Ok(Outcome::Interrupted);
        }
        let probe = recipe::export(&trained.model, &self.out)?;
        let scores = self.scores(&trained)?;
        let s = &trained.summary;
        if self.json {
            let value = serde_json::json!({
                "glb": self.out, "probe": probe, "run": self.run, "steps": s.step, "seconds": s.seconds, "scores": scores,
            });
            println!("{value}");
        } else {
            println!("{} steps in {:.0} s", s.step, s.seconds);
            scores.iter().for_each(print);
            println!("{}", self.out.display());
            println!("{}", probe.display());
        }
        Ok(Outcome::Done)
    }
}

impl Object {
    /// Scores on what was held out, with pictures in the run's folder.
    fn scores(&self, trained: &Trained) -> Result<Option<ObjectScores>> {
        use diorama_geom::capture::Split;
        if self.score_spp == 0 || trained.capture.indices(Split::Test).is_empty() {
            return Ok(None);
        }
        let folder = self.run.join("eval");
        std::fs::create_dir_all(&folder).map_err(DataError::io(&folder, "create"))?;
        let look = &mut |name: &str, image: &diorama_geom::ImageU8| Ok(photo::save_png(&folder.join(format!("{name}.png")), image)?);
        Ok(Some(scores::judge(&trained.model, &trained.capture, self.score_spp, look)?))
    }
}

/// Scores in words.
pub fn print(s: &ObjectScores) {
    println!(
        "held out         {:.2} dB, path-traced {:.2} dB ({} views, {} triangles)",
        s.object_psnr, s.object_traced_psnr, s.views, s.faces
    );
    if let Some(t) = &s.truth {
        println!(
            "unseen light     {:.2} dB, path-traced {:.2} dB; after a factor per channel {:.2} and {:.2} dB",
            t.object_relight_psnr, t.object_relight_traced_psnr, t.object_relight_scaled_psnr, t.object_relight_traced_scaled_psnr
        );
        println!("base color       {:.2} dB after a factor per channel", t.base_color_psnr);
        println!("shape            {:.3} % of the diagonal", 100.0 * t.chamfer);
    }
}
