//! `diorama view`

use super::{INTERRUPT, Outcome, use_threads, watch_interrupts};
use crate::arguments::{ListenArgs, ViewArgs};
use diorama_geom::view_source::ViewSource;
use diorama_pipelines::object::viewing::RunView;
use diorama_pipelines::object::{device, run_folder};
use diorama_pipelines::{PipelineError, Result};
use diorama_viewer::{Server, ViewerOptions};
use std::sync::Arc;

pub fn run(a: &ViewArgs) -> Result<Outcome> {
    use_threads(a.threads)?;
    let (mut model, notes) = run_folder::load_model(&a.run)?;
    notes.iter().for_each(|n| eprintln!("note: {n}"));
    device::accelerate(&mut model, &a.device)?;
    let server = listen(&a.listen, RunView::new(&a.run, model, false))?;
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

/// A server that is bound and does not serve yet.
pub fn listen(a: &ListenArgs, source: Arc<dyn ViewSource>) -> Result<Server> {
    Server::bind(&ViewerOptions { host: a.host, port: a.port }, source).map_err(|e| PipelineError::Usage(e.to_string()))
}
