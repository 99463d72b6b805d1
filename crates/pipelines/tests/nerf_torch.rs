//! The `nerf` network equals the same weights in PyTorch. Runs where `DIORAMA_TORCH_PYTHON` names a Python
//! that has torch and numpy.

use diorama_engine::fields::{self, DensityQuery, FieldBuffers};
use diorama_geom::contraction::Space;
use diorama_testkit::random;
use std::path::Path;
use std::process::Command;

fn write(folder: &Path, name: &str, values: &[f32]) {
    let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
    std::fs::write(folder.join(name), bytes).unwrap();
}

#[test]
fn nerf_forward_equals_pytorch() {
    let Ok(python) = std::env::var("DIORAMA_TORCH_PYTHON") else {
        println!("skipped: DIORAMA_TORCH_PYTHON is not set");
        return;
    };
    let n = 4096;
    // An outer cube of edge 1: model points are [0, 1]³, field coordinates [−1, 1]³.
    let mut field = fields::nerf(Space::Cube(1.0), 5e-4, 0, 0, 7, 1);
    for (w, noise) in field.weights.values.iter_mut().zip(random(field.net.mlp.params_len(), 5)) {
        *w += 0.01 * noise;
    }
    let points = random(n * 3, 1);
    let model: Vec<f32> = points.iter().map(|v| 0.5 * v + 0.5).collect();
    let mut dirs = random(n * 3, 2);
    for d in dirs.chunks_exact_mut(3) {
        let l = (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]).sqrt();
        d.iter_mut().for_each(|v| *v /= l);
    }
    let mut sigma = vec![0.0; n];
    field.density(&model, &mut sigma);
    let mut buf = FieldBuffers::default();
    let colors = field.outputs_at(&model, &dirs, &[], &mut buf).to_vec();
    let dir = tempfile::tempdir().unwrap();
    // The points as the field saw them, after the way through model space.
    let seen: Vec<f32> = model.iter().map(|v| 2.0 * (v - 0.5)).collect();
    for (name, values) in
        [("weights.f32", &field.weights.values), ("points.f32", &seen), ("dirs.f32", &dirs), ("sigma.f32", &sigma), ("rgb.f32", &colors)]
    {
        write(dir.path(), name, values);
    }
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../benches/peers/nerf_forward.py");
    let out = Command::new(python).arg(script).arg(dir.path()).output().unwrap();
    println!("{}{}", String::from_utf8_lossy(&out.stdout), String::from_utf8_lossy(&out.stderr));
    assert!(out.status.success());
}
