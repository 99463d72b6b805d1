//! Tests of what hides the light.

use super::*;
use diorama_geom::glam::DMat3;
use diorama_geom::{Camera, Pose};

fn basis(n: Vec3) -> [f32; 9] {
    sh_light::basis(n.as_dvec3()).map(|b| b as f32)
}

/// A plate at z = 0.25 and a wall on it at x = 0.5, each 0.1 thick.
struct Corner;

impl DensityQuery for Corner {
    fn density(&self, model: &[f32], sigma: &mut [f32]) {
        for (s, p) in sigma.iter_mut().zip(model.chunks_exact(3)) {
            let is_plate = (0.15..0.25).contains(&p[2]);
            let is_wall = (0.5..0.6).contains(&p[0]) && (0.25..0.75).contains(&p[2]);
            *s = if is_plate || is_wall { 1000.0 } else { 0.0 };
        }
    }
}

fn corner() -> Visibility {
    Visibility::of(&Corner, &Occupancy::new(64, 1, false), (0.0, 1.0), 64)
}

#[test]
fn the_wall_shadows_what_lies_behind_it() {
    let (v, up) = (corner(), Vec3::Z);
    let sun = Vec3::new(1.0, 0.0, 1.0).normalize();
    // The shadow of a wall half as high as the cube reaches as far.
    for (x, want) in [(0.05, 0.0), (0.2, 0.0), (0.42, 0.0), (0.7, 1.0), (0.9, 1.0)] {
        let got = v.from_sun(Vec3::new(x, 0.5, 0.25), up, sun);
        assert!((got - want).abs() < 0.05, "{x}: {got}");
    }
    let other = Vec3::new(-1.0, 0.0, 1.0).normalize();
    assert!(v.from_sun(Vec3::new(0.2, 0.5, 0.25), up, other) > 0.95);
    assert!(v.from_sun(Vec3::new(0.5, 0.5, 0.5), Vec3::NEG_X, other) > 0.95);
}

/// Cameras look down on a part of the plate.
#[test]
fn what_no_photograph_shows_casts_no_shadow() {
    let (field, occupancy, up) = (Corner, Occupancy::new(64, 1, false), Vec3::Z);
    let looking_down = |x: f64| {
        let pose = Pose { rotation: DMat3::from_cols(DVec3::X, DVec3::NEG_Y, DVec3::NEG_Z), translation: DVec3::new(x, 0.5, 2.0) };
        // At the wall's foot, 1.75 below, the picture is half as wide as the cube.
        PosedCamera { camera: Camera::pinhole(40, 120, 2.0 * (0.25f64 / 1.75).atan()), pose }
    };
    let sun = Vec3::new(1.0, 0.0, 1.0).normalize();
    let lit = |cameras: &[PosedCamera]| {
        let v = Visibility::within(&field, &occupancy, (0.0, 1.0), 64, cameras);
        v.from_sun(Vec3::new(0.2, 0.5, 0.25), up, sun)
    };
    assert!(lit(&[looking_down(0.1)]) > 0.95, "nothing shows the wall");
    assert!(lit(&[looking_down(0.1), looking_down(0.55)]) < 0.05, "one picture shows it");
}

/// Rays of true surfaces begin close to them; where distances are off by more than a cell, so high that surfaces do not shadow themselves.
#[test]
fn rays_of_noisy_surfaces_begin_higher() {
    let plate = |sunk: f32| -> Vec<(Vec3, Vec3)> {
        let at = |i: usize| Vec3::new(0.05 + 0.006 * (i % 67) as f32, 0.05 + 0.013 * (i / 67) as f32, 0.25 - sunk);
        (0..67 * 67).map(|i| (at(i), Vec3::Z)).collect()
    };
    let mut v = corner();
    v.lift_from(&plate(0.0));
    assert_eq!(v.lift(), LIFTS[0]);
    let cell = 1.0 / 64.0;
    v.lift_from(&plate(1.5 * cell));
    assert!(v.lift() > LIFTS[0], "{}", v.lift());
    assert!(v.own_hits(&plate(1.5 * cell)) <= SMOOTH);
    // What lies so deep that no height takes it begins low; where it is a fifth of all, the highest beginning helps the rest.
    v.lift_from(&plate(6.0 * cell));
    assert_eq!(v.lift(), LIFTS[0]);
    let mixed =
        plate(1.5 * cell).into_iter().zip(plate(6.0 * cell)).enumerate().map(|(i, (near, deep))| if i % 5 == 0 { deep } else { near });
    v.lift_from(&mixed.collect::<Vec<_>>());
    assert_eq!(v.lift(), LIFTS[2]);
}

/// Coarse cells and a low sun: the edge of the shadow lies where the ray from the edge of the wall meets the plate.
#[test]
fn shadows_are_not_shifted() {
    let (v, up) = (Visibility::of(&Corner, &Occupancy::new(16, 1, false), (0.0, 1.0), 16), Vec3::Z);
    // Half as high as the cube, the wall ends a shadow 0.4 before it.
    let sun = Vec3::new(1.0, 0.0, 1.25).normalize();
    for (x, is_lit) in [(0.07, true), (0.13, false), (0.2, false)] {
        let got = v.from_sun(Vec3::new(x, 0.5, 0.25), up, sun);
        assert!(if is_lit { got > 0.6 } else { got < 0.25 }, "{x}: {got}");
    }
}

#[test]
fn corners_are_less_open_than_the_plain() {
    let v = corner();
    let open = |point: Vec3, normal: Vec3| v.from_sky(point, normal, 512, 0);
    let [far, near] = [0.05, 0.47].map(|x| open(Vec3::new(x, 0.5, 0.25), Vec3::Z));
    // A wall of height h at distance d hides (1 − d / √(d² + h²)) / 2 of what a plain receives, if it is long.
    assert!((far - 0.83).abs() < 0.1 && (near - 0.55).abs() < 0.12, "{far} {near}");
    let side = open(Vec3::new(0.5, 0.5, 0.5), Vec3::NEG_X);
    assert!((side - 0.72).abs() < 0.1, "{side}");
}

/// Open space under a sky of which the upper half is seen, before a ground that sends what the sky would.
#[test]
fn light_in_the_open_is_that_of_the_sky_and_changes_with_the_normal_as_it_does() {
    let empty = Visibility::new(Cells::empty((0.0, 1.0), 16));
    let mut sky = [0.0; 27];
    (0..27).for_each(|i| sky[i] = [0.9, 0.2, 0.1][i % 3] * [1.0, -0.1, 0.3, 0.2, 0.04, -0.03, 0.05, 0.02, -0.06][i / 3]);
    let ambient = Ambient { sky: sky.to_vec(), radiosity: Radiosity::dark() };
    let normal = Vec3::new(0.1, -0.2, 1.0).normalize();
    // Of directions below, which see the ground, few count for a surface that looks up.
    let light = |n: Vec3| (0..9).map(|i| basis(n)[i] * Vec3::from_slice(&sky[3 * i..])).sum::<Vec3>();
    let got = ambient.gathered(normal, empty.looks(Vec3::splat(0.5), normal, 8192, 1));
    assert!((got.light - light(normal)).abs().max_element() < 0.03, "{} {}", got.light, light(normal));
    for side in [Vec3::X, Vec3::Y] {
        let turned = (normal + 0.05 * side).normalize();
        let (want, by) = (light(turned) - light(normal), got.at(turned) - got.light);
        assert!((want - by).abs().max_element() < 0.15 * want.abs().max_element() + 1e-3, "{want} {by}");
    }
}

/// A wall sees the upper half of a sky whose radiance is `(1 + z) / 2`: of its light, `π/4 + 1/3` of `π/2`.
#[test]
fn a_wall_gets_the_share_of_a_skys_light_that_comes_from_above() {
    let empty = Visibility::new(Cells::empty((0.0, 1.0), 16));
    let up = basis(Vec3::Z);
    let mut sky = [0.0; 27];
    sky[..3].fill(0.5 / (RADIANCE[0] * up[0]));
    let rising = (1..4).max_by(|a, b| up[*a].total_cmp(&up[*b])).unwrap();
    sky[3 * rising..3 * rising + 3].fill(0.5 / (RADIANCE[rising] * up[rising]));
    let ambient =
        Ambient { sky: sky.to_vec(), radiosity: Radiosity::dark() }.gathered(Vec3::X, empty.looks(Vec3::splat(0.5), Vec3::X, 8192, 1));
    let share = ambient.from_sky(&sky).x / 0.5;
    assert!((share - 0.712).abs() < 0.02, "{share}");
}

#[test]
fn what_hides_the_sky_sends_its_own_light() {
    let v = corner();
    let (point, up) = (Vec3::new(0.47, 0.5, 0.25), Vec3::Z);
    let with = |cells: Vec3| {
        let radiosity = Radiosity { cells: vec![cells; SIDES * OPEN_CELLS.pow(3)], ground: Vec3::ZERO };
        Ambient { sky: vec![0.0; 27], radiosity }.gathered(up, v.looks(point, up, 2048, 0))
    };
    let (dark, lit) = (with(Vec3::ZERO), with(Vec3::new(1.0, 0.5, 0.0)));
    assert_eq!(dark.light, Vec3::ZERO);
    let open = v.from_sky(point, up, 2048, 0);
    assert!((lit.light - (1.0 - open) * Vec3::new(1.0, 0.5, 0.0)).abs().max_element() < 0.02, "{lit:?}");
    // The wall stands at +x: a surface that turns there receives more of it.
    assert!(lit.slope[0].x > 0.1 && lit.at(Vec3::new(0.1, 0.0, 0.995)).x > lit.light.x, "{lit:?}");
}
