//! Fewer triangles by quadric error (Garland and Heckbert 1997), through meshoptimizer.

use diorama_geom::Mesh;
use meshopt::{SimplifyOptions, VertexDataAdapter};

/// At most `faces` triangles where the shape allows it; a mesh that has no more is left alone.
pub fn simplify(mesh: &mut Mesh, faces: usize) {
    if mesh.faces.len() <= faces {
        return;
    }
    let bytes: Vec<u8> = mesh.positions.iter().flatten().flat_map(|v| v.to_ne_bytes()).collect();
    let Ok(vertices) = VertexDataAdapter::new(&bytes, 12, 0) else { return };
    let kept = meshopt::simplify(mesh.faces.as_flattened(), &vertices, faces * 3, 1e9, SimplifyOptions::None, None);
    mesh.faces = kept.chunks_exact(3).map(|f| [f[0], f[1], f[2]]).collect();
    mesh.compact();
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_flat_grid_shrinks_and_keeps_its_bounds() {
        let n = 40u32;
        let mut m = Mesh::default();
        for i in 0..n * n {
            m.positions.push([(i % n) as f32, (i / n) as f32, 0.0]);
        }
        for y in 0..n - 1 {
            for x in 0..n - 1 {
                let i = y * n + x;
                m.faces.extend([[i, i + 1, i + n], [i + 1, i + n + 1, i + n]]);
            }
        }
        let bounds = m.bounds();
        simplify(&mut m, 100);
        assert!(m.faces.len() <= 100 && !m.faces.is_empty());
        assert_eq!(m.bounds(), bounds);
    }
}
