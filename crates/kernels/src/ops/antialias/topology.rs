//! Which triangles share edges.

use rayon::prelude::*;

/// Per edge of each triangle, the same edge of the other triangle that has it; edge `i` is opposite to corner `i`. Positions do not matter,
/// so that one topology serves for as long as triangles keep their vertices.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Topology {
    /// `3 · triangle + edge`, or [`NONE`], `[F, 3]`.
    twins: Vec<[u32; 3]>,
}

/// Marks edges of one triangle, or of more than two.
const NONE: u32 = u32::MAX;

impl Topology {
    /// Edges with more than two triangles count as edges of a single one.
    ///
    /// # Panics
    /// When there are more than `2³² / 3` triangles.
    pub fn new(triangles: &[[u32; 3]]) -> Topology {
        assert!(triangles.len() < (NONE / 3) as usize, "antialias: too many triangles");
        let of = |f: usize| {
            (0..3).map(move |i| {
                let (a, b) = (triangles[f][(i + 1) % 3], triangles[f][(i + 2) % 3]);
                ((a.min(b), a.max(b)), (3 * f + i) as u32)
            })
        };
        let mut edges: Vec<((u32, u32), u32)> = (0..triangles.len()).flat_map(of).collect();
        edges.par_sort_unstable();
        let mut twins = vec![[NONE; 3]; triangles.len()];
        for shared in edges.chunk_by(|a, b| a.0 == b.0) {
            if let [(_, a), (_, b)] = *shared {
                twins[a as usize / 3][a as usize % 3] = b;
                twins[b as usize / 3][b as usize % 3] = a;
            }
        }
        Topology { twins }
    }

    /// Number of triangles.
    pub fn len(&self) -> usize {
        self.twins.len()
    }

    pub fn is_empty(&self) -> bool {
        self.twins.is_empty()
    }

    /// The triangle that shares edge `i` of a triangle, if exactly one does, and the edge's number there.
    #[inline(always)]
    pub fn across(&self, triangle: usize, i: usize) -> Option<(usize, usize)> {
        let twin = self.twins[triangle][i];
        (twin != NONE).then_some((twin as usize / 3, twin as usize % 3))
    }
}
