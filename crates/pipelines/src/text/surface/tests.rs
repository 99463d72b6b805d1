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

#[test]
fn reading_coordinates_invert_and_rays_meet_where_they_should() {
    for radius in [None, Some(0.6)] {
        for size in [[0.7, 0.3], [0.2, 0.6]] {
            let board = Board::new(size, radius);
            let points = board.points(6000, 0.0);
            let surface = fit(&points, board.toward(), if radius.is_some() { Wanted::Quadric } else { Wanted::Plane }).unwrap();
            let r = rectangle(&surface, &points, Some(board.world_from_board.x_axis), DVec3::Z);
            assert!((r.reading_size().x / size[0] - 1.0).abs() < 0.02 && (r.reading_size().y / size[1] - 1.0).abs() < 0.02);
            let frame = r.reading_frame(dvec2(0.0, 0.0));
            assert!(degrees(frame.x_axis, board.world_from_board.x_axis) < 1.0 && degrees(frame.z_axis, board.toward()) < 1.0);
            let eye = board.at(0.3, 0.2, 2.0);
            for at in [dvec2(0.0, 0.0), dvec2(0.06, -0.1), dvec2(-0.09, 0.12)] {
                let point = r.reading_point(at);
                let (t, got) = r.hit(eye, (point - eye).normalize(), 0.0).unwrap();
                assert!((got - at).length() < 1e-6 && (t - point.distance(eye)).abs() < 1e-6, "{got} {at}");
            }
            let beyond = r.reading_point(dvec2(0.7 * size[0], 0.0));
            assert!(r.hit(eye, beyond - eye, 0.0).is_none() && r.hit(eye, beyond - eye, 0.3 * size[0]).is_some());
            assert!(r.hit(eye, eye - beyond, 1.0).is_none(), "it is not behind the eye");
            let [low, high] = r.facing(eye).unwrap();
            assert!((high - low) / r.reading_size().x > 0.9 && r.facing(board.at(0.0, 0.0, -2.0)).is_none());
        }
    }
}

#[test]
fn outlines_give_back_the_rectangle_that_they_were_drawn_around() {
    for (size, radius) in [([0.8, 0.25], None), ([0.3, 0.5], None), ([0.6, 0.3], Some(0.6))] {
        let board = Board::new(size, radius);
        let points = board.points(6000, 0.0);
        let surface = fit(&points, board.toward(), Wanted::Auto).unwrap();
        let [x, y] = size.map(|v| 0.5 * v);
        let along = |y: f64, from: f64| (0..5).map(move |k| (from * (1.0 - 0.5 * k as f64), y));
        let outline: Vec<(f64, f64)> =
            if radius.is_some() { along(y, -x).chain(along(-y, x)).collect() } else { vec![(-x, y), (x, y), (x, -y), (-x, -y)] };
        let places = outline.iter().map(|(x, y)| surface.nearest(board.at(*x, *y, 0.0)).0).collect::<Vec<_>>();
        let r = outlined(&surface, &[places.clone(), places]).unwrap();
        assert!((r.reading_size().x - size[0]).abs() < 0.01 && (r.reading_size().y - size[1]).abs() < 0.01, "{:?}", r.reading_size());
        let expected = [(-x, y), (x, y), (x, -y), (-x, -y)].map(|(x, y)| board.at(x, y, 0.0));
        let got = r.reading_corners().map(|c| r.reading_point(c));
        assert!(got.iter().zip(expected).all(|(a, b)| (*a - b).length() < 0.02), "{got:?} {expected:?}");
    }
    let flat = fit(&Board::new(FLAT, None).points(500, 0.0), DVec3::Z, Wanted::Plane).unwrap();
    assert!(outlined(&flat, &[vec![dvec2(0.0, 0.0); 3]]).is_none() && outlined(&flat, &[]).is_none());
}

#[test]
fn depths_that_err_by_more_than_a_region_is_high_do_not_turn_its_plane_edge_on() {
    let board = Board::new([0.8, 0.06], None);
    let rng = Rng::new(9, 9);
    // Seen from the front, each point is off along the view; a fifth by much.
    let points: Vec<DVec3> = board
        .points(3000, 0.0)
        .into_iter()
        .enumerate()
        .map(|(i, p)| p + board.toward() * rng.normal(i as u64) as f64 * if i % 5 == 0 { 0.4 } else { 0.04 })
        .collect();
    let surface = fit(&points, board.toward(), Wanted::Auto).unwrap();
    assert_eq!(surface.kind, Kind::Plane);
    assert!(degrees(surface.normal(dvec2(0.0, 0.0)), board.toward()) < 8.0, "{}", degrees(surface.normal(dvec2(0.0, 0.0)), board.toward()));
}
