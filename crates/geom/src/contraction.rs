//! Scene contraction for unbounded captures (Barron et al. 2022, mip-NeRF 360, eq. 10).

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

#[cfg(test)]
mod tests {
    use super::*;

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
