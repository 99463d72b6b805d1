//! Parsers of models, environment maps and light.

use crate::file;
use diorama_data::gltf::{self, WriteOptions};
use diorama_data::{environment, model_file, nerf_osr, obj, photo, sessions, sh_text, text_labels};
use diorama_geom::environment::Environment;
use diorama_geom::glam::{DAffine3, DVec3};
use diorama_geom::model::{Instance, Material, Model, Opacity, Texture, Wrap};
use diorama_geom::sh_light::ShLight;
use diorama_geom::{ImageU8, Mesh};
use std::path::Path;

/// Reads a `.glb` or `.gltf`; a model that was read can be written and read again.
pub fn gltf(data: &[u8]) {
    let path = file("model.glb", data);
    let Ok(loaded) = model_file::read(&path) else { return };
    let model = loaded.model;
    let vertices: usize = model.parts.iter().map(|p| p.mesh.positions.len()).sum();
    let in_range = |m: &Mesh| m.faces.iter().flatten().all(|i| (*i as usize) < m.positions.len());
    assert!(model.parts.iter().all(|p| in_range(&p.mesh) && p.material < model.materials.len()), "indices of vertices and materials");
    if vertices < 10_000 {
        for quantize in [false, true] {
            // Coordinates near the largest float overflow under a transform.
            let Ok(bytes) = gltf::encode(&model, WriteOptions { quantize }, &path) else { continue };
            let again = gltf::read(&file("again.glb", &bytes));
            assert!(again.is_ok() || has_huge_numbers(&model), "{again:?}");
        }
    }
}

fn has_huge_numbers(model: &Model) -> bool {
    let is_huge = |v: f64| v.abs() > 1e18;
    let placed = model.instances.iter().any(|i| i.world_from_part.to_cols_array().iter().any(|v| is_huge(*v)));
    placed || model.parts.iter().flat_map(|p| &p.mesh.positions).flatten().any(|v| is_huge(*v as f64))
}

fn model() -> Model {
    let mesh = Mesh {
        positions: vec![[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.5], [1.0, 1.0, 0.5]],
        normals: vec![[0.0, 0.0, 1.0]; 4],
        tangents: vec![[1.0, 0.0, 0.0, 1.0]; 4],
        uvs: vec![[0.0, 1.0], [1.0, 1.0], [0.0, 0.0], [1.0, 0.0]],
        colors_srgb: vec![[1.0, 0.5, 0.0]; 4],
        faces: vec![[0, 1, 2], [2, 1, 3]],
        ..Mesh::default()
    };
    let mut model = Model::of("square", mesh);
    model
        .textures
        .push(Texture { image: ImageU8 { width: 2, height: 1, channels: 4, data: (0..8).collect() }, wrap: [Wrap::Mirror, Wrap::Repeat] });
    model.materials[0] = Material {
        base_color_texture: Some(0),
        metallic_roughness_texture: Some(0),
        is_occluding: true,
        normal_texture: Some(0),
        emission: [2.0, 1.0, 0.0],
        emission_texture: Some(0),
        transmission: 0.5,
        opacity: Opacity::Cutoff(0.5),
        ..Material::default()
    };
    model
        .instances
        .push(Instance { part: 0, world_from_part: DAffine3::from_rotation_x(0.4) * DAffine3::from_scale(DVec3::new(1.0, 2.0, -1.0)) });
    model
}

pub fn gltf_seeds() -> Vec<Vec<u8>> {
    let path = file("seed.glb", b"");
    let binary = [false, true].map(|quantize| gltf::encode(&model(), WriteOptions { quantize }, &path).expect("a plain model"));
    // Sparse positions, a strip, a transform of the texture, and data within the JSON.
    let text = br#"{"asset":{"version":"2.0"},"scene":0,"scenes":[{"nodes":[0]}],"nodes":[{"children":[1],"scale":[2,2,2]},{"mesh":0,"skin":0,"rotation":[0,0,0,1]}],
        "meshes":[{"name":"a","primitives":[{"attributes":{"POSITION":0,"TEXCOORD_0":2},"indices":1,"mode":5,"material":0}]}],
        "materials":[{"pbrMetallicRoughness":{"baseColorTexture":{"index":0,"extensions":{"KHR_texture_transform":{"offset":[0.5,0],"rotation":1,"scale":[2,2]}}}},
        "extensions":{"KHR_materials_unlit":{}}}],"textures":[{"source":0}],"images":[{"uri":"images/a.png"}],
        "extensionsUsed":["KHR_texture_transform","KHR_materials_unlit"],
        "buffers":[{"uri":"data:application/octet-stream;base64,AAECAwAAAAAAAAAAAACAPwAAgD8AAAAAAAAAAA==","byteLength":28}],
        "bufferViews":[{"buffer":0,"byteLength":4},{"buffer":0,"byteOffset":4,"byteLength":24,"byteStride":12}],
        "accessors":[{"componentType":5126,"count":4,"type":"VEC3","sparse":{"count":2,"indices":{"bufferView":0,"byteOffset":1,"componentType":5121},"values":{"bufferView":1}}},
        {"bufferView":0,"componentType":5121,"count":4,"type":"SCALAR"},{"componentType":5121,"normalized":true,"count":4,"type":"VEC2"}]}"#;
    binary.into_iter().chain([text.to_vec()]).collect()
}

/// Reads an OBJ; with `newmtl`, the input is also its MTL.
pub fn obj(data: &[u8]) {
    let path = file("model.obj", data);
    file("images/model.mtl", data);
    if let Ok(loaded) = obj::read(&path, None) {
        let in_range = |m: &Mesh| m.faces.iter().flatten().all(|i| (*i as usize) < m.positions.len());
        assert!(loaded.model.parts.iter().all(|p| in_range(&p.mesh)), "indices of vertices");
    }
}

pub fn obj_seeds() -> Vec<Vec<u8>> {
    let text = "mtllib images/model.mtl\nnewmtl a\nKd 0.5 0.2 0.1\nd 0.5\nmap_Kd -s 1 1 1 -clamp on a.png\nv 0 0 0 1 0 0\nv 1 0 0 0 1 0\nv 1 1 0 0 0 1\nv 0.2 0.3 0 1 1 1\n\
                vt 0 0\nvt 1 1\nvn 0 0 1\nusemtl a\nf 1/1/1 2/2/1 3/1/1 4/2/1\nf -4//-1 -3//-1 \\\n-2//-1\n";
    vec![text.as_bytes().to_vec()]
}

/// Reads an environment map of any format.
pub fn environment(data: &[u8]) {
    let path = file("map.hdr", data);
    if let Ok(loaded) = environment::read(&path) {
        let map = loaded.environment;
        assert!(map.image().data.iter().all(|v| v.is_finite() && *v >= 0.0), "radiance");
        assert!(map.image().width == 2 * map.image().height);
    }
}

pub fn environment_seeds() -> Vec<Vec<u8>> {
    let map = Environment::from_fn(4, |d| [1.0 + d.x, 2.0 + d.y, 3.0 + d.z]);
    let (hdr, exr) = (file("seed.hdr", b""), file("seed.exr", b""));
    environment::save_hdr(&hdr, &map).expect("a scratch file");
    environment::save_exr(&exr, &map).expect("a scratch file");
    let png = photo::encode_png(&ImageU8 { width: 4, height: 2, channels: 3, data: (0..24).map(|i| i * 11).collect() });
    [hdr, exr].iter().map(|p| std::fs::read(p).expect("a scratch file")).chain([png]).collect()
}

/// Reads coefficients of light.
pub fn sh_text(data: &[u8]) {
    let path = file("light.txt", data);
    if let Ok(text) = sh_text::read(&path) {
        sh_text::save(&path, &text.light, text.sun.as_ref()).expect("a scratch file");
        let again = sh_text::read(&path).expect("what was written");
        assert_eq!((again.light, again.sun.map(|s| s.1)), (text.light, text.sun.map(|s| s.1)));
        assert!(again.sun.is_none_or(|s| (s.0 - text.sun.expect("one").0).length() < 1e-12));
    }
}

pub fn sh_seeds() -> Vec<Vec<u8>> {
    let path = file("light.txt", b"");
    let light = ShLight(std::array::from_fn(|i| [i as f64, 0.25, -1e-3]));
    sh_text::save(&path, &light, Some(&(DVec3::Z, [1.0, 0.5, 0.0]))).expect("a scratch file");
    vec![std::fs::read(path).expect("a scratch file"), b"# light\n1,2,3\n4 5 6\n".to_vec()]
}

/// Reads a matrix of NeRF-OSR.
pub fn osr_matrix(data: &[u8]) {
    if let Ok(matrix) = nerf_osr::parse_matrix(data, Path::new("pose.txt")) {
        assert!(matrix.iter().all(|v| v.is_finite()));
    }
}

pub fn osr_seeds() -> Vec<Vec<u8>> {
    vec![b"1 0 0 0.5\n0 1 0 -2e1\n0 0 1 0\n0 0 0 1\n".to_vec(), b"1 2 nan".to_vec()]
}

/// Reads a list of sessions.
pub fn session_list(data: &[u8]) {
    if let Ok(list) = sessions::parse_list(data, Path::new("sessions.txt")) {
        assert!(list.values().all(|session| !session.contains(char::is_whitespace)));
    }
}

pub fn session_seeds() -> Vec<Vec<u8>> {
    vec![b"# names\na.jpg noon\nb c.jpg, dusk\r\n".to_vec(), b"alone\n".to_vec()]
}

/// Labels of writing: as our own lines, then in each foreign format.
pub fn text_labels(data: &[u8]) {
    let Ok(text) = std::str::from_utf8(data) else { return };
    if let Ok(images) = text_labels::parse(text) {
        assert!(images.iter().flat_map(|i| &i.regions).all(|r| r.polygon.len() > 2));
    }
    for format in text_labels::Format::ALL {
        let _ = text_labels::count(format, text);
    }
}

pub fn text_label_seeds() -> Vec<Vec<u8>> {
    [
        r#"{"image":"a.png","regions":[{"id":0,"polygon":[[0,0],[4,0],[4,2],[0,2]],"transcription":"A","kind":"custom","ignore":true}]}"#,
        r#"{"imagePath":"a.png","shapes":[{"label":"A","points":[[0,0],[4,2]],"group_id":1,"shape_type":"rectangle"}]}"#,
        "a.png\t[{\"transcription\":\"A\",\"points\":[[0,0],[4,0],[4,2],[0,2]],\"difficult\":true}]\n",
        "1 2 3 4 \"A, b\"\n",
        "\u{feff}0,0,4,0,4,2,0,2,Latin,A, b\r\n",
    ]
    .map(|s| s.as_bytes().to_vec())
    .to_vec()
}
