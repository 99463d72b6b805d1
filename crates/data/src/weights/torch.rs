//! Files of `torch.save`: a pickle with names and descriptions of tensors, and the numbers beside it.

use super::number::Kind;
use crate::pickle::{self, Id, Node, Pickle};
use diorama_geom::NamedArray;
use std::collections::HashMap;
use std::fs::File;
use std::io::{BufReader, Read, Seek};

/// Modules that run programs, access files or load code: a file of weights that calls them is hostile.
const HOSTILE: [&str; 18] = [
    "os",
    "posix",
    "nt",
    "subprocess",
    "sys",
    "shutil",
    "socket",
    "runpy",
    "importlib",
    "pty",
    "code",
    "ctypes",
    "builtins",
    "__builtin__",
    "webbrowser",
    "pickle",
    "marshal",
    "operator",
];
/// Functions of those modules that only build values.
const HARMLESS: [&str; 8] = [
    "builtins set",
    "builtins frozenset",
    "builtins complex",
    "builtins bytearray",
    "builtins slice",
    "__builtin__ set",
    "__builtin__ frozenset",
    "builtins object",
];

/// A tensor as the pickle describes it.
struct Described {
    name: String,
    shape: Vec<usize>,
    kind: Kind,
    /// Name of the storage, and how many numbers it has.
    storage: String,
    stored: usize,
    /// Index of the tensor's first number, and how many it has.
    first: usize,
    count: usize,
    /// Strides of the axes, if the numbers are not stored row by row.
    strides: Option<Vec<usize>>,
}

/// The tensors of a state_dict, at the top or under a key such as `state_dict`.
fn described(p: &Pickle, file_bytes: u64, wanted: &dyn Fn(&str) -> bool) -> std::result::Result<Vec<Described>, String> {
    refuse_hostile(p)?;
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
    // Tensors may share storage, but a small file must not fill the memory.
    if out.iter().map(|d| d.count as u64).try_fold(0, u64::checked_add).is_none_or(|n| n > file_bytes) {
        return Err("its tensors have more numbers than the file has bytes".into());
    }
    Ok(out)
}

/// Refuses a pickle that would have executed something. Nothing is ever called here; the message tells the user what kind of file it is.
fn refuse_hostile(p: &Pickle) -> std::result::Result<(), String> {
    for node in p.nodes() {
        let Node::Call(f, _) = node else { continue };
        let Node::Global(name) = p.get(*f) else { continue };
        let module = name.split([' ', '.']).next().unwrap_or_default();
        if HOSTILE.contains(&module) && !HARMLESS.contains(&&name[..]) {
            return Err(format!("it would run {:.80}, which no file of weights needs; do not load it elsewhere", name.replace(' ', ".")));
        }
    }
    Ok(())
}

fn describe(p: &Pickle, key: Id, value: Id, wanted: &dyn Fn(&str) -> bool, out: &mut Vec<Described>) -> std::result::Result<(), String> {
    let Some(name) = p.text(key).filter(|n| wanted(n)) else { return Ok(()) };
    let mut value = value;
    // A parameter is a tensor with a flag for its gradient.
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
    if shape.len() != strides.len() {
        return Err(wrong("malformed shape"));
    }
    let mut step = 1;
    let in_rows = shape.iter().zip(&strides).rev().all(|(n, s)| {
        let fits = *n <= 1 || *s == step;
        step *= n.max(&1);
        fits
    });
    let last = shape.iter().zip(&strides).try_fold(first, |at, (n, s)| at.checked_add(n.saturating_sub(1).checked_mul(*s)?));
    if count > 0 && last.is_none_or(|last| last >= stored) {
        return Err(wrong("reaches beyond its storage"));
    }
    let strides = (count > 0 && !in_rows).then_some(strides);
    out.push(Described { name: name.into(), shape, kind, storage: key.into(), stored, first, count, strides });
    Ok(())
}

impl Described {
    /// How many of the storage's numbers must be read to get all numbers of the tensor.
    fn end(&self) -> Option<usize> {
        match &self.strides {
            None => self.first.checked_add(self.count),
            Some(strides) => self.shape.iter().zip(strides).map(|(n, s)| (n - 1) * s).sum::<usize>().checked_add(self.first + 1),
        }
    }

    /// Decodes the tensor from the bytes of its storage.
    fn of(self, storage: &[u8]) -> std::result::Result<NamedArray, String> {
        let n = self.kind.bytes();
        let range = self.first.checked_mul(n).zip(self.end().and_then(|e| e.checked_mul(n)));
        let data = range.and_then(|(a, b)| storage.get(a..b));
        let data = data.ok_or_else(|| format!("{:.80}: its numbers are missing; copy the file again", self.name))?;
        let values = match &self.strides {
            None => self.kind.values(data),
            Some(strides) => in_rows(&self.shape, strides, &self.kind.values(data)),
        };
        Ok(NamedArray { name: self.name, shape: self.shape, values })
    }
}

/// Copies numbers with strides into row-major order.
fn in_rows(shape: &[usize], strides: &[usize], from: &[f32]) -> Vec<f32> {
    let mut index = vec![0; shape.len()];
    let mut out = Vec::new();
    for _ in 0..shape.iter().product() {
        out.push(from[index.iter().zip(strides).map(|(i, s)| i * s).sum::<usize>()]);
        for axis in (0..shape.len()).rev() {
            index[axis] += 1;
            if index[axis] < shape[axis] {
                break;
            }
            index[axis] = 0;
        }
    }
    out
}

pub(super) fn from_zip(file: BufReader<File>, size: u64, wanted: &dyn Fn(&str) -> bool) -> std::result::Result<Vec<NamedArray>, String> {
    let mut zip = zip::ZipArchive::new(file).map_err(|e| format!("not a whole archive ({e}); copy the file again"))?;
    let named = |name: std::result::Result<std::borrow::Cow<str>, _>| Some(name.ok()?.strip_suffix("data.pkl")?.to_string());
    let root = zip.file_names().find_map(named).ok_or("an archive without data.pkl, so it was not written by torch.save")?;
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
    for d in described(&p, size, wanted)? {
        let mut entry = zip.by_name(&format!("{root}data/{}", d.storage)).map_err(|e| format!("{:.80}: {e}", d.name))?;
        if entry.compression() != zip::CompressionMethod::Stored {
            return Err("its numbers are compressed, which torch.save never does".into());
        }
        let most = d.end().and_then(|n| n.checked_mul(d.kind.bytes())).ok_or("malformed shape")?;
        let mut data = Vec::new();
        entry.by_ref().take(most as u64).read_to_end(&mut data).map_err(|e| format!("{:.80}: {e}; copy the file again", d.name))?;
        drop(entry);
        out.push(d.of(&data)?);
    }
    Ok(out)
}

/// Magic number of files from PyTorch before 1.6.
const MAGIC: [u8; 10] = [0x6c, 0xfc, 0x9c, 0x46, 0xf9, 0x20, 0x6a, 0xa8, 0x50, 0x19];

pub(super) fn from_legacy(
    mut file: BufReader<File>,
    size: u64,
    wanted: &dyn Fn(&str) -> bool,
) -> std::result::Result<Vec<NamedArray>, String> {
    if pickle::read(&mut file)?.root() != &Node::Bytes(MAGIC.into()) {
        return Err("a pickle, but not one of torch.save; save model.state_dict() with torch.save".into());
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
    for (i, d) in described(&p, size, wanted)?.into_iter().enumerate() {
        by_storage.entry(d.storage.clone()).or_default().push((i, d));
    }
    let mut out: Vec<(usize, NamedArray)> = Vec::new();
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

/// Names and number formats of all storages, including those of tensors that are not wanted.
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
