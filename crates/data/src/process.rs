//! Finds and runs other programs.

use crate::error::{DataError, Result};
use std::fs::File;
use std::io::{BufRead, BufReader, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::time::{Duration, Instant};

/// Time without output after which a program counts as hung.
const SILENCE_LIMIT: Duration = Duration::from_secs(30 * 60);
/// Output lines of a failed program that are shown.
const SHOWN_LINES: usize = 3;
/// Interval at which an interrupt is checked.
const POLL_INTERVAL: Duration = Duration::from_millis(100);

/// How a program ended, if it did not fail.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ended {
    Done,
    Interrupted,
}

/// Path of a program, or the path that the environment variable `variable` gives.
///
/// # Errors
/// If the program does not exist; `package` says what to install.
pub fn find(name: &'static str, variable: &str, package: &str) -> Result<PathBuf> {
    if let Some(given) = std::env::var_os(variable) {
        let given = PathBuf::from(given);
        return if given.is_file() {
            Ok(given)
        } else {
            Err(DataError::input(given, format!("{variable}: no such program; unset it or name {name} there")))
        };
    }
    let paths = std::env::var_os("PATH").unwrap_or_default();
    let names = [name.to_string(), format!("{name}.exe"), format!("{name}.bat")];
    let found = std::env::split_paths(&paths).flat_map(|d| names.iter().map(move |n| d.join(n)).collect::<Vec<_>>()).find(|p| p.is_file());
    found.ok_or_else(|| DataError::input(name, format!("not found; install it ({package}) or give its path in {variable}")))
}

/// Runs a program to its end. Its output is written to `log` and passed line by line to `on_line`.
///
/// # Errors
/// If it cannot be started, fails, or prints nothing for half an hour.
pub fn run(command: &mut Command, log: &Path, interrupt: &AtomicBool, on_line: &mut dyn FnMut(&str)) -> Result<Ended> {
    let program = PathBuf::from(command.get_program());
    let mut sink = File::options().create(true).append(true).open(log).map_err(DataError::io(log, "write"))?;
    let arguments: Vec<_> = command.get_args().map(|a| a.to_string_lossy().into_owned()).collect();
    writeln!(sink, "$ {} {}", program.display(), arguments.join(" ")).map_err(DataError::io(log, "write"))?;
    command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut child = command.spawn().map_err(DataError::io(&program, "start"))?;
    let (send, lines) = channel();
    let pipes: [Option<Box<dyn Read + Send>>; 2] =
        [child.stdout.take().map(|p| Box::new(p) as _), child.stderr.take().map(|p| Box::new(p) as _)];
    for pipe in pipes.into_iter().flatten() {
        let send = send.clone();
        std::thread::spawn(move || {
            let mut reader = BufReader::new(pipe);
            let mut line = Vec::new();
            while reader.read_until(b'\n', &mut line).is_ok_and(|n| n > 0) {
                // Progress lines, which overwrite each other, end in a carriage return.
                let text = String::from_utf8_lossy(&line).trim_end().to_string();
                if send.send(text).is_err() {
                    break;
                }
                line.clear();
            }
        });
    }
    drop(send);
    let mut last = std::collections::VecDeque::new();
    let mut heard = Instant::now();
    loop {
        if interrupt.load(Ordering::Relaxed) {
            end(&mut child);
            return Ok(Ended::Interrupted);
        }
        match lines.recv_timeout(POLL_INTERVAL) {
            Ok(line) => {
                heard = Instant::now();
                writeln!(sink, "{line}").map_err(DataError::io(log, "write"))?;
                on_line(&line);
                if !line.trim().is_empty() {
                    last.push_back(line);
                    if last.len() > SHOWN_LINES {
                        last.pop_front();
                    }
                }
            }
            Err(RecvTimeoutError::Timeout) if heard.elapsed() > SILENCE_LIMIT => {
                end(&mut child);
                return Err(DataError::failed(&program, format!("printed nothing for 30 minutes and was stopped; see {}", log.display())));
            }
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => break,
        }
    }
    let status = child.wait().map_err(DataError::io(&program, "wait for"))?;
    if interrupt.load(Ordering::Relaxed) {
        return Ok(Ended::Interrupted);
    }
    if !status.success() {
        return Err(DataError::failed(
            &program,
            format!("failed ({status}): {}; see {}", last_lines(last.iter().map(String::as_str)), log.display()),
        ));
    }
    Ok(Ended::Done)
}

/// Runs a program and passes its standard output to `read`.
///
/// # Errors
/// If it cannot be started or fails.
pub fn read_output(command: &mut Command, read: &mut dyn FnMut(&mut dyn Read) -> std::io::Result<()>) -> Result<()> {
    let program = PathBuf::from(command.get_program());
    command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut child = command.spawn().map_err(DataError::io(&program, "start"))?;
    let mut errors = child.stderr.take().expect("piped");
    let complaints = std::thread::spawn(move || {
        let mut text = Vec::new();
        // The exit status says whether the program failed; this is only what it said about it.
        let _ = errors.read_to_end(&mut text);
        String::from_utf8_lossy(&text).into_owned()
    });
    let mut out = child.stdout.take().expect("piped");
    let result = read(&mut out);
    drop(out);
    if result.is_err() {
        end(&mut child);
    }
    let status = child.wait().map_err(DataError::io(&program, "wait for"))?;
    let messages = complaints.join().unwrap_or_default();
    result.map_err(DataError::io(&program, "read from"))?;
    if !status.success() {
        return Err(DataError::failed(&program, format!("failed ({status}): {}", last_lines(messages.lines()))));
    }
    Ok(())
}

/// The last lines of a program's output, joined into one.
fn last_lines<'a>(lines: impl DoubleEndedIterator<Item = &'a str>) -> String {
    let mut last: Vec<&str> = lines.rev().map(str::trim).filter(|l| !l.is_empty()).take(SHOWN_LINES).collect();
    last.reverse();
    if last.is_empty() { "no reason given".into() } else { last.join("; ") }
}

fn end(child: &mut Child) {
    let _ = child.kill();
    let _ = child.wait();
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_program_says_is_kept_and_its_failure_told() {
        let dir = tempfile::tempdir().unwrap();
        let log = dir.path().join("log");
        let no = AtomicBool::new(false);
        let mut heard = Vec::new();
        let sh = |script: &str, heard: &mut Vec<String>| {
            run(Command::new("sh").args(["-c", script]), &log, &no, &mut |l| heard.push(l.to_string()))
        };
        assert_eq!(sh("echo one; echo two >&2", &mut heard).unwrap(), Ended::Done);
        heard.sort();
        assert_eq!(heard, ["one", "two"]);
        let failed = sh("echo reason; exit 3", &mut heard).unwrap_err();
        assert!(failed.to_string().contains("reason") && !failed.is_input(), "{failed}");
        let all = std::fs::read_to_string(&log).unwrap();
        assert!(all.contains("one\n") && all.contains("$ sh -c"));
    }

    #[test]
    fn an_interrupt_ends_the_program() {
        let dir = tempfile::tempdir().unwrap();
        let begin = Instant::now();
        let stop = AtomicBool::new(true);
        let ended = run(Command::new("sleep").arg("60"), &dir.path().join("log"), &stop, &mut |_| {}).unwrap();
        assert!(ended == Ended::Interrupted && begin.elapsed() < Duration::from_secs(30));
    }

    #[test]
    fn a_program_that_is_not_there_is_the_users_to_install() {
        let e = find("no-such-program", "NO_SUCH_VARIABLE", "Debian's package such").unwrap_err();
        assert!(e.is_input() && e.to_string().contains("package such"), "{e}");
    }
}
