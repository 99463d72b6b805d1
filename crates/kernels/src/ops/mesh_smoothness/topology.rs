//! Neighbors of vertices and of faces, found once per mesh.

/// Neighbors in a triangle mesh.
#[derive(Clone, Debug, Default)]
pub struct MeshTopology {
    faces: Vec<[u32; 3]>,
    /// Neighbors of vertex `i`: `neighbors[starts[i]..starts[i + 1]]`, ascending.
    starts: Vec<u32>,
    neighbors: Vec<u32>,
    /// Faces on both sides of each edge that has exactly two.
    pairs: Vec<[u32; 2]>,
    /// Faces across the edges of each face, `u32::MAX` where there is no pair.
    across: Vec<[u32; 3]>,
    /// Corners at vertex `i`, three times the face plus the corner: `corners[corner_starts[i]..corner_starts[i + 1]]`.
    corner_starts: Vec<u32>,
    corners: Vec<u32>,
}

impl MeshTopology {
    /// Of `faces` over `vertices` vertices.
    ///
    /// # Panics
    /// When a corner is not below `vertices`.
    pub fn new(vertices: usize, faces: &[[u32; 3]]) -> MeshTopology {
        assert!(faces.iter().flatten().all(|i| (*i as usize) < vertices), "mesh smoothness: corner beyond {vertices} vertices");
        // Ends of half edges in ascending order, with three times the face plus the edge.
        let mut half: Vec<([u32; 2], u32)> = Vec::with_capacity(faces.len() * 3);
        for (i, f) in faces.iter().enumerate() {
            for k in 0..3 {
                let (a, b) = (f[k], f[(k + 1) % 3]);
                half.push(([a.min(b), a.max(b)], (i * 3 + k) as u32));
            }
        }
        half.sort_unstable();
        let mut both_ways = Vec::new();
        let (mut pairs, mut across) = (Vec::new(), vec![[u32::MAX; 3]; faces.len()]);
        for group in half.chunk_by(|a, b| a.0 == b.0) {
            let [a, b] = group[0].0;
            if a != b {
                both_ways.extend([(a, b), (b, a)]);
            }
            if let [(_, p), (_, q)] = group {
                pairs.push([p / 3, q / 3]);
                across[*p as usize / 3][*p as usize % 3] = q / 3;
                across[*q as usize / 3][*q as usize % 3] = p / 3;
            }
        }
        let (starts, neighbors) = rows(vertices, both_ways);
        let corners = faces.iter().flatten().enumerate().map(|(c, i)| (*i, c as u32)).collect();
        let (corner_starts, corners) = rows(vertices, corners);
        MeshTopology { faces: faces.to_vec(), starts, neighbors, pairs, across, corner_starts, corners }
    }

    /// Number of vertices.
    pub fn vertices(&self) -> usize {
        self.starts.len().saturating_sub(1)
    }

    /// Faces `[F, 3]`.
    pub fn faces(&self) -> &[[u32; 3]] {
        &self.faces
    }

    /// Neighbors of a vertex, ascending.
    pub fn neighbors(&self, vertex: usize) -> &[u32] {
        &self.neighbors[self.starts[vertex] as usize..self.starts[vertex + 1] as usize]
    }

    /// Faces on both sides of each edge that has exactly two.
    pub fn pairs(&self) -> &[[u32; 2]] {
        &self.pairs
    }

    /// Faces across the edges of each face, `u32::MAX` where there is none.
    pub fn across(&self) -> &[[u32; 3]] {
        &self.across
    }

    /// Corners at a vertex: three times the face plus the corner.
    pub fn corners(&self, vertex: usize) -> &[u32] {
        &self.corners[self.corner_starts[vertex] as usize..self.corner_starts[vertex + 1] as usize]
    }
}

/// Second numbers of pairs, by their first, as starts and values.
fn rows(n: usize, mut entries: Vec<(u32, u32)>) -> (Vec<u32>, Vec<u32>) {
    entries.sort_unstable();
    let mut starts = vec![0u32; n + 1];
    entries.iter().for_each(|(i, _)| starts[*i as usize + 1] += 1);
    (0..n).for_each(|i| starts[i + 1] += starts[i]);
    (starts, entries.into_iter().map(|(_, v)| v).collect())
}
