//! `diorama completions` and `diorama man`

use super::Outcome;
use crate::arguments::{CompletionsArgs, ManArgs};
use diorama_data::{DataError, atomic};
use diorama_pipelines::Result;

/// Completions of a shell on stdout.
pub fn completions(a: &CompletionsArgs, mut command: clap::Command) -> Result<Outcome> {
    let mut text = Vec::new();
    clap_complete::generate(a.shell, &mut command, "diorama", &mut text);
    crate::print::bytes(&text);
    Ok(Outcome::Done)
}

/// A page for the program and for each verb, `diorama-train.1` and so on.
pub fn pages(a: &ManArgs, mut command: clap::Command) -> Result<Outcome> {
    std::fs::create_dir_all(&a.folder).map_err(DataError::io(&a.folder, "create"))?;
    command.build();
    let mut names = Vec::new();
    write(&command, "diorama", a, &mut names)?;
    println!("{}: {} pages, {} and on", a.folder.display(), names.len(), names[0]);
    Ok(Outcome::Done)
}

fn write(command: &clap::Command, name: &str, a: &ManArgs, names: &mut Vec<String>) -> Result<()> {
    let file = a.folder.join(format!("{name}.1"));
    let mut text = Vec::new();
    // Pages name themselves as they are called from a shell: `diorama train`.
    let page = clap_mangen::Man::new(command.clone().display_name(name));
    page.render(&mut text).map_err(DataError::io(&file, "write"))?;
    atomic::write(&file, &text)?;
    names.push(format!("{name}.1"));
    for sub in command.get_subcommands().filter(|s| s.get_name() != "help") {
        write(sub, &format!("{name}-{}", sub.get_name()), a, names)?;
    }
    Ok(())
}
