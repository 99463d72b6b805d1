//! Count of the arithmetic of products: convolutions, linear layers, attention.

use std::sync::atomic::{AtomicU64, Ordering};

static FLOPS: AtomicU64 = AtomicU64::new(0);

/// Books a forward pass of so many multiply-adds.
pub(crate) fn book(multiply_adds: usize) {
    FLOPS.fetch_add(2 * multiply_adds as u64, Ordering::Relaxed);
}

/// FLOP of all products that ran forward on the CPU since the program began; a multiply-add is two.
pub fn flops() -> u64 {
    FLOPS.load(Ordering::Relaxed)
}
