//! `diorama relight`: a group of commands.

mod compose;
mod eval;
mod fit_light;
pub(super) mod from_run;
mod light_flags;
mod mesh;
pub(super) mod object;
mod prepare;
mod quickstart;
mod render;
mod scenario;
mod synth;
mod train;
mod turntable;

use super::Verb;
use clap::Subcommand;

/// Take the light out of photographs, and put places and objects under another
#[derive(Subcommand)]
pub enum Relight {
    Quickstart(quickstart::Quickstart),
    Prepare(prepare::Prepare),
    Train(train::Train),
    Render(render::Render),
    Object(object::Object),
    Eval(eval::Eval),
    Mesh(mesh::Mesh),
    FitLight(fit_light::FitLight),
    Compose(compose::Compose),
    Turntable(turntable::Turntable),
    Scenario(scenario::Scenario),
    Synth(synth::Synth),
}

impl Relight {
    /// The chosen command.
    pub fn verb(&self) -> &dyn Verb {
        match self {
            Relight::Quickstart(v) => v,
            Relight::Prepare(v) => v,
            Relight::Train(v) => v,
            Relight::Render(v) => v,
            Relight::Object(v) => v,
            Relight::Eval(v) => v,
            Relight::Mesh(v) => v,
            Relight::FitLight(v) => v,
            Relight::Compose(v) => v,
            Relight::Turntable(v) => v,
            Relight::Scenario(v) => v,
            Relight::Synth(v) => v,
        }
    }
}
