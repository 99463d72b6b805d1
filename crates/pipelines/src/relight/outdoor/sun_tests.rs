//! Tests of the search for suns.

use super::*;
use crate::relight::outdoor::visibility::{Ambient, Look};
use diorama_engine::fields::DensityQuery;
use diorama_engine::samplers::occupancy::Occupancy;
use diorama_geom::rng::Rng;
use diorama_geom::sh_light::ShLight;

/// A plate with a tower.
struct Tower;

fn is_inside(p: Vec3) -> bool {
    (0.1..0.2).contains(&p.z) || ((p - 0.5).abs().truncate().max_element() < 0.1 && (0.2..0.6).contains(&p.z))
}

impl DensityQuery for Tower {
    fn density(&self, model: &[f32], sigma: &mut [f32]) {
        sigma.iter_mut().zip(model.chunks_exact(3)).for_each(|(s, p)| *s = 2000.0 * is_inside(Vec3::from_slice(p)) as u8 as f32);
    }
}

/// A sky that is brighter above.
fn sky() -> ShLight {
    let mut sky = ShLight::uniform([0.2, 0.25, 0.35]);
    sky.0[2] = [0.1; 3];
    sky
}

/// Random points of the plate and the tower, with normals and albedos.
fn places(n: u64) -> impl Iterator<Item = (Vec3, Vec3, Vec3)> {
    let rng = Rng::new(5, 5);
    (0..n).map(move |i| {
        let at = |k: u64| rng.uniform(8 * i + k);
        let (point, normal) = match i % 4 {
            0..2 => (Vec3::new(at(0), at(1), 0.2), Vec3::Z),
            2 => (Vec3::new(0.4 + 0.2 * at(0), 0.4, 0.2 + 0.4 * at(1)), Vec3::NEG_Y),
            _ => (Vec3::new(0.6, 0.4 + 0.2 * at(0), 0.2 + 0.4 * at(1)), Vec3::X),
        };
        (point, normal, Vec3::new(0.2 + 0.5 * at(2), 0.3 + 0.3 * at(3), 0.5))
    })
}

#[test]
fn suns_are_told_apart_and_an_overcast_sky_has_none() {
    let visibility = Visibility::of(&Tower, &Occupancy::new(64, 1, false), (0.0, 1.0), 64);
    let places: Vec<(Vec3, Vec3, Vec3)> = places(1200).collect();
    let albedos = places.iter().map(|p| p.2).collect();
    let surfaces = Surfaces::new(places.iter().map(|p| (p.0, p.1)), albedos, &visibility);
    let sky: Vec<f32> = sky().0.iter().flatten().map(|v| *v as f32).collect();
    let towards = [Vec3::new(0.7, -0.5, 0.6), Vec3::new(-0.6, -0.6, 0.5)].map(Vec3::normalize);
    let suns = towards.map(|d| [d.x, d.y, d.z, 0.9, 0.8, 0.6]).into_iter().chain([[0.0, 0.0, 1.0, 0.0, 0.0, 0.0]]);
    let lights: Vec<([f32; SUN], Ambient)> = suns.map(|s| (s, surfaces.light(&visibility, &s, &sky))).collect();
    let look = |(place, (point, normal, albedo)): (&Place, &(Vec3, Vec3, Vec3))| {
        let color = |(sun, ambient): &([f32; SUN], Ambient)| {
            let direct = place.sunlit(&visibility, Vec3::from_slice(sun)) * Vec3::from_slice(&sun[3..]);
            *albedo * (direct + place.ambient(ambient))
        };
        Seen { point: *point, normal: *normal, colors: lights.iter().map(color).collect(), shown: vec![true; lights.len()], is_flat: true }
    };
    let seen: Vec<Seen> = surfaces.points.iter().zip(&places).map(look).collect();
    let (found, told) = tell_apart(&seen, &visibility, &AtomicBool::new(false), &mut |_| {}).expect("no interrupt");
    for (fitted, toward) in found.iter().zip(towards) {
        let off = Vec3::from_slice(&fitted.sun).angle_between(toward).to_degrees();
        assert!(off < 3.0, "{off}° off: {fitted:?}");
        assert!(fitted.sun[3] > 0.5, "{fitted:?}");
    }
    assert_eq!(found[2].sun[3..], [0.0; 3], "a sun in an overcast sky");
    // Up to a factor.
    let (got, want) = (told.albedos.iter().map(|a| a.x), places.iter().map(|p| p.2.x));
    let by = want.clone().sum::<f32>() / got.clone().sum::<f32>();
    let off = got.zip(want).map(|(g, w)| (by * g - w).abs()).sum::<f32>() / places.len() as f32;
    assert!(off < 0.03, "albedos are {off} off");
    // Once stopped, nothing is told.
    assert!(tell_apart(&seen, &visibility, &AtomicBool::new(true), &mut |_| {}).is_none());
}

#[test]
fn mistaken_shadows_do_not_make_suns_weak() {
    let visibility = Visibility::of(&Tower, &Occupancy::new(64, 1, false), (0.0, 1.0), 64);
    let places: Vec<(Vec3, Vec3, Vec3)> = places(2000).collect();
    let surfaces = Surfaces::new(places.iter().map(|p| (p.0, p.1)), places.iter().map(|p| p.2).collect(), &visibility);
    let sky: Vec<f32> = ShLight::uniform([0.2, 0.25, 0.35]).0.iter().flatten().map(|v| *v as f32).collect();
    let towards = [Vec3::new(0.7, -0.5, 0.6), Vec3::new(-0.6, -0.6, 0.5), Vec3::new(0.1, -0.8, 0.9)].map(Vec3::normalize);
    let suns = towards.map(|d| [d.x, d.y, d.z, 0.9, 0.8, 0.6]).into_iter().chain([[0.0, 0.0, 1.0, 0.0, 0.0, 0.0]]);
    let lights: Vec<([f32; SUN], Ambient)> = suns.map(|s| (s, surfaces.light(&visibility, &s, &sky))).collect();
    let rng = Rng::new(6, 6);
    let look = |(i, (place, (point, normal, albedo))): (usize, (&Place, &(Vec3, Vec3, Vec3)))| {
        let color = |(l, (sun, ambient)): (usize, &([f32; SUN], Ambient))| {
            // Things that no ray finds shade a third of what is in the sun.
            let is_shaded = rng.uniform((8 * i + l) as u64) < 0.33;
            let direct = place.sunlit(&visibility, Vec3::from_slice(sun)) * Vec3::from_slice(&sun[3..]);
            *albedo * (if is_shaded { Vec3::ZERO } else { direct } + place.ambient(ambient))
        };
        let colors = lights.iter().enumerate().map(color).collect();
        Seen { point: *point, normal: *normal, colors, shown: vec![true; lights.len()], is_flat: true }
    };
    let seen: Vec<Seen> = surfaces.points.iter().zip(&places).enumerate().map(look).collect();
    let (found, _) = tell_apart(&seen, &visibility, &AtomicBool::new(false), &mut |_| {}).unwrap();
    let share = |sun: &[f32], sky: &[f32]| sun[2] * gray(&sun[3..]) / gray(&level(sun, sky).to_array());
    for (found, (sun, _)) in found.iter().zip(&lights) {
        let (got, want) = (share(&found.sun, &found.sky), share(sun, &sky));
        assert!((got - want).abs() < 0.08, "of the light of a level surface, {got} are the sun's instead of {want}");
    }
}

#[test]
fn the_sun_is_found_where_it_stands() {
    let visibility = Visibility::of(&Tower, &Occupancy::new(64, 1, false), (0.0, 1.0), 64);
    let (sun, power) = (Vec3::new(0.5, -0.6, 0.7).normalize(), Vec3::new(0.9, 0.8, 0.6));
    let sky = sky();
    let seen: Vec<(Vec3, Vec3, Vec3, Vec3)> = places(3000)
        .map(|(point, normal, albedo)| {
            let place = Place::of(&visibility, point, normal);
            let lit: Vec3 = place.sky.iter().zip(sky.0).map(|(t, l)| *t * Vec3::from(l.map(|v| v as f32))).sum();
            let direct = power * normal.dot(sun).max(0.0) * visibility.from_sun(point, normal, sun);
            (point, normal, albedo, albedo * (lit + direct))
        })
        .collect();
    let surfaces = Surfaces::new(seen.iter().map(|s| (s.0, s.1)), seen.iter().map(|s| s.2).collect(), &visibility);
    let pixels: Vec<Lit> =
        seen.iter().map(|s| Lit { albedo: s.2, seen: s.3, sent: Vec3::ZERO, trust: 1.0, slope: slope(s.3, s.3) }).collect();
    let found = fit(&pixels, &surfaces, &visibility, None);
    let direction = Vec3::from_slice(&found.sun[..3]);
    assert!(direction.angle_between(sun).to_degrees() < 2.0, "{direction} {sun}");
    assert!((Vec3::from_slice(&found.sun[3..6]) - power).abs().max_element() < 0.05, "{found:?}");
    // From nearby, only the neighborhood is searched.
    let again = fit(&pixels, &surfaces, &visibility, Some((sun + Vec3::new(0.05, 0.0, 0.0)).normalize()));
    assert!(Vec3::from_slice(&again.sun[..3]).angle_between(sun).to_degrees() < 2.0);
}

/// A plain frontal shade in the albedos is none of a sun's; one sun among overcast skies is found alone.
#[test]
fn a_shade_that_all_lights_share_is_no_sun() {
    let visibility = Visibility::of(&Tower, &Occupancy::new(64, 1, false), (0.0, 1.0), 64);
    let toward = Vec3::new(0.7, -0.5, 0.6).normalize();
    let places: Vec<(Vec3, Vec3, Vec3)> = places(1200).collect();
    let shade = |p: &(Vec3, Vec3, Vec3)| 0.4 + 0.6 * p.1.dot(Vec3::new(0.3, -0.9, 0.3).normalize()).max(0.0);
    let albedos: Vec<Vec3> = places.iter().map(|p| shade(p) * p.2).collect();
    let surfaces = Surfaces::new(places.iter().map(|p| (p.0, p.1)), albedos.clone(), &visibility);
    let sky: Vec<f32> = sky().0.iter().flatten().map(|v| *v as f32).collect();
    let light = |l: usize| {
        let sun = [toward.x, toward.y, toward.z, 0.9, 0.8, 0.6].map(|v| if l == 2 { v } else { 0.0 });
        let sky: Vec<f32> = sky.iter().map(|v| v * (0.6 + 0.2 * l as f32)).collect();
        (surfaces.light(&visibility, &sun, &sky), sun)
    };
    let lights: Vec<_> = (0..5).map(light).collect();
    let rng = Rng::new(3, 1);
    let look = |(i, (place, albedo)): (usize, (&Place, &Vec3))| {
        let color = |(l, (ambient, sun)): (usize, &(Ambient, [f32; SUN]))| {
            let direct = if sun[2] > 0.0 { place.sunlit(&visibility, toward) * Vec3::from_slice(&sun[3..]) } else { Vec3::ZERO };
            // Surfaces are never known well.
            let noise = 1.0 + 0.1 * rng.normal((5 * i + l) as u64);
            noise * *albedo * (direct + place.ambient(ambient))
        };
        let colors = lights.iter().enumerate().map(color).collect();
        Seen { point: place.point, normal: place.normal, colors, shown: vec![true; lights.len()], is_flat: true }
    };
    let seen: Vec<Seen> = surfaces.points.iter().zip(&albedos).enumerate().map(look).collect();
    let (found, _) = tell_apart(&seen, &visibility, &AtomicBool::new(false), &mut |_| {}).expect("no interrupt");
    for (l, fitted) in found.iter().enumerate() {
        match l {
            2 => assert!(Vec3::from_slice(&fitted.sun).angle_between(toward).to_degrees() < 5.0 && fitted.sun[3] > 0.3, "{fitted:?}"),
            _ => assert_eq!(fitted.sun[3..], [0.0; 3], "light {l}"),
        }
    }
}

/// Two fifths of a photograph show dark things before the place.
#[test]
fn dark_things_before_a_place_do_not_take_its_sun() {
    let visibility = Visibility::of(&Tower, &Occupancy::new(64, 1, false), (0.0, 1.0), 64);
    let sun = Vec3::new(0.5, -0.6, 0.7).normalize();
    let places: Vec<(Vec3, Vec3, Vec3)> = places(2000).collect();
    let surfaces = Surfaces::new(places.iter().map(|p| (p.0, p.1)), places.iter().map(|p| p.2).collect(), &visibility);
    let sky: Vec<f32> = sky().0.iter().flatten().map(|v| *v as f32).collect();
    let ambient = surfaces.light(&visibility, &[sun.x, sun.y, sun.z, 0.9, 0.8, 0.6], &sky);
    let look = |(i, (place, albedo)): (usize, (&Place, &Vec3))| {
        let direct = place.sunlit(&visibility, sun) * Vec3::new(0.9, 0.8, 0.6);
        let lit = *albedo * (direct + place.ambient(&ambient));
        let color = if i % 5 < 2 { Vec3::splat(0.004 + 0.02 * (i % 7) as f32) } else { lit };
        Shown { point: place.point, normal: place.normal, albedo: *albedo, share: 1.0, color }
    };
    let shown: Vec<Shown> = surfaces.points.iter().zip(&surfaces.albedos).enumerate().map(look).collect();
    let found = of_photograph(&shown, &surfaces, &visibility, &AtomicBool::new(false)).expect("no interrupt");
    let off = Vec3::from_slice(&found.sun).angle_between(sun).to_degrees();
    assert!(off < 5.0 && (found.sun[3] - 0.9).abs() < 0.2, "{off}° off: {found:?}");
}

/// Walls alone, which see the horizon and little of the zenith, under the CIE overcast sky: light from above must not be lost.
#[test]
fn an_overcast_sky_is_brightest_above_where_only_walls_show_it() {
    let visibility = Visibility::of(&Tower, &Occupancy::new(64, 1, false), (0.0, 1.0), 64);
    let at = |i: usize| {
        let turn = i as f32 * 0.618 * std::f32::consts::TAU;
        (Vec3::new(0.5 + 0.3 * turn.cos(), 0.5 + 0.3 * turn.sin(), 0.6), Vec3::new(turn.cos(), turn.sin(), 0.0))
    };
    let surfaces = Surfaces::new((0..500).map(at), vec![Vec3::ONE; 500], &visibility);
    let mut overcast = [0.0; 27];
    // Light over π of a radiance of 0.3 (1 + 2 sin h) / 3 in each channel.
    (0..3).for_each(|k| (overcast[k], overcast[6 + k]) = (0.1 / 0.282_095, 0.2 / (1.5 * 0.488_603)));
    let rng = Rng::new(5, 1);
    let noise = |i: usize| 1.0 + 0.1 * rng.normal(i as u64);
    let look = |(i, p): (usize, &Place)| {
        let seen = noise(i) * p.of_sky(&overcast);
        Lit { albedo: Vec3::ONE, seen, sent: Vec3::ZERO, trust: 1.0, slope: slope(seen, seen) }
    };
    let lit: Vec<Lit> = surfaces.points.iter().enumerate().map(look).collect();
    let found = solve(&lit, &surfaces.points, &vec![0.0; lit.len()], Vec3::Z);
    let (got, want) = (level(&found.sun, &found.sky), level(&[0.0; SUN], &overcast));
    assert!((got / want - 1.0).abs().max_element() < 0.05, "{got} {want}");
}

/// A lit pavement and the dark wall that stands on it, in one cell.
#[test]
fn ground_and_wall_of_one_cell_send_their_own_light() {
    let visibility = Visibility::of(&Tower, &Occupancy::new(64, 1, false), (0.0, 1.0), 64);
    let point = Vec3::new(0.3, 0.3, 0.25);
    let normals = [Vec3::Z, -Vec3::Y];
    let surfaces = Surfaces::new((0..8).map(|i| (point, normals[i % 2])), vec![Vec3::ONE; 8], &visibility);
    let lit: Vec<Vec3> = (0..8).map(|i| Vec3::splat([0.8, 0.1][i % 2])).collect();
    let radiosity = surfaces.radiosity(&lit);
    let from = |direction: Vec3| {
        let look = Look { direction, facing: 1.0, passes: 0.0, open: 0.0, cell: visibility.cell_of(point) };
        radiosity.toward(&look).x
    };
    let near = |a: f32, b: f32| (a - b).abs() < 1e-5;
    assert!(near(from(-Vec3::Z), 0.8) && near(from(Vec3::Y), 0.1), "{} {}", from(-Vec3::Z), from(Vec3::Y));
    assert!(near(from(Vec3::new(0.0, 0.6, -0.8)), 0.64 * 0.8 + 0.36 * 0.1));
    assert!(near(radiosity.ground.x, 0.8), "the ground outside looks like what faces up: {}", radiosity.ground);
}
