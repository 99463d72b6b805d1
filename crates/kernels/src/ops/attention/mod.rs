//! Scaled dot product attention, `softmax(Q Kᵀ · scale) V`, of every batch and head (Vaswani et al. 2017). The matrix of weights is made
//! tile by tile and never kept: backward makes it again from the logarithms of its rows' sums (Dao et al. 2022).

pub mod cpu;
pub mod reference;
#[cfg(test)]
mod tests;

/// Shapes of q and the output `[batch, queries, width]`, k and v `[batch, keys, width]`, where batch is batches times heads.
#[derive(Clone, Copy, Debug)]
pub struct Attention {
    pub batch: usize,
    pub queries: usize,
    pub keys: usize,
    pub width: usize,
    /// Usually `1 / √width`.
    pub scale: f32,
    /// Whether query `i` sees keys `0..=i` alone.
    pub causal: bool,
}

impl Attention {
    /// Every query sees every key; the scale is `1 / √width`.
    pub fn new(batch: usize, queries: usize, keys: usize, width: usize) -> Attention {
        Attention { batch, queries, keys, width, scale: 1.0 / (width as f32).sqrt(), causal: false }
    }
}
