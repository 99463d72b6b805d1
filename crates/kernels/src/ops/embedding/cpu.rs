//! Copies of rows; the gradient by ranges of table rows, each of which reads all indices in their order.

use crate::math::multiversion;
use crate::tasks::{self, Parts};

/// Elements per task forward, about.
const BLOCK: usize = 1 << 14;
/// Ranges that the table is cut into backward.
const RANGES: usize = 32;

fn check(rows: usize, d: usize, table: usize, indices: &[i64], out: usize) {
    assert!(table == rows * d && out == indices.len() * d, "embedding: shapes");
    if let Some(i) = indices.iter().find(|i| !(0..rows as i64).contains(i)) {
        panic!("embedding: row {i} of {rows}");
    }
}

/// `out[n] = table[indices[n]]`.
///
/// # Shapes
/// table `[rows, d]`, indices `[N]`, out `[N, d]`.
///
/// # Panics
/// When an index is outside of the table.
pub fn forward(rows: usize, d: usize, table: &[f32], indices: &[i64], out: &mut [f32]) {
    check(rows, d, table.len(), indices, out.len());
    if d == 0 {
        return;
    }
    let (elements, per_task, parts) = (out.len(), (BLOCK / d).max(1), Parts::new(out));
    tasks::run(indices.len().div_ceil(per_task), elements, |task| {
        // SAFETY: each task has a chunk of its own.
        let out = unsafe { parts.chunk(task, per_task * d) };
        for (row, i) in out.chunks_exact_mut(d).zip(&indices[task * per_task..]) {
            row.copy_from_slice(&table[*i as usize * d..][..d]);
        }
    });
}

multiversion! {
    /// Adds the gradients of rows `first..` of the table.
    fn add_range(d: usize, first: usize, indices: &[i64], d_out: &[f32], d_table: &mut [f32]) {
        let rows = (d_table.len() / d) as u64;
        for (n, i) in indices.iter().enumerate() {
            let row = (*i as u64).wrapping_sub(first as u64);
            if row < rows {
                let to = &mut d_table[row as usize * d..][..d];
                to.iter_mut().zip(&d_out[n * d..][..d]).for_each(|(t, g)| *t += g);
            }
        }
    }
}

/// Gradient of the table, overwritten; rows that were not looked up get 0.
///
/// # Shapes
/// indices `[N]`, d_out `[N, d]`, d_table `[rows, d]`.
///
/// # Panics
/// When an index is outside of the table.
pub fn backward(rows: usize, d: usize, indices: &[i64], d_out: &[f32], d_table: &mut [f32]) {
    check(rows, d, d_table.len(), indices, d_out.len());
    if d == 0 {
        return;
    }
    let (elements, per_task, parts) = (d_table.len() + d_out.len(), rows.div_ceil(RANGES).max(1), Parts::new(d_table));
    tasks::run(rows.div_ceil(per_task), elements, |task| {
        // SAFETY: each task has a chunk of its own.
        let d_table = unsafe { parts.chunk(task, per_task * d) };
        d_table.fill(0.0);
        add_range(d, task * per_task, indices, d_out, d_table);
    });
}
