//! Closes meshes: merges vertices with equal positions, separates edges with more than two faces, fills holes.

use diorama_geom::Mesh;
use diorama_geom::mesh::{cross, sub};
use std::collections::HashMap;

/// Merges vertices with equal positions and drops faces that become degenerate. A closed mesh stays closed.
pub fn weld(mesh: &mut Mesh) {
    let mut first = HashMap::new();
    let at: Vec<u32> = mesh
        .positions
        .iter()
        .enumerate()
        // Adding zero turns −0 into 0.
        .map(|(i, p)| *first.entry(p.map(|v| (v + 0.0).to_bits())).or_insert(i as u32))
        .collect();
    mesh.faces.iter_mut().flatten().for_each(|i| *i = at[*i as usize]);
    mesh.faces.retain(|f| f[0] != f[1] && f[1] != f[2] && f[0] != f[2]);
    remove_folded_faces(mesh);
    mesh.compact();
}

/// Removes pairs of faces on the same three vertices with opposite orientation; they enclose nothing.
fn remove_folded_faces(mesh: &mut Mesh) {
    let mut balance: HashMap<[u32; 3], i32> = HashMap::new();
    let key = |f: &[u32; 3]| {
        let mut k = *f;
        k.sort_unstable();
        let least = (0..3).min_by_key(|i| f[*i]).unwrap_or(0);
        // Orientation of the face.
        (k, if f[(least + 1) % 3] == k[1] { 1 } else { -1 })
    };
    for f in &mesh.faces {
        let (k, way) = key(f);
        *balance.entry(k).or_default() += way;
    }
    mesh.faces.retain(|f| {
        let (k, way) = key(f);
        match balance.get_mut(&k) {
            Some(b) if *b != 0 && b.signum() == way => {
                *b -= way;
                true
            }
            _ => false,
        }
    });
}

/// Most rounds of [`close`].
const ROUNDS: usize = 8;
/// Separated parts that touch are shrunk by this share of their edge length, so that readers that merge vertices by position keep them
/// separate.
const SHRINK: f32 = 2e-3;

/// Closes a mesh; returns whether it is watertight then. Edges with more than two faces are split so that each solid beside them is
/// separate, and holes are filled with fans around their center.
pub fn close(mesh: &mut Mesh) -> bool {
    weld(mesh);
    for _ in 0..ROUNDS {
        if mesh.is_watertight() {
            return true;
        }
        separate_fans(mesh);
        fill_holes(mesh);
        split_shared_edges(mesh);
    }
    mesh.is_watertight()
}

/// Half edges by their end vertices: three times the face index plus the corner where each starts.
fn half_edges(mesh: &Mesh) -> HashMap<(u32, u32), Vec<u32>> {
    let mut by_ends: HashMap<(u32, u32), Vec<u32>> = HashMap::new();
    for (i, f) in mesh.faces.iter().enumerate() {
        (0..3).for_each(|k| by_ends.entry((f[k], f[(k + 1) % 3])).or_default().push((i * 3 + k) as u32));
    }
    by_ends
}

/// Face normal with twice the face's area as length.
fn normal(mesh: &Mesh, face: usize) -> [f32; 3] {
    let [a, b, c] = mesh.faces[face].map(|i| mesh.positions[i as usize]);
    cross(sub(b, a), sub(c, a))
}

fn length(v: [f32; 3]) -> f32 {
    (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt()
}

/// Some edges with several pairs of faces cannot be separated at their ends. They get one additional vertex per pair.
fn split_shared_edges(mesh: &mut Mesh) {
    let by_ends = half_edges(mesh);
    let mut touched = vec![false; mesh.faces.len()];
    let mut edges: Vec<_> = by_ends.iter().filter(|((a, b), c)| a < b && c.len() > 1).collect();
    edges.sort_unstable();
    let mut added = Vec::new();
    for (&(a, b), forth) in edges {
        let Some(back) = by_ends.get(&(b, a)) else { continue };
        for (x, y) in pairs(mesh, (a, b), forth, back) {
            let (f, g) = (x as usize / 3, y as usize / 3);
            // Edges of faces that were split in this round wait for the next.
            if touched[f] || touched[g] || f == g {
                continue;
            }
            (touched[f], touched[g]) = (true, true);
            let (p, q) = (mesh.positions[a as usize], mesh.positions[b as usize]);
            let n: [f32; 3] = std::array::from_fn(|k| normal(mesh, f)[k] + normal(mesh, g)[k]);
            let by = SHRINK * length(sub(q, p)) / length(n).max(1e-20);
            let middle = mesh.positions.len() as u32;
            mesh.positions.push(std::array::from_fn(|k| 0.5 * (p[k] + q[k]) - by * n[k]));
            for c in [x, y] {
                let face = &mut mesh.faces[c as usize / 3];
                let k = c as usize % 3;
                let (end, apex) = (face[(k + 1) % 3], face[(k + 2) % 3]);
                face[(k + 1) % 3] = middle;
                added.push([middle, end, apex]);
            }
        }
    }
    mesh.faces.extend(added);
}

/// Gives each fan of faces around a vertex its own vertex; fans are connected by edges with two faces.
fn separate_fans(mesh: &mut Mesh) {
    let by_ends = half_edges(mesh);
    // Corners that stay one vertex: those at both ends of an edge between two faces.
    let mut same: Vec<u32> = (0..mesh.faces.len() as u32 * 3).collect();
    fn root(same: &mut [u32], mut i: u32) -> u32 {
        while same[i as usize] != i {
            same[i as usize] = same[same[i as usize] as usize];
            i = same[i as usize];
        }
        i
    }
    let next = |c: u32| c / 3 * 3 + (c + 1) % 3;
    for (&(a, b), forth) in &by_ends {
        if a > b && by_ends.contains_key(&(b, a)) {
            continue;
        }
        let Some(back) = by_ends.get(&(b, a)) else { continue };
        for (x, y) in pairs(mesh, (a, b), forth, back) {
            for (p, q) in [(x, next(y)), (next(x), y)] {
                let (p, q) = (root(&mut same, p), root(&mut same, q));
                same[p as usize] = q;
            }
        }
    }
    let mut vertex: HashMap<(u32, u32), u32> = HashMap::new();
    let mut positions = Vec::new();
    let own = |c: u32| {
        let at = mesh.faces[c as usize / 3][c as usize % 3];
        *vertex.entry((at, root(&mut same, c))).or_insert_with(|| {
            positions.push(mesh.positions[at as usize]);
            positions.len() as u32 - 1
        })
    };
    let corners: Vec<u32> = (0..mesh.faces.len() as u32 * 3).map(own).collect();
    let mut copies = vec![0u32; mesh.positions.len()];
    vertex.keys().for_each(|(at, _)| copies[*at as usize] += 1);
    let mut parted = vec![false; positions.len()];
    vertex.iter().for_each(|((at, _), id)| parted[*id as usize] = copies[*at as usize] > 1);
    let faces = corners.chunks_exact(3).map(|f| [f[0], f[1], f[2]]).collect();
    *mesh = Mesh { positions, faces, ..Mesh::default() };
    shrink(mesh, &parted);
}

/// Moves vertices slightly against the normals of their faces.
fn shrink(mesh: &mut Mesh, which: &[bool]) {
    let (mut sum, mut shortest) = (vec![[0.0f32; 3]; which.len()], vec![f32::INFINITY; which.len()]);
    for (i, f) in mesh.faces.iter().enumerate().filter(|(_, f)| f.iter().any(|v| which[*v as usize])) {
        let n = normal(mesh, i);
        for k in 0..3 {
            let (a, b) = (f[k] as usize, f[(k + 1) % 3] as usize);
            let l = length(sub(mesh.positions[b], mesh.positions[a]));
            (shortest[a], shortest[b]) = (shortest[a].min(l), shortest[b].min(l));
            (0..3).for_each(|c| sum[a][c] += n[c]);
        }
    }
    for v in (0..which.len()).filter(|v| which[*v]) {
        let by = SHRINK * shortest[v] / length(sum[v]).max(1e-20);
        (0..3).for_each(|k| mesh.positions[v][k] -= by * sum[v][k]);
    }
}

/// Pairs faces (by their corner at the edge's start) across an edge; with more than two faces, those with the solid between them.
fn pairs(mesh: &Mesh, (a, b): (u32, u32), forth: &[u32], back: &[u32]) -> Vec<(u32, u32)> {
    if forth.len() == 1 && back.len() == 1 {
        return vec![(forth[0], back[0])];
    }
    let p = |i: u32| mesh.positions[i as usize];
    let axis = sub(p(b), p(a));
    let dot = |a: [f32; 3], b: [f32; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    let helper = if axis[0].abs() < axis[1].abs().max(axis[2].abs()) { [1.0, 0.0, 0.0] } else { [0.0, 1.0, 0.0] };
    let u = cross(axis, helper);
    let v = cross(axis, u);
    let length = dot(axis, axis).sqrt().max(1e-20);
    let angle = |c: u32| {
        let f = mesh.faces[c as usize / 3];
        let d = sub(p(f[(c as usize + 2) % 3]), p(a));
        (dot(d, v) / length).atan2(dot(d, u))
    };
    let turn = |from: f32, to: f32| (to - from).rem_euclid(std::f32::consts::TAU);
    let mut free: Vec<(u32, f32)> = back.iter().map(|c| (*c, angle(*c))).collect();
    let mut out = Vec::new();
    for &c in forth {
        // The solid lies behind a face: the next face around the edge in that direction bounds it.
        let own = angle(c);
        let Some(k) = (0..free.len()).min_by(|i, j| turn(free[*i].1, own).total_cmp(&turn(free[*j].1, own))) else { break };
        out.push((c, free.remove(k).0));
    }
    out
}

/// Fills each hole with a fan around its center.
fn fill_holes(mesh: &mut Mesh) {
    let by_ends = half_edges(mesh);
    let mut rim: HashMap<u32, Vec<u32>> = HashMap::new();
    let mut starts: Vec<(u32, u32)> = Vec::new();
    for (&(a, b), forth) in &by_ends {
        let alone = forth.len().saturating_sub(by_ends.get(&(b, a)).map_or(0, Vec::len));
        starts.extend(std::iter::repeat_n((a, b), alone));
    }
    starts.sort_unstable();
    // The border of a hole runs against its faces.
    starts.iter().for_each(|(a, b)| rim.entry(*b).or_default().push(*a));
    for (_, start) in starts {
        let mut ring = vec![start];
        while let Some(next) = rim.get_mut(&ring[ring.len() - 1]).and_then(Vec::pop) {
            if next == start {
                break;
            }
            ring.push(next);
        }
        if ring.len() < 3 {
            continue;
        }
        if ring.len() == 3 {
            mesh.faces.push([ring[0], ring[1], ring[2]]);
            continue;
        }
        let sum = ring.iter().fold([0.0f32; 3], |s, i| std::array::from_fn(|k| s[k] + mesh.positions[*i as usize][k]));
        let middle = mesh.positions.len() as u32;
        mesh.positions.push(sum.map(|v| v / ring.len() as f32));
        mesh.faces.extend((0..ring.len()).map(|k| [ring[k], ring[(k + 1) % ring.len()], middle]));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A cube at `lo` with two triangles per side, each face with its own vertices.
    fn cube(lo: [f32; 3], mesh: &mut Mesh) {
        for (axis, side) in (0..3).flat_map(|a| [(a, 0.0), (a, 1.0f32)]) {
            let first = mesh.positions.len() as u32;
            for (u, v) in [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)] {
                let mut p = lo;
                p[axis] += side;
                p[(axis + 1) % 3] += u;
                p[(axis + 2) % 3] += v;
                mesh.positions.push(p);
            }
            let ring = if side > 0.5 { [0, 1, 2, 3] } else { [0, 3, 2, 1] }.map(|i| first + i);
            mesh.faces.extend([[ring[0], ring[1], ring[2]], [ring[0], ring[2], ring[3]]]);
        }
    }

    #[test]
    fn vertices_at_one_place_become_one() {
        let mut m = Mesh::default();
        cube([0.0; 3], &mut m);
        assert!(!m.is_watertight());
        weld(&mut m);
        assert!(m.is_watertight() && m.positions.len() == 8);
    }

    #[test]
    fn holes_are_filled() {
        // A whole side, a triangle, and two holes that meet in a corner or along an edge.
        for (first, last) in [(2, 0), (0, 1), (2, 1)] {
            let mut m = Mesh::default();
            cube([0.0; 3], &mut m);
            weld(&mut m);
            m.faces.drain(..first);
            m.faces.truncate(m.faces.len() - last);
            assert!(close(&mut m));
            // Flat holes are filled flat.
            assert!((m.volume() - 1.0).abs() < if first + last < 3 { 1e-5 } else { 0.2 }, "{}", m.volume());
        }
    }

    #[test]
    fn cubes_that_touch_along_an_edge_or_in_a_corner_are_parted() {
        for other in [[1.0, 1.0, 0.0], [1.0, 1.0, 1.0]] {
            let mut m = Mesh::default();
            cube([0.0; 3], &mut m);
            cube(other, &mut m);
            assert!(close(&mut m), "{other:?}");
            assert!((m.volume() - 2.0).abs() < 2e-2 && m.faces.len() == 24);
            // The parts are also separate for readers that identify vertices by position.
            weld(&mut m);
            assert!(m.is_watertight());
        }
    }

    #[test]
    fn faces_that_fold_onto_each_other_go() {
        let mut m = Mesh::default();
        cube([0.0; 3], &mut m);
        weld(&mut m);
        let f = m.faces[0];
        m.positions.push([0.5, 0.5, 3.0]);
        m.faces.extend([[f[0], f[1], 8], [f[1], f[0], 8]]);
        assert!(close(&mut m) && m.faces.len() == 12);
    }
}
