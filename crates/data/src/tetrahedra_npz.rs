//! Tetrahedral grids in `.npz` files, in the layout of nvdiffrec: `vertices [V, 3]` and `indices [T, 4]`.

use crate::error::{DataError, Result};
use crate::npy;
use diorama_geom::Tetrahedra;
use std::path::Path;

/// Reads a grid in the file's own axes and gives every tetrahedron positive volume.
///
/// # Errors
/// If an array is missing or has another shape, an index has no vertex, or tetrahedra are inverted, flat or not finite; the message has
/// their numbers.
pub fn read(file: &Path) -> Result<Tetrahedra> {
    let bad = |what: String| DataError::input(file, what);
    let rows = |name: &str, width: usize| -> Result<Vec<f64>> {
        let (shape, values) = npy::read_from_npz(file, name)?;
        match shape[..] {
            [n, w] if w == width && n > 0 => Ok(values),
            _ => Err(bad(format!("array `{name}` has shape {shape:?}; expected [{}, {width}]", if width == 3 { "V" } else { "T" }))),
        }
    };
    let (vertices, indices) = (rows("vertices", 3)?, rows("indices", 4)?);
    let n = vertices.len() / 3;
    let lost = indices.iter().filter(|i| !(0.0..n as f64).contains(*i) || i.fract() != 0.0).count();
    if lost > 0 {
        return Err(bad(format!("{lost} numbers in `indices` name none of the {n} vertices")));
    }
    let mut grid = Tetrahedra {
        positions: vertices.as_chunks::<3>().0.iter().map(|v| v.map(|v| v as f32)).collect(),
        cells: indices.as_chunks::<4>().0.iter().map(|i| i.map(|i| i as u32)).collect(),
    };
    grid.orient().map_err(|e| bad(format!("{e}; make the grid again, or use the built-in one")))?;
    Ok(grid)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Write;

    fn npy(kind: &str, shape: &str, body: Vec<u8>) -> Vec<u8> {
        let header = format!("{{'descr': '{kind}', 'fortran_order': False, 'shape': ({shape}), }}\n");
        [b"\x93NUMPY\x01\0", &(header.len() as u16).to_le_bytes()[..], header.as_bytes(), &body].concat()
    }

    fn floats(values: &[f32]) -> Vec<u8> {
        values.iter().flat_map(|v| v.to_le_bytes()).collect()
    }

    fn ints(values: &[i64]) -> Vec<u8> {
        values.iter().flat_map(|v| v.to_le_bytes()).collect()
    }

    const VERTICES: [f32; 15] = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 1.0, 0.0, 0.5, 0.5, 1.0];

    /// Reads a grid of these arrays.
    fn read_of(arrays: &[(&str, Vec<u8>)]) -> Result<Tetrahedra> {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("tets.npz");
        let mut w = zip::ZipWriter::new(std::fs::File::create(&path).unwrap());
        let deflated = zip::write::SimpleFileOptions::default().compression_method(zip::CompressionMethod::Deflated);
        for (name, data) in arrays {
            w.start_file(format!("{name}.npy"), deflated).unwrap();
            w.write_all(data).unwrap();
        }
        w.finish().unwrap();
        read(&path)
    }

    #[test]
    fn a_grid_is_read_and_wound_alike() {
        // Both windings, indices of 8 and of 4 bytes, vertices of 4 and of 8.
        for cells in [[4, 0, 2, 1, 4, 0, 3, 2], [0, 4, 2, 1, 0, 4, 3, 2]] {
            let short: Vec<u8> = cells.iter().flat_map(|i| (*i as i32).to_le_bytes()).collect();
            let double: Vec<u8> = VERTICES.iter().flat_map(|v| (*v as f64).to_le_bytes()).collect();
            let a = read_of(&[("vertices", npy("<f4", "5, 3", floats(&VERTICES))), ("indices", npy("<i8", "2, 4", ints(&cells)))]).unwrap();
            let b = read_of(&[("vertices", npy("<f8", "5, 3", double)), ("indices", npy("<i4", "2, 4", short))]).unwrap();
            assert_eq!(a, b);
            assert_eq!(a.positions[4], [0.5, 0.5, 1.0]);
            assert!((0..2).all(|i| (a.volume(i) - 1.0 / 6.0).abs() < 1e-6));
        }
    }

    #[test]
    fn bad_grids_are_refused_with_counts() {
        let vertices = |v: &[f32]| ("vertices", npy("<f4", "5, 3", floats(v)));
        let cells = |c: &[i64]| ("indices", npy("<i8", &format!("{}, 4", c.len() / 4), ints(c)));
        let mut infinite = VERTICES;
        infinite[0] = f32::NAN;
        for (arrays, what) in [
            (vec![vertices(&VERTICES), cells(&[4, 0, 2, 1, 4, 0, 3, 2, 0, 4, 2, 1])], "of 3 tetrahedra, 1 are inverted"),
            (vec![vertices(&infinite), cells(&[4, 0, 2, 1, 4, 0, 3, 2])], "2 have coordinates that are not finite"),
            (vec![vertices(&VERTICES), cells(&[4, 0, 2, 1, 4, 0, 5, -1])], "2 numbers in `indices` name none of the 5 vertices"),
            (vec![vertices(&VERTICES)], "has no array `indices`; it has vertices"),
            (vec![vertices(&VERTICES), ("indices", npy("<i8", "4, 2", ints(&[0; 8])))], "shape [4, 2]; expected [T, 4]"),
            (vec![vertices(&VERTICES), ("indices", npy("<i8", "3, 4", ints(&[0; 8])))], "needs more bytes"),
            (vec![vertices(&VERTICES), ("indices", npy("<u2", "2, 4", ints(&[0; 2])))], "only little-endian"),
        ] {
            let e = read_of(&arrays).unwrap_err();
            assert!(e.is_input() && e.to_string().contains("tets.npz") && e.to_string().contains(what), "{e}");
        }
    }

    #[test]
    fn no_changed_byte_crashes_the_reader() {
        let arrays = |v: Vec<u8>, i: Vec<u8>| read_of(&[("vertices", v), ("indices", i)]);
        let (vertices, cells) = (npy("<f4", "5, 3", floats(&VERTICES)), npy("<i8", "2, 4", ints(&[4, 0, 2, 1, 4, 0, 3, 2])));
        for at in 0..vertices.len().max(cells.len()) {
            for value in [0, b'9', 0x80, 0xff] {
                let changed = |a: &[u8]| {
                    let mut a = a.to_vec();
                    a.iter_mut().skip(at).take(1).for_each(|b| *b = value);
                    a
                };
                for read in [arrays(changed(&vertices), cells.clone()), arrays(vertices.clone(), changed(&cells))] {
                    let usable = |g: Tetrahedra| (0..g.cells.len()).all(|i| g.volume(i) > 0.0);
                    assert!(read.is_err() || read.is_ok_and(usable), "byte {at} as {value}");
                }
            }
        }
        let e = arrays(vertices[..vertices.len() - 1].to_vec(), cells).unwrap_err().to_string();
        assert!(e.contains("needs more bytes"), "{e}");
    }
}
