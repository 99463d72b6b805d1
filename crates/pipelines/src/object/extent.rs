//! The default box of exported meshes: the surface that most cameras look at.

use super::model::ObjectModel;
use diorama_engine::renderers::volume::{Quality, Tracer};
use diorama_geom::Frame;
use diorama_geom::glam::DVec3;

/// Most cameras that are asked, and pixels along the longer side of their views.
const CAMERAS: usize = 48;
const VIEW_PX: u32 = 40;
/// Points that fewer than this share of the cameras see, compared with the point that most see, are surroundings.
const SEEN: f64 = 0.4;
/// Points farther from the middle of what the cameras look at than this many times the cameras' distance to it are
/// surroundings, even where all cameras see them: a wall behind the thing, or the horizon.
const REACH: f64 = 1.5;
/// Share of a picture's width and height around its middle that tells what a camera looks at.
const MIDDLE: f64 = 0.4;
/// Share of the points left out on either side, and the margin around the rest.
const STRAYS: f64 = 0.01;
const MARGIN: f64 = 0.05;

/// Lowest and highest corner in the world: the inner cube where the field ends there, else the box around the surfaces that many of the
/// cameras see.
pub fn of(model: &ObjectModel) -> ([f32; 3], [f32; 3]) {
    let s = &model.capture.scene;
    let cube = |half: f64| {
        let corner = |sign: f64| s.center + DVec3::splat(sign * half);
        (corner(-1.0), corner(1.0))
    };
    let narrow = |(lo, hi): (DVec3, DVec3)| (lo.as_vec3().to_array(), hi.as_vec3().to_array());
    if s.aabb_scale <= 1 && !model.field.is_unbounded() {
        return narrow(cube(s.half));
    }
    let (lowest, highest) = cube(s.half * s.aabb_scale as f64);
    let mut points = seen_points(model);
    points.retain(|p| p.position.cmpge(lowest).all() && p.position.cmple(highest).all());
    match around(&points) {
        None => narrow(cube(s.half)),
        Some((lo, hi)) => narrow((lo.max(lowest), hi.min(highest))),
    }
}

/// A point of a surface that a camera sees.
struct Seen {
    position: DVec3,
    /// Distance from the camera.
    distance: f64,
    /// Whether it stands in the middle of the camera's picture.
    is_central: bool,
    /// Cameras whose pictures it would stand in.
    cameras: usize,
}

/// Least surfaces that tell anything.
const FEWEST: usize = 100;

/// The box around what most cameras look at; none where they see hardly any surface.
fn around(points: &[Seen]) -> Option<(DVec3, DVec3)> {
    let central: Vec<&Seen> = points.iter().filter(|p| p.is_central).collect();
    // The nearest quarter, so that a thing that does not fill the middle of the pictures counts more than what is behind it.
    let away = REACH * quantile(central.iter().map(|p| p.distance).collect(), 0.25);
    let subject = |k: usize| central.iter().filter(|p| p.distance <= away).map(|p| p.position[k]).collect();
    let middle = DVec3::from([0, 1, 2].map(|k| quantile(subject(k), 0.5)));
    let enough = points.iter().map(|p| p.cameras).max().unwrap_or(0) as f64 * SEEN;
    let of_many = |p: &&Seen| p.cameras as f64 >= enough;
    let near: Vec<&Seen> = points.iter().filter(of_many).filter(|p| (p.position - middle).length() <= away).collect();
    if near.len() < FEWEST {
        return None;
    }
    let side = |k: usize| {
        let mut v: Vec<f64> = near.iter().map(|p| p.position[k]).collect();
        v.sort_by(f64::total_cmp);
        let strays = (v.len() as f64 * STRAYS) as usize;
        (v[strays], v[v.len() - 1 - strays])
    };
    let sides = [side(0), side(1), side(2)];
    let margin = MARGIN * sides.iter().map(|(a, b)| b - a).fold(0.0, f64::max);
    Some((DVec3::from(sides.map(|s| s.0 - margin)), DVec3::from(sides.map(|s| s.1 + margin))))
}

/// The value that a share of the others lies below; 0 of none.
fn quantile(mut v: Vec<f64>, share: f64) -> f64 {
    v.sort_by(f64::total_cmp);
    v.get((v.len() as f64 * share) as usize).copied().unwrap_or(0.0)
}

/// Points in the world of the surfaces that a frame's camera sees, in a view of `longest` pixels along its longer side.
pub fn surface_points(model: &ObjectModel, tracer: &Tracer, f: &Frame, longest: u32) -> Vec<DVec3> {
    surfaces(model, tracer, f, longest).into_iter().map(|s| s.position).collect()
}

/// [`surface_points`] with what the camera knows of them; no camera is counted yet.
fn surfaces(model: &ObjectModel, tracer: &Tracer, f: &Frame, longest: u32) -> Vec<Seen> {
    let c = &f.camera;
    let shrink = longest as f64 / c.width.max(c.height) as f64;
    let small = c.resized(((c.width as f64 * shrink) as u32).max(1), ((c.height as f64 * shrink) as u32).max(1));
    let posed = model.to_model(small, &f.world_from_camera);
    let view = tracer.view(&posed, &mut |_| {});
    let world_from_model = model.model_from_world.inverse();
    let from_middle = |v: f64, n: u32| (v / n as f64 - 0.5).abs() < 0.5 * MIDDLE;
    let seen = |i: usize| {
        let w = small.width as usize;
        let (x, y) = ((i % w) as f64 + 0.5, (i / w) as f64 + 0.5);
        let position = world_from_model.point(posed.pose.point(posed.camera.direction(x, y) * view.depth.data[i] as f64));
        Seen {
            position,
            distance: (position - f.world_from_camera.translation).length(),
            is_central: from_middle(x, small.width) && from_middle(y, small.height),
            cameras: 0,
        }
    };
    (0..view.depth.data.len()).filter(|i| view.opacity.data[*i] > 0.5).map(seen).collect()
}

/// Points of surfaces in small views from the training cameras.
fn seen_points(model: &ObjectModel) -> Vec<Seen> {
    let n = model.train.len();
    let frames: Vec<_> = (0..n.min(CAMERAS)).map(|i| &model.capture.frames[model.train[i * n / n.min(CAMERAS)]]).collect();
    let tracer = model.tracer(Quality::Fast);
    let mut points: Vec<Seen> = frames.iter().flat_map(|f| surfaces(model, &tracer, f, VIEW_PX)).collect();
    for p in &mut points {
        let in_view = |f: &&&diorama_geom::Frame| f.camera.shows(f.world_from_camera.inverse().point(p.position));
        p.cameras = frames.iter().filter(in_view).count();
    }
    points
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_geom::{Camera, Pose};

    /// What cameras see of a ball of radius 1 at the origin before a wall `wall` away from it, or before nothing.
    fn scene(eyes: &[DVec3], wall: f64) -> Vec<Seen> {
        let camera = Camera::pinhole(40, 30, 0.9);
        let poses: Vec<Pose> = eyes.iter().map(|e| Pose::look_at(*e, DVec3::ZERO, DVec3::Z)).collect();
        let mut out = Vec::new();
        for pose in &poses {
            for i in 0..40 * 30 {
                let (x, y) = ((i % 40) as f64 + 0.5, (i / 40) as f64 + 0.5);
                let d = pose.rotation * camera.direction(x, y);
                let o = pose.translation;
                // The near side of the ball, else the far side of a ball of the wall's radius around it.
                let hit = |r: f64, side: f64| {
                    let (b, c) = (o.dot(d), o.length_squared() - r * r);
                    (b * b >= c).then(|| -b + side * (b * b - c).sqrt())
                };
                let t = hit(1.0, -1.0).or(hit(wall, 1.0)).unwrap();
                let p = o + d * t;
                let sees = |pose: &&Pose| {
                    camera.project(pose.inverse().point(p)).is_some_and(|px| (0.0..40.0).contains(&px.x) && (0.0..30.0).contains(&px.y))
                };
                let is_central = (x / 40.0 - 0.5).abs() < 0.5 * MIDDLE && (y / 30.0 - 0.5).abs() < 0.5 * MIDDLE;
                out.push(Seen { position: p, distance: t, is_central, cameras: poses.iter().filter(sees).count() });
            }
        }
        out
    }

    /// The box must hold the ball and hardly more.
    #[track_caller]
    fn holds_the_ball(points: &[Seen]) {
        let (lo, hi) = around(points).unwrap();
        assert!((0..3).all(|k| lo[k] < -0.45 && hi[k] > 0.45), "{lo} {hi}");
        assert!((hi - lo).max_element() < 4.0, "{lo} {hi}");
    }

    #[test]
    fn the_box_holds_the_thing_and_not_the_room_however_large() {
        let ring: Vec<DVec3> = (0..12).map(|i| DVec3::new(4.0 * (i as f64 * 0.52).cos(), 4.0 * (i as f64 * 0.52).sin(), 1.5)).collect();
        for wall in [12.0, 64.0, 1000.0] {
            holds_the_ball(&scene(&ring, wall));
        }
    }

    #[test]
    fn what_all_cameras_see_far_behind_the_thing_is_no_part_of_it() {
        // From one side only, so that every camera has the wall in its picture as it has the ball.
        let side: Vec<DVec3> = (0..9).map(|i| DVec3::new(4.0, (i % 3) as f64 * 0.6 - 0.6, (i / 3) as f64 * 0.6 - 0.6)).collect();
        for wall in [16.0, 64.0, 1000.0] {
            let points = scene(&side, wall);
            let (lo, hi) = around(&points).unwrap();
            assert!((hi - lo).max_element() < 4.0, "{wall}: {lo} {hi}");
        }
    }

    #[test]
    fn too_little_surface_gives_no_box() {
        assert!(around(&[]).is_none());
        assert!(around(&scene(&[DVec3::new(4.0, 0.0, 0.0)], 8.0)[..90]).is_none());
    }
}
