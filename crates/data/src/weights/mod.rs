//! Network weights from files: safetensors, and state_dicts written by PyTorch's `torch.save` (`.pth`, `.pt`), in the present format (a
//! zip archive) and the one before PyTorch 1.6.

mod number;
#[cfg(test)]
mod tests;
mod torch;

use crate::atomic;
use crate::error::{DataError, Result};
use diorama_geom::NamedArray;
use number::Kind;
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use std::collections::HashMap;
use std::fs::File;
use std::io::{BufReader, Read, Seek, Write};
use std::path::Path;

/// Largest file that is read, in bytes.
const LIMIT: u64 = 8 << 30;
/// Largest header of a safetensors file, as the format has it.
const HEADER_LIMIT: u64 = 100 << 20;

/// Reads the floating-point tensors whose names `wanted` accepts, in the file's order, as f32.
///
/// # Errors
/// If the file is neither safetensors nor from `torch.save`, is incomplete, or contains more than names and tensors.
pub fn read(path: &Path, wanted: &dyn Fn(&str) -> bool) -> Result<Vec<NamedArray>> {
    let file = File::open(path).map_err(DataError::io(path, "read"))?;
    let size = file.metadata().map_err(DataError::io(path, "read"))?.len();
    if size > LIMIT {
        return Err(DataError::input(path, format!("{size} bytes, more than the limit of {LIMIT} for a file of weights")));
    }
    let mut file = BufReader::new(file);
    let mut head = [0; 4];
    let known = file.read_exact(&mut head).and_then(|()| file.rewind()).is_ok();
    let read = match head {
        _ if !known => Err("it is empty or can hardly be read".to_string()),
        [b'P', b'K', 3, 4] => torch::from_zip(file, size, wanted),
        // Old files start with a pickled magic number, from protocol 4 on inside a frame. In a safetensors file these bytes would be the
        // length of a header; the magic number distinguishes the two.
        [0x80, 2 | 3, 0x8a, 0x0a] | [0x80, 4 | 5, 0x95, _] => torch::from_legacy(file, size, wanted),
        _ => from_safetensors(path, wanted),
    };
    read.map_err(|e| DataError::input(path, format!("cannot be read as weights: {e}")))
}

fn from_safetensors(path: &Path, wanted: &dyn Fn(&str) -> bool) -> std::result::Result<Vec<NamedArray>, String> {
    let bytes = std::fs::read(path).map_err(|e| e.to_string())?;
    let file = SafeTensors::deserialize(&bytes).map_err(|e| format!("neither safetensors nor a file of torch.save ({e})"))?;
    let mut names: Vec<&str> = file.names().into_iter().filter(|n| wanted(n)).collect();
    names.sort_unstable();
    let mut out = Vec::new();
    for name in names {
        let t = file.tensor(name).map_err(|e| e.to_string())?;
        let kind = match t.dtype() {
            Dtype::F16 => Kind::Half,
            Dtype::BF16 => Kind::Brain,
            Dtype::F32 => Kind::Single,
            Dtype::F64 => Kind::Double,
            _ => continue,
        };
        out.push(NamedArray { name: name.into(), shape: t.shape().to_vec(), values: kind.values(t.data()) });
    }
    Ok(out)
}

/// Texts that a safetensors file holds beside its tensors; none of a file of PyTorch's.
///
/// # Errors
/// If the file cannot be read.
pub fn metadata(path: &Path) -> Result<HashMap<String, String>> {
    let mut file = File::open(path).map_err(DataError::io(path, "read"))?;
    let size = file.metadata().map_err(DataError::io(path, "read"))?.len();
    let mut length = [0; 8];
    if size < 8 {
        return Ok(HashMap::new());
    }
    file.read_exact(&mut length).map_err(DataError::io(path, "read"))?;
    let length = u64::from_le_bytes(length);
    if length > HEADER_LIMIT.min(size - 8) {
        return Ok(HashMap::new());
    }
    let mut head = Vec::new();
    file.take(length).read_to_end(&mut head).map_err(DataError::io(path, "read"))?;
    let header: Option<serde_json::Value> = serde_json::from_slice(&head).ok();
    let texts = header.and_then(|mut h| h.get_mut("__metadata__").map(serde_json::Value::take));
    Ok(texts.and_then(|t| serde_json::from_value(t).ok()).unwrap_or_default())
}

/// Writes arrays as safetensors, with text in its metadata. The file appears complete or not at all.
///
/// # Errors
/// If two arrays have the same name, or the file cannot be written.
pub fn save(path: &Path, arrays: &[NamedArray], metadata: HashMap<String, String>) -> Result<()> {
    let mut views = Vec::new();
    let bytes: Vec<Vec<u8>> = arrays.iter().map(|a| a.values.iter().flat_map(|v| v.to_le_bytes()).collect()).collect();
    let mut names = std::collections::HashSet::new();
    for (a, bytes) in arrays.iter().zip(&bytes) {
        if !names.insert(&a.name) {
            return Err(DataError::input(path, format!("two arrays are named {:.80}", a.name)));
        }
        let view = TensorView::new(Dtype::F32, a.shape.clone(), bytes).map_err(|e| DataError::input(path, format!("{}: {e}", a.name)))?;
        views.push((a.name.as_str(), view));
    }
    let whole =
        safetensors::serialize(views, (!metadata.is_empty()).then_some(metadata)).map_err(|e| DataError::input(path, e.to_string()))?;
    atomic::write_with(path, |w| w.write_all(&whole))
}
