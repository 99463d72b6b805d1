//! Plain loops in f64.

use super::{KEPT, cell_at};

/// A ray's image, place in shares of the image's width and height, and squared error.
#[derive(Clone, Copy, Debug)]
pub struct Hit {
    pub image: usize,
    pub u: f32,
    pub v: f32,
    pub error: f32,
}

/// Errors after rays are mixed in one after the other.
pub fn record(errors: &[f32], hits: &[Hit]) -> Vec<f64> {
    let mut out: Vec<f64> = errors.iter().map(|e| *e as f64).collect();
    for h in hits {
        let e = &mut out[cell_at(h.image, h.u, h.v)];
        *e = KEPT as f64 * *e + 0.1 * h.error as f64;
    }
    out
}

/// Errors after rays without an order: those of a cell count as so many rays of their mean error.
pub fn record_means(errors: &[f32], hits: &[Hit]) -> Vec<f64> {
    let mut of_cells = vec![Vec::new(); errors.len()];
    hits.iter().for_each(|h| of_cells[cell_at(h.image, h.u, h.v)].push(h.error as f64));
    let mixed = |(e, hits): (&f32, &Vec<f64>)| {
        let mean = hits.iter().sum::<f64>() / hits.len().max(1) as f64;
        hits.iter().fold(*e as f64, |e, _| KEPT as f64 * e + (1.0 - KEPT as f64) * mean)
    };
    errors.iter().zip(&of_cells).map(mixed).collect()
}

/// Sums of the errors' roots up to each cell.
pub fn cdf(drawn: &[f32]) -> Vec<f64> {
    let mut sum = 0.0;
    let add = |e: &f32| {
        sum += (*e as f64).sqrt();
        sum
    };
    drawn.iter().map(add).collect()
}
