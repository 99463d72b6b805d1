//! OBJ with a texture or vertex colors, binary little-endian PLY, and binary STL, all in the mesh's own axes.

use crate::error::{DataError, Result};
use crate::{atomic, photo};
use diorama_geom::Mesh;
use diorama_geom::color::u8_from_unit;
use diorama_geom::mesh::{cross, sub};
use std::io::Write;
use std::path::{Path, PathBuf};

/// Writes the texture of `model.obj` as `model.png` beside it and returns that name; `None` without a texture. Blanks in the name become
/// underscores, because many readers cannot handle blanks.
pub(crate) fn save_texture(path: &Path, mesh: &Mesh) -> Result<Option<String>> {
    let Some(t) = mesh.texture.as_ref().filter(|_| mesh.uvs.len() == mesh.positions.len()) else { return Ok(None) };
    let name = beside(path, "png");
    photo::save_png(&path.with_file_name(&name), t)?;
    Ok(Some(name))
}

/// Additional files that are written when a textured mesh is saved as `path`.
pub fn companions(path: &Path) -> Vec<PathBuf> {
    let extensions: &[&str] = match path.extension().and_then(|e| e.to_str()).unwrap_or_default() {
        "obj" => &["mtl", "png", NORMALS],
        "dae" => &["png"],
        _ => &[],
    };
    extensions.iter().map(|e| path.with_file_name(beside(path, e))).collect()
}

/// File name suffix of an OBJ's normal map.
const NORMALS: &str = "normal.png";

/// Name of an additional file of `path`.
fn beside(path: &Path, extension: &str) -> String {
    let stem = path.file_stem().unwrap_or_default().to_string_lossy();
    format!("{}.{extension}", stem.replace(char::is_whitespace, "_"))
}

/// Writes an OBJ: `v x y z`, with `r g b` if there is no texture; normals, texture coordinates, 1-based faces. A texture is written to
/// `.mtl` and `.png` files beside it.
pub fn save_obj(path: &Path, mesh: &Mesh) -> Result<()> {
    check(path, mesh)?;
    let texture = save_texture(path, mesh)?;
    let material = beside(path, "mtl");
    if let Some(t) = &texture {
        let mut text = format!("newmtl radiance\nKa 0 0 0\nKd 1 1 1\nKs 0 0 0\nillum 1\nmap_Kd {t}\n");
        if let Some(map) = &mesh.normal_map {
            let name = beside(path, NORMALS);
            photo::save_png(&path.with_file_name(&name), map)?;
            // Readers of physically based materials use `norm`, others `map_Bump`.
            text += &format!("norm {name}\nmap_Bump {name}\n");
        }
        atomic::write(&path.with_file_name(&material), text.as_bytes())?;
    }
    atomic::write_with(path, |w| {
        writeln!(w, "# diorama {}; z up", env!("CARGO_PKG_VERSION"))?;
        if texture.is_some() {
            writeln!(w, "mtllib {material}\nusemtl radiance")?;
        }
        let colored = texture.is_none() && mesh.colors_srgb.len() == mesh.positions.len();
        for (i, p) in mesh.positions.iter().enumerate() {
            write!(w, "v {} {} {}", p[0], p[1], p[2])?;
            if colored {
                let c = mesh.colors_srgb[i].map(|v| v.clamp(0.0, 1.0));
                write!(w, " {:.4} {:.4} {:.4}", c[0], c[1], c[2])?;
            }
            writeln!(w)?;
        }
        for n in &mesh.normals {
            writeln!(w, "vn {:.5} {:.5} {:.5}", n[0], n[1], n[2])?;
        }
        if texture.is_some() {
            mesh.uvs.iter().try_for_each(|[u, v]| writeln!(w, "vt {u} {}", 1.0 - v))?;
        }
        let normals = mesh.normals.len() == mesh.positions.len();
        for f in &mesh.faces {
            let [a, b, c] = f.map(|i| i + 1);
            match (texture.is_some(), normals) {
                (true, true) => writeln!(w, "f {a}/{a}/{a} {b}/{b}/{b} {c}/{c}/{c}")?,
                (true, false) => writeln!(w, "f {a}/{a} {b}/{b} {c}/{c}")?,
                (false, true) => writeln!(w, "f {a}//{a} {b}//{b} {c}//{c}")?,
                (false, false) => writeln!(w, "f {a} {b} {c}")?,
            }
        }
        Ok(())
    })
}

/// Writes a PLY; without faces it is a point cloud.
pub fn save_ply(path: &Path, mesh: &Mesh) -> Result<()> {
    atomic::write_with(path, |w| {
        let n = mesh.positions.len();
        let (normals, colors) = (mesh.normals.len() == n && n > 0, mesh.colors_srgb.len() == n && n > 0);
        writeln!(w, "ply\nformat binary_little_endian 1.0\ncomment diorama {}; z up\nelement vertex {n}", env!("CARGO_PKG_VERSION"))?;
        writeln!(w, "property float x\nproperty float y\nproperty float z")?;
        if normals {
            writeln!(w, "property float nx\nproperty float ny\nproperty float nz")?;
        }
        if colors {
            writeln!(w, "property uchar red\nproperty uchar green\nproperty uchar blue")?;
        }
        if !mesh.faces.is_empty() {
            writeln!(w, "element face {}\nproperty list uchar int vertex_indices", mesh.faces.len())?;
        }
        writeln!(w, "end_header")?;
        for i in 0..n {
            mesh.positions[i].iter().try_for_each(|v| w.write_all(&v.to_le_bytes()))?;
            if normals {
                mesh.normals[i].iter().try_for_each(|v| w.write_all(&v.to_le_bytes()))?;
            }
            if colors {
                w.write_all(&mesh.colors_srgb[i].map(u8_from_unit))?;
            }
        }
        for f in &mesh.faces {
            w.write_all(&[3])?;
            f.iter().try_for_each(|i| w.write_all(&i.to_le_bytes()))?;
        }
        Ok(())
    })
}

/// Writes a binary STL, which has neither colors nor shared vertices.
pub fn save_stl(path: &Path, mesh: &Mesh) -> Result<()> {
    check(path, mesh)?;
    let count = u32::try_from(mesh.faces.len()).map_err(|_| DataError::input(path, "too many faces for STL; lower --faces"))?;
    atomic::write_with(path, |w| {
        let mut header = [0u8; 80];
        let text = b"diorama; z up";
        header[..text.len()].copy_from_slice(text);
        w.write_all(&header)?;
        w.write_all(&count.to_le_bytes())?;
        for f in &mesh.faces {
            let [a, b, c] = f.map(|i| mesh.positions[i as usize]);
            let n = cross(sub(b, a), sub(c, a));
            let l = (n[0] * n[0] + n[1] * n[1] + n[2] * n[2]).sqrt().max(1e-20);
            for v in [n.map(|v| v / l), a, b, c].as_flattened() {
                w.write_all(&v.to_le_bytes())?;
            }
            w.write_all(&[0, 0])?;
        }
        Ok(())
    })
}

/// Refuses an empty mesh.
pub(crate) fn check(path: &Path, mesh: &Mesh) -> Result<()> {
    if mesh.faces.is_empty() {
        return Err(DataError::input(path, "the mesh is empty: nothing is denser than the level; lower --level or train longer"));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn triangle() -> Mesh {
        Mesh {
            positions: vec![[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]],
            normals: vec![[0.0, 0.0, 1.0]; 3],
            colors_srgb: vec![[1.0, 0.0, 0.5]; 3],
            faces: vec![[0, 1, 2]],
            ..Mesh::default()
        }
    }

    #[test]
    fn sizes_and_headers_are_exact() {
        let dir = tempfile::tempdir().unwrap();
        let p = dir.path().join("a.stl");
        save_stl(&p, &triangle()).unwrap();
        assert_eq!(std::fs::metadata(&p).unwrap().len(), 84 + 50);
        let p = dir.path().join("a.ply");
        save_ply(&p, &triangle()).unwrap();
        let data = std::fs::read(&p).unwrap();
        let end = data.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
        assert_eq!(data.len() - end, 3 * (24 + 3) + 13);
        let p = dir.path().join("a.obj");
        save_obj(&p, &triangle()).unwrap();
        let text = std::fs::read_to_string(&p).unwrap();
        assert!(text.contains("v 1 0 0 1.0000 0.0000 0.5000\n") && text.contains("f 1//1 2//2 3//3\n"));
    }

    #[test]
    fn a_failed_save_leaves_no_file() {
        let dir = tempfile::tempdir().unwrap();
        let p = dir.path().join("a.obj");
        assert!(save_obj(&p, &Mesh::default()).is_err() && !p.exists());
    }
}
