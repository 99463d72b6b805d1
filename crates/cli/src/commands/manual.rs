//! `diorama completions` and `diorama man`

use super::{Outcome, Program, Verb};
use clap::{Args, CommandFactory};
use diorama_data::{DataError, atomic};
use diorama_pipelines::Result;
use std::path::{Path, PathBuf};

/// Print completions for a shell
#[derive(Args, Clone, Debug)]
#[command(
    after_help = "Examples:\n  diorama completions bash > ~/.local/share/bash-completion/completions/diorama\n  diorama completions zsh > ~/.zfunc/_diorama\n  diorama completions fish > ~/.config/fish/completions/diorama.fish"
)]
pub struct Completions {
    /// Shell whose completions are printed
    shell: clap_complete::Shell,
}

impl Verb for Completions {
    fn run(&self) -> Result<Outcome> {
        let mut text = Vec::new();
        clap_complete::generate(self.shell, &mut Program::command(), "diorama", &mut text);
        crate::print::bytes(&text);
        Ok(Outcome::Done)
    }
}

/// Write manual pages, one per command
#[derive(Args, Clone, Debug)]
#[command(after_help = "Example:\n  diorama man ~/.local/share/man/man1 && man diorama-train")]
pub struct Man {
    /// Folder for the pages, which are named after the commands
    folder: PathBuf,
}

impl Verb for Man {
    fn run(&self) -> Result<Outcome> {
        std::fs::create_dir_all(&self.folder).map_err(DataError::io(&self.folder, "create"))?;
        let mut command = Program::command();
        command.build();
        let mut names = Vec::new();
        write(&command, "diorama", &self.folder, &mut names)?;
        println!("{}: {} pages, {} and on", self.folder.display(), names.len(), names[0]);
        Ok(Outcome::Done)
    }
}

/// Writes a page for the program and for each command: `diorama-train.1` and so on.
fn write(command: &clap::Command, name: &str, folder: &Path, names: &mut Vec<String>) -> Result<()> {
    let file = folder.join(format!("{name}.1"));
    let mut text = Vec::new();
    // Pages show the name as typed in a shell: `diorama train`.
    let page = clap_mangen::Man::new(command.clone().display_name(name));
    page.render(&mut text).map_err(DataError::io(&file, "write"))?;
    atomic::write(&file, &text)?;
    names.push(format!("{name}.1"));
    for sub in command.get_subcommands().filter(|s| s.get_name() != "help") {
        write(sub, &format!("{name}-{}", sub.get_name()), folder, names)?;
    }
    Ok(())
}
