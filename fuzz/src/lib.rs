//! Fuzz targets: every parser of untrusted bytes, as a function that must neither crash nor hang.

mod models;

use diorama_data::{
    archive, camera_path_json, checkpoint, colmap, import, llff, photo, photo_import, sparse_ply, splat_ply, transforms_json, weights,
};
use diorama_geom::capture::Frame;
use diorama_geom::glam::DVec3;
use diorama_geom::{Camera, ImageU8, Pose, Similarity, SparsePoint};
use diorama_pipelines::Application;
use diorama_pipelines::object::config::{Config, Method};
use diorama_pipelines::relight::{self, outdoor};
use diorama_pipelines::run::config::{self, Configuration};
use diorama_pipelines::run::viewer_files;
use std::path::PathBuf;
use std::sync::OnceLock;

/// A parser with inputs that it accepts.
pub struct Parser {
    pub name: &'static str,
    pub run: fn(&[u8]),
    pub seeds: fn() -> Vec<Vec<u8>>,
}

/// All parsers.
pub const PARSERS: &[Parser] = &[
    Parser { name: "transforms_json", run: transforms_json, seeds: transforms_seeds },
    Parser { name: "camera_path_json", run: camera_path, seeds: path_seeds },
    Parser { name: "colmap_binary", run: colmap_binary, seeds: colmap_binary_seeds },
    Parser { name: "colmap_text", run: colmap_text, seeds: colmap_text_seeds },
    Parser { name: "colmap_points", run: colmap_points, seeds: points_seeds },
    Parser { name: "poses_bounds_npy", run: npy, seeds: npy_seeds },
    Parser { name: "checkpoint", run: load_checkpoint, seeds: checkpoint_seeds },
    Parser { name: "photo", run: decode_photo, seeds: photo_seeds },
    Parser { name: "cut_photo", run: cut_photo, seeds: cut_seeds },
    Parser { name: "jpeg_metadata", run: strip_jpeg, seeds: photo_seeds },
    Parser { name: "zip", run: unzip, seeds: zip_seeds },
    Parser { name: "http_request", run: http, seeds: http_seeds },
    Parser { name: "viewer_message", run: message, seeds: message_seeds },
    Parser { name: "run_config", run: run_config, seeds: config_seeds },
    Parser { name: "crop_json", run: crop_json, seeds: crop_seeds },
    Parser { name: "splat_ply", run: splats, seeds: splat_seeds },
    Parser { name: "sparse_ply", run: sparse_points, seeds: sparse_seeds },
    Parser { name: "weights", run: load_weights, seeds: weights_seeds },
    Parser { name: "gltf", run: models::gltf, seeds: models::gltf_seeds },
    Parser { name: "obj", run: models::obj, seeds: models::obj_seeds },
    Parser { name: "environment", run: models::environment, seeds: models::environment_seeds },
    Parser { name: "sh_text", run: models::sh_text, seeds: models::sh_seeds },
    Parser { name: "osr_matrix", run: models::osr_matrix, seeds: models::osr_seeds },
    Parser { name: "text_labels", run: models::text_labels, seeds: models::text_label_seeds },
    Parser { name: "session_list", run: models::session_list, seeds: models::session_seeds },
];

/// The parser with a given name.
///
/// # Panics
/// If there is no parser of that name.
pub fn parser(name: &str) -> &'static Parser {
    PARSERS.iter().find(|p| p.name == name).unwrap_or_else(|| panic!("no parser {name}"))
}

/// A scratch folder of this process with a small photograph, in memory if the system supports it.
fn folder() -> &'static PathBuf {
    static FOLDER: OnceLock<PathBuf> = OnceLock::new();
    FOLDER.get_or_init(|| {
        let base = PathBuf::from("/dev/shm");
        let base = if base.is_dir() { base } else { std::env::temp_dir() };
        let folder = base.join(format!("diorama-fuzz-{}", std::process::id()));
        std::fs::create_dir_all(folder.join("images")).expect("a scratch folder");
        let image = ImageU8 { width: 4, height: 3, channels: 3, data: vec![90; 36] };
        photo::save_png(&folder.join("images/a.png"), &image).expect("a scratch file");
        folder
    })
}

/// Removes the scratch folder.
pub fn clean_up() {
    let _ = std::fs::remove_dir_all(folder());
}

/// Writes `data` as a file of the scratch folder.
fn file(name: &str, data: &[u8]) -> PathBuf {
    let path = folder().join(name);
    std::fs::write(&path, data).expect("a scratch file");
    path
}

fn transforms_json(data: &[u8]) {
    let path = file("transforms.json", data);
    let _ = transforms_json::read(&path, folder());
    let _ = import::import(&path, &import::ImportOptions::default());
}

fn camera_path(data: &[u8]) {
    let path = file("camera_path.json", data);
    let _ = camera_path_json::read(&path, &Similarity::IDENTITY);
    if let Ok(text) = std::str::from_utf8(data) {
        let _ = camera_path_json::moved(text, &path, &Similarity::IDENTITY);
    }
}

/// Cameras and images in one input, split at the position given by its first byte.
fn halves(data: &[u8]) -> (&[u8], &[u8]) {
    let Some((&at, rest)) = data.split_first() else { return (data, data) };
    rest.split_at((at as usize * rest.len() / 255).min(rest.len()))
}

fn joined(a: &[u8], b: &[u8]) -> Vec<u8> {
    let at = (a.len() * 255).div_ceil(a.len() + b.len());
    [&[at as u8][..], a, b].concat()
}

fn colmap_binary(data: &[u8]) {
    let (cameras, images) = halves(data);
    let _ = std::fs::create_dir_all(folder().join("binary/images"));
    file("binary/cameras.bin", cameras);
    file("binary/images.bin", images);
    // Points with ids 0 and 7, to which keypoints may refer.
    let point = |id: u64| [&id.to_le_bytes()[..], &[0; 43 - 8], &0u64.to_le_bytes()].concat();
    file("binary/points3D.bin", &[&2u64.to_le_bytes()[..], &point(0), &point(7)].concat());
    let _ = colmap::read(&folder().join("binary"));
    let _ = colmap::registered(&folder().join("binary"));
}

fn colmap_text(data: &[u8]) {
    let (cameras, images) = halves(data);
    let _ = std::fs::create_dir_all(folder().join("text/images"));
    file("text/cameras.txt", cameras);
    file("text/images.txt", images);
    file("text/points3D.txt", b"7 0 0 0 1 2 3 0.5 1 0\n");
    let _ = colmap::read(&folder().join("text"));
}

fn colmap_points(data: &[u8]) {
    file("points3D.bin", data);
    let _ = colmap::points(folder());
    let text = folder().join("points");
    let _ = std::fs::create_dir_all(&text);
    file("points/points3D.txt", data);
    let _ = colmap::points(&text);
}

fn npy(data: &[u8]) {
    let _ = std::fs::create_dir_all(folder().join("llff/images"));
    file("llff/images/a.png", b"");
    file("llff/poses_bounds.npy", data);
    let _ = llff::read(&folder().join("llff"));
}

fn load_checkpoint(data: &[u8]) {
    let _ = checkpoint::read(&file("c.safetensors", data));
}

fn decode_photo(data: &[u8]) {
    // The format is detected from the content.
    let path = file("photo.png", data);
    // Mutations may claim any size. Those above the limits must be refused; those below need not be decoded here.
    if photo::size(&path).is_ok_and(|(w, h)| w as u64 * h as u64 <= 1 << 16) {
        let _ = photo::load_full(&path);
    }
    let _ = photo::is_turned(&path);
}

/// Files in formats that this crate cannot write.
const FILES: [&[u8]; 5] = [
    include_bytes!("../../crates/data/tests/photos/baseline.jpg"),
    include_bytes!("../../crates/data/tests/photos/progressive.jpg"),
    include_bytes!("../../crates/data/tests/photos/lossy.webp"),
    include_bytes!("../../crates/data/tests/photos/lzw.tiff"),
    include_bytes!("../../crates/data/tests/photos/deflate.tiff"),
];

/// A truncated photograph must be refused, unless nothing of it is lost. One byte chooses the format, two the position of the cut in
/// 65,536ths, one the width; the others are pixels.
fn cut_photo(data: &[u8]) {
    let [kind, low, high, width, rest @ ..] = data else { return };
    let (w, h) = (*width as usize % 40 + 1, 12);
    let at = |i: usize| if rest.is_empty() { 0 } else { rest[i % rest.len()] };
    let rgb = ImageU8 { width: w, height: h, channels: 3, data: (0..w * h * 3).map(at).collect() };
    let whole = match kind % 8 {
        0 => photo::encode_png(&rgb),
        1 => std::fs::read(photo_import::write(&rgb, folder(), "whole").expect("a scratch file")).expect("a scratch file"),
        2 => {
            let path = folder().join("whole.exr");
            photo::save_exr(&path, &rgb.to_f32()).expect("a scratch file");
            std::fs::read(path).expect("a scratch file")
        }
        n => FILES[n as usize - 3].to_vec(),
    };
    let want = photo::load_full(&file("cut", &whole)).expect("a whole photograph");
    let length = (u16::from_le_bytes([*low, *high]) as usize * whole.len()) >> 16;
    if let Ok(got) = photo::load_full(&file("cut", &whole[..length])) {
        assert!(got == want, "{length} of {} bytes decode to something else", whole.len());
    }
}

fn strip_jpeg(data: &[u8]) {
    if let Some(clean) = photo_import::without_metadata(data) {
        assert!(clean.len() <= data.len());
        assert_eq!(photo_import::without_metadata(&clean).as_deref(), Some(&clean[..]), "removing metadata twice changes nothing");
    }
}

fn unzip(data: &[u8]) {
    let path = file("archive.zip", data);
    let _ = std::fs::remove_dir_all(folder().join("archive"));
    let limits = archive::ArchiveLimits { entries: 100, bytes: 1 << 20, ratio: 100 };
    let _ = archive::unpacked(&path, &limits);
}

fn http(data: &[u8]) {
    diorama_viewer::fuzz_request(data);
}

fn message(data: &[u8]) {
    diorama_viewer::fuzz_message(data);
}

fn transforms_seeds() -> Vec<Vec<u8>> {
    let frame = |x: f64| serde_json::json!({ "file_path": "images/a", "transform_matrix": [[1, 0, 0, x], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]], "mask_path": "images/a.png", "time": 0.5 });
    let whole = serde_json::json!({ "camera_angle_x": 0.7, "fl_x": 3.0, "w": 4, "h": 3, "k1": 0.1, "k2": 0.0, "p1": 1e-3, "p2": 0, "camera_model": "OPENCV",
        "aabb_scale": 4, "scale": 0.33, "offset": [0.5, 0.5, 0.5], "train_filenames": ["images/a"], "frames": [frame(0.0), frame(1.0), frame(2.0), frame(3.0)] });
    vec![whole.to_string().into_bytes()]
}

fn path_seeds() -> Vec<Vec<u8>> {
    let m = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 4, 0, 0, 0, 1];
    let path = serde_json::json!({ "render_width": 64, "render_height": 48, "fps": 24, "is_cycle": false,
        "keyframes": [{ "matrix": "[1,0,0,0,0,1,0,0,0,0,1,0,0,0,4,1]", "fov": 50 }], "camera_path": [{ "camera_to_world": m, "fov": 50, "aspect": 1.3 }] });
    vec![path.to_string().into_bytes()]
}

fn colmap_binary_seeds() -> Vec<Vec<u8>> {
    let (mut cameras, mut images) = (Vec::new(), Vec::new());
    cameras.extend(1u64.to_le_bytes());
    cameras.extend([1u32.to_le_bytes(), 4u32.to_le_bytes()].concat());
    cameras.extend([4u64.to_le_bytes(), 3u64.to_le_bytes()].concat());
    [3.0f64, 3.0, 2.0, 1.5, 0.1, 0.0, 0.0, 0.0].iter().for_each(|v| cameras.extend(v.to_le_bytes()));
    images.extend(1u64.to_le_bytes());
    images.extend(1u32.to_le_bytes());
    [1.0f64, 0.0, 0.0, 0.0, 0.0, 0.0, 4.0].iter().for_each(|v| images.extend(v.to_le_bytes()));
    images.extend(1u32.to_le_bytes());
    images.extend(b"a.png\0");
    images.extend(1u64.to_le_bytes());
    images.extend([0; 24]);
    vec![joined(&cameras, &images)]
}

fn colmap_text_seeds() -> Vec<Vec<u8>> {
    vec![joined(b"# cameras\n1 OPENCV 4 3 3 3 2 1.5 0.1 0 0 0\n", b"# images\n1 1 0 0 0 0 0 4 1 a.png\n0.5 0.5 -1 2.5 1.5 7\n")]
}

fn points_seeds() -> Vec<Vec<u8>> {
    let mut out = 1u64.to_le_bytes().to_vec();
    out.extend(7u64.to_le_bytes());
    [1.0f64, 2.0, 3.0].iter().for_each(|v| out.extend(v.to_le_bytes()));
    out.extend([9, 8, 7]);
    out.extend(0.5f64.to_le_bytes());
    out.extend(1u64.to_le_bytes());
    out.extend([0; 8]);
    vec![out, b"# points\n7 1 2 3 9 8 7 0.5 1 0 2 4\n".to_vec()]
}

fn npy_seeds() -> Vec<Vec<u8>> {
    let mut header = "{'descr': '<f8', 'fortran_order': False, 'shape': (1, 17), }".to_string();
    header.push_str(&" ".repeat(117 - header.len()));
    header.push('\n');
    let mut out = b"\x93NUMPY\x01\x00".to_vec();
    out.extend((header.len() as u16).to_le_bytes());
    out.extend(header.as_bytes());
    for v in [1.0f64, 0.0, 0.0, 0.0, 3.0, 0.0, 1.0, 0.0, 0.0, 4.0, 0.0, 0.0, 1.0, 4.0, 3.0, 1.0, 9.0] {
        out.extend(v.to_le_bytes());
    }
    vec![out]
}

fn checkpoint_seeds() -> Vec<Vec<u8>> {
    let folder = folder().join("checkpoints");
    let data = [1.0f32, 2.0, 3.0];
    let entries = [checkpoint::Entry { name: "a".into(), shape: vec![3], data: &data }];
    let metadata = std::collections::HashMap::from([("method".to_string(), "ngp".to_string())]);
    checkpoint::save(&folder, &entries, metadata).expect("a scratch checkpoint");
    vec![std::fs::read(checkpoint::latest(&folder)).expect("a scratch checkpoint")]
}

fn photo_seeds() -> Vec<Vec<u8>> {
    let data: Vec<u8> = (0..16 * 12 * 3).map(|i| (i * 7) as u8).collect();
    let rgb = ImageU8 { width: 16, height: 12, channels: 3, data };
    let rgba = ImageU8 { width: 4, height: 4, channels: 4, data: (0..64).collect() };
    let jpeg = photo_import::write(&rgb, folder(), "seed").expect("a scratch file");
    let own = [std::fs::read(jpeg).expect("a scratch file"), photo::encode_png(&rgb), photo::encode_png(&rgba)];
    own.into_iter().chain(FILES.map(|f| f.to_vec())).collect()
}

fn cut_seeds() -> Vec<Vec<u8>> {
    (0..8).map(|kind| [&[kind, 0xff, 0xf0, 23][..], &(0..60).map(|i| (i * 37) as u8).collect::<Vec<u8>>()].concat()).collect()
}

fn zip_seeds() -> Vec<Vec<u8>> {
    use std::io::Write;
    let mut w = zip::ZipWriter::new(std::io::Cursor::new(Vec::new()));
    for name in ["a/transforms.json", "a/images/b.txt"] {
        let deflated = zip::write::SimpleFileOptions::default().compression_method(zip::CompressionMethod::Deflated);
        w.start_file(name, deflated).and_then(|()| Ok(w.write_all(&[b'x'; 100])?)).expect("memory takes all");
    }
    vec![w.finish().expect("memory takes all").into_inner()]
}

fn http_seeds() -> Vec<Vec<u8>> {
    let head = "GET /socket?token=abc HTTP/1.1\r\nHost: 127.0.0.1:7007\r\nOrigin: http://127.0.0.1:7007\r\nUpgrade: websocket\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n";
    vec![head.as_bytes().to_vec()]
}

fn message_seeds() -> Vec<Vec<u8>> {
    let pose = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 4];
    [
        serde_json::json!({ "kind": "view", "id": 1, "view": { "width": 64, "height": 48, "fov_y": 0.8, "pose": pose, "layer": "depth",
            "values": { "sun": 0.5, "shadows": true, "sky": "dusk" }, "clip": [0, 0, 0, 1, 1, 1] } }),
        serde_json::json!({ "kind": "view", "id": 2, "view": { "width": 64, "height": 48, "fov_y": 0.8, "pose": pose, "layer": "rgb",
            "values": {}, "clip": null } }),
        serde_json::json!({ "kind": "export", "format": "glb", "faces": 100, "resolution": 64, "clip": null }),
        serde_json::json!({ "kind": "path", "json": "{}" }),
    ]
    .map(|v| v.to_string().into_bytes())
    .to_vec()
}

fn run_config(data: &[u8]) {
    let _ = std::fs::create_dir_all(folder().join("run"));
    let path = file("run/config.toml", data);
    let _ = Application::of_run(path.parent().expect("a folder"));
    let Ok(text) = std::str::from_utf8(data) else { return };
    read_config::<Config>(text);
    read_config::<outdoor::config::Config>(text);
    read_config::<relight::object::config::Config>(text);
    // An option's value may be anything.
    let _ = Config::new(Method::Ngp, "x".into()).set(text, text);
}

/// A configuration that was read can be written and set.
fn read_config<C: Configuration>(text: &str) {
    if let Ok(mut config) = config::from_toml::<C>(text) {
        let _ = config.check();
        let _ = config::from_toml::<C>(&config::to_toml(&config));
        let _ = config::set(&mut config, "data.downscale", text);
    }
}

fn config_seeds() -> Vec<Vec<u8>> {
    let of = |m| Config::new(m, "data".into()).to_toml();
    let unknown = of(Method::Ngp).replace("\"object\"", "\"sculpture\"");
    let scene = config::to_toml(&outdoor::config::Config::template());
    let object = config::to_toml(&relight::object::config::Config::template());
    let methods = [Method::Ngp, Method::Nerf, Method::Mlp, Method::Baseline].map(of);
    methods.into_iter().chain([unknown, scene, object]).map(String::into_bytes).collect()
}

fn crop_json(data: &[u8]) {
    let path = file("crop.json", data);
    let _ = viewer_files::read_crop(path.parent().expect("a folder"));
    let path = file("scale.json", data);
    let _ = viewer_files::read_scale(path.parent().expect("a folder"));
}

fn crop_seeds() -> Vec<Vec<u8>> {
    vec![
        br#"{"min": [-1.0, -0.5, 0.0], "max": [1.0, 0.5, 2e-3]}"#.to_vec(),
        br#"{"points": [[0, 1, 2], [1, 1, 2.5]], "metres": 0.45}"#.to_vec(),
    ]
}

fn splats(data: &[u8]) {
    let path = file("points.ply", data);
    let _ = splat_ply::read(&path);
}

/// The capture for [`sparse_points`]: three points, two photographs.
fn sparse() -> (Vec<SparsePoint>, Vec<Frame>) {
    let point =
        |i: u32| SparsePoint { position: DVec3::new(i as f64, 2.0, -1.0), color: [10, 20, 30], error: 0.5, frames: (0..=i % 2).collect() };
    let frame = |name: &str| Frame::new(name, folder().join(name), Camera::pinhole(4, 3, 1.0), Pose::IDENTITY);
    ((0..3).map(point).collect(), vec![frame("images/a.png"), frame("images/b ü.png")])
}

fn sparse_points(data: &[u8]) {
    let (mut points, frames) = sparse();
    points.iter_mut().for_each(|p| p.frames.clear());
    let read = sparse_ply::observe(&folder().join("points.ply"), folder(), data, &frames, &mut points);
    assert!(read.is_err() || points.iter().flat_map(|p| &p.frames).all(|f| (*f as usize) < frames.len()));
}

fn sparse_seeds() -> Vec<Vec<u8>> {
    let (points, frames) = sparse();
    let path = folder().join("sparse.ply");
    sparse_ply::write(&path, &points, &frames, folder()).expect("a scratch file");
    vec![std::fs::read(path).expect("a scratch file")]
}

fn splat_seeds() -> Vec<Vec<u8>> {
    let head = |format: &str, n: usize, more: &str| {
        format!("ply\nformat {format} 1.0\nelement vertex {n}\nproperty float x\nproperty float y\nproperty double z\n{more}end_header\n")
    };
    let colors = "property uchar red\nproperty uchar green\nproperty uchar blue\n";
    let floats: String = ["f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
        .iter()
        .map(|n| format!("property float {n}\n"))
        .collect();
    let text = format!("{}1 2 3 10 20 30\n-4 5e-1 6 0 255 7\n", head("ascii", 2, colors));
    let mut binary = head("binary_little_endian", 2, &floats).into_bytes();
    binary.extend([7u8; 2 * (4 + 4 + 8 + 11 * 4)]);
    vec![text.into_bytes(), binary]
}

fn load_weights(data: &[u8]) {
    let path = file("weights.pth", data);
    let Ok(arrays) = weights::read(&path, &|_| true) else { return };
    let numbers: usize = arrays.iter().map(|a| a.values.len()).sum();
    assert!(numbers <= data.len(), "{numbers} numbers of {} bytes", data.len());
    assert!(arrays.iter().all(|a| a.shape.iter().product::<usize>() == a.values.len()), "array lengths match their shapes");
}

/// Files that PyTorch wrote in both formats, and a safetensors file.
fn weights_seeds() -> Vec<Vec<u8>> {
    let of_torch =
        [&include_bytes!("../../crates/data/tests/data/small.pth")[..], include_bytes!("../../crates/data/tests/data/small_legacy.pth")];
    of_torch.iter().map(|b| b.to_vec()).chain(checkpoint_seeds()).collect()
}
