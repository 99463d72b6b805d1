//! Tests of reading COLMAP models: valid ones of every camera model, and broken ones.

use super::*;
use diorama_geom::glam::DVec3;
use diorama_geom::transform::rotation_from_quaternion;

fn binary(dir: &Path, model: u32, params: &[f64], names: &[&str]) {
    let mut cameras = 1u64.to_le_bytes().to_vec();
    cameras.extend(7u32.to_le_bytes());
    cameras.extend(model.to_le_bytes());
    cameras.extend(64u64.to_le_bytes());
    cameras.extend(48u64.to_le_bytes());
    params.iter().for_each(|p| cameras.extend(p.to_le_bytes()));
    let mut images = (names.len() as u64).to_le_bytes().to_vec();
    for (i, n) in names.iter().enumerate() {
        images.extend((i as u32 + 1).to_le_bytes());
        // 90° about y, center at (i, 2, 3): t = −R c.
        let h = std::f64::consts::FRAC_1_SQRT_2;
        let r = rotation_from_quaternion([h, 0.0, h, 0.0]);
        let t = -(r * DVec3::new(i as f64, 2.0, 3.0));
        for v in [h, 0.0, h, 0.0, t.x, t.y, t.z] {
            images.extend(v.to_le_bytes());
        }
        images.extend(7u32.to_le_bytes());
        images.extend(n.as_bytes());
        images.push(0);
        images.extend(1u64.to_le_bytes());
        images.extend([0u8; 24]);
    }
    let sparse = dir.join("sparse/0");
    std::fs::create_dir_all(&sparse).unwrap();
    std::fs::create_dir_all(dir.join("images")).unwrap();
    std::fs::write(sparse.join("cameras.bin"), cameras).unwrap();
    std::fs::write(sparse.join("images.bin"), images).unwrap();
    names.iter().for_each(|n| std::fs::write(dir.join("images").join(n), b"x").unwrap());
}

#[test]
fn binary_models_give_camera_centers_and_axes() {
    let dir = tempfile::tempdir().unwrap();
    binary(dir.path(), 4, &[50.0, 51.0, 32.0, 24.0, 0.1, 0.2, 0.3, 0.4], &["b.jpg", "a b.jpg"]);
    let got = read(dir.path()).unwrap();
    assert_eq!(got.frames[0].name, "a b");
    assert!((got.frames[0].world_from_camera.translation - DVec3::new(1.0, 2.0, 3.0)).length() < 1e-9);
    assert!((got.frames[0].world_from_camera.rotation.z_axis - DVec3::new(-1.0, 0.0, 0.0)).length() < 1e-9);
    assert_eq!(got.frames[0].camera.lens, Lens::Brown { k: [0.1, 0.2, 0.0, 0.0, 0.0, 0.0], p: [0.3, 0.4] });
}

#[test]
fn every_camera_model_is_read() {
    for (i, (_, n)) in MODELS.iter().enumerate() {
        let dir = tempfile::tempdir().unwrap();
        let params: Vec<f64> = (0..*n).map(|k| if k < 4 { 40.0 } else { 0.01 * k as f64 }).collect();
        binary(dir.path(), i as u32, &params, &["a.jpg"]);
        let c = read(dir.path()).unwrap().frames[0].camera;
        let d = c.direction(50.0, 30.0);
        assert!((c.project(d).unwrap() - diorama_geom::glam::DVec2::new(50.0, 30.0)).length() < 1e-4, "{}", MODELS[i].0);
    }
}

#[test]
fn truncated_files_and_unknown_models_are_named() {
    let dir = tempfile::tempdir().unwrap();
    binary(dir.path(), 1, &[50.0, 51.0, 32.0, 24.0], &["a.jpg"]);
    let file = dir.path().join("sparse/0/images.bin");
    let good = std::fs::read(&file).unwrap();
    for n in [3, 20, good.len() - 30, good.len() - 1] {
        std::fs::write(&file, &good[..n]).unwrap();
        assert!(read(dir.path()).unwrap_err().is_input());
    }
    binary(dir.path(), 99, &[], &["a.jpg"]);
    assert!(read(dir.path()).unwrap_err().to_string().contains("not supported"));
}
