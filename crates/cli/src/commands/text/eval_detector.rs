//! `diorama text eval-detector`

use crate::commands::process::{INTERRUPT, use_threads, watch_interrupts};
use crate::commands::{Outcome, Verb};
use crate::terminal::Progress;
use clap::Args;
use diorama_engine::train::Event;
use diorama_pipelines::run::config;
use diorama_pipelines::text::detectors::config::{Backbone, Kind};
use diorama_pipelines::text::detectors::evaluation::Score;
use diorama_pipelines::text::detectors::judge::{self, Judged};
use diorama_pipelines::text::detectors::recipe;
use diorama_pipelines::{PipelineError, Result};
use std::path::PathBuf;

/// Score a detector of writing on labelled images, or write it as ONNX
#[derive(Args, Clone, Debug)]
#[command(
    after_help = "Examples:\n  diorama text eval-detector --weights runs/db --data ds/test --by-scene --by-pose\n  diorama text eval-detector --model db --backbone tiny --weights db.safetensors --onnx db.onnx"
)]
pub struct EvalDetector {
    /// Run folder, or file of weights
    #[arg(long)]
    weights: PathBuf,
    /// east or db [default: what the weights say]
    #[arg(long)]
    model: Option<String>,
    /// tiny or resnet50 [default: what the weights say]
    #[arg(long)]
    backbone: Option<String>,
    /// Folder with images/ and, for each image, icdar15/gt_NAME.txt
    #[arg(long, required_unless_present = "onnx")]
    data: Option<PathBuf>,
    /// List the scores of each scene
    #[arg(long)]
    by_scene: bool,
    /// List the scores of each cluster of poses
    #[arg(long)]
    by_pose: bool,
    /// Write the network as ONNX: from sRGB from 0 to 1, sides multiples of 32, to its maps
    #[arg(long)]
    onnx: Option<PathBuf>,
    /// KEY=VALUE of the configuration, such as decode.db.score=0.5; may be repeated
    #[arg(long)]
    set: Vec<String>,
    /// Number of CPU threads [default: all]
    #[arg(long)]
    threads: Option<usize>,
    /// Print one JSON object on stdout
    #[arg(long)]
    json: bool,
}

impl EvalDetector {
    fn print(&self, judged: &Judged) {
        let e = &judged.evaluation;
        let line = |name: &str, s: &Score| {
            println!("{name:<20} precision {:.4}  recall {:.4}  F {:.4}", s.precision, s.recall, s.f);
        };
        println!("{} images, {} words, {} detections, {:.2} images/s", e.images, e.labels, e.detections, judged.images_per_s);
        line("instances", &e.instance);
        line("scenes", &e.scene);
        line("DetEval", &judged.det_eval);
        if self.by_scene {
            e.scenes.iter().for_each(|s| line(&s.scene, &s.score));
        }
        if self.by_pose {
            e.clusters.iter().for_each(|c| line(&format!("cluster {} ({})", c.cluster, c.labels), &c.score));
        }
    }

    fn json_of(&self, judged: Option<&Judged>) -> serde_json::Value {
        let mut out = serde_json::json!({ "onnx": self.onnx });
        if let Some(judged) = judged {
            out = serde_json::to_value(judged).expect("plain values");
            for (key, is_wanted) in [("scenes", self.by_scene), ("clusters", self.by_pose)] {
                if let (false, Some(table)) = (is_wanted, out.as_object_mut()) {
                    table.remove(key);
                }
            }
            out["onnx"] = serde_json::json!(self.onnx);
        }
        out
    }
}

impl Verb for EvalDetector {
    fn json(&self) -> bool {
        self.json
    }

    fn run(&self) -> Result<Outcome> {
        use_threads(self.threads)?;
        if self.data.is_none() && (self.by_scene || self.by_pose) {
            return Err(PipelineError::Usage("--by-scene, --by-pose: give --data".into()));
        }
        let model = self.model.as_deref().map(Kind::named).transpose()?;
        let backbone = self.backbone.as_deref().map(Backbone::named).transpose()?;
        let (detector, mut config) = recipe::open(&self.weights, model, backbone)?;
        config::set_all(&mut config, &self.set)?;
        let mut judged = None;
        if let Some(data) = &self.data {
            let mut set = recipe::labelled(data)?;
            if self.by_pose {
                judge::find_clusters(&mut set, data, config.seed)?;
            }
            watch_interrupts();
            let (mut progress, n) = (Progress::new(), set.len());
            let mut look = |i: usize| progress.event(&Event::Preparing { what: "detecting", share: i as f64 / n as f64 });
            judged = judge::judge(&detector, &config, &set, &INTERRUPT, &mut look)?;
            if judged.is_none() {
                return Ok(Outcome::Interrupted);
            }
        }
        if let Some(file) = &self.onnx {
            recipe::write_onnx(&detector, &config, file)?;
        }
        if self.json {
            println!("{}", self.json_of(judged.as_ref()));
        } else {
            judged.iter().for_each(|j| self.print(j));
            self.onnx.iter().for_each(|f| println!("{}", f.display()));
        }
        Ok(Outcome::Done)
    }
}
