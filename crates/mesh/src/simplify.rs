//! Simplifies meshes by quadric error (Garland and Heckbert 1997), through meshoptimizer.

use diorama_geom::Mesh;
use meshopt::{SimplifyOptions, VertexDataAdapter};

/// How a mesh was reduced to the requested number of faces.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reduction {
    /// It had no more faces.
    None,
    /// Edges were collapsed; all parts remain.
    Collapsed,
    /// Small parts were removed too.
    Pruned,
    /// Vertices were clustered regardless of connectivity, because the topology allows no fewer faces.
    Clustered,
}

/// Reduces a mesh to at most `faces` triangles.
///
/// # Errors
/// The fewest triangles that the mesh can have, if `faces` is less; the mesh is unchanged then.
pub fn simplify(mesh: &mut Mesh, faces: usize) -> Result<Reduction, usize> {
    if mesh.faces.len() <= faces {
        return Ok(Reduction::None);
    }
    let bytes: Vec<u8> = mesh.positions.iter().flatten().flat_map(|v| v.to_ne_bytes()).collect();
    let vertices = VertexDataAdapter::new(&bytes, 12, 0).map_err(|_| mesh.faces.len())?;
    let all = mesh.faces.as_flattened();
    let collapsed = |options| meshopt::simplify(all, &vertices, faces * 3, 1e9, options, None);
    let clustered = || meshopt::simplify_sloppy(all, &vertices, faces * 3, 1e9, None);
    let mut fewest = mesh.faces.len();
    for how in [Reduction::Collapsed, Reduction::Pruned, Reduction::Clustered] {
        let kept = match how {
            Reduction::Pruned => collapsed(SimplifyOptions::Prune),
            Reduction::Clustered => clustered(),
            _ => collapsed(SimplifyOptions::None),
        };
        let count = kept.len() / 3;
        if (1..=faces).contains(&count) {
            mesh.faces = kept.as_chunks::<3>().0.to_vec();
            mesh.compact();
            return Ok(how);
        }
        if count > 0 {
            fewest = fewest.min(count);
        }
    }
    Err(fewest)
}

/// Collapses edges until `faces` triangles are left, while vertices on open borders and seams of the texture stay in place. Returns the number
/// of triangles, which is higher where borders and topology allow no fewer. Only positions of existing vertices are used, so that texture
/// coordinates stay valid.
pub fn collapse(mesh: &mut Mesh, faces: usize) -> usize {
    let bytes: Vec<u8> = mesh.positions.iter().flatten().flat_map(|v| v.to_ne_bytes()).collect();
    if let Ok(vertices) = VertexDataAdapter::new(&bytes, 12, 0)
        && mesh.faces.len() > faces
    {
        let kept = meshopt::simplify(mesh.faces.as_flattened(), &vertices, faces * 3, 1e9, SimplifyOptions::LockBorder, None);
        mesh.faces = kept.as_chunks::<3>().0.to_vec();
        mesh.compact();
    }
    mesh.faces.len()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grid(n: u32) -> Mesh {
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
        m
    }

    /// An octahedron with a given size and position.
    fn octahedron(m: &mut Mesh, center: [f32; 3], radius: f32) {
        let first = m.positions.len() as u32;
        for k in 0..3 {
            for sign in [radius, -radius] {
                let mut p = center;
                p[k] += sign;
                m.positions.push(p);
            }
        }
        let [x, nx, y, ny, z, nz] = std::array::from_fn(|i| first + i as u32);
        m.faces.extend([[x, y, z], [y, nx, z], [nx, ny, z], [ny, x, z], [y, x, nz], [nx, y, nz], [ny, nx, nz], [x, ny, nz]]);
    }

    #[test]
    fn a_flat_grid_shrinks_and_keeps_its_bounds() {
        let mut m = grid(40);
        let bounds = m.bounds();
        assert_eq!(simplify(&mut m, 100), Ok(Reduction::Collapsed));
        assert!(m.faces.len() <= 100 && !m.faces.is_empty());
        assert_eq!(m.bounds(), bounds);
        let same = m.clone();
        assert_eq!(simplify(&mut m, 100), Ok(Reduction::None));
        assert_eq!(m, same);
    }

    #[test]
    fn vertices_on_the_border_stay() {
        let mut m = grid(40);
        // Waves, and a border that is not straight.
        m.positions.iter_mut().for_each(|p| *p = [p[0] + 0.3 * (p[1] * 1.3).sin(), p[1] + 0.3 * (p[0] * 1.7).sin(), (0.3 * p[0]).sin()]);
        let border = |m: &Mesh| {
            let mut edges = std::collections::HashMap::<[u32; 2], usize>::new();
            m.faces.iter().flat_map(|f| (0..3).map(|k| [f[k].min(f[(k + 1) % 3]), f[k].max(f[(k + 1) % 3])])).for_each(|e| {
                *edges.entry(e).or_default() += 1;
            });
            let open = edges.into_iter().filter(|(_, n)| *n == 1).flat_map(|(e, _)| e);
            open.map(|i| m.positions[i as usize].map(f32::to_bits)).collect::<std::collections::BTreeSet<_>>()
        };
        let before = border(&m);
        assert_eq!(before.len(), 4 * 39);
        let left = collapse(&mut m, 700);
        assert!(left <= 700 && left == m.faces.len(), "{left}");
        assert_eq!(border(&m), before);
        // The border alone needs as many.
        assert!(collapse(&mut m, 10) >= 154);
    }

    #[test]
    fn no_more_faces_than_asked_even_where_topology_forbids_collapses() {
        // A thousand separate solids, which edge collapses cannot reduce further.
        let mut m = Mesh::default();
        for i in 0..1000 {
            octahedron(&mut m, [(i % 10) as f32, (i / 10 % 10) as f32, (i / 100) as f32], 0.3);
        }
        for faces in [2000, 500, 60] {
            let mut reduced = m.clone();
            let how = simplify(&mut reduced, faces);
            assert!(how.is_ok_and(|h| h != Reduction::None), "{faces}: {how:?}");
            assert!((1..=faces).contains(&reduced.faces.len()), "{faces}: {}", reduced.faces.len());
        }
        // Sheets that share one edge, which fixes all of them.
        let mut fan = Mesh { positions: vec![[0.0; 3], [0.0, 0.0, 1.0]], ..Mesh::default() };
        for i in 0..64 {
            let a = i as f32 * 0.098;
            fan.positions.push([a.cos(), a.sin(), 0.5]);
            fan.faces.push([0, 1, 2 + i]);
        }
        match simplify(&mut fan, 10) {
            Ok(_) => assert!((1..=10).contains(&fan.faces.len())),
            Err(fewest) => assert!(fewest > 10 && fan.faces.len() == 64),
        }
    }

    #[test]
    fn what_cannot_be_reached_is_said_and_changes_nothing() {
        let mut m = Mesh::default();
        octahedron(&mut m, [0.0; 3], 1.0);
        let same = m.clone();
        match simplify(&mut m, 1) {
            Ok(_) => assert_eq!(m.faces.len(), 1),
            Err(fewest) => assert!(fewest > 1 && m == same),
        }
    }
}
