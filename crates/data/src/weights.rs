//! Weights of networks from the user's files: safetensors, and what PyTorch's `torch.save` writes of a state_dict (`.pth`, `.pt`),
//! in its present format (a ZIP archive) and the one before 1.6.

use crate::error::{DataError, Result};
use crate::pickle::{self, Id, Node, Pickle};
use safetensors::tensor::{Dtype, SafeTensors};
use std::collections::HashMap;
use std::fs::File;
use std::io::{BufReader, Read, Seek};
use std::path::Path;

/// Most bytes of a file.
const LIMIT: u64 = 8 << 30;
/// Most numbers that are taken out of a file.
const MOST: usize = 1 << 30;

/// A named tensor, row by row.
#[derive(Clone, Debug, PartialEq)]
pub struct Tensor {
    pub name: String,
    pub shape: Vec<usize>,
    pub values: Vec<f32>,
}

/// The tensors of floating-point numbers whose names `wanted` admits, in the file's order, as f32.
///
/// # Errors
/// When the file is neither safetensors nor `torch.save`'s, is not whole, or holds more than names and tensors.
pub fn read(path: &Path, wanted: &dyn Fn(&str) -> bool) -> Result<Vec<Tensor>> {
    let file = File::open(path).map_err(DataError::io(path, "read"))?;
    let size = file.metadata().map_err(DataError::io(path, "read"))?.len();
    if size > LIMIT {
        return Err(DataError::input(path, format!("{size} bytes, more than the {LIMIT} that a file of weights may have")));
    }
    let mut file = BufReader::new(file);
    let mut head = [0; 4];
    let known = file.read_exact(&mut head).and_then(|()| file.rewind()).is_ok();
    let read = match head {
        _ if !known => Err("it is empty or can hardly be read".to_string()),
        [b'P', b'K', 3, 4] => from_zip(file, wanted),
        // Every pickle of protocol 2 begins so; in a safetensors file this would be a header of at least 640 bytes whose length
        // ends in 0x0280, which the magic number below tells apart.
        [0x80, 2, 0x8a, 0x0a] => from_legacy(file, size, wanted),
        _ => from_safetensors(path, wanted),
    };
    read.map_err(|e| DataError::input(path, format!("cannot be read as weights: {e}")))
}

fn from_safetensors(path: &Path, wanted: &dyn Fn(&str) -> bool) -> std::result::Result<Vec<Tensor>, String> {
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
        out.push(Tensor { name: name.into(), shape: t.shape().to_vec(), values: kind.values(t.data()) });
    }
    Ok(out)
}

/// Formats of numbers.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Kind {
    Half,
    Brain,
    Single,
    Double,
    /// Numbers of so many bytes that are no weights.
    Other(usize),
}

impl Kind {
    fn of_storage(global: &str) -> Option<Kind> {
        Some(match global.strip_prefix("torch ")? {
            "HalfStorage" => Kind::Half,
            "BFloat16Storage" => Kind::Brain,
            "FloatStorage" => Kind::Single,
            "DoubleStorage" => Kind::Double,
            "LongStorage" | "ComplexFloatStorage" => Kind::Other(8),
            "IntStorage" => Kind::Other(4),
            "ShortStorage" => Kind::Other(2),
            "ByteStorage" | "CharStorage" | "BoolStorage" | "UntypedStorage" => Kind::Other(1),
            _ => return None,
        })
    }

    fn bytes(self) -> usize {
        match self {
            Kind::Half | Kind::Brain => 2,
            Kind::Single => 4,
            Kind::Double => 8,
            Kind::Other(n) => n,
        }
    }

    /// Little-endian numbers as f32.
    fn values(self, data: &[u8]) -> Vec<f32> {
        match self {
            Kind::Half => data.as_chunks::<2>().0.iter().map(|b| half(u16::from_le_bytes(*b))).collect(),
            Kind::Brain => data.as_chunks::<2>().0.iter().map(|b| f32::from_bits((u16::from_le_bytes(*b) as u32) << 16)).collect(),
            Kind::Single => data.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect(),
            Kind::Double => data.as_chunks::<8>().0.iter().map(|b| f64::from_le_bytes(*b) as f32).collect(),
            Kind::Other(_) => Vec::new(),
        }
    }
}

/// IEEE 754's 16 bits.
fn half(bits: u16) -> f32 {
    let (sign, exponent, fraction) = (bits >> 15, (bits >> 10 & 31) as i32, (bits & 1023) as f32);
    let magnitude = match exponent {
        0 => fraction * 2f32.powi(-24),
        31 if fraction == 0.0 => f32::INFINITY,
        31 => f32::NAN,
        e => (1.0 + fraction / 1024.0) * 2f32.powi(e - 15),
    };
    if sign == 1 { -magnitude } else { magnitude }
}

/// A tensor as the pickle describes it.
struct Described {
    name: String,
    shape: Vec<usize>,
    kind: Kind,
    /// Name of the storage and how many numbers it has.
    storage: String,
    stored: usize,
    /// The first number of the tensor, and how many there are.
    first: usize,
    count: usize,
}

/// The tensors that a state_dict names, or that one under a key such as `state_dict` does.
fn described(p: &Pickle, wanted: &dyn Fn(&str) -> bool) -> std::result::Result<Vec<Described>, String> {
    let Node::Dict(entries) = p.root() else {
        return Err("it holds no dictionary of names and tensors; save model.state_dict() instead of the model".into());
    };
    let mut out = Vec::new();
    for (key, value) in entries {
        match p.get(*value) {
            Node::Dict(inner) => {
                for (key, value) in inner {
                    describe(p, *key, *value, wanted, &mut out)?;
                }
            }
            _ => describe(p, *key, *value, wanted, &mut out)?,
        }
    }
    if out.iter().map(|d| d.count).try_fold(0usize, usize::checked_add).is_none_or(|n| n > MOST) {
        return Err(format!("more than {MOST} numbers"));
    }
    Ok(out)
}

fn describe(p: &Pickle, key: Id, value: Id, wanted: &dyn Fn(&str) -> bool, out: &mut Vec<Described>) -> std::result::Result<(), String> {
    let Some(name) = p.text(key).filter(|n| wanted(n)) else { return Ok(()) };
    let mut value = value;
    // A parameter is a tensor with the wish for a gradient.
    if let Node::Call(f, arguments) = p.get(value)
        && matches!(p.get(*f), Node::Global(g) if g == "torch._utils _rebuild_parameter")
        && let Some([tensor, ..]) = p.list(*arguments)
    {
        value = *tensor;
    }
    let Node::Call(f, arguments) = p.get(value) else { return Ok(()) };
    let wrong = |what: &str| format!("{name:.80}: {what}");
    match p.get(*f) {
        Node::Global(g) if g == "torch._utils _rebuild_tensor_v2" => {}
        Node::Global(g) => return Err(wrong(&format!("{g:.80} is not a plain tensor; save model.state_dict() alone"))),
        _ => return Err(wrong("is not a plain tensor")),
    }
    let Some(&[storage, first, size, stride, ..]) = p.list(*arguments) else { return Err(wrong("malformed tensor")) };
    let Node::Persistent(storage) = p.get(storage) else { return Err(wrong("malformed storage")) };
    let Some(&[tag, class, key, _, stored, ..]) = p.list(*storage) else { return Err(wrong("malformed storage")) };
    let (Some("storage"), Node::Global(class), Some(key)) = (p.text(tag), p.get(class), p.text(key)) else {
        return Err(wrong("malformed storage"));
    };
    let kind = Kind::of_storage(class).ok_or_else(|| wrong(&format!("{class:.80} holds numbers of an unknown kind")))?;
    if let Kind::Other(_) = kind {
        return Ok(());
    }
    let numbers = |id: Id| -> Option<Vec<usize>> { p.list(id)?.iter().map(|i| usize::try_from(p.int(*i)?).ok()).collect() };
    let unsigned = |id: Id| p.int(id).and_then(|v| usize::try_from(v).ok());
    let (Some(shape), Some(strides), Some(first), Some(stored)) = (numbers(size), numbers(stride), unsigned(first), unsigned(stored))
    else {
        return Err(wrong("malformed shape"));
    };
    let count = shape.iter().try_fold(1usize, |n, s| n.checked_mul(*s)).ok_or_else(|| wrong("malformed shape"))?;
    let mut step = 1;
    let in_rows = shape.len() == strides.len()
        && shape.iter().zip(&strides).rev().all(|(n, s)| {
            let fits = *n <= 1 || *s == step;
            step *= n.max(&1);
            fits
        });
    if count > 0 && !in_rows {
        return Err(wrong("is not stored row by row; save its .contiguous()"));
    }
    if first.checked_add(count).is_none_or(|end| end > stored) {
        return Err(wrong("reaches beyond its storage"));
    }
    out.push(Described { name: name.into(), shape, kind, storage: key.into(), stored, first, count });
    Ok(())
}

impl Described {
    /// The tensor, of its storage's bytes.
    fn of(self, storage: &[u8]) -> std::result::Result<Tensor, String> {
        let n = self.kind.bytes();
        let range = self.first.checked_mul(n).zip(self.count.checked_mul(n)).and_then(|(a, n)| storage.get(a..a.checked_add(n)?));
        let data = range.ok_or_else(|| format!("{:.80}: its numbers are missing; copy the file again", self.name))?;
        Ok(Tensor { name: self.name, shape: self.shape, values: self.kind.values(data) })
    }
}

fn from_zip(file: BufReader<File>, wanted: &dyn Fn(&str) -> bool) -> std::result::Result<Vec<Tensor>, String> {
    let mut zip = zip::ZipArchive::new(file).map_err(|e| format!("not a whole archive ({e}); copy the file again"))?;
    let named = |name: std::result::Result<std::borrow::Cow<str>, _>| Some(name.ok()?.strip_suffix("data.pkl")?.to_string());
    let root = zip.file_names().find_map(named).ok_or("an archive without data.pkl, so none of torch.save")?;
    if let Ok(mut order) = zip.by_name(&format!("{root}byteorder")) {
        let mut text = Vec::new();
        order.by_ref().take(16).read_to_end(&mut text).map_err(|e| e.to_string())?;
        if text != b"little" {
            return Err("its numbers are big-endian; save it on another machine".into());
        }
    }
    let p = {
        let mut entry = zip.by_name(&format!("{root}data.pkl")).map_err(|e| e.to_string())?;
        pickle::read(&mut entry)?
    };
    let mut out = Vec::new();
    for d in described(&p, wanted)? {
        let mut entry = zip.by_name(&format!("{root}data/{}", d.storage)).map_err(|e| format!("{:.80}: {e}", d.name))?;
        if entry.compression() != zip::CompressionMethod::Stored {
            return Err("its numbers are compressed, which torch.save never does".into());
        }
        let most = (d.first + d.count).checked_mul(d.kind.bytes()).ok_or("malformed shape")?;
        let mut data = Vec::new();
        entry.by_ref().take(most as u64).read_to_end(&mut data).map_err(|e| format!("{:.80}: {e}; copy the file again", d.name))?;
        drop(entry);
        out.push(d.of(&data)?);
    }
    Ok(out)
}

/// The number that opens files of PyTorch before 1.6.
const MAGIC: [u8; 10] = [0x6c, 0xfc, 0x9c, 0x46, 0xf9, 0x20, 0x6a, 0xa8, 0x50, 0x19];

fn from_legacy(mut file: BufReader<File>, size: u64, wanted: &dyn Fn(&str) -> bool) -> std::result::Result<Vec<Tensor>, String> {
    if pickle::read(&mut file)?.root() != &Node::Bytes(MAGIC.into()) {
        return Err("a pickle, but none of torch.save; save model.state_dict() by torch.save".into());
    }
    let version = pickle::read(&mut file)?;
    if version.root() != &Node::Int(1001) {
        return Err("another version of torch.save; save it again with a recent PyTorch".into());
    }
    let system = pickle::read(&mut file)?;
    if let Node::Dict(entries) = system.root()
        && entries.iter().any(|(k, v)| system.text(*k) == Some("little_endian") && system.get(*v) == &Node::Bool(false))
    {
        return Err("its numbers are big-endian; save it on another machine".into());
    }
    let p = pickle::read(&mut file)?;
    let keys = pickle::read(&mut file)?;
    let Node::List(order) = keys.root() else { return Err("no list of storages".into()) };
    let kinds = storages(&p)?;
    let mut by_storage: HashMap<String, Vec<(usize, Described)>> = HashMap::new();
    for (i, d) in described(&p, wanted)?.into_iter().enumerate() {
        by_storage.entry(d.storage.clone()).or_default().push((i, d));
    }
    let mut out: Vec<(usize, Tensor)> = Vec::new();
    for key in order {
        let key = keys.text(*key).ok_or("a storage without a name")?;
        let mut head = [0; 8];
        file.read_exact(&mut head).map_err(|_| "it ends too early; copy the file again")?;
        let count = u64::from_le_bytes(head);
        let kind = kinds.get(key).ok_or("a storage that nothing describes")?;
        let bytes = count.checked_mul(kind.bytes() as u64).filter(|n| *n <= size).ok_or("a storage larger than the file")?;
        let Some(here) = by_storage.remove(key) else {
            file.seek_relative(bytes as i64).map_err(|e| e.to_string())?;
            if file.stream_position().map_err(|e| e.to_string())? > size {
                return Err("it ends too early; copy the file again".into());
            }
            continue;
        };
        let mut data = Vec::new();
        file.by_ref().take(bytes).read_to_end(&mut data).map_err(|e| e.to_string())?;
        for (i, d) in here {
            if d.stored as u64 > count {
                return Err(format!("{:.80}: its storage is shorter than described", d.name));
            }
            out.push((i, d.of(&data)?));
        }
    }
    if let Some((_, d)) = by_storage.into_values().flatten().next() {
        return Err(format!("{:.80}: its numbers are missing; copy the file again", d.name));
    }
    out.sort_by_key(|(i, _)| *i);
    Ok(out.into_iter().map(|(_, t)| t).collect())
}

/// Names and kinds of all storages, those of tensors that nobody wants among them.
fn storages(p: &Pickle) -> std::result::Result<HashMap<String, Kind>, String> {
    let mut out = HashMap::new();
    for node in p.nodes() {
        let Node::Persistent(id) = node else { continue };
        let Some(&[_, class, key, ..]) = p.list(*id) else { return Err("malformed storage".into()) };
        let (Node::Global(class), Some(key)) = (p.get(class), p.text(key)) else { return Err("malformed storage".into()) };
        let kind = Kind::of_storage(class).ok_or_else(|| format!("{class:.80} holds numbers of an unknown kind"))?;
        out.insert(key.to_string(), kind);
    }
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::PathBuf;

    /// Made by benches/peers/lpips_reference.py, by PyTorch 2.
    fn sample(name: &str) -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data").join(name)
    }

    #[test]
    fn both_formats_of_torch_save_are_read() {
        for name in ["small.pth", "small_legacy.pth"] {
            let tensors = read(&sample(name), &|_| true).unwrap();
            let names: Vec<&str> = tensors.iter().map(|t| &t.name[..]).collect();
            // Integers are no weights.
            let expected =
                ["0.weight", "0.bias", "1.weight", "1.bias", "1.running_mean", "1.running_var", "half", "brain", "double", "part"];
            assert_eq!(names, expected, "{name}");
            let by = |n: &str| tensors.iter().find(|t| t.name == n).unwrap();
            assert_eq!(by("0.weight").shape, [3, 2, 2, 2]);
            assert_eq!(by("0.weight").values[..4], [-1.0, -0.932_165_15, -0.502_243_9, -0.621_745_6]);
            assert_eq!(by("1.running_var").values, [0.836_628_56, 0.400_305_15, -0.595_174_8]);
            assert_eq!(by("half").values, [1.0, -0.5, 65504.0, 5.960_464_5e-8]);
            assert_eq!(by("brain").values, [1.0, -2.5]);
            assert_eq!(by("double").values, [0.1]);
            assert_eq!(by("part").values, [4.0, 5.0, 6.0], "a part of a longer storage");
            assert_eq!(read(&sample(name), &|n| n == "part").unwrap(), [by("part").clone()]);
        }
    }

    #[test]
    fn safetensors_are_read() {
        let dir = tempfile::tempdir().unwrap();
        let data: Vec<u8> = [1.5f32, -2.0].iter().flat_map(|v| v.to_le_bytes()).collect();
        let view = safetensors::tensor::TensorView::new(Dtype::F32, vec![2, 1], &data).unwrap();
        let path = dir.path().join("a.safetensors");
        std::fs::write(&path, safetensors::serialize([("w", view)], None).unwrap()).unwrap();
        assert_eq!(read(&path, &|_| true).unwrap(), [Tensor { name: "w".into(), shape: vec![2, 1], values: vec![1.5, -2.0] }]);
    }

    #[test]
    fn files_that_end_early_or_are_something_else_are_refused() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.pth");
        for name in ["small.pth", "small_legacy.pth"] {
            let whole = std::fs::read(sample(name)).unwrap();
            for n in (0..whole.len()).step_by(7) {
                std::fs::write(&path, &whole[..n]).unwrap();
                let e = read(&path, &|_| true).unwrap_err();
                assert!(e.is_input() && e.to_string().contains("a.pth"), "{name} {n}: {e}");
            }
        }
        std::fs::write(&path, b"\x80\x02cos\nsystem\nX\x04\x00\x00\x00true\x85R.").unwrap();
        assert!(read(&path, &|_| true).is_err());
    }

    #[test]
    fn tensors_beyond_their_storage_are_refused() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.pth");
        let whole = std::fs::read(sample("small_legacy.pth")).unwrap();
        // The tensor `part` begins at its storage's number 4 and has three of ten.
        let at = whole.windows(6).position(|w| w == b"K\x04K\x03\x85q").unwrap();
        for (i, v) in [(1, 200u8), (3, 9)] {
            let mut bad = whole.clone();
            bad[at + i] = v;
            std::fs::write(&path, bad).unwrap();
            let e = read(&path, &|_| true).unwrap_err().to_string();
            assert!(e.contains("part") && e.contains("beyond"), "{e}");
        }
    }

    #[test]
    fn halves_are_exact() {
        for (bits, value) in [(0x3c00, 1.0f32), (0xc000, -2.0), (0x7bff, 65504.0), (1, 2f32.powi(-24)), (0x7c00, f32::INFINITY)] {
            assert_eq!(half(bits), value);
        }
        assert!(half(0x7e00).is_nan());
    }
}
