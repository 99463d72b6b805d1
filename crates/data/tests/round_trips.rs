//! Round trips of every format that is both read and written, with random content.

use diorama_data::camera_path_json::{self, CameraPath};
use diorama_data::checkpoint::{self, Entry};
use diorama_data::depth::{self, DepthFormat, DepthSequence};
use diorama_data::photo::{self, Photo};
use diorama_data::{colmap, point_cloud, sparse_ply, splat_ply, transforms_json};
use diorama_geom::camera_path::PathView;
use diorama_geom::capture::{Frame, Split};
use diorama_geom::glam::DVec3;
use diorama_geom::transform::rotation_from_axis_angle;
use diorama_geom::{Camera, Capture, Image, ImageU8, Lens, Mesh, Pose, SceneBox, Similarity, SparsePoint};
use proptest::prelude::*;
use std::collections::HashMap;
use std::path::Path;

fn vector(size: f64) -> impl Strategy<Value = DVec3> {
    prop::array::uniform3(-size..size).prop_map(DVec3::from_array)
}

fn pose() -> impl Strategy<Value = Pose> {
    (vector(3.0), vector(5.0)).prop_map(|(turn, translation)| Pose { rotation: rotation_from_axis_angle(turn), translation })
}

fn motion() -> impl Strategy<Value = Similarity> {
    (0.1..10.0f64, vector(3.0), vector(5.0)).prop_map(|(scale, turn, translation)| Similarity {
        scale,
        rotation: rotation_from_axis_angle(turn),
        translation,
    })
}

fn is_near(a: &Pose, b: &Pose) -> bool {
    (a.translation - b.translation).length() < 1e-6 && a.rotation.abs_diff_eq(b.rotation, 1e-6)
}

/// An image of up to 9 × 9 pixels.
fn image(channels: usize) -> impl Strategy<Value = ImageU8> {
    (1usize..9, 1usize..9).prop_flat_map(move |(width, height)| {
        prop::collection::vec(any::<u8>(), width * height * channels).prop_map(move |data| ImageU8 { width, height, channels, data })
    })
}

fn config(cases: u32) -> ProptestConfig {
    ProptestConfig { cases, failure_persistence: None, ..ProptestConfig::default() }
}

proptest! {
    #![proptest_config(config(24))]

    #[test]
    fn checkpoints(
        tensors in prop::collection::btree_map("[a-z][a-z.0-9]{0,12}", prop::collection::vec(any::<f32>(), 0..40), 1..5),
        metadata in prop::collection::hash_map("[a-z_]{1,8}", ".{0,12}", 0..4),
    ) {
        let dir = tempfile::tempdir().unwrap();
        let entries: Vec<Entry> =
            tensors.iter().map(|(name, data)| Entry { name: name.clone(), shape: vec![data.len()], data }).collect();
        let metadata: HashMap<String, String> = metadata.into_iter().map(|(k, v)| (format!("own_{k}"), v)).collect();
        checkpoint::save(dir.path(), &entries, metadata.clone()).unwrap();
        let (mut read, note) = checkpoint::load(dir.path()).unwrap();
        prop_assert_eq!(note, None);
        prop_assert_eq!(read.tensors.len(), tensors.len());
        for (name, data) in &tensors {
            let got = read.take(name).unwrap();
            prop_assert!(got.iter().map(|v| v.to_bits()).eq(data.iter().map(|v| v.to_bits())), "{name}");
        }
        prop_assert!(metadata.iter().all(|(k, v)| read.metadata.get(k) == Some(v)));
    }

    #[test]
    fn camera_paths(poses in prop::collection::vec(pose(), 1..5), world in motion(), other in motion(), fov in 0.2..2.5f64, fps in 1u32..60, lens in 0..3) {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("camera_path.json");
        let straight = Camera::pinhole(64, 48, fov);
        let camera = match lens {
            0 => straight,
            1 => Camera { lens: Lens::Fisheye { k: [0.0; 4], p: [0.0; 2], s: [0.0; 2] }, ..straight },
            _ => Camera::equirectangular(64, 32),
        };
        let views = poses.into_iter().map(|world_from_camera| PathView { camera, world_from_camera }).collect();
        let path = CameraPath { views, fps: fps as f64, crop: None };
        camera_path_json::write(&file, &path, &world).unwrap();
        let read = camera_path_json::read(&file, &world).unwrap();
        prop_assert_eq!((read.fps, read.views.len()), (path.fps, path.views.len()));
        for (a, b) in path.views.iter().zip(&read.views) {
            prop_assert!(is_near(&a.world_from_camera, &b.world_from_camera));
            prop_assert_eq!((a.camera.width, a.camera.height, a.camera.lens), (b.camera.width, b.camera.height, b.camera.lens));
            prop_assert!(lens == 2 || (a.camera.fy - b.camera.fy).abs() < 1e-6 * a.camera.fy);
        }
        // Moving a path to another frame and back gives the same path; `moved` accepts perspective paths only.
        if lens != 0 {
            return Ok(());
        }
        let text = std::fs::read_to_string(&file).unwrap();
        let there = camera_path_json::moved(&text, &file, &other).unwrap();
        let back = camera_path_json::moved(&there, &file, &other.inverse()).unwrap();
        std::fs::write(&file, back).unwrap();
        let read = camera_path_json::read(&file, &world).unwrap();
        prop_assert!(path.views.iter().zip(&read.views).all(|(a, b)| is_near(&a.world_from_camera, &b.world_from_camera)));
    }

    #[test]
    fn pictures_and_masks(rgb in image(3), rgba in image(4), mask in image(1)) {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("a.png");
        for im in [&rgb, &rgba] {
            photo::save_png(&file, im).unwrap();
            prop_assert_eq!(&photo::load(&file).unwrap(), im);
        }
        photo::save_png(&file, &mask).unwrap();
        prop_assert_eq!(photo::load_mask(&file).unwrap(), mask);
    }

    #[test]
    fn pictures_of_linear_light(width in 1usize..9, height in 1usize..9, values in prop::collection::vec(0.0..1e4f32, 8 * 8 * 3)) {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("a.exr");
        let im = Image { width, height, channels: 3, data: values[..width * height * 3].to_vec() };
        photo::save_exr(&file, &im).unwrap();
        let Photo::Linear(read) = photo::load_full(&file).unwrap() else { panic!("EXR holds linear light") };
        prop_assert_eq!((read.width, read.height), (width, height));
        let rgb = read.data.chunks_exact(read.channels).flat_map(|p| &p[..3]);
        prop_assert!(rgb.zip(&im.data).all(|(a, b)| (a - b).abs() <= 1e-3 * b.abs() + 1e-6), "{:?} {:?}", read.data, im.data);
    }

    #[test]
    fn distances_in_16_bits(frames in prop::collection::vec(prop::collection::vec(prop_oneof![Just(0.0f32), 1e-3..1e4f32], 12), 1..5)) {
        let dir = tempfile::tempdir().unwrap();
        let mut sequence = DepthSequence::new(dir.path(), DepthFormat::Png, true);
        for data in &frames {
            sequence.push(&Image { width: 4, height: 3, channels: 1, data: data.clone() }).unwrap();
        }
        let meaning: serde_json::Value = serde_json::from_slice(&std::fs::read(dir.path().join("depth.json")).unwrap()).unwrap();
        let step = meaning["step"].as_f64().unwrap();
        for (i, data) in frames.iter().enumerate() {
            let read = depth::read_png(&dir.path().join(format!("depth16_{i:04}.png"))).unwrap();
            for (n, d) in read.iter().zip(data) {
                // Frames written before a longer distance came are rounded once more for each longer distance.
                prop_assert!((*n as f64 * step - *d as f64).abs() <= step * frames.len() as f64, "{n} x {step}: {d}");
                prop_assert_eq!(*n == 0, *d == 0.0);
            }
        }
    }

    #[test]
    fn point_clouds(points in prop::collection::vec((prop::array::uniform3(-1e3..1e3f32), prop::array::uniform3(any::<u8>())), 1..30)) {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("a.ply");
        let colors_srgb = points.iter().map(|p| p.1.map(|v| v as f32 / 255.0)).collect();
        let mesh = Mesh { positions: points.iter().map(|p| p.0).collect(), colors_srgb, normals: vec![[0.0, 0.0, 1.0]; points.len()], ..Mesh::default() };
        point_cloud::save_ply(&file, &mesh).unwrap();
        let read = splat_ply::read(&file).unwrap();
        prop_assert_eq!(&read.positions, &mesh.positions);
        for (a, (_, b)) in read.rgb_srgb.iter().zip(&points) {
            prop_assert!((0..3).all(|k| (a[k] * 255.0).round() == b[k] as f32), "{a:?} {b:?}");
        }
    }

    #[test]
    fn sparse_points(points in prop::collection::vec((vector(100.0), prop::array::uniform3(any::<u8>()), 0.0..9.0f32, 1u8..8), 1..20)) {
        let dir = tempfile::tempdir().unwrap();
        let root = dir.path();
        let file = root.join("points.ply");
        let frames: Vec<Frame> =
            (0..3).map(|i| Frame::new(format!("{i}"), root.join(format!("{i} ü.png")), Camera::pinhole(4, 3, 1.0), Pose::IDENTITY)).collect();
        let points: Vec<SparsePoint> = points
            .into_iter()
            .map(|(position, color, error, seen)| SparsePoint { position, color, error, frames: (0..3).filter(|f| seen >> f & 1 == 1).collect() })
            .collect();
        sparse_ply::write(&file, &points, &frames, root).unwrap();
        let bare = |p: &SparsePoint| SparsePoint { error: 0.0, frames: Vec::new(), ..p.clone() };
        let mut read: Vec<SparsePoint> = points.iter().map(bare).collect();
        sparse_ply::observe(&file, root, &std::fs::read(&file).unwrap(), &frames, &mut read).unwrap();
        prop_assert_eq!(read, points.clone());
        let seen = splat_ply::read(&file).unwrap();
        prop_assert!(seen.positions.iter().zip(&points).all(|(a, b)| *a == b.position.as_vec3().to_array()));
    }

    #[test]
    fn captures_as_transforms_and_as_colmap_text(poses in prop::collection::vec(pose(), 3..6), lens in lens(), fov in 0.3..1.5f64, test in 0usize..3) {
        let dir = tempfile::tempdir().unwrap();
        let root = dir.path();
        let camera = Camera { lens, ..Camera::pinhole(8, 6, fov) };
        std::fs::create_dir(root.join("images")).unwrap();
        let frames = poses.iter().enumerate().map(|(i, p)| frame(root, i, i == test, camera, *p)).collect();
        let capture = Capture::new(frames, SceneBox { center: DVec3::ZERO, half: 1.0, aabb_scale: 1 });
        let file = root.join("transforms.json");
        transforms_json::write(&file, root, &capture, None).unwrap();
        colmap::write_text(&root.join("sparse/0"), &capture).unwrap();
        let (transforms, model) = (transforms_json::read(&file, root).unwrap(), colmap::read(root).unwrap());
        prop_assert_eq!((transforms.frames.len(), model.frames.len()), (capture.frames.len(), capture.frames.len()));
        for (a, (b, c)) in capture.frames.iter().zip(transforms.frames.iter().zip(&model.frames)) {
            prop_assert_eq!(a.split, b.split);
            for b in [b, c] {
                prop_assert!(is_near(&a.world_from_camera, &b.world_from_camera), "{a:?} {b:?}");
                prop_assert_eq!((&a.image, a.camera.width, a.camera.height), (&b.image, b.camera.width, b.camera.height));
                let pixel = |c: &Camera| c.project(DVec3::new(0.2, -0.1, 1.0)).unwrap();
                prop_assert!((pixel(&a.camera) - pixel(&b.camera)).length() < 1e-6, "{a:?} {b:?}");
            }
        }
    }
}

/// The lenses that both formats describe, with some distortion.
fn lens() -> impl Strategy<Value = Lens> {
    let k = || prop::array::uniform4(-0.02..0.02f64);
    prop_oneof![
        Just(Lens::Pinhole),
        k().prop_map(|[a, b, c, d]| Lens::Brown { k: [a, b, c, 0.0, 0.0, 0.0], p: [0.1 * d, -0.1 * a] }),
        k().prop_map(|k| Lens::Fisheye { k, p: [0.0; 2], s: [0.0; 2] }),
    ]
}

/// A frame whose photograph exists.
fn frame(root: &Path, i: usize, is_test: bool, camera: Camera, pose: Pose) -> Frame {
    let image = root.join(format!("images/{i}.png"));
    photo::save_png(&image, &ImageU8 { width: 8, height: 6, channels: 3, data: vec![9; 144] }).unwrap();
    let split = if is_test { Split::Test } else { Split::Train };
    Frame { split, ..Frame::new(format!("{i}"), image, camera, pose) }
}
