//! Largest values and means of windows, with PyTorch's rules for borders, and means of whole planes. Means over windows are
//! [`resample`](super::resample) with the table that [`Pool::average`] makes, and adaptive means its area filter.

#[cfg(any(test, feature = "gpu"))]
pub(crate) mod cases;
pub mod cpu;
pub mod reference;
#[cfg(test)]
mod tests;

use super::resample::{Resample, Weights};

/// Windows on planes `[H, W]`; vertical values first.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Pool {
    pub kernel: [usize; 2],
    pub stride: [usize; 2],
    /// At each border, at most half the kernel.
    pub padding: [usize; 2],
    /// Whether a last window that is not full counts, as long as it begins inside the image or the padding before it.
    pub ceil_mode: bool,
}

impl Pool {
    /// `[H', W']` of the output.
    ///
    /// # Panics
    /// When the padding is more than half the kernel, or the padded image smaller than a window.
    pub fn output(&self, from: [usize; 2]) -> [usize; 2] {
        std::array::from_fn(|axis| {
            let (n, k, s, p) = (from[axis], self.kernel[axis], self.stride[axis], self.padding[axis]);
            assert!(2 * p <= k && s > 0 && k > 0, "pool: kernel {k}, stride {s}, padding {p}");
            assert!(n + 2 * p >= k || self.ceil_mode, "pool: {n} pixels for windows of {k}");
            let room = (n + 2 * p).saturating_sub(k);
            let last = if self.ceil_mode { room.div_ceil(s) } else { room / s };
            // A last window that begins behind the image has nothing to read.
            if self.ceil_mode && last > 0 && last * s >= n + p { last } else { last + 1 }
        })
    }

    /// Tables of the means over windows. Padding counts as zeros with `count_padding` (PyTorch's `count_include_pad`).
    pub fn average(&self, from: [usize; 2], count_padding: bool) -> Resample {
        let to = self.output(from);
        let [v, h] =
            [0, 1].map(|i: usize| Weights::windows((self.kernel[i], self.stride[i], self.padding[i]), count_padding, from[i], to[i]));
        Resample::of(v, h)
    }
}
