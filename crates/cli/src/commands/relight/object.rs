//! `diorama relight object`

use super::from_run::Source;
use crate::commands::process::{INTERRUPT, discard, note, usage, use_threads, watch_interrupts};
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
    after_help = "Examples:\n  diorama relight object data/chair -o chair.glb\n  diorama relight object --from-run runs/chair -o chair.glb\n  diorama relight object --resume --run runs/chair -o chair.glb"
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
    pub texture: Option<usize>,
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
    /// Begin from a run of `diorama train`: its poses, its mesh, and photographs without masks, cut out where its mesh covers them
    #[arg(long, value_name = "RUN")]
    from_run: Option<PathBuf>,
    /// Box of the object in that run, x0,y0,z0,x1,y1,z1 (the input's frame), or auto [default: the crop box saved in the viewer, else auto: what most cameras look at]
    #[arg(long, allow_hyphen_values = true, requires = "from_run")]
    clip: Option<String>,
    /// Cells along that box's longest side [default: 320]
    #[arg(long, requires = "from_run")]
    resolution: Option<usize>,
    /// Largest number of faces of that run's mesh; 0 keeps all [default: 24 for each squared cell of the grid, 16224 for --grid 64]
    #[arg(long, requires = "from_run")]
    faces: Option<usize>,
    /// Device that samples that run: auto, cpu, cuda, vulkan, metal or webgpu
    #[arg(long, default_value = "auto", requires = "from_run")]
    device: String,
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
    pub force: bool,
    /// Samples per pixel of path-traced scores; 0: no scores
    #[arg(long, default_value_t = 32)]
    score_spp: u32,
    /// Number of CPU threads [default: all]
    #[arg(long)]
    threads: Option<usize>,
    /// Print one JSON object on stdout
    #[arg(long)]
    pub json: bool,
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
    /// # Errors
    /// When options exclude each other.
    fn check(&self) -> Result<()> {
        if self.out.extension().is_none_or(|e| !e.eq_ignore_ascii_case("glb")) {
            return Err(usage(format!("out {}: objects are written as .glb", self.out.display())));
        }
        let excluded = [
            (self.data.is_some(), "the run knows its photographs; leave out the folder"),
            (self.resume, "a run that is resumed has kept what it began from; leave out one of --from-run and --resume"),
            (self.base.is_some(), "the run gives the mesh; leave out one of --from-run and --base"),
        ];
        if let Some((_, why)) = excluded.iter().find(|(is_given, _)| self.from_run.is_some() && *is_given) {
            return Err(usage(format!("from-run: {why}")));
        }
        Ok(())
    }

    fn config(&self, begun: Option<Config>) -> Result<Config> {
        let mut config = match (begun, &self.data) {
            (Some(_), Some(_)) => return Err(PipelineError::Usage("--resume: the run knows its capture; leave out the folder".into())),
            (None, None) if self.from_run.is_some() => Config::new(self.preset, PathBuf::new()),
            (None, None) => return Err(PipelineError::Usage("give the folder of a capture, --from-run or --resume".into())),
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
        self.check()?;
        let opened = if self.resume { Some(RunFolder::open(&self.run)?) } else { None };
        let (folder, begun) = match opened {
            Some((folder, description)) => (Some(folder), Some(description.config::<Config>()?)),
            None => (None, None),
        };
        let mut config = self.config(begun)?;
        watch_interrupts();
        let existed = self.run.exists();
        // Nothing is written before the request is known to be sound.
        let (mut folder, imported) = match (folder, self.source()) {
            (Some(folder), _) => {
                let capture = folder.capture()?;
                (folder, capture)
            }
            (None, Some(source)) => match source.begin(&mut config, &self.run, self.force)? {
                Some(begun) => begun,
                None => {
                    note("stopped before training began; nothing is kept");
                    return Ok(Outcome::Interrupted);
                }
            },
            (None, None) => {
                let imported = capture::import(&config)?;
                capture::load(&config, &imported)?;
                (RunFolder::create(&self.run, self.force)?, imported)
            }
        };
        let mut progress = Progress::new();
        let trained = recipe::train(&config, &imported, &mut folder, self.resume, &INTERRUPT, &mut |e| progress.event(e));
        if trained.is_err() && !existed && !folder.checkpoints().exists() {
            // A run that never started leaves nothing behind.
            drop(folder);
            discard(&self.run);
        }
        let trained = trained?;
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
    /// The materials of a run of the object application, as `diorama export --materials` asks for them.
    pub fn of_run(source: &Source, run: PathBuf, out: PathBuf) -> Object {
        Object {
            data: None,
            preset: Preset::Fast,
            out,
            run,
            grid: None,
            texture: None,
            steps: None,
            mc: false,
            fixed_light: None,
            base: None,
            from_run: Some(source.run.to_path_buf()),
            clip: source.clip.map(str::to_string),
            resolution: source.resolution,
            faces: source.faces,
            device: source.device.to_string(),
            seed: None,
            set: Vec::new(),
            resume: false,
            force: false,
            score_spp: 0,
            threads: None,
            json: false,
        }
    }

    /// The run to begin from.
    fn source(&self) -> Option<Source<'_>> {
        let run = self.from_run.as_deref()?;
        Some(Source { run, clip: self.clip.as_deref(), resolution: self.resolution, faces: self.faces, device: &self.device })
    }

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
