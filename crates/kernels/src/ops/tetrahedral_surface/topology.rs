//! Edges of a tetrahedral grid with static numbers, found once.

use super::EDGES;
use rayon::prelude::*;

/// Tetrahedra, their unique edges, and the edges at each vertex.
#[derive(Clone, Debug, Default)]
pub struct Topology {
    /// Corners of each tetrahedron `[T, 4]`, with positive volume.
    cells: Vec<[u32; 4]>,
    /// Ends of each edge, the lower first, ascending `[E, 2]`.
    edges: Vec<[u32; 2]>,
    /// Edges of each tetrahedron in the order of [`EDGES`], `[T, 6]`.
    cell_edges: Vec<[u32; 6]>,
    /// Edges at vertex `i`: `incident[starts[i]..starts[i + 1]]`.
    starts: Vec<u32>,
    incident: Vec<u32>,
}

impl Topology {
    /// Of tetrahedra with positive volume over `vertices` vertices.
    ///
    /// # Panics
    /// When a corner is not below `vertices`.
    pub fn new(vertices: usize, cells: Vec<[u32; 4]>) -> Topology {
        assert!(cells.par_iter().flatten().all(|i| (*i as usize) < vertices), "tetrahedral surface: corner beyond {vertices} vertices");
        let pair = |cell: &[u32; 4], [a, b]: [usize; 2]| [cell[a].min(cell[b]), cell[a].max(cell[b])];
        let mut edges: Vec<[u32; 2]> = cells.par_iter().flat_map_iter(|c| EDGES.map(|e| pair(c, e))).collect();
        edges.par_sort_unstable();
        edges.dedup();
        edges.shrink_to_fit();
        // First edge of each lower end.
        let mut first = vec![0u32; vertices + 1];
        edges.iter().for_each(|e| first[e[0] as usize + 1] += 1);
        (0..vertices).for_each(|i| first[i + 1] += first[i]);
        let number = |e: [u32; 2]| {
            let (from, to) = (first[e[0] as usize], first[e[0] as usize + 1]);
            let of_end = &edges[from as usize..to as usize];
            from + of_end.partition_point(|o| o[1] < e[1]) as u32
        };
        let cell_edges = cells.par_iter().map(|c| EDGES.map(|e| number(pair(c, e)))).collect();
        let (starts, incident) = incident_edges(vertices, &edges);
        Topology { cells, edges, cell_edges, starts, incident }
    }

    /// Number of vertices.
    pub fn vertices(&self) -> usize {
        self.starts.len().saturating_sub(1)
    }

    /// Corners `[T, 4]`.
    pub fn cells(&self) -> &[[u32; 4]] {
        &self.cells
    }

    /// Ends `[E, 2]`, the lower first, ascending.
    pub fn edges(&self) -> &[[u32; 2]] {
        &self.edges
    }

    /// Edges of each tetrahedron in the order of [`EDGES`], `[T, 6]`.
    pub fn cell_edges(&self) -> &[[u32; 6]] {
        &self.cell_edges
    }

    /// Edges at a vertex.
    pub fn edges_at(&self, vertex: usize) -> &[u32] {
        &self.incident[self.starts[vertex] as usize..self.starts[vertex + 1] as usize]
    }
}

fn incident_edges(vertices: usize, edges: &[[u32; 2]]) -> (Vec<u32>, Vec<u32>) {
    let mut starts = vec![0u32; vertices + 1];
    edges.iter().flatten().for_each(|i| starts[*i as usize + 1] += 1);
    (0..vertices).for_each(|i| starts[i + 1] += starts[i]);
    let (mut next, mut incident) = (starts.clone(), vec![0; edges.len() * 2]);
    for (e, ends) in edges.iter().enumerate() {
        for i in ends {
            incident[next[*i as usize] as usize] = e as u32;
            next[*i as usize] += 1;
        }
    }
    (starts, incident)
}
