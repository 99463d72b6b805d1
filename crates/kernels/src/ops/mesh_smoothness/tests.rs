use super::*;
use diorama_testkit::{assert_close, assert_gradient, random, wide};

/// A bumpy sheet of `n²` squares with a hole, and one vertex without faces.
fn sheet(n: usize, seed: u64) -> (Vec<[f32; 3]>, Vec<[u32; 3]>) {
    let p = n + 1;
    let bumps = random((p * p + 1) * 3, seed);
    let positions = (0..p * p + 1).map(|i| [i % p, i / p, 0].map(|v| v as f32)).zip(bumps.as_chunks::<3>().0);
    let positions = positions.map(|(p, b)| std::array::from_fn(|k| p[k] + 0.3 * b[k])).collect();
    let mut faces = Vec::new();
    for i in (0..n * n).filter(|i| n < 3 || *i != n + 1) {
        let at = |x: usize, y: usize| ((i / n + y) * p + i % n + x) as u32;
        faces.extend([[at(0, 0), at(1, 0), at(1, 1)], [at(0, 0), at(1, 1), at(0, 1)]]);
    }
    (positions, faces)
}

fn points(p: &[[f32; 3]]) -> Vec<[f64; 3]> {
    p.iter().map(|p| p.map(f64::from)).collect()
}

#[test]
fn matches_the_reference() {
    for n in [1, 4, 70] {
        let ((first, faces), (moved, _)) = (sheet(n, 1), sheet(n, 2));
        let topology = MeshTopology::new(first.len(), &faces);
        let twice_plus_one = |d: Vec<[f64; 3]>| d.iter().flatten().map(|d| 1.0 + 2.0 * d).collect::<Vec<_>>();
        let check = |what: &str, got: f64, d: &[[f32; 3]], (want, want_d): (f64, Vec<[f64; 3]>)| {
            assert_close(what, &[got as f32], &[want], 1e-5);
            assert_close(what, d.as_flattened(), &twice_plus_one(want_d), 1e-5);
        };
        let mut d = vec![[1.0; 3]; first.len()];
        let got = cpu::relative_laplacian(&topology, &cpu::laplacian(&topology, &first), &moved, 2.0, &mut d);
        check("laplacian", got, &d, reference::relative_laplacian(&faces, &points(&first), &points(&moved)));
        for crease in [f32::INFINITY, 0.05] {
            let mut d = vec![[1.0; 3]; first.len()];
            let got = cpu::normal_consistency(&topology, &moved, crease, 2.0, &mut d);
            check("normals", got, &d, reference::normal_consistency(&faces, &points(&moved), crease as f64));
        }
    }
}

#[test]
fn reference_gradients_match_central_differences() {
    let ((first, faces), (moved, _)) = (sheet(3, 1), sheet(3, 2));
    let (first, moved) = (points(&first), points(&moved));
    let d = reference::relative_laplacian(&faces, &first, &moved).1;
    let of = |p: &[f64]| p.as_chunks::<3>().0.to_vec();
    assert_gradient("laplacian", d.as_flattened(), moved.as_flattened(), 1e-6, |p| reference::relative_laplacian(&faces, &first, &of(p)).0);
    for crease in [f64::INFINITY, 0.05] {
        let d = reference::normal_consistency(&faces, &moved, crease).1;
        let at = |p: &[f64]| reference::normal_consistency(&faces, &of(p), crease).0;
        assert_gradient("normals", d.as_flattened(), moved.as_flattened(), 1e-6, at);
    }
}

#[test]
fn flat_and_unmoved_meshes_cost_nothing() {
    let (first, faces) = sheet(6, 3);
    let topology = MeshTopology::new(first.len(), &faces);
    let shifted: Vec<[f32; 3]> = first.iter().map(|p| [p[0] + 2.0, p[1] - 1.0, p[2]]).collect();
    let mut d = vec![[0.0; 3]; first.len()];
    assert!(cpu::relative_laplacian(&topology, &cpu::laplacian(&topology, &first), &shifted, 1.0, &mut d) < 1e-12);
    assert!(d.as_flattened().iter().all(|v| v.abs() < 1e-6));
    let flat: Vec<[f32; 3]> = first.iter().map(|p| [p[0], p[1], 0.0]).collect();
    assert!(cpu::normal_consistency(&topology, &flat, 0.05, 1.0, &mut d) < 1e-6);
    // A right angle, 1 − cos 90°, and what of it counts.
    let corner = [[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
    let topology = MeshTopology::new(4, &[[0, 1, 2], [1, 0, 3]]);
    for (crease, counts) in [(f32::INFINITY, 1.0), (0.25, 0.2)] {
        assert!((cpu::normal_consistency(&topology, &corner, crease, 1.0, &mut [[0.0; 3]; 4]) - counts).abs() < 1e-6);
    }
}

#[test]
fn faces_without_area_stay_finite() {
    let topology = MeshTopology::new(4, &[[0, 1, 2], [1, 0, 3]]);
    let mut d = [[0.0; 3]; 4];
    let value = cpu::normal_consistency(&topology, &[[0.0; 3], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 0.0, 1.0]], 0.05, 1.0, &mut d);
    assert!(value.is_finite() && d.as_flattened().iter().all(|v| v.is_finite()), "{}", wide(&d.concat())[0]);
}
