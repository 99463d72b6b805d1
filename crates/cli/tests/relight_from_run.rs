//! `relight object --from-run` and `export --materials`: opaque photographs before a background become an object without any mask.

mod program;

use diorama_data::{checkpoint, model_file, photo};
use diorama_geom::ImageU8;
use program::{copy_all, fails, s, works};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::OnceLock;
use std::time::{Duration, Instant};

const MATERIALS: &str = "newmtl red\nKd 0.7 0.15 0.1\nnewmtl blue\nKd 0.1 0.2 0.6\n";
/// Around the box.
const CLIP: &str = "-1.3,-1.3,-1.3,1.3,1.3,1.3";

/// A box with sides in 4×4 checks of two colors, from −1 to 1.
fn checked_box() -> String {
    let mut text = String::from("mtllib box.mtl\n");
    for (side, i, j) in (0..6).flat_map(|s| (0..16).map(move |k| (s, k % 4, k / 4))) {
        let (axis, sign) = (side / 2, [-1.0, 1.0][side % 2]);
        let corners = [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)].map(|(a, b)| {
            let mut p = [0.0; 3];
            // The order of the corners turns with the side, so that they face outward.
            (p[axis], p[(axis + 1) % 3], p[(axis + 2) % 3]) = (sign, sign * (0.5 * a as f64 - 1.0), 0.5 * b as f64 - 1.0);
            p
        });
        corners.iter().for_each(|p| text += &format!("v {} {} {}\n", p[0], p[1], p[2]));
        text += &format!("usemtl {}\nf -4 -3 -2 -1\n", if (i + j) % 2 == 0 { "red" } else { "blue" });
    }
    text
}

struct Good {
    _folder: tempfile::TempDir,
    data: PathBuf,
    run: PathBuf,
}

/// Opaque photographs of the box before white, and a run on them without any mask, made once.
fn good() -> &'static Good {
    static GOOD: OnceLock<Good> = OnceLock::new();
    GOOD.get_or_init(|| {
        let folder = tempfile::tempdir().unwrap();
        let at = folder.path();
        std::fs::write(at.join("box.obj"), checked_box()).unwrap();
        std::fs::write(at.join("box.mtl"), MATERIALS).unwrap();
        let synth = "relight synth --object box.obj --show-light --views 32 --size 64x64 --spp 16 --light uniform --unseen-light sky:40,100 -o data";
        works(at, &synth.split(' ').collect::<Vec<_>>());
        let train = "train data -o run --steps 500 --background white --device cpu --set field.space=box --set field.log2_size=14 --set sampling.batch_samples=16384";
        works(at, &train.split(' ').collect::<Vec<_>>());
        Good { data: at.join("data"), run: at.join("run"), _folder: folder }
    })
}

/// Starts a command that writes what it says into `folder/said`, and interrupts it once `sign` is seen.
#[track_caller]
fn interrupted(folder: &Path, arguments: &[&str], sign: impl Fn() -> bool) -> String {
    let said = || std::fs::read_to_string(folder.join("said")).unwrap();
    let file = std::fs::File::create(folder.join("said")).unwrap();
    let mut c = Command::new(env!("CARGO_BIN_EXE_diorama"));
    let mut child = c.args(arguments).current_dir(folder).stdout(Stdio::null()).stderr(file).spawn().unwrap();
    let end = Instant::now() + Duration::from_secs(120);
    while !sign() {
        assert!(child.try_wait().unwrap().is_none() && Instant::now() < end, "{arguments:?}: no sign: {}", said());
        std::thread::sleep(Duration::from_millis(2));
    }
    assert!(Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap().success());
    assert_eq!(child.wait().unwrap().code(), Some(130), "{arguments:?}: {}", said());
    said()
}

#[test]
fn an_object_is_cut_out_of_opaque_photographs_and_goes_on_without_them() {
    let dir = tempfile::tempdir().unwrap();
    let at = dir.path();
    // A data set and a run that may be deleted.
    let (data, run) = (at.join("data"), at.join("source"));
    copy_all(&good().data, &data);
    copy_all(&good().run, &run);
    let config = std::fs::read_to_string(run.join("config.toml")).unwrap();
    std::fs::write(run.join("config.toml"), config.replace(s(&good().data), s(&data))).unwrap();
    let kept = std::fs::read_to_string(run.join("capture.json")).unwrap().replace(s(&good().data), s(&data));
    let mut kept: serde_json::Value = serde_json::from_str(&kept).unwrap();
    // The mask of one photograph leaves open all that it shows; another one is cut out already.
    photo::save_png(&data.join("open.png"), &ImageU8 { width: 64, height: 64, channels: 1, data: vec![0; 64 * 64] }).unwrap();
    kept["frames"][0]["mask"] = "open.png".into();
    let image = data.join("images/001.png");
    let opaque = photo::load(&image).unwrap();
    let own = opaque.data.as_chunks::<3>().0.iter().flat_map(|p| [p[0], p[1], p[2], if *p == [255; 3] { 0 } else { 200 }]).collect();
    photo::save_png(&image, &ImageU8 { channels: 4, data: own, ..opaque }).unwrap();
    std::fs::write(run.join("capture.json"), kept.to_string()).unwrap();
    let call = format!(
        "relight object --from-run source --clip {CLIP} --preset ci --resolution 64 --steps 200 --texture 256 --run new -o box.glb --set run.log_every=1"
    );
    let said = interrupted(at, &call.split(' ').collect::<Vec<_>>(), || at.join("new/metrics.jsonl").exists());
    assert!(
        said.contains("of 32 photographs 1 show something in front")
            && said.contains("31 photographs, 27 of them to train on")
            && said.contains("--resume --run new"),
        "{said}"
    );
    // The background is transparent, the object is not.
    let cut = photo::load(&at.join("new/start/images/003.png")).unwrap();
    let own = photo::load(&at.join("new/start/images/001.png")).unwrap();
    assert!(own.channels == 4 && own.pixel(32, 32)[3] == 200, "its own opacity is kept");
    let alpha = |x: usize, y: usize| cut.pixel(x, y)[3];
    assert!(cut.channels == 4 && [(0, 0), (63, 0), (0, 63), (63, 63)].iter().all(|(x, y)| alpha(*x, *y) == 0) && alpha(32, 32) == 255);
    copy_all(&data.join("truth"), &at.join("new/start/truth"));
    std::fs::remove_dir_all(&data).unwrap();
    std::fs::remove_dir_all(&run).unwrap();
    std::fs::rename(at.join("new"), at.join("moved")).unwrap();
    let out = works(at, &["relight", "object", "--resume", "--run", "moved", "-o", "box.glb", "--score-spp", "4", "--json"]);
    let out: serde_json::Value = serde_json::from_str(&out).unwrap();
    let of = |name: &str| out["scores"]["truth"][name].as_f64().unwrap();
    eprintln!("{out}");
    assert!(out["scores"]["object_psnr"].as_f64().unwrap() > 22.0 && of("base_color_psnr") > 15.0 && of("chamfer") < 0.01, "{out}");
    let model = model_file::read(&at.join("box.glb")).unwrap().model;
    let (lo, hi) = model.bounds().unwrap();
    let near = |a: f64, b: f64| (a - b).abs() < 0.12;
    assert!((0..3).all(|k| near(lo[k], -1.0) && near(hi[k], 1.0)), "{lo:?} {hi:?}");
}

#[test]
fn materials_are_an_export_that_can_be_interrupted() {
    let dir = tempfile::tempdir().unwrap();
    let at = dir.path();
    let run = at.join("run");
    copy_all(&good().run, &run);
    let call = format!("export --materials run --clip {CLIP} --resolution 64 --faces 1000 --texture 128 -o box.glb");
    let call: Vec<&str> = call.split(' ').collect();
    let said = interrupted(at, &call, || at.join("run/materials/metrics.jsonl").exists());
    assert!(said.contains("--resume --run run/materials") && !at.join("box.glb").exists(), "{said}");
    fails(at, &call, 2, &["run/materials", "--resume", "--force"]);
    // Go on, but not for minutes.
    let config = at.join("run/materials/config.toml");
    let steps: u64 =
        checkpoint::read(&checkpoint::latest(&at.join("run/materials/checkpoints"))).unwrap().metadata["step"].parse().unwrap();
    let text = std::fs::read_to_string(&config).unwrap();
    std::fs::write(&config, text.replace("texture_steps = 3000", &format!("texture_steps = {}", steps + 2))).unwrap();
    works(at, &["relight", "object", "--resume", "--run", "run/materials", "-o", "box.glb", "--score-spp", "0"]);
    let model = model_file::read(&at.join("box.glb")).unwrap().model;
    let material = &model.materials[model.parts[0].material];
    assert!([material.base_color_texture, material.metallic_roughness_texture, material.normal_texture].iter().all(Option::is_some));
    assert!(at.join("box.probe.hdr").is_file());
    fails(at, &call, 2, &["box.glb", "exists", "--force"]);
    fails(at, &["export", "--materials", "run/materials", "-o", "b.glb"], 2, &["run/materials", "relight-object", "--resume"]);
    fails(at, &["export", "--materials", "run", "-o", "b.obj"], 2, &["b.obj", ".glb"]);
}

#[test]
fn what_cannot_be_begun_from_is_refused_in_one_line_and_leaves_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let at = dir.path();
    let refuse = |more: &[&str], parts: &[&str]| {
        let before = std::fs::read_dir(at).unwrap().count();
        let run: &[&str] = if more.contains(&"--run") { &[] } else { &["--run", "new"] };
        fails(at, &[&["relight", "object", "--preset", "ci", "--resolution", "32", "-o", "new.glb"], run, more].concat(), 2, parts);
        assert_eq!(std::fs::read_dir(at).unwrap().count(), before, "{more:?} left something behind");
    };
    let run = s(&good().run);
    refuse(&["data", "--from-run", run], &["--from-run", "leave out the folder"]);
    refuse(&["--base", "x.glb", "--from-run", run], &["--from-run", "--base"]);
    refuse(&["--resume", "--from-run", run], &["--from-run", "--resume"]);
    refuse(&["--from-run", "nowhere"], &["nowhere", "not a run folder"]);
    refuse(&["--from-run", run, "--clip", "1,2,3"], &["--clip 1,2,3"]);
    // Beside of everything; where cameras stand.
    refuse(&["--from-run", run, "--clip", "40,40,40,41,41,41"], &["box", "no opaque", "--clip"]);
    refuse(&["--from-run", run, "--run", run, "--force"], &["--run", "begin from"]);
    std::fs::create_dir(at.join("other")).unwrap();
    std::fs::write(at.join("other/config.toml"), "application = \"relight\"\n").unwrap();
    refuse(&["--from-run", "other"], &["other", "relight", "diorama relight mesh"]);
    // Hardly trained: fog.
    works(at, &["train", s(&good().data), "-o", "fog", "--steps", "1", "--device", "cpu", "--set", "field.log2_size=12"]);
    refuse(&["--from-run", "fog", "--clip", CLIP], &["box", "no opaque", "train longer"]);
}
