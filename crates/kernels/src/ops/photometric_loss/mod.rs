//! How rays' colors are compared with photographs: squared differences, or Huber's (1964).

pub mod cpu;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod reference;
#[cfg(test)]
mod tests;

/// How a color difference `d` counts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ColorLoss {
    /// `d²`
    Mse,
    /// `d² / 2δ` within δ, `|d| − δ/2` beyond.
    Huber(f32),
}
