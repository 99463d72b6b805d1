//! Plain loops in f64.

use super::{CORRECTION, PosedCamera};
use diorama_geom::glam::DVec3;

/// Origins and unit directions `[R, 3]` of the rays through `pixels` `[R, 2]` of cameras `index` `[R]`.
pub fn forward(cameras: &[PosedCamera], index: &[u32], pixels: &[f64]) -> (Vec<f64>, Vec<f64>) {
    let (mut origins, mut dirs) = (Vec::new(), Vec::new());
    for (r, &c) in index.iter().enumerate() {
        let c = &cameras[c as usize];
        origins.extend(c.pose.translation.to_array());
        dirs.extend((c.pose.rotation * c.camera.direction(pixels[r * 2], pixels[r * 2 + 1])).to_array());
    }
    (origins, dirs)
}

/// Gradient of the corrections `[cameras, 7]` at zero.
pub fn backward(cameras: &[PosedCamera], index: &[u32], pixels: &[f64], d_origins: &[f64], d_dirs: &[f64]) -> Vec<f64> {
    let mut out = vec![0.0; cameras.len() * CORRECTION];
    let (_, dirs) = forward(cameras, index, pixels);
    for (r, &c) in index.iter().enumerate() {
        let g = &mut out[c as usize * CORRECTION..][..CORRECTION];
        let v = |a: &[f64]| DVec3::new(a[r * 3], a[r * 3 + 1], a[r * 3 + 2]);
        // d(ω × d)·g = ω·(d × g)
        let turn = v(&dirs).cross(v(d_dirs)).to_array();
        let h = 1e-5;
        let at = |phi: f64| {
            let c = cameras[c as usize].corrected(&[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, phi]);
            c.pose.rotation * c.camera.direction(pixels[r * 2], pixels[r * 2 + 1])
        };
        let slope = (at(h) - at(-h)) / (2.0 * h);
        for k in 0..3 {
            g[k] += d_origins[r * 3 + k];
            g[3 + k] += turn[k];
        }
        g[6] += slope.dot(v(d_dirs));
    }
    out
}
