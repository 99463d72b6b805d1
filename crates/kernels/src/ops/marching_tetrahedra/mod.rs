//! Marching tetrahedra (Doi and Koide 1991): each cell is six tetrahedra around its diagonal (Kuhn's division, which agrees on the faces
//! that cells share). There are no ambiguous cases, at some twice the triangles of marching cubes.
//!
//! Vertices lie where the density crosses `level` linearly along an edge, in grid coordinates; triangles wind counter-clockwise seen
//! from the side below `level`. The meshers of [`super::marching_cubes`] work with this table.

#[cfg(feature = "gpu")]
pub use super::marching_cubes::gpu;
pub mod reference;
#[cfg(test)]
mod tests;
pub use super::marching_cubes::cpu;

use super::marching_cubes::{CaseTable, Edge};

/// The surfaces of [`super::marching_cubes::cases`].
///
/// # Errors
/// When the device is lost.
#[cfg(feature = "gpu")]
pub(crate) fn check(gpu: &crate::gpu::Gpu, table: &mut crate::gpu::table::Table) -> Result<(), crate::gpu::GpuError> {
    super::marching_cubes::cases::check_surface(gpu, table, "marching tetrahedra", &case_table())
}

/// Corners of the six tetrahedra; bit `k` of a corner is the step along axis `k`.
pub const TETRAHEDRA: [[usize; 4]; 6] = [[0, 1, 3, 7], [0, 1, 5, 7], [0, 2, 3, 7], [0, 2, 6, 7], [0, 4, 5, 7], [0, 4, 6, 7]];

/// The cases of cells that are cut tetrahedron by tetrahedron.
pub fn case_table() -> CaseTable {
    let of = |inside: usize| TETRAHEDRA.iter().flat_map(|t| triangles(*t, inside)).collect();
    CaseTable { directions: &[1, 2, 3, 4, 5, 6, 7], triangles: (0..256).map(of).collect() }
}

fn triangles(corners: [usize; 4], inside: usize) -> Vec<[Edge; 3]> {
    let places = corners.map(|c| [0, 1, 2].map(|k| (c >> k & 1) as f32));
    // The corners of a tetrahedron are nested sets of bits.
    let edge = |[a, b]: [usize; 2]| Edge { corner: corners[a.min(b)], direction: corners[a] ^ corners[b] };
    cut(places, corners.map(|c| inside >> c & 1 == 1)).into_iter().map(|t| t.map(edge)).collect()
}

/// Triangles of the surface in a tetrahedron, counter-clockwise seen from outside; each vertex is named by the corners of its edge.
pub(crate) fn cut(places: [[f32; 3]; 4], inside: [bool; 4]) -> Vec<[[usize; 2]; 3]> {
    let (within, without): (Vec<usize>, Vec<usize>) = (0..4).partition(|c| inside[*c]);
    let found = match (&within[..], &without[..]) {
        (&[a], &[b, c, d]) | (&[b, c, d], &[a]) => vec![[[a, b], [a, c], [a, d]]],
        (&[a, b], &[c, d]) => vec![[[a, c], [a, d], [b, d]], [[a, c], [b, d], [b, c]]],
        _ => Vec::new(),
    };
    let middle = |c: &[usize]| [0, 1, 2].map(|k| c.iter().map(|c| places[*c][k]).sum::<f32>() / c.len().max(1) as f32);
    let outward = diorama_geom::mesh::sub(middle(&without), middle(&within));
    let faces_outward = |t: &[[usize; 2]; 3]| {
        let [p, q, r] = t.map(|e| middle(&e));
        let n = diorama_geom::mesh::cross(diorama_geom::mesh::sub(q, p), diorama_geom::mesh::sub(r, p));
        (0..3).map(|k| n[k] * outward[k]).sum::<f32>() > 0.0
    };
    found.into_iter().map(|t| if faces_outward(&t) { t } else { [t[0], t[2], t[1]] }).collect()
}
