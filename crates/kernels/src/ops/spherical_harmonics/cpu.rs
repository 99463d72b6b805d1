//! Closed polynomials, up to degree 4.

pub(super) const C1: f32 = 0.488_602_5;
pub(super) const C2: f32 = 1.092_548_4;
pub(super) const C20: f32 = 0.946_174_7;
pub(super) const C22: f32 = 0.546_274_2;
pub(super) const C3: f32 = 0.590_043_6;
pub(super) const C31: f32 = 2.890_611_4;
pub(super) const C32: f32 = 0.457_045_8;
pub(super) const C30: f32 = 0.373_176_33;
pub(super) const C33: f32 = 1.445_305_7;

/// directions `[N, 3]` to out `[N, degree²]`, all of it written.
pub fn forward(degree: usize, dirs: &[f32], out: &mut [f32]) {
    let w = degree * degree;
    for (d, o) in dirs.chunks_exact(3).zip(out.chunks_exact_mut(w)) {
        let [x, y, z] = [d[0], d[1], d[2]];
        o[0] = 0.282_094_8;
        if degree > 1 {
            o[1..4].copy_from_slice(&[-C1 * y, C1 * z, -C1 * x]);
        }
        if degree > 2 {
            o[4..9].copy_from_slice(&[C2 * x * y, -C2 * y * z, C20 * z * z - 0.315_391_57, -C2 * x * z, C22 * (x * x - y * y)]);
        }
        if degree > 3 {
            let (xx, yy, zz) = (x * x, y * y, z * z);
            o[9..16].copy_from_slice(&[
                C3 * y * (yy - 3.0 * xx),
                C31 * x * y * z,
                C32 * y * (1.0 - 5.0 * zz),
                C30 * z * (5.0 * zz - 3.0),
                C32 * x * (1.0 - 5.0 * zz),
                C33 * z * (xx - yy),
                C3 * x * (3.0 * yy - xx),
            ]);
        }
    }
}

/// Gradient of the directions, overwritten.
pub fn backward(degree: usize, dirs: &[f32], d_out: &[f32], g: &mut [f32]) {
    let w = degree * degree;
    for ((d, o), g) in dirs.chunks_exact(3).zip(d_out.chunks_exact(w)).zip(g.chunks_exact_mut(3)) {
        let [x, y, z] = [d[0], d[1], d[2]];
        let (mut gx, mut gy, mut gz) = (0.0, 0.0, 0.0);
        if degree > 1 {
            gx -= C1 * o[3];
            gy -= C1 * o[1];
            gz += C1 * o[2];
        }
        if degree > 2 {
            gx += C2 * (y * o[4] - z * o[7]) + 2.0 * C22 * x * o[8];
            gy += C2 * (x * o[4] - z * o[5]) - 2.0 * C22 * y * o[8];
            gz += -C2 * (y * o[5] + x * o[7]) + 2.0 * C20 * z * o[6];
        }
        if degree > 3 {
            let (xx, yy, zz) = (x * x, y * y, z * z);
            gx += -6.0 * C3 * x * y * o[9]
                + C31 * y * z * o[10]
                + C32 * (1.0 - 5.0 * zz) * o[13]
                + 2.0 * C33 * x * z * o[14]
                + 3.0 * C3 * (yy - xx) * o[15];
            gy += 3.0 * C3 * (yy - xx) * o[9] + C31 * x * z * o[10] + C32 * (1.0 - 5.0 * zz) * o[11] - 2.0 * C33 * y * z * o[14]
                + 6.0 * C3 * x * y * o[15];
            gz += C31 * x * y * o[10] - 10.0 * C32 * y * z * o[11] + C30 * (15.0 * zz - 3.0) * o[12] - 10.0 * C32 * x * z * o[13]
                + C33 * (xx - yy) * o[14];
        }
        g.copy_from_slice(&[gx, gy, gz]);
    }
}
