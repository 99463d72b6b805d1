//! Cases of the op, for its tests and for `bench check`.

use super::Ray;
#[cfg(feature = "gpu")]
use super::{Bvh, Hit, gpu as on_gpu, reference};
#[cfg(feature = "gpu")]
use crate::gpu::{Gpu, GpuError, table::Table};
use diorama_testkit::random;

/// Corners and triangles.
pub type Mesh = (Vec<[f32; 3]>, Vec<[u32; 3]>);

/// Triangles of edges of about `size`, in the cube `[−1, 1]³`.
pub fn soup(n: usize, size: f32, seed: u64) -> Mesh {
    let (centers, edges) = (random(3 * n, seed), random(9 * n, seed + 1));
    let vertices = (0..3 * n).map(|i| std::array::from_fn(|k| centers[i / 3 * 3 + k] + size * edges[3 * i + k])).collect();
    (vertices, (0..n as u32).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect())
}

/// Rays through that cube.
pub fn rays(n: usize, seed: u64) -> Vec<Ray> {
    let (from, to) = (random(3 * n, seed), random(3 * n, seed + 1));
    (0..n)
        .map(|i| {
            let origin = std::array::from_fn(|k| 2.0 * from[3 * i + k]);
            let mut direction: [f32; 3] = std::array::from_fn(|k| to[3 * i + k] - origin[k]);
            // Some are parallel to one axis plane or two.
            (0..i % 8 % 3).for_each(|k| direction[(i + k) % 3] = 0.0);
            Ray { origin, direction, range: [0.0, f32::INFINITY] }
        })
        .collect()
}

/// A sphere of `4 n²` vertices around the origin, closed.
pub fn sphere(n: usize) -> Mesh {
    let (rows, columns) = (n, 2 * n);
    let mut vertices = vec![[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]];
    for r in 1..rows {
        for c in 0..columns {
            let (polar, azimuth) = (std::f64::consts::PI * r as f64 / rows as f64, std::f64::consts::TAU * c as f64 / columns as f64);
            vertices.push([polar.sin() * azimuth.cos(), polar.sin() * azimuth.sin(), polar.cos()].map(|v| v as f32));
        }
    }
    let at = |r: usize, c: usize| match r {
        0 => 0,
        r if r == rows => 1,
        r => (2 + (r - 1) * columns + c % columns) as u32,
    };
    let mut triangles = Vec::new();
    for r in 0..rows {
        for c in 0..columns {
            let [a, b, d, e] = [at(r, c), at(r + 1, c), at(r + 1, c + 1), at(r, c + 1)];
            triangles.extend([[a, b, d], [a, d, e]].into_iter().filter(|t| t[0] != t[1] && t[1] != t[2] && t[2] != t[0]));
        }
    }
    (vertices, triangles)
}

/// Rays from inside of a mesh through its corners and through points of its edges.
pub fn through_edges((vertices, triangles): &Mesh) -> Vec<Ray> {
    let origin = [0.1, -0.2, 0.05];
    let edges = triangles.iter().map(|t| t.map(|v| vertices[v as usize]));
    let at = |[a, b, _]: [[f32; 3]; 3], s: f32| std::array::from_fn(|k| (1.0 - s) * a[k] + s * b[k] - origin[k]);
    let ray = |t, s| Ray { origin, direction: at(t, s), range: [0.0, f32::INFINITY] };
    edges.flat_map(|t| [0.0, 0.25, 0.5, 0.7].map(|s| ray(t, s))).collect()
}

#[cfg(feature = "gpu")]
pub fn check(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    for (n, size) in [(0, 0.1), (1, 1.0), (9, 0.5), (700, 0.3)] {
        let (vertices, triangles) = soup(n, size, 3);
        let (bvh, mut rays) = (on_gpu::GpuBvh::upload(gpu, &Bvh::build(&vertices, &triangles)), rays(1500, 9));
        // Some end before what they would hit, or begin behind it.
        rays.iter_mut().enumerate().filter(|(i, _)| i % 5 == 0).for_each(|(i, r)| r.range = [0.2 * (i % 3) as f32, 0.9]);
        let want: Vec<_> = rays.iter().map(|r| reference::nearest(&vertices, &triangles, r)).collect();
        let (nearest, any) = (on_gpu::trace(gpu, &bvh, &rays, false)?, on_gpu::trace(gpu, &bvh, &rays, true)?);
        let shape = format!("T={n} R={}", rays.len());
        let is_same = |i: usize, h: &Hit| want[i].map_or(u32::MAX, |w| w.1) == h.triangle;
        let others = nearest.iter().enumerate().filter(|(i, h)| !is_same(*i, h)).count();
        let blocked = any.iter().zip(&want).filter(|(h, w)| h.is_some() != w.is_some()).count();
        let few = |n: usize| if n <= rays.len() / 1000 { Ok(0.0) } else { Err(format!("{n} rays differ")) };
        table.row("ray and triangles", "triangle", shape.clone(), few(others));
        table.row("ray and triangles", "whether any", shape.clone(), few(blocked));
        let same: Vec<_> = nearest.iter().enumerate().filter(|(i, h)| h.is_some() && is_same(*i, h)).map(|(i, h)| (h, want[i])).collect();
        let (t, weights): (Vec<f32>, Vec<f32>) =
            (same.iter().map(|(h, _)| h.t).collect(), same.iter().flat_map(|(h, _)| h.weights).collect());
        let wide: Vec<_> = same.iter().flat_map(|(_, w)| *w).collect();
        table.close("ray and triangles", "distance", &shape, &gpu.upload(&t), &wide.iter().map(|w| w.0).collect::<Vec<_>>())?;
        table.close("ray and triangles", "weights", &shape, &gpu.upload(&weights), &wide.iter().flat_map(|w| w.2).collect::<Vec<_>>())?;
    }
    let mesh = sphere(24);
    let (bvh, rays) = (on_gpu::GpuBvh::upload(gpu, &Bvh::build(&mesh.0, &mesh.1)), through_edges(&mesh));
    let missed = on_gpu::trace(gpu, &bvh, &rays, false)?.iter().filter(|h| !h.is_some()).count();
    let outcome = if missed == 0 { Ok(0.0) } else { Err(format!("{missed} rays pass between triangles")) };
    table.row("ray and triangles", "closed surface", format!("R={}", rays.len()), outcome);
    Ok(())
}
