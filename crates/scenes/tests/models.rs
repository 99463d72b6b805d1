//! The procedural models as a renderer meets them: geometry, materials and cameras.

use diorama_geom::color::linear_from_srgb;
use diorama_geom::glam::{DVec3, Vec3};
use diorama_geom::model::{Model, Opacity};
use diorama_geom::rng::Rng;
use diorama_scenes::{chair, still_life_model, street};
use rayon::prelude::*;
use std::collections::HashMap;
use std::sync::OnceLock;

fn the_street() -> &'static Model {
    static STREET: OnceLock<Model> = OnceLock::new();
    STREET.get_or_init(|| street::model(1))
}

fn all() -> [(&'static str, Model); 3] {
    [("street", the_street().clone()), ("chair", chair::model(1)), ("still life", still_life_model::model())]
}

#[test]
fn vertices_are_finite_with_unit_normals_and_indices_within_bounds() {
    for (name, model) in all() {
        for part in &model.parts {
            let (mesh, label) = (&part.mesh, format!("{name}: {}", part.name));
            let n = mesh.positions.len();
            assert!(!mesh.faces.is_empty() && mesh.normals.len() == n && mesh.uvs.len() == n, "{label}");
            assert!(mesh.positions.iter().flatten().chain(mesh.uvs.iter().flatten()).all(|v| v.is_finite()), "{label}");
            assert!(mesh.normals.iter().all(|n| (Vec3::from(*n).length() - 1.0).abs() < 1e-4), "{label}");
            assert!(mesh.faces.iter().flatten().all(|i| (*i as usize) < n), "{label}");
            let has_normal_map = model.materials[part.material].normal_texture.is_some();
            assert!(!has_normal_map || mesh.tangents.len() == n, "{label}");
            for (t, n) in mesh.tangents.iter().zip(&mesh.normals) {
                let tangent = Vec3::new(t[0], t[1], t[2]);
                assert!((tangent.length() - 1.0).abs() < 1e-4 && tangent.dot(Vec3::from(*n)).abs() < 1e-3 && t[3].abs() == 1.0, "{label}");
            }
        }
    }
}

#[test]
fn shading_normals_agree_with_the_winding() {
    for (name, model) in all() {
        for part in &model.parts {
            for f in &part.mesh.faces {
                let [a, b, c] = f.map(|i| Vec3::from(part.mesh.positions[i as usize]));
                let normal = (b - a).cross(c - a).normalize_or_zero();
                let least = f.iter().map(|i| normal.dot(Vec3::from(part.mesh.normals[*i as usize]))).fold(1.0, f32::min);
                assert!(least > 0.2, "{name}: {} has a normal at {least} to its face", part.name);
            }
        }
    }
}

#[test]
fn sizes_are_within_their_bounds() {
    let unique = |m: &Model| m.parts.iter().map(|p| p.mesh.faces.len()).sum::<usize>();
    let street = the_street();
    assert!((20_000..150_000).contains(&unique(street)), "{}", unique(street));
    assert!(street.face_count() < 160_000, "{}", street.face_count());
    let chair = chair::model(1);
    assert!((10_000..60_000).contains(&chair.face_count()), "{}", chair.face_count());
    let (lo, hi) = chair.bounds().unwrap();
    assert!(lo[2].abs() < 0.01 && (1.0..1.2).contains(&hi[2]));
}

#[test]
fn models_repeat_and_follow_their_seed() {
    assert_eq!(street::model(1), *the_street());
    assert_ne!(street::model(2).instances, the_street().instances);
    assert_eq!(chair::model(4), chair::model(4));
    assert_eq!(street::cameras(20, 64, 48, 3), street::cameras(20, 64, 48, 3));
}

/// Linear base colors of a material, as they meet the surface.
fn colors(model: &Model, material: usize) -> Vec<[f32; 3]> {
    let m = &model.materials[material];
    let factor: [f32; 3] = std::array::from_fn(|k| m.base_color[k]);
    let Some(texture) = m.base_color_texture else { return vec![factor] };
    let image = &model.textures[texture].image;
    let cutoff = if let Opacity::Cutoff(c) = m.opacity { c } else { 0.0 };
    let shown = image.data.chunks_exact(image.channels).filter(|p| p.len() < 4 || p[3] as f32 / 255.0 >= cutoff);
    shown.map(|p| std::array::from_fn(|k| factor[k] * linear_from_srgb(p[k] as f32 / 255.0))).collect()
}

#[test]
fn albedo_stays_between_charcoal_and_fresh_plaster() {
    for (name, model) in [("street", the_street().clone()), ("chair", chair::model(1))] {
        for (k, m) in model.materials.iter().enumerate() {
            for c in colors(&model, k).into_iter().flatten() {
                assert!((0.04..=0.85).contains(&c), "{name}: {} has {c}", m.name);
            }
        }
    }
}

#[test]
fn every_part_of_the_chair_and_the_still_life_is_closed() {
    for model in [chair::model(1), still_life_model::model()] {
        for part in &model.parts {
            let mut balance = HashMap::<[[u32; 3]; 2], i64>::new();
            for f in &part.mesh.faces {
                let p = f.map(|i| part.mesh.positions[i as usize].map(f32::to_bits));
                for k in 0..3 {
                    let (a, b) = (p[k], p[(k + 1) % 3]);
                    *balance.entry([a.min(b), a.max(b)]).or_default() += if a < b { 1 } else { -1 };
                }
            }
            let open = balance.values().filter(|n| **n != 0).count();
            assert_eq!(open, 0, "{}: edges without a partner", part.name);
            assert!(part.mesh.volume() > 0.0, "{}", part.name);
        }
    }
}

/// A triangle in the world.
struct Triangle {
    corners: [Vec3; 3],
    part: usize,
}

fn triangles(model: &Model) -> Vec<Triangle> {
    let of = |i: &diorama_geom::model::Instance| {
        let mesh = &model.parts[i.part].mesh;
        let p = |k: u32| i.world_from_part.transform_point3(DVec3::from(mesh.positions[k as usize].map(f64::from))).as_vec3();
        mesh.faces.iter().map(|f| Triangle { corners: f.map(p), part: i.part }).collect::<Vec<_>>()
    };
    model.instances.iter().flat_map(of).collect()
}

/// Distance to the nearest triangle, its part, and whether its front is seen. Möller and Trumbore 1997.
fn nearest(triangles: &[Triangle], origin: Vec3, direction: Vec3) -> Option<(f32, usize, bool)> {
    let hit = |t: &Triangle| {
        let [a, b, c] = t.corners;
        let (e1, e2) = (b - a, c - a);
        let p = direction.cross(e2);
        let det = e1.dot(p);
        let s = origin - a;
        let (u, q) = (s.dot(p) / det, s.cross(e1));
        let v = direction.dot(q) / det;
        let distance = e2.dot(q) / det;
        let inside = det.abs() > 1e-12 && u >= 0.0 && v >= 0.0 && u + v <= 1.0 && distance > 1e-4;
        inside.then_some((distance, t.part, det > 0.0))
    };
    triangles.iter().filter_map(hit).min_by(|a, b| a.0.total_cmp(&b.0))
}

#[test]
fn cameras_stand_free_and_see_fronts() {
    let model = the_street();
    let triangles = triangles(model);
    let cameras = street::cameras(48, 64, 48, 1);
    assert_eq!(cameras.len(), 48);
    // Sheets that are seen from both sides.
    let sheets = ["leaves", "plants", "awning", "curtains"];
    let seen: Vec<f32> = cameras
        .par_iter()
        .enumerate()
        .flat_map(|(i, (camera, pose))| {
            let origin = pose.translation.as_vec3();
            let rng = Rng::new(5, i as u64);
            let mut distances = Vec::new();
            for k in 0..16u64 {
                // Half of the rays in the image, half all around.
                let (a, b) = (rng.uniform(2 * k), rng.uniform(2 * k + 1));
                let direction = if k < 8 {
                    pose.rotation * camera.direction(64.0 * a as f64, 48.0 * b as f64)
                } else {
                    let (z, angle) = (2.0 * a as f64 - 1.0, std::f64::consts::TAU * b as f64);
                    DVec3::new((1.0 - z * z).sqrt() * angle.cos(), (1.0 - z * z).sqrt() * angle.sin(), z)
                };
                let Some((distance, part, is_front)) = nearest(&triangles, origin, direction.as_vec3()) else { continue };
                let name = &model.parts[part].name;
                assert!(distance > 0.3, "camera {i} is {distance} m from {name}");
                assert!(is_front || sheets.iter().any(|s| name.ends_with(s)), "camera {i} sees the back of {name}");
                if k < 8 {
                    distances.push(distance);
                }
            }
            distances
        })
        .collect();
    // Most of what the images show is the place, not the sky; façades are some meters away.
    assert!(seen.len() > 48 * 8 * 7 / 10, "{} of {}", seen.len(), 48 * 8);
    let mut sorted = seen.clone();
    sorted.sort_by(f32::total_cmp);
    assert!((5.0..30.0).contains(&sorted[sorted.len() / 2]), "{}", sorted[sorted.len() / 2]);
}

#[test]
fn photographers_have_the_height_of_people_and_images_any_size() {
    for (width, height) in [(640, 360), (48, 64)] {
        let cameras = street::cameras(64, width, height, 2);
        let at_eye_level = cameras.iter().filter(|(_, p)| (1.5..2.05).contains(&p.translation.z)).count();
        assert!((48..64).contains(&at_eye_level), "{at_eye_level}");
        assert!(cameras.iter().all(|(c, _)| (c.width, c.height) == (width, height)));
    }
    for (camera, pose) in chair::cameras(40, 96, 96) {
        assert!(((pose.translation - chair::CENTER).length() - chair::DISTANCE).abs() < 1e-9);
        for corner in 0..8 {
            let pick = |bit: usize, lo: f64, hi: f64| if corner >> bit & 1 == 1 { hi } else { lo };
            let p = DVec3::new(pick(0, -0.33, 0.33), pick(1, -0.28, 0.39), pick(2, 0.0, 1.09));
            let px = camera.project(pose.inverse().point(p)).unwrap();
            assert!(px.min_element() > 0.0 && px.max_element() < 96.0, "the chair is cut: {px}");
        }
    }
}

#[test]
fn occluders_are_found_by_name() {
    let model = the_street();
    let triangles = |prefix: &str| model.parts.iter().filter(|p| p.name.starts_with(prefix)).map(|p| p.mesh.faces.len()).sum::<usize>();
    for prefix in street::OCCLUDERS.into_iter().chain(["house.", "arcade.", "church.", "gate.", "ground."]) {
        assert!(triangles(prefix) > 100, "{prefix}");
    }
    let names: std::collections::HashSet<_> = model.parts.iter().map(|p| (&p.name, p.material)).collect();
    assert_eq!(names.len(), model.parts.len());
}
