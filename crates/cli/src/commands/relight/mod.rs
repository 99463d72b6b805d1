//! `diorama relight`: a group of commands.

mod compose;
mod light_flags;
mod turntable;

use super::Verb;
use clap::Subcommand;

/// Put models under other light: composed scenes and turntables, path-traced
#[derive(Subcommand)]
pub enum Relight {
    Compose(compose::Compose),
    Turntable(turntable::Turntable),
}

impl Relight {
    /// The chosen command.
    pub fn verb(&self) -> &dyn Verb {
        match self {
            Relight::Compose(v) => v,
            Relight::Turntable(v) => v,
        }
    }
}
