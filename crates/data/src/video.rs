//! Extracts frames of a video with ffmpeg: the sharpest of each interval.

use crate::error::{DataError, Result};
use crate::process::{self, Ended};
use crate::sharpness::{self, SHORT_SIDE};
use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::atomic::AtomicBool;

/// Side of the small gray frames on which sharpness is measured.
const WIDTH: usize = 320;

/// Most frames per call of ffmpeg; systems limit the length of a command.
const PER_CALL: usize = 1500;

/// Which frames of a video are extracted.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Choice {
    /// At most this many in total.
    Count(usize),
    /// This many per second.
    PerSecond(f64),
    /// The sharpest of each of this many equal parts, without blurred ones, see [`sharpness::sharp`].
    Sharp(usize),
}

/// Path of ffmpeg.
///
/// # Errors
/// If it is not installed.
pub fn ffmpeg() -> Result<PathBuf> {
    process::find("ffmpeg", "DIORAMA_FFMPEG", "Debian: apt install ffmpeg")
}

/// Result of [`extract`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Extracted {
    /// Frames in the video.
    pub frames: usize,
    /// Frames that were written.
    pub taken: usize,
    /// ffmpeg's messages, if the video could be decoded only in part.
    pub fault: Option<String>,
}

/// Writes the chosen frames as `frame_00001.jpg` … into `folder`, without metadata; `None` when interrupted.
///
/// # Errors
/// If ffmpeg fails, or the video has no frames that it can decode; the error includes ffmpeg's own message.
pub fn extract(
    ffmpeg: &Path,
    video: &Path,
    folder: &Path,
    choice: Choice,
    log: &Path,
    interrupt: &AtomicBool,
) -> Result<Option<Extracted>> {
    let passthrough = passthrough(ffmpeg)?;
    let (sharpness, fault) = measure(ffmpeg, passthrough, video, matches!(choice, Choice::Sharp(_)))?;
    let chosen = match choice {
        Choice::Count(n) => sharpness::sharpest(&sharpness, n),
        Choice::PerSecond(fps) => {
            let count = (sharpness.len() as f64 / frames_per_second(ffmpeg, video)? * fps).round() as usize;
            sharpness::sharpest(&sharpness, count.max(1))
        }
        Choice::Sharp(windows) => sharpness::sharp(&sharpness, windows),
    };
    for (i, part) in chosen.chunks(PER_CALL).enumerate() {
        // Runs of consecutive frames keep the expression short.
        let terms: Vec<String> =
            runs(part).iter().map(|(a, b)| if a == b { format!("eq(n,{a})") } else { format!("between(n,{a},{b})") }).collect();
        let mut c = Command::new(ffmpeg);
        c.args(["-hide_banner", "-nostdin", "-y", "-i"]).arg(video);
        c.arg("-vf").arg(format!("select='{}'", terms.join("+"))).args(passthrough);
        c.args(["-map_metadata", "-1", "-fflags", "+bitexact", "-qscale:v", "1", "-qmin", "1"]);
        c.arg("-start_number").arg((i * PER_CALL + 1).to_string()).arg(folder.join("frame_%05d.jpg"));
        let ended = process::run(&mut c, log, interrupt, &mut |_| {});
        let written = (0..part.len()).all(|k| folder.join(format!("frame_{:05}.jpg", i * PER_CALL + k + 1)).is_file());
        match ended {
            Ok(Ended::Interrupted) => return Ok(None),
            // ffmpeg also fails for frames after the last one that can be decoded.
            Err(e) if !(written && fault.is_some()) => return Err(e),
            Ok(Ended::Done) if !written => {
                let what = format!("wrote fewer than the {} requested frames; see {}", part.len(), log.display());
                return Err(DataError::failed(ffmpeg, what));
            }
            _ => {}
        }
    }
    Ok(Some(Extracted { frames: sharpness.len(), taken: chosen.len(), fault }))
}

/// The option that writes each decoded frame once, regardless of its timestamp: `-vsync` was renamed in ffmpeg 5.1, and newer versions
/// removed the old name.
fn passthrough(ffmpeg: &Path) -> Result<[&'static str; 2]> {
    let out = Command::new(ffmpeg).arg("-version").output().map_err(DataError::io(ffmpeg, "start"))?;
    let text = String::from_utf8_lossy(&out.stdout).into_owned();
    let old = version(&text).is_some_and(|v| v < (5, 1));
    Ok(if old { ["-vsync", "0"] } else { ["-fps_mode", "passthrough"] })
}

/// Major and minor version from the output of `ffmpeg -version`; `None` for development builds, which are recent.
fn version(text: &str) -> Option<(u32, u32)> {
    let version = text.lines().next()?.strip_prefix("ffmpeg version ")?.split_whitespace().next()?;
    let mut parts = version.trim_start_matches('n').split(|c: char| !c.is_ascii_digit());
    let major = parts.next()?.parse().ok()?;
    // Names of nightly builds start with the year.
    (major < 1000).then(|| (major, parts.next().and_then(|m| m.parse().ok()).unwrap_or(0)))
}

/// Variance of the Laplacian of each frame, gray: at [`SHORT_SIDE`] if it `keeps_shape`, else as a small square; and ffmpeg's messages if it
/// could not decode all frames.
fn measure(ffmpeg: &Path, passthrough: [&str; 2], video: &Path, keeps_shape: bool) -> Result<(Vec<f32>, Option<String>)> {
    let mut c = Command::new(ffmpeg);
    c.args(["-hide_banner", "-nostdin", "-loglevel", "error", "-i"]).arg(video).args(passthrough);
    if keeps_shape {
        let side = |own: &str, other: &str| format!("'if(lte({own},{other}),min({SHORT_SIDE},{own}),-1)'");
        let size = format!("w={}:h={}", side("iw", "ih"), side("ih", "iw-1"));
        c.args(["-vf", &format!("scale={size}:flags=area,format=gray"), "-f", "image2pipe", "-c:v", "pgm", "-"]);
    } else {
        // Square frames: the shape does not matter for sharpness, and the size must be known.
        c.args(["-vf", &format!("scale={WIDTH}:{WIDTH}:flags=area,format=gray"), "-f", "rawvideo", "-"]);
    }
    let mut out = Vec::new();
    let read = process::read_output(&mut c, &mut |pipe| {
        let mut pipe = BufReader::new(pipe);
        loop {
            let size = if keeps_shape { pgm_header(&mut pipe)? } else { Some((WIDTH, WIDTH)) };
            let Some((width, height)) = size else { return Ok(()) };
            let mut frame = vec![0u8; width * height];
            match pipe.read_exact(&mut frame) {
                Ok(()) => out.push(sharpness::laplacian_variance(&frame, width)),
                Err(e) if e.kind() == std::io::ErrorKind::UnexpectedEof => return Ok(()),
                Err(e) => return Err(e),
            }
        }
    });
    match read {
        // Frames decoded before an error are used.
        Err(e) if !out.is_empty() => Ok((out, Some(e.to_string()))),
        // If ffmpeg does not know an option, it has not read the video.
        Err(e) if ["Unrecognized option", "Option not found", "No such filter"].iter().any(|w| e.to_string().contains(w)) => Err(e),
        Err(e) => Err(DataError::input(video, format!("its first frame cannot be decoded: {e}; convert it to MP4"))),
        Ok(()) if out.is_empty() => Err(DataError::input(video, "holds no frames; give a video, or a folder of photographs")),
        Ok(()) => Ok((out, None)),
    }
}

/// Width and height of the PGM picture that begins, as ffmpeg writes it: three lines, with 8 bits per pixel; none at the end of the pipe.
fn pgm_header(pipe: &mut dyn BufRead) -> std::io::Result<Option<(usize, usize)>> {
    let mut header = String::new();
    for _ in 0..3 {
        pipe.read_line(&mut header)?;
    }
    if header.is_empty() {
        return Ok(None);
    }
    let fields: Vec<&str> = header.split_ascii_whitespace().collect();
    let size = match fields[..] {
        ["P5", width, height, "255"] => width.parse().ok().zip(height.parse().ok()),
        _ => None,
    };
    size.map(Some).ok_or_else(|| std::io::Error::other(format!("{header:?} is no header of a PGM picture")))
}

fn frames_per_second(ffmpeg: &Path, video: &Path) -> Result<f64> {
    // ffmpeg itself prints the frame rate, so that ffprobe is not needed: "Stream … 29.97 fps".
    let out = Command::new(ffmpeg).args(["-hide_banner", "-nostdin", "-i"]).arg(video).output().map_err(DataError::io(ffmpeg, "start"))?;
    let text = String::from_utf8_lossy(&out.stderr).into_owned();
    let fps =
        text.lines().filter(|l| l.contains("Video:")).find_map(|l| l.split(" fps").next()?.rsplit([' ', ',']).next()?.parse::<f64>().ok());
    fps.filter(|f| *f > 0.0).ok_or_else(|| DataError::input(video, "does not state its frame rate; give --frames instead of --fps"))
}

/// First and last number of each run of consecutive numbers.
fn runs(sorted: &[usize]) -> Vec<(usize, usize)> {
    let mut out: Vec<(usize, usize)> = Vec::new();
    for &i in sorted {
        match out.last_mut() {
            Some(last) if last.1 + 1 == i => last.1 = i,
            _ => out.push((i, i)),
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn consecutive_numbers_are_runs() {
        assert_eq!(runs(&[0, 1, 2, 5, 7, 8]), [(0, 2), (5, 5), (7, 8)]);
    }

    #[test]
    fn versions_of_all_kinds_are_told_apart() {
        for (text, expected) in [
            ("ffmpeg version 4.4.2-0ubuntu0.22.04.1 Copyright (c) 2000-2021", Some((4, 4))),
            ("ffmpeg version 5.1.9-0+deb12u1 Copyright", Some((5, 1))),
            ("ffmpeg version n7.1 Copyright", Some((7, 1))),
            ("ffmpeg version 8.0 Copyright", Some((8, 0))),
            ("ffmpeg version N-118000-g1234567 Copyright", None),
            ("ffmpeg version 2025-01-02-git-0f1a2b-full_build Copyright", None),
            ("something else", None),
        ] {
            assert_eq!(version(text), expected, "{text}");
        }
    }
}
