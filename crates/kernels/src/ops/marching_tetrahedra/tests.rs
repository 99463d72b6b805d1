use super::*;
use diorama_geom::Mesh;
use diorama_testkit::{random, wide};

fn run([nx, ny, nz]: [usize; 3], values: &[f32], level: f32) -> Mesh {
    let (positions, faces) = cpu::surface(&case_table(), values, [nx, ny, nz], level);
    Mesh { positions, faces, ..Mesh::default() }
}

/// Corners of triangles in a comparable order: by place, the winding kept.
fn sorted(mut triangles: Vec<[[i64; 3]; 3]>) -> Vec<[[i64; 3]; 3]> {
    for t in &mut triangles {
        let least = (0..3).min_by_key(|k| t[*k]).unwrap_or(0);
        t.rotate_left(least);
    }
    triangles.sort();
    triangles
}

#[test]
fn equals_the_reference_triangle_by_triangle() {
    for (nx, ny, nz) in [(1, 1, 1), (2, 2, 2), (7, 5, 6), (70, 3, 40)] {
        let v = random(nx * ny * nz, 4);
        let m = run([nx, ny, nz], &v, 0.1);
        let grid = |p: [f64; 3]| p.map(|v| (v * 1e3).round() as i64);
        let got = m.faces.iter().map(|f| f.map(|i| grid(m.positions[i as usize].map(f64::from)))).collect();
        let want = reference::triangles(nx, ny, nz, &wide(&v), 0.1f32 as f64).into_iter().map(|t| t.map(grid)).collect();
        let (got, want) = (sorted(got), sorted(want));
        assert_eq!(got.len(), want.len());
        let differ = got.iter().zip(&want).filter(|(a, b)| a != b).count();
        // Rounding to thousandths parts a few.
        assert!(differ * 50 <= got.len(), "{differ} of {}", got.len());
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
        assert!(run([n, n, n], &v, 0.0).is_watertight());
    }
}

#[test]
fn a_sphere_has_its_volume_and_faces_outward() {
    let (n, c, r) = (24, 11.5f32, 8.0f32);
    let place = |i: usize| [(i % n) as f32 - c, (i / n % n) as f32 - c, (i / n / n) as f32 - c];
    let v: Vec<f32> = (0..n * n * n).map(|i| r - place(i).iter().map(|v| v * v).sum::<f32>().sqrt()).collect();
    let m = run([n, n, n], &v, 0.0);
    let exact = 4.0 / 3.0 * std::f64::consts::PI * (r as f64).powi(3);
    assert!((m.volume() / exact - 1.0).abs() < 0.02, "signed volume {}, sphere {exact}", m.volume());
}
