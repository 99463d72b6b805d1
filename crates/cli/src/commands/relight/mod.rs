//! `diorama relight`: a group of commands.

mod compose;
mod eval;
mod light_flags;
mod render;
mod scenario;
mod synth;
mod train;
mod turntable;

use super::Verb;
use clap::Subcommand;

/// Put models under other light: composed scenes and turntables, path-traced
#[derive(Subcommand)]
pub enum Relight {
    Train(train::Train),
    Render(render::Render),
    Eval(eval::Eval),
    Compose(compose::Compose),
    Turntable(turntable::Turntable),
    Scenario(scenario::Scenario),
    Synth(synth::Synth),
}

impl Relight {
    /// The chosen command.
    pub fn verb(&self) -> &dyn Verb {
        match self {
            Relight::Train(v) => v,
            Relight::Render(v) => v,
            Relight::Eval(v) => v,
            Relight::Compose(v) => v,
            Relight::Turntable(v) => v,
            Relight::Scenario(v) => v,
            Relight::Synth(v) => v,
        }
    }
}
