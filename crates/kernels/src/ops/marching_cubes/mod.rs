//! Marching cubes (Lorensen and Cline 1987) over slices of a density grid, so that memory stays at two
//! slices. The case table is derived, not typed in: on every face of a cell, each run of inside corners
//! is cut off by one segment, a rule that both cells of a face share, so surfaces have no holes.
//!
//! Vertices lie where the density crosses `level` linearly along an edge, in grid coordinates;
//! triangles wind counter-clockwise seen from the side below `level`.

#[cfg(any(test, feature = "gpu"))]
pub(crate) mod cases;
pub mod cpu;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod reference;
#[cfg(test)]
mod tests;

/// An edge of a cell from one of its corners in a direction; bit `k` of either is a step along axis `k`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Edge {
    pub corner: usize,
    pub direction: usize,
}

/// How cells are cut, here and by marching tetrahedra.
pub struct CaseTable {
    /// Directions of the edges on which vertices lie, ascending.
    pub directions: &'static [usize],
    /// Triangles for each of the 256 sets of inside corners.
    pub triangles: Vec<Vec<[Edge; 3]>>,
}

/// Corners of edge `e`: edge `4 a + i` runs along axis `a`. Corner bit `k` is the step along axis `k`.
fn edge_corners(e: usize) -> (usize, usize) {
    let (a, i) = (e / 4, e % 4);
    let (u, v) = ((a + 1) % 3, (a + 2) % 3);
    let low = ((i & 1) << u) | ((i >> 1) << v);
    (low, low | 1 << a)
}

/// The cases of cubes.
pub fn case_table() -> CaseTable {
    let edge = |e: u8| Edge { corner: edge_corners(e as usize).0, direction: 1 << (e / 4) };
    let triangles = (0..256).map(|inside| triangles_of_case(inside).into_iter().map(|t| t.map(edge)).collect()).collect();
    CaseTable { directions: &[1, 2, 4], triangles }
}

fn edge_between(p: usize, q: usize) -> usize {
    (0..12).find(|&e| edge_corners(e) == (p.min(q), p.max(q))).expect("corners that differ in one bit")
}

fn triangles_of_case(inside: usize) -> Vec<[u8; 3]> {
    // next[e] = f: a segment runs from crossing e to crossing f on some face.
    let mut next = [usize::MAX; 12];
    for axis in 0..3 {
        for side in 0..2 {
            let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
            let corner = |a: usize, b: usize| (side << axis) | (a << u) | (b << v);
            let mut ring = [corner(0, 0), corner(1, 0), corner(1, 1), corner(0, 1)];
            if side == 0 {
                ring.reverse();
            }
            let is_in = |k: usize| inside >> ring[k % 4] & 1 == 1;
            for k in 0..4 {
                if is_in(k) || !is_in(k + 1) {
                    continue;
                }
                let enter = edge_between(ring[k], ring[(k + 1) % 4]);
                let end = (k + 1..k + 4).find(|&m| !is_in(m + 1)).expect("corner k is outside");
                next[enter] = edge_between(ring[end % 4], ring[(end + 1) % 4]);
            }
        }
    }
    let mut used = [false; 12];
    let mut out = Vec::new();
    for start in 0..12 {
        if next[start] == usize::MAX || used[start] {
            continue;
        }
        let mut ring = Vec::new();
        let mut e = start;
        while !used[e] {
            used[e] = true;
            ring.push(e as u8);
            e = next[e];
        }
        cut_ears(ring, &mut out);
    }
    out
}

/// Whether two cell edges lie on one face of the cell.
fn share_a_face(e: u8, f: u8) -> bool {
    let corners = |e: u8| edge_corners(e as usize);
    let ((a, b), (c, d)) = (corners(e), corners(f));
    (0..3).any(|axis| [a, b, c, d].iter().all(|q| q >> axis & 1 == a >> axis & 1))
}

/// Triangulates a ring of crossings. A diagonal within a face of the cell could coincide with one of the
/// neighboring cell and leave an edge with four triangles, so ears are cut along other diagonals while there are any.
fn cut_ears(mut ring: Vec<u8>, out: &mut Vec<[u8; 3]>) {
    while ring.len() > 3 {
        let n = ring.len();
        let ear = (0..n).find(|&i| !share_a_face(ring[(i + n - 1) % n], ring[(i + 1) % n])).unwrap_or(0);
        out.push([ring[(ear + n - 1) % n], ring[ear], ring[(ear + 1) % n]]);
        ring.remove(ear);
    }
    out.push([ring[0], ring[1], ring[2]]);
}
