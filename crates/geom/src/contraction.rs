//! Scene contraction for unbounded captures (Barron et al. 2022, mip-NeRF 360, eq. 10).

/// Maps model space, whose inner cube is `[0, 1]³`, to the finite domain of an encoding.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Space {
    /// A cube with this edge around the inner cube's center; outside it the field is empty.
    Cube(f32),
    /// All of space: unchanged within a cube with this edge around the inner cube's center, contracted outside it.
    Contracted(f32),
}

impl Space {
    /// Coordinates in `[−½, ½]³` of a point given relative to the inner cube's center.
    #[inline(always)]
    pub fn normalize(self, centered: [f32; 3]) -> [f32; 3] {
        match self {
            Space::Cube(edge) => centered.map(|v| v / edge),
            Space::Contracted(edge) => contract(centered.map(|v| 2.0 / edge * v)).map(|v| 0.25 * v),
        }
    }

    /// Derivative of [`Space::normalize`] at `centered` along `v`.
    pub fn normalize_tangent(self, centered: [f32; 3], v: [f32; 3]) -> [f32; 3] {
        match self {
            Space::Cube(edge) => v.map(|v| v / edge),
            Space::Contracted(edge) => contract_tangent(centered.map(|v| 2.0 / edge * v), v).map(|t| 0.5 / edge * t),
        }
    }

    /// Gradient of [`Space::normalize`] with respect to its input at `centered`, given the gradient of its output.
    pub fn normalize_backward(self, centered: [f32; 3], d: [f32; 3]) -> [f32; 3] {
        match self {
            Space::Cube(edge) => d.map(|d| d / edge),
            Space::Contracted(edge) => contract_backward(centered.map(|v| 2.0 / edge * v), d).map(|g| 0.5 / edge * g),
        }
    }
}

/// Maps all of space into the ball of radius 2: identity inside the unit ball, else
/// `(2 − 1/‖x‖) x/‖x‖`, with the norm of largest magnitude (`‖·‖∞`) so that the image is a cube.
pub fn contract(x: [f32; 3]) -> [f32; 3] {
    let m = x[0].abs().max(x[1].abs()).max(x[2].abs());
    if m <= 1.0 {
        return x;
    }
    let s = (2.0 - 1.0 / m) / m;
    [x[0] * s, x[1] * s, x[2] * s]
}

/// Inverse of [`contract`] for points inside the cube of half-width 2.
pub fn uncontract(y: [f32; 3]) -> [f32; 3] {
    let m = y[0].abs().max(y[1].abs()).max(y[2].abs());
    if m <= 1.0 {
        return y;
    }
    let s = 1.0 / ((2.0 - m) * m);
    [y[0] * s, y[1] * s, y[2] * s]
}

/// Axis of the largest coordinate, and `s` and `ds/dm` of `y = s(m) x` with `s = 2/m − 1/m²`; none where `m ≤ 1` and `y = x`.
fn stretch(x: [f32; 3]) -> Option<(usize, f32, f32)> {
    let big = (0..3).max_by(|&a, &b| x[a].abs().total_cmp(&x[b].abs())).unwrap_or(0);
    let m = x[big].abs();
    (m > 1.0).then(|| (big, (2.0 - 1.0 / m) / m, -2.0 / (m * m) + 2.0 / (m * m * m)))
}

/// Derivative of [`contract`] at `x` along `v`.
pub fn contract_tangent(x: [f32; 3], v: [f32; 3]) -> [f32; 3] {
    let Some((big, s, slope)) = stretch(x) else { return v };
    let by = x[big].signum() * slope * v[big];
    std::array::from_fn(|k| s * v[k] + by * x[k])
}

/// Gradient of [`contract`] with respect to its input at `x`, given the gradient of its output.
pub fn contract_backward(x: [f32; 3], d: [f32; 3]) -> [f32; 3] {
    let Some((big, s, slope)) = stretch(x) else { return d };
    let mut g = d.map(|d| d * s);
    g[big] += x[big].signum() * slope * (d[0] * x[0] + d[1] * x[1] + d[2] * x[2]);
    g
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_gradient_matches_central_differences() {
        for x in [[0.3, -0.2, 0.9], [1.5, 0.2, -0.7], [-2.0, 3.5, 1.0]] {
            let d = [0.3, -1.1, 0.7];
            let g = contract_backward(x, d);
            for k in 0..3 {
                let at = |h: f32| {
                    let mut x = x;
                    x[k] += h;
                    let y = contract(x);
                    (y[0] * d[0] + y[1] * d[1] + y[2] * d[2]) as f64
                };
                let numeric = (at(1e-2) - at(-1e-2)) / 2e-2;
                assert!((g[k] as f64 - numeric).abs() < 2e-3, "{x:?} {k}: {} {numeric}", g[k]);
            }
            let v = [0.9, 0.2, -0.4];
            let dot = |a: [f32; 3], b: [f32; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
            assert!((dot(contract_tangent(x, v), d) - dot(g, v)).abs() < 1e-5, "{x:?}: tangent and gradient disagree");
        }
    }

    #[test]
    fn contraction_is_invertible_and_bounded() {
        for x in [[0.3, -0.2, 0.9], [4.0, 1.0, -7.0], [0.0, 1000.0, 3.0]] {
            let y = contract(x);
            assert!(y.iter().all(|v| v.abs() < 2.0));
            let z = uncontract(y);
            for k in 0..3 {
                assert!((z[k] - x[k]).abs() <= 1e-2 * x[k].abs().max(1e-3), "{x:?} {z:?}");
            }
        }
    }
}
