use super::*;
use diorama_geom::daylight::Daylight;
use diorama_geom::environment::Environment;
use diorama_scenes::signs::{Family, Stage};

/// A flat board of a stage, and a camera straight before it.
fn before(distance: f64) -> (Stage, Camera, Pose) {
    let stage = Stage::of(Family::Room, 0, usize::MAX);
    let board = stage.boards[1];
    let face = board.world_from_face(0.0);
    let middle = board.point(DVec2::ZERO);
    let pose = Pose::look_at(middle + distance * face.z_axis, middle, DVec3::Z);
    (stage, Camera::pinhole(320, 240, 1.0), pose)
}

#[test]
fn a_region_seen_from_the_front_is_an_upright_rectangle_of_the_size_that_its_distance_gives() {
    let (stage, camera, pose) = before(2.0);
    let rect = Rect { low: [-0.3, -0.1], high: [0.3, 0.1] };
    let q = quad(&stage.boards[1], &rect, &camera, &pose).unwrap();
    let (w, h) = (camera.fx * 0.6 / 2.0, camera.fy * 0.2 / 2.0);
    let expected = [
        [160.0 - w / 2.0, 120.0 - h / 2.0],
        [160.0 + w / 2.0, 120.0 - h / 2.0],
        [160.0 + w / 2.0, 120.0 + h / 2.0],
        [160.0 - w / 2.0, 120.0 + h / 2.0],
    ];
    assert!(q.iter().flatten().zip(expected.iter().flatten()).all(|(a, b)| (a - b).abs() < 1e-9), "{q:?}");
    assert!((shortest_side(&q) - h).abs() < 1e-9);
    // Frontal text is diag(1, −1, −1).
    let pose = text_pose(&stage.boards[1], &rect, &pose);
    let frontal = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
    assert!(
        (pose.rotation - frontal).to_cols_array().iter().all(|v| v.abs() < 1e-9) && (pose.translation - 2.0 * DVec3::Z).length() < 1e-9
    );
    assert!(quad(&stage.boards[1], &rect, &camera, &before(-2.0).2).is_none());
}

#[test]
fn visibility_is_the_share_in_the_picture_and_not_hidden() {
    let (stage, camera, pose) = before(0.9);
    let pictures: Vec<_> =
        stage.boards.iter().map(|_| diorama_geom::ImageU8 { width: 1, height: 1, channels: 3, data: vec![99; 3] }).collect();
    let scene = Scene::new(&stage.model(&pictures), &Daylight::of(Environment::uniform([1.0; 3], 8)));
    let board = &stage.boards[1];
    let small = Rect { low: [-0.1, -0.1], high: [0.1, 0.1] };
    assert_eq!(visibility(&scene, board, &small, &camera, &pose), 1.0);
    // Twice as wide as the picture: half of it.
    let half = 0.9 * (0.5f64).tan();
    let wide = Rect { low: [-2.0 * half, -0.05], high: [2.0 * half, 0.05] };
    let share = visibility(&scene, board, &wide, &camera, &pose);
    assert!((share - 0.5).abs() <= 1.0 / 32.0, "{share}");
    // From behind it shows its back.
    let behind = Pose::look_at(board.point(DVec2::ZERO) - board.world_from_face(0.0).z_axis, board.point(DVec2::ZERO), DVec3::Z);
    assert_eq!(visibility(&scene, board, &small, &camera, &behind), 0.0);
    // A screen that ends in the middle hides half.
    let mut model = stage.model(&pictures);
    let face = board.world_from_face(0.0);
    let screen = board.point(DVec2::ZERO) + 0.3 * face.z_axis;
    let corners =
        [[0.0, -1.0], [1.0, -1.0], [1.0, 1.0], [0.0, 1.0]].map(|[x, y]| (screen + x * face.x_axis + y * face.y_axis).as_vec3().to_array());
    let mesh = diorama_geom::Mesh { positions: corners.to_vec(), faces: vec![[0, 1, 2], [0, 2, 3]], ..Default::default() };
    model.add(diorama_geom::Model::of("screen", mesh), diorama_geom::glam::DAffine3::IDENTITY);
    let hidden = Scene::new(&model, &Daylight::of(Environment::uniform([1.0; 3], 8)));
    assert!((visibility(&hidden, board, &small, &camera, &pose) - 0.5).abs() < 1e-12);
}

#[test]
fn polygons_end_with_the_picture_and_keep_their_first_corner() {
    let size = [100.0, 60.0];
    let square = [[10.0, 10.0], [50.0, 10.0], [50.0, 40.0], [10.0, 40.0]];
    assert_eq!(clipped(&square, size), square);
    assert_eq!(
        clipped(&[[80.0, 10.0], [120.0, 10.0], [120.0, 40.0], [80.0, 40.0]], size),
        [[80.0, 10.0], [100.0, 10.0], [100.0, 40.0], [80.0, 40.0]]
    );
    assert_eq!(
        clipped(&[[-20.0, 10.0], [20.0, 10.0], [20.0, 40.0], [-20.0, 40.0]], size),
        [[0.0, 10.0], [20.0, 10.0], [20.0, 40.0], [0.0, 40.0]]
    );
    assert!(clipped(&[[-20.0, 10.0], [-1.0, 10.0], [-1.0, 40.0]], size).is_empty());
}
