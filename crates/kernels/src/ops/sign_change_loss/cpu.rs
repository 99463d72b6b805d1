//! Sums in f64 over chunks, so the value does not depend on threads; the gradient is gathered at the ends of cut edges.

use crate::ops::tetrahedral_surface::{Surface, Topology, cpu::active_in};
use rayon::prelude::*;

/// Elements per task.
const CHUNK: usize = 1 << 12;

/// Value for the surface extracted from `s`, `[V]`.
pub fn value(topology: &Topology, surface: &Surface, s: &[f32]) -> f64 {
    // Of the two ends one is inside.
    let entropy = |x: f32, y: f64| {
        let x = x as f64;
        x.max(0.0) - x * y + (-x.abs()).exp().ln_1p()
    };
    let of = |e: &u32| {
        let [a, b] = topology.edges()[*e as usize].map(|i| i as usize);
        let (inside, outside) = if surface.is_inside(a) { (s[a], s[b]) } else { (s[b], s[a]) };
        entropy(inside, 0.0) + entropy(outside, 1.0)
    };
    let parts: Vec<f64> = surface.cut_edges.par_chunks(CHUNK).map(|part| part.iter().map(of).sum()).collect();
    parts.iter().sum::<f64>() / surface.cut_edges.len().max(1) as f64
}

/// Adds `weight` times the gradient of [`value`] to `d_s`, `[V]`.
///
/// # Panics
/// When the shapes differ.
pub fn backward(topology: &Topology, surface: &Surface, s: &[f32], weight: f32, d_s: &mut [f32]) {
    assert!(s.len() == topology.vertices() && d_s.len() == s.len(), "sign change loss: shapes");
    let scale = weight / surface.cut_edges.len().max(1) as f32;
    d_s.par_chunks_mut(CHUNK).enumerate().for_each(|(c, d_s)| {
        for i in active_in(&surface.active, c * CHUNK..c * CHUNK + d_s.len()) {
            let i = *i as usize;
            let own = surface.is_inside(i);
            let is_cut = |e: &&u32| {
                let [a, b] = topology.edges()[**e as usize].map(|i| i as usize);
                surface.is_inside(if a == i { b } else { a }) != own
            };
            let edges = topology.edges_at(i).iter().filter(is_cut).count() as f32;
            // The other end's sign is the target.
            let target = if own { 0.0 } else { 1.0 };
            d_s[i - c * CHUNK] += scale * edges * (1.0 / (1.0 + (-s[i]).exp()) - target);
        }
    });
}
