//! `diorama view`

use super::{INTERRUPT, Outcome, note, use_threads, watch_interrupts};
use crate::arguments::{ListenArgs, ViewArgs};
use diorama_data::import::{self, ImportOptions};
use diorama_geom::view_source::ViewSource;
use diorama_pipelines::object::viewing::RunView;
use diorama_pipelines::object::viewing_points::PointsView;
use diorama_pipelines::object::{device, run_folder};
use diorama_pipelines::run::kept_capture;
use diorama_pipelines::{PipelineError, Result};
use diorama_viewer::{Server, ViewerOptions};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

pub fn run(a: &ViewArgs) -> Result<Outcome> {
    use_threads(a.threads)?;
    let source = source(a)?;
    let server = listen(&a.listen, source.shown())?;
    watch_interrupts();
    if a.json {
        println!("{}", serde_json::json!({ "address": server.address() }));
    } else {
        println!("{}", server.address());
    }
    eprintln!("open this address in a browser; Ctrl-C ends");
    let Source::Run(run) = source else {
        server.run(&INTERRUPT);
        return Ok(Outcome::Done);
    };
    // A device that was named and fails ends the viewer.
    std::thread::scope(|s| {
        s.spawn(|| {
            while !INTERRUPT.load(Ordering::Relaxed) {
                std::thread::sleep(Duration::from_millis(100));
                if run.check_device().is_err() {
                    INTERRUPT.store(true, Ordering::Relaxed);
                }
            }
        });
        server.run(&INTERRUPT);
    });
    run.check_device().map(|()| Outcome::Done)
}

enum Source {
    Run(Arc<RunView>),
    Points(Arc<PointsView>),
}

impl Source {
    fn shown(&self) -> Arc<dyn ViewSource> {
        match self {
            Source::Run(r) => r.clone(),
            Source::Points(p) => p.clone(),
        }
    }
}

/// What there is to look at: a run, a file of points or splats, or a data set.
fn source(a: &ViewArgs) -> Result<Source> {
    let is_run = ["config.toml", "checkpoints"].iter().any(|n| a.path.join(n).exists());
    if a.data.is_some() && !is_run {
        return Err(PipelineError::Usage(format!("--data: {} is no run, so it has no photographs elsewhere", a.path.display())));
    }
    if a.path.is_file() && a.path.extension().is_some_and(|e| e.eq_ignore_ascii_case("ply")) {
        let view = PointsView::of_file(&a.path)?;
        eprintln!("{} points or splats", view.points());
        return Ok(Source::Points(Arc::new(view)));
    }
    if is_run || !a.path.is_dir() {
        let (mut model, notes) = run_folder::load_model_of(&a.path, a.data.as_deref())?;
        notes.iter().for_each(|n| note(n));
        if let Err(e) = kept_capture::require_photographs(&model.capture) {
            note(&format!("photographs cannot be shown: {e}"));
        }
        device::accelerate(&mut model, &a.device, Box::new(note))?;
        return Ok(Source::Run(RunView::new(&a.path, model, false)?));
    }
    let capture = import::import(&a.path, &ImportOptions { min_views: 1, allow_broken: true, ..ImportOptions::default() })?;
    capture.notes.iter().for_each(|n| note(n));
    let view = PointsView::of_capture(&a.path, &capture)?;
    eprintln!("a data set of {} views with {} points; train it to see more", capture.frames.len(), view.points());
    Ok(Source::Points(Arc::new(view)))
}

/// A server that is bound and does not serve yet.
pub fn listen(a: &ListenArgs, source: Arc<dyn ViewSource>) -> Result<Server> {
    Server::bind(&ViewerOptions { host: a.host, port: a.port }, source).map_err(|e| PipelineError::Usage(e.to_string()))
}
