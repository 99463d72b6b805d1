//! Photographs of the still life, and a stand-in for COLMAP that returns the true model of them. Each test file uses a part of this module.

#![allow(dead_code, reason = "each test program uses a part")]

use diorama_data::{colmap, photo_import};
use diorama_geom::glam::{DQuat, DVec2, DVec3};
use diorama_geom::rng::Rng;
use diorama_geom::{Camera, ImageU8, Pose, Ray};
use diorama_scenes::still_life;
use std::path::Path;

pub const SIZE: u32 = 200;

/// Factor of linear light by which every second photograph is darker.
const DARKER: f32 = 0.5;

/// `views` photographs of the still life, of which every second is darker, and COLMAP's model of them.
pub fn capture(photos: &Path, model: &Path, views: usize) {
    std::fs::create_dir_all(photos).unwrap();
    std::fs::create_dir_all(model).unwrap();
    let scene = still_life::scene();
    let camera = Camera::pinhole(SIZE, SIZE, still_life::FOV);
    let poses: Vec<Pose> = (0..views).map(|i| still_life::pose(i, views)).collect();
    for (i, p) in poses.iter().enumerate() {
        let im = scene.render(&camera, p, 2);
        let shade = |v: u8| {
            let linear = diorama_geom::color::linear_from_srgb(v as f32 / 255.0) * if i % 2 == 0 { 1.0 } else { DARKER };
            diorama_geom::color::u8_from_unit(diorama_geom::color::srgb_from_linear(linear))
        };
        let over =
            |p: &[u8]| -> [u8; 3] { std::array::from_fn(|k| shade(((p[k] as u32 * p[3] as u32 + 90 * (255 - p[3] as u32)) / 255) as u8)) };
        let data = im.data.chunks_exact(4).flat_map(over).collect();
        photo_import::write(&ImageU8 { channels: 3, data, ..im }, photos, &format!("view_{i:02}")).unwrap();
    }
    // The points are hits of random rays; each is observed in all views that see it.
    let rng = Rng::new(8, 0);
    let mut points: Vec<DVec3> = Vec::new();
    for n in 0..2500u64 {
        let p = &poses[rng.below(3 * n, views as u64) as usize];
        let px = DVec2::new(rng.uniform(3 * n + 1) as f64, rng.uniform(3 * n + 2) as f64) * SIZE as f64;
        let ray = Ray { origin: p.translation, direction: p.rotation * camera.direction(px.x, px.y) };
        points.extend(scene.trace(&ray).map(|(_, t)| ray.origin + ray.direction * t));
    }
    let (mut tracks, mut images) = (vec![Vec::new(); points.len()], (views as u64).to_le_bytes().to_vec());
    for (i, p) in poses.iter().enumerate() {
        let inverse = p.inverse();
        let seen: Vec<(DVec2, usize)> = points
            .iter()
            .enumerate()
            .filter_map(|(n, x)| {
                let to = *x - p.translation;
                let ray = Ray { origin: p.translation, direction: to.normalize() };
                let visible = scene.trace(&ray).is_some_and(|(_, t)| (t - to.length()).abs() < 1e-3);
                camera.project(inverse.point(*x)).filter(|_| visible).map(|px| (px, n))
            })
            .collect();
        images.extend((i as u32 + 1).to_le_bytes());
        let q = DQuat::from_mat3(&inverse.rotation);
        [q.w, q.x, q.y, q.z].into_iter().chain(inverse.translation.to_array()).for_each(|v| images.extend(v.to_le_bytes()));
        images.extend(1u32.to_le_bytes());
        images.extend(format!("view_{i:02}.jpg\0").bytes());
        images.extend((seen.len() as u64).to_le_bytes());
        for (k, (px, n)) in seen.iter().enumerate() {
            [px.x, px.y].iter().for_each(|v| images.extend(v.to_le_bytes()));
            images.extend((*n as u64).to_le_bytes());
            tracks[*n].push((i as u32 + 1, k as u32));
        }
    }
    std::fs::write(model.join("images.bin"), images).unwrap();
    let mut cameras = [&1u64.to_le_bytes()[..], &1u32.to_le_bytes(), &1u32.to_le_bytes()].concat();
    [SIZE as u64; 2].iter().for_each(|v| cameras.extend(v.to_le_bytes()));
    [camera.fx, camera.fy, camera.cx, camera.cy].iter().for_each(|v| cameras.extend(v.to_le_bytes()));
    std::fs::write(model.join("cameras.bin"), cameras).unwrap();
    let mut all = (points.len() as u64).to_le_bytes().to_vec();
    for (n, (x, track)) in points.iter().zip(&tracks).enumerate() {
        all.extend((n as u64).to_le_bytes());
        x.to_array().iter().for_each(|v| all.extend(v.to_le_bytes()));
        all.extend([120, 130, 140]);
        all.extend(0.5f64.to_le_bytes());
        all.extend((track.len() as u64).to_le_bytes());
        track.iter().for_each(|(i, k)| all.extend([i.to_le_bytes(), k.to_le_bytes()].concat()));
    }
    std::fs::write(model.join("points3D.bin"), all).unwrap();
    assert_eq!(colmap::points(model).unwrap().len(), points.len());
}

/// A program that answers like COLMAP and writes the true model.
pub fn stand_in(path: &Path, model: &Path) {
    use std::os::unix::fs::PermissionsExt;
    let script = format!(
        "#!/bin/sh\ncommand=$1\nwhile [ $# -gt 1 ]; do [ \"$1\" = --output_path ] && out=$2; shift; done\n\
         [ $command = mapper ] && mkdir -p $out/0 && cp {}/*.bin $out/0\nexit 0\n",
        model.display()
    );
    std::fs::write(path, script).unwrap();
    std::fs::set_permissions(path, std::fs::Permissions::from_mode(0o755)).unwrap();
}
