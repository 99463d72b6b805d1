use super::*;
use diorama_geom::glam::{DMat3, DVec3, dvec2};
use diorama_geom::rng::Rng;

/// A board's frame: x along the reading direction, y up, z toward the viewer, who is on +z.
struct Board {
    world_from_board: DMat3,
    center: DVec3,
    size: [f64; 2],
    radius: Option<f64>,
}

const FLAT: [f64; 2] = [0.8, 0.25];

impl Board {
    fn new(size: [f64; 2], radius: Option<f64>) -> Board {
        let turn = DMat3::from_rotation_z(0.3) * DMat3::from_rotation_y(0.5) * DMat3::from_rotation_x(-0.2);
        Board { world_from_board: turn, center: DVec3::new(1.0, -2.0, 3.0), size, radius }
    }

    fn at(&self, x: f64, y: f64, out: f64) -> DVec3 {
        let p = match self.radius {
            None => DVec3::new(x, y, out),
            Some(r) => DVec3::new((r + out) * (x / r).sin(), y, (r + out) * (x / r).cos() - r),
        };
        self.center + self.world_from_board * p
    }

    /// Points of it with noise along the normal.
    fn points(&self, n: usize, noise: f64) -> Vec<DVec3> {
        let rng = Rng::new(5, n as u64);
        let u = |k: u64| rng.uniform(k) as f64 - 0.5;
        (0..n as u64)
            .map(|i| self.at(self.size[0] * u(3 * i), self.size[1] * u(3 * i + 1), noise * rng.normal(1_000_000 + i) as f64))
            .collect()
    }

    fn toward(&self) -> DVec3 {
        self.world_from_board.z_axis
    }
}

fn degrees(a: DVec3, b: DVec3) -> f64 {
    a.normalize().dot(b.normalize()).clamp(-1.0, 1.0).acos().to_degrees()
}

#[test]
fn a_plane_with_noise_and_outliers_is_found_with_its_rectangle_and_pose() {
    let board = Board::new(FLAT, None);
    let mut points = board.points(4000, 0.002);
    let stray = |i: usize| board.at(0.4 * (i as f64 / 400.0 - 0.5), 0.1, 0.05 + 0.2 * (i as f64 * 0.618).fract());
    points.extend((0..400).map(stray));
    let surface = fit(&points, board.toward(), Wanted::Auto).unwrap();
    assert_eq!(surface.kind, Kind::Plane);
    assert!(
        degrees(surface.normal(dvec2(0.1, 0.05)), board.toward()) < 0.1,
        "{}",
        degrees(surface.normal(dvec2(0.0, 0.0)), board.toward())
    );
    assert!(surface.rms < 0.0025);
    let points = board.points(4000, 0.0);
    let surface = fit(&points, board.toward(), Wanted::Auto).unwrap();
    assert!(degrees(surface.normal(dvec2(0.0, 0.0)), board.toward()) < 1e-6 && surface.rms < 1e-9);
    let r = rectangle(&surface, &points, Some(board.world_from_board.x_axis), DVec3::Z);
    assert!((r.size.x - FLAT[0]).abs() < 0.004 && (r.size.y - FLAT[1]).abs() < 0.004 && r.quarter_turns == 0, "{:?}", r.size);
    let (pose, center) = r.world_from_region();
    assert!((pose - board.world_from_board).to_cols_array().iter().all(|v| v.abs() < 0.01) && (center - board.center).length() < 0.003);
    let expected = [(-0.5, 0.5), (0.5, 0.5), (0.5, -0.5), (-0.5, -0.5)].map(|(x, y)| board.at(x * FLAT[0], y * FLAT[1], 0.0));
    assert!(r.corners().iter().zip(expected).all(|(a, b)| (*a - b).length() < 0.008));
}

#[test]
fn long_regions_keep_their_ends() {
    let board = Board::new([2.0, 0.15], None);
    let points = board.points(8000, 0.0);
    let surface = fit(&points, board.toward(), Wanted::Auto).unwrap();
    let r = rectangle(&surface, &points, Some(board.world_from_board.x_axis), DVec3::Z);
    assert!((r.size.x - 2.0).abs() < 0.006 && (r.size.y - 0.15).abs() < 0.003, "{:?}", r.size);
}

#[test]
fn a_bent_surface_becomes_a_quadric_whose_rectangle_has_lengths_along_it() {
    let board = Board::new([0.7, 0.3], Some(0.6));
    let points = board.points(6000, 0.001);
    let surface = fit(&points, board.toward(), Wanted::Auto).unwrap();
    assert_eq!(surface.kind, Kind::Quadric);
    assert!(fit(&points, board.toward(), Wanted::Plane).unwrap().rms > 5.0 * surface.rms, "{}", surface.rms);
    let r = rectangle(&surface, &points, Some(board.world_from_board.x_axis), DVec3::Z);
    assert!((r.size.x / 0.7 - 1.0).abs() < 0.015 && (r.size.y / 0.3 - 1.0).abs() < 0.02, "{:?}", r.size);
    let (pose, center) = r.world_from_region();
    assert!(degrees(pose.z_axis, board.toward()) < 1.0 && degrees(pose.x_axis, board.world_from_board.x_axis) < 1.0);
    assert!((center - board.center).length() < 0.004);
    // Away from the middle as well: a quarter of the width from it.
    assert!((r.point(dvec2(0.175, 0.0)) - board.at(0.175, 0.0, 0.0)).length() < 0.005);
    // Few points do not choose a quadric by themselves.
    assert_eq!(fit(&board.points(150, 0.001), board.toward(), Wanted::Auto).unwrap().kind, Kind::Plane);
    assert_eq!(fit(&board.points(150, 0.001), board.toward(), Wanted::Quadric).unwrap().kind, Kind::Quadric);
}

#[test]
fn the_reading_direction_turns_the_frame_or_counts_quarter_turns() {
    let board = Board::new(FLAT, None);
    let points = board.points(3000, 0.0);
    let surface = fit(&points, board.toward(), Wanted::Auto).unwrap();
    let [x, y] = [board.world_from_board.x_axis, board.world_from_board.y_axis];
    for (reading, turns, along) in [(x, 0, x), (-x, 0, -x), (y, 1, x), (-y, 3, x)] {
        let r = rectangle(&surface, &points, Some(reading), DVec3::Z);
        let pose = r.world_from_region().0;
        // Vertical text leaves open which way the longer side points, so that turns and axis agree with the reading direction.
        let turned = DMat3::from_axis_angle(pose.z_axis, r.quarter_turns as f64 * std::f64::consts::FRAC_PI_2) * pose.x_axis;
        assert!(turned.dot(reading) > 0.99 && (turns % 2 == 1 || pose.x_axis.dot(along) > 0.99) && r.quarter_turns % 2 == turns % 2);
    }
    // Without one, it reads to the right of an upright viewer.
    let pose = rectangle(&surface, &points, None, y).world_from_region().0;
    assert!(pose.x_axis.dot(x) > 0.99);
}

#[test]
fn smoothing_takes_noise_and_leaves_the_shape() {
    for radius in [None, Some(0.6)] {
        let board = Board::new([0.5, 0.3], radius);
        let (points, spacing) = cleaned(&board.points(4000, 0.003));
        let off = |p: &DVec3| {
            let local = board.world_from_board.transpose() * (*p - board.center);
            radius.map_or(local.z, |r| local.x.hypot(local.z + r) - r)
        };
        let rms = |points: &[DVec3]| (points.iter().map(|p| off(p).powi(2)).sum::<f64>() / points.len() as f64).sqrt();
        let smooth = smoothed(&points, spacing);
        assert!(rms(&smooth) < 0.45 * rms(&points), "{} {}", rms(&smooth), rms(&points));
    }
}

#[test]
fn clouds_lose_outliers_and_what_is_too_many() {
    let board = Board::new(FLAT, None);
    let mut points = board.points(3000, 0.001);
    let far: Vec<DVec3> = (0..20).map(|i| board.center + DVec3::new(0.2 * i as f64 - 2.0, 1.5, 0.3)).collect();
    points.extend(&far);
    let (kept, spacing) = cleaned(&points);
    assert!(kept.len() > 2800 && far.iter().all(|p| !kept.contains(p)) && (0.001..0.02).contains(&spacing), "{} {spacing}", kept.len());
    let mut many = board.points(60_000, 0.0);
    many.extend([DVec3::splat(100.0), DVec3::splat(f64::NAN), DVec3::new(f64::INFINITY, 0.0, 0.0)]);
    let (kept, _) = cleaned(&many);
    assert!((10_000..=20_000).contains(&kept.len()) && kept.iter().all(|p| (*p - board.center).length() < 1.0), "{}", kept.len());
}

#[test]
fn too_few_points_and_lines_have_no_surface() {
    let board = Board::new(FLAT, None);
    assert_eq!(fit(&board.points(49, 0.0), board.toward(), Wanted::Auto), Err(NoSurface::FewPoints(49)));
    let line: Vec<DVec3> = (0..100).map(|i| board.at(0.01 * i as f64, 0.0, 0.0)).collect();
    assert_eq!(fit(&line, board.toward(), Wanted::Auto), Err(NoSurface::Line));
}
