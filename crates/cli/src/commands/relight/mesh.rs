//! `diorama relight mesh`

use crate::commands::count::count;
use crate::commands::process::{INTERRUPT, note, usage, use_threads, watch_interrupts};
use crate::commands::{Outcome, Verb};
use crate::terminal::ShareShown;
use clap::Args;
use diorama_pipelines::Result;
use diorama_pipelines::relight::meshing::{self, MeshOptions, Meshed};
use diorama_pipelines::relight::outdoor::recipe;
use std::path::PathBuf;

/// Turn a trained scene into a GLB with its albedo as texture, without the light of the photographs
#[derive(Args, Clone, Debug)]
#[command(
    after_help = "Examples:\n  diorama relight mesh runs/site -o site.glb\n  diorama relight mesh runs/site --algo mt --target 500k --bake 4096 --lods 2 --quantize -o site.glb"
)]
pub struct Mesh {
    /// Folder of the run
    run: PathBuf,
    /// GLB to write
    #[arg(short, long, default_value = "site.glb")]
    out: PathBuf,
    /// mc (marching cubes) or mt (marching tetrahedra)
    #[arg(long, default_value = "mc")]
    algo: String,
    /// Cells along the longest side of the scene's box
    #[arg(long, default_value_t = 512)]
    resolution: usize,
    /// Density at the surface [default: of five, that whose mesh has the depth that the field renders]
    #[arg(long)]
    level: Option<f32>,
    /// on: vertices lie at the level between grid points; off: halfway, in stairs
    #[arg(long, default_value = "on")]
    interp: String,
    /// Most faces, such as 500k or 1.5M; 0: no limit
    #[arg(long, default_value = "500k")]
    target: String,
    /// Edge of the texture of the albedo, in texels
    #[arg(long, default_value_t = 2048)]
    bake: usize,
    /// Number of coarser copies (NAME.lod1.glb, …), each with a quarter of the faces
    #[arg(long, default_value_t = 0)]
    lods: usize,
    /// Store coordinates with 16 bits and normals with 8 (KHR_mesh_quantization)
    #[arg(long)]
    quantize: bool,
    /// Number of CPU threads [default: all]
    #[arg(long)]
    threads: Option<usize>,
    /// Print one JSON object on stdout
    #[arg(long)]
    json: bool,
}

impl Verb for Mesh {
    fn json(&self) -> bool {
        self.json
    }

    fn run(&self) -> Result<Outcome> {
        use_threads(self.threads)?;
        let options = self.options()?;
        let (model, notes) = recipe::load(&self.run)?;
        notes.iter().for_each(|n| note(n));
        watch_interrupts();
        let mut shown = ShareShown::new();
        let made = meshing::mesh(&model, &options, &INTERRUPT, &mut |stage, i, n| shown.show(i as f64 / n.max(1) as f64, stage))?;
        shown.finish();
        let Some(made) = made else { return Ok(Outcome::Interrupted) };
        made.notes.iter().for_each(|n| note(n));
        if self.json {
            println!("{}", serde_json::to_string(&made).expect("plain values"));
        } else {
            print(&made);
        }
        Ok(Outcome::Done)
    }
}

impl Mesh {
    fn options(&self) -> Result<MeshOptions> {
        let interpolate = match &self.interp[..] {
            "on" => true,
            "off" => false,
            other => return Err(usage(format!("interp {other:?}: expected on or off"))),
        };
        Ok(MeshOptions {
            out: self.out.clone(),
            method: self.algo.parse().map_err(|e: String| usage(e.replacen("extract", "algo", 1)))?,
            resolution: self.resolution,
            level: self.level,
            interpolate,
            target: count(&self.target)
                .ok_or_else(|| usage(format!("target {:?}: expected a number such as 500k or 1.5M", self.target)))?,
            bake: self.bake,
            lods: self.lods,
            quantize: self.quantize,
        })
    }
}

fn print(made: &Meshed) {
    println!(
        "{}: {} faces, {} vertices, {:.1} MB, of {} extracted at density {:.2}; removed: {} seen by fewer than 3 photographs, {} in small parts; {:.0} s",
        made.file.display(),
        made.faces,
        made.vertices,
        made.bytes as f64 / 1e6,
        made.extracted,
        made.level,
        made.removed.unseen,
        made.removed.small,
        made.seconds
    );
    if made.glass > 0 {
        println!("{} faces are glass", made.glass);
    }
    for c in &made.candidates {
        println!("density {:.2}: depth differs by {:.2} % from the rendered one", c.level, 100.0 * c.depth_error);
    }
    made.lods.iter().for_each(|f| println!("{}", f.display()));
}
