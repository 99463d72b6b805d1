//! The container of binary glTF: a header, JSON, and a binary chunk of buffer views.

use crate::error::{DataError, Result};
use serde_json::{Value, json};
use std::path::Path;

/// First bytes of a `.glb`.
pub const MAGIC: &[u8] = b"glTF";
/// Kinds of chunks.
pub const JSON: &[u8] = b"JSON";
pub const BIN: &[u8] = b"BIN\0";

/// Types of numbers.
pub const BYTE: u32 = 5120;
pub const UBYTE: u32 = 5121;
pub const SHORT: u32 = 5122;
pub const USHORT: u32 = 5123;
pub const UINT: u32 = 5125;
pub const FLOAT: u32 = 5126;

/// Primitive modes.
pub const TRIANGLES: u32 = 4;
pub const TRIANGLE_STRIP: u32 = 5;
pub const TRIANGLE_FAN: u32 = 6;

/// Filters and wrap modes of samplers.
pub const LINEAR: u32 = 9729;
pub const LINEAR_MIPMAP: u32 = 9987;
pub const REPEAT: u32 = 10497;
pub const CLAMP: u32 = 33071;
pub const MIRROR: u32 = 33648;

/// Buffer view targets: vertex attributes, and indices.
pub const ARRAY: u32 = 34962;
pub const ELEMENTS: u32 = 34963;

/// The binary chunk under construction, with its buffer views and accessors.
#[derive(Default)]
pub struct Chunk {
    pub bytes: Vec<u8>,
    pub views: Vec<Value>,
    pub accessors: Vec<Value>,
}

impl Chunk {
    /// Appends bytes and a buffer view for them; returns the index of the view.
    pub fn view(&mut self, data: Vec<u8>, target: Option<u32>) -> usize {
        let mut view = json!({ "buffer": 0, "byteOffset": self.bytes.len(), "byteLength": data.len() });
        if let Some(target) = target {
            view["target"] = target.into();
        }
        self.views.push(view);
        self.bytes.extend(data);
        self.bytes.resize(self.bytes.len().next_multiple_of(4), 0);
        self.views.len() - 1
    }

    /// Appends data and an accessor for them; returns the index of the accessor.
    pub fn add(&mut self, data: Vec<u8>, target: u32, mut accessor: Value) -> Value {
        accessor["bufferView"] = self.view(data, Some(target)).into();
        self.accessors.push(accessor);
        (self.accessors.len() - 1).into()
    }

    /// Appends rows of `stride` bytes, of which the last ones may be padding, as vertex attribute.
    pub fn add_rows(&mut self, data: Vec<u8>, stride: usize, accessor: Value) -> Value {
        let index = self.add(data, ARRAY, accessor);
        self.views.last_mut().expect("the view that was added")["byteStride"] = stride.into();
        index
    }
}

/// Names an item, if there is a name.
pub fn name(item: &mut Value, name: &str) {
    if !name.is_empty() {
        item["name"] = name.into();
    }
}

/// A point or direction of a world whose z points up, in one whose y does.
pub fn y_up(p: [f32; 3]) -> [f32; 3] {
    [p[0], p[2], -p[1]]
}

/// The file: header, JSON chunk and binary chunk.
pub fn join(root: &Value, binary: &[u8], path: &Path) -> Result<Vec<u8>> {
    let mut text = serde_json::to_vec(root).expect("JSON of plain values");
    text.resize(text.len().next_multiple_of(4), b' ');
    let total = 12 + 8 + text.len() + 8 + binary.len();
    let total = u32::try_from(total).map_err(|_| DataError::input(path, "the mesh exceeds 4 GiB, the limit of .glb; lower --faces"))?;
    let mut out = b"glTF".to_vec();
    out.extend(2u32.to_le_bytes());
    out.extend(total.to_le_bytes());
    for (kind, chunk) in [(b"JSON", &text[..]), (b"BIN\0", binary)] {
        out.extend((chunk.len() as u32).to_le_bytes());
        out.extend(kind);
        out.extend(chunk);
    }
    Ok(out)
}
