//! Cameras of a photographer who walks through the street.

use super::layout::{END, FACADE, Layout, PAVEMENT};
use diorama_geom::glam::{DVec3, dvec3};
use diorama_geom::rng::Rng;
use diorama_geom::{Camera, Pose};

/// Field of view over the longer side of the image in radians.
pub const FOV: f64 = 1.13;

/// How many draws a camera may take to find a free place.
const DRAWS: u64 = 400;

/// Where a camera stands and looks.
struct View {
    eye: DVec3,
    target: DVec3,
}

/// Whether a camera may stand at `eye` and sees freely for the first meters.
fn is_free(layout: &Layout, view: &View) -> bool {
    let ahead = (view.target - view.eye).normalize();
    let inside = |p: DVec3, margin: f64| {
        layout.obstacles().iter().any(|o| {
            let d = (p - o.at).truncate().length();
            d < o.radius + margin && p.z > o.z[0] - margin && p.z < o.z[1] + margin
        })
    };
    !inside(view.eye, 0.25) && (1..=6).all(|k| !inside(view.eye + ahead * 0.5 * k as f64, 0.0))
}

/// A candidate for view `i`: three in four from a pavement or the road, else from an upper floor or from under the arcade.
fn draw(i: u64, u: impl Fn(u64, f64, f64) -> f64) -> View {
    let side = if i.is_multiple_of(2) { 1.0 } else { -1.0 };
    if i % 16 == 11 {
        // In the middle of a bay, so that no column is close in front.
        let bay = -6.0 - 0.6 - 22.8 / 7.0 * (u(0, 0.0, 7.0).floor() + 0.5);
        let eye = dvec3(bay, -FACADE - u(1, 1.4, 2.2), PAVEMENT + u(2, 1.5, 1.9));
        return View { eye, target: dvec3(eye.x + u(3, -2.5, 2.5), FACADE, u(4, 2.0, 4.5)) };
    }
    if i % 8 == 5 {
        let eye = dvec3(u(0, -26.0, 26.0), -side * (FACADE - u(1, 1.5, 2.2)), u(2, 4.6, 8.2));
        return View { eye, target: dvec3(eye.x + u(3, -10.0, 10.0), side * FACADE, u(4, 2.5, 6.0)) };
    }
    // The golden ratio spreads the places along the street.
    let along = (i as f64 * 0.618_033_988_75 + u(0, -0.06, 0.06)).rem_euclid(1.0);
    let x = -END + 3.0 + (2.0 * END - 6.0) * along;
    let eye = dvec3(x, -side * u(1, 0.2, 9.2), PAVEMENT + u(2, 1.5, 1.9));
    if i % 8 == 3 {
        // Along the street, toward the end that is farther away.
        let end = -END * x.signum();
        return View { eye, target: dvec3(end, u(3, -6.0, 6.0), u(4, 3.0, 6.0)) };
    }
    View { eye, target: dvec3(x + u(3, -10.0, 10.0), side * FACADE, u(4, 3.0, 6.0)) }
}

/// `n` cameras with poses in the street of a seed, for images of any size: eye height 1.5 to 1.9 m, one in eight from an upper floor.
/// None of them is inside of an object; fewer are returned only if no free place is found.
pub fn cameras(n: usize, width: u32, height: u32, seed: u64) -> Vec<(Camera, Pose)> {
    let layout = Layout::new(seed);
    let fov_x = if width >= height { FOV } else { 2.0 * ((0.5 * FOV).tan() * width as f64 / height as f64).atan() };
    let camera = Camera::pinhole(width, height, fov_x);
    let pose = |i: u64| {
        let rng = Rng::new(seed, 83 + i);
        let views = (0..DRAWS).map(|k| draw(i, |c, lo, hi| lo + (hi - lo) * rng.uniform(8 * k + c) as f64));
        let view = views.into_iter().find(|v| is_free(&layout, v))?;
        Some((camera, Pose::look_at(view.eye, view.target, DVec3::Z)))
    };
    (0..n as u64).filter_map(pose).collect()
}
