//! Reference matrix product: plain loops in f64.

use super::Matmul;

fn places(s: &Matmul, batch: usize, i: usize, j: usize, p: usize) -> (usize, usize, usize) {
    let a = batch * s.m * s.k + if s.a_transposed { p * s.m + i } else { i * s.k + p };
    let b = batch * s.k * s.n + if s.b_transposed { j * s.k + p } else { p * s.n + j };
    (a, b, (batch * s.m + i) * s.n + j)
}

/// Calls `visit(a, b, c)` with the indices of every product.
fn products(s: &Matmul, mut visit: impl FnMut(usize, usize, usize)) {
    for batch in 0..s.batch {
        for i in 0..s.m {
            for j in 0..s.n {
                for p in 0..s.k {
                    let (a, b, c) = places(s, batch, i, j, p);
                    visit(a, b, c);
                }
            }
        }
    }
}

/// `c = a b`, or `c += a b` with [`Matmul::accumulate`].
pub fn forward(s: &Matmul, a: &[f64], b: &[f64], c: &mut [f64]) {
    if !s.accumulate {
        c.fill(0.0);
    }
    products(s, |i, j, to| c[to] += a[i] * b[j]);
}

/// Gradients of a and b, given the gradient `d` of c.
pub fn backward(s: &Matmul, a: &[f64], b: &[f64], d: &[f64]) -> (Vec<f64>, Vec<f64>) {
    let (mut da, mut db) = (vec![0.0; a.len()], vec![0.0; b.len()]);
    products(s, |i, j, to| {
        da[i] += d[to] * b[j];
        db[j] += d[to] * a[i];
    });
    (da, db)
}
