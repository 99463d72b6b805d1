//! Properties of cameras, transforms and camera paths: invariance under rigid motions of the world, and round trips.

use diorama_geom::glam::{DMat3, DVec3};
use diorama_geom::transform::rotation_from_axis_angle;
use diorama_geom::{Camera, Lens, Pose, Similarity, camera_path};
use proptest::prelude::*;

fn vector(size: f64) -> impl Strategy<Value = DVec3> {
    prop::array::uniform3(-size..size).prop_map(DVec3::from_array)
}

fn rotation() -> impl Strategy<Value = DMat3> {
    vector(3.0).prop_map(rotation_from_axis_angle)
}

fn pose() -> impl Strategy<Value = Pose> {
    (rotation(), vector(5.0)).prop_map(|(rotation, translation)| Pose { rotation, translation })
}

/// A rigid motion with a scale.
fn motion() -> impl Strategy<Value = Similarity> {
    (0.1..10.0f64, rotation(), vector(5.0)).prop_map(|(scale, rotation, translation)| Similarity { scale, rotation, translation })
}

/// Every lens model, with some distortion.
fn camera() -> impl Strategy<Value = Camera> {
    let lens = prop_oneof![
        Just(Lens::Pinhole),
        prop::array::uniform4(-0.02..0.02f64).prop_map(|[a, b, c, d]| Lens::Brown { k: [a, b, c, 0.0, 0.0, 0.0], p: [0.1 * d, -0.1 * a] }),
        prop::array::uniform4(-0.01..0.01f64).prop_map(|k| Lens::Fisheye { k, p: [0.0; 2], s: [0.0; 2] }),
        (0.3..1.2f64).prop_map(|omega| Lens::Fov { omega }),
        Just(Lens::Equirectangular),
    ];
    (lens, 0.5..1.4f64, 0.9..1.1f64).prop_map(|(lens, fov, aspect)| match lens {
        Lens::Equirectangular => Camera::equirectangular(64, 32),
        lens => {
            let straight = Camera::pinhole(64, 48, fov);
            Camera { fy: straight.fy * aspect, cx: straight.cx + 1.5, lens, ..straight }
        }
    })
}

fn near(a: DVec3, b: DVec3) -> bool {
    (a - b).length() <= 1e-9 * (1.0 + a.length())
}

fn same_poses(a: &[Pose], b: &[Pose]) -> bool {
    a.len() == b.len()
        && a.iter().zip(b).all(|(a, b)| (a.translation - b.translation).length() < 1e-6 && a.rotation.abs_diff_eq(b.rotation, 1e-6))
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 200, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn transforms_are_undone_by_their_inverses(s in motion(), t in motion(), p in pose(), x in vector(5.0)) {
        prop_assert!(near(s.inverse().point(s.point(x)), x));
        prop_assert!(near(p.inverse().point(p.point(x)), x));
        prop_assert!(near(s.after(&t).point(x), s.point(t.point(x))));
        prop_assert!(s.pose(&p).rigidity_error() < 1e-9);
    }

    #[test]
    fn no_motion_of_the_world_moves_a_pixel(camera in camera(), pose in pose(), s in motion(), x in vector(5.0)) {
        let before = camera.project(pose.inverse().point(x));
        let after = camera.project(s.pose(&pose).inverse().point(s.point(x)));
        match (before, after) {
            (Some(a), Some(b)) => prop_assert!((a - b).length() <= 1e-6 * (1.0 + a.length()), "{a} {b}"),
            (a, b) => prop_assert!(a.is_none() && b.is_none(), "{a:?} {b:?}"),
        }
    }

    #[test]
    fn directions_of_pixels_lead_back_to_them(camera in camera(), u in 0.05..0.95f64, v in 0.05..0.95f64, far in 0.1..100.0f64) {
        let (x, y) = (u * camera.width as f64, v * camera.height as f64);
        let direction = camera.direction(x, y);
        prop_assert!((direction.length() - 1.0).abs() < 1e-9);
        let back = camera.project(direction * far).expect("a pixel's own direction is seen");
        prop_assert!((back.x - x).abs() < 1e-4 && (back.y - y).abs() < 1e-4, "{x} {y} {back}");
    }

    #[test]
    fn camera_paths_move_with_the_world(
        poses in prop::collection::vec(pose(), 3..6),
        center in vector(1.0),
        s in motion(),
        frames in 2usize..7,
    ) {
        let s = Similarity { scale: 1.0, ..s };
        let moved: Vec<Pose> = poses.iter().map(|p| s.pose(p)).collect();
        let up = DVec3::new(0.1, -0.2, 0.9);
        let all = |p: Vec<Pose>| p.iter().map(|p| s.pose(p)).collect::<Vec<_>>();
        let orbit = camera_path::orbit(&poses, center, up, frames);
        prop_assert!(same_poses(&all(orbit), &camera_path::orbit(&moved, s.point(center), s.rotation * up, frames)));
        let between = camera_path::interpolate(&poses, frames);
        prop_assert!(same_poses(&all(between), &camera_path::interpolate(&moved, frames)));
    }
}
