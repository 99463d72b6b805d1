use super::*;
use crate::loaded_model::LoadedModel;
use crate::photo;
use diorama_geom::ImageU8;
use diorama_geom::color::linear_from_srgb;
use diorama_geom::glam::DVec3;
use diorama_geom::model::{Opacity, Wrap};
use serde_json::{Value, json};
use std::path::Path;

/// A data URI of bytes, percent-encoded.
fn uri(bytes: &[u8]) -> String {
    "data:application/octet-stream,".to_string() + &bytes.iter().map(|b| format!("%{b:02x}")).collect::<String>()
}

fn floats(v: &[f32]) -> Vec<u8> {
    v.iter().flat_map(|v| v.to_le_bytes()).collect()
}

/// Two triangles of a square, three corners each, in the plane z = 0 of a world whose y points up.
const SQUARE: [f32; 18] = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 1.0, 0.0];
const UVS: [f32; 12] = [0.0, 1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0];

/// A scene of one mesh. Buffer views 0 to 2 hold positions, texture coordinates, and a PNG of one pixel.
fn scene() -> Value {
    let png = photo::encode_png(&ImageU8 { width: 1, height: 1, channels: 3, data: vec![10, 20, 30] });
    let parts = [floats(&SQUARE), floats(&UVS), png];
    let mut at = 0;
    let views: Vec<Value> = parts
        .iter()
        .map(|p| {
            at += p.len();
            json!({ "buffer": 0, "byteOffset": at - p.len(), "byteLength": p.len() })
        })
        .collect();
    json!({
        "asset": { "version": "2.0" },
        "nodes": [{ "mesh": 0 }],
        "meshes": [{ "name": "square", "primitives": [{ "attributes": { "POSITION": 0, "TEXCOORD_0": 1 }, "material": 0 }] }],
        "materials": [{ "name": "paint", "pbrMetallicRoughness": { "baseColorTexture": { "index": 0 } } }],
        "textures": [{ "source": 0, "sampler": 0 }],
        "samplers": [{ "wrapS": 33071, "wrapT": 33648 }],
        "images": [{ "bufferView": 2 }],
        "buffers": [{ "uri": uri(&parts.concat()), "byteLength": at }],
        "bufferViews": views,
        "accessors": [
            { "bufferView": 0, "componentType": 5126, "count": 6, "type": "VEC3" },
            { "bufferView": 1, "componentType": 5126, "count": 6, "type": "VEC2" },
        ],
    })
}

/// Adds an accessor with data of its own; returns its index.
fn add_accessor(scene: &mut Value, data: &[u8], kind: u32, count: usize, vector: &str) -> usize {
    let buffer = scene["buffers"].as_array().unwrap().len();
    let view = scene["bufferViews"].as_array().unwrap().len();
    scene["buffers"].as_array_mut().unwrap().push(json!({ "uri": uri(data), "byteLength": data.len() }));
    scene["bufferViews"].as_array_mut().unwrap().push(json!({ "buffer": buffer, "byteLength": data.len() }));
    let accessors = scene["accessors"].as_array_mut().unwrap();
    accessors.push(json!({ "bufferView": view, "componentType": kind, "count": count, "type": vector }));
    accessors.len() - 1
}

fn read_json(scene: &Value) -> crate::Result<LoadedModel> {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.gltf");
    std::fs::write(&path, scene.to_string()).unwrap();
    read(&path)
}

fn error(scene: &Value) -> String {
    let text = read_json(scene).unwrap_err().to_string();
    assert!(text.contains("a.gltf"), "{text}");
    text
}

#[test]
fn a_textured_square_stands_upright() {
    let LoadedModel { model, notes } = read_json(&scene()).unwrap();
    assert_eq!(notes, Vec::<String>::new());
    let part = &model.parts[0];
    assert_eq!((part.name.as_str(), part.mesh.faces.as_slice()), ("square", &[[0, 1, 2], [3, 4, 5]][..]));
    assert_eq!(part.mesh.positions[2], [1.0, 0.0, 1.0]);
    assert_eq!(part.mesh.uvs[1], [1.0, 1.0]);
    let texture = &model.textures[model.materials[0].base_color_texture.unwrap()];
    assert_eq!((texture.image.pixel(0, 0), texture.wrap), (&[10, 20, 30][..], [Wrap::Clamp, Wrap::Mirror]));
    assert_eq!((model.materials[0].roughness, model.materials[0].metallic, model.materials[0].is_two_sided), (1.0, 1.0, false));
}

#[test]
fn nodes_share_parts_and_multiply_their_transforms() {
    let mut s = scene();
    let half = 0.5f64.sqrt();
    s["nodes"] = json!([
        { "children": [1, 2], "translation": [10, 0, 0] },
        { "mesh": 0, "rotation": [0, half, 0, half], "scale": [2, 1, 1] },
        { "mesh": 0, "matrix": [1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 0, 0, 3, 4, 1] },
    ]);
    s["scenes"] = json!([{ "nodes": [0] }]);
    let model = read_json(&s).unwrap().model;
    assert_eq!((model.parts.len(), model.instances.len()), (1, 2));
    // (1, 1, 0) there; a quarter turn about y takes x to −z.
    let corner = DVec3::new(1.0, 0.0, 1.0);
    let at = |i: usize| model.instances[i].world_from_part.transform_point3(corner);
    assert!((at(0) - DVec3::new(10.0, 2.0, 1.0)).length() < 1e-12, "{}", at(0));
    assert!((at(1) - DVec3::new(11.0, -4.0, 2.0)).length() < 1e-12, "{}", at(1));
    assert!(model.instances[1].world_from_part.matrix3.determinant() < 0.0);
}

#[test]
fn strips_fans_and_indices_of_all_widths_give_the_same_square() {
    let area = |s: &Value| {
        let mesh = &read_json(s).unwrap().model.parts[0].mesh;
        let p = |i: u32| DVec3::from(mesh.positions[i as usize].map(f64::from));
        mesh.faces.iter().map(|[a, b, c]| (p(*b) - p(*a)).cross(p(*c) - p(*a)) / 2.0).sum::<DVec3>()
    };
    // Corners 0, 1, 2, 5 go around the square.
    for (mode, order) in [(4, vec![0, 1, 2, 0, 2, 5]), (5, vec![0, 1, 5, 2]), (5, vec![0, 1, 5, 5, 5, 1, 2]), (6, vec![0, 1, 2, 5])] {
        for kind in [5121, 5123, 5125] {
            let mut s = scene();
            let bytes = |i: &u32| i.to_le_bytes()[..[1, 2, 4][((kind - 5121) / 2) as usize]].to_vec();
            let data: Vec<u8> = order.iter().flat_map(bytes).collect();
            let index = add_accessor(&mut s, &data, kind, order.len(), "SCALAR");
            s["meshes"][0]["primitives"][0]["indices"] = index.into();
            s["meshes"][0]["primitives"][0]["mode"] = mode.into();
            let got = area(&s);
            assert!((got - DVec3::new(0.0, -1.0, 0.0)).length() < 1e-12, "mode {mode}, {kind}, {order:?}: {got}");
        }
    }
}

#[test]
fn quantized_sparse_and_strided_numbers_are_read() {
    let mut s = scene();
    // Positions as bytes of 1/127 in rows of 4.
    let rows: Vec<u8> = SQUARE.chunks(3).flat_map(|p| [(p[0] * 127.0) as u8, (p[1] * 127.0) as u8, 129, 7]).collect();
    let index = add_accessor(&mut s, &rows, 5120, 6, "VEC3");
    s["accessors"][index]["normalized"] = true.into();
    let view = s["accessors"][index]["bufferView"].as_u64().unwrap() as usize;
    s["bufferViews"][view]["byteStride"] = 4.into();
    s["extensionsRequired"] = json!(["KHR_mesh_quantization"]);
    s["meshes"][0]["primitives"][0]["attributes"]["POSITION"] = index.into();
    // Texture coordinates of zero, except for two.
    let indices = add_accessor(&mut s, &[1, 5], 5121, 2, "SCALAR");
    let values = add_accessor(&mut s, &[255, 0, 51, 102], 5121, 2, "VEC2");
    let view = |i: usize| s["accessors"][i]["bufferView"].clone();
    let sparse =
        json!({ "count": 2, "indices": { "bufferView": view(indices), "componentType": 5121 }, "values": { "bufferView": view(values) } });
    s["accessors"][1] = json!({ "componentType": 5121, "normalized": true, "count": 6, "type": "VEC2", "sparse": sparse });
    let mesh = read_json(&s).unwrap().model.parts.remove(0).mesh;
    assert_eq!(mesh.positions[2], [1.0, 1.0, 1.0], "129 is −127, and (x, y, z) there is (x, −z, y) here");
    assert_eq!(mesh.uvs, [[0.0, 0.0], [1.0, 0.0], [0.0, 0.0], [0.0, 0.0], [0.0, 0.0], [0.2, 0.4]]);
}

#[test]
fn colors_of_vertices_become_srgb() {
    let mut s = scene();
    let data: Vec<u8> = [[65535u16, 32768, 0]; 6].iter().flatten().flat_map(|v| v.to_le_bytes()).collect();
    let index = add_accessor(&mut s, &data, 5123, 6, "VEC3");
    s["accessors"][index]["normalized"] = true.into();
    s["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"] = index.into();
    let [r, g, b] = read_json(&s).unwrap().model.parts[0].mesh.colors_srgb[3];
    assert!((r - 1.0).abs() < 1e-6 && b == 0.0 && (linear_from_srgb(g) - 32768.0 / 65535.0).abs() < 1e-6);
}

#[test]
fn materials_keep_their_numbers() {
    let mut s = scene();
    s["extensionsUsed"] = json!(["KHR_materials_emissive_strength", "KHR_materials_transmission"]);
    s["materials"][0] = json!({
        "pbrMetallicRoughness": { "baseColorFactor": [0.1, 0.2, 0.3, 0.4], "metallicFactor": 0.5, "roughnessFactor": 0.6,
            "metallicRoughnessTexture": { "index": 0 } },
        "occlusionTexture": { "index": 0 }, "normalTexture": { "index": 0, "scale": 0.7 },
        "emissiveFactor": [1.0, 0.5, 0.0], "emissiveTexture": { "index": 0 }, "alphaMode": "MASK", "alphaCutoff": 0.25, "doubleSided": true,
        "extensions": { "KHR_materials_emissive_strength": { "emissiveStrength": 8.0 }, "KHR_materials_transmission": { "transmissionFactor": 0.9 } },
    });
    let LoadedModel { model, notes } = read_json(&s).unwrap();
    assert_eq!(notes, Vec::<String>::new());
    let m = &model.materials[0];
    assert_eq!((m.base_color, m.metallic, m.roughness), ([0.1, 0.2, 0.3, 0.4], 0.5, 0.6));
    assert_eq!((m.emission, m.transmission, m.opacity, m.is_two_sided), ([8.0, 4.0, 0.0], 0.9, Opacity::Cutoff(0.25), true));
    assert_eq!((m.metallic_roughness_texture, m.is_occluding, m.normal_texture, m.normal_scale), (Some(0), true, Some(0), 0.7));
    assert_eq!((m.base_color_texture, m.emission_texture, model.textures.len()), (None, Some(0), 1));
}

#[test]
fn transforms_of_textures_move_the_coordinates() {
    let mut s = scene();
    s["extensionsRequired"] = json!(["KHR_texture_transform"]);
    let turned = json!({ "index": 0, "extensions": { "KHR_texture_transform": {
        "offset": [0, 1], "rotation": std::f64::consts::FRAC_PI_2, "scale": [0.5, 0.5] } } });
    s["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"] = turned.clone();
    let uvs = read_json(&s).unwrap().model.parts.remove(0).mesh.uvs;
    // The specification's example shows the lower left quadrant of the image.
    let (low, high) =
        uvs.iter().fold(([9.0f32; 2], [-9.0f32; 2]), |(l, h), uv| ([l[0].min(uv[0]), l[1].min(uv[1])], [h[0].max(uv[0]), h[1].max(uv[1])]));
    for (got, want) in low.into_iter().chain(high).zip([0.0, 0.5, 0.5, 1.0]) {
        assert!((got - want).abs() < 1e-6, "{low:?} to {high:?}");
    }
    s["materials"][0]["normalTexture"] = json!({ "index": 0 });
    let e = error(&s);
    assert!(e.contains("material \"paint\"") && e.contains("different coordinates"), "{e}");
    s["materials"][0]["normalTexture"] = turned;
    assert!(read_json(&s).is_ok());
}

#[test]
fn unlit_colors_become_base_colors_and_are_noted() {
    let mut s = scene();
    s["materials"][0]["extensions"] = json!({ "KHR_materials_unlit": {} });
    let LoadedModel { model, notes } = read_json(&s).unwrap();
    let m = &model.materials[0];
    assert_eq!((m.emission, m.roughness, m.metallic, m.base_color_texture), ([0.0; 3], 1.0, 0.0, Some(0)));
    assert!(notes[0].contains("material \"paint\" is unlit"), "{notes:?}");
}

#[test]
fn what_is_assumed_or_left_out_is_noted() {
    let mut s = scene();
    s["animations"] = json!([{}]);
    s["extensionsUsed"] = json!(["KHR_lights_punctual"]);
    s["meshes"] = json!([
        { "name": "bare", "primitives": [{ "attributes": { "POSITION": 0 } }, { "attributes": { "POSITION": 0 }, "material": 0 }] },
        { "name": "wire", "primitives": [{ "attributes": { "POSITION": 0 }, "mode": 1 }] },
    ]);
    s["nodes"] = json!([{ "mesh": 0 }, { "mesh": 1 }]);
    let LoadedModel { model, notes } = read_json(&s).unwrap();
    for want in [
        "animations are left out",
        "KHR_lights_punctual is left out",
        "mesh \"bare\" has no material: the default material, matte white, is used",
        "mesh \"bare\" has no texture coordinates: the textures of its material are left out",
        "mesh \"wire\": its points or lines are left out",
    ] {
        assert!(notes.iter().any(|n| n.contains(want)), "{want}: {notes:?}");
    }
    assert!(model.materials.iter().all(|m| m.base_color_texture.is_none()));
    assert_eq!(model.materials[model.parts[0].material].metallic, 0.0);
}

#[test]
fn damaged_files_name_the_place_and_the_cure() {
    let changed = |change: &dyn Fn(&mut Value)| {
        let mut s = scene();
        change(&mut s);
        error(&s)
    };
    let primitive = |s: &mut Value, key: &str, index: usize| s["meshes"][0]["primitives"][0]["attributes"][key] = index.into();
    for (got, want) in [
        (changed(&|s| s["extensionsRequired"] = json!(["KHR_draco_mesh_compression"])), "gltf-transform/cli copy"),
        (changed(&|s| s["extensionsRequired"] = json!(["KHR_texture_basisu"])), "ktxdecompress"),
        (
            changed(&|s| {
                s["extensionsRequired"] = json!(["EXT_meshopt_compression"]);
                s["buffers"][0] = json!({ "byteLength": 9 });
            }),
            "requires the extension EXT_meshopt_compression",
        ),
        (changed(&|s| s["extensionsRequired"] = json!(["ACME_hair"])), "ACME_hair"),
        (changed(&|s| s["accessors"][0]["count"] = 7.into()), "mesh \"square\", POSITION: 7 elements do not fit into 72 bytes"),
        (changed(&|s| s["accessors"][1]["count"] = 5.into()), "mesh \"square\" has 6 positions, but 5 of TEXCOORD_0"),
        (changed(&|s| s["accessors"][0]["count"] = (1u64 << 61).into()), "are too many"),
        (changed(&|s| s["accessors"][0]["bufferView"] = 9.into()), "refers to buffer view 9, but there are 3"),
        (changed(&|s| primitive(s, "POSITION", 8)), "refers to accessor 8"),
        (changed(&|s| s["bufferViews"][0]["byteLength"] = 9999.into()), "goes past the end of buffer 0"),
        (changed(&|s| s["buffers"][0]["byteLength"] = 9999.into()), "buffer 0 should have 9999 bytes, but only"),
        (changed(&|s| s["buffers"][0]["uri"] = "lost.bin".into()), "lost.bin is missing"),
        (changed(&|s| s["buffers"][0]["uri"] = "https://a.b/c.bin".into()), "which is not fetched"),
        (changed(&|s| s["buffers"][0]["uri"] = "/etc/passwd".into()), "no relative path"),
        (changed(&|s| s["images"][0] = json!({ "uri": uri(b"text") })), "image 0: cannot be decoded"),
        (changed(&|s| s["nodes"] = json!([{ "name": "loop", "mesh": 0, "children": [0] }])), "no node of its scene"),
        (changed(&|s| s["scenes"] = json!([{ "nodes": [0, 0] }])), "node 0 is part of the scene twice"),
        (changed(&|s| s["nodes"][0]["rotation"] = json!([0, 0, 0, 0])), "its rotation is no quaternion"),
        (changed(&|s| s["materials"][0]["pbrMetallicRoughness"]["roughnessFactor"] = 2.into()), "roughnessFactor is 2, outside of 0 to 1"),
        (changed(&|s| s["meshes"] = json!([])), "refers to mesh 0, but there are 0"),
        (changed(&|s| s["accessors"][0]["componentType"] = "x".into()), "not glTF: invalid type"),
    ] {
        assert!(got.contains(want), "{want}: {got}");
    }
}

#[test]
fn an_index_beyond_the_vertices_and_a_position_that_is_not_finite_are_errors() {
    let mut s = scene();
    let index = add_accessor(&mut s, &[0, 1, 6], 5121, 3, "SCALAR");
    s["meshes"][0]["primitives"][0]["indices"] = index.into();
    assert!(error(&s).contains("index 6 is not below its 6 vertices"));
    let mut s = scene();
    let index = add_accessor(&mut s, &floats(&[0.0, 0.0, 0.0, 1.0, f32::NAN, 0.0, 0.0, 1.0, 0.0]), 5126, 3, "VEC3");
    s["meshes"][0]["primitives"][0]["attributes"] = json!({ "POSITION": index });
    assert!(error(&s).contains("position 1 is not finite"));
}

#[test]
fn files_beside_the_scene_are_found_by_encoded_names() {
    let dir = tempfile::tempdir().unwrap();
    let mut s = scene();
    std::fs::create_dir(dir.path().join("my textures")).unwrap();
    photo::save_png(
        &dir.path().join("my textures/a.png"),
        &ImageU8 { width: 1, height: 2, channels: 4, data: vec![1, 2, 3, 4, 5, 6, 7, 8] },
    )
    .unwrap();
    s["images"][0] = json!({ "uri": "my%20textures/a.png" });
    let path = dir.path().join("b.gltf");
    std::fs::write(&path, s.to_string()).unwrap();
    assert_eq!(read(&path).unwrap().model.textures[0].image.pixel(0, 1), [5, 6, 7, 8]);
}

#[test]
fn every_cut_of_a_glb_is_an_error() {
    let s = scene();
    let whole = binary::join(&s, &[0; 8], Path::new("a.glb")).unwrap();
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.glb");
    std::fs::write(&path, &whole).unwrap();
    read(&path).unwrap();
    for keep in (0..whole.len()).step_by(7).chain([whole.len() - 1]) {
        std::fs::write(&path, &whole[..keep]).unwrap();
        let e = read(&path).unwrap_err().to_string();
        assert!(e.contains("a.glb"), "{keep}: {e}");
    }
}
