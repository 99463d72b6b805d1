use super::*;
use crate::ops::marching_tetrahedra::TETRAHEDRA;
use diorama_geom::Mesh;
use diorama_testkit::{assert_close, assert_gradient, random, wide};

/// Grid of `n³` cubes of six tetrahedra each (Kuhn's division), with vertices moved a little.
pub(crate) fn grid(n: usize, seed: u64) -> (Topology, Vec<[f32; 3]>) {
    let p = n + 1;
    let number = |[x, y, z]: [usize; 3]| ((z * p + y) * p + x) as u32;
    let moved = random(p * p * p * 3, seed);
    let place = |i: usize| [i % p, i / p % p, i / p / p];
    let positions = (0..p * p * p).map(|i| std::array::from_fn(|k| place(i)[k] as f32 + 0.1 * moved[i * 3 + k])).collect();
    let mut cells = Vec::new();
    for i in (0..p * p * p).filter(|i| place(*i).iter().all(|c| *c < n)) {
        for t in TETRAHEDRA {
            let [a, b, c, d] = t.map(|corner| number(std::array::from_fn(|k| place(i)[k] + (corner >> k & 1))));
            // Even permutations of the axes have positive volume.
            let even = matches!(t, [0, 1, 3, 7] | [0, 2, 6, 7] | [0, 4, 5, 7]);
            cells.push(if even { [a, b, c, d] } else { [a, c, b, d] });
        }
    }
    (Topology::new(p * p * p, cells), positions)
}

fn points(p: &[[f32; 3]]) -> Vec<[f64; 3]> {
    p.iter().map(|p| p.map(f64::from)).collect()
}

fn rotated(mut f: [u32; 3]) -> [u32; 3] {
    let least = (0..3).min_by_key(|k| f[*k]).unwrap_or(0);
    f.rotate_left(least);
    f
}

#[test]
fn unique_edges_and_their_numbers_are_right() {
    let (t, _) = grid(3, 1);
    // Axes, diagonals of faces and of cubes.
    assert_eq!(t.edges().len(), 3 * 3 * 16 + 3 * 9 * 4 + 27);
    for (cell, edges) in t.cells().iter().zip(t.cell_edges()) {
        for (e, [a, b]) in edges.iter().zip(EDGES) {
            let mut ends = [cell[a], cell[b]];
            ends.sort_unstable();
            assert_eq!(t.edges()[*e as usize], ends);
        }
    }
    for i in 0..t.vertices() {
        let want: Vec<u32> = (0..t.edges().len()).filter(|e| t.edges()[*e].contains(&(i as u32))).map(|e| e as u32).collect();
        assert_eq!(t.edges_at(i), want);
    }
}

#[test]
fn equals_the_reference() {
    for (n, seed) in [(1, 3), (2, 4), (7, 5), (30, 6)] {
        let (t, positions) = grid(n, seed);
        let s: Vec<f32> = random(t.vertices(), seed + 10).into_iter().map(|s| s + 0.2).collect();
        let mut surface = Surface::default();
        cpu::extract(&t, &s, &positions, &mut surface);
        let want = reference::extract(t.cells(), &wide(&s), &points(&positions));
        let edges: Vec<[u32; 2]> = surface.cut_edges.iter().map(|e| t.edges()[*e as usize]).collect();
        assert_eq!(edges, want.edges);
        assert_close("positions", surface.positions.as_flattened(), want.positions.as_flattened(), 1e-5);
        let faces = |f: &[[u32; 3]]| f.iter().map(|f| rotated(*f)).collect::<Vec<_>>();
        assert_eq!(faces(&surface.faces), faces(&want.faces));
    }
}

#[test]
fn random_distances_with_an_outside_border_are_watertight() {
    let (n, p) = (9, 10);
    for seed in 0..5 {
        let (t, positions) = grid(n, seed);
        let mut s = random(t.vertices(), seed + 50);
        for (i, s) in s.iter_mut().enumerate() {
            if [i % p, i / p % p, i / p / p].iter().any(|c| *c == 0 || *c == n) {
                *s = -1.0;
            }
        }
        let mut surface = Surface::default();
        cpu::extract(&t, &s, &positions, &mut surface);
        let mesh = Mesh { positions: surface.positions, faces: surface.faces, ..Mesh::default() };
        assert!(mesh.is_watertight() && mesh.volume() > 0.0);
    }
}

#[test]
fn reference_gradients_match_central_differences() {
    let (t, positions) = grid(2, 7);
    let (s, positions) = (wide(&random(t.vertices(), 8)), points(&positions));
    let found = reference::extract(t.cells(), &s, &positions);
    let d: Vec<[f64; 3]> = wide(&random(found.edges.len() * 3, 9)).chunks(3).map(|d| [d[0], d[1], d[2]]).collect();
    let (d_s, d_positions) = reference::backward(&found.edges, &s, &positions, &d);
    let loss = |s: &[f64], p: &[[f64; 3]]| -> f64 {
        let r = reference::extract(t.cells(), s, p);
        r.positions.as_flattened().iter().zip(d.as_flattened()).map(|(v, d)| v * d).sum()
    };
    assert_gradient("d_s", &d_s, &s, 1e-5, |s| loss(s, &positions));
    let flat = positions.as_flattened();
    assert_gradient("d_positions", d_positions.as_flattened(), flat, 1e-6, |p| loss(&s, p.as_chunks::<3>().0));
}

#[test]
fn gradients_equal_the_reference_and_are_added() {
    for (n, seed) in [(1, 1), (6, 2), (32, 3)] {
        let (t, positions) = grid(n, seed);
        let mut s = random(t.vertices(), seed + 20);
        // Differences too small to divide by twice.
        (s[0], s[1]) = (1e-9, -2e-9);
        let mut surface = Surface::default();
        cpu::extract(&t, &s, &positions, &mut surface);
        let d: Vec<[f32; 3]> = random(surface.positions.len() * 3, 9).chunks(3).map(|d| [d[0], d[1], d[2]]).collect();
        let edges: Vec<[u32; 2]> = surface.cut_edges.iter().map(|e| t.edges()[*e as usize]).collect();
        let (mut want_s, mut want) = reference::backward(&edges, &wide(&s), &points(&positions), &points(&d));
        want_s.iter_mut().chain(want.as_flattened_mut()).for_each(|d| *d += 0.5);
        let (mut d_s, mut d_positions) = (vec![0.5; s.len()], vec![[0.5; 3]; s.len()]);
        cpu::backward(&t, &surface, (&s, &positions), &d, (&mut d_s, &mut d_positions));
        // The first two carry nearly all of the norm.
        assert_close("small gaps", &d_s[..2], &want_s[..2], 1e-4);
        assert_close("d_s", &d_s[2..], &want_s[2..], 1e-3);
        assert_close("d_positions", d_positions.as_flattened(), want.as_flattened(), 1e-4);
    }
}

#[test]
fn extreme_distances_stay_finite() {
    let (t, positions) = grid(3, 2);
    let values = [0.0, 1e-45, -1e-45, 1e-30, -1e-30, f32::MAX, -f32::MAX, 1.0, -1.0];
    for seed in 0..20 {
        let pick = diorama_geom::rng::Rng::new(seed, 0);
        let s: Vec<f32> = (0..t.vertices() as u64).map(|i| values[pick.below(i, values.len() as u64) as usize]).collect();
        let mut surface = Surface::default();
        cpu::extract(&t, &s, &positions, &mut surface);
        assert!(surface.positions.as_flattened().iter().all(|v| (-0.2..=3.2).contains(v)));
        let d = vec![[1.0; 3]; surface.positions.len()];
        let (mut d_s, mut d_positions) = (vec![0.0; s.len()], vec![[0.0; 3]; s.len()]);
        cpu::backward(&t, &surface, (&s, &positions), &d, (&mut d_s, &mut d_positions));
        assert!(d_s.iter().chain(d_positions.as_flattened()).all(|d| d.is_finite()));
    }
}

#[test]
fn no_sign_change_gives_no_surface() {
    let (t, positions) = grid(2, 1);
    let mut surface = Surface::default();
    cpu::extract(&t, &vec![-1.0; t.vertices()], &positions, &mut surface);
    assert!(surface.positions.is_empty() && surface.faces.is_empty() && surface.active.is_empty() && surface.area() == 0.0);
}
