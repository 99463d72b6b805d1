//! Triangle meshes.

use crate::ImageU8;

/// An indexed triangle mesh; faces wind counter-clockwise seen from outside.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Mesh {
    pub positions: Vec<[f32; 3]>,
    /// Unit normals, one per vertex, or empty.
    pub normals: Vec<[f32; 3]>,
    /// sRGB colors in [0, 1], one per vertex, or empty.
    pub colors_srgb: Vec<[f32; 3]>,
    /// Texture coordinates, one per vertex, or empty: u to the right, v down; the texture covers `[0, 1]²`.
    pub uvs: Vec<[f32; 2]>,
    /// sRGB texture, `[H, W, 3]`.
    pub texture: Option<ImageU8>,
    /// Unit vectors along u, and the sign for which `sign · (normal × tangent)` points against v; one per vertex, or empty.
    pub tangents: Vec<[f32; 4]>,
    /// Normals in tangent space, `(n + 1) / 2`, `[H, W, 3]`: x along u, y against v, z outward.
    pub normal_map: Option<ImageU8>,
    pub faces: Vec<[u32; 3]>,
}

impl Mesh {
    /// Lowest and highest corner; `None` without vertices.
    pub fn bounds(&self) -> Option<([f32; 3], [f32; 3])> {
        let first = *self.positions.first()?;
        Some(
            self.positions
                .iter()
                .fold((first, first), |(lo, hi), p| (std::array::from_fn(|k| lo[k].min(p[k])), std::array::from_fn(|k| hi[k].max(p[k])))),
        )
    }

    /// Whether every edge is shared by exactly two faces that traverse it in opposite directions.
    pub fn is_watertight(&self) -> bool {
        let mut edges = std::collections::HashMap::<(u32, u32), i32>::new();
        for f in &self.faces {
            for k in 0..3 {
                *edges.entry((f[k], f[(k + 1) % 3])).or_default() += 1;
            }
        }
        !self.faces.is_empty() && edges.iter().all(|(&(a, b), &n)| n == 1 && edges.get(&(b, a)) == Some(&1))
    }

    /// Enclosed volume of a closed mesh; negative if its faces point inward.
    pub fn volume(&self) -> f64 {
        let of = |f: &[u32; 3]| {
            let [a, b, c] = f.map(|i| glam::DVec3::from(self.positions[i as usize].map(f64::from)));
            a.dot(b.cross(c)) / 6.0
        };
        self.faces.iter().map(of).sum()
    }

    /// Area-weighted vertex normals; vertices without area get +z.
    pub fn compute_normals(&mut self) {
        let mut sum = vec![[0.0f32; 3]; self.positions.len()];
        for f in &self.faces {
            let [a, b, c] = f.map(|i| self.positions[i as usize]);
            let n = cross(sub(b, a), sub(c, a));
            for &i in f {
                for k in 0..3 {
                    sum[i as usize][k] += n[k];
                }
            }
        }
        self.normals = sum
            .into_iter()
            .map(|n| {
                let l = (n[0] * n[0] + n[1] * n[1] + n[2] * n[2]).sqrt();
                if l > 1e-20 { n.map(|v| v / l) } else { [0.0, 0.0, 1.0] }
            })
            .collect();
    }

    /// Keeps only vertices that faces use, in the order of their first use.
    pub fn compact(&mut self) {
        let mut new_index = vec![u32::MAX; self.positions.len()];
        let mut kept = Vec::new();
        for f in &mut self.faces {
            for i in f.iter_mut() {
                if new_index[*i as usize] == u32::MAX {
                    new_index[*i as usize] = kept.len() as u32;
                    kept.push(*i as usize);
                }
                *i = new_index[*i as usize];
            }
        }
        let pick = |v: &Vec<[f32; 3]>| if v.is_empty() { Vec::new() } else { kept.iter().map(|&i| v[i]).collect() };
        if !self.uvs.is_empty() {
            self.uvs = kept.iter().map(|&i| self.uvs[i]).collect();
        }
        if !self.tangents.is_empty() {
            self.tangents = kept.iter().map(|&i| self.tangents[i]).collect();
        }
        self.positions = pick(&self.positions);
        self.normals = pick(&self.normals);
        self.colors_srgb = pick(&self.colors_srgb);
    }
}

/// `a − b`.
pub fn sub(a: [f32; 3], b: [f32; 3]) -> [f32; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

/// Cross product `a × b`.
pub fn cross(a: [f32; 3], b: [f32; 3]) -> [f32; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tetrahedron() -> Mesh {
        Mesh {
            positions: vec![[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            faces: vec![[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]],
            ..Mesh::default()
        }
    }

    #[test]
    fn watertight_needs_every_face() {
        let mut m = tetrahedron();
        assert!(m.is_watertight() && (m.volume() - 1.0 / 6.0).abs() < 1e-12);
        m.faces.pop();
        assert!(!m.is_watertight());
    }

    #[test]
    fn normals_point_outward_and_compaction_drops_strays() {
        let mut m = tetrahedron();
        m.positions.insert(0, [9.0; 3]);
        m.faces.iter_mut().flatten().for_each(|i| *i += 1);
        m.compact();
        m.compute_normals();
        assert_eq!(m.positions.len(), 4);
        let origin = m.positions.iter().position(|p| *p == [0.0; 3]).unwrap();
        assert!(m.normals[origin].iter().all(|&v| v < 0.0));
    }
}
