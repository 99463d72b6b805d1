//! Point clouds in surveying formats: LAS (ASPRS 1.2, point format 2) and E57 (ASTM E2807). PLY is in [`crate::mesh_text`].

use crate::error::{DataError, Result};
use crate::{atomic, mesh_text};
use diorama_geom::Mesh;
use diorama_geom::color::u8_from_unit;
use e57::{E57Writer, Extension, Record, RecordDataType, RecordName, RecordValue};
use std::io::{Cursor, Write};
use std::path::Path;

/// Writes the vertices of a mesh, with their normals and colors, as PLY.
pub fn save_ply(path: &Path, points: &Mesh) -> Result<()> {
    check(path, points)?;
    mesh_text::save_ply(path, points)
}

/// Sizes in bytes of LAS's header, of a variable-length record's header, of an extra-bytes description, and of a point.
const HEADER: usize = 227;
const RECORD_HEAD: usize = 54;
const DESCRIPTION: usize = 192;
const POINT: usize = 26 + 12;

/// Writes the vertices of a mesh, with their normals and colors, as LAS. The format has no field for normals; they are extra bytes of each
/// point, named `NormalX` to `NormalZ`.
///
/// # Errors
/// For an empty cloud, more than 2³² points, or if the file cannot be written.
pub fn save_las(path: &Path, points: &Mesh) -> Result<()> {
    check(path, points)?;
    let (lo, hi) = points.bounds().unwrap_or_default();
    let count = u32::try_from(points.positions.len()).map_err(|_| DataError::input(path, "too many points for LAS; lower --points"))?;
    let middle: [f64; 3] = std::array::from_fn(|k| (0.5 * (lo[k] as f64 + hi[k] as f64)).round());
    // Coordinates are integers: steps from the center.
    let reach = (0..3).map(|k| (hi[k] as f64 - middle[k]).abs().max((lo[k] as f64 - middle[k]).abs())).fold(1e-9, f64::max);
    let step = 10f64.powi((reach / 1e9).log10().ceil() as i32);
    atomic::write_with(path, |w| {
        w.write_all(&las_head(count, step, middle, (lo, hi)))?;
        for i in 0..points.positions.len() {
            for k in 0..3 {
                w.write_all(&(((points.positions[i][k] as f64 - middle[k]) / step).round() as i32).to_le_bytes())?;
            }
            // No intensity; first of one return; no class, angle, user data or source.
            w.write_all(&[0, 0, 1 | 1 << 3, 0, 0, 0, 0, 0])?;
            for v in points.colors_srgb[i] {
                // Sixteen bits: 255 becomes 65535.
                w.write_all(&(u8_from_unit(v) as u16 * 257).to_le_bytes())?;
            }
            points.normals[i].iter().try_for_each(|v| w.write_all(&v.to_le_bytes()))?;
        }
        Ok(())
    })
}

/// LAS's header with the description of the normals.
fn las_head(count: u32, step: f64, middle: [f64; 3], (lo, hi): ([f32; 3], [f32; 3])) -> Vec<u8> {
    let text = |out: &mut Vec<u8>, text: &str, n: usize| {
        out.extend(text.bytes().chain(std::iter::repeat(0)).take(n));
    };
    let mut out = b"LASF".to_vec();
    out.extend([0; 20]);
    out.extend([1, 2]);
    text(&mut out, "EXTRACTION", 32);
    text(&mut out, concat!("diorama ", env!("CARGO_PKG_VERSION")), 32);
    // The date is left empty, so that the same run gives the same file.
    out.extend([0; 4]);
    out.extend((HEADER as u16).to_le_bytes());
    out.extend(((HEADER + RECORD_HEAD + 3 * DESCRIPTION) as u32).to_le_bytes());
    out.extend(1u32.to_le_bytes());
    out.push(2);
    out.extend((POINT as u16).to_le_bytes());
    out.extend(count.to_le_bytes());
    // All points are first returns.
    [count, 0, 0, 0, 0].iter().for_each(|n| out.extend(n.to_le_bytes()));
    [step; 3].iter().chain(&middle).for_each(|v| out.extend(v.to_le_bytes()));
    (0..3).for_each(|k| [hi[k], lo[k]].iter().for_each(|v| out.extend((*v as f64).to_le_bytes())));
    debug_assert_eq!(out.len(), HEADER);
    out.extend([0; 2]);
    text(&mut out, "LASF_Spec", 16);
    out.extend(4u16.to_le_bytes());
    out.extend((3 * DESCRIPTION as u16).to_le_bytes());
    text(&mut out, "Extra Bytes", 32);
    for name in ["NormalX", "NormalY", "NormalZ"] {
        // Type 9 is a float.
        out.extend([0, 0, 9, 0]);
        text(&mut out, name, 32);
        out.extend([0; 124]);
        text(&mut out, "unit normal", 32);
    }
    out
}

/// Writes the vertices of a mesh in meters, with their normals and colors, as E57. Normals use the extension for surface normals (`nor`).
///
/// # Errors
/// For an empty cloud, or if the file cannot be written.
pub fn save_e57(path: &Path, points: &Mesh) -> Result<()> {
    check(path, points)?;
    let bytes = e57_bytes(points).map_err(|e| DataError::failed(path, format!("cannot be encoded as E57: {e}")))?;
    atomic::write(path, &bytes)
}

fn e57_bytes(points: &Mesh) -> e57::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    // A fixed name, so that the same run gives the same file.
    let id =
        points.positions.iter().flatten().fold(0xcbf2_9ce4_8422_2325u64, |h, v| (h ^ v.to_bits() as u64).wrapping_mul(0x0100_0000_01b3));
    let name = |k: u8| format!("{{{:08x}-{:04x}-4000-8000-0000000000{k:02x}}}", id >> 32, id & 0xffff);
    let mut file = E57Writer::new(Cursor::new(&mut bytes), &name(0))?;
    file.register_extension(Extension::new("nor", "http://www.libe57.org/E57_NOR_surface_normals.txt"))?;
    let normal = |axis: &str| Record {
        name: RecordName::Unknown { namespace: "nor".into(), name: format!("normal{axis}") },
        data_type: RecordDataType::F32,
    };
    let prototype = vec![
        Record::CARTESIAN_X_F32,
        Record::CARTESIAN_Y_F32,
        Record::CARTESIAN_Z_F32,
        Record::COLOR_RED_U8,
        Record::COLOR_GREEN_U8,
        Record::COLOR_BLUE_U8,
        normal("X"),
        normal("Y"),
        normal("Z"),
    ];
    let mut cloud = file.add_pointcloud(&name(1), prototype)?;
    cloud.set_name(Some(concat!("diorama ", env!("CARGO_PKG_VERSION")).into()));
    for i in 0..points.positions.len() {
        let color = points.colors_srgb[i].map(|v| RecordValue::Integer(u8_from_unit(v) as i64));
        let [position, normal] = [points.positions[i], points.normals[i]].map(|v| v.map(RecordValue::Single));
        cloud.add_point(position.into_iter().chain(color).chain(normal).collect())?;
    }
    cloud.finalize()?;
    file.finalize()?;
    drop(file);
    Ok(bytes)
}

fn check(path: &Path, points: &Mesh) -> Result<()> {
    if points.positions.is_empty() {
        return Err(DataError::input(path, "there are no points: the cameras see no surface there; choose another --clip or train longer"));
    }
    assert!(points.normals.len() == points.positions.len() && points.colors_srgb.len() == points.positions.len(), "point attributes");
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cloud() -> Mesh {
        Mesh {
            positions: vec![[1.0, 2.0, 3.0], [-4.5, 0.25, 1e-3], [100.0, -7.0, 0.0]],
            normals: vec![[0.0, 0.0, 1.0], [0.6, 0.8, 0.0], [-1.0, 0.0, 0.0]],
            colors_srgb: vec![[1.0, 0.0, 0.5], [0.0, 1.0, 0.0], [0.2, 0.4, 0.6]],
            ..Mesh::default()
        }
    }

    #[test]
    fn las_is_read_by_another_program() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.las");
        save_las(&path, &cloud()).unwrap();
        let mut reader = las::Reader::from_path(&path).unwrap();
        assert_eq!((reader.header().number_of_points(), reader.header().point_format().extra_bytes), (3, 12));
        let b = reader.header().bounds();
        assert!((b.min.x + 4.5).abs() < 1e-6 && (b.max.x - 100.0).abs() < 1e-6 && (b.max.z - 3.0).abs() < 1e-6);
        let read: Vec<las::Point> = reader.read_all().unwrap().points().map(|p| p.unwrap()).collect();
        for (p, i) in read.iter().zip(0..) {
            let c = cloud();
            for (a, b) in [p.x, p.y, p.z].iter().zip(c.positions[i]) {
                assert!((a - b as f64).abs() < 2e-7, "{a} {b}");
            }
            let color = p.color.unwrap();
            for (a, b) in [color.red, color.green, color.blue].iter().zip(c.colors_srgb[i]) {
                assert!((*a as f32 / 65535.0 - b).abs() < 0.003);
            }
            let normal: Vec<f32> = p.extra_bytes.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
            assert_eq!(normal, c.normals[i]);
        }
    }

    #[test]
    fn e57_holds_positions_colors_and_normals() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.e57");
        save_e57(&path, &cloud()).unwrap();
        let mut reader = e57::E57Reader::from_file(&path).unwrap();
        assert_eq!(reader.extensions()[0].namespace, "nor");
        let clouds = reader.pointclouds();
        assert_eq!((clouds.len(), clouds[0].records), (1, 3));
        let read: Vec<_> = reader.pointcloud_raw(&clouds[0]).unwrap().map(|p| p.unwrap()).collect();
        let single = |v: &RecordValue| match v {
            RecordValue::Single(v) => *v,
            other => panic!("{other:?}"),
        };
        for (i, p) in read.iter().enumerate() {
            assert_eq!([&p[0], &p[1], &p[2]].map(single), cloud().positions[i]);
            assert_eq!([&p[6], &p[7], &p[8]].map(single), cloud().normals[i]);
        }
        assert_eq!(read[0][3..6], [255, 0, 128].map(RecordValue::Integer));
    }

    #[test]
    fn an_empty_cloud_is_refused_and_leaves_no_file() {
        let dir = tempfile::tempdir().unwrap();
        for save in [save_ply, save_las, save_e57] {
            let path = dir.path().join("a");
            assert!(save(&path, &Mesh::default()).unwrap_err().is_input() && !path.exists());
        }
    }
}
