//! Parallel over rays; corrections' gradients are added ray by ray, so their order is fixed.

use super::{CORRECTION, PosedCamera};
use diorama_geom::glam::DVec3;
use rayon::prelude::*;

/// Rays through pixels.
///
/// # Shapes
/// index `[R]` names a camera per ray; pixels `[R, 2]`; origins and dirs `[R, 3]`, overwritten.
pub fn forward(cameras: &[PosedCamera], index: &[u32], pixels: &[f32], origins: &mut [f32], dirs: &mut [f32]) {
    assert!(pixels.len() == index.len() * 2 && origins.len() == index.len() * 3 && dirs.len() == origins.len(), "rays: shapes");
    let rays = origins.par_chunks_mut(3).zip(dirs.par_chunks_mut(3)).zip(index.par_iter().zip(pixels.par_chunks(2)));
    rays.with_min_len(128).for_each(|((o, d), (&c, p))| {
        let c = &cameras[c as usize];
        o.copy_from_slice(&c.pose.translation.as_vec3().to_array());
        let dir = c.pose.rotation * c.camera.direction(p[0] as f64, p[1] as f64);
        d.copy_from_slice(&dir.as_vec3().to_array());
    });
}

/// Adds to the corrections' gradients `[cameras, 7]`.
///
/// # Shapes
/// as [`forward`]; dirs are its result.
pub fn backward(cameras: &[PosedCamera], index: &[u32], pixels: &[f32], dirs: &[f32], d_origins: &[f32], d_dirs: &[f32], out: &mut [f64]) {
    assert_eq!(out.len(), cameras.len() * CORRECTION, "rays: corrections");
    let per_ray: Vec<[f64; CORRECTION]> = (0..index.len())
        .into_par_iter()
        .with_min_len(128)
        .map(|r| {
            let v = |a: &[f32]| DVec3::new(a[r * 3] as f64, a[r * 3 + 1] as f64, a[r * 3 + 2] as f64);
            let (d, g, o) = (v(dirs), v(d_dirs), v(d_origins));
            let turn = d.cross(g);
            let c = &cameras[index[r] as usize];
            let h = 1e-4;
            let at = |scale: f64| {
                let mut camera = c.camera;
                camera.fx *= scale;
                camera.fy *= scale;
                camera.direction(pixels[r * 2] as f64, pixels[r * 2 + 1] as f64)
            };
            let slope = c.pose.rotation * ((at(1.0 + h) - at(1.0 - h)) / (2.0 * h));
            [o.x, o.y, o.z, turn.x, turn.y, turn.z, slope.dot(g)]
        })
        .collect();
    for (&c, g) in index.iter().zip(&per_ray) {
        out[c as usize * CORRECTION..][..CORRECTION].iter_mut().zip(g).for_each(|(o, g)| *o += g);
    }
}
