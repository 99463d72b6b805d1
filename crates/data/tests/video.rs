//! Frames of videos, extracted by this machine's ffmpeg and by stand-ins that accept only present options.
#![cfg(unix)]

use diorama_data::video::{self, Choice, Extracted};
use diorama_data::{DataError, photo};
use diorama_geom::ImageU8;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::atomic::AtomicBool;

/// Number of frames of the test video. Every fourth is sharp, and the brightness of a frame encodes its number.
const FRAMES: usize = 24;

fn extract(program: &Path, file: &Path, folder: &Path, choice: Choice) -> Result<Option<Extracted>, DataError> {
    std::fs::create_dir_all(folder).unwrap();
    video::extract(program, file, folder, choice, &folder.with_extension("log"), &AtomicBool::new(false))
}

/// The machine's ffmpeg and that of `DIORAMA_NEW_FFMPEG`; prints which of them is skipped.
fn ffmpegs() -> Vec<PathBuf> {
    let machine = video::ffmpeg().ok();
    let new = std::env::var_os("DIORAMA_NEW_FFMPEG").map(PathBuf::from);
    assert!(new.as_ref().is_none_or(|f| f.is_file()), "DIORAMA_NEW_FFMPEG is no file");
    for (found, what) in [(&machine, "no ffmpeg"), (&new, "no newer ffmpeg (DIORAMA_NEW_FFMPEG)")] {
        assert!(found.is_some() || std::env::var("DIORAMA_REQUIRE_FFMPEG").is_err(), "{what}, and it is required");
        if found.is_none() {
            println!("skipped: {what}");
        }
    }
    machine.into_iter().chain(new).collect()
}

/// A checkered picture, with fine squares if it is sharp; its mean encodes its number.
fn picture(number: usize) -> ImageU8 {
    let (w, h, level) = (96, 64, 40 + 7 * number as u8);
    let contrast = if number % 4 == 2 { 30 } else { 3 };
    let at = |i: usize| if (i % w / 8 + i / w / 8).is_multiple_of(2) { level + contrast } else { level - contrast };
    ImageU8 { width: w, height: h, channels: 3, data: (0..w * h).flat_map(|i| [at(i); 3]).collect() }
}

fn number(file: &Path) -> usize {
    let im = photo::load(file).unwrap();
    let mean = im.data.iter().map(|v| *v as f64).sum::<f64>() / im.data.len() as f64;
    ((mean - 40.0) / 7.0).round() as usize
}

fn script(path: &Path, text: &str) {
    std::fs::write(path, text).unwrap();
    std::fs::set_permissions(path, std::fs::Permissions::from_mode(0o755)).unwrap();
}

/// The test video in FFV1, with irregular timestamps.
fn video(ffmpeg: &Path, dir: &Path) -> PathBuf {
    for i in 0..FRAMES {
        photo::save_png(&dir.join(format!("{i:03}.png")), &picture(i)).unwrap();
    }
    let file = dir.join("a video ü.mkv");
    let made = Command::new(ffmpeg)
        .args(["-loglevel", "error", "-nostdin", "-y", "-framerate", "10", "-i"])
        .arg(dir.join("%03d.png"))
        .args(["-vf", "setpts='(N+3*floor(N/5))/10/TB'", "-c:v", "ffv1", "-fflags", "+bitexact"])
        .arg(&file)
        .output()
        .unwrap();
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    file
}

fn frames(folder: &Path) -> Vec<PathBuf> {
    let mut all: Vec<PathBuf> = std::fs::read_dir(folder).unwrap().flatten().map(|e| e.path()).collect();
    all.sort();
    all
}

#[test]
fn the_sharp_frames_of_a_real_video_are_written() {
    ffmpegs().iter().for_each(|f| sharp_frames_are_written(f));
}

fn sharp_frames_are_written(ffmpeg: &Path) {
    let dir = tempfile::tempdir().unwrap();
    let file = video(ffmpeg, dir.path());
    let out = dir.path().join("out");
    let made = extract(ffmpeg, &file, &out, Choice::Count(6)).unwrap().unwrap();
    assert_eq!(made, Extracted { frames: FRAMES, taken: 6, fault: None });
    assert_eq!(frames(&out).iter().map(|f| number(f)).collect::<Vec<_>>(), [2, 6, 10, 14, 18, 22]);
    // Two of eight parts have no sharp frame.
    let sharp = dir.path().join("sharp");
    let made = extract(ffmpeg, &file, &sharp, Choice::Sharp(8)).unwrap().unwrap();
    assert_eq!(made, Extracted { frames: FRAMES, taken: 6, fault: None });
    assert_eq!(frames(&sharp).iter().map(|f| number(f)).collect::<Vec<_>>(), [2, 6, 10, 14, 18, 22]);
    // All of them are consecutive.
    let all = dir.path().join("all");
    assert_eq!(extract(ffmpeg, &file, &all, Choice::Count(99)).unwrap().unwrap().taken, FRAMES);
    assert_eq!(frames(&all).iter().map(|f| number(f)).collect::<Vec<_>>(), (0..FRAMES).collect::<Vec<_>>());
}

#[test]
fn what_ffmpeg_cannot_decode_is_told_in_its_own_words() {
    ffmpegs().iter().for_each(|f| failures_are_told(f));
}

fn failures_are_told(ffmpeg: &Path) {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("a.mp4");
    std::fs::write(&file, b"this is no video, though it is named like one").unwrap();
    let e = extract(ffmpeg, &file, &dir.path().join("out"), Choice::Count(6)).unwrap_err();
    assert!(e.is_input() && e.to_string().contains("a.mp4") && e.to_string().contains("Invalid data found"), "{e}");
    // Half a video gives its first frames and a message.
    let whole = video(ffmpeg, dir.path());
    let bytes = std::fs::read(&whole).unwrap();
    std::fs::write(&file, &bytes[..bytes.len() / 2]).unwrap();
    let half = dir.path().join("half");
    let made = extract(ffmpeg, &file, &half, Choice::Count(3)).unwrap().unwrap();
    assert!(made.frames < FRAMES && made.taken == 3 && frames(&half).len() == 3, "{made:?}");
}

/// A stand-in for ffmpeg 8: it does not accept the options `-vsync` and `-filter_script`. It knows one video, whose third frame is sharp.
fn ffmpeg_8(dir: &Path, version: &str, known: &str) -> PathBuf {
    let side = 320;
    let flat = vec![90u8; side * side];
    let sharp: Vec<u8> = (0..side * side).map(|i| if (i % side / 2 + i / side / 2) % 2 == 0 { 200 } else { 20 }).collect();
    std::fs::write(dir.join("raw"), [&flat[..], &flat, &sharp, &flat].concat()).unwrap();
    photo::save_png(&dir.join("frame.png"), &picture(3)).unwrap();
    let program = dir.join(format!("ffmpeg-{version}"));
    let here = dir.display();
    script(
        &program,
        &format!(
            r#"#!/bin/sh
if [ "$1" = -version ]; then echo "ffmpeg version {version} Copyright (c) 2000-2025 the FFmpeg developers"; exit 0; fi
passes=no
for a in "$@"; do
    case "$a" in
        -filter_script*|-vsync|-fps_mode)
            if [ "$a" != {known} ]; then
                echo "Unrecognized option '${{a#-}}'." >&2
                echo "Error splitting the argument list: Option not found" >&2
                exit 8
            fi
            passes=yes ;;
        select=*) selected=$a ;;
    esac
    last=$a
done
[ $passes = yes ] || {{ echo "frames are dropped and doubled" >&2; exit 1; }}
if [ "$last" = - ]; then cat {here}/raw; exit 0; fi
[ "$selected" = "select='eq(n,2)'" ] || {{ echo "$selected: not the sharp frame" >&2; exit 1; }}
cp {here}/frame.png "$(printf "$last" 1)"
"#
        ),
    );
    program
}

/// Debian's ffmpeg 5 still accepts options that version 8 removed.
#[test]
fn the_newer_ffmpeg_lacks_the_options_that_are_gone() {
    let Some(new) = ffmpegs().into_iter().nth(1) else { return };
    let said =
        Command::new(&new).args(["-f", "lavfi", "-i", "color", "-vsync", "0", "-frames:v", "1", "-f", "null", "-"]).output().unwrap();
    let words = String::from_utf8_lossy(&said.stderr).into_owned();
    assert!(!said.status.success() && words.contains("Unrecognized option 'vsync'"), "{words}");
}

#[test]
fn options_suit_the_version() {
    let dir = tempfile::tempdir().unwrap();
    for (version, known) in [("8.0", "-fps_mode"), ("N-121000-gabcdef", "-fps_mode"), ("4.4.2-0ubuntu0.22.04.1", "-vsync")] {
        let program = ffmpeg_8(dir.path(), version, known);
        let out = dir.path().join(version);
        let made = extract(&program, Path::new("a.mp4"), &out, Choice::Count(1)).unwrap().unwrap();
        assert_eq!((made.frames, made.taken), (4, 1), "{version}");
        assert_eq!(number(&out.join("frame_00001.jpg")), 3, "{version}");
    }
    // If ffmpeg accepts neither option, the error blames ffmpeg, not the video.
    let program = ffmpeg_8(dir.path(), "9.0", "-pass_all");
    let e = extract(&program, Path::new("a.mp4"), &dir.path().join("9"), Choice::Count(1)).unwrap_err().to_string();
    assert!(e.contains("Unrecognized option 'fps_mode'") && e.contains("ffmpeg-9.0") && !e.contains("MP4"), "{e}");
}
