//! Volume rendering by quadrature (Max 1995; NeRF eq. 3) over packed samples:
//! `w_i = T_i (1 − e^{−σ_i δ_i})`, `T_{i+1} = T_i e^{−σ_i δ_i}`, `Ĉ = Σ w_i c_i + T_out · background`.

#[cfg(any(test, feature = "gpu"))]
pub(crate) mod cases;
pub mod cpu;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod reference;
#[cfg(test)]
pub(crate) mod tests;

/// Most channels per sample.
pub const MAX_CHANNELS: usize = 512;

/// Packed samples along rays: ray `r` owns samples `offsets[r]..offsets[r + 1]`, in order.
#[derive(Clone, Copy, Debug)]
pub struct Packed<'a> {
    /// `[R + 1]`
    pub offsets: &'a [u32],
    /// Start of each interval, `[S]`.
    pub t: &'a [f32],
    /// Length of each interval, `[S]`.
    pub dt: &'a [f32],
}

impl<'a> Packed<'a> {
    pub fn rays(&self) -> usize {
        self.offsets.len().saturating_sub(1)
    }

    pub fn samples(&self) -> usize {
        self.t.len()
    }

    /// Samples of ray `r`.
    pub fn range(&self, r: usize) -> std::ops::Range<usize> {
        self.offsets[r] as usize..self.offsets[r + 1] as usize
    }
}

/// What compositing gives per ray and per sample.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Composited<T> {
    /// `[R, C]`
    pub color: Vec<T>,
    /// `Σ w_i (t_i + δ_i / 2)`, `[R]`: divide by opacity for the expected depth.
    pub depth: Vec<T>,
    /// `Σ w_i = 1 − T_out`, `[R]`
    pub opacity: Vec<T>,
    /// `[S]`
    pub weights: Vec<T>,
}
