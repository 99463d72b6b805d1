//! `diorama relight compose`

use crate::commands::process::{INTERRUPT, note, use_threads, watch_interrupts};
use crate::commands::{Outcome, Verb};
use crate::terminal::ShareShown;
use clap::Args;
use diorama_pipelines::relight::scene_file::Denoise;
use diorama_pipelines::relight::{compose, export_blender, path_tracer::PathTracer, picture, scene_file};
use diorama_pipelines::{PipelineError, Result};
use std::path::PathBuf;
use std::time::Instant;

/// Render models in a scene under one light, or in a photograph
#[derive(Args, Clone, Debug)]
#[command(
    after_help = "Examples:\n  diorama relight compose scene.toml --spp 1024 -o final.exr\n  diorama relight compose scene.toml --spp 64 --denoise atrous -o draft.png\n\nAn interrupted picture goes on with the same command."
)]
pub struct Compose {
    /// Description of the composition (.toml)
    scene: PathBuf,
    /// Picture: .exr (linear light) or .png
    #[arg(short, long, default_value = "composed.png")]
    out: PathBuf,
    /// Samples per pixel [default: that of the description]
    #[arg(long)]
    spp: Option<u32>,
    /// WIDTHxHEIGHT [default: that of the description]
    #[arg(long)]
    size: Option<String>,
    /// auto, cpu, cuda, vulkan, metal or webgpu
    #[arg(long, default_value = "auto")]
    device: String,
    /// off or atrous [default: that of the description]
    #[arg(long)]
    denoise: Option<String>,
    /// Also write the composition for Blender: model, light, and a script that opens them
    #[arg(long, value_name = "DIR")]
    export_blender: Option<PathBuf>,
    /// Replace the picture
    #[arg(long)]
    force: bool,
    /// Number of CPU threads [default: all]
    #[arg(long)]
    threads: Option<usize>,
    /// Print one JSON object on stdout
    #[arg(long)]
    json: bool,
}

impl Verb for Compose {
    fn json(&self) -> bool {
        self.json
    }

    fn run(&self) -> Result<Outcome> {
        use_threads(self.threads)?;
        let file = self.description()?;
        picture::PictureFormat::of(&self.out)?;
        if self.out.exists() && !self.force {
            return Err(PipelineError::Usage(format!("{}: exists; give --force to replace it", self.out.display())));
        }
        if let Some(folder) = self.out.parent().filter(|f| !f.as_os_str().is_empty() && !f.is_dir()) {
            return Err(PipelineError::Usage(format!("{}: no such folder; make it, or give another --out", folder.display())));
        }
        watch_interrupts();
        let mut tracer = PathTracer::open(&self.device, Box::new(note))?;
        let mut composition = compose::load(&file)?;
        composition.notes.iter().for_each(|n| note(n));
        picture::require_memory(&composition.view.camera)?;
        if let Some(folder) = &self.export_blender {
            export_blender::write(folder, &composition, &file, self.force)?.iter().for_each(|n| note(n));
            note(&format!("to render it with Cycles: {}", export_blender::hint(folder)));
        }
        let (start, kept) = (Instant::now(), picture::kept_beside(&self.out));
        let mut shown = ShareShown::new();
        let text = format!("{} triangles, {} samples per pixel", composition.scene.triangles(), file.render.spp);
        let composed = compose::render(&mut composition, &file, &mut tracer, &kept, &INTERRUPT, &mut |s| shown.show(s, &text))?;
        shown.finish();
        if composed.interrupted {
            eprintln!("interrupted: the unfinished picture is in {}; the same command goes on", kept.display());
            return Ok(Outcome::Interrupted);
        }
        let stops = picture::save(&self.out, &composed.rgba, file.render.exposure)?;
        picture::discard(&kept)?;
        let seconds = start.elapsed().as_secs_f64();
        let size = [composed.rgba.width, composed.rgba.height];
        if self.json {
            println!(
                "{}",
                serde_json::json!({ "picture": self.out, "size": size, "spp": file.render.spp, "triangles": composition.scene.triangles(), "device": tracer.name(), "seconds": seconds, "exposure": stops })
            );
        } else {
            println!("{} × {} pixels, {} samples each, in {seconds:.1} s ({})", size[0], size[1], file.render.spp, tracer.name());
            stops.iter().for_each(|s| println!("exposure   {s:+.2} stops"));
            println!("{}", self.out.display());
        }
        Ok(Outcome::Done)
    }
}

impl Compose {
    /// The description with the command's own values.
    fn description(&self) -> Result<scene_file::SceneFile> {
        let mut file = scene_file::read(&self.scene)?;
        if let Some(spp) = self.spp {
            if spp == 0 {
                return Err(PipelineError::Usage("--spp: must be at least 1".into()));
            }
            file.render.spp = spp;
        }
        if let Some(size) = &self.size {
            file.render.size = Some(crate::commands::render::parse_size(size)?.into());
        }
        match self.denoise.as_deref() {
            None => {}
            Some("off") => file.render.denoise = Denoise::Off,
            Some("atrous") => file.render.denoise = Denoise::Atrous,
            Some(other) => return Err(PipelineError::Usage(format!("--denoise {other:?}: expected off or atrous"))),
        }
        Ok(file)
    }
}
