//! `diorama view`

use super::{INTERRUPT, Outcome, use_threads, watch_interrupts};
use crate::arguments::{ListenArgs, ViewArgs};
use diorama_data::import::{self, ImportOptions};
use diorama_geom::view_source::ViewSource;
use diorama_pipelines::object::viewing::RunView;
use diorama_pipelines::object::viewing_points::PointsView;
use diorama_pipelines::object::{device, run_folder};
use diorama_pipelines::{PipelineError, Result};
use diorama_viewer::{Server, ViewerOptions};
use std::sync::Arc;

pub fn run(a: &ViewArgs) -> Result<Outcome> {
    use_threads(a.threads)?;
    let server = listen(&a.listen, source(a)?)?;
    watch_interrupts();
    if a.json {
        println!("{}", serde_json::json!({ "address": server.address() }));
    } else {
        println!("{}", server.address());
    }
    eprintln!("open this address in a browser; Ctrl-C ends");
    server.run(&INTERRUPT);
    Ok(Outcome::Done)
}

/// What there is to look at: a run, a file of points or splats, or a data set.
fn source(a: &ViewArgs) -> Result<Arc<dyn ViewSource>> {
    if a.path.is_file() && a.path.extension().is_some_and(|e| e.eq_ignore_ascii_case("ply")) {
        let view = PointsView::of_file(&a.path)?;
        eprintln!("{} points or splats", view.points());
        return Ok(Arc::new(view));
    }
    let is_run = ["config.toml", "checkpoints"].iter().any(|n| a.path.join(n).exists());
    if is_run || !a.path.is_dir() {
        let (mut model, notes) = run_folder::load_model(&a.path)?;
        notes.iter().for_each(|n| eprintln!("note: {n}"));
        device::accelerate(&mut model, &a.device)?;
        return Ok(RunView::new(&a.path, model, false));
    }
    let capture = import::import(&a.path, &ImportOptions { min_views: 1, allow_broken: true, ..ImportOptions::default() })?;
    capture.notes.iter().for_each(|n| eprintln!("note: {n}"));
    let view = PointsView::of_capture(&a.path, &capture)?;
    eprintln!("a data set of {} views with {} points; train it to see more", capture.frames.len(), view.points());
    Ok(Arc::new(view))
}

/// A server that is bound and does not serve yet.
pub fn listen(a: &ListenArgs, source: Arc<dyn ViewSource>) -> Result<Server> {
    Server::bind(&ViewerOptions { host: a.host, port: a.port }, source).map_err(|e| PipelineError::Usage(e.to_string()))
}
