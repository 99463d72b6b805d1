//! COLLADA 1.4.1 for SketchUp and other CAD programs: z up, meters, one material with a PNG texture beside the file or with vertex colors.

use crate::error::Result;
use crate::{atomic, mesh_text};
use diorama_geom::Mesh;
use std::io::Write;
use std::path::Path;

/// Writes a `.dae`, and its texture beside it.
///
/// # Errors
/// If the mesh is empty or the file cannot be written.
pub fn save(path: &Path, mesh: &Mesh) -> Result<()> {
    mesh_text::check(path, mesh)?;
    let texture = mesh_text::save_texture(path, mesh)?;
    atomic::write_with(path, |w| write(w, mesh, texture.as_deref()))
}

fn write(w: &mut impl Write, mesh: &Mesh, texture: Option<&str>) -> std::io::Result<()> {
    let n = mesh.positions.len();
    writeln!(w, r#"<?xml version="1.0" encoding="utf-8"?>"#)?;
    writeln!(w, r#"<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">"#)?;
    // The date is fixed so that equal meshes give equal files.
    let date = "2026-01-01T00:00:00Z";
    writeln!(w, "<asset><contributor><authoring_tool>diorama {}</authoring_tool></contributor>", env!("CARGO_PKG_VERSION"))?;
    writeln!(w, r#"<created>{date}</created><modified>{date}</modified><unit name="meter" meter="1"/><up_axis>Z_UP</up_axis></asset>"#)?;
    if let Some(file) = texture {
        writeln!(w, r#"<library_images><image id="albedo"><init_from>{}</init_from></image></library_images>"#, escaped(file))?;
    }
    writeln!(w, r#"<library_effects><effect id="effect"><profile_COMMON>"#)?;
    if texture.is_some() {
        writeln!(w, r#"<newparam sid="surface"><surface type="2D"><init_from>albedo</init_from></surface></newparam>"#)?;
        writeln!(w, r#"<newparam sid="sampler"><sampler2D><source>surface</source></sampler2D></newparam>"#)?;
    }
    let diffuse = if texture.is_some() { r#"<texture texture="sampler" texcoord="UVMap"/>"# } else { "<color>1 1 1 1</color>" };
    writeln!(w, r#"<technique sid="common"><lambert><diffuse>{diffuse}</diffuse></lambert></technique>"#)?;
    writeln!(w, "</profile_COMMON></effect></library_effects>")?;
    writeln!(
        w,
        r##"<library_materials><material id="material" name="radiance"><instance_effect url="#effect"/></material></library_materials>"##
    )?;
    writeln!(w, r#"<library_geometries><geometry id="mesh" name="mesh"><mesh>"#)?;
    source(w, "positions", "XYZ", &mesh.positions)?;
    let normals = mesh.normals.len() == n;
    if normals {
        source(w, "normals", "XYZ", &mesh.normals)?;
    }
    let uvs: Vec<[f32; 2]> = mesh.uvs.iter().map(|[u, v]| [*u, 1.0 - v]).collect();
    if texture.is_some() {
        source(w, "uvs", "ST", &uvs)?;
    }
    let colors = texture.is_none() && mesh.colors_srgb.len() == n;
    if colors {
        source(w, "colors", "RGB", &mesh.colors_srgb)?;
    }
    writeln!(w, r##"<vertices id="vertices"><input semantic="POSITION" source="#positions"/></vertices>"##)?;
    writeln!(w, r#"<triangles material="material" count="{}">"#, mesh.faces.len())?;
    writeln!(w, r##"<input semantic="VERTEX" source="#vertices" offset="0"/>"##)?;
    if normals {
        writeln!(w, r##"<input semantic="NORMAL" source="#normals" offset="0"/>"##)?;
    }
    if texture.is_some() {
        writeln!(w, r##"<input semantic="TEXCOORD" source="#uvs" offset="0" set="0"/>"##)?;
    }
    if colors {
        writeln!(w, r##"<input semantic="COLOR" source="#colors" offset="0"/>"##)?;
    }
    write!(w, "<p>")?;
    for f in &mesh.faces {
        write!(w, "{} {} {} ", f[0], f[1], f[2])?;
    }
    writeln!(w, "</p></triangles></mesh></geometry></library_geometries>")?;
    writeln!(w, r#"<library_visual_scenes><visual_scene id="scene"><node id="object" name="object">"#)?;
    writeln!(
        w,
        r##"<instance_geometry url="#mesh"><bind_material><technique_common><instance_material symbol="material" target="#material">"##
    )?;
    if texture.is_some() {
        writeln!(w, r#"<bind_vertex_input semantic="UVMap" input_semantic="TEXCOORD" input_set="0"/>"#)?;
    }
    writeln!(w, "</instance_material></technique_common></bind_material></instance_geometry>")?;
    writeln!(w, "</node></visual_scene></library_visual_scenes>")?;
    writeln!(w, r##"<scene><instance_visual_scene url="#scene"/></scene></COLLADA>"##)
}

fn source<const N: usize>(w: &mut impl Write, id: &str, names: &str, rows: &[[f32; N]]) -> std::io::Result<()> {
    write!(w, r#"<source id="{id}"><float_array id="{id}-array" count="{}">"#, rows.len() * N)?;
    for v in rows.as_flattened() {
        write!(w, "{v} ")?;
    }
    writeln!(w, "</float_array><technique_common>")?;
    write!(w, r##"<accessor source="#{id}-array" count="{}" stride="{N}">"##, rows.len())?;
    for name in names.chars() {
        write!(w, r#"<param name="{name}" type="float"/>"#)?;
    }
    writeln!(w, "</accessor></technique_common></source>")
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}
