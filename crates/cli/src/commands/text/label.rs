//! `diorama text label`

use crate::commands::process::{INTERRUPT, note, usage, use_threads, watch_interrupts};
use crate::commands::{Outcome, Verb};
use crate::terminal::ShareShown;
use clap::Args;
use diorama_data::text_set::SetFormat;
use diorama_pipelines::text::label::fitting::{Extent, FitOptions};
use diorama_pipelines::text::label::{self, Cameras, LabelOptions, Labeler};
use diorama_pipelines::text::surface::Wanted;
use diorama_pipelines::{PipelineError, Result};
use std::path::PathBuf;

/// Find the text regions of a run in space, and label its photographs or any other views of it
#[derive(Args, Clone, Debug)]
#[command(
    after_help = "Examples:\n  diorama text label runs/room\n  diorama text label runs/room --formats icdar15,mmocr,coco -o data/room-labels\n  diorama text label runs/room --cameras camera_path.json --surface plane"
)]
pub struct Label {
    /// Folder of the run
    run: PathBuf,
    /// What carries labels to views: field (regions in space), or stereo (a homography from a labelled photograph, without poses)
    #[arg(long, default_value = "field")]
    labeler: String,
    /// Surface of the regions: auto (a quadric where it fits much better than a plane), plane or quadric [default: auto]
    #[arg(long, value_name = "SURFACE")]
    surface: Option<String>,
    /// What the sides of regions follow: labels (the outlines that were labelled), or points (of the learned class) [default: labels]
    #[arg(long, value_name = "EXTENT")]
    extent: Option<String>,
    /// Views to be labelled: all, training or held-out photographs, or a camera_path.json, whose views are rendered
    #[arg(long, default_value = "all")]
    cameras: String,
    /// icdar13, icdar15, mlt17, ppocr, mmocr, doctr, coco, cocotext, textocr, textnerf
    #[arg(long, value_delimiter = ',', default_value = "icdar15")]
    formats: Vec<String>,
    /// Folder for images and labels [default: RUN/labels]
    #[arg(short, long)]
    out: Option<PathBuf>,
    /// Replace earlier labels
    #[arg(long)]
    force: bool,
    /// Where the photographs are now
    #[arg(long)]
    data: Option<PathBuf>,
    /// Number of CPU threads [default: all]
    #[arg(long)]
    threads: Option<usize>,
    /// Print one JSON object on stdout
    #[arg(long)]
    json: bool,
}

/// Formats of a data set by name.
pub fn formats(names: &[String]) -> Result<Vec<SetFormat>> {
    let all = || SetFormat::ALL.map(SetFormat::name).join(", ");
    names.iter().map(|n| SetFormat::named(n).ok_or_else(|| usage(format!("format {n:?}: expected {}", all())))).collect()
}

impl Label {
    fn options(&self) -> Result<LabelOptions> {
        let surface = match self.surface.as_deref().unwrap_or("auto") {
            "auto" => Wanted::Auto,
            "plane" => Wanted::Plane,
            "quadric" => Wanted::Quadric,
            other => return Err(usage(format!("surface {other:?}: expected auto, plane or quadric"))),
        };
        let extent = match self.extent.as_deref().unwrap_or("labels") {
            "labels" => Extent::Labels,
            "points" => Extent::Points,
            other => return Err(usage(format!("extent {other:?}: expected labels or points"))),
        };
        let cameras = match &self.cameras[..] {
            "all" => Cameras::All,
            "training" => Cameras::Training,
            "held-out" => Cameras::HeldOut,
            file => Cameras::File(PathBuf::from(file)),
        };
        let out = self.out.clone().unwrap_or_else(|| self.run.join("labels"));
        let labeler = match &self.labeler[..] {
            "field" => Labeler::Surfaces(FitOptions { surface, extent }),
            "stereo" if self.surface.is_some() || self.extent.is_some() => {
                return Err(usage("--labeler stereo has no surfaces; leave --surface and --extent out".into()));
            }
            "stereo" => Labeler::Stereo,
            other => return Err(usage(format!("labeler {other:?}: expected field or stereo"))),
        };
        Ok(LabelOptions { labeler, cameras, formats: formats(&self.formats)?, out })
    }
}

impl Verb for Label {
    fn json(&self) -> bool {
        self.json
    }

    fn run(&self) -> Result<Outcome> {
        use_threads(self.threads)?;
        let options = self.options()?;
        if options.out.join(diorama_data::text_set::ANNOTATIONS).exists() && !self.force {
            let out = options.out.display();
            return Err(PipelineError::Usage(format!("{out}: holds labels already; give --force to replace them, or another --out")));
        }
        watch_interrupts();
        let mut shown = ShareShown::new();
        let done = label::label(&self.run, self.data.as_deref(), &options, &INTERRUPT, &mut |s, what| shown.show(s, what))?;
        shown.finish();
        done.notes.iter().for_each(|n| note(n));
        if self.json {
            println!("{}", serde_json::to_string(&done).expect("plain values"));
        } else if !done.interrupted {
            if self.labeler == "field" {
                println!("{} regions, {} without a surface", done.regions, done.without_surface);
            }
            println!("{} images, {} words, {} not to be read", done.images, done.words, done.unreadable);
            if let Some(a) = &done.accuracy {
                let corners = a.corner_error_px.map(|v| format!("corners {v:.2} px, ")).unwrap_or_default();
                let poses = a.pose_error_deg.map(|v| format!("pose {v:.1}°, ")).unwrap_or_default();
                println!("against the truth: {corners}{poses}visibility {:.3}", a.visibility_error);
            }
            println!("{}", options.out.display());
        }
        if done.interrupted {
            note("interrupted: the same command begins anew");
            return Ok(Outcome::Interrupted);
        }
        Ok(Outcome::Done)
    }
}
