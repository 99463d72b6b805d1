//! Runs that are moved, repeated, interrupted, compared and scored, with the real program.

mod program;

use diorama_data::photo;
use diorama_pipelines::object::quickstart::write_capture;
use program::*;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

#[test]
fn runs_and_photographs_may_move() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| {
        let folder = dir.path().join(name);
        std::fs::create_dir_all(&folder).unwrap();
        folder
    };
    let (home, elsewhere) = (at("home"), at("elsewhere"));
    write_capture(&home.join("data"), 8, 24).unwrap();
    // Started with paths that are valid in one working folder only.
    works(&home, &[&["train", "data", "-o", "run", "--steps", "4"], &SMALL[..]].concat());
    let eval = |from: &Path, run: &str, more: &[&str]| works(from, &[&["eval", run, "--device", "cpu"], more].concat());
    eval(&elsewhere, "../home/run", &[]);
    works(&elsewhere, &["compare", "../home/run", "-o", "cmp"]);
    works(&elsewhere, &["train", "-o", "../home/run", "--resume", "--steps", "6"]);
    // Everything moves together.
    let moved = dir.path().join("moved");
    std::fs::rename(&home, &moved).unwrap();
    eval(&elsewhere, "../moved/run", &[]);
    // Run and photographs move to different places.
    let (run, data) = (dir.path().join("far/run"), dir.path().join("photographs"));
    at("far");
    std::fs::rename(moved.join("run"), &run).unwrap();
    std::fs::rename(moved.join("data"), &data).unwrap();
    for verb in [&["eval", s(&run)][..], &["compare", s(&run)], &["train", "-o", s(&run), "--resume", "--steps", "8"]] {
        fails(&elsewhere, verb, 2, &[".png", "does not exist", "--data"]);
    }
    eval(&elsewhere, s(&run), &["--data", s(&data)]);
    works(&elsewhere, &["compare", s(&run), "--data", "../photographs", "-o", "cmp"]);
    fails(&elsewhere, &["eval", s(&run), "--data", s(&elsewhere)], 2, &["elsewhere", "holds no images"]);
    // These commands do not read photographs.
    works(&elsewhere, &["render", s(&run), "--frames", "1", "--size", "16x16", "--device", "cpu"]);
    works(&elsewhere, &["export", s(&run), "-o", "a.ply", "--resolution", "16", "--level", "0.01", "--device", "cpu"]);
    fails(&elsewhere, &["view", s(&data), "--data", s(&data), "--port", "0"], 2, &["--data", "is no run"]);
    // Resuming stores the new place.
    works(&elsewhere, &["train", "-o", s(&run), "--resume", "--data", "../photographs", "--steps", "8"]);
    eval(dir.path(), s(&run), &[]);
}

#[test]
fn a_command_may_be_repeated_with_resume_and_a_change_names_both_values() {
    let dir = tempfile::tempdir().unwrap();
    let capture = s(&good().capture);
    let command =
        ["train", capture, "-o", "run", "--steps", "4", "--downscale", "2", "--split", "every:4", "--seed", "7", "--method", "ngp"];
    let more = ["--background", "white", "--format", "transforms"];
    let all = [&command[..], &more, &SMALL].concat();
    works(dir.path(), &all);
    let summary = || std::fs::read_to_string(dir.path().join("run/summary.json")).unwrap();
    let before = summary();
    // Nothing is left to do, and the run's results are kept.
    let o = call(dir.path(), &[&all[..], &["--resume"]].concat());
    let said = String::from_utf8_lossy(&o.stderr);
    assert!(o.status.success() && said.contains("the run has its 4 steps") && !said.contains("NaN"), "{said}");
    assert!(!String::from_utf8_lossy(&o.stdout).contains("NaN") && !before.contains("\"psnr_train\": null"), "{before}");
    assert_eq!(summary(), before);
    for (flag, value, had) in [
        ("--downscale", "4", "2"),
        ("--split", "every:8", "every:4"),
        ("--seed", "8", "7"),
        ("--method", "nerf", "ngp"),
        ("--background", "black", "white"),
        ("--format", "colmap", "transforms"),
        ("--set", "field.log2_size=13", "12"),
    ] {
        let named = if flag == "--set" { "field.log2_size" } else { flag };
        let said = value.rsplit('=').next().unwrap();
        let parts = [&format!("{named} cannot change")[..], &format!("has {had}, not {said}")];
        fails(dir.path(), &["train", "-o", "run", "--resume", flag, value], 2, &parts);
    }
    // Another capture.
    write_capture(&dir.path().join("other"), 6, 24).unwrap();
    fails(dir.path(), &["train", "other", "-o", "run", "--resume"], 2, &[capture, "not on other", "--data FOLDER"]);
    // A configuration equal to the run's, and one that differs.
    std::fs::copy(dir.path().join("run/config.toml"), dir.path().join("same.toml")).unwrap();
    let text = std::fs::read_to_string(dir.path().join("same.toml")).unwrap();
    std::fs::write(dir.path().join("other.toml"), text.replace("distortion = \"auto\"", "distortion = 0.5")).unwrap();
    works(dir.path(), &["train", "-o", "run", "--resume", "--config", "same.toml"]);
    fails(dir.path(), &["train", "-o", "run", "--resume", "--config", "other.toml"], 2, &["loss.distortion", "auto", "0.5"]);
}

#[test]
fn the_preset_of_the_report_gives_exactly_100_pixels() {
    let dir = tempfile::tempdir().unwrap();
    write_capture(&dir.path().join("data"), 6, 150).unwrap();
    let train = [&["train", "data", "-o", "run", "--steps", "1", "--preset", "report"], &SMALL[..]].concat();
    works(dir.path(), &train);
    works(dir.path(), &[&train[..], &["--resume"]].concat());
    works(dir.path(), &["render", "run", "--path", "held-out", "--images", "frames", "--device", "cpu", "--quality", "fast"]);
    assert_eq!(diorama_data::photo::size(&dir.path().join("frames/0000.png")).unwrap(), (100, 100));
    let report: serde_json::Value =
        serde_json::from_str(&works(dir.path(), &["eval", "run", "--quality", "fast", "--device", "cpu", "--json"])).unwrap();
    assert!(report["psnr"].as_f64().unwrap().is_finite());
}

/// A call with limited memory.
fn with_memory(folder: &Path, limit: &str, arguments: &[&str]) -> (Option<i32>, serde_json::Value, String) {
    let o = call_in(folder, &[("DIORAMA_MEMORY", limit)], arguments);
    (o.status.code(), serde_json::from_slice(&o.stdout).unwrap_or_default(), String::from_utf8_lossy(&o.stderr).into_owned())
}

#[test]
fn what_does_not_fit_into_memory_is_refused_with_needs_has_and_cure() {
    let dir = tempfile::tempdir().unwrap();
    let table = ["--set", "field.log2_size=24", "--set", "field.levels=64", "--set", "field.features=8", "--json"];
    let all = [&["train", s(&good().capture), "-o", "run", "--steps", "1", "--device", "cpu"], &table[..]].concat();
    // The limit applies on large machines too.
    let (code, told, said) = with_memory(dir.path(), "64GiB", &all);
    assert_eq!((code, told["kind"].as_str(), told["exit_code"].as_i64()), (Some(1), Some("memory"), Some(1)), "{said}");
    let line = told["error"].as_str().unwrap();
    for part in ["parameters 1", "GiB", "are available", "--set field.log2_size=19"] {
        assert!(line.contains(part), "{part:?} is not in {line}");
    }
    assert_eq!(said.lines().filter(|l| l.starts_with("diorama: ")).count(), 1, "{said}");
    assert!(!dir.path().join("run").exists());
}

#[test]
fn an_export_that_does_not_fit_is_refused_with_needs_has_and_cure() {
    let dir = tempfile::tempdir().unwrap();
    let export = ["export", s(&good().run), "-o", "a.glb", "--level", "0.01", "--device", "cpu", "--json"];
    for (resolution, texture, largest, cure) in
        [("128", "0", "surface", "try --resolution 64"), ("32", "1024", "texture", "try --texture 512")]
    {
        let size = ["--resolution", resolution, "--texture", texture];
        let (code, told, said) = with_memory(dir.path(), "10MiB", &[&export[..], &size].concat());
        assert_eq!((code, told["kind"].as_str(), told["exit_code"].as_i64()), (Some(1), Some("memory"), Some(1)), "{said}");
        let line = told["error"].as_str().unwrap();
        for part in ["the export needs about ", largest, "10 MiB are available", cure] {
            assert!(line.contains(part), "{part:?} is not in {line}");
        }
        assert!(!line.contains('\n') && said.contains(line), "{said}");
    }
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 0, "a refusal left something behind");
    // Work that fits is done; an invalid limit is an error.
    let small = [&export[..], &["--resolution", "16", "--texture", "64"]].concat();
    let (code, told, said) = with_memory(dir.path(), "1GiB", &small);
    assert_eq!(code, Some(0), "{said}");
    assert!(told["faces"].as_u64().unwrap() > 0 && !said.contains("needs about"), "{said}");
    let (code, told, _) = with_memory(dir.path(), "much", &[&small[..], &["--force"]].concat());
    assert!(code == Some(2) && told["error"].as_str().unwrap().contains("DIORAMA_MEMORY=much: expected bytes"), "{told}");
    let (_, doctor, _) = with_memory(dir.path(), "10MiB", &["doctor", "--json"]);
    assert_eq!(doctor["memory_available_bytes"].as_u64(), Some(10 << 20), "{doctor}");
}

#[test]
fn training_and_exports_that_hardly_fit_say_so() {
    let dir = tempfile::tempdir().unwrap();
    let train = [&["train", s(&good().capture), "-o", "run", "--steps", "1", "--json"], &SMALL[..]].concat();
    let export = ["export", s(&good().run), "-o", "a.ply", "--resolution", "64", "--level", "0.01", "--device", "cpu", "--json"];
    for (arguments, what, written) in [(&train[..], "training needs about ", "run"), (&export, "the export needs about ", "a.ply")] {
        let (code, told, _) = with_memory(dir.path(), "1MiB", arguments);
        assert_eq!((code, told["kind"].as_str()), (Some(1), Some("memory")), "{told}");
        assert!(!dir.path().join(written).exists());
        let needs = told["error"].as_str().unwrap().strip_prefix(what).unwrap().split(" MiB").next().unwrap();
        let needs: f64 = needs.parse().unwrap();
        // A tenth more than needed is tight, three times as much is not.
        for (factor, is_tight) in [(1.1, true), (3.0, false)] {
            let (code, _, said) = with_memory(dir.path(), &format!("{}MiB", needs * factor), &[arguments, &["--force"]].concat());
            assert_eq!(code, Some(0), "{said}");
            let note = said.lines().find(|l| l.starts_with(&format!("note: {what}")));
            assert_eq!(note.is_some_and(|l| l.contains("if it does not fit: ")), is_tight, "{factor}: {said}");
        }
    }
}

#[test]
fn eval_tells_the_view_and_the_time_left() {
    let o = call(&good().run, &["eval", s(&good().run), "--device", "cpu"]);
    let said = String::from_utf8_lossy(&o.stderr).into_owned();
    assert!(o.status.success(), "{said}");
    let line = said.lines().find(|l| l.starts_with("view ")).unwrap_or_else(|| panic!("no progress in {said}"));
    // Two held-out views and two training views are scored.
    let (view, left) = line.split_once("; ").unwrap_or_else(|| panic!("no time left in {line}"));
    assert!(view.starts_with("view 1 of 4 (images/view_00): "), "{line}");
    let time = left.strip_suffix(" s left").or(left.strip_suffix(" min left")).unwrap_or_else(|| panic!("{line}"));
    time.parse::<u32>().unwrap();
}

#[test]
fn eval_explains_how_many_training_views_see_what_a_view_shows() {
    let (dir, run) = copy();
    let folder = dir.path();
    let o = call(folder, &["eval", s(&run), "--device", "cpu", "--explain", "--json"]);
    assert!(o.status.success(), "{}", String::from_utf8_lossy(&o.stderr));
    let report: serde_json::Value = serde_json::from_slice(&o.stdout).unwrap();
    let views = report["seen_by"].as_array().unwrap();
    assert_eq!(views.len(), report["per_view"].as_array().unwrap().len());
    for v in views {
        let shares: Vec<f64> = v["shares"].as_array().unwrap().iter().map(|s| s.as_f64().unwrap()).collect();
        assert!(shares.len() == 5 && (shares.iter().sum::<f64>() - 1.0).abs() < 1e-6, "{v}");
        // Cameras all around the still life look at its center.
        assert!(shares[4] > 0.3, "{v}");
        let errors = v["errors"].as_array().unwrap()[2..].iter().filter_map(|e| e.as_f64());
        let (worst, best) = errors.fold((f64::INFINITY, 0.0f64), |(w, b), e| (w.min(-10.0 * e.log10()), b.max(-10.0 * e.log10())));
        let seen = v["psnr_where_seen"].as_f64().unwrap();
        assert!(worst <= seen && seen <= best, "{worst} to {best}: {seen}");
        let map = photo::load(&run.join("eval").join(format!("{}.seen.png", v["name"].as_str().unwrap().replace('/', "_")))).unwrap();
        assert!(map.data.chunks_exact(map.channels).any(|p| p[..3] == [60, 150, 90]), "green where four or more see it");
    }
    let told = works(folder, &["eval", s(&run), "--device", "cpu", "--explain"]);
    assert!(told.contains("training views that see what a view shows") && told.lines().any(|l| l.contains("images/view_00")), "{told}");
    assert!(told.contains("where two or more training views see it: psnr "), "{told}");
}

/// Number of video frames that the machine's ffmpeg decodes without complaint; without ffmpeg, prints that this was skipped.
#[cfg(unix)]
fn decoded(film: &Path) -> Option<usize> {
    let Ok(ffmpeg) = diorama_data::video::ffmpeg() else {
        assert!(std::env::var_os("DIORAMA_REQUIRE_FFMPEG").is_none(), "ffmpeg is required");
        println!("skipped: no ffmpeg");
        return None;
    };
    let all = ["-v", "warning", "-xerror", "-i", s(film), "-map", "0:v", "-f", "framemd5", "-"];
    let o = Command::new(ffmpeg).args(all).output().unwrap();
    let said = String::from_utf8_lossy(&o.stderr);
    assert!(o.status.success() && said.is_empty(), "{said}");
    Some(String::from_utf8(o.stdout).unwrap().lines().filter(|l| !l.starts_with('#')).count())
}

#[cfg(unix)]
#[test]
fn an_interrupted_film_has_the_frames_so_far() {
    let dir = tempfile::tempdir().unwrap();
    let film = |name: &str, frames: usize| {
        let child = Command::new(env!("CARGO_BIN_EXE_diorama"))
            .args(["render", s(&good().run), "--device", "cpu", "--size", "64x64", "--frames", "2000", "--video", name])
            .args(["--images", "frames"])
            .current_dir(dir.path())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let begin = Instant::now();
        while !dir.path().join(format!("frames/{frames:04}.png")).exists() {
            assert!(begin.elapsed() < Duration::from_secs(100), "no frames come");
            std::thread::sleep(Duration::from_millis(5));
        }
        assert!(Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap().success());
        let o = child.wait_with_output().unwrap();
        let _ = std::fs::remove_dir_all(dir.path().join("frames"));
        let (out, said) = (String::from_utf8_lossy(&o.stdout).into_owned(), String::from_utf8_lossy(&o.stderr).into_owned());
        assert_eq!(o.status.code(), Some(130), "{said}");
        let done: usize = out.split(' ').next().unwrap().parse().unwrap();
        assert!((frames..2000).contains(&done) && said.contains(&format!("ends with frame {done}")), "{out}{said}");
        assert!(out.contains(name), "{out}");
        (std::fs::read(dir.path().join(name)).unwrap(), done)
    };
    let (mp4, done) = film("a.mp4", 2);
    let stsz = mp4.windows(4).position(|w| w == b"stsz").unwrap();
    assert_eq!(u32::from_be_bytes(mp4[stsz + 12..stsz + 16].try_into().unwrap()) as usize, done, "frames of the film");
    assert!(mp4[4..8] == *b"ftyp" && mp4.windows(4).any(|w| w == b"mdat"));
    decoded(&dir.path().join("a.mp4")).into_iter().for_each(|frames| assert_eq!(frames, done));
    let (gif, done) = film("a.gif", 1);
    assert!(gif.starts_with(b"GIF89a") && gif.last() == Some(&0x3b), "it has its end");
    decoded(&dir.path().join("a.gif")).into_iter().for_each(|frames| assert_eq!(frames, done));
}

#[test]
fn films_are_what_their_names_say() {
    let dir = tempfile::tempdir().unwrap();
    let run = s(&good().run);
    works(dir.path(), &["render", run, "--frames", "3", "--size", "32x24", "--video", "a.gif", "--device", "cpu"]);
    assert_eq!(diorama_data::photo::size(&dir.path().join("a.gif")).unwrap(), (32, 24));
    assert!(std::fs::read(dir.path().join("a.gif")).unwrap().starts_with(b"GIF89a"));
    for (name, why) in [("a.webm", "not as .webm"), ("film", "names no format"), ("no/a.mp4", "not a folder")] {
        fails(dir.path(), &["render", run, "--frames", "3", "--size", "32x24", "--video", name, "--device", "cpu"], 2, &[why]);
        assert!(!dir.path().join(name).exists());
    }
}

#[test]
fn every_run_is_looked_at_before_the_first_is_judged() {
    let dir = tempfile::tempdir().unwrap();
    let (_copy, damaged) = copy();
    std::fs::remove_dir_all(damaged.join("checkpoints")).unwrap();
    // Photographs that disappeared after training, and a run without held-out views.
    write_capture(&dir.path().join("data"), 8, 24).unwrap();
    works(dir.path(), &[&["train", "data", "-o", "bare", "--steps", "1"], &SMALL[..]].concat());
    works(dir.path(), &[&["train", "data", "-o", "all", "--steps", "1", "--split", "all"], &SMALL[..]].concat());
    std::fs::rename(dir.path().join("data/images/view_00.png"), dir.path().join("data/away.png")).unwrap();
    let capture = s(&good().capture);
    works(dir.path(), &[&["train", capture, "-o", "whole", "--steps", "1", "--split", "all"], &SMALL[..]].concat());
    for (second, why) in [
        ("missing", "not a run folder"),
        (s(&damaged), "no checkpoint"),
        ("bare", "does not exist"),
        ("all", "does not exist"),
        ("whole", "holds no views out"),
    ] {
        let second_named = if why == "does not exist" { "view_00.png" } else { second };
        let said = fails(dir.path(), &["compare", s(&good().run), second, "-o", "cmp"], 2, &[second_named, why]);
        assert!(!said.contains("judging") && !dir.path().join("cmp").exists(), "{said}");
    }
}

#[test]
fn compare_shows_the_memory_of_training() {
    let dir = tempfile::tempdir().unwrap();
    let run = s(&good().run);
    let table: serde_json::Value = serde_json::from_str(&works(dir.path(), &["compare", run, "-o", "cmp", "--json"])).unwrap();
    // An earlier comparison is replaced, a folder with other content is not.
    let text = works(dir.path(), &["compare", run, "-o", "cmp"]);
    assert!(text.lines().next().unwrap().contains("memory"), "{text}");
    std::fs::create_dir(dir.path().join("mine")).unwrap();
    std::fs::write(dir.path().join("mine/views.png"), b"mine").unwrap();
    fails(dir.path(), &["compare", run, "-o", "mine"], 2, &["mine", "holds no comparison"]);
    assert_eq!(std::fs::read(dir.path().join("mine/views.png")).unwrap(), b"mine");
    if cfg!(target_os = "linux") {
        assert!((10 << 20..8 << 30).contains(&table[0]["peak_memory_bytes"].as_u64().unwrap()), "{table}");
        assert!(text.contains("MiB") || text.contains("GiB"), "{text}");
    }
}

#[test]
fn what_was_saved_in_the_viewer_is_never_ignored() {
    let crops = ["{\"min\":[0,0,0]", "{\"min\":[0,0,0],\"max\":[0,1,1]}", "{\"min\":[0,0,0],\"max\":[1,1,1],\"turn\":1}", ""];
    let scales = ["{\"points\":[[0,0,0],[0,0,0]],\"metres\":1}", "{\"points\":[[0,0,0],[0,0,1]],\"metres\":-1}", "[]"];
    let paths = ["{}", "[]", "{\"camera_path\":[{\"camera_to_world\":[1,2]}],\"render_width\":64,\"render_height\":48}"];
    let view: &[&str] = &["view", ".", "--port", "0", "--device", "cpu"];
    let train: &[&str] = &["train", "-o", ".", "--resume", "--steps", "61", "--view", "--port", "0"];
    let export: &[&str] = &["export", ".", "-o", "new", "--format", "ply", "--resolution", "16", "--level", "0.01", "--device", "cpu"];
    let render: &[&str] = &["render", ".", "--frames", "1", "--size", "16x16", "--images", "new", "--device", "cpu"];
    let deep: &[&str] = &["render", ".", "--frames", "1", "--size", "16x16", "--images", "new", "--layers", "depth", "--device", "cpu"];
    let along: &[&str] = &["render", ".", "--path", "camera_path.json", "--images", "new", "--device", "cpu"];
    let (_dir, run) = copy();
    let summary = std::fs::read(run.join("summary.json")).unwrap();
    for (name, texts, verbs) in [
        ("crop.json", &crops[..], &[export, render, deep, train, view][..]),
        ("scale.json", &scales, &[export, deep, train, view]),
        ("camera_path.json", &paths, &[along, train, view]),
    ] {
        for text in texts {
            std::fs::write(run.join(name), text).unwrap();
            for verb in verbs {
                // A path given by the user is the user's file: the error does not mention the viewer.
                let cure = if std::ptr::eq(*verb, along) { name } else { "remove the file" };
                fails(&run, verb, 2, &[name, cure]);
                assert!(!run.join("new").exists(), "{verb:?} left something behind");
            }
        }
        std::fs::remove_file(run.join(name)).unwrap();
    }
    assert_eq!(std::fs::read(run.join("summary.json")).unwrap(), summary, "nothing was trained");
}

#[test]
fn a_port_in_use_leaves_no_folder() {
    let dir = tempfile::tempdir().unwrap();
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let port = taken.local_addr().unwrap().port().to_string();
    let view = ["--view", "--port", &port];
    fails(dir.path(), &[&["train", s(&good().capture), "-o", "run", "--steps", "1"], &view[..], &SMALL].concat(), 2, &["--port", "in use"]);
    assert!(!dir.path().join("run").exists());
}

#[test]
fn held_out_photographs_that_cannot_be_read_are_named() {
    let dir = tempfile::tempdir().unwrap();
    let data = dir.path().join("data");
    copy_all(&good().capture, &data);
    std::fs::write(data.join("images/view_08.png"), b"no picture").unwrap();
    let all = [&["train", "data", "-o", "run", "--steps", "1", "--split", "every:8"], &SMALL[..]].concat();
    fails(dir.path(), &all, 2, &["view_08.png"]);
    assert!(!dir.path().join("run").exists());
}

#[test]
fn training_and_eval_tell_of_held_out_and_training_views() {
    let dir = tempfile::tempdir().unwrap();
    let all = [&["train", s(&good().capture), "-o", "run", "--steps", "40", "--json", "--split", "every:4"], &SMALL[..]].concat();
    let trained: serde_json::Value =
        serde_json::from_str(&works(dir.path(), &[&all[..], &["--set", "run.evaluate_every=10", "--set", "run.log_every=10"]].concat()))
            .unwrap();
    assert!((3.0..60.0).contains(&trained["psnr_held_out"].as_f64().unwrap()), "{trained}");
    let log = std::fs::read_to_string(dir.path().join("run/metrics.jsonl")).unwrap();
    assert_eq!(log.lines().filter(|l| l.contains("val_psnr")).count(), 4, "{log}");
    assert!(std::fs::read_to_string(dir.path().join("run/curves.svg")).unwrap().contains("held out"));
    let report: serde_json::Value = serde_json::from_str(&works(dir.path(), &["eval", "run", "--device", "cpu", "--json"])).unwrap();
    assert_eq!((report["views"].as_u64(), report["training"]["views"].as_u64()), (Some(4), Some(4)));
    let gap = report["training"]["psnr"].as_f64().unwrap() - report["psnr"].as_f64().unwrap();
    assert!((report["gap"].as_f64().unwrap() - gap).abs() < 1e-9);
    assert!(report["per_view"][0]["behind_fog"].is_boolean());
    // A run that overfits its training views: two of them, opposite each other.
    let json = dir.path().join("few/transforms.json");
    copy_all(&good().capture, &dir.path().join("few"));
    let mut few: serde_json::Value = serde_json::from_slice(&std::fs::read(&json).unwrap()).unwrap();
    let names = |i: &[usize]| i.iter().map(|i| few["frames"][*i]["file_path"].clone()).collect::<Vec<_>>();
    let (train, test) = (names(&[1, 2]), names(&[0, 5, 8, 12]));
    (few["train_filenames"], few["test_filenames"]) = (train.clone().into(), test.clone().into());
    few["frames"].as_array_mut().unwrap().retain(|f| train.contains(&f["file_path"]) || test.contains(&f["file_path"]));
    std::fs::write(&json, few.to_string()).unwrap();
    works(dir.path(), &[&["train", "few", "-o", "by_heart", "--steps", "300"], &SMALL[..]].concat());
    let said = works(dir.path(), &["eval", "by_heart", "--device", "cpu"]);
    for part in ["training views: psnr", "dB below training views", "fog", "helps", "behind fog: "] {
        assert!(said.contains(part), "{part:?} is not in {said}");
    }
    let summary: serde_json::Value = serde_json::from_slice(&std::fs::read(dir.path().join("by_heart/summary.json")).unwrap()).unwrap();
    assert!(!summary["behind_fog"].as_array().unwrap().is_empty(), "{summary}");
}
