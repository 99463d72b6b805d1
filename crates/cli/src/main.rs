//! The `diorama` command.

#[macro_use]
mod print;
mod arguments;
mod commands;
mod terminal;

#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> std::process::ExitCode {
    arguments::main()
}
