//! USDZ for AR: an uncompressed zip whose entries start at multiples of 64 bytes, with a scene as text (`.usda`) and its texture. The
//! scene is y up and in meters, as AR viewers expect: (x, y, z) is written as (x, z, −y).

use crate::error::{DataError, Result};
use crate::{atomic, mesh_text, photo};
use diorama_geom::Mesh;
use diorama_geom::color::linear_from_srgb;
use std::fmt::Write;
use std::path::Path;

/// Alignment of the data of each entry, in bytes.
const ALIGNMENT: usize = 64;

/// Writes a `.usdz`.
///
/// # Errors
/// If the mesh is empty, the file would exceed 4 GiB, or the file cannot be written.
pub fn save(path: &Path, mesh: &Mesh) -> Result<()> {
    mesh_text::check(path, mesh)?;
    let mut entries = vec![("scene.usda", scene(mesh).into_bytes())];
    if let Some(t) = mesh.texture.as_ref().filter(|_| mesh.uvs.len() == mesh.positions.len()) {
        entries.push(("textures/albedo.png", photo::encode_png(t)));
    }
    let bytes = stored_zip(&entries).ok_or_else(|| DataError::input(path, "the mesh exceeds 4 GiB, the limit of .usdz; lower --faces"))?;
    atomic::write(path, &bytes)
}

/// The scene as `.usda` text.
fn scene(mesh: &Mesh) -> String {
    let n = mesh.positions.len();
    let y_up = |p: &[f32; 3]| [p[0], p[2], -p[1]];
    let mut s = String::with_capacity(n * 80 + mesh.faces.len() * 24);
    let textured = mesh.texture.is_some() && mesh.uvs.len() == n;
    let turned: Vec<[f32; 3]> = mesh.positions.iter().map(y_up).collect();
    let (lo, hi) = turned.iter().fold(([f32::MAX; 3], [f32::MIN; 3]), |(lo, hi), p| {
        (std::array::from_fn(|k| lo[k].min(p[k])), std::array::from_fn(|k| hi[k].max(p[k])))
    });
    s.push_str("#usda 1.0\n(\n    defaultPrim = \"Root\"\n    metersPerUnit = 1\n    upAxis = \"Y\"\n)\n\n");
    s.push_str("def Xform \"Root\" (\n    kind = \"component\"\n)\n{\n    def Mesh \"Object\" (\n        prepend apiSchemas = [\"MaterialBindingAPI\"]\n    )\n    {\n");
    s.push_str("        uniform bool doubleSided = 1\n        uniform token subdivisionScheme = \"none\"\n");
    tuples(&mut s, "float3[] extent", [lo, hi].iter().copied(), "");
    numbers(&mut s, "int[] faceVertexCounts", mesh.faces.iter().map(|_| 3));
    numbers(&mut s, "int[] faceVertexIndices", mesh.faces.iter().flatten().copied());
    tuples(&mut s, "point3f[] points", turned.into_iter(), "");
    if mesh.normals.len() == n {
        tuples(&mut s, "normal3f[] normals", mesh.normals.iter().map(y_up), "interpolation = \"vertex\"");
    }
    if textured {
        let uvs = mesh.uvs.iter().map(|[u, v]| [*u, 1.0 - v]);
        tuples(&mut s, "texCoord2f[] primvars:st", uvs, "interpolation = \"vertex\"");
    } else if mesh.colors_srgb.len() == n {
        let linear = mesh.colors_srgb.iter().map(|c| c.map(|v| linear_from_srgb(v.clamp(0.0, 1.0))));
        tuples(&mut s, "color3f[] primvars:displayColor", linear, "interpolation = \"vertex\"");
    }
    s.push_str("        rel material:binding = </Root/Material>\n    }\n\n    def Material \"Material\"\n    {\n");
    s.push_str(
        "        token outputs:surface.connect = </Root/Material/Surface.outputs:surface>\n\n        def Shader \"Surface\"\n        {\n",
    );
    s.push_str("            uniform token info:id = \"UsdPreviewSurface\"\n            float inputs:roughness = 1\n            float inputs:metallic = 0\n");
    let from = match (textured, mesh.colors_srgb.len() == n) {
        (true, _) => "color3f inputs:diffuseColor.connect = </Root/Material/Albedo.outputs:rgb>",
        (false, true) => "color3f inputs:diffuseColor.connect = </Root/Material/Color.outputs:result>",
        _ => "color3f inputs:diffuseColor = (0.8, 0.8, 0.8)",
    };
    let _ = writeln!(s, "            {from}\n            token outputs:surface\n        }}");
    if textured {
        s.push_str("\n        def Shader \"Albedo\"\n        {\n            uniform token info:id = \"UsdUVTexture\"\n");
        s.push_str("            asset inputs:file = @textures/albedo.png@\n            token inputs:sourceColorSpace = \"sRGB\"\n");
        s.push_str("            token inputs:wrapS = \"clamp\"\n            token inputs:wrapT = \"clamp\"\n");
        s.push_str("            float2 inputs:st.connect = </Root/Material/Coordinates.outputs:result>\n            color3f outputs:rgb\n        }\n");
        s.push_str("\n        def Shader \"Coordinates\"\n        {\n            uniform token info:id = \"UsdPrimvarReader_float2\"\n");
        s.push_str("            string inputs:varname = \"st\"\n            float2 outputs:result\n        }\n");
    } else if mesh.colors_srgb.len() == n {
        s.push_str("\n        def Shader \"Color\"\n        {\n            uniform token info:id = \"UsdPrimvarReader_float3\"\n");
        s.push_str("            string inputs:varname = \"displayColor\"\n            float3 outputs:result\n        }\n");
    }
    s.push_str("    }\n}\n");
    s
}

fn tuples<const N: usize>(s: &mut String, name: &str, rows: impl Iterator<Item = [f32; N]>, metadata: &str) {
    let _ = write!(s, "        {name} = [");
    for (i, row) in rows.enumerate() {
        s.push_str(if i > 0 { ", (" } else { "(" });
        for (k, v) in row.iter().enumerate() {
            let _ = write!(s, "{}{v}", if k > 0 { ", " } else { "" });
        }
        s.push(')');
    }
    s.push(']');
    if !metadata.is_empty() {
        let _ = write!(s, " (\n            {metadata}\n        )");
    }
    s.push('\n');
}

fn numbers(s: &mut String, name: &str, values: impl Iterator<Item = u32>) {
    let _ = write!(s, "        {name} = [");
    for (i, v) in values.enumerate() {
        let _ = write!(s, "{}{v}", if i > 0 { ", " } else { "" });
    }
    s.push_str("]\n");
}

/// A zip without compression; `None` beyond 4 GiB.
fn stored_zip(entries: &[(&str, Vec<u8>)]) -> Option<Vec<u8>> {
    let (mut out, mut directory) = (Vec::new(), Vec::new());
    for (name, data) in entries {
        let (at, size) = (u32::try_from(out.len()).ok()?, u32::try_from(data.len()).ok()?);
        // An extra field of zeros pads the header; the field's own header has four bytes.
        let unpadded = out.len() + 30 + name.len() + 4;
        let padding = unpadded.next_multiple_of(ALIGNMENT) - unpadded;
        // Version 1.0, no flags, stored, 1980-01-01.
        let mut common = Vec::new();
        for v in [10u16, 0, 0, 0, 0x21] {
            common.extend(v.to_le_bytes());
        }
        for v in [crc32fast::hash(data), size, size] {
            common.extend(v.to_le_bytes());
        }
        common.extend((name.len() as u16).to_le_bytes());
        out.extend(b"PK\x03\x04");
        out.extend(&common);
        out.extend((padding as u16 + 4).to_le_bytes());
        out.extend(name.as_bytes());
        out.extend(0x1986u16.to_le_bytes());
        out.extend((padding as u16).to_le_bytes());
        out.resize(out.len() + padding, 0);
        out.extend(data);
        directory.extend(b"PK\x01\x02");
        directory.extend(10u16.to_le_bytes());
        directory.extend(&common);
        // No extra field, comment, disk number or attributes.
        directory.extend([0; 12]);
        directory.extend(at.to_le_bytes());
        directory.extend(name.as_bytes());
    }
    let (at, n) = (u32::try_from(out.len()).ok()?, entries.len() as u16);
    out.extend(&directory);
    out.extend(b"PK\x05\x06\0\0\0\0");
    out.extend([n.to_le_bytes(), n.to_le_bytes()].concat());
    out.extend((directory.len() as u32).to_le_bytes());
    out.extend(at.to_le_bytes());
    out.extend([0, 0]);
    Some(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn entries_begin_at_multiples_of_64_bytes() {
        let zip = stored_zip(&[("a.txt", b"hello".to_vec()), ("folder/b.bin", vec![7; 100])]).unwrap();
        let starts: Vec<usize> = [&b"hello"[..], &[7; 100]].iter().map(|d| zip.windows(d.len()).position(|w| w == *d).unwrap()).collect();
        assert!(starts.iter().all(|s| s % 64 == 0), "{starts:?}");
    }
}
