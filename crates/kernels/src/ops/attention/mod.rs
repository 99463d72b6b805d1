//! Scaled dot-product attention, `softmax(Q Kᵀ · scale) V`, for every batch and head (Vaswani et al. 2017). The weight matrix is computed
//! tile by tile and never stored: the backward pass recomputes it from the log-sum-exp of its rows (FlashAttention, Dao et al. 2022).

pub mod cpu;
pub mod reference;
#[cfg(test)]
mod tests;

/// Description of an attention layer.
///
/// # Shapes
/// q and output `[batch, queries, width]`; k and v `[batch, keys, width]`; `batch` is batch size times heads.
#[derive(Clone, Copy, Debug)]
pub struct Attention {
    pub batch: usize,
    pub queries: usize,
    pub keys: usize,
    pub width: usize,
    /// Factor of the scores, usually `1 / √width`.
    pub scale: f32,
    /// Whether query `i` sees only keys `0..=i`.
    pub causal: bool,
}

impl Attention {
    /// Attention without a mask, with scale `1 / √width`.
    pub fn new(batch: usize, queries: usize, keys: usize, width: usize) -> Attention {
        Attention { batch, queries, keys, width, scale: 1.0 / (width as f32).sqrt(), causal: false }
    }
}
