//! Vectors of three numbers.

pub type V3 = [f32; 3];

#[inline(always)]
pub fn dot(a: V3, b: V3) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

#[inline(always)]
pub fn cross(a: V3, b: V3) -> V3 {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

#[inline(always)]
pub fn sub(a: V3, b: V3) -> V3 {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

/// `a + s b`
#[inline(always)]
pub fn along(a: V3, s: f32, b: V3) -> V3 {
    [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]]
}

#[inline(always)]
pub fn scale(a: V3, s: f32) -> V3 {
    [a[0] * s, a[1] * s, a[2] * s]
}

/// Product of each component.
#[inline(always)]
pub fn times(a: V3, b: V3) -> V3 {
    [a[0] * b[0], a[1] * b[1], a[2] * b[2]]
}

/// The vector scaled to length 1; `+z` in place of one without length.
#[inline(always)]
pub fn unit(v: V3) -> V3 {
    let squared = dot(v, v);
    if squared > 0.0 { scale(v, 1.0 / squared.sqrt()) } else { [0.0, 0.0, 1.0] }
}

/// Luminance of linear RGB (Rec. 709).
#[inline(always)]
pub fn luminance(c: V3) -> f32 {
    0.2126 * c[0] + 0.7152 * c[1] + 0.0722 * c[2]
}

/// Weighted sum of a triangle's corners: `(1 − u − v) a + u b + v c`.
#[inline(always)]
pub fn mix<const N: usize>([a, b, c]: [[f32; N]; 3], [u, v]: [f32; 2]) -> [f32; N] {
    let w = 1.0 - u - v;
    std::array::from_fn(|k| w * a[k] + u * b[k] + v * c[k])
}

/// An orthonormal frame whose third vector is `n` (Duff et al. 2017).
#[inline(always)]
pub fn frame(n: V3) -> [V3; 3] {
    let sign = 1f32.copysign(n[2]);
    let a = -1.0 / (sign + n[2]);
    let b = n[0] * n[1] * a;
    [[1.0 + sign * n[0] * n[0] * a, sign * b, -sign * n[0]], [b, sign + n[1] * n[1] * a, -n[1]], n]
}

/// Affine transform of a point, rows `[axis][x, y, z, 1]`.
#[inline(always)]
pub fn transform_point(m: &[[f32; 4]; 3], p: V3) -> V3 {
    std::array::from_fn(|i| m[i][0] * p[0] + m[i][1] * p[1] + m[i][2] * p[2] + m[i][3])
}

/// Affine transform of a direction.
#[inline(always)]
pub fn transform_direction(m: &[[f32; 4]; 3], d: V3) -> V3 {
    std::array::from_fn(|i| m[i][0] * d[0] + m[i][1] * d[1] + m[i][2] * d[2])
}

/// Transform of a normal by the inverse of its surface's transform.
#[inline(always)]
pub fn transform_normal(inverse: &[[f32; 4]; 3], n: V3) -> V3 {
    std::array::from_fn(|i| inverse[0][i] * n[0] + inverse[1][i] * n[1] + inverse[2][i] * n[2])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_are_orthonormal_and_right_handed() {
        for n in [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], unit([0.3, -0.5, -0.7]), unit([1.0, 1e-4, 1e-6])] {
            let [s, t, n] = frame(n);
            assert!([dot(s, t), dot(s, n), dot(t, n)].iter().all(|d| d.abs() < 1e-6));
            let c = cross(s, t);
            assert!((0..3).all(|k| (c[k] - n[k]).abs() < 1e-6), "{n:?}");
        }
    }

    #[test]
    fn normals_stay_orthogonal_to_their_surface() {
        let m = [[2.0, 0.5, 0.0, 1.0], [0.0, 1.0, 0.0, 2.0], [0.3, 0.0, 0.5, 3.0]];
        // The inverse of the linear part, by cofactors.
        let det = 2.0 * 1.0 * 0.5 - 0.5 * (0.0 * 0.5 - 0.0 * 0.3);
        let inverse = [[0.5 / det, -0.25 / det, 0.0, 0.0], [0.0, 1.0 / det, 0.0, 0.0], [-0.3 / det, 0.15 / det, 2.0 / det, 0.0]];
        let (side, normal) = ([1.0, 2.0, -0.5], [1.0, 0.0, 2.0]);
        assert!(dot(side, normal).abs() < 1e-6);
        assert!(dot(transform_direction(&m, side), transform_normal(&inverse, normal)).abs() < 1e-5);
    }
}
