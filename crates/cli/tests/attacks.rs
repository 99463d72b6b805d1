//! Twenty faults that a trusted system survives, tested on the release program. Each test is named after its fault. For formats that the
//! program does not read, the file must be refused.

#[path = "program/mod.rs"]
mod support;

use diorama_data::checkpoint;
use diorama_pipelines::object::quickstart::write_capture;
use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::sync::OnceLock;
use std::time::{Duration, Instant};
use support::{Small, copy_of as copy};

fn program() -> Command {
    let mut c = Command::new(env!("CARGO_BIN_EXE_diorama"));
    c.stdin(Stdio::null());
    c
}

fn diorama(args: &[&str]) -> Output {
    program().args(args).output().unwrap()
}

struct Good {
    _dir: tempfile::TempDir,
    capture: PathBuf,
    run: PathBuf,
}

/// A valid capture with a short run on it, made once.
fn good() -> &'static Good {
    static GOOD: OnceLock<Good> = OnceLock::new();
    GOOD.get_or_init(|| {
        let dir = tempfile::tempdir().unwrap();
        let (capture, run) = (dir.path().join("capture"), dir.path().join("run"));
        write_capture(&capture, 8, 24).unwrap();
        assert!(train(&capture, &run, &["--steps", "6", "--set", "run.save_every_steps=2"]).status.success());
        Good { _dir: dir, capture, run }
    })
}

fn train(data: &Path, run: &Path, extra: &[&str]) -> Output {
    let mut c = program();
    c.arg("train").arg(data).arg("--out").arg(run).args(["--device", "cpu", "--set", "field.log2_size=10"]).args(extra);
    c.output().unwrap()
}

fn edit(capture: &Path, change: impl FnOnce(&mut serde_json::Value)) {
    let file = capture.join("transforms.json");
    let mut json: serde_json::Value = serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
    change(&mut json);
    std::fs::write(file, json.to_string()).unwrap();
}

/// Expects one line that names the fault, the given exit code, and no panic.
#[track_caller]
fn fails(o: &Output, code: i32, expected: &[&str]) {
    let text = String::from_utf8_lossy(&o.stderr);
    assert_eq!(o.status.code(), Some(code), "{text}");
    assert!(!text.contains("panicked"), "{text}");
    let errors: Vec<&str> = text.lines().filter(|l| l.starts_with("diorama: ")).collect();
    assert_eq!(errors.len(), 1, "one line: {text}");
    for e in expected {
        assert!(errors[0].contains(e), "{e:?} is not in {:?}", errors[0]);
    }
}

/// Trains on a damaged copy of the valid capture: it must be refused and leave nothing behind.
#[track_caller]
fn refused(expected: &[&str], spoil: impl FnOnce(&Path)) {
    let (dir, capture) = copy(&good().capture);
    spoil(&capture);
    let run = dir.path().join("run");
    fails(&train(&capture, &run, &["--steps", "1"]), 2, expected);
    assert!(!run.exists(), "something was left behind");
}

/// A file that is not a capture, under a name that says what it is.
#[track_caller]
fn not_read(name: &str, content: &[u8]) {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join(name);
    std::fs::write(&file, content).unwrap();
    let run = dir.path().join("run");
    fails(&train(&file, &run, &["--steps", "1"]), 2, &[]);
    assert!(!run.exists());
    fails(&diorama(&["eval", file.to_str().unwrap()]), 2, &["not a run folder"]);
}

#[test]
fn fault_01_kill_in_a_save_leaves_a_file_that_loads_and_no_stale_temporaries() {
    // Random kills are tested in kill_and_resume.rs; this test places the leftovers of such a kill by hand.
    let (_dir, run) = copy(&good().run);
    let partial = run.join("checkpoints/latest.safetensors.partial");
    std::fs::write(&partial, b"half").unwrap();
    assert!(diorama(&["train", "--out", run.to_str().unwrap(), "--resume", "--steps", "8"]).status.success());
    assert!(!partial.exists());
    checkpoint::load(&run.join("checkpoints")).unwrap();
}

#[test]
fn fault_02_a_full_disk_names_the_file_and_keeps_the_old_one() {
    let dir = tempfile::tempdir().unwrap();
    let Some(small) = Small::mount(&dir.path().join("small")) else {
        println!("skipped: no right to mount a small file system");
        return;
    };
    let old = small.0.join("mesh.glb");
    std::fs::write(&old, b"the old mesh").unwrap();
    std::fs::write(small.0.join("filler"), vec![0; 1000 << 10]).unwrap();
    let run = good().run.to_str().unwrap();
    let export = |out: &Path| {
        diorama(&[
            "export",
            run,
            "-o",
            out.to_str().unwrap(),
            "--force",
            "--resolution",
            "24",
            "--texture",
            "64",
            "--level",
            "0.01",
            "--device",
            "cpu",
        ])
    };
    fails(&export(&old), 1, &["mesh.glb", "cannot write", "space"]);
    assert_eq!(std::fs::read(&old).unwrap(), b"the old mesh");
    assert_eq!(small.0.read_dir().unwrap().count(), 2, "a part was left");
    let frames = small.0.join("frames");
    let o = diorama(&[
        "render",
        run,
        "--images",
        frames.to_str().unwrap(),
        "--size",
        "32x24",
        "--frames",
        "40",
        "--quality",
        "fast",
        "--device",
        "cpu",
    ]);
    fails(&o, 1, &["frames/", "cannot write"]);
    // A run whose checkpoint does not fit on the disk.
    std::fs::remove_dir_all(&frames).unwrap();
    let o = train(&good().capture, &small.0.join("run"), &["--steps", "4", "--set", "field.log2_size=16"]);
    fails(&o, 1, &["small/run", "cannot write"]);
}

#[test]
fn fault_03_resume_after_a_kill_is_bit_equal() {
    let dir = tempfile::tempdir().unwrap();
    let (whole, parts) = (dir.path().join("whole"), dir.path().join("parts"));
    let start = |run: &Path, resume: bool| {
        let mut c = program();
        c.arg("train").arg("--out").arg(run).args(["--steps", "400"]).stdout(Stdio::null()).stderr(Stdio::null());
        if resume {
            c.arg("--resume");
        } else {
            c.arg(&good().capture).args([
                "--device",
                "cpu",
                "--seed",
                "5",
                "--set",
                "field.log2_size=12",
                "--set",
                "run.save_every_steps=3",
            ]);
        }
        c.spawn().unwrap()
    };
    assert!(start(&whole, false).wait().unwrap().success());
    let mut child = start(&parts, false);
    let begin = Instant::now();
    while !checkpoint::exists(&parts.join("checkpoints")) && begin.elapsed() < Duration::from_secs(60) {
        std::thread::sleep(Duration::from_millis(1));
    }
    child.kill().unwrap();
    child.wait().unwrap();
    let step = |run: &Path| checkpoint::load(&run.join("checkpoints")).unwrap().0.metadata["step"].parse::<u32>().unwrap();
    assert!(step(&parts) < 400, "it ended before it could be killed");
    assert!(start(&parts, true).wait().unwrap().success());
    let bits = |run: &Path| {
        let mut c = checkpoint::read(&checkpoint::latest(&run.join("checkpoints"))).unwrap();
        c.tensors.sort_by(|a, b| a.0.cmp(&b.0));
        c.tensors.into_iter().map(|t| (t.0, t.2.iter().map(|v| v.to_bits()).collect::<Vec<_>>())).collect::<Vec<_>>()
    };
    assert!(bits(&whole) == bits(&parts), "the runs differ");
    assert_eq!(step(&parts), 400);
}

#[test]
fn fault_04_a_damaged_checkpoint_falls_back_to_the_previous_one() {
    let (_dir, run) = copy(&good().run);
    let latest = run.join("checkpoints/latest.safetensors");
    let bytes = std::fs::read(&latest).unwrap();
    let mut flipped = bytes.clone();
    let at = flipped.len() - 100;
    flipped[at] ^= 4;
    for damaged in [&bytes[..bytes.len() / 2], &flipped] {
        std::fs::write(&latest, damaged).unwrap();
        let o = diorama(&["eval", run.to_str().unwrap(), "--device", "cpu"]);
        let said = String::from_utf8_lossy(&o.stderr).into_owned();
        assert!(o.status.success() && said.contains("note:") && said.contains("previous"), "{said}");
    }
}

#[test]
fn fault_05_a_checkpoint_of_another_version_is_told() {
    let (_dir, run) = copy(&good().run);
    let _ = std::fs::remove_file(run.join("checkpoints/previous.safetensors"));
    let latest = run.join("checkpoints/latest.safetensors");
    let mut bytes = std::fs::read(&latest).unwrap();
    let at = bytes.windows(13).position(|w| w == b"\"version\":\"1\"").unwrap();
    bytes[at + 11] = b'9';
    std::fs::write(&latest, bytes).unwrap();
    fails(&diorama(&["eval", run.to_str().unwrap()]), 2, &["version 9"]);
}

#[test]
fn fault_06_numbers_that_are_not_finite_name_the_frame_and_never_reach_a_checkpoint() {
    refused(&["frames[1].transform_matrix"], |c| edit(c, |j| j["frames"][1]["transform_matrix"][0][3] = 1e300.into()));
    // With this learning rate the loss becomes non-finite after one step: the run is restarted once, then stopped.
    let dir = tempfile::tempdir().unwrap();
    let run = dir.path().join("run");
    let wild = ["--method", "mlp", "--steps", "8", "--set", "sampling.rays=64", "--set", "sampling.samples=8", "--set", "optim.rate=1e30"];
    let o = train(&good().capture, &run, &wild);
    let told = String::from_utf8_lossy(&o.stderr).into_owned();
    assert!(told.contains("step 1: the loss was not finite; the rate is lowered; back to step 0"), "{told}");
    fails(&o, 1, &["not finite at step 1, and again at step 1", "no checkpoint yet", "--set optim.rate"]);
    assert!(!told.contains("safetensors") && !run.exists(), "{told}");
    // The same in a run that has a checkpoint, which stays valid and finite.
    let gentle = ["--method", "mlp", "--steps", "2", "--set", "sampling.rays=64", "--set", "sampling.samples=8"];
    assert!(train(&good().capture, &run, &gentle).status.success());
    let mut c = program();
    c.arg("train").arg("--out").arg(&run).args(["--resume", "--steps", "60", "--set", "optim.rate=1e30"]);
    let latest = checkpoint::latest(&run.join("checkpoints"));
    fails(&c.output().unwrap(), 1, &["not finite at step", latest.to_str().unwrap(), "is the last good checkpoint"]);
    let kept = checkpoint::read(&latest).unwrap();
    assert_eq!(kept.metadata["step"], "2");
    assert!(kept.tensors.iter().all(|t| t.2.iter().all(|v| v.is_finite())), "a checkpoint holds NaN");
}

#[test]
fn fault_07_numbers_beyond_f32_and_rotations_that_are_none() {
    refused(&["frames[0].fl_x"], |c| {
        let file = c.join("transforms.json");
        edit(c, |j| j["frames"][0]["fl_x"] = "HUGE".into());
        let text = std::fs::read_to_string(&file).unwrap().replace("\"HUGE\"", "1e39");
        std::fs::write(file, text).unwrap();
    });
    refused(&["transform_matrix"], |c| edit(c, |j| j["frames"][2]["transform_matrix"][0][0] = 3.0.into()));
}

#[test]
fn fault_08_json_nested_100_000_deep() {
    refused(&["recursion limit"], |c| {
        std::fs::write(c.join("transforms.json"), format!("{{\"a\":{}1{}}}", "[".repeat(100_000), "]".repeat(100_000))).unwrap();
    });
}

#[test]
fn fault_09_paths_that_lead_out_of_the_data_set() {
    let secret = tempfile::tempdir().unwrap();
    std::fs::copy(good().capture.join("images/view_00.png"), secret.path().join("x.png")).unwrap();
    let outside = secret.path().join("x.png");
    for name in
        ["../../etc/passwd", "/etc/passwd", outside.to_str().unwrap(), "C:\\x.png", "\\\\server\\share\\x.png", "images/../../x.png"]
    {
        refused(&["leads out"], |c| edit(c, |j| j["frames"][0]["file_path"] = name.into()));
    }
    #[cfg(unix)]
    refused(&["leads out"], |c| {
        std::os::unix::fs::symlink(&outside, c.join("images/link.png")).unwrap();
        edit(c, |j| j["frames"][0]["file_path"] = "images/link.png".into());
    });
}

#[test]
fn fault_10_gltf_files_are_not_read() {
    not_read("x.gltf", br#"{"asset":{"version":"2.0"},"buffers":[{"uri":"file:///etc/passwd","byteLength":9}]}"#);
}

#[test]
fn fault_11_obj_files_are_not_read() {
    not_read("x.obj", b"mtllib ../../x\nv 0 0 0\n");
}

#[test]
fn fault_12_zip_slips_links_and_bombs() {
    let dir = tempfile::tempdir().unwrap();
    let zip = dir.path().join("capture.zip");
    let make = |fill: &dyn Fn(&mut zip::ZipWriter<std::fs::File>)| {
        let mut w = zip::ZipWriter::new(std::fs::File::create(&zip).unwrap());
        fill(&mut w);
        w.finish().unwrap();
        train(&zip, &dir.path().join("run"), &["--steps", "1"])
    };
    let put = |w: &mut zip::ZipWriter<std::fs::File>, name: &str, data: &[u8]| {
        let deflated = zip::write::SimpleFileOptions::default().compression_method(zip::CompressionMethod::Deflated);
        w.start_file(name, deflated).unwrap();
        w.write_all(data).unwrap();
    };
    fails(&make(&|w| put(w, "../../evil", b"x")), 2, &["capture.zip", "leads out"]);
    fails(&make(&|w| w.add_symlink("images", "/etc", zip::write::SimpleFileOptions::default()).unwrap()), 2, &["is a link"]);
    fails(&make(&|w| put(w, "b", &vec![0; 16 << 20])), 2, &["a bomb"]);
    assert_eq!(dir.path().read_dir().unwrap().count(), 1, "something was unpacked");
    // A valid capture trains.
    let o = make(&|w| {
        put(w, "chair/transforms.json", &std::fs::read(good().capture.join("transforms.json")).unwrap());
        for e in good().capture.join("images").read_dir().unwrap().flatten() {
            put(w, &format!("chair/images/{}", e.file_name().to_string_lossy()), &std::fs::read(e.path()).unwrap());
        }
    });
    assert!(o.status.success(), "{}", String::from_utf8_lossy(&o.stderr));
}

#[test]
fn fault_13_images_that_claim_to_be_huge() {
    refused(&["view_03.png", "limit"], |c| {
        let image = c.join("images/view_03.png");
        let mut png = std::fs::read(&image).unwrap();
        png[16..20].copy_from_slice(&60_000u32.to_be_bytes());
        png[20..24].copy_from_slice(&60_000u32.to_be_bytes());
        let crc = crc32fast::hash(&png[12..29]);
        png[29..33].copy_from_slice(&crc.to_be_bytes());
        std::fs::write(&image, png).unwrap();
    });
    refused(&["view_03.hdr", "limit"], |c| {
        std::fs::remove_file(c.join("images/view_03.png")).unwrap();
        std::fs::write(c.join("images/view_03.hdr"), b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 100000 +X 100000\n").unwrap();
        edit(c, |j| j["frames"][3]["file_path"] = "images/view_03.hdr".into());
    });
}

#[test]
fn fault_14_an_npy_header_that_claims_a_trillion_numbers() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::create_dir(dir.path().join("images")).unwrap();
    std::fs::copy(good().capture.join("images/view_00.png"), dir.path().join("images/a.png")).unwrap();
    let mut npy = b"\x93NUMPY\x01\x00\x76\x00".to_vec();
    let header = "{'descr': '<f8', 'fortran_order': False, 'shape': (58823529411, 17), }";
    npy.extend(format!("{header:<117}\n").as_bytes());
    std::fs::write(dir.path().join("poses_bounds.npy"), npy).unwrap();
    fails(&train(dir.path(), &dir.path().join("run"), &["--steps", "1"]), 2, &["poses_bounds.npy"]);
}

#[test]
fn fault_15_a_ply_that_claims_too_many_vertices() {
    let claim = b"ply\nformat binary_little_endian 1.0\nelement vertex 4000000000000\nproperty float x\nend_header\n";
    not_read("x.ply", claim);
    let file = good().capture.join("claim.ply");
    std::fs::write(&file, claim).unwrap();
    fails(&diorama(&["view", file.to_str().unwrap(), "--port", "0"]), 2, &["claim.ply", "room"]);
    std::fs::remove_file(&file).unwrap();
    // It is also refused if a capture names it.
    let (dir, capture) = copy(&good().capture);
    std::fs::write(capture.join("x.ply"), b"ply\nformat ascii 1.0\nelement vertex 4000000000000\nend_header\n").unwrap();
    edit(&capture, |j| j["ply_file_path"] = "x.ply".into());
    fails(&train(&capture, &dir.path().join("run"), &["--steps", "1"]), 2, &["x.ply", "room"]);
}

#[test]
fn fault_16_nbt_is_not_read() {
    not_read("level.dat", &[9; 4096]);
}

#[test]
fn fault_17_anvil_regions_are_not_read() {
    not_read("r.0.0.mca", &[0xff; 8192]);
}

#[test]
fn fault_18_pickles_are_not_read() {
    let pickle = b"\x80\x04\x95cposix\nsystem\n(S'touch /tmp/owned'\ntR.";
    not_read("weights.pth", pickle);
    let (_dir, run) = copy(&good().run);
    let _ = std::fs::remove_file(run.join("checkpoints/previous.safetensors"));
    std::fs::write(run.join("checkpoints/latest.safetensors"), pickle).unwrap();
    fails(&diorama(&["eval", run.to_str().unwrap()]), 2, &["latest.safetensors"]);
}

/// Weights are read from pickles, but nothing in them is executed.
#[test]
fn fault_18_weights_that_would_run_a_program_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let (file, owned) = (dir.path().join("weights.pth"), dir.path().join("owned"));
    let command = format!("touch {}", owned.display());
    // The format of torch.save before 1.6: a magic number, a version, system information, and then a call instead of names and tensors.
    let mut bytes =
        b"\x80\x02\x8a\x0a\x6c\xfc\x9c\x46\xf9\x20\x6a\xa8\x50\x19.\x80\x02M\xe9\x03.\x80\x02}.\x80\x02}X\x01\0\0\0wcposix\nsystem\nX"
            .to_vec();
    bytes.extend((command.len() as u32).to_le_bytes());
    bytes.extend(command.as_bytes());
    bytes.extend(b"\x85Rs.\x80\x02].");
    std::fs::write(&file, bytes).unwrap();
    let run = good().run.to_str().unwrap();
    fails(&diorama(&["eval", run, "--device", "cpu", "--lpips", file.to_str().unwrap()]), 2, &["weights.pth", "would run posix.system"]);
    assert!(!owned.exists());
}

#[test]
fn fault_19_hostile_pages_slow_clients_and_huge_frames() {
    let mut child = program()
        .args(["view", good().run.to_str().unwrap(), "--port", "0", "--json", "--device", "cpu"])
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let mut line = String::new();
    let mut out = child.stdout.take().unwrap();
    let mut byte = [0];
    while !line.ends_with('\n') && out.read(&mut byte).unwrap() > 0 {
        line.push(byte[0] as char);
    }
    let json: serde_json::Value = serde_json::from_str(&line).unwrap();
    let host = json["address"].as_str().unwrap().trim_start_matches("http://").trim_end_matches('/').to_string();
    let ask = |head: &str| {
        let mut s = TcpStream::connect(&host).unwrap();
        s.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
        // A refused connection may be closed before the request is written completely.
        let _ = s.write_all(head.as_bytes());
        let mut answer = [0; 12];
        s.read_exact(&mut answer).map(|()| String::from_utf8_lossy(&answer[9..]).into_owned()).unwrap_or_default()
    };
    let socket =
        "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n";
    assert_eq!(ask(&format!("GET /socket HTTP/1.1\r\nHost: {host}\r\nOrigin: http://evil.example\r\n{socket}")), "403");
    assert_eq!(ask(&format!("GET /socket HTTP/1.1\r\nHost: evil.example\r\nOrigin: http://evil.example\r\n{socket}")), "403");
    assert_ne!(ask(&format!("GET /{} HTTP/1.1\r\nHost: {host}\r\n\r\n", "x".repeat(20_000))), "200");
    // Sixty clients that never finish their requests block others only until their time limit.
    let slow: Vec<TcpStream> = (0..60).filter_map(|_| TcpStream::connect(&host).ok()).collect();
    let begin = Instant::now();
    while ask(&format!("GET / HTTP/1.1\r\nHost: {host}\r\n\r\n")) != "200" {
        assert!(begin.elapsed() < Duration::from_secs(30), "slow clients keep others out");
        std::thread::sleep(Duration::from_millis(200));
    }
    drop(slow);
    // A frame that claims 2 GiB ends its connection, not the program.
    let mut s = TcpStream::connect(&host).unwrap();
    s.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
    s.write_all(format!("GET /socket HTTP/1.1\r\nHost: {host}\r\nOrigin: http://{host}\r\n{socket}").as_bytes()).unwrap();
    s.write_all(&[&[0x81, 0xff][..], &(2u64 << 30).to_be_bytes(), &[1, 2, 3, 4]].concat()).unwrap();
    let mut rest = Vec::new();
    let _ = s.read_to_end(&mut rest);
    assert!(rest.starts_with(b"HTTP/1.1 101"));
    assert_eq!(ask(&format!("GET / HTTP/1.1\r\nHost: {host}\r\n\r\n")), "200");
    assert!(child.try_wait().unwrap().is_none());
    child.kill().unwrap();
    child.wait().unwrap();
    // The port is in use.
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let port = taken.local_addr().unwrap().port().to_string();
    fails(&diorama(&["view", good().run.to_str().unwrap(), "--port", &port, "--device", "cpu"]), 2, &["--port", "in use"]);
}

#[test]
fn fault_20_missing_programs_and_devices_are_told_before_any_work() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("data");
    let images = good().capture.join("images");
    let without = |input: &Path| {
        let mut c = program();
        c.env("PATH", dir.path()).env_remove("DIORAMA_COLMAP").arg("prepare").arg(input).arg("-o").arg(&out);
        c.output().unwrap()
    };
    fails(&without(&images), 2, &["colmap", "install"]);
    assert!(!out.exists());
    for device in ["cuda", "metal"] {
        let run = dir.path().join("run");
        let mut c = program();
        c.arg("train").arg(&good().capture).arg("--out").arg(&run).args(["--steps", "1", "--device", device]);
        fails(&c.output().unwrap(), 2, &[device]);
        assert!(!run.exists());
    }
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        // If COLMAP fails, the error gives the reason and the location of its log, and the work can be resumed.
        let broken = dir.path().join("colmap");
        std::fs::write(&broken, "#!/bin/sh\necho out of memory >&2\nexit 7\n").unwrap();
        std::fs::set_permissions(&broken, std::fs::Permissions::from_mode(0o755)).unwrap();
        let mut c = program();
        c.env("DIORAMA_COLMAP", &broken).arg("prepare").arg(&images).arg("-o").arg(&out);
        fails(&c.output().unwrap(), 1, &["out of memory", "colmap.log"]);
        assert!(out.join("images").is_dir());
    }
}
