//! Gaussian splats to images on the CPU: elliptical weighted averages (Zwicker et al., "EWA splatting", 2002), sorted by depth and composited
//! front to back, as in Kerbl et al., "3D Gaussian splatting", 2023.

use super::view::View;
use diorama_geom::glam::{Mat3, Quat, Vec2, Vec3};
use diorama_geom::splats::Splats;
use diorama_geom::{Camera, Image, Pose};
use rayon::prelude::*;

/// Rows that are composited at once.
const BAND: usize = 8;
/// Variance in square pixels that every splat has at least, so that none falls between pixels.
const BLUR: f32 = 0.3;
/// Standard deviations after which a splat ends, opacity below which it does not count, transmittance after which a pixel is done.
const REACH: f32 = 3.0;
const FAINTEST: f32 = 1.0 / 255.0;
const DONE: f32 = 1e-3;
/// Nearest distance along the axis.
const NEAR: f32 = 1e-3;

/// A splat in the picture.
#[derive(Clone, Copy)]
struct Flat {
    depth: f32,
    /// Distance from the eye.
    distance: f32,
    middle: Vec2,
    /// Inverse covariance: xx, xy, yy.
    conic: [f32; 3],
    half: Vec2,
    opacity: f32,
    rgb: Vec3,
}

/// Draws splats as a pinhole sees them, over `background`; distances are in the world's units.
pub fn render(splats: &Splats, camera: &Camera, world_from_camera: &Pose, background: [f32; 3]) -> View {
    let (w, h) = (camera.width as usize, camera.height as usize);
    let mut flat: Vec<Flat> = (0..splats.len()).into_par_iter().filter_map(|i| flatten(splats, i, camera, world_from_camera)).collect();
    flat.par_sort_unstable_by(|a, b| a.depth.total_cmp(&b.depth));
    let bands: Vec<Vec<[f32; 5]>> =
        (0..h.div_ceil(BAND)).into_par_iter().map(|b| band(&flat, b * BAND, ((b + 1) * BAND).min(h), w)).collect();
    let mut view = View { rgb: Image::zeros(w, h, 3), opacity: Image::zeros(w, h, 1), depth: Image::zeros(w, h, 1) };
    for (i, [r, g, b, through, depth]) in bands.into_iter().flatten().enumerate() {
        let opacity = 1.0 - through;
        for (k, v) in [r, g, b].into_iter().enumerate() {
            view.rgb.data[i * 3 + k] = v + through * background[k];
        }
        view.opacity.data[i] = opacity;
        view.depth.data[i] = if opacity > 0.0 { depth / opacity } else { 0.0 };
    }
    view
}

/// The splat's ellipse in the picture; none where it is behind, beside, or too faint.
fn flatten(splats: &Splats, i: usize, c: &Camera, world_from_camera: &Pose) -> Option<Flat> {
    let turn: Mat3 = world_from_camera.rotation.transpose().as_mat3();
    let p = turn * (Vec3::from(splats.positions[i]) - world_from_camera.translation.as_vec3());
    let opacity = splats.opacities[i];
    if p.z < NEAR || opacity < FAINTEST {
        return None;
    }
    let (fx, fy) = (c.fx as f32, c.fy as f32);
    let [qw, qx, qy, qz] = splats.rotations[i];
    let axes = turn * Mat3::from_quat(Quat::from_xyzw(qx, qy, qz, qw)) * Mat3::from_diagonal(Vec3::from(splats.scales[i]));
    // The projection's slope at the splat; beyond the picture's edge it would explode.
    let edge = Vec2::new(1.3 * 0.5 * c.width as f32 / fx, 1.3 * 0.5 * c.height as f32 / fy);
    let t = (Vec2::new(p.x, p.y) / p.z).clamp(-edge, edge);
    let (row_x, row_y) = (Vec3::new(fx / p.z, 0.0, -fx * t.x / p.z), Vec3::new(0.0, fy / p.z, -fy * t.y / p.z));
    let (a, b) = (axes.transpose() * row_x, axes.transpose() * row_y);
    let (xx, xy, yy) = (a.dot(a) + BLUR, a.dot(b), b.dot(b) + BLUR);
    let det = xx * yy - xy * xy;
    if det.is_nan() || det <= 0.0 {
        return None;
    }
    let middle = Vec2::new(fx * p.x / p.z + c.cx as f32, fy * p.y / p.z + c.cy as f32);
    let half = Vec2::new(xx.sqrt(), yy.sqrt()) * REACH;
    let visible =
        middle.x + half.x >= 0.0 && middle.y + half.y >= 0.0 && middle.x - half.x < c.width as f32 && middle.y - half.y < c.height as f32;
    let conic = [yy / det, -xy / det, xx / det];
    (visible && middle.is_finite()).then(|| Flat {
        depth: p.z,
        distance: p.length(),
        middle,
        conic,
        half,
        opacity,
        rgb: Vec3::from(splats.rgb_srgb[i]),
    })
}

/// Colour, transmittance and weighted distance of some rows.
fn band(flat: &[Flat], y0: usize, y1: usize, w: usize) -> Vec<[f32; 5]> {
    let mut out = vec![[0.0, 0.0, 0.0, 1.0, 0.0]; (y1 - y0) * w];
    let mut open = out.len();
    for s in flat {
        let (low, high) = (s.middle - s.half, s.middle + s.half);
        if high.y < y0 as f32 || low.y >= y1 as f32 {
            continue;
        }
        let from = |v: f32, least: usize| (v - 0.5).ceil().max(least as f32) as usize;
        let to = |v: f32, most: usize| ((v - 0.5).floor() + 1.0).clamp(0.0, most as f32) as usize;
        for y in from(low.y, y0)..to(high.y, y1) {
            let dy = y as f32 + 0.5 - s.middle.y;
            for x in from(low.x, 0)..to(high.x, w) {
                let dx = x as f32 + 0.5 - s.middle.x;
                let o = &mut out[(y - y0) * w + x];
                if o[3] < DONE {
                    continue;
                }
                let power = 0.5 * (s.conic[0] * dx * dx + s.conic[2] * dy * dy) + s.conic[1] * dx * dy;
                let alpha = (s.opacity * (-power).exp()).min(0.999);
                if alpha < FAINTEST {
                    continue;
                }
                let weight = alpha * o[3];
                (0..3).for_each(|k| o[k] += weight * s.rgb[k]);
                o[3] -= weight;
                o[4] += weight * s.distance;
                open -= (o[3] < DONE) as usize;
            }
        }
        if open == 0 {
            break;
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_geom::Similarity;
    use diorama_geom::glam::DVec3;

    fn one(p: [f32; 3], rgb: [f32; 3], opacity: f32, scale: [f32; 3]) -> Splats {
        let mut s = Splats::default();
        s.push(p, rgb, opacity, scale, [1.0, 0.0, 0.0, 0.0]);
        s
    }

    fn camera() -> Camera {
        Camera { fx: 100.0, fy: 100.0, ..Camera::pinhole(64, 48, 1.0) }
    }

    #[test]
    fn a_splat_on_the_axis_is_its_gaussian() {
        let (sx, sy, z) = (0.2f32, 0.1f32, 4.0f32);
        let view = render(&one([0.0, 0.0, z], [1.0, 0.5, 0.0], 0.8, [sx, sy, 0.3]), &camera(), &Pose::IDENTITY, [0.0, 0.0, 1.0]);
        for (x, y) in [(32, 24), (35, 24), (32, 26), (29, 22)] {
            let (dx, dy) = (x as f32 + 0.5 - 32.0, y as f32 + 0.5 - 24.0);
            let (vx, vy) = ((100.0 * sx / z).powi(2) + BLUR, (100.0 * sy / z).powi(2) + BLUR);
            let alpha = 0.8 * (-0.5 * (dx * dx / vx + dy * dy / vy)).exp();
            let p = view.rgb.pixel(x, y);
            assert!(
                (p[0] - alpha).abs() < 1e-4 && (p[1] - 0.5 * alpha).abs() < 1e-4 && (p[2] - (1.0 - alpha)).abs() < 1e-4,
                "{p:?} {alpha}"
            );
            assert!((view.depth.pixel(x, y)[0] - z).abs() < 1e-3);
        }
        assert_eq!(view.opacity.pixel(0, 0), [0.0]);
    }

    #[test]
    fn the_near_one_covers_the_far_one_in_any_order() {
        let (near, far) = (([0.0, 0.0, 2.0], [1.0, 0.0, 0.0]), ([0.0, 0.0, 3.0], [0.0, 1.0, 0.0]));
        for pair in [[near, far], [far, near]] {
            let mut s = Splats::default();
            pair.iter().for_each(|(p, c)| s.push(*p, *c, 1.0, [0.5; 3], [1.0, 0.0, 0.0, 0.0]));
            let view = render(&s, &camera(), &Pose::IDENTITY, [0.0; 3]);
            let p = view.rgb.pixel(32, 24);
            assert!(p[0] > 0.98 && p[1] < 0.02, "{p:?}");
        }
    }

    #[test]
    fn a_moved_world_seen_from_a_moved_camera_is_the_same_picture() {
        let s = one([0.3, -0.2, 4.0], [0.2, 0.9, 0.4], 0.9, [0.5, 0.1, 0.02]);
        let pose = Pose::look_at(DVec3::new(3.0, 1.0, -2.0), DVec3::new(0.0, 0.5, 1.0), DVec3::Z);
        let mut moved = s.clone();
        moved.transform(&Similarity { scale: 2.0, rotation: pose.rotation, translation: pose.translation });
        let (a, b) = (render(&s, &camera(), &Pose::IDENTITY, [0.1; 3]), render(&moved, &camera(), &pose, [0.1; 3]));
        let worst = a.rgb.data.iter().zip(&b.rgb.data).map(|(x, y)| (x - y).abs()).fold(0.0, f32::max);
        assert!(worst < 1e-3, "{worst}");
        assert!((b.depth.pixel(39, 19)[0] / a.depth.pixel(39, 19)[0] - 2.0).abs() < 1e-3);
    }

    #[test]
    fn what_is_behind_or_not_there_is_not_drawn() {
        let view = render(&one([0.0, 0.0, -2.0], [1.0; 3], 1.0, [0.1; 3]), &camera(), &Pose::IDENTITY, [0.25; 3]);
        assert!(view.rgb.data.iter().all(|v| *v == 0.25));
        assert!(render(&Splats::default(), &camera(), &Pose::IDENTITY, [0.0; 3]).opacity.data.iter().all(|v| *v == 0.0));
    }
}
