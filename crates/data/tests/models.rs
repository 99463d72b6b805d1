//! Models and environment maps that other programs wrote.

use diorama_data::gltf::{self, WriteOptions};
use diorama_data::model_file::{self, LoadedModel};
use diorama_data::{environment, obj};
use std::path::PathBuf;

/// A folder of real data; without one, prints that the test was skipped.
fn data(name: &str) -> Option<PathBuf> {
    let found = std::env::var("DIORAMA_TEST_DATA").ok().map(|d| PathBuf::from(d).join(name)).filter(|d| d.is_dir());
    if found.is_none() {
        assert!(std::env::var("DIORAMA_REQUIRE_DATA").is_err(), "DIORAMA_TEST_DATA/{name} is required");
        println!("skipped: no test data");
    }
    found
}

#[test]
fn a_city_of_99_meshes_round_trips() {
    let Some(city) = data("city_lowpoly") else { return };
    let LoadedModel { model, notes } = model_file::read(&city.join("scene.gltf")).unwrap();
    assert_eq!(notes, Vec::<String>::new());
    assert_eq!((model.parts.len(), model.textures.len(), model.materials.len()), (99, 8, 8));
    let (low, high) = model.bounds().unwrap();
    assert!(high[2] - low[2] < high[0] - low[0] && high[2] - low[2] < high[1] - low[1], "a city is flatter than long: {low:?} {high:?}");
    let dir = tempfile::tempdir().unwrap();
    for quantize in [false, true] {
        let path = dir.path().join("city.glb");
        gltf::save(&path, &model, WriteOptions { quantize }).unwrap();
        let again = gltf::read(&path).unwrap().model;
        assert_eq!((again.face_count(), again.materials.len()), (model.face_count(), model.materials.len()));
        let near = 1e-4 * (high[0] - low[0]);
        let (l, h) = again.bounds().unwrap();
        assert!((0..3).all(|k| (l[k] - low[k]).abs() < near && (h[k] - high[k]).abs() < near), "{l:?} {h:?}");
    }
}

#[test]
fn spot_is_a_watertight_cow_that_stands_upright() {
    let Some(meshes) = data("meshes") else { return };
    let LoadedModel { model, notes } = obj::read(&meshes.join("spot/spot.obj"), None).unwrap();
    assert_eq!(notes, Vec::<String>::new());
    let mesh = &model.parts[0].mesh;
    assert_eq!((model.parts.len(), mesh.faces.len()), (1, 5856));
    assert_eq!(model.textures.len(), 1);
    assert!(mesh.volume() > 0.0);
    // Her length is along y here, and she is higher than wide.
    let (low, high) = mesh.bounds().unwrap();
    let size: [f32; 3] = std::array::from_fn(|k| high[k] - low[k]);
    assert!(size[1] > size[0] && size[2] > size[0], "{size:?}");
}

#[test]
fn poly_haven_maps_are_environments() {
    let Some(maps) = data("hdri") else { return };
    let dir = tempfile::tempdir().unwrap();
    let mut count = 0;
    for entry in std::fs::read_dir(maps).unwrap() {
        let path = entry.unwrap().path();
        if path.extension().is_none_or(|e| e != "hdr") {
            continue;
        }
        let read = environment::read(&path).unwrap();
        assert_eq!((read.environment.image().width, read.notes.len()), (1024, 0), "{}", path.display());
        // RGBE that was read is written as it was.
        let again = dir.path().join("a.hdr");
        environment::save_hdr(&again, &read.environment).unwrap();
        assert_eq!(environment::read(&again).unwrap().environment, read.environment, "{}", path.display());
        count += 1;
    }
    assert!(count > 0);
}
