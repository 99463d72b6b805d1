//! Plain loop in f64, face by face.

/// `[R, 2]` for origins and dirs `[R, 3]`.
pub fn intersect(origins: &[f64], dirs: &[f64], min: [f64; 3], max: [f64; 3], near_plane: f64) -> Vec<f64> {
    let mut out = Vec::new();
    for (o, d) in origins.chunks_exact(3).zip(dirs.chunks_exact(3)) {
        let (mut near, mut far) = (near_plane, f64::INFINITY);
        for k in 0..3 {
            if d[k] == 0.0 {
                if o[k] < min[k] || o[k] > max[k] {
                    far = f64::NEG_INFINITY;
                }
                continue;
            }
            let (a, b) = ((min[k] - o[k]) / d[k], (max[k] - o[k]) / d[k]);
            near = near.max(a.min(b));
            far = far.min(a.max(b));
        }
        out.extend(if near < far { [near, far] } else { [0.0, 0.0] });
    }
    out
}
