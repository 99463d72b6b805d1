//! Slice by slice with shared vertices.

use super::{case_table, edge_corners};

const NONE: u32 = u32::MAX;

/// Collects a surface from slices of density pushed in order of z.
pub struct Mesher {
    nx: usize,
    ny: usize,
    level: f32,
    table: Vec<Vec<[u8; 3]>>,
    z: usize,
    below: Slice,
    /// Vertex positions in grid coordinates (x, y, z).
    pub positions: Vec<[f32; 3]>,
    pub faces: Vec<[u32; 3]>,
}

#[derive(Default)]
struct Slice {
    values: Vec<f32>,
    /// Vertices on the slice's x and y edges.
    x_edges: Vec<u32>,
    y_edges: Vec<u32>,
}

impl Mesher {
    /// For slices of `ny` rows of `nx` values.
    pub fn new(nx: usize, ny: usize, level: f32) -> Self {
        Mesher { nx, ny, level, table: case_table(), z: 0, below: Slice::default(), positions: Vec::new(), faces: Vec::new() }
    }

    /// Adds the next slice, `[ny, nx]`.
    ///
    /// # Panics
    /// When the slice has another size, or more than 2³² − 1 vertices arise.
    pub fn push(&mut self, values: &[f32]) {
        assert_eq!(values.len(), self.nx * self.ny, "marching cubes: slice");
        let (nx, ny, z, level) = (self.nx, self.ny, self.z, self.level);
        let mut above = Slice { values: values.to_vec(), x_edges: vec![NONE; nx * ny], y_edges: vec![NONE; nx * ny] };
        let mut z_edges = vec![NONE; if z > 0 { nx * ny } else { 0 }];
        let positions = &mut self.positions;
        let mut vertex = |a: f32, b: f32, base: [f32; 3], axis: usize| {
            if (a > level) == (b > level) {
                return NONE;
            }
            let mut p = base;
            p[axis] += (level - a) / (b - a);
            positions.push(p);
            u32::try_from(positions.len() - 1).expect("fewer than 2^32 vertices")
        };
        for y in 0..ny {
            for x in 0..nx {
                let i = y * nx + x;
                let base = [x as f32, y as f32, z as f32];
                if x + 1 < nx {
                    above.x_edges[i] = vertex(values[i], values[i + 1], base, 0);
                }
                if y + 1 < ny {
                    above.y_edges[i] = vertex(values[i], values[i + nx], base, 1);
                }
                if z > 0 {
                    z_edges[i] = vertex(self.below.values[i], values[i], [base[0], base[1], base[2] - 1.0], 2);
                }
            }
        }
        if z > 0 {
            self.connect(&above, &z_edges);
        }
        self.below = above;
        self.z += 1;
    }

    fn connect(&mut self, above: &Slice, z_edges: &[u32]) {
        let nx = self.nx;
        for y in 0..self.ny.saturating_sub(1) {
            for x in 0..nx.saturating_sub(1) {
                let i = y * nx + x;
                let slices = [&self.below, above];
                let mut inside = 0;
                for c in 0..8 {
                    let v = slices[c >> 2].values[i + (c & 1) + nx * ((c >> 1) & 1)];
                    inside |= ((v > self.level) as usize) << c;
                }
                for t in &self.table[inside] {
                    self.faces.push(t.map(|e| {
                        let (c, _) = edge_corners(e as usize);
                        let at = i + (c & 1) + nx * ((c >> 1) & 1);
                        match e / 4 {
                            0 => slices[c >> 2].x_edges[at],
                            1 => slices[c >> 2].y_edges[at],
                            _ => z_edges[at],
                        }
                    }));
                }
            }
        }
    }
}
