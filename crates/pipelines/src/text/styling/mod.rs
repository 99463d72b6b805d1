//! Seasons and climates for rendered images: colors and detail take the moments of a style, and structure that many views share, and text,
//! keep their detail.
//!
//! The result is `(1 − m)·stylized + m·recolored`, where m protects ([`mask`]), and both images come from one [`Transfer`], whose statistics
//! are those of a whole scene, so that views do not flicker.

pub mod haar;
pub mod mask;
pub mod presets;
pub mod style;
pub mod transfer;

pub use mask::{MaskMode, blend, importance, protection};
pub use presets::Preset;
pub use style::Style;
pub use transfer::{Moments, Transfer};

#[cfg(test)]
mod tests;
