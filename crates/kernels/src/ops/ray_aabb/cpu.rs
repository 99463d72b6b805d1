//! Slab test per ray.

/// Fills `out` `[R, 2]` for origins and dirs `[R, 3]`.
pub fn intersect(origins: &[f32], dirs: &[f32], min: [f32; 3], max: [f32; 3], near_plane: f32, out: &mut [f32]) {
    for ((o, d), out) in origins.chunks_exact(3).zip(dirs.chunks_exact(3)).zip(out.chunks_exact_mut(2)) {
        let (mut near, mut far) = (near_plane, f32::INFINITY);
        for k in 0..3 {
            let inv = 1.0 / d[k];
            let (a, b) = ((min[k] - o[k]) * inv, (max[k] - o[k]) * inv);
            // An axis-parallel ray gives ±∞ outside the slab's planes and NaN on them, which min and max ignore.
            near = near.max(a.min(b));
            far = far.min(a.max(b));
        }
        out.copy_from_slice(&if near < far { [near, far] } else { [0.0, 0.0] });
    }
}
