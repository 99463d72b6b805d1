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

/// Sine and cosine of an angle in turns, to about 2e-7: polynomials of an eighth of a turn (Cody and Waite 1980).
#[inline(always)]
pub fn sin_cos_turns(turns: f32) -> [f32; 2] {
    // Adding 1.5 · 2²³ rounds to an integer, which then stands in the low bits.
    const ROUND: f32 = 12_582_912.0;
    let quarters = 4.0 * turns;
    let rounded = quarters + ROUND;
    let quadrant = rounded.to_bits();
    let x = (quarters - (rounded - ROUND)) * std::f32::consts::FRAC_PI_2;
    let x2 = x * x;
    let sine = x + x * x2 * (-1.666_665_5e-1 + x2 * (8.332_161e-3 + x2 * -1.951_529_6e-4));
    let cosine = 1.0 - 0.5 * x2 + x2 * x2 * (4.166_664_6e-2 + x2 * (-1.388_731_6e-3 + x2 * 2.443_315_7e-5));
    let (a, b) = if quadrant & 1 == 0 { (sine, cosine) } else { (cosine, sine) };
    let sign = |bit: u32, v: f32| f32::from_bits(v.to_bits() ^ (bit & 2) << 30);
    [sign(quadrant, a), sign(quadrant.wrapping_add(1), b)]
}

/// Arc cosine of a number, which is first brought into −1 to 1, to about 1e-7 (Abramowitz and Stegun 1964, 4.4.46).
#[inline(always)]
pub fn arc_cosine(x: f32) -> f32 {
    let size = x.abs().min(1.0);
    let p = -0.001_262_491_1;
    let p = 0.006_670_09 + size * p;
    let p = -0.017_088_126 + size * p;
    let p = 0.030_891_88 + size * p;
    let p = -0.050_174_303 + size * p;
    let p = 0.088_978_98 + size * p;
    let p = -0.214_598_8 + size * p;
    let p = std::f32::consts::FRAC_PI_2 + size * p;
    let angle = (1.0 - size).sqrt() * p;
    if x < 0.0 { std::f32::consts::PI - angle } else { angle }
}

/// Angle of `(sine, cosine)` times any length in turns, −½ to ½, to about 1e-7 (Abramowitz and Stegun 1964, 4.4.49); 0 without length.
#[inline(always)]
pub fn turns_of(sine: f32, cosine: f32) -> f32 {
    let (s, c) = (sine.abs(), cosine.abs());
    let (low, high) = if s <= c { (s, c) } else { (c, s) };
    let x = low / high.max(f32::MIN_POSITIVE);
    let x2 = x * x;
    let p = 0.002_866_225_8;
    let p = -0.016_165_737 + x2 * p;
    let p = 0.042_909_615 + x2 * p;
    let p = -0.075_289_64 + x2 * p;
    let p = 0.106_562_64 + x2 * p;
    let p = -0.142_089 + x2 * p;
    let p = 0.199_935_51 + x2 * p;
    let p = -0.333_331_44 + x2 * p;
    let eighth = (x + x * x2 * p) * (0.5 / std::f32::consts::PI);
    let quarter = if s <= c { eighth } else { 0.25 - eighth };
    let half = if cosine < 0.0 { 0.5 - quarter } else { quarter };
    half.copysign(sine)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn angles_are_those_of_the_library() {
        for i in -4000..=4000 {
            let turns = i as f32 / 1600.0;
            let (sine, cosine) = (std::f64::consts::TAU * turns as f64).sin_cos();
            let [a, b] = sin_cos_turns(turns);
            assert!((a as f64 - sine).abs() < 4e-7 && (b as f64 - cosine).abs() < 4e-7, "{turns}: {a} {b}");
            let x = i as f32 / 4000.0;
            assert!((arc_cosine(x) as f64 - (x as f64).acos()).abs() < 4e-7, "{x}");
            let angle = sine.atan2(cosine) / std::f64::consts::TAU;
            let got = turns_of(3.0 * sine as f32, 3.0 * cosine as f32) as f64;
            let error = (got - angle + 0.5).rem_euclid(1.0) - 0.5;
            assert!(error.abs() < 1e-7, "{turns}: {got} {angle}");
        }
        assert_eq!(turns_of(0.0, 0.0), 0.0);
        assert!(arc_cosine(1.0 + 1e-6) == 0.0 && (arc_cosine(-1.1) - std::f32::consts::PI).abs() < 1e-6);
    }

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
