//! Retouching of a text region's frontal views: writing is erased, the light on the surface is measured, and new writing is joined to it.
//!
//! Frontal views show the same rectangle from several directions, so they have one size and share masks. A mask `[H, W]` is true for pixels
//! of glyphs, which are to be erased.

mod edges;
mod noise;
mod patch_field;
pub mod patch_match;
pub mod poisson;
mod shading;
mod sine_transform;
pub mod telea;
mod view_stack;

pub use edges::{blur, edge_width};
pub use noise::{noise_level, with_noise};
pub use shading::{Albedos, Shading};

/// Why a hole cannot be filled.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum CannotFill {
    #[error("there is no view to fill")]
    NoViews,
    #[error("the mask of {mask} pixels and the views do not have the same size; draw the mask on the first view, {width}x{height} pixels")]
    Sizes { mask: usize, width: usize, height: usize },
    #[error(
        "no square of {0}x{0} pixels is free of writing, so there is nothing to copy; widen the margin of the views or erase with `telea`"
    )]
    NothingToCopy(usize),
    #[error("the mask covers every pixel, so there is nothing to continue; widen the margin of the views")]
    NothingKnown,
}

#[cfg(test)]
mod patch_tests;
#[cfg(test)]
mod shading_tests;
#[cfg(test)]
mod tests;
