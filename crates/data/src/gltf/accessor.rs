//! Accessors: numbers in buffers, with strides, integers that stand for 0 to 1, and sparse substitutes.

use super::binary::{BYTE, FLOAT, SHORT, UBYTE, UINT, USHORT};
use super::document::Document;
use super::schema::Accessor;
use crate::error::Result;

/// Largest number of elements of an accessor without data, which are all zero.
const MOST_WITHOUT_DATA: usize = 1 << 22;
/// Largest number of numbers of a file.
const MOST_NUMBERS: usize = 1 << 30;

/// Vectors of a common length.
pub struct Vectors {
    /// Numbers of a vector.
    pub size: usize,
    /// `[n, size]`.
    pub values: Vec<f32>,
}

impl Document<'_> {
    /// Vectors of an accessor as floats; normalized integers become 0 to 1 or −1 to 1.
    pub fn vectors(&self, index: usize, what: &str) -> Result<Vectors> {
        let accessor = self.item(&self.root.accessors, index, "accessor", what)?;
        let (kind, is_normalized) = (accessor.component_type, accessor.normalized);
        let values = self.elements(accessor, what, |b| float(kind, is_normalized, b))?;
        Ok(Vectors { size: components(&accessor.kind).unwrap_or(1), values })
    }

    /// Vectors of exactly `N` numbers.
    pub fn arrays<const N: usize>(&self, index: usize, what: &str) -> Result<Vec<[f32; N]>> {
        let Vectors { size, values } = self.vectors(index, what)?;
        if size != N {
            return Err(self.wrong(format!("{what} has vectors of {size} numbers, not {N}; export the mesh again")));
        }
        Ok(values.as_chunks().0.to_vec())
    }

    /// Indices of vertices.
    pub fn indices(&self, index: usize, what: &str) -> Result<Vec<u32>> {
        let accessor = self.item(&self.root.accessors, index, "accessor", what)?;
        let kind = accessor.component_type;
        if accessor.kind != "SCALAR" || !matches!(kind, UBYTE | USHORT | UINT) {
            return Err(self.wrong(format!("{what}: indices must be unsigned integers; export the mesh again")));
        }
        self.elements(accessor, what, |b| integer(kind, b))
    }

    /// All numbers of an accessor, one vector after the other.
    fn elements<T: Copy + Default>(&self, accessor: &Accessor, what: &str, number: impl Fn(&[u8]) -> T) -> Result<Vec<T>> {
        let unknown = || self.wrong(format!("{what}: numbers of type {} {} are not read", accessor.component_type, accessor.kind));
        let (bytes, size) = width(accessor.component_type).zip(components(&accessor.kind)).ok_or_else(unknown)?;
        let count = accessor.count;
        let total = count.checked_mul(size).and_then(|n| n.checked_add(self.numbers.get())).filter(|n| *n <= MOST_NUMBERS);
        self.numbers.set(total.ok_or_else(|| self.wrong(format!("{what}: {count} elements are too many; split the file")))?);
        let mut values = match accessor.buffer_view {
            Some(view) => self.spread(view, accessor.byte_offset, count, (bytes, size), what, &number)?,
            None if count <= MOST_WITHOUT_DATA => vec![T::default(); count * size],
            None => return Err(self.wrong(format!("{what}: {count} elements without data; export the mesh again"))),
        };
        if let Some(sparse) = &accessor.sparse {
            let kind = sparse.indices.component_type;
            let index_bytes = width(kind).filter(|_| matches!(kind, UBYTE | USHORT | UINT)).ok_or_else(unknown)?;
            let at = &sparse.indices;
            let rows = self.spread(at.buffer_view, at.byte_offset, sparse.count, (index_bytes, 1), what, &|b| integer(kind, b))?;
            let at = &sparse.values;
            let substitutes = self.spread(at.buffer_view, at.byte_offset, sparse.count, (bytes, size), what, &number)?;
            for (row, value) in rows.into_iter().zip(substitutes.chunks_exact(size)) {
                let row = row as usize;
                let place = values.chunks_exact_mut(size).nth(row);
                place
                    .ok_or_else(|| self.wrong(format!("{what}: sparse index {row} is not below {count}; export again")))?
                    .copy_from_slice(value);
            }
        }
        Ok(values)
    }

    /// Reads `count` vectors of `size` numbers of `bytes` bytes from a buffer view.
    fn spread<T>(
        &self,
        view: usize,
        offset: usize,
        count: usize,
        (bytes, size): (usize, usize),
        what: &str,
        number: &impl Fn(&[u8]) -> T,
    ) -> Result<Vec<T>> {
        let (view, data) = self.view(view, what)?;
        let length = bytes * size;
        let stride = view.byte_stride.unwrap_or(length).max(length);
        let end = count.saturating_sub(1).checked_mul(stride).and_then(|n| n.checked_add(offset + length.min(count * length)));
        if end.is_none_or(|end| end > data.len()) {
            let have = data.len();
            return Err(self.wrong(format!("{what}: {count} elements do not fit into {have} bytes; the file is damaged, export it again")));
        }
        let rows = (0..count).map(|i| &data[offset + i * stride..][..length]);
        Ok(rows.flat_map(|row| row.chunks_exact(bytes)).map(number).collect())
    }
}

/// Bytes of a number.
fn width(kind: u32) -> Option<usize> {
    match kind {
        BYTE | UBYTE => Some(1),
        SHORT | USHORT => Some(2),
        UINT | FLOAT => Some(4),
        _ => None,
    }
}

/// Numbers of a vector.
fn components(kind: &str) -> Option<usize> {
    match kind {
        "SCALAR" => Some(1),
        "VEC2" => Some(2),
        "VEC3" => Some(3),
        "VEC4" => Some(4),
        _ => None,
    }
}

/// A little-endian unsigned integer.
fn integer(kind: u32, b: &[u8]) -> u32 {
    match kind {
        UBYTE => b[0] as u32,
        USHORT => u16::from_le_bytes([b[0], b[1]]) as u32,
        _ => u32::from_le_bytes([b[0], b[1], b[2], b[3]]),
    }
}

/// A little-endian number; section 3.11 of the standard defines how integers stand for fractions.
fn float(kind: u32, is_normalized: bool, b: &[u8]) -> f32 {
    let (value, largest) = match kind {
        BYTE => (b[0] as i8 as f32, i8::MAX as f32),
        SHORT => (i16::from_le_bytes([b[0], b[1]]) as f32, i16::MAX as f32),
        FLOAT => return f32::from_le_bytes([b[0], b[1], b[2], b[3]]),
        _ => (integer(kind, b) as f32, [u8::MAX as f32, u16::MAX as f32, u32::MAX as f32][width(kind).map_or(2, |w| w / 2)]),
    };
    if is_normalized { (value / largest).max(-1.0) } else { value }
}
