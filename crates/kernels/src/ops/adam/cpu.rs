//! In place, parallel over chunks.

use super::Adam;
use crate::math::multiversion;
use rayon::prelude::*;

/// Elements per task, a multiple of [`LINE`].
const CHUNK: usize = 1 << 15;

/// Elements per touched mark.
pub const LINE: usize = crate::ops::hash_grid::cpu::LINE;

#[derive(Clone, Copy)]
struct Factors {
    step: f32,
    root: f32,
}

fn factors(a: &Adam, t: u32) -> Factors {
    let (b1, b2) = (a.beta1 as f64, a.beta2 as f64);
    Factors { step: (a.rate as f64 / (1.0 - b1.powi(t as i32))) as f32, root: (1.0 / (1.0 - b2.powi(t as i32))).sqrt() as f32 }
}

/// One dense step `t ≥ 1`.
pub fn dense(a: &Adam, t: u32, p: &mut [f32], m: &mut [f32], v: &mut [f32], g: &[f32]) {
    assert!(p.len() == m.len() && p.len() == v.len() && p.len() == g.len(), "adam: lengths");
    let f = factors(a, t);
    let chunks = p.par_chunks_mut(CHUNK).zip(m.par_chunks_mut(CHUNK)).zip(v.par_chunks_mut(CHUNK)).zip(g.par_chunks(CHUNK));
    chunks.for_each(|(((p, m), v), g)| {
        for i in 0..p.len() {
            let g = g[i] + a.weight_decay * p[i];
            m[i] = a.beta1 * m[i] + (1.0 - a.beta1) * g;
            v[i] = a.beta2 * v[i] + (1.0 - a.beta2) * g * g;
            p[i] -= f.step * m[i] / (v[i].sqrt() * f.root + a.epsilon);
        }
    });
}

/// One sparse step over the marked lines; clears their gradients and marks.
///
/// # Shapes
/// p, m, v, g: `[N]` with `N` a multiple of [`LINE`]; touched: `[N / LINE]`.
pub fn sparse(a: &Adam, t: u32, p: &mut [f32], m: &mut [f32], v: &mut [f32], g: &mut [f32], touched: &mut [u8]) {
    assert!(p.len() == m.len() && p.len() == v.len() && p.len() == g.len(), "adam: lengths");
    assert_eq!(touched.len() * LINE, p.len(), "adam: marks");
    let f = factors(a, t);
    let params = p.par_chunks_mut(CHUNK).zip(m.par_chunks_mut(CHUNK)).zip(v.par_chunks_mut(CHUNK));
    let chunks = params.zip(g.par_chunks_mut(CHUNK)).zip(touched.par_chunks_mut(CHUNK / LINE));
    chunks.for_each(|((((p, m), v), g), touched)| sparse_chunk(a, f, p, m, v, g, touched));
}

multiversion! {
    fn sparse_chunk(a: &Adam, f: Factors, p: &mut [f32], m: &mut [f32], v: &mut [f32], g: &mut [f32], touched: &mut [u8]) {
        for (line, mark) in touched.iter_mut().enumerate() {
            if *mark == 0 {
                continue;
            }
            *mark = 0;
            let span = line * LINE..(line + 1) * LINE;
            let p: &mut [f32; LINE] = (&mut p[span.clone()]).try_into().expect("a line");
            let m: &mut [f32; LINE] = (&mut m[span.clone()]).try_into().expect("a line");
            let v: &mut [f32; LINE] = (&mut v[span.clone()]).try_into().expect("a line");
            let g: &mut [f32; LINE] = (&mut g[span]).try_into().expect("a line");
            for i in 0..LINE {
                let live = g[i] != 0.0;
                let d = g[i] + a.weight_decay * p[i];
                let m1 = a.beta1 * m[i] + (1.0 - a.beta1) * d;
                let v1 = a.beta2 * v[i] + (1.0 - a.beta2) * d * d;
                let p1 = p[i] - f.step * m1 / (v1.sqrt() * f.root + a.epsilon);
                m[i] = if live { m1 } else { m[i] };
                v[i] = if live { v1 } else { v[i] };
                p[i] = if live { p1 } else { p[i] };
                g[i] = 0.0;
            }
        }
    }
}
