//! Parallel tasks whose number depends on a problem's size alone, run at the caller's SIMD level, and the parts of slices that they write.

use crate::simd;
use rayon::prelude::*;
use std::cell::Cell;
use std::marker::PhantomData;
use std::ops::Range;

/// Elements below which waking other threads costs more than they save.
const SERIAL: usize = 1 << 14;

/// Calls `work` once for each of `0..n`, in any order. Problems that touch few `elements` stay on this thread.
pub fn run(n: usize, elements: usize, work: impl Fn(usize) + Sync) {
    if n <= 1 || elements < SERIAL {
        return (0..n).for_each(work);
    }
    let level = simd::level();
    (0..n).into_par_iter().for_each(|i| simd::with_level(level, || work(i)));
}

/// A mutable slice whose disjoint parts are written by tasks.
#[derive(Clone, Copy)]
pub struct Parts<'a, T> {
    ptr: *mut T,
    len: usize,
    life: PhantomData<&'a mut [T]>,
}

// SAFETY: parts are handed out by `range` and `chunk`, whose contract forbids overlap.
unsafe impl<T: Send> Send for Parts<'_, T> {}
// SAFETY: as above.
unsafe impl<T: Send> Sync for Parts<'_, T> {}

impl<'a, T> Parts<'a, T> {
    pub fn new(slice: &'a mut [T]) -> Self {
        Parts { ptr: slice.as_mut_ptr(), len: slice.len(), life: PhantomData }
    }

    /// The elements of `range`.
    ///
    /// # Safety
    /// No other live part may overlap it.
    ///
    /// # Panics
    /// When `range` leaves the slice.
    #[allow(clippy::mut_from_ref)]
    pub unsafe fn range(&self, range: Range<usize>) -> &'a mut [T] {
        assert!(range.start <= range.end && range.end <= self.len, "part {range:?} of {}", self.len);
        // SAFETY: inside the slice; disjointness is the caller's promise.
        unsafe { std::slice::from_raw_parts_mut(self.ptr.add(range.start), range.len()) }
    }

    /// Chunk `i` of chunks of `size` elements; the last may be shorter.
    ///
    /// # Safety
    /// No other live part may overlap it.
    #[allow(clippy::mut_from_ref)]
    pub unsafe fn chunk(&self, i: usize, size: usize) -> &'a mut [T] {
        // SAFETY: the caller's promise.
        unsafe { self.range((i * size).min(self.len)..((i + 1) * size).min(self.len)) }
    }
}

thread_local! {
    static BUFFER: Cell<Vec<f32>> = const { Cell::new(Vec::new()) };
}

/// Lends `work` a buffer of `n` floats of any value, which this thread keeps between calls.
pub fn with_buffer<R>(n: usize, work: impl FnOnce(&mut [f32]) -> R) -> R {
    let mut buffer = BUFFER.take();
    if buffer.len() < n {
        buffer.resize(n, 0.0);
    }
    let result = work(&mut buffer[..n]);
    BUFFER.set(buffer);
    result
}

/// Starts to fetch the memory that a reference points to.
#[inline(always)]
pub(crate) fn prefetch<T>(value: &T) {
    #[cfg(target_arch = "x86_64")]
    // SAFETY: a hint, which every x86-64 CPU has.
    unsafe {
        std::arch::x86_64::_mm_prefetch::<{ std::arch::x86_64::_MM_HINT_T0 }>(std::ptr::from_ref(value).cast());
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = value;
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simd::{Level, with_level};
    use std::sync::atomic::{AtomicUsize, Ordering};

    #[test]
    fn every_task_runs_once_at_the_callers_level() {
        for level in Level::available() {
            for elements in [0, SERIAL] {
                let seen: Vec<AtomicUsize> = (0..100).map(|_| AtomicUsize::new(0)).collect();
                with_level(level, || {
                    run(100, elements, |i| {
                        assert_eq!(simd::level(), level);
                        seen[i].fetch_add(1, Ordering::Relaxed);
                    });
                });
                assert!(seen.iter().all(|s| s.load(Ordering::Relaxed) == 1));
            }
        }
    }

    #[test]
    fn chunks_cover_a_slice() {
        let mut values = vec![0; 10];
        let parts = Parts::new(&mut values);
        for i in 0..4 {
            // SAFETY: chunks do not overlap.
            unsafe { parts.chunk(i, 3) }.fill(i + 1);
        }
        assert_eq!(values, [1, 1, 1, 2, 2, 2, 3, 3, 3, 4]);
    }

    #[test]
    fn a_buffer_is_kept() {
        let first = with_buffer(10, |b| b.as_ptr() as usize);
        assert_eq!(first, with_buffer(5, |b| b.as_ptr() as usize));
        assert_eq!(with_buffer(7, |b| b.len()), 7);
    }
}
