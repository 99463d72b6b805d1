//! Samples without an occupancy grid: one at a random place of each of `n` equal intervals between near and far (NeRF, eq. 2), and `m` more
//! where a coarse pass found matter. A sample's interval reaches from midpoint to midpoint between neighboring places.

#[cfg(any(test, feature = "gpu"))]
pub(crate) mod cases;
pub mod cpu;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod reference;
#[cfg(test)]
mod tests;

use diorama_geom::rng::Rng;

/// Random numbers of the places, and the rays drawn before; without them, places are the middles of their intervals.
pub type Jitter = Option<(Rng, u64)>;
