use super::*;
use crate::{mesh_text, photo};
use diorama_geom::ImageU8;
use diorama_geom::model::Opacity;

fn write(dir: &Path, obj: &str, mtl: &str) -> std::path::PathBuf {
    let path = dir.join("a.obj");
    std::fs::write(&path, obj).unwrap();
    std::fs::write(dir.join("a b.mtl"), mtl).unwrap();
    path
}

fn parse(obj: &str) -> Result<LoadedModel> {
    let dir = tempfile::tempdir().unwrap();
    read(&write(dir.path(), obj, ""), None)
}

const CORNERS: &str = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nvn 0 0 2\n";

#[test]
fn materials_become_parts_with_textures() {
    let dir = tempfile::tempdir().unwrap();
    photo::save_png(&dir.path().join("old wood.png"), &ImageU8 { width: 1, height: 1, channels: 3, data: vec![4, 5, 6] }).unwrap();
    let mtl =
        "# wood\nnewmtl wood\n Kd 0 0 0\nmap_Kd -s 1 1 1 C:\\here\\old wood.png\nnewmtl glass\nKd 0.1 0.2 0.3\nd 0.25\nKe 2\nPr 0.5\n";
    let obj = format!("mtllib a b.mtl\n{CORNERS}usemtl wood\nf 1/1/1 2/2/1 3/3/1 4/4/1\nusemtl glass\nf -4//-1 \\\n-3//-1 -2//-1\n");
    let LoadedModel { model, notes } = read(&write(dir.path(), &obj, mtl), None).unwrap();
    let [wood, glass] = &model.parts[..] else { panic!("{} parts", model.parts.len()) };
    assert_eq!((wood.name.as_str(), wood.mesh.faces.as_slice()), ("wood", &[[0, 1, 2], [0, 2, 3]][..]));
    assert_eq!((wood.mesh.positions[2], wood.mesh.normals[0], wood.mesh.uvs[0]), ([1.0, 0.0, 1.0], [0.0, -1.0, 0.0], [0.0, 1.0]));
    assert_eq!((glass.mesh.faces.len(), glass.mesh.uvs.len(), glass.mesh.normals.len()), (1, 0, 3));
    let (wood, glass) = (&model.materials[wood.material], &model.materials[glass.material]);
    assert_eq!(model.textures[wood.base_color_texture.unwrap()].image.data, [4, 5, 6]);
    assert_eq!(wood.base_color[..3], [1.0; 3]);
    assert!(notes.len() == 1 && notes[0].contains("Kd is black"), "{notes:?}");
    assert_eq!((glass.base_color, glass.opacity, glass.emission, glass.roughness), ([0.1, 0.2, 0.3, 0.25], Opacity::Blend, [2.0; 3], 0.5));
}

#[test]
fn our_own_files_round_trip_with_z_up() {
    let mesh = Mesh {
        positions: vec![[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 3.0]],
        normals: vec![[0.0, 0.0, 1.0]; 3],
        uvs: vec![[0.0, 0.25], [1.0, 0.5], [0.0, 0.75]],
        texture: Some(ImageU8 { width: 1, height: 1, channels: 3, data: vec![7; 3] }),
        faces: vec![[0, 1, 2]],
        ..Mesh::default()
    };
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("b.obj");
    mesh_text::save_obj(&path, &mesh).unwrap();
    let LoadedModel { mut model, notes } = read(&path, None).unwrap();
    assert_eq!(notes, Vec::<String>::new());
    assert_eq!(model.textures[0].image.data, [7; 3]);
    assert_eq!(model.parts.remove(0).mesh, Mesh { texture: None, ..mesh.clone() });
    let turned = read(&path, Some(Up::Y)).unwrap().model;
    assert_eq!(turned.parts[0].mesh.positions[2], [0.0, -3.0, 1.0]);
}

#[test]
fn colors_of_vertices_are_read() {
    let model = parse("v 0 0 0 1 0 0\nv 1 0 0 0 1 0\nv 0 1 0 0 0 0.5\nf 1 2 3\n").unwrap().model;
    assert_eq!(model.parts[0].mesh.colors_srgb, [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.5]]);
}

#[test]
fn missing_materials_are_noted() {
    let notes = parse(&format!("mtllib lost.mtl\n{CORNERS}f 1 2 3\nusemtl gold\nf 1 2 3\n")).unwrap().notes;
    for want in ["lost.mtl is missing", "mesh \"a\": faces without a material", "material \"gold\" is in no .mtl"] {
        assert!(notes.iter().any(|n| n.contains(want)), "{want}: {notes:?}");
    }
}

#[test]
fn errors_name_the_line() {
    for (text, want) in [
        ("v 0 0\n", "line 1: \"0 0\" is not 3 finite numbers"),
        ("v 0 0 nan\n", "line 1:"),
        ("v 0 0 0\nf 1 2 3\n", "line 2: vertex 2 does not exist; there are 1 so far"),
        ("v 0 0 0\nf -2 -1 -1\n", "line 2: vertex -2 does not exist"),
        ("v 0 0 0\nf 0 1 1\n", "line 2: vertex 0 does not exist"),
        ("v 0 0 0\nf 1/x 1 1\n", "line 2: \"x\" is not an index of a texture coordinate"),
        ("v 0 0 0\nf 1 1\n", "line 2: a face has fewer than 3 corners"),
        ("v 0 0 0\n", "a.obj: the file has no faces"),
    ] {
        let e = parse(text).unwrap_err().to_string();
        assert!(e.contains(want), "{want}: {e}");
    }
}
