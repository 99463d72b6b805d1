//! `println!` and `eprintln!` of this program: unlike those of the standard library, which they shadow, they do not panic where
//! nobody reads on, as in `diorama info RUN | head -1`. The work goes on and the exit code is that of the work.

use std::fmt::Arguments;
use std::io::{ErrorKind, Write};

macro_rules! println {
    ($($text:tt)*) => { $crate::print::line(format_args!($($text)*)) };
}

macro_rules! eprintln {
    ($($text:tt)*) => { $crate::print::error_line(format_args!($($text)*)) };
}

/// Writes a line to stdout. Ends the program with exit code 1 where the line cannot be written although somebody reads, as on a
/// full disk.
pub fn line(text: Arguments) {
    let mut out = std::io::stdout().lock();
    finish(out.write_fmt(text).and_then(|()| out.write_all(b"\n")));
}

/// Writes bytes to stdout, as `line`.
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

/// Writes a line to stderr; there is nobody to tell if that fails.
pub fn error_line(text: Arguments) {
    let mut out = std::io::stderr().lock();
    let _ = out.write_fmt(text).and_then(|()| out.write_all(b"\n"));
}
