//! The `diorama` command.

#[macro_use]
mod print;
mod commands;
mod terminal;

use clap::Parser;
use commands::{Outcome, Program};
use std::process::ExitCode;

#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

/// Parses the arguments, runs the command, reports errors.
fn main() -> ExitCode {
    diorama_kernels::device::quiet_drivers();
    diorama_kernels::device::settle_cuda_path();
    let program = match Program::try_parse() {
        Ok(p) => p,
        Err(e) => {
            let _ = e.print();
            return ExitCode::from(if e.use_stderr() { terminal::USAGE } else { 0 });
        }
    };
    let verb = program.command.verb();
    ExitCode::from(match verb.run() {
        Ok(Outcome::Done) => 0,
        Ok(Outcome::Interrupted) => terminal::INTERRUPTED,
        Err(e) => terminal::report(&e, verb.json()),
    })
}
