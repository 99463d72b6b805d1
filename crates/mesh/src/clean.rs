//! Removing what is not the object.

use diorama_geom::Mesh;

/// Keeps connected components that hold at least `share` of the faces of the largest one.
pub fn remove_floaters(mesh: &mut Mesh, share: f32) {
    let mut parent: Vec<u32> = (0..mesh.positions.len() as u32).collect();
    fn root(parent: &mut [u32], mut i: u32) -> u32 {
        while parent[i as usize] != i {
            parent[i as usize] = parent[parent[i as usize] as usize];
            i = parent[i as usize];
        }
        i
    }
    for f in &mesh.faces {
        let a = root(&mut parent, f[0]);
        for &i in &f[1..] {
            let b = root(&mut parent, i);
            parent[b as usize] = a;
        }
    }
    let mut faces = vec![0u32; mesh.positions.len()];
    let roots: Vec<u32> = mesh.faces.iter().map(|f| root(&mut parent, f[0])).collect();
    roots.iter().for_each(|r| faces[*r as usize] += 1);
    let least = (faces.iter().max().copied().unwrap_or(0) as f32 * share).ceil() as u32;
    let mut keep = roots.iter().map(|r| faces[*r as usize] >= least);
    mesh.faces.retain(|_| keep.next().unwrap_or(true));
    mesh.compact();
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn small_islands_go_and_large_ones_stay() {
        // A strip of ten triangles, and one apart.
        let mut m = Mesh::default();
        for i in 0..12 {
            m.positions.push([i as f32 * 0.5, (i % 2) as f32, 0.0]);
        }
        m.faces = (0..10).map(|i| [i, i + 1, i + 2]).collect();
        m.positions.extend([[50.0, 0.0, 0.0], [51.0, 0.0, 0.0], [50.0, 1.0, 0.0]]);
        m.faces.push([12, 13, 14]);
        let mut all = m.clone();
        remove_floaters(&mut all, 0.05);
        assert_eq!(all.faces.len(), 11);
        remove_floaters(&mut m, 0.2);
        assert_eq!((m.faces.len(), m.positions.len()), (10, 12));
    }
}
