//! Outputs of a run: point clouds, cropped meshes, distances, perceptual scores, and closed output pipes.

use diorama_data::checkpoint;
use diorama_geom::glam::DVec3;
use diorama_pipelines::object::quickstart::write_capture;
use diorama_pipelines::object::run_folder;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::{OnceLock, RwLock};

/// A short run, made once. Tests that write files to it lock it exclusively; tests that such files would affect share the lock.
struct Good {
    _folder: tempfile::TempDir,
    run: PathBuf,
    lock: RwLock<()>,
}

fn good() -> &'static Good {
    static GOOD: OnceLock<Good> = OnceLock::new();
    GOOD.get_or_init(|| {
        let folder = tempfile::tempdir().unwrap();
        let (capture, run) = (folder.path().join("capture"), folder.path().join("run"));
        write_capture(&capture, 24, 64).unwrap();
        let small = ["--set", "field.log2_size=14", "--set", "field.finest=256"];
        works(&[&["train", s(&capture), "-o", s(&run), "--steps", "400", "--device", "cpu"], &small[..]].concat());
        Good { _folder: folder, run, lock: RwLock::new(()) }
    })
}

fn s(p: &Path) -> &str {
    p.to_str().unwrap()
}

fn diorama(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_diorama")).args(arguments).output().unwrap()
}

/// The output of a call that succeeds.
#[track_caller]
fn works(arguments: &[&str]) -> String {
    let o = diorama(arguments);
    assert!(o.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&o.stderr));
    String::from_utf8(o.stdout).unwrap()
}

/// The error line of a call that is refused.
#[track_caller]
fn refused(arguments: &[&str]) -> String {
    let o = diorama(arguments);
    let text = String::from_utf8_lossy(&o.stderr).into_owned();
    assert_eq!(o.status.code(), Some(2), "{arguments:?}: {text}");
    text.lines().find(|l| l.starts_with("diorama: ")).unwrap_or_else(|| panic!("{text}")).to_string()
}

#[track_caller]
fn export(file: &Path, more: &[&str]) -> serde_json::Value {
    let all = [&["export", s(&good().run), "-o", s(file), "--device", "cpu", "--json"], more].concat();
    serde_json::from_str(&works(&all)).unwrap()
}

type Corner = [f64; 3];

/// Header and positions of a binary PLY whose vertices start with x, y, z.
fn ply(file: &Path) -> (String, Vec<Corner>) {
    let bytes = std::fs::read(file).unwrap();
    let end = bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    let head = String::from_utf8(bytes[..end].to_vec()).unwrap();
    let count: usize = head.lines().find_map(|l| l.strip_prefix("element vertex ")).unwrap().parse().unwrap();
    let sizes = head.lines().filter_map(|l| l.strip_prefix("property ").filter(|l| !l.starts_with("list")));
    let size: usize = sizes.map(|p| if p.starts_with("uchar") { 1 } else { 4 }).sum();
    let number = |at: usize| f32::from_le_bytes(bytes[at..at + 4].try_into().unwrap()) as f64;
    let points = (0..count).map(|i| std::array::from_fn(|k| number(end + i * size + 4 * k))).collect();
    (head, points)
}

fn bounds(points: &[Corner]) -> (Corner, Corner) {
    let fold = |f: fn(f64, f64) -> f64, from: f64| std::array::from_fn(|k| points.iter().map(|p| p[k]).fold(from, f));
    (fold(f64::min, f64::INFINITY), fold(f64::max, f64::NEG_INFINITY))
}

/// The first and the ninety-ninth percentile along each axis.
fn most(points: &[Corner]) -> (Corner, Corner) {
    let at = |k: usize, share: f64| {
        let mut along: Vec<f64> = points.iter().map(|p| p[k]).collect();
        along.sort_by(f64::total_cmp);
        along[(share * (along.len() - 1) as f64) as usize]
    };
    (std::array::from_fn(|k| at(k, 0.01)), std::array::from_fn(|k| at(k, 0.99)))
}

#[test]
fn points_lie_where_the_mesh_does() {
    let _held = good().lock.read().unwrap();
    let dir = tempfile::tempdir().unwrap();
    let (mesh, cloud) = (dir.path().join("mesh.ply"), dir.path().join("cloud.ply"));
    export(&mesh, &["--resolution", "96", "--scale", "2"]);
    let made = export(&cloud, &["--format", "points", "--points", "20000", "--scale", "2"]);
    assert_eq!((made["points"].as_u64(), made["scale"].as_f64()), (Some(20_000), Some(2.0)));
    let (head, points) = ply(&cloud);
    assert!(["nx", "nz", "red", "blue"].iter().all(|p| head.contains(p)) && !head.contains("element face"), "{head}");
    assert_eq!(points.len(), 20_000);
    let (_, vertices) = ply(&mesh);
    // One of the two may contain a floater that the other lacks.
    let ((lo, hi), (mesh_lo, mesh_hi)) = (most(&points), most(&vertices));
    let longest = (0..3).map(|k| mesh_hi[k] - mesh_lo[k]).fold(0.0, f64::max);
    for k in 0..3 {
        // The base of the object is seen only from above, so the mesh may reach deeper.
        let below = if k == 2 { (mesh_lo[k] - lo[k]).max(0.0) } else { (lo[k] - mesh_lo[k]).abs() };
        assert!(below < 0.12 * longest && (hi[k] - mesh_hi[k]).abs() < 0.12 * longest, "{lo:?} {mesh_lo:?} {hi:?} {mesh_hi:?}");
    }
    // Nine tenths of the points are within a fortieth of the mesh's length from one of its vertices.
    let near = points.iter().step_by(100).filter(|p| {
        let square = |v: &Corner| (0..3).map(|k| (v[k] - p[k]).powi(2)).sum::<f64>();
        vertices.iter().map(square).fold(f64::INFINITY, f64::min).sqrt() < longest / 40.0
    });
    assert!(near.count() >= 180);
    // Half of it.
    let middle = 0.25 * (lo[0] + hi[0]);
    let clip =
        format!("{},{},{},{},{},{}", 0.5 * lo[0] - 0.1, 0.5 * lo[1] - 0.1, 0.5 * lo[2] - 0.1, middle, 0.5 * hi[1] + 0.1, 0.5 * hi[2] + 0.1);
    export(&cloud, &["--format", "points", "--points", "5000", "--scale", "2", "--clip", &clip, "--force"]);
    let (lo, hi) = bounds(&ply(&cloud).1);
    assert!(hi[0] <= 2.0 * middle + 1e-4 && lo[0] < middle, "{lo:?} {hi:?} {middle}");
}

#[test]
fn points_are_written_as_las_and_e57_too() {
    let _held = good().lock.read().unwrap();
    let dir = tempfile::tempdir().unwrap();
    let las = dir.path().join("a.las");
    export(&las, &["--points", "3000"]);
    let bytes = std::fs::read(&las).unwrap();
    assert_eq!((&bytes[..4], u32::from_le_bytes(bytes[107..111].try_into().unwrap())), (&b"LASF"[..], 3000));
    let e57 = dir.path().join("a.e57");
    export(&e57, &["--format", "points", "--points", "3000"]);
    assert!(std::fs::read(&e57).unwrap().starts_with(b"ASTM-E57"));
    let run = s(&good().run);
    let out = |name: &str| dir.path().join(name).to_str().unwrap().to_string();
    assert!(refused(&["export", run, "-o", &out("b.glb"), "--points", "10"]).contains("--points"));
    assert!(refused(&["export", run, "-o", &out("b.obj"), "--format", "points"]).contains("ply, las or e57"));
    assert!(refused(&["export", run, "-o", &out("b.las"), "--points", "0"]).contains("--points 0"));
    assert!(refused(&["export", run, "-o", &out("b.las"), "--watertight"]).contains("--watertight"));
    assert!(refused(&["export", run, "-o", &out("b.glb"), "--clip", "all"]).contains("--clip all"));
    assert!(
        refused(&["export", run, "-o", &out("b.las"), "--points", "10", "--clip", "90,90,90,91,91,91"]).contains("there are no points")
    );
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 2, "a refusal left something behind");
}

#[test]
fn the_mesh_lies_inside_the_crop_box_of_the_viewer() {
    let _held = good().lock.write().unwrap();
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("a.ply");
    let (model, _) = run_folder::load_model(&good().run).unwrap();
    let in_world = |points: Vec<Corner>| -> Vec<Corner> {
        points.into_iter().map(|p| model.capture.world_from_capture.point(DVec3::from(p)).to_array()).collect()
    };
    let small = ["--resolution", "64", "--keep-unseen", "--floaters", "0"];
    export(&file, &small);
    let (lo, hi) = bounds(&in_world(ply(&file).1));
    // A quarter is cut off at one side of each axis.
    let size: Corner = std::array::from_fn(|k| hi[k] - lo[k]);
    let crop: (Corner, Corner) = (std::array::from_fn(|k| lo[k] + 0.25 * size[k]), std::array::from_fn(|k| hi[k] + 0.1 * size[k]));
    let saved = good().run.join("crop.json");
    std::fs::write(&saved, serde_json::json!({ "min": crop.0, "max": crop.1 }).to_string()).unwrap();
    export(&file, &[&small[..], &["--force"]].concat());
    let (lo, hi) = bounds(&in_world(ply(&file).1));
    std::fs::remove_file(&saved).unwrap();
    for k in 0..3 {
        let slack = 1e-4 * size[k];
        assert!(lo[k] >= crop.0[k] - slack && hi[k] <= crop.1[k] + slack, "axis {k}: {lo:?} {hi:?} {crop:?}");
        // The box cuts through the object, so the mesh reaches its side.
        assert!(lo[k] <= crop.0[k] + 0.1 * size[k], "axis {k}: {lo:?} {crop:?}");
    }
}

#[test]
fn the_summary_says_how_many_faces_went() {
    let _held = good().lock.read().unwrap();
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("a.stl");
    let run = s(&good().run);
    let text = works(&["export", run, "-o", s(&file), "--resolution", "48", "--device", "cpu"]);
    assert!(text.contains("removed: ") && text.contains("fewer than three cameras see"), "{text}");
    let removed = export(&file, &["--resolution", "48", "--keep-unseen", "--force"])["removed"].clone();
    assert_eq!((removed["unseen"].as_u64(), removed["before_cameras"].as_u64()), (Some(0), Some(0)));
    // A briefly trained field has parts that hardly any camera sees; the removed faces are those that --keep-unseen keeps.
    let all = ["--resolution", "64", "--floaters", "0", "--faces", "0", "--force"];
    let (seen, kept) = (export(&file, &all), export(&file, &[&all[..], &["--keep-unseen"]].concat()));
    let count = |made: &serde_json::Value, what: &str| made["removed"][what].as_u64().unwrap();
    let gone = count(&seen, "unseen") + count(&seen, "before_cameras");
    assert!(gone > 0, "{seen}");
    assert_eq!(seen["faces"].as_u64().unwrap() + gone, kept["faces"].as_u64().unwrap(), "{seen} {kept}");
}

#[test]
fn no_more_faces_than_asked_also_where_the_mesh_is_closed() {
    let _held = good().lock.read().unwrap();
    let dir = tempfile::tempdir().unwrap();
    for faces in ["400", "60"] {
        let made =
            export(&dir.path().join("a.stl"), &["--resolution", "64", "--faces", faces, "--floaters", "0", "--keep-unseen", "--force"]);
        assert!(made["faces"].as_u64().unwrap() <= faces.parse().unwrap(), "{made}");
        let closed = export(&dir.path().join("b.stl"), &["--resolution", "64", "--faces", faces, "--watertight", "--force"]);
        let more = closed["faces"].as_u64().unwrap() > faces.parse().unwrap();
        assert_eq!(more, closed["notes"].to_string().contains("to close the surface"), "{closed}");
    }
}

/// Values of an `.npy` file of floats.
fn npy(file: &Path) -> Vec<f32> {
    let bytes = std::fs::read(file).unwrap();
    let head = 10 + u16::from_le_bytes([bytes[8], bytes[9]]) as usize;
    bytes[head..].chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect()
}

#[test]
fn distances_follow_the_measured_length_and_are_not_cut_off() {
    let _held = good().lock.write().unwrap();
    let dir = tempfile::tempdir().unwrap();
    let run = &good().run;
    let render = |name: &str, more: &[&str]| {
        let images = dir.path().join(name);
        let all = ["render", s(run), "--frames", "3", "--size", "32x24", "--layers", "depth", "--device", "cpu", "--images", s(&images)];
        works(&[&all[..], more].concat());
        images
    };
    let meaning =
        |folder: &Path| -> serde_json::Value { serde_json::from_slice(&std::fs::read(folder.join("depth.json")).unwrap()).unwrap() };
    let units = render("units", &["--depth", "npy"]);
    assert_eq!(meaning(&units)["unit"], "units of the capture");
    // One unit of the capture is 50 m.
    let saved = run.join("scale.json");
    std::fs::write(&saved, r#"{"points": [[0, 0, 0], [0, 0, 2]], "metres": 100}"#).unwrap();
    let (meters, png) = (render("meters", &["--depth", "npy"]), render("png", &[]));
    std::fs::remove_file(&saved).unwrap();
    assert_eq!((meaning(&meters)["unit"].as_str(), meaning(&png)["frames"].as_u64()), (Some("m"), Some(3)));
    let step = meaning(&png)["step"].as_f64().unwrap();
    let mut farthest = 0.0f32;
    for i in 0..3 {
        let (u, m) = (npy(&units.join(format!("depth_{i:04}.npy"))), npy(&meters.join(format!("depth_{i:04}.npy"))));
        let deep = image_numbers(&png.join(format!("depth16_{i:04}.png")));
        for ((u, m), n) in u.iter().zip(&m).zip(deep) {
            assert!((m - 50.0 * u).abs() <= 1e-4 * m.abs(), "{u} {m}");
            assert!((n as f64 * step - *m as f64).abs() <= 0.51 * step, "{n} {m}");
            farthest = farthest.max(*m);
        }
    }
    // Beyond the range of 16 bits in thousandths.
    assert!(farthest > 66.0, "{farthest}");
}

/// Values of a 16-bit PNG.
fn image_numbers(file: &Path) -> Vec<u16> {
    diorama_data::depth::read_png(file).unwrap()
}

/// A tensor of small distinct numbers.
fn tensor(shape: &[usize], seed: u64, scale: f32) -> Vec<f32> {
    let rng = diorama_geom::rng::Rng::new(seed, 9);
    (0..shape.iter().product::<usize>() as u64).map(|i| (rng.uniform(i) - 0.5 + if seed >= 100 { 0.5 } else { 0.0 }) * scale).collect()
}

type Tensor = (String, Vec<usize>, Vec<f32>);

/// Convolutions `(number, from, to, kernel)` of a network as torchvision names them, and the heads of LPIPS above `taps` channels.
fn network(convolutions: &[(usize, usize, usize, usize)], taps: &[usize]) -> (Vec<Tensor>, Vec<Tensor>) {
    let mut trunk = Vec::new();
    for &(i, from, to, kernel) in convolutions {
        let shape = vec![to, from, kernel, kernel];
        let scale = 2.0 * (6.0 / (from * kernel * kernel) as f32).sqrt();
        trunk.push((format!("features.{i}.weight"), shape.clone(), tensor(&shape, i as u64, scale)));
        trunk.push((format!("features.{i}.bias"), vec![to], tensor(&[to], i as u64 + 50, 0.1)));
    }
    let head = |(k, n): (usize, &usize)| (format!("lin{k}.model.1.weight"), vec![1, *n, 1, 1], tensor(&[*n], 100 + k as u64, 1.0));
    (trunk, taps.iter().enumerate().map(head).collect())
}

fn alexnet() -> (Vec<Tensor>, Vec<Tensor>) {
    let convolutions = [(0, 3, 64, 11), (3, 64, 192, 5), (6, 192, 384, 3), (8, 384, 256, 3), (10, 256, 256, 3)];
    network(&convolutions, &convolutions.map(|c| c.2))
}

fn vgg16() -> (Vec<Tensor>, Vec<Tensor>) {
    let numbers = [0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28];
    let channels = [3, 64, 64, 128, 128, 256, 256, 256, 512, 512, 512, 512, 512, 512];
    let convolutions: Vec<_> = numbers.iter().zip(channels.windows(2)).map(|(i, c)| (*i, c[0], c[1], 3)).collect();
    network(&convolutions, &[64, 128, 256, 512, 512])
}

fn save_safetensors(folder: &Path, tensors: &[Tensor]) -> PathBuf {
    let entries: Vec<_> =
        tensors.iter().map(|(n, shape, data)| checkpoint::Entry { name: n.clone(), shape: shape.clone(), data }).collect();
    checkpoint::save(folder, &entries, Default::default()).unwrap();
    checkpoint::latest(folder)
}

/// Writes a `state_dict` in the format of `torch.save`: an archive of a pickle and one storage per tensor.
fn save_pth(file: &Path, tensors: &[Tensor]) {
    use std::io::Write;
    let mut zip = zip::ZipWriter::new(std::fs::File::create(file).unwrap());
    let stored = zip::write::SimpleFileOptions::default().compression_method(zip::CompressionMethod::Stored);
    let text = |t: &str| [b"X", &(t.len() as u32).to_le_bytes()[..], t.as_bytes()].concat();
    let int = |n: usize| [b"J", &(n as i32).to_le_bytes()[..]].concat();
    let tuple = |v: &[usize]| [b"(", &v.iter().flat_map(|n| int(*n)).collect::<Vec<u8>>()[..], b"t"].concat();
    let mut pickle = b"\x80\x02}(".to_vec();
    for (key, (name, shape, values)) in tensors.iter().enumerate() {
        let strides: Vec<usize> = (0..shape.len()).map(|i| shape[i + 1..].iter().product()).collect();
        let storage = [b"(", &text("storage")[..], b"ctorch\nFloatStorage\n", &text(&key.to_string()), &text("cpu"), &int(values.len())];
        let storage = [&storage.concat()[..], b"tQ"].concat();
        let rest = [int(0), tuple(shape), tuple(&strides)].concat();
        // Without a gradient and without hooks.
        pickle.extend([&text(name)[..], b"ctorch._utils\n_rebuild_tensor_v2\n(", &storage, &rest].concat());
        pickle.extend(b"\x89ccollections\nOrderedDict\n)RtR");
        zip.start_file(format!("weights/data/{key}"), stored).unwrap();
        zip.write_all(&values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>()).unwrap();
    }
    pickle.extend(b"u.");
    zip.start_file("weights/data.pkl", stored).unwrap();
    zip.write_all(&pickle).unwrap();
    zip.finish().unwrap();
}

/// Distances of the held-out views, and the report.
fn lpips(files: &[&Path]) -> (Vec<f64>, serde_json::Value) {
    let weights = files.iter().map(|f| s(f)).collect::<Vec<_>>().join(",");
    let report = works(&["eval", s(&good().run), "--device", "cpu", "--json", "--lpips", &weights]);
    let report: serde_json::Value = serde_json::from_str(&report).unwrap();
    let views: Vec<f64> = report["per_view"].as_array().unwrap().iter().map(|v| v["lpips"].as_f64().unwrap()).collect();
    let mean = views.iter().sum::<f64>() / views.len() as f64;
    assert!(views.iter().all(|v| *v > 0.0 && v.is_finite()) && (report["lpips"].as_f64().unwrap() - mean).abs() < 1e-12, "{report}");
    (views, report)
}

#[test]
fn eval_judges_by_lpips_with_the_users_weights() {
    let dir = tempfile::tempdir().unwrap();
    let (trunk, heads) = alexnet();
    let in_one = dir.path().join("alex.pth");
    save_pth(&in_one, &[&trunk[..], &heads].concat());
    let (trunk, heads) = (save_safetensors(&dir.path().join("trunk"), &trunk), save_safetensors(&dir.path().join("heads"), &heads));
    let (views, _) = lpips(&[&trunk, &heads]);
    assert_eq!(lpips(&[&in_one]).0, views, "both formats hold the same weights");
    let refused_with = |weights: &str| refused(&["eval", s(&good().run), "--device", "cpu", "--json", "--lpips", weights]);
    assert!(refused_with(s(&trunk)).contains("without the linear heads"));
    assert!(refused_with("no/such.pth").contains("no/such.pth"));
    // A truncated file is refused by name.
    let bytes = std::fs::read(&in_one).unwrap();
    std::fs::write(&in_one, &bytes[..bytes.len() / 2]).unwrap();
    assert!(refused_with(s(&in_one)).contains("alex.pth: cannot be read as weights"));
}

#[test]
fn eval_judges_by_lpips_with_vgg_in_a_file_of_pytorch() {
    let dir = tempfile::tempdir().unwrap();
    let (trunk, heads) = vgg16();
    let (network, weights) = (dir.path().join("vgg16.pth"), dir.path().join("heads.pth"));
    save_pth(&network, &trunk);
    save_pth(&weights, &heads);
    lpips(&[&network, &weights]);
    let text = works(&["eval", s(&good().run), "--device", "cpu", "--lpips", &format!("{},{}", s(&network), s(&weights))]);
    assert!(text.lines().any(|l| l.starts_with("lpips 0.") && l.ends_with("(VGG16)")), "{text}");
}

#[test]
fn a_reader_that_goes_away_is_no_error() {
    let run = s(&good().run);
    for arguments in [&["info", run][..], &["info", run, "--json"], &["doctor"], &["completions", "bash"], &["export", "--help"]] {
        // Every write fails.
        let (reader, writer) = std::io::pipe().unwrap();
        drop(reader);
        let o = Command::new(env!("CARGO_BIN_EXE_diorama")).args(arguments).stdout(writer).output().unwrap();
        let text = String::from_utf8_lossy(&o.stderr);
        assert!(o.status.success() && !text.contains("panicked"), "{arguments:?}: {:?} {text}", o.status);
    }
    // A refused call keeps its exit code.
    let (reader, writer) = std::io::pipe().unwrap();
    drop(reader);
    let o = Command::new(env!("CARGO_BIN_EXE_diorama")).args(["info", "no/such", "--json"]).stdout(writer).output().unwrap();
    assert_eq!(o.status.code(), Some(2));
    // stderr is closed, too.
    let (reader, writer) = std::io::pipe().unwrap();
    drop(reader);
    let status = Command::new(env!("CARGO_BIN_EXE_diorama")).args(["info", "no/such"]).stderr(writer).status().unwrap();
    assert_eq!(status.code(), Some(2));
}

#[test]
#[cfg(target_os = "linux")]
fn a_full_disk_under_stdout_is_an_error() {
    let full = std::fs::File::options().write(true).open("/dev/full").unwrap();
    let o = Command::new(env!("CARGO_BIN_EXE_diorama")).args(["doctor"]).stdout(full).output().unwrap();
    let text = String::from_utf8_lossy(&o.stderr);
    assert!(o.status.code() == Some(1) && text.contains("stdout: cannot write") && !text.contains("panicked"), "{:?} {text}", o.status);
}
