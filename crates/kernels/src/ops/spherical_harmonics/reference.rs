//! From the definition: derivatives of Legendre polynomials times `Re, Im (x + iy)^m`.

use std::f64::consts::PI;

/// Coefficients of the `m`-th derivative of the Legendre polynomial `P_l`, lowest power first.
fn legendre_derivative(l: usize, m: usize) -> Vec<f64> {
    let (mut prev, mut cur) = (vec![1.0], vec![0.0, 1.0]);
    let mut p = if l == 0 { prev.clone() } else { cur.clone() };
    for k in 2..=l {
        let mut next = vec![0.0; k + 1];
        for (i, c) in cur.iter().enumerate() {
            next[i + 1] += (2 * k - 1) as f64 * c / k as f64;
        }
        for (i, c) in prev.iter().enumerate() {
            next[i] -= (k - 1) as f64 * c / k as f64;
        }
        prev = cur;
        cur = next;
        p = cur.clone();
    }
    for _ in 0..m {
        p = p.iter().enumerate().skip(1).map(|(i, c)| i as f64 * c).collect();
    }
    p
}

fn evaluate(p: &[f64], z: f64) -> f64 {
    p.iter().rev().fold(0.0, |a, c| a * z + c)
}

fn factorial(n: usize) -> f64 {
    (1..=n).map(|i| i as f64).product()
}

/// `Re` or `Im` of `(x + iy)^m`.
fn planar(m: usize, x: f64, y: f64, imaginary: bool) -> f64 {
    let (mut re, mut im) = (1.0, 0.0);
    for _ in 0..m {
        (re, im) = (re * x - im * y, re * y + im * x);
    }
    if imaginary { im } else { re }
}

fn each(degree: usize, mut f: impl FnMut(usize, f64, Vec<f64>, usize, bool)) {
    for l in 0..degree {
        for m in -(l as i64)..=l as i64 {
            let a = m.unsigned_abs() as usize;
            let mut n = ((2 * l + 1) as f64 / (4.0 * PI) * factorial(l - a) / factorial(l + a)).sqrt();
            if a > 0 {
                n *= 2f64.sqrt() * if a % 2 == 1 { -1.0 } else { 1.0 };
            }
            f((l * l + l).wrapping_add_signed(m as isize), n, legendre_derivative(l, a), a, m < 0);
        }
    }
}

/// `[N, 3]` to `[N, degree²]`.
pub fn forward(degree: usize, dirs: &[f64]) -> Vec<f64> {
    let w = degree * degree;
    let mut out = vec![0.0; dirs.len() / 3 * w];
    each(degree, |i, n, p, m, im| {
        for (d, o) in dirs.chunks_exact(3).zip(out.chunks_exact_mut(w)) {
            o[i] = n * evaluate(&p, d[2]) * planar(m, d[0], d[1], im);
        }
    });
    out
}

/// Gradient of the directions, taken as independent coordinates.
pub fn backward(degree: usize, dirs: &[f64], d_out: &[f64]) -> Vec<f64> {
    let w = degree * degree;
    let mut g = vec![0.0; dirs.len()];
    each(degree, |i, n, p, m, im| {
        let slope: Vec<f64> = p.iter().enumerate().skip(1).map(|(i, c)| i as f64 * c).collect();
        for (k, d) in dirs.chunks_exact(3).enumerate() {
            let go = n * d_out[k * w + i];
            if m > 0 {
                // d (x + iy)^m = m (x + iy)^(m−1) (dx + i dy)
                let (re, imag) = (planar(m - 1, d[0], d[1], false), planar(m - 1, d[0], d[1], true));
                let z = evaluate(&p, d[2]) * m as f64;
                let (dx, dy) = if im { (imag, re) } else { (re, -imag) };
                g[k * 3] += go * z * dx;
                g[k * 3 + 1] += go * z * dy;
            }
            g[k * 3 + 2] += go * evaluate(&slope, d[2]) * planar(m, d[0], d[1], im);
        }
    });
    g
}
