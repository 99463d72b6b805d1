//! The camera that shows a text region where, how large and in which pose one wants, in closed form.
//!
//! Of a region of width `w` and height `h`, the wanted pixel `(u, v)` of its center gives the ray `r = K⁻¹(u, v, 1)ᵀ`, the wanted rotation `R`
//! from region to camera its normal `n = R e₃`. The quadrilateral at depth `Z` has the area `f_x f_y |n·r| w h Z² / ([Z² − (α+β)²][Z² − (α−β)²])`
//! with `α = w R₃₁ / 2`, `β = h R₃₂ / 2`; this equals the share `ρ` of the picture at the depth whose square is the larger root of a quadratic.

use super::regions::TextPose;
use diorama_geom::glam::{DMat3, DVec2, DVec3};
use diorama_geom::{Camera, Lens, Pose};

/// How a region is to appear.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Wanted {
    /// Pixel of the region's center.
    pub center_px: DVec2,
    /// Rotation from the region's frame (x along the reading direction, y up, z toward the reader) to the camera's.
    pub camera_from_region: DMat3,
    /// Area of the region's quadrilateral over that of the picture.
    pub area_ratio: f64,
}

/// A region in the world: its frame at its center, and its size.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Placed {
    pub world_from_region: DMat3,
    pub center_in_world: DVec3,
    pub size: DVec2,
}

/// Why there is no such camera.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum NoCamera {
    #[error("the region would turn its back to the camera")]
    FacesAway,
    #[error("an area ratio must be above 0, and a region have an area")]
    NoArea,
    #[error("cameras with lens distortion are not solved for; undistort the photographs")]
    Distorted,
}

/// The pose of a pinhole camera that shows a flat region as wanted.
///
/// # Errors
/// When there is none.
pub fn solve(camera: &Camera, region: &Placed, wanted: &Wanted) -> Result<Pose, NoCamera> {
    if camera.lens != Lens::Pinhole {
        return Err(NoCamera::Distorted);
    }
    let rotation = wanted.camera_from_region;
    let ray = DVec3::new((wanted.center_px.x - camera.cx) / camera.fx, (wanted.center_px.y - camera.cy) / camera.fy, 1.0);
    let facing = rotation.z_axis.dot(ray);
    if facing >= 0.0 {
        return Err(NoCamera::FacesAway);
    }
    let picture = camera.width as f64 * camera.height as f64;
    let area = wanted.area_ratio * picture;
    let depth = depth(camera.fx * camera.fy * -facing, region.size, [rotation.x_axis.z, rotation.y_axis.z], area)?;
    let center_in_camera = depth * ray;
    let world_from_camera = region.world_from_region * rotation.transpose();
    Ok(Pose { rotation: world_from_camera, translation: region.center_in_world - world_from_camera * center_in_camera })
}

/// Depth of the center at which the projected area is `area`; `slopes` are the third components of the region's axes in the camera.
fn depth(scale: f64, size: DVec2, slopes: [f64; 2], area: f64) -> Result<f64, NoCamera> {
    if !(area > 0.0 && size.min_element() > 0.0) {
        return Err(NoCamera::NoArea);
    }
    let (alpha, beta) = (0.5 * size.x * slopes[0], 0.5 * size.y * slopes[1]);
    let c = scale * size.x * size.y / area;
    let sum = c + 2.0 * (alpha * alpha + beta * beta);
    let product = (alpha * alpha - beta * beta).powi(2);
    Ok((0.5 * (sum + (sum * sum - 4.0 * product).max(0.0).sqrt())).sqrt())
}

/// How a region appears to a camera.
pub fn seen(camera: &Camera, region: &Placed, pose: &Pose) -> Option<(TextPose, Wanted)> {
    let camera_from_world = pose.inverse();
    let rotation = camera_from_world.rotation * region.world_from_region;
    let translation = camera_from_world.point(region.center_in_world);
    let half = 0.5 * region.size;
    let corner = |x: f64, y: f64| camera.project(translation + rotation * DVec3::new(x * half.x, y * half.y, 0.0));
    let corners = [corner(-1.0, 1.0)?, corner(1.0, 1.0)?, corner(1.0, -1.0)?, corner(-1.0, -1.0)?];
    let area = 0.5 * (0..4).map(|k| corners[k].perp_dot(corners[(k + 1) % 4])).sum::<f64>();
    let picture = camera.width as f64 * camera.height as f64;
    let wanted = Wanted { center_px: camera.project(translation)?, camera_from_region: rotation, area_ratio: area / picture };
    Some((TextPose { rotation, translation }, wanted))
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_geom::glam::{DQuat, dvec2};
    use diorama_geom::rng::Rng;

    /// A region somewhere, and a way to see it: oblique ones and large ones too.
    fn random(k: u64) -> (Camera, Placed, Wanted) {
        let rng = Rng::new(17, k);
        let u = |i: u64, low: f64, high: f64| low + (high - low) * rng.uniform(i) as f64;
        let turn = |i: u64| DQuat::from_xyzw(u(i, -1.0, 1.0), u(i + 1, -1.0, 1.0), u(i + 2, -1.0, 1.0), u(i + 3, -1.0, 1.0)).normalize();
        let fov = u(0, 0.4, 1.6);
        let camera = Camera { cx: 310.0, cy: 255.5, fy: 520.0, ..Camera::pinhole(640, 480, fov) };
        let region = Placed {
            world_from_region: DMat3::from_quat(turn(1)),
            center_in_world: DVec3::new(u(5, -3.0, 3.0), u(6, -3.0, 3.0), u(7, -3.0, 3.0)),
            size: dvec2(u(8, 0.05, 3.0), u(9, 0.05, 1.0)),
        };
        let frontal = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
        let tilt =
            DMat3::from_rotation_x(u(10, -1.2, 1.2)) * DMat3::from_rotation_y(u(11, -1.2, 1.2)) * DMat3::from_rotation_z(u(12, -0.6, 0.6));
        let wanted = Wanted {
            center_px: dvec2(u(13, 60.0, 580.0), u(14, 60.0, 420.0)),
            camera_from_region: tilt * frontal,
            area_ratio: u(15, (0.001f64).ln(), (0.3f64).ln()).exp(),
        };
        (camera, region, wanted)
    }

    #[test]
    fn the_camera_shows_the_region_as_wanted_to_rounding() {
        let (mut solved, mut worst) = (0, [0.0f64; 3]);
        for k in 0..20_000 {
            let (camera, region, wanted) = random(k);
            match solve(&camera, &region, &wanted) {
                Err(e) => assert_eq!(e, NoCamera::FacesAway),
                Ok(pose) => {
                    let (text, got) = seen(&camera, &region, &pose).expect("all corners are in front of the camera");
                    solved += 1;
                    worst[0] = worst[0].max((got.center_px - wanted.center_px).length());
                    let off = (text.rotation - wanted.camera_from_region).to_cols_array();
                    worst[1] = worst[1].max(off.iter().fold(0.0, |m, v| m.max(v.abs())));
                    worst[2] = worst[2].max((got.area_ratio / wanted.area_ratio - 1.0).abs());
                    assert!(pose.rigidity_error() < 1e-9);
                }
            }
        }
        assert!(solved > 15_000 && worst[0] < 1e-6 && worst[1] < 1e-9 && worst[2] < 1e-9, "{solved} {worst:?}");
    }

    #[test]
    fn a_frontal_region_is_at_the_depth_of_its_scale_and_impossible_wishes_are_told() {
        let camera = Camera::pinhole(200, 100, 1.0);
        let region = Placed { world_from_region: DMat3::IDENTITY, center_in_world: DVec3::new(1.0, 2.0, 3.0), size: dvec2(0.5, 0.2) };
        let frontal = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
        let wanted = Wanted { center_px: dvec2(100.0, 50.0), camera_from_region: frontal, area_ratio: 0.02 };
        let pose = solve(&camera, &region, &wanted).unwrap();
        // f² w h / Z² = ρ W H, straight before the region's center, on its +z.
        let z = (camera.fx * camera.fy * 0.1 / (0.02 * 20_000.0)).sqrt();
        assert!((pose.translation - DVec3::new(1.0, 2.0, 3.0 + z)).length() < 1e-12);
        assert_eq!(solve(&camera, &region, &Wanted { camera_from_region: DMat3::IDENTITY, ..wanted }), Err(NoCamera::FacesAway));
        assert_eq!(solve(&camera, &region, &Wanted { area_ratio: 0.0, ..wanted }), Err(NoCamera::NoArea));
        let bent = Camera { lens: Lens::Brown { k: [0.1, 0.0, 0.0, 0.0, 0.0, 0.0], p: [0.0; 2] }, ..camera };
        assert_eq!(solve(&bent, &region, &wanted), Err(NoCamera::Distorted));
    }
}
