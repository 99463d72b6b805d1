use super::{cpu, reference};
use diorama_testkit::{assert_close, assert_gradient, random};

/// A bumpy fan of faces over `n` vertices, with one vertex of no face.
fn fan(n: usize) -> (Vec<[u32; 3]>, Vec<[f32; 3]>) {
    let faces = (1..n as u32 - 2).map(|i| [0, i, i + 1]).collect();
    (faces, random(3 * n, 4).as_chunks::<3>().0.to_vec())
}

fn wide(p: &[[f32; 3]]) -> Vec<[f64; 3]> {
    p.iter().map(|p| p.map(f64::from)).collect()
}

#[test]
fn both_directions_match_the_reference() {
    for n in [4, 9, 5000] {
        let (faces, positions) = fan(n);
        let d = random(3 * n, 5).as_chunks::<3>().0.to_vec();
        let want = reference::forward(&faces, &wide(&positions));
        assert_close("normals", cpu::forward(&faces, &positions).as_flattened(), want.as_flattened(), 1e-5);
        let mut got = vec![[1.0; 3]; n];
        cpu::backward(&faces, &positions, &d, &mut got);
        let want: Vec<f64> = reference::backward(&faces, &wide(&positions), &wide(&d)).as_flattened().iter().map(|v| v + 1.0).collect();
        assert_close("positions", got.as_flattened(), &want, 1e-4);
    }
}

#[test]
fn the_reference_s_gradient_matches_central_differences() {
    let (faces, positions) = fan(7);
    let d = random(21, 6);
    let loss = |p: &[f64]| {
        let n = reference::forward(&faces, p.as_chunks::<3>().0);
        n.as_flattened().iter().zip(&d).map(|(n, d)| n * *d as f64).sum()
    };
    let got = reference::backward(&faces, &wide(&positions), &wide(d.as_chunks::<3>().0));
    assert_gradient("positions", got.as_flattened(), wide(&positions).as_flattened(), 1e-6, loss);
}

#[test]
fn vertices_without_area_point_up() {
    let (faces, positions) = ([[0, 1, 2]], [[0.0; 3], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [5.0; 3]]);
    assert_eq!(cpu::forward(&faces, &positions), vec![[0.0, 0.0, 1.0]; 4]);
    let mut d = vec![[0.0; 3]; 4];
    cpu::backward(&faces, &positions, &[[1.0; 3]; 4], &mut d);
    assert_eq!(d, vec![[0.0; 3]; 4]);
}
