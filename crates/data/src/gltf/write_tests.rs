use super::*;
use diorama_geom::glam::{DAffine3, DMat3, DQuat, DVec3, EulerRot};
use diorama_geom::model::{Instance, Material, Model, Opacity, Part, Texture, Wrap};
use diorama_geom::{ImageU8, Mesh};
use proptest::prelude::*;
use std::path::Path;

const WRAPS: [Wrap; 3] = [Wrap::Repeat, Wrap::Mirror, Wrap::Clamp];

fn unit(v: [f32; 3]) -> [f32; 3] {
    let l = v.iter().map(|v| v * v).sum::<f32>().sqrt();
    if l > 0.1 { v.map(|v| v / l) } else { [0.0, 0.0, 1.0] }
}

fn any_mesh() -> impl Strategy<Value = Mesh> {
    (3usize..12, any::<bool>()).prop_flat_map(|(n, colors)| {
        let vector = || proptest::array::uniform3(-1.0f32..1.0);
        let many = |k: usize| proptest::collection::vec(vector(), k);
        let faces = proptest::collection::vec(proptest::array::uniform3(0..n as u32), 1..20);
        let uvs = proptest::collection::vec(proptest::array::uniform2(-0.2f32..1.2), n);
        (many(n), many(n), many(n), many(if colors { n } else { 0 }), uvs, faces).prop_map(
            |(positions, normals, tangents, colors, uvs, faces)| Mesh {
                positions: positions.into_iter().map(|p| p.map(|v| 10.0 * v)).collect(),
                normals: normals.into_iter().map(unit).collect(),
                tangents: tangents.into_iter().map(|t| (unit(t), t[0])).map(|([x, y, z], s)| [x, y, z, s.signum()]).collect(),
                colors_srgb: colors.into_iter().map(|c| c.map(f32::abs)).collect(),
                uvs,
                faces,
                ..Mesh::default()
            },
        )
    })
}

fn any_texture() -> impl Strategy<Value = Texture> {
    (1usize..4, 1usize..4, 3usize..5, 0usize..3, 0usize..3).prop_flat_map(|(width, height, channels, s, t)| {
        proptest::collection::vec(any::<u8>(), width * height * channels)
            .prop_map(move |data| Texture { image: ImageU8 { width, height, channels, data }, wrap: [WRAPS[s], WRAPS[t]] })
    })
}

fn any_material(textures: usize) -> impl Strategy<Value = Material> {
    let texture = move || proptest::option::of(0..textures);
    let unit = 0.0f32..=1.0;
    let opacity = prop_oneof![Just(Opacity::Opaque), Just(Opacity::Blend), unit.clone().prop_map(Opacity::Cutoff)];
    let numbers =
        (proptest::array::uniform4(unit.clone()), unit.clone(), unit.clone(), -2.0f32..2.0, proptest::array::uniform3(0.0f32..9.0), unit);
    (numbers, (texture(), texture(), texture(), texture()), opacity, any::<bool>(), any::<bool>(), "[a-z ü]{0,6}").prop_map(
        |(
            (base_color, roughness, metallic, normal_scale, emission, transmission),
            (base, packed, normal, glow),
            opacity,
            occlusion,
            two_sided,
            name,
        )| Material {
            name,
            base_color,
            base_color_texture: base,
            roughness,
            metallic,
            specular: 1.0 - 0.5 * metallic,
            metallic_roughness_texture: packed,
            is_occluding: occlusion && packed.is_some(),
            normal_texture: normal,
            normal_scale: if normal.is_some() { normal_scale } else { 1.0 },
            emission,
            emission_texture: glow.filter(|_| emission != [0.0; 3]),
            transmission,
            opacity,
            is_two_sided: two_sided,
        },
    )
}

fn any_place() -> impl Strategy<Value = DAffine3> {
    let shear = prop_oneof![Just(0.0f64), -0.5..0.5f64];
    (
        proptest::array::uniform3(-3.0..3.0f64),
        proptest::array::uniform3(0.3..3.0f64),
        proptest::array::uniform3(-50.0..50.0f64),
        any::<bool>(),
        shear,
    )
        .prop_map(|([a, b, c], scale, t, mirror, shear)| {
            let rotation = DQuat::from_euler(EulerRot::XYZ, a, b, c);
            let scale = DVec3::from(scale) * if mirror { DVec3::new(1.0, -1.0, 1.0) } else { DVec3::ONE };
            let sheared = DMat3::from_cols(DVec3::X, DVec3::new(shear, 1.0, 0.0), DVec3::Z);
            let placed = DAffine3::from_scale_rotation_translation(scale, rotation, t.into());
            placed * DAffine3::from_mat3(sheared)
        })
}

fn any_model() -> impl Strategy<Value = Model> {
    let textures = proptest::collection::vec(any_texture(), 1..4);
    (textures, 1usize..3, 1usize..4, 1usize..5).prop_flat_map(|(textures, materials, parts, instances)| {
        let part = (any_mesh(), 0..materials, "[a-z]{0,6}").prop_map(|(mesh, material, name)| Part { name, mesh, material });
        let instance = (0..parts, any_place()).prop_map(|(part, world_from_part)| Instance { part, world_from_part });
        let materials = proptest::collection::vec(any_material(textures.len()), materials);
        (Just(textures), materials, proptest::collection::vec(part, parts), proptest::collection::vec(instance, instances))
            .prop_map(|(textures, materials, parts, instances)| Model { textures, materials, parts, instances })
    })
}

/// What a triangle's corner looks like in the world.
#[derive(Debug)]
struct Corner {
    position: DVec3,
    normal: DVec3,
    tangent: DVec3,
    /// Of the tangent, times that of the transform's determinant.
    sign: f64,
    uv: [f32; 2],
    color: Option<[f32; 3]>,
}

fn corners(model: &Model) -> Vec<(Corner, &Material)> {
    let mut out = Vec::new();
    for Instance { part, world_from_part } in &model.instances {
        let Part { mesh, material, .. } = &model.parts[*part];
        let m = world_from_part.matrix3;
        let is_mirrored = m.determinant() < 0.0;
        for face in &mesh.faces {
            // The outside of a mirrored face has its corners clockwise.
            let order = if is_mirrored { [0, 2, 1] } else { [0, 1, 2] };
            for i in order.map(|k| face[k] as usize) {
                let vector = |v: [f32; 3]| DVec3::from(v.map(f64::from));
                let tangent = mesh.tangents.get(i).copied().unwrap_or_default();
                let corner = Corner {
                    position: world_from_part.transform_point3(vector(mesh.positions[i])),
                    normal: (m.inverse().transpose() * vector(mesh.normals[i])).normalize(),
                    tangent: (m * vector([tangent[0], tangent[1], tangent[2]])).normalize_or_zero(),
                    sign: tangent[3] as f64 * if is_mirrored { -1.0 } else { 1.0 },
                    uv: mesh.uvs[i],
                    color: mesh.colors_srgb.get(i).copied(),
                };
                out.push((corner, &model.materials[*material]));
            }
        }
    }
    out
}

/// A material whose textures are given by value.
fn resolved(model: &Model, m: &Material) -> (Material, Vec<Option<Texture>>) {
    let bare = Material {
        base_color_texture: None,
        metallic_roughness_texture: None,
        normal_texture: None,
        emission_texture: None,
        emission: [0.0; 3],
        ..m.clone()
    };
    let all = [m.base_color_texture, m.metallic_roughness_texture, m.normal_texture, m.emission_texture];
    (bare, all.map(|i| i.map(|i| model.textures[i].clone())).to_vec())
}

fn again(model: &Model, quantize: bool) -> Model {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.glb");
    save(&path, model, WriteOptions { quantize }).unwrap();
    let loaded = read(&path).unwrap();
    assert_eq!(loaded.notes, Vec::<String>::new());
    loaded.model
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn models_round_trip(model in any_model(), quantize in any::<bool>()) {
        let read = again(&model, quantize);
        let (want, got) = (corners(&model), corners(&read));
        prop_assert_eq!(want.len(), got.len());
        // Half a step of positions is 20 / 65535 / 2, scaled and sheared by up to 4; of normals 1 / 254 in each of three directions.
        let (near, straight) = if quantize { (1.5e-3, 0.08) } else { (1e-4, 1e-4) };
        for ((a, material_a), (b, material_b)) in want.iter().zip(&got) {
            prop_assert!((a.position - b.position).length() < near, "{:?} {:?}", a, b);
            prop_assert!((a.normal - b.normal).length() < straight, "{:?} {:?}", a, b);
            prop_assert!((0..2).all(|k| (a.uv[k] - b.uv[k]).abs() < 1e-5), "{:?} {:?}", a, b);
            if material_a.normal_texture.is_some() {
                prop_assert!((a.tangent - b.tangent).length() < straight && a.sign == b.sign, "{:?} {:?}", a, b);
            }
            prop_assert_eq!(a.color.is_some(), b.color.is_some());
            if let (Some(a), Some(b)) = (a.color, b.color) {
                // 16 bits, linear: 12.92 times as coarse near black.
                prop_assert!((0..3).all(|k| (a[k] - b[k]).abs() < 13.0 / 65535.0), "{:?} {:?}", a, b);
            }
            prop_assert_eq!(resolved(&model, material_a), resolved(&read, material_b));
            let (a, b) = (material_a.emission, material_b.emission);
            prop_assert!((0..3).all(|k| (a[k] - b[k]).abs() <= 1e-5), "{:?} {:?}", a, b);
        }
    }
}

fn triangle() -> Model {
    Model::of("t", Mesh { positions: vec![[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], faces: vec![[0, 1, 2]], ..Mesh::default() })
}

#[test]
fn instances_share_a_mesh_and_unused_parts_are_left_out() {
    let mut model = triangle();
    model.add(triangle(), DAffine3::IDENTITY);
    model.instances[1] = Instance { part: 0, world_from_part: DAffine3::from_translation(DVec3::new(0.0, 0.0, 7.0)) };
    let read = again(&model, false);
    assert_eq!((read.parts.len(), read.instances.len(), read.materials.len()), (1, 2, 1));
    assert_eq!(read.instances, model.instances);
}

#[test]
fn quantized_files_are_smaller() {
    let n = 40u32;
    let positions = (0..n * n).map(|i| [(i % n) as f32, (i / n) as f32, 0.0]).collect();
    let faces = (0..n * (n - 1)).filter(|i| i % n != n - 1).flat_map(|i| [[i, i + 1, i + n], [i + 1, i + n + 1, i + n]]).collect();
    let mut mesh = Mesh { positions, uvs: vec![[0.5; 2]; (n * n) as usize], faces, ..Mesh::default() };
    mesh.compute_normals();
    let model = Model::of("plane", mesh);
    let size = |quantize| encode(&model, WriteOptions { quantize }, Path::new("a.glb")).unwrap().len();
    // 16 bytes a vertex in place of 32.
    assert!(size(false) - size(true) > 15 * (n * n) as usize, "{} and {}", size(false), size(true));
}

#[test]
fn what_gltf_does_not_allow_is_refused() {
    let refused = |change: &dyn Fn(&mut Model)| {
        let mut model = triangle();
        change(&mut model);
        encode(&model, WriteOptions::default(), Path::new("a.glb")).unwrap_err().to_string()
    };
    for (got, want) in [
        (refused(&|m| m.instances.clear()), "a.glb: the model has no triangles"),
        (refused(&|m| m.materials[0].roughness = 1.5), "material \"t\": roughness is 1.5, not 0 to 1"),
        (refused(&|m| m.materials[0].emission[1] = f32::NAN), "emission is NaN"),
        (refused(&|m| m.parts[0].mesh.positions[1][0] = f32::INFINITY), "part \"t\" has the position 1 that is not finite"),
        (refused(&|m| m.parts[0].mesh.faces[0][2] = 3), "has a face with vertex 3, but 3 vertices"),
        (refused(&|m| m.instances[0].world_from_part.translation.x = f64::NAN), "a place that is not finite"),
        (
            refused(&|m| {
                m.textures.push(Texture {
                    image: ImageU8 { width: 1, height: 1, channels: 3, data: vec![0; 3] },
                    wrap: WRAPS[..2].try_into().unwrap(),
                });
                m.materials[0].base_color_texture = Some(0);
            }),
            "has no texture coordinates for the textures of material \"t\"",
        ),
    ] {
        assert!(got.contains(want), "{want}: {got}");
    }
}
