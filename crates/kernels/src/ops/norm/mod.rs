//! Normalization by mean and variance with an affine map and an activation, `y = act(γ (x − μ) / √(σ² + ε) + β)`: batch
//! (Ioffe and Szegedy 2015), group (Wu and He 2018), instance (a group per channel), and layer (Ba et al. 2016).

pub mod cpu;
pub mod layer;
pub mod reference;
#[cfg(test)]
mod tests;

use super::activation::Activation;

/// Set of elements that share a mean and a variance.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Over {
    /// All images and places of a channel; statistics `[C]`.
    Batch,
    /// As [`Over::Batch`], but the statistics are given (inference, frozen layers).
    Given,
    /// Places of the channels of one of so many groups, image by image; statistics `[N, G]`. With as many groups as channels this
    /// is instance normalization.
    Groups(usize),
}

/// Normalization of x `[N, C, L]`, where L is the number of places, such as `H · W`.
#[derive(Clone, Copy, Debug)]
pub struct Norm<'a> {
    pub over: Over,
    pub images: usize,
    pub channels: usize,
    pub places: usize,
    pub epsilon: f32,
    /// `γ [C]`, else 1.
    pub scale: Option<&'a [f32]>,
    /// `β [C]`, else 0.
    pub shift: Option<&'a [f32]>,
    pub activation: Activation,
}

impl Norm<'_> {
    /// Number of means, and of variances.
    pub fn sets(&self) -> usize {
        match self.over {
            Over::Batch | Over::Given => self.channels,
            Over::Groups(groups) => self.images * groups,
        }
    }

    /// Elements that a mean is taken over.
    pub fn count(&self) -> usize {
        match self.over {
            Over::Batch | Over::Given => self.images * self.places,
            Over::Groups(groups) => self.channels / groups.max(1) * self.places,
        }
    }

    /// Elements of x.
    pub fn elements(&self) -> usize {
        self.images * self.channels * self.places
    }
}

/// Layer normalization of rows, x `[M, D]`; `γ` and `β` are `[D]`.
#[derive(Clone, Copy, Debug)]
pub struct LayerNorm<'a> {
    pub width: usize,
    pub epsilon: f32,
    /// `γ [D]`, else 1.
    pub scale: Option<&'a [f32]>,
    /// `β [D]`, else 0.
    pub shift: Option<&'a [f32]>,
    pub activation: Activation,
}

/// Moves running statistics towards those of a batch: `r ← r + momentum (b − r)`, with the unbiased variance as in PyTorch.
///
/// # Shapes
/// all `[C]`; `count` is the number of elements behind a mean.
pub fn update_running(count: usize, momentum: f32, mean: &[f32], variance: &[f32], running_mean: &mut [f32], running_variance: &mut [f32]) {
    assert!(mean.len() == running_mean.len() && variance.len() == running_variance.len(), "norm: running statistics");
    let unbiased = count as f32 / (count as f32 - 1.0);
    for (r, b) in running_mean.iter_mut().zip(mean) {
        *r += momentum * (b - *r);
    }
    for (r, b) in running_variance.iter_mut().zip(variance) {
        *r += momentum * (b * unbiased - *r);
    }
}
