//! Sparse points of a capture, and COLMAP models whose poses contradict their points.

use diorama_data::import::{self, Format, ImportOptions};
use diorama_data::{colmap, photo, photo_check};
use diorama_geom::capture::Frame;
use diorama_geom::glam::{DQuat, DVec3};
use diorama_geom::rng::Rng;
use diorama_geom::{Camera, Capture, ImageU8, Pose, SceneBox};
use std::path::Path;

const VIEWS: usize = 8;
const POINTS: u64 = 300;

/// A COLMAP model to generate.
struct Kind {
    /// Offset added to the point ids in the points file; the images file counts from 0.
    first: u64,
    /// Indices of photographs that get a wrong pose.
    wrong: Vec<usize>,
    /// Keypoints refer to photographs larger by this factor.
    keypoints: f64,
    text: bool,
    tracks: bool,
    /// Index of a photograph that shares no points.
    alone: Option<usize>,
}

const GOOD: Kind = Kind { first: 0, wrong: Vec::new(), keypoints: 1.0, text: false, tracks: true, alone: None };

fn pose(i: usize) -> Pose {
    let a = i as f64 * 0.7;
    Pose::look_at(DVec3::new(4.0 * a.cos(), 4.0 * a.sin(), 1.0), DVec3::ZERO, DVec3::Z)
}

/// Writes a model to `sparse/0`, and photographs.
fn write(root: &Path, kind: &Kind) {
    let (model, images) = (root.join("sparse/0"), root.join("images"));
    std::fs::create_dir_all(&model).unwrap();
    std::fs::create_dir_all(&images).unwrap();
    let camera = Camera::pinhole(200, 150, 0.9);
    let rng = Rng::new(5, 0);
    let place = |n: u64| DVec3::from_array(std::array::from_fn(|k| 2.0 * rng.uniform(3 * n + k as u64) as f64 - 1.0));
    let (mut lines, mut binary) = (String::new(), (VIEWS as u64).to_le_bytes().to_vec());
    let mut tracks = vec![Vec::new(); POINTS as usize];
    for i in 0..VIEWS {
        let image = ImageU8 { width: 200, height: 150, channels: 3, data: vec![90; 200 * 150 * 3] };
        photo::save_png(&images.join(format!("v{i}.png")), &image).unwrap();
        let inverse = pose(i).inverse();
        let written = if kind.wrong.contains(&i) { pose(i + 3).inverse() } else { inverse };
        let shows = |n: u64| kind.alone.is_none_or(|a| (n < 20) == (a == i));
        let seen: Vec<(f64, f64, u64)> = (0..POINTS)
            .filter(|n| shows(*n))
            .filter_map(|n| camera.project(inverse.point(place(n))).map(|p| (p.x * kind.keypoints, p.y * kind.keypoints, n)))
            .collect();
        let q = DQuat::from_mat3(&written.rotation);
        let t = written.translation;
        binary.extend((i as u32 + 1).to_le_bytes());
        [q.w, q.x, q.y, q.z, t.x, t.y, t.z].iter().for_each(|v| binary.extend(v.to_le_bytes()));
        binary.extend(1u32.to_le_bytes());
        binary.extend(format!("v{i}.png\0").bytes());
        binary.extend((seen.len() as u64).to_le_bytes());
        lines += &format!("{} {} {} {} {} {} {} {} 1 v{i}.png\n", i + 1, q.w, q.x, q.y, q.z, t.x, t.y, t.z);
        for (k, (x, y, n)) in seen.iter().enumerate() {
            [*x, *y].iter().for_each(|v| binary.extend(v.to_le_bytes()));
            binary.extend(n.to_le_bytes());
            lines += &format!("{x} {y} {n} ");
            tracks[*n as usize].push((i as u32 + 1, k as u32));
        }
        lines += "\n";
    }
    let mut all = POINTS.to_le_bytes().to_vec();
    let mut points = String::new();
    for n in 0..POINTS {
        let (id, x, track) = (n + kind.first, place(n), if kind.tracks { &tracks[n as usize][..] } else { &[] });
        all.extend(id.to_le_bytes());
        x.to_array().iter().for_each(|v| all.extend(v.to_le_bytes()));
        all.extend([10, 20, 30]);
        all.extend(0.5f64.to_le_bytes());
        all.extend((track.len() as u64).to_le_bytes());
        track.iter().for_each(|(i, k)| all.extend([i.to_le_bytes(), k.to_le_bytes()].concat()));
        points += &format!("{id} {} {} {} 10 20 30 0.5", x.x, x.y, x.z);
        track.iter().for_each(|(i, k)| points += &format!(" {i} {k}"));
        points += "\n";
    }
    if kind.text {
        std::fs::write(model.join("cameras.txt"), format!("1 PINHOLE 200 150 {} {} 100 75\n", camera.fx, camera.fy)).unwrap();
        std::fs::write(model.join("images.txt"), lines).unwrap();
        std::fs::write(model.join("points3D.txt"), points).unwrap();
        return;
    }
    let mut cameras = [&1u64.to_le_bytes()[..], &1u32.to_le_bytes(), &1u32.to_le_bytes()].concat();
    [200u64, 150].iter().for_each(|v| cameras.extend(v.to_le_bytes()));
    [camera.fx, camera.fy, camera.cx, camera.cy].iter().for_each(|v| cameras.extend(v.to_le_bytes()));
    std::fs::write(model.join("cameras.bin"), cameras).unwrap();
    std::fs::write(model.join("images.bin"), binary).unwrap();
    std::fs::write(model.join("points3D.bin"), all).unwrap();
}

fn read(kind: &Kind) -> Result<Capture, String> {
    let dir = tempfile::tempdir().unwrap();
    write(dir.path(), kind);
    import::import(dir.path(), &ImportOptions::default()).map_err(|e| {
        assert!(e.is_input());
        e.to_string()
    })
}

#[test]
fn a_good_model_gives_its_points_with_the_frames_that_see_them() {
    for text in [false, true] {
        let c = read(&Kind { text, ..GOOD }).unwrap();
        assert_eq!((c.points.len(), c.notes.len()), (POINTS as usize, 0), "{:?}", c.notes);
        let a = c.agreement.as_ref().unwrap();
        let (mean, median) = a.error_px.unwrap();
        assert!(mean < 1e-6 && median < 1e-6 && a.absent == 0 && a.observations > 1000, "{a:?}");
        for p in &c.points {
            assert!(p.frames.len() > 1 && p.frames.is_sorted() && p.color == [10, 20, 30] && p.error == 0.5);
            // Points are in the world that the importer has turned upright, like the frames.
            for f in p.frames.iter().map(|f| &c.frames[*f as usize]) {
                let px = f.camera.project(f.world_from_camera.inverse().point(p.position)).unwrap();
                assert!(px.x > 0.0 && px.x < 200.0 && px.y > -60.0 && px.y < 210.0, "{px}");
            }
        }
        assert!(c.frames.iter().zip(&a.frames).all(|(_, a)| a.shared > 100 && a.error_px.unwrap() < 1e-6));
    }
}

#[test]
fn poses_that_contradict_the_points_are_refused_and_can_be_looked_at() {
    let broken = Kind { wrong: (0..VIEWS).collect(), ..GOOD };
    let e = read(&broken).unwrap_err();
    assert!(e.contains("sparse/0") && e.contains("contradict") && e.contains("prepare") && e.contains("points3D"), "{e}");
    assert!(!e.contains("is in the model's folder too"), "{e}");
    let dir = tempfile::tempdir().unwrap();
    write(dir.path(), &broken);
    std::fs::write(dir.path().join("sparse/0/images_0.bin"), b"").unwrap();
    let e = import::import(dir.path(), &ImportOptions::default()).err().unwrap().to_string();
    assert!(e.contains("images_0.bin is in the model's folder too"), "{e}");
    let looked = import::import(dir.path(), &ImportOptions { allow_broken: true, ..ImportOptions::default() }).unwrap();
    assert!(looked.agreement.unwrap().is_broken());
    // As the message suggests: without points the poses are accepted as they are.
    std::fs::remove_file(dir.path().join("sparse/0/points3D.bin")).unwrap();
    assert_eq!(import::import(dir.path(), &ImportOptions::default()).unwrap().agreement, None);
}

#[test]
fn observations_of_absent_points_are_checked_by_tracks() {
    // Files of two runs: ids and positions differ.
    let mixed = Kind { first: 100_000, wrong: (0..VIEWS).collect(), ..GOOD };
    let e = read(&mixed).unwrap_err();
    assert!(e.contains("contradict") && e.contains("not in the model"), "{e}");
    // Only the ids differ.
    let numbered = read(&Kind { first: 100_000, ..GOOD }).unwrap();
    assert!(numbered.notes.len() == 1 && numbered.notes[0].contains("0.0 pixels apart"), "{:?}", numbered.notes);
    assert!(numbered.points.iter().all(|p| p.frames.len() > 1));
    let without = read(&Kind { first: 100_000, tracks: false, ..GOOD }).unwrap();
    assert!(without.notes.len() == 1 && without.notes[0].contains("could not be compared"), "{:?}", without.notes);
}

#[test]
fn single_photographs_are_named() {
    let one = read(&Kind { wrong: vec![5], ..GOOD }).unwrap();
    assert!(
        one.notes.len() == 1 && one.notes[0].starts_with("1 of 8 photographs do not fit") && one.notes[0].contains("v5"),
        "{:?}",
        one.notes
    );
    let alone = read(&Kind { alone: Some(2), ..GOOD }).unwrap();
    assert!(alone.notes.len() == 1 && alone.notes[0].contains("share no points with others: v2;"), "{:?}", alone.notes);
}

#[test]
fn keypoints_of_larger_photographs_are_no_contradiction() {
    let c = read(&Kind { keypoints: 4.0, ..GOOD }).unwrap();
    assert!(c.notes.is_empty() && c.agreement.unwrap().error_px.unwrap().1 < 1e-3);
}

#[test]
fn damaged_points_are_named() {
    let dir = tempfile::tempdir().unwrap();
    write(dir.path(), &GOOD);
    let file = dir.path().join("sparse/0/points3D.bin");
    let good = std::fs::read(&file).unwrap();
    std::fs::write(&file, &good[..good.len() - 9]).unwrap();
    let e = import::import(dir.path(), &ImportOptions::default()).unwrap_err();
    assert!(e.is_input() && e.to_string().contains("points3D.bin"), "{e}");
    let dir = tempfile::tempdir().unwrap();
    write(dir.path(), &Kind { text: true, ..GOOD });
    let file = dir.path().join("sparse/0/points3D.txt");
    std::fs::write(&file, "1 0 0 zero 10 20 30 0.5\n").unwrap();
    assert!(colmap::points(file.parent().unwrap()).unwrap_err().to_string().contains("line 1"));
}

#[test]
fn points_named_by_transforms_json_come_along() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::create_dir(dir.path().join("images")).unwrap();
    let frames = (0..4)
        .map(|i| {
            let image = dir.path().join(format!("images/v{i}.png"));
            photo::save_png(&image, &ImageU8 { width: 8, height: 6, channels: 3, data: vec![9; 144] }).unwrap();
            Frame::new(format!("v{i}"), image, Camera::pinhole(8, 6, 0.9), pose(i))
        })
        .collect();
    let capture = Capture::new(frames, SceneBox { center: DVec3::ZERO, half: 1.0, aabb_scale: 2 });
    let file = dir.path().join("transforms.json");
    diorama_data::transforms_json::write(&file, dir.path(), &capture, Some("cloud.ply")).unwrap();
    let options = ImportOptions { format: Some(Format::Transforms), ..ImportOptions::default() };
    let without = import::import(dir.path(), &options).unwrap();
    assert!(without.points.is_empty() && without.notes[0].contains("cloud.ply does not exist"), "{:?}", without.notes);
    let head = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n";
    let text = format!("{head}property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n1 2 3 255 0 10\n4 5 6 0 0 0\n");
    std::fs::write(dir.path().join("cloud.ply"), text).unwrap();
    let with = import::import(dir.path(), &options).unwrap();
    assert_eq!((with.points.len(), with.points[0].position, with.points[0].color), (2, DVec3::new(1.0, 2.0, 3.0), [255, 0, 10]));
    assert!(with.points[0].frames.is_empty() && with.agreement.is_none());
    // Points are not stored in a run's folder.
    assert!(!serde_json::to_string(&with).unwrap().contains("points"));
}

#[test]
fn points_follow_the_photographs_when_broken_ones_are_left_out() {
    let dir = tempfile::tempdir().unwrap();
    write(dir.path(), &GOOD);
    std::fs::write(dir.path().join("images/v2.png"), b"").unwrap();
    let whole = std::fs::read(dir.path().join("images/v5.png")).unwrap();
    std::fs::write(dir.path().join("images/v5.png"), &whole[..whole.len() - 20]).unwrap();
    let mut c = import::import(dir.path(), &ImportOptions { skip_broken: true, ..ImportOptions::default() }).unwrap();
    photo_check::leave_out_broken(&mut c).unwrap();
    assert_eq!((c.frames.len(), &c.broken[..]), (VIEWS - 2, &["v2.png".to_string(), "v5.png".to_string()][..]));
    assert_eq!(c.agreement.as_ref().unwrap().frames.len(), VIEWS - 2);
    assert!(!c.points.is_empty());
    for p in &c.points {
        for f in &p.frames {
            let f = &c.frames[*f as usize];
            assert!(f.camera.project(f.world_from_camera.inverse().point(p.position)).is_some(), "{} sees {}", f.name, p.position);
        }
    }
    // Each frame has the points that the whole model has for it.
    write(dir.path(), &GOOD);
    let all = import::import(dir.path(), &ImportOptions::default()).unwrap();
    let seen_by = |c: &Capture, name: &str| {
        let at = c.frames.iter().position(|f| f.name == name).unwrap() as u32;
        c.points.iter().filter(|p| p.frames.contains(&at)).map(|p| p.position.to_array()).collect::<Vec<_>>()
    };
    for f in &c.frames {
        let want = seen_by(&all, &f.name);
        assert!(!want.is_empty() && seen_by(&c, &f.name).len() == want.len(), "{}", f.name);
    }
}
