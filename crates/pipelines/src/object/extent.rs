//! What a capture is of: the box that a mesh is taken from when nobody says which.

use super::model::ObjectModel;
use diorama_engine::renderers::volume::Quality;
use diorama_geom::glam::DVec3;

/// Most cameras that are asked, and pixels along the longer side of their views.
const CAMERAS: usize = 48;
const VIEW_PX: u32 = 40;
/// Points that fewer than this share of the cameras see, compared with the point that most see, are surroundings.
const SEEN: f64 = 0.4;
/// Share of the points left out on either side, and the margin around the rest.
const STRAYS: f64 = 0.01;
const MARGIN: f64 = 0.05;

/// Lowest and highest corner in the world: the inner cube where it is all there is, else the box around the surfaces that
/// many of the cameras see.
pub fn of(model: &ObjectModel) -> ([f32; 3], [f32; 3]) {
    let s = &model.capture.scene;
    let cube = |half: f64| {
        let corner = |sign: f64| s.center + DVec3::splat(sign * half);
        (corner(-1.0), corner(1.0))
    };
    let narrow = |(lo, hi): (DVec3, DVec3)| (lo.as_vec3().to_array(), hi.as_vec3().to_array());
    if s.aabb_scale <= 1 {
        return narrow(cube(s.half));
    }
    let (lowest, highest) = cube(s.half * s.aabb_scale as f64);
    let mut points = seen_points(model);
    points.retain(|p| p.cmpge(lowest).all() && p.cmple(highest).all());
    if points.len() < 100 {
        return narrow(cube(s.half));
    }
    let side = |k: usize| {
        let mut v: Vec<f64> = points.iter().map(|p| p[k]).collect();
        v.sort_by(f64::total_cmp);
        let strays = (v.len() as f64 * STRAYS) as usize;
        (v[strays], v[v.len() - 1 - strays])
    };
    let sides = [side(0), side(1), side(2)];
    let margin = MARGIN * sides.iter().map(|(a, b)| b - a).fold(0.0, f64::max);
    let lo = DVec3::from(sides.map(|s| s.0 - margin)).max(lowest);
    let hi = DVec3::from(sides.map(|s| s.1 + margin)).min(highest);
    narrow((lo, hi))
}

/// Points of surfaces in small views from the training cameras that many of the cameras look at.
fn seen_points(model: &ObjectModel) -> Vec<DVec3> {
    let n = model.train.len();
    let frames: Vec<_> = (0..n.min(CAMERAS)).map(|i| &model.capture.frames[model.train[i * n / n.min(CAMERAS)]]).collect();
    let tracer = model.tracer(Quality::Fast);
    let world_from_model = model.model_from_world.inverse();
    let mut points = Vec::new();
    for f in &frames {
        let c = &f.camera;
        let shrink = VIEW_PX as f64 / c.width.max(c.height) as f64;
        let small = c.resized(((c.width as f64 * shrink) as u32).max(1), ((c.height as f64 * shrink) as u32).max(1));
        let posed = model.to_model(small, &f.world_from_camera);
        let view = tracer.view(&posed, &mut |_| {});
        for (i, d) in view.depth.data.iter().enumerate().filter(|(i, _)| view.opacity.data[*i] > 0.5) {
            let w = small.width as usize;
            let along = posed.camera.direction((i % w) as f64 + 0.5, (i / w) as f64 + 0.5);
            points.push(world_from_model.point(posed.pose.point(along * *d as f64)));
        }
    }
    let counts: Vec<usize> = points
        .iter()
        .map(|p| {
            let in_view = |f: &&&diorama_geom::Frame| {
                let (w, h) = (f.camera.width as f64, f.camera.height as f64);
                let q = f.world_from_camera.inverse().point(*p);
                f.camera.project(q).is_some_and(|px| (0.0..w).contains(&px.x) && (0.0..h).contains(&px.y))
            };
            frames.iter().filter(in_view).count()
        })
        .collect();
    let enough = counts.iter().max().copied().unwrap_or(0) as f64 * SEEN;
    let mut counts = counts.into_iter();
    points.retain(|_| counts.next().is_some_and(|c| c as f64 >= enough));
    points
}
