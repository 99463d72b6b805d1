use super::*;
use diorama_testkit::{random, wide};

/// Positions and faces, slice by slice.
fn run(nx: usize, ny: usize, nz: usize, values: &[f32], level: f32) -> diorama_geom::Mesh {
    let table = case_table();
    let mut m = cpu::Mesher::new(&table, nx, ny, level);
    for z in 0..nz {
        m.push(&values[z * nx * ny..(z + 1) * nx * ny]);
    }
    diorama_geom::Mesh { positions: m.positions, faces: m.faces, ..Default::default() }
}

#[test]
fn equals_the_reference_triangle_by_triangle() {
    // A mesher is fed slices, of which an empty one has none.
    for cases::Case { size: [nx, ny, nz], density, level } in cases::cases().into_iter().filter(|c| !c.density.is_empty()) {
        let m = run(nx, ny, nz, &density, level);
        let want = reference::triangles(nx, ny, nz, &wide(&density), level as f64);
        assert_eq!(m.faces.len(), want.len());
        for (f, w) in m.faces.iter().zip(&want) {
            for (i, p) in f.iter().zip(w) {
                let q = m.positions[*i as usize];
                assert!((0..3).all(|k| (q[k] as f64 - p[k]).abs() < 1e-4), "{q:?} {p:?}");
            }
        }
    }
}

#[test]
fn random_fields_closed_by_their_border_are_watertight() {
    for seed in 0..5 {
        let n = 9;
        let mut v = random(n * n * n, seed);
        for (i, v) in v.iter_mut().enumerate() {
            let p = [i % n, i / n % n, i / n / n];
            if p.iter().any(|&c| c == 0 || c == n - 1) {
                *v = -1.0;
            }
        }
        assert!(run(n, n, n, &v, 0.0).is_watertight());
    }
}

#[test]
fn a_sphere_lies_on_its_surface_and_faces_outward() {
    let (n, c, r) = (24, 11.5f32, 8.0f32);
    let v: Vec<f32> = (0..n * n * n)
        .map(|i| {
            let p = [(i % n) as f32 - c, (i / n % n) as f32 - c, (i / n / n) as f32 - c];
            r - (p[0] * p[0] + p[1] * p[1] + p[2] * p[2]).sqrt()
        })
        .collect();
    let m = run(n, n, n, &v, 0.0);
    for p in &m.positions {
        let d = p.iter().map(|v| (v - c) * (v - c)).sum::<f32>().sqrt();
        assert!((d - r).abs() < 0.05, "{d}");
    }
    let exact = 4.0 / 3.0 * std::f64::consts::PI * (r as f64).powi(3);
    assert!((m.volume() / exact - 1.0).abs() < 0.02, "signed volume {}, sphere {exact}", m.volume());
}

#[test]
fn every_case_uses_exactly_its_crossing_edges() {
    for (inside, triangles) in case_table().triangles.iter().enumerate() {
        let used: std::collections::HashSet<Edge> = triangles.iter().flatten().copied().collect();
        for e in 0..12 {
            let (a, b) = edge_corners(e);
            let edge = Edge { corner: a, direction: a ^ b };
            assert_eq!(used.contains(&edge), (inside >> a & 1) != (inside >> b & 1), "case {inside} edge {e}");
        }
    }
}

#[test]
fn a_whole_grid_in_slabs_equals_slice_by_slice() {
    // Wider than a word, and several slabs.
    let (nx, ny, nz) = (70, 9, 53);
    let mut state = 7u32;
    let values: Vec<f32> = (0..nx * ny * nz)
        .map(|_| {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 8) as f32 / (1 << 24) as f32
        })
        .collect();
    let m = run(nx, ny, nz, &values, 0.4);
    let (positions, faces) = cpu::surface(&case_table(), &values, [nx, ny, nz], 0.4);
    assert_eq!((positions.len(), faces.len()), (m.positions.len(), m.faces.len()));
    let placed = |p: &[[f32; 3]], f: &[[u32; 3]]| -> Vec<[[f32; 3]; 3]> { f.iter().map(|f| f.map(|i| p[i as usize])).collect() };
    assert!(placed(&positions, &faces) == placed(&m.positions, &m.faces));
    // Each vertex is there once.
    let mut bits: Vec<[u32; 3]> = positions.iter().map(|p| p.map(f32::to_bits)).collect();
    bits.sort_unstable();
    bits.dedup();
    assert_eq!(bits.len(), {
        let mut b: Vec<[u32; 3]> = m.positions.iter().map(|p| p.map(f32::to_bits)).collect();
        b.sort_unstable();
        b.dedup();
        b.len()
    });
    assert!(cpu::surface(&case_table(), &[0.0; 8], [2, 2, 2], 0.5) == (vec![], vec![]));
}
