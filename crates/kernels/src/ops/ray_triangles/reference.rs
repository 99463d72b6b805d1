//! All triangles, one by one (Möller and Trumbore 1997).

use super::Ray;

/// Nearest hit: distance, triangle, weights of the second and the third corner.
///
/// # Shapes
/// vertices `[V, 3]`, triangles `[T, 3]`.
pub fn nearest(vertices: &[[f32; 3]], triangles: &[[u32; 3]], ray: &Ray) -> Option<(f64, u32, [f64; 2])> {
    let wide = |v: [f32; 3]| v.map(f64::from);
    let (origin, direction) = (wide(ray.origin), wide(ray.direction));
    let mut best: Option<(f64, u32, [f64; 2])> = None;
    for (i, triangle) in triangles.iter().enumerate() {
        let [a, b, c] = triangle.map(|v| wide(vertices[v as usize]));
        let (ab, ac, ao) = (sub(b, a), sub(c, a), sub(origin, a));
        let p = cross(direction, ac);
        let volume = dot(ab, p);
        let q = cross(ao, ab);
        let (u, v, t) = (dot(ao, p) / volume, dot(direction, q) / volume, dot(ac, q) / volume);
        let inside = volume != 0.0 && u >= 0.0 && v >= 0.0 && u + v <= 1.0;
        let before = best.is_none_or(|(nearest, ..)| t < nearest);
        if inside && t > ray.range[0] as f64 && t < ray.range[1] as f64 && before {
            best = Some((t, i as u32, [u, v]));
        }
    }
    best
}

fn sub(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|i| a[i] - b[i])
}

fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    (0..3).map(|i| a[i] * b[i]).sum()
}
