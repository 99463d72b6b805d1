//! `println!` and `eprintln!` of this program, which shadow those of the standard library. They do not panic if the reader has closed the
//! pipe, as in `diorama info RUN | head -1`: the work continues, and the exit code is that of the work.

use std::fmt::Arguments;
use std::io::{ErrorKind, Write};

macro_rules! println {
    ($($text:tt)*) => { $crate::print::line(format_args!($($text)*)) };
}

macro_rules! eprintln {
    ($($text:tt)*) => { $crate::print::error_line(format_args!($($text)*)) };
}

/// Writes a line to stdout. Ends the program with exit code 1 if the line cannot be written although the pipe is open, as on a full disk.
pub fn line(text: Arguments) {
    let mut out = std::io::stdout().lock();
    finish(out.write_fmt(text).and_then(|()| out.write_all(b"\n")));
}

/// Writes bytes to stdout, like `line`.
pub fn bytes(text: &[u8]) {
    let mut out = std::io::stdout().lock();
    finish(out.write_all(text).and_then(|()| out.flush()));
}

fn finish(written: std::io::Result<()>) {
    if let Err(e) = written.and_then(|()| std::io::stdout().flush())
        && e.kind() != ErrorKind::BrokenPipe
    {
        error_line(format_args!("diorama: stdout: cannot write: {e}"));
        std::process::exit(1);
    }
}

/// Writes a line to stderr. A failure is ignored, because it could not be reported.
pub fn error_line(text: Arguments) {
    let mut out = std::io::stderr().lock();
    let _ = out.write_fmt(text).and_then(|()| out.write_all(b"\n"));
}
