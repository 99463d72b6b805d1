//! `diorama view`

use super::process::{INTERRUPT, note, use_threads, watch_interrupts};
use super::{Outcome, Verb};
use clap::Args;
use diorama_data::import::{self, ImportOptions};
use diorama_geom::view_source::ViewSource;
use diorama_pipelines::object::viewing::{self, RunView};
use diorama_pipelines::object::{device, run_folder};
use diorama_pipelines::relight::outdoor;
use diorama_pipelines::run::viewing_points::PointsView;
use diorama_pipelines::run::{description, folder, kept_capture};
use diorama_pipelines::text;
use diorama_pipelines::{Application, PipelineError, Result};
use diorama_viewer::{Server, ViewerOptions};
use std::net::IpAddr;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

/// Address of the viewer: options of `view`, and of `train --view`.
#[derive(Args, Clone, Debug)]
pub struct ListenFlags {
    /// Address to listen on; except for 127.0.0.1, a token is required, which is part of the printed address
    #[arg(long, default_value = "127.0.0.1")]
    pub host: IpAddr,
    /// 0: any free port
    #[arg(long, default_value_t = 7007)]
    pub port: u16,
}

impl ListenFlags {
    /// Binds a server that does not serve yet.
    ///
    /// # Errors
    /// If the address cannot be bound.
    pub fn bind(&self, source: Arc<dyn ViewSource>) -> Result<Server> {
        Server::bind(&ViewerOptions { host: self.host, port: self.port }, source).map_err(|e| PipelineError::Usage(e.to_string()))
    }
}

/// Show a run in the browser: views, cameras, crop box, scale, camera paths, meshes; or a data set's cameras and points
#[derive(Args, Clone, Debug)]
#[command(
    after_help = "Examples:\n  diorama view runs/chair\n  diorama view data/chair\n  diorama view splats.ply\n  diorama view runs/street --light dusk.hdr\n  diorama view runs/chair --host 0.0.0.0 --port 8080"
)]
pub struct View {
    /// Folder of a run or of a data set, or a PLY file of points or Gaussian splats
    path: PathBuf,
    /// For a run: where its photographs are now, if they moved
    #[arg(long, value_name = "FOLDER")]
    data: Option<PathBuf>,
    /// auto, cpu, cuda, vulkan, metal or webgpu
    #[arg(long, default_value = "auto")]
    device: String,
    /// For a run of relight: a light to choose from, as an environment map or spherical harmonics; may be repeated
    #[arg(long, value_name = "FILE")]
    light: Vec<PathBuf>,
    #[command(flatten)]
    listen: ListenFlags,
    /// Number of CPU threads [default: all]
    #[arg(long)]
    threads: Option<usize>,
    /// Print the address as a JSON object on stdout
    #[arg(long)]
    json: bool,
}

impl Verb for View {
    fn json(&self) -> bool {
        self.json
    }

    fn run(&self) -> Result<Outcome> {
        use_threads(self.threads)?;
        let source = source(self)?;
        let server = self.listen.bind(source.shown())?;
        watch_interrupts();
        if self.json {
            println!("{}", serde_json::json!({ "address": server.address() }));
        } else {
            println!("{}", server.address());
        }
        eprintln!("open this address in a browser; press Ctrl-C to end");
        // If a device given by name fails, the viewer ends.
        std::thread::scope(|s| {
            s.spawn(|| {
                while !INTERRUPT.load(Ordering::Relaxed) {
                    std::thread::sleep(Duration::from_millis(100));
                    if source.check_device().is_err() {
                        INTERRUPT.store(true, Ordering::Relaxed);
                    }
                }
            });
            server.run(&INTERRUPT);
        });
        source.check_device().map(|()| Outcome::Done)
    }
}

enum Source {
    Run(Arc<RunView>),
    Scene(Arc<outdoor::viewing::RunView>),
    Text(Arc<text::viewing::RunView>),
    Points(Arc<PointsView>),
}

impl Source {
    fn shown(&self) -> Arc<dyn ViewSource> {
        match self {
            Source::Run(r) => r.clone(),
            Source::Scene(r) => r.clone(),
            Source::Text(r) => r.clone(),
            Source::Points(p) => p.clone(),
        }
    }

    /// The failure of a device that was given by name.
    fn check_device(&self) -> Result<()> {
        match self {
            Source::Run(r) => r.check_device(),
            Source::Scene(_) | Source::Text(_) | Source::Points(_) => Ok(()),
        }
    }
}

/// The view source: a run, a file of points or splats, or a data set.
fn source(a: &View) -> Result<Source> {
    let is_run = a.path.join(description::NAME).exists() || folder::checkpoints(&a.path).exists();
    if a.data.is_some() && !is_run {
        return Err(PipelineError::Usage(format!("--data: {} is not a run; give --data only for runs", a.path.display())));
    }
    let has_lights = is_run && Application::of_run(&a.path)? == Application::Relight;
    if !a.light.is_empty() && !has_lights {
        return Err(PipelineError::Usage(format!("--light: {} is not a run of relight", a.path.display())));
    }
    if a.path.is_file() && a.path.extension().is_some_and(|e| e.eq_ignore_ascii_case("ply")) {
        let view = PointsView::of_file(&a.path)?;
        eprintln!("{} points or splats", view.points());
        return Ok(Source::Points(Arc::new(view)));
    }
    if is_run || !a.path.is_dir() {
        return match Application::of_run(&a.path)? {
            Application::Object => object(a),
            Application::Relight => scene(a),
            of @ Application::RelightObject => Err(of.refuse(&a.path, "the GLB file that diorama relight object wrote")),
            Application::Text => written(a),
            of @ Application::Detector => Err(of.refuse(&a.path, "diorama text eval-detector --weights")),
        };
    }
    let capture = import::import(&a.path, &ImportOptions { min_views: 1, allow_broken: true, ..ImportOptions::default() })?;
    capture.notes.iter().for_each(|n| note(n));
    let view = PointsView::of_capture(&a.path, &capture)?;
    eprintln!("a data set of {} views with {} points; train a field to see more", capture.frames.len(), view.points());
    Ok(Source::Points(Arc::new(view)))
}

/// The view source of a run of the object application.
fn object(a: &View) -> Result<Source> {
    let (mut model, notes) = run_folder::load_model_of(&a.path, a.data.as_deref())?;
    notes.iter().for_each(|n| note(n));
    if let Err(e) = kept_capture::require_photographs(&model.capture) {
        note(&format!("photographs cannot be shown: {e}"));
    }
    device::accelerate(&mut model, &a.device, Box::new(note))?;
    Ok(Source::Run(viewing::open(&a.path, model, false)?))
}

/// The view source of a run of the text application.
fn written(a: &View) -> Result<Source> {
    let (model, notes) = text::field::recipe::load(&a.path, a.data.as_deref())?;
    notes.iter().for_each(|n| note(n));
    if let Err(e) = kept_capture::require_photographs(&model.capture) {
        note(&format!("photographs cannot be shown: {e}"));
    }
    Ok(Source::Text(text::viewing::open(&a.path, model)?))
}

/// The view source of a run of the scene model.
fn scene(a: &View) -> Result<Source> {
    let (maps, notes) = outdoor::viewing::read_maps(&a.light)?;
    let (model, of_run) = outdoor::recipe::load_of(&a.path, a.data.as_deref())?;
    notes.iter().chain(&of_run).for_each(|n| note(n));
    if let Err(e) = kept_capture::require_photographs(&model.capture) {
        note(&format!("photographs cannot be shown: {e}"));
    }
    Ok(Source::Scene(outdoor::viewing::open(&a.path, model, maps, false)?))
}
