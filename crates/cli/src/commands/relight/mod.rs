//! `diorama relight`: a group of commands.

mod compose;
mod eval;
mod light_flags;
mod object;
mod render;
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
    Object(object::Object),
    Eval(eval::Eval),
    Compose(compose::Compose),
    Turntable(turntable::Turntable),
    Synth(synth::Synth),
}

impl Relight {
    /// The chosen command.
    pub fn verb(&self) -> &dyn Verb {
        match self {
            Relight::Train(v) => v,
            Relight::Render(v) => v,
            Relight::Object(v) => v,
            Relight::Eval(v) => v,
            Relight::Compose(v) => v,
            Relight::Turntable(v) => v,
            Relight::Synth(v) => v,
        }
    }
}
