//! Least distance between cameras and matter.

use diorama_engine::samplers::pixels::Observation;
use diorama_engine::samplers::stereo;
use diorama_geom::Capture;
use diorama_geom::capture::SparsePoint;

/// Where nothing is known, in inner cubes.
pub const UNKNOWN: f32 = 0.1;

/// Fewest observations that give an estimate, and the share of the closest that is ignored as outliers.
const OBSERVATIONS: usize = 1000;
const WRONG: f64 = 0.01;

/// Share of the distance to the closest points in which nothing is looked for.
const EMPTY: f64 = 0.7;

/// Distance, in inner cubes, from which on matter may be before a camera: most of the way to the closest sparse points that
/// cameras see, where these are enough. Before that stands nothing, but many a field finds it easiest to hang each photograph before
/// its own camera.
pub fn of_points(capture: &Capture) -> Option<f32> {
    let distance = |p: &SparsePoint, frame: u32| {
        let camera = &capture.frames[frame as usize].world_from_camera;
        (p.position - camera.translation).length()
    };
    let all = capture.points.iter().flat_map(|p| p.frames.iter().map(|f| distance(p, *f))).collect();
    most_of_the_way(all, capture.scene.model_from_world().scale)
}

/// The same by observations.
pub fn of_observations(observations: &[Observation]) -> Option<f32> {
    most_of_the_way(observations.iter().map(|o| o.distance as f64).collect(), 1.0)
}

/// Settles the least distance where it is left open (0), from what stereo or points observed, and drops observations of what is closer: rays
/// begin beyond it, so that no sample could be there.
pub fn settle(near: &mut f32, found: &mut Vec<Observation>, viewing_distance: f64) {
    if *near == 0.0 {
        // Stereo looks no nearer than that, so that what it does not find may be there all the same.
        let most = (stereo::NEAREST * viewing_distance) as f32;
        *near = of_observations(found).map_or(UNKNOWN, |n| n.min(most).max(UNKNOWN));
    }
    found.retain(|o| o.distance > *near);
}

fn most_of_the_way(mut all: Vec<f64>, scale: f64) -> Option<f32> {
    if all.len() < OBSERVATIONS {
        return None;
    }
    let closest = (all.len() as f64 * WRONG) as usize;
    let (_, near, _) = all.select_nth_unstable_by(closest, f64::total_cmp);
    Some(UNKNOWN.max((EMPTY * *near * scale) as f32))
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_geom::capture::{Frame, SceneBox};
    use diorama_geom::glam::DVec3;
    use diorama_geom::{Camera, Pose};

    /// Two cameras, 600 points 2 to 3 away from each, and `strays` next to the first.
    fn capture(strays: usize) -> Capture {
        let camera = |x: f64| Frame::new("a", "a.jpg", Camera::pinhole(8, 8, 1.0), Pose { translation: DVec3::X * x, ..Pose::IDENTITY });
        let mut capture = Capture::new(vec![camera(-1e-6), camera(1e-6)], SceneBox { center: DVec3::ZERO, half: 0.5, aabb_scale: 1 });
        let point = |distance: f64, frames: &[u32]| SparsePoint {
            position: DVec3::Z * distance,
            color: [0; 3],
            error: 0.0,
            frames: frames.to_vec(),
        };
        capture.points = (0..600).map(|i| point(2.0 + i as f64 / 600.0, &[0, 1])).collect();
        capture.points.extend((0..strays).map(|_| point(0.01, &[0])));
        capture
    }

    #[test]
    fn matter_is_looked_for_from_shortly_before_the_closest_points_on() {
        let scale = capture(0).scene.model_from_world().scale;
        for strays in [0, 9] {
            let got = of_points(&capture(strays)).unwrap() as f64 / scale;
            assert!((1.39..1.42).contains(&got), "{got} with {strays} stray points");
        }
    }

    #[test]
    fn few_points_and_points_without_cameras_tell_nothing() {
        let mut few = capture(0);
        few.points.truncate(400);
        let mut silent = capture(0);
        silent.points.iter_mut().for_each(|p| p.frames.clear());
        assert_eq!((of_points(&few), of_points(&silent)), (None, None));
    }
}
