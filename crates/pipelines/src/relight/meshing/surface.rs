//! From an extracted surface to one that photographs support, with as many faces as asked.

use diorama_geom::{Camera, Mesh, Pose};
use diorama_mesh::{clean, repair, simplify};
use serde::Serialize;

/// Training cameras that must see a face.
const SEEN_BY: usize = 3;
/// Components with a smaller share of the area are removed.
const SMALL: f64 = 1e-3;
/// Error of the surface in cells, for visibility.
pub(super) const SLACK: f32 = 1.5;

/// Faces removed, by reason.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Removed {
    /// Seen by fewer than three training cameras.
    pub unseen: usize,
    /// In components with less than 0.1 % of the area.
    pub small: usize,
}

/// Removes what fewer than three cameras see, and components with less than 0.1 % of the area; `cell` is the edge of a grid cell.
pub fn clean(mesh: &mut Mesh, cameras: &[(Camera, Pose)], cell: f32) -> Removed {
    // Floaters go first where they are small, because they hide what is behind them.
    let small = clean::remove_small_area(mesh, SMALL);
    let unseen = clean::remove_rarely_seen(mesh, cameras, SEEN_BY, SLACK * cell);
    Removed { unseen, small: small + clean::remove_small_area(mesh, SMALL) }
}

/// Reduces a surface to `target` faces, open borders held; returns a note where they allow no fewer.
pub fn reduce(mesh: &mut Mesh, target: usize) -> Option<String> {
    repair::weld(mesh);
    let left = simplify::collapse(mesh, target);
    (left > target).then(|| format!("{left} faces instead of {target}: so many its open borders and its topology need"))
}
