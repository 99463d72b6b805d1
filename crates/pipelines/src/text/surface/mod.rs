//! The surface of a text region from points of it: cleaned and smoothed points, a plane or a quadric fitted robustly, and the smallest
//! rectangle on it with its pose.

mod cloud;
mod fit;
mod reading;
mod rectangle;
mod smoothing;

pub use cloud::cleaned;
pub use fit::{Kind, Surface, fit};
pub use reading::outlined;
pub use rectangle::{Rectangle, plane_rectangle, rectangle};
pub(in crate::text) use rectangle::{hull, smallest};
pub(in crate::text) use smoothing::principal;
pub use smoothing::smoothed;

/// Points below which nothing is fitted.
pub const LEAST_POINTS: usize = 50;

/// Surfaces to choose from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Wanted {
    /// A quadric where it explains the points much better than a plane.
    #[default]
    Auto,
    Plane,
    Quadric,
}

/// Why points have no surface.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum NoSurface {
    #[error("{0} points, of which at least {LEAST_POINTS} are needed; label a photograph that shows it larger")]
    FewPoints(usize),
    #[error("its points are on one line")]
    Line,
}

#[cfg(test)]
mod tests;
