//! Dropout (Srivastava et al. 2014): element `i` is kept and divided by `1 − p`, or set to 0 with probability `p`, by number
//! `first + i` of a random stream. Backward is the same op on the gradient: nothing is stored.

pub mod cpu;
pub mod reference;
#[cfg(test)]
mod tests;

use diorama_geom::rng::Rng;

/// Which elements drop.
#[derive(Clone, Copy, Debug)]
pub struct Dropout {
    pub rng: Rng,
    /// Counter of the first element.
    pub first: u64,
    /// Probability of 0, in 0..1.
    pub p: f32,
}
