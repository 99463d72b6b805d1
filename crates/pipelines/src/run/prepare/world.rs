//! Normalizes COLMAP's world, whose scale and axes are arbitrary: up becomes +z, the origin is the cameras' focus point, and their median
//! distance from it is 4, as in instant-ngp's `colmap2nerf`.

use diorama_data::colmap::Point;
use diorama_geom::capture::{Frame, focus_point};
use diorama_geom::glam::{DMat3, DVec3};
use diorama_geom::rng::Rng;
use diorama_geom::transform::rotation_between;
use diorama_geom::{Pose, SceneBox, Similarity};

/// Median distance of the cameras from their focus point, in world units.
pub const DISTANCE: f64 = 4.0;
/// Half the edge of the inner cube: the unit cube under instant-ngp's scale of 0.33.
const HALF: f64 = 0.5 / 0.33;
/// Share of the points that the outer cube must contain.
const HELD: f64 = 0.95;
/// Least cosine between a floor's normal and the first estimate of up. A floor must meet one pair of [`FLOORS`]: more than the first share
/// of the points on it, less than the second share below it.
const LEVEL: f64 = 0.9;
const FLOORS: [(f64, f64); 2] = [(0.12, 0.1), (0.02, 0.01)];
/// Planes that RANSAC tries.
const TRIALS: u64 = 20_000;
/// Least extent of a floor, as a share of the cameras' distance.
const WIDE: f64 = 0.5;

/// Result of [`place`].
pub struct Placed {
    pub scene: SceneBox,
    /// Mean angle between the cameras' up directions and the world's, in degrees.
    pub tilt: f64,
    pub floor: bool,
    /// Points in the new world with their colors.
    pub points: Vec<(DVec3, [u8; 3])>,
}

/// Moves the cameras into the normalized world; returns its bounds and the moved points.
pub fn place(frames: &mut [Frame], points: &[Point]) -> Placed {
    let poses: Vec<Pose> = frames.iter().map(|f| f.world_from_camera).collect();
    let (center, distance) = focus_point(&poses);
    // Points seen in fewer than three images are often wrong.
    let firm: Vec<DVec3> = points.iter().filter(|p| p.images >= 3).map(|p| p.position).collect();
    let guess = cameras_up(&poses);
    let eyes: Vec<DVec3> = poses.iter().map(|p| p.translation).collect();
    let floor = floor_normal(&firm, &eyes, guess, center, distance);
    let up = floor.unwrap_or(guess);
    let scale = DISTANCE / distance;
    let rotation = rotation_between(up, DVec3::Z);
    let s = Similarity { scale, rotation, translation: -(rotation * center) * scale };
    for f in frames.iter_mut() {
        f.world_from_camera = s.pose(&f.world_from_camera);
    }
    let angle = |f: &Frame| (-f.world_from_camera.rotation.y_axis).dot(DVec3::Z).clamp(-1.0, 1.0).acos().to_degrees();
    let tilt = frames.iter().map(angle).sum::<f64>() / frames.len().max(1) as f64;
    let points: Vec<(DVec3, [u8; 3])> = points.iter().map(|p| (s.point(p.position), p.rgb)).collect();
    let mut reach: Vec<f64> = firm.iter().map(|p| s.point(*p).abs().max_element()).collect();
    reach.sort_by(f64::total_cmp);
    let wanted = reach.get((reach.len() as f64 * HELD) as usize).copied().unwrap_or(HALF) / HALF;
    let aabb_scale = (wanted.max(1.0).ceil() as u32).next_power_of_two().clamp(1, 16);
    Placed { scene: SceneBox { center: DVec3::ZERO, half: HALF, aabb_scale }, tilt, floor: floor.is_some(), points }
}

/// Estimates the up direction from the poses, assuming level cameras: the normal of the plane that the horizontal image axes span; the mean
/// of the cameras' up directions where these axes span no plane.
pub fn cameras_up(poses: &[Pose]) -> DVec3 {
    let mean = poses.iter().map(|p| -p.rotation.y_axis).sum::<DVec3>().normalize_or(DVec3::Z);
    let mut a = DMat3::ZERO;
    for p in poses {
        let r = p.rotation.x_axis;
        a += DMat3::from_cols(r * r.x, r * r.y, r * r.z);
    }
    a *= 1.0 / poses.len().max(1) as f64;
    // Eigenvector of the smallest eigenvalue of `a`, by power iteration on I − a.
    let b = DMat3::IDENTITY - a;
    let mut v = mean;
    (0..200).for_each(|_| v = (b * v).normalize_or(mean));
    let v = if v.dot(mean) < 0.0 { -v } else { v };
    let off_plane = v.dot(a * v);
    // Spread within the plane: without it, the axes are parallel and the normal is ambiguous.
    let other = v.cross(poses.first().map_or(DVec3::X, |p| p.rotation.x_axis)).normalize_or(DVec3::X);
    let spread = other.dot(a * other);
    if v.dot(mean) > 0.7 && off_plane < 0.25 * spread { v } else { mean }
}

/// Normal of the nearly level plane below the cameras with the most points on it (RANSAC); none where no plane qualifies as a floor.
fn floor_normal(points: &[DVec3], eyes: &[DVec3], up: DVec3, center: DVec3, distance: f64) -> Option<DVec3> {
    let near: Vec<DVec3> = points.iter().copied().filter(|p| (*p - center).length() < 1.5 * distance).collect();
    if near.len() < 200 {
        return None;
    }
    let slack = 0.01 * distance;
    let rng = Rng::new(1, 0);
    let pick = |i: u64| near[rng.below(i, near.len() as u64) as usize];
    let mut best: Option<(usize, DVec3, DVec3)> = None;
    for trial in 0..TRIALS {
        let [a, b, c] = [0, 1, 2].map(|k| pick(trial * 3 + k));
        let n = (b - a).cross(c - a).normalize_or_zero();
        let n = if n.dot(up) < 0.0 { -n } else { n };
        if n.dot(up) < LEVEL {
            continue;
        }
        let heights = near.iter().map(|p| (*p - a).dot(n));
        let (mut on, mut below) = (0, 0);
        for h in heights {
            on += (h.abs() < slack) as usize;
            below += (h < -3.0 * slack) as usize;
        }
        let share = |v: usize| v as f64 / near.len() as f64;
        let is_floor = FLOORS.iter().any(|(least, most)| share(on) > *least && share(below) < *most);
        let all_above = eyes.iter().filter(|e| (**e - a).dot(n) > 0.0).count() * 20 >= eyes.len() * 19;
        if is_floor && all_above && best.is_none_or(|b| on > b.0) && extent(&near, a, n, slack) > WIDE * distance {
            best = Some((on, a, n));
        }
    }
    best.map(|(_, a, n)| fitted(&near, a, n, slack))
}

/// Refines the plane through `a` with normal `n` by least squares over the points near it; returns the new normal.
fn fitted(points: &[DVec3], mut a: DVec3, mut n: DVec3, slack: f64) -> DVec3 {
    for within in [slack, 0.5 * slack, 0.5 * slack] {
        let u = n.any_orthonormal_vector();
        let v = n.cross(u);
        let (mut m, mut rhs) = (DMat3::ZERO, DVec3::ZERO);
        for p in points.iter().map(|p| *p - a).filter(|p| p.dot(n).abs() < within) {
            let x = DVec3::new(p.dot(u), p.dot(v), 1.0);
            m += DMat3::from_cols(x * x.x, x * x.y, x * x.z);
            rhs += x * p.dot(n);
        }
        if m.determinant().abs() < 1e-12 {
            break;
        }
        let h = m.inverse() * rhs;
        a += n * h.z;
        n = (n - u * h.x - v * h.y).normalize();
    }
    n
}

/// Extent of the points on a plane along two orthogonal directions, whichever is less; ignores 5 % of the points at either end.
fn extent(points: &[DVec3], a: DVec3, n: DVec3, slack: f64) -> f64 {
    let u = n.any_orthonormal_vector();
    let v = n.cross(u);
    let across = |d: DVec3| {
        let mut at: Vec<f64> = points.iter().filter(|p| (**p - a).dot(n).abs() < slack).map(|p| p.dot(d)).collect();
        at.sort_by(f64::total_cmp);
        let edge = at.len() / 20;
        at.get(at.len() - 1 - edge).zip(at.get(edge)).map_or(0.0, |(hi, lo)| hi - lo)
    };
    across(u).min(across(v))
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_geom::Camera;

    /// Cameras around a cube on a floor, in a world that is scaled, rotated by `turn` and shifted.
    fn scene(turn: DMat3) -> (Vec<Frame>, Vec<Point>) {
        let s = Similarity { scale: 0.37, rotation: turn, translation: DVec3::new(5.0, -2.0, 9.0) };
        let frames = (0..24)
            .map(|i| {
                let a = i as f64 * 0.26;
                let eye = DVec3::new(3.0 * a.cos(), 3.0 * a.sin(), 1.5);
                let pose = Pose::look_at(eye, DVec3::ZERO, DVec3::Z);
                Frame::new(format!("{i}"), "", Camera::pinhole(64, 48, 0.9), s.pose(&pose))
            })
            .collect();
        let rng = Rng::new(3, 0);
        let u = |i: u64| rng.uniform(i) as f64 * 2.0 - 1.0;
        let points = (0..2000u64)
            .map(|i| {
                let p = if i % 2 == 0 {
                    DVec3::new(2.0 * u(3 * i), 2.0 * u(3 * i + 1), -0.5)
                } else {
                    DVec3::new(0.5 * u(3 * i), 0.5 * u(3 * i + 1), 0.5 * u(3 * i + 2))
                };
                Point { id: 0, position: s.point(p), rgb: [9; 3], error: 0.5, images: 4 }
            })
            .collect();
        (frames, points)
    }

    #[test]
    fn any_turned_world_stands_upright_again() {
        for turn in [DMat3::IDENTITY, rotation_between(DVec3::Z, DVec3::new(0.3, -0.9, -0.2))] {
            let (mut frames, points) = scene(turn);
            let placed = place(&mut frames, &points);
            assert!(placed.floor && placed.scene.aabb_scale <= 4);
            // The floor is level, half a unit of the old world below the center.
            let scale = 4.0 / (3.0f64 * 3.0 + 1.5 * 1.5).sqrt();
            for (p, _) in placed.points.iter().step_by(2) {
                assert!((p.z + 0.5 * scale).abs() < 0.02, "{p}");
            }
            for f in &frames {
                assert!((f.world_from_camera.translation.length() - 4.0).abs() < 1e-6);
                assert!((f.world_from_camera.translation.z - 1.5 * scale).abs() < 0.05);
            }
        }
    }

    #[test]
    fn without_a_floor_the_cameras_tell_what_is_up() {
        let (mut frames, _) = scene(rotation_between(DVec3::Z, DVec3::new(0.9, 0.1, 0.4)));
        let placed = place(&mut frames, &[]);
        assert!(!placed.floor);
        assert!(frames.iter().all(|f| (f.world_from_camera.rotation.x_axis.z).abs() < 1e-3), "the horizon is level");
    }
}
