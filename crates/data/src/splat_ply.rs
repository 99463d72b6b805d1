//! PLY files of points, and of Gaussian splats in the format of 3D Gaussian Splatting: `x y z`, colors as `red green blue` or as the
//! constant spherical harmonic `f_dc_0..2`, `opacity` (logit), `scale_0..2` (logarithm), `rot_0..3`. ASCII and binary little-endian.

use crate::error::{self, DataError, Result};
use diorama_geom::splats::Splats;
use std::path::Path;

const LIMIT: u64 = 8 << 30;
/// Value of the constant spherical harmonic.
const HARMONIC: f32 = 0.282_094_8;

/// Storage type of a number.
#[derive(Clone, Copy, PartialEq)]
enum Kind {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Kind {
    fn named(s: &str) -> Option<Kind> {
        Some(match s {
            "char" | "int8" => Kind::I8,
            "uchar" | "uint8" => Kind::U8,
            "short" | "int16" => Kind::I16,
            "ushort" | "uint16" => Kind::U16,
            "int" | "int32" => Kind::I32,
            "uint" | "uint32" => Kind::U32,
            "float" | "float32" => Kind::F32,
            "double" | "float64" => Kind::F64,
            _ => return None,
        })
    }

    fn bytes(self) -> usize {
        match self {
            Kind::I8 | Kind::U8 => 1,
            Kind::I16 | Kind::U16 => 2,
            Kind::I32 | Kind::U32 | Kind::F32 => 4,
            Kind::F64 => 8,
        }
    }

    fn read(self, b: &[u8]) -> f32 {
        match self {
            Kind::I8 => b[0] as i8 as f32,
            Kind::U8 => b[0] as f32,
            Kind::I16 => i16::from_le_bytes([b[0], b[1]]) as f32,
            Kind::U16 => u16::from_le_bytes([b[0], b[1]]) as f32,
            Kind::I32 => i32::from_le_bytes([b[0], b[1], b[2], b[3]]) as f32,
            Kind::U32 => u32::from_le_bytes([b[0], b[1], b[2], b[3]]) as f32,
            Kind::F32 => f32::from_le_bytes([b[0], b[1], b[2], b[3]]),
            Kind::F64 => f64::from_le_bytes([b[0], b[1], b[2], b[3], b[4], b[5], b[6], b[7]]) as f32,
        }
    }
}

/// Description of the vertices in a file's header.
struct Head {
    ascii: bool,
    count: usize,
    properties: Vec<(String, Kind)>,
    /// Byte offset of the vertices.
    body: usize,
}

fn head(path: &Path, data: &[u8]) -> Result<Head> {
    let wrong = |what: String| DataError::input(path, format!("{what}; expected a PLY of points or Gaussian splats"));
    let (mut at, mut ascii, mut elements) = (0, None, 0);
    let (mut count, mut properties) = (None, Vec::new());
    for line in 0.. {
        let end = data[at..].iter().take(4096).position(|b| *b == b'\n').ok_or_else(|| wrong("has no end_header".into()))?;
        let text = String::from_utf8_lossy(&data[at..at + end]).trim().to_string();
        at += end + 1;
        let words: Vec<&str> = text.split_whitespace().collect();
        match words[..] {
            ["ply"] if line == 0 => {}
            _ if line == 0 => return Err(wrong("does not begin with ply".into())),
            ["format", "ascii", _] => ascii = Some(true),
            ["format", "binary_little_endian", _] => ascii = Some(false),
            ["format", other, ..] => return Err(wrong(format!("format {other} is not read, ascii and binary_little_endian are"))),
            ["element", "vertex", n] if elements == 0 => {
                elements += 1;
                count = Some(n.parse::<usize>().map_err(|_| wrong(format!("element vertex: {n:?} is not a count")))?);
            }
            ["element", "vertex", ..] => return Err(wrong("element vertex is not the first".into())),
            ["element", ..] => elements += 1,
            ["property", kind, name] if elements == 1 && count.is_some() => {
                let kind = Kind::named(kind).ok_or_else(|| wrong(format!("property {name}: type {kind:?} is unknown")))?;
                properties.push((name.to_string(), kind));
            }
            ["property", "list", ..] if elements == 1 && count.is_some() => return Err(wrong("vertices hold lists".into())),
            ["end_header"] => break,
            _ => {}
        }
    }
    let ascii = ascii.ok_or_else(|| wrong("has no format line".into()))?;
    let count = count.ok_or_else(|| wrong("has no element vertex".into()))?;
    // The shortest number in a text file is one digit and a blank.
    let stride: usize = properties.iter().map(|p| if ascii { 2 } else { p.1.bytes() }).sum();
    if stride == 0 || count.checked_mul(stride).is_none_or(|n| n > data.len() - at + ascii as usize) {
        return Err(wrong(format!("claims {count} vertices, more than the file has room for")));
    }
    Ok(Head { ascii, count, properties, body: at })
}

/// Reads points or splats.
///
/// # Errors
/// If the file is not such a PLY, or ends too early.
pub fn read(path: &Path) -> Result<Splats> {
    let data = error::read(path, LIMIT)?;
    let head = head(path, &data)?;
    let at = |name: &str| head.properties.iter().position(|p| p.0 == name);
    let three = |names: [&str; 3]| Some([at(names[0])?, at(names[1])?, at(names[2])?]);
    let place = three(["x", "y", "z"]).ok_or_else(|| DataError::input(path, "its vertices have no x, y and z"))?;
    let rgb = three(["red", "green", "blue"]);
    let harmonic = three(["f_dc_0", "f_dc_1", "f_dc_2"]);
    let (opacity, scale) = (at("opacity"), three(["scale_0", "scale_1", "scale_2"]));
    let rotation = match (three(["rot_0", "rot_1", "rot_2"]), at("rot_3")) {
        (Some([a, b, c]), Some(d)) => Some([a, b, c, d]),
        _ => None,
    };
    let byte = rgb.map(|i| head.properties[i[0]].1 == Kind::U8);
    let mut out = Splats::default();
    let mut take = |v: &[f32]| {
        let color = match (rgb, harmonic) {
            (Some(i), _) => i.map(|i| if byte == Some(true) { v[i] / 255.0 } else { v[i] }),
            (None, Some(i)) => i.map(|i| 0.5 + HARMONIC * v[i]),
            (None, None) => [0.5; 3],
        };
        let opaque = opacity.map_or(1.0, |i| 1.0 / (1.0 + (-v[i]).exp()));
        let q = rotation.map_or([1.0, 0.0, 0.0, 0.0], |i| i.map(|i| v[i]));
        let length = q.iter().map(|v| v * v).sum::<f32>().sqrt();
        let q = if length > 1e-12 && length.is_finite() { q.map(|v| v / length) } else { [1.0, 0.0, 0.0, 0.0] };
        let s = scale.map_or([0.0; 3], |i| i.map(|i| v[i].min(20.0).exp()));
        let p = place.map(|i| v[i]);
        // Points with non-finite positions are not shown.
        if p.iter().chain(&color).chain(&s).all(|v| v.is_finite()) && opaque.is_finite() {
            out.push(p, color.map(|v| v.clamp(0.0, 1.0)), opaque, s, q);
        }
    };
    let mut values = vec![0.0; head.properties.len()];
    if head.ascii {
        let text = String::from_utf8_lossy(&data[head.body..]);
        let mut numbers = text.split_whitespace();
        for i in 0..head.count {
            for v in &mut values {
                let word = numbers.next().ok_or_else(|| DataError::input(path, format!("ends at vertex {i} of {}", head.count)))?;
                *v = word.parse().map_err(|_| DataError::input(path, format!("vertex {i}: {word:?} is not a number")))?;
            }
            take(&values);
        }
    } else {
        let stride: usize = head.properties.iter().map(|p| p.1.bytes()).sum();
        for vertex in data[head.body..].chunks_exact(stride).take(head.count) {
            let mut at = 0;
            for (v, (_, kind)) in values.iter_mut().zip(&head.properties) {
                *v = kind.read(&vertex[at..]);
                at += kind.bytes();
            }
            take(&values);
        }
    }
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh_text;
    use diorama_geom::Mesh;

    #[test]
    fn own_points_and_foreign_splats_are_read() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("points.ply");
        let cloud = Mesh {
            positions: vec![[1.0, 2.0, 3.0], [-1.0, 0.5, 0.0]],
            colors_srgb: vec![[1.0, 0.0, 0.2], [0.0, 1.0, 0.4]],
            ..Mesh::default()
        };
        mesh_text::save_ply(&file, &cloud).unwrap();
        let s = read(&file).unwrap();
        assert_eq!(s.positions, cloud.positions);
        assert!((s.rgb_srgb[0][2] - 0.2).abs() < 1e-6 && s.opacities == [1.0, 1.0] && s.scales == [[0.0; 3]; 2]);
        let mut bytes = b"ply\nformat binary_little_endian 1.0\nelement vertex 1\n".to_vec();
        let names = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 f_rest_0 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3";
        names.split(' ').for_each(|n| bytes.extend(format!("property float {n}\n").bytes()));
        bytes.extend(b"end_header\n");
        let values = [1.0f32, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0, 0.0, -9.0, 7.0, 0.0, 0.0, -1.0, 1.0, 2.0, 0.0, 0.0, 0.0];
        values.iter().for_each(|v| bytes.extend(v.to_le_bytes()));
        std::fs::write(&file, bytes).unwrap();
        let s = read(&file).unwrap();
        assert_eq!((s.positions[0], s.opacities[0], s.rotations[0]), ([1.0, 2.0, 3.0], 0.5, [1.0, 0.0, 0.0, 0.0]));
        assert!((s.rgb_srgb[0][0] - 0.782_094_8).abs() < 1e-6 && s.rgb_srgb[0][2] == 0.0);
        assert!((s.scales[0][1] - (-1.0f32).exp()).abs() < 1e-6);
        let text = "ply\nformat ascii 1.0\ncomment hand-made\nelement vertex 2\nproperty double x\nproperty float y\nproperty float z\n\
                    element face 0\nproperty list uchar int vertex_indices\nend_header\n0 1 2\n3 4 5\n";
        std::fs::write(&file, text).unwrap();
        assert_eq!(read(&file).unwrap().positions, [[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]]);
    }

    #[test]
    fn malformed_files_are_named() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("x.ply");
        let vertex = "property float x\nproperty float y\nproperty float z\nend_header\n";
        for (text, expected) in [
            ("".into(), "end_header"),
            ("solid\n".into(), "begin with ply"),
            (format!("ply\nformat binary_big_endian 1.0\nelement vertex 1\n{vertex}"), "big_endian"),
            (format!("ply\nformat binary_little_endian 1.0\nelement vertex 4000000000000\n{vertex}"), "room"),
            (format!("ply\nformat ascii 1.0\nelement vertex 99999999999999999999999\n{vertex}"), "not a count"),
            (format!("ply\nformat ascii 1.0\nelement vertex 1\n{vertex}1 2 x\n"), "not a number"),
            ("ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1 2\n".into(), "x, y and z"),
        ] {
            std::fs::write(&file, &text).unwrap();
            let e = read(&file).unwrap_err();
            assert!(e.is_input() && e.to_string().contains(expected) && e.to_string().contains("x.ply"), "{e}");
        }
    }
}
