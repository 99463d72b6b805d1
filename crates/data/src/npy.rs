//! Arrays of NumPy (`.npy`, and `.npz`, which is a zip file of them).

use crate::error::{self, DataError, Result};
use std::io::Read;
use std::path::Path;

/// Largest array that is read, in bytes.
const LIMIT: u64 = 1 << 30;

/// Shape and values of an array; integers are exact up to 2⁵³.
pub type Array = (Vec<usize>, Vec<f64>);

/// Reads a little-endian f4, f8, i4 or i8 array in C order.
///
/// # Errors
/// If the file is another kind of array, or shorter than its shape says.
pub fn read(file: &Path) -> Result<Array> {
    decode(&error::read(file, LIMIT)?).map_err(|what| DataError::input(file, format!("is not a usable .npy file: {what}")))
}

/// Reads the array `name` of a `.npz` file.
///
/// # Errors
/// If the file is no zip file, lacks the array, or the array is not as [`read`] expects; the message names what there is.
pub fn read_from_npz(file: &Path, name: &str) -> Result<Array> {
    let bad = |what: String| DataError::input(file, what);
    let opened = std::fs::File::open(file).map_err(DataError::io(file, "read"))?;
    let mut zip = zip::ZipArchive::new(std::io::BufReader::new(opened)).map_err(|e| bad(format!("is not a readable .npz file ({e})")))?;
    let there: Vec<String> = zip.file_names().map(|n| n.map(|n| n.trim_end_matches(".npy").to_string())).filter_map(|n| n.ok()).collect();
    let Ok(entry) = zip.by_name(&format!("{name}.npy")) else {
        return Err(bad(format!("has no array `{name}`; it has {:.200}", there.join(", "))));
    };
    // The size in the header may be false, so no more than the limit is unpacked.
    let mut data = Vec::new();
    entry.take(LIMIT + 1).read_to_end(&mut data).map_err(|e| bad(format!("array `{name}` cannot be unpacked ({e})")))?;
    if data.len() as u64 > LIMIT {
        return Err(bad(format!("array `{name}` is larger than {} MiB", LIMIT >> 20)));
    }
    decode(&data).map_err(|what| bad(format!("array `{name}` cannot be read: {what}")))
}

/// Decodes the bytes of a `.npy` file. Its size is compared with its shape before anything is allocated.
fn decode(data: &[u8]) -> std::result::Result<Array, String> {
    if data.len() < 12 || &data[..6] != b"\x93NUMPY" {
        return Err("the magic bytes are missing".into());
    }
    let (length, start): (usize, usize) = if data[6] == 1 {
        (u16::from_le_bytes([data[8], data[9]]) as usize, 10)
    } else {
        (u32::from_le_bytes([data[8], data[9], data[10], data[11]]) as usize, 12)
    };
    let header = data.get(start..start.saturating_add(length)).ok_or("the header ends too early")?;
    let header = String::from_utf8_lossy(header);
    let field = |key: &str| header.split_once(key).map(|h| h.1.trim_start_matches([':', ' ', '\'', '"']));
    let kind = field("'descr'").and_then(|d| d.get(..3)).filter(|d| ["<f4", "<f8", "<i4", "<i8"].contains(d));
    let kind = kind.ok_or("only little-endian f4, f8, i4 and i8 are read")?;
    if field("'fortran_order'").is_none_or(|f| !f.starts_with("False")) {
        return Err("only C order is read".into());
    }
    let shape = field("'shape'").and_then(|s| s.strip_prefix('(')).and_then(|s| s.split_once(')')).ok_or("no shape")?.0;
    let sizes = shape.split(',').map(str::trim).filter(|s| !s.is_empty()).map(|s| s.parse().map_err(|_| "the shape is malformed"));
    let shape: Vec<usize> = sizes.collect::<std::result::Result<_, _>>()?;
    let count = shape.iter().try_fold(1usize, |a, b| a.checked_mul(*b));
    let bytes = count.and_then(|c| c.checked_mul(if kind.ends_with('8') { 8 } else { 4 }));
    let body = bytes.and_then(|b| data.get(start + length..)?.get(..b));
    let body = body.ok_or_else(|| format!("shape {shape:?} needs more bytes than the file has"))?;
    let (fours, eights) = (body.as_chunks::<4>().0, body.as_chunks::<8>().0);
    let values = match kind {
        "<f4" => fours.iter().map(|b| f32::from_le_bytes(*b) as f64).collect(),
        "<i4" => fours.iter().map(|b| i32::from_le_bytes(*b) as f64).collect(),
        "<f8" => eights.iter().map(|b| f64::from_le_bytes(*b)).collect(),
        _ => eights.iter().map(|b| i64::from_le_bytes(*b) as f64).collect(),
    };
    Ok((shape, values))
}
