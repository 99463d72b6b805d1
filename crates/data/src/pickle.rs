//! The part of Python's pickle format (protocols 2 to 5) that `torch.save` writes for named tensors. Nothing is executed: a class or
//! function is stored as a name, and a call as a [`Node::Call`].

use std::io::Read;

/// Largest pickle that is read, in bytes.
const LIMIT: usize = 64 << 20;

/// Index of a value in a [`Pickle`].
pub type Id = u32;

/// One value. Elements of compound values are indices, so that deep nesting cannot exhaust the stack.
#[derive(Clone, Debug, PartialEq)]
pub enum Node {
    None,
    Bool(bool),
    Int(i64),
    Float(f64),
    Text(String),
    Bytes(Vec<u8>),
    /// Tuples and lists.
    List(Vec<Id>),
    Dict(Vec<(Id, Id)>),
    /// A class or function, `module name`.
    Global(String),
    /// A function or class with its arguments.
    Call(Id, Id),
    /// A reference to data outside the pickle.
    Persistent(Id),
}

/// The values of one pickle.
#[derive(Clone, Debug, Default)]
pub struct Pickle {
    nodes: Vec<Node>,
    root: Id,
}

impl Pickle {
    /// The value that the pickle describes.
    pub fn root(&self) -> &Node {
        &self.nodes[self.root as usize]
    }

    /// All values, in the order of their creation.
    pub fn nodes(&self) -> &[Node] {
        &self.nodes
    }

    /// The value with an index.
    pub fn get(&self, id: Id) -> &Node {
        &self.nodes[id as usize]
    }

    /// The elements of a tuple or list; `None` for other values.
    pub fn list(&self, id: Id) -> Option<&[Id]> {
        match self.get(id) {
            Node::List(v) => Some(v),
            _ => None,
        }
    }

    /// An integer; `None` for other values.
    pub fn int(&self, id: Id) -> Option<i64> {
        match self.get(id) {
            Node::Int(v) => Some(*v),
            _ => None,
        }
    }

    /// A text; `None` for other values.
    pub fn text(&self, id: Id) -> Option<&str> {
        match self.get(id) {
            Node::Text(v) => Some(v),
            _ => None,
        }
    }
}

/// Reads one pickle; the reader is left after it.
///
/// # Errors
/// A message for malformed pickles, opcodes that `torch.save` does not use, and pickles of more than 64 MiB.
pub fn read(from: &mut dyn Read) -> Result<Pickle, String> {
    let mut machine = Machine { from, left: LIMIT, out: Pickle::default(), stack: Vec::new(), marks: Vec::new(), memo: Vec::new() };
    machine.run()?;
    Ok(machine.out)
}

struct Machine<'a> {
    from: &'a mut dyn Read,
    /// Bytes that may still be read.
    left: usize,
    out: Pickle,
    stack: Vec<Id>,
    /// Stack heights at the marks.
    marks: Vec<usize>,
    memo: Vec<Option<Id>>,
}

impl Machine<'_> {
    fn run(&mut self) -> Result<(), String> {
        loop {
            let [op] = self.bytes()?;
            match op {
                0x80 => {
                    let [version] = self.bytes()?;
                    if version > 5 {
                        return Err(format!("pickle protocol {version}"));
                    }
                }
                // A frame is only a hint for buffering.
                0x95 => drop(self.bytes::<8>()?),
                b'.' => {
                    self.out.root = self.pop()?;
                    return Ok(());
                }
                b'(' => self.marks.push(self.stack.len()),
                // The state of an object contains nothing about its tensors.
                b'0' | b'b' => drop(self.pop()?),
                _ if self.push_scalar(op)? || self.fill_container(op)? || self.push_object(op)? || self.use_memo(op)? => {}
                _ => return Err(format!("pickle opcode 0x{op:02x}, which torch.save does not write")),
            }
        }
    }

    /// Pushes a number, text or bytes. Returns whether `op` is one of these opcodes.
    fn push_scalar(&mut self, op: u8) -> Result<bool, String> {
        let node = match op {
            b'N' => Node::None,
            0x88 => Node::Bool(true),
            0x89 => Node::Bool(false),
            b'J' => Node::Int(i32::from_le_bytes(self.bytes()?) as i64),
            b'K' => Node::Int(u8::from_le_bytes(self.bytes()?) as i64),
            b'M' => Node::Int(u16::from_le_bytes(self.bytes()?) as i64),
            0x8a => long(&self.short_bytes()?),
            b'G' => Node::Float(f64::from_be_bytes(self.bytes()?)),
            b'X' => text(self.long_bytes()?)?,
            0x8c => text(self.short_bytes()?)?,
            b'C' => Node::Bytes(self.short_bytes()?),
            b'U' => Node::Text(String::from_utf8_lossy(&self.short_bytes()?).into_owned()),
            b'B' => Node::Bytes(self.long_bytes()?),
            _ => return Ok(false),
        };
        self.push(node);
        Ok(true)
    }

    /// Creates or extends a tuple, list, set or dictionary. Returns whether `op` is one of these opcodes.
    fn fill_container(&mut self, op: u8) -> Result<bool, String> {
        match op {
            b']' | b')' | 0x8f => self.push(Node::List(Vec::new())),
            b'}' => self.push(Node::Dict(Vec::new())),
            b't' | b'l' | 0x91 => {
                let v = self.since_mark()?;
                self.push(Node::List(v));
            }
            0x85..=0x87 => {
                let n = (op - 0x84) as usize;
                let first = self.stack.len().checked_sub(n).filter(|f| *f >= self.floor()).ok_or_else(short)?;
                let v = self.stack.split_off(first);
                self.push(Node::List(v));
            }
            b'a' => {
                let v = self.pop()?;
                self.append(vec![v])?;
            }
            b'e' | 0x90 => {
                let v = self.since_mark()?;
                self.append(v)?;
            }
            b's' => {
                let (v, k) = (self.pop()?, self.pop()?);
                self.set(&[k, v])?;
            }
            b'u' => {
                let v = self.since_mark()?;
                self.set(&v)?;
            }
            _ => return Ok(false),
        }
        Ok(true)
    }

    /// Pushes the name of a class or function, a call of one, or a persistent reference. Returns whether `op` is one of these opcodes.
    fn push_object(&mut self, op: u8) -> Result<bool, String> {
        match op {
            b'c' => {
                let (module, name) = (self.line()?, self.line()?);
                self.push(Node::Global(format!("{module} {name}")));
            }
            0x93 => {
                let (name, module) = (self.pop()?, self.pop()?);
                let both = self.out.text(module).zip(self.out.text(name)).map(|(m, n)| format!("{m} {n}"));
                self.push(Node::Global(both.ok_or("a name that is no text")?));
            }
            b'R' | 0x81 => {
                let (arguments, function) = (self.pop()?, self.pop()?);
                let empty = self.out.list(arguments).is_some_and(<[Id]>::is_empty);
                let is_dict = matches!(self.out.get(function), Node::Global(g) if g == "collections OrderedDict");
                self.push(if empty && is_dict { Node::Dict(Vec::new()) } else { Node::Call(function, arguments) });
            }
            b'Q' => {
                let v = self.pop()?;
                self.push(Node::Persistent(v));
            }
            _ => return Ok(false),
        }
        Ok(true)
    }

    /// Stores the top of the stack in the memo, or pushes an entry of the memo. Returns whether `op` is one of these opcodes.
    fn use_memo(&mut self, op: u8) -> Result<bool, String> {
        match op {
            b'q' => {
                let [i] = self.bytes()?;
                self.memo_put(i as usize)?;
            }
            b'r' => {
                let i = u32::from_le_bytes(self.bytes()?);
                self.memo_put(i as usize)?;
            }
            0x94 => self.memo_put(self.memo.len())?,
            b'h' => {
                let [i] = self.bytes()?;
                self.memo_get(i as usize)?;
            }
            b'j' => {
                let i = u32::from_le_bytes(self.bytes()?);
                self.memo_get(i as usize)?;
            }
            _ => return Ok(false),
        }
        Ok(true)
    }

    fn take(&mut self, n: usize) -> Result<Vec<u8>, String> {
        self.left = self.left.checked_sub(n).ok_or("a pickle of more than 64 MiB")?;
        let mut out = Vec::new();
        // Memory grows with the bytes that are read, not with the claimed length.
        let got = (&mut *self.from).take(n as u64).read_to_end(&mut out).map_err(|e| e.to_string())?;
        if got == n { Ok(out) } else { Err("it ends too early; copy the file again".into()) }
    }

    fn bytes<const N: usize>(&mut self) -> Result<[u8; N], String> {
        self.left = self.left.checked_sub(N).ok_or("a pickle of more than 64 MiB")?;
        let mut out = [0; N];
        self.from.read_exact(&mut out).map_err(|_| "it ends too early; copy the file again".to_string())?;
        Ok(out)
    }

    fn line(&mut self) -> Result<String, String> {
        let mut out = Vec::new();
        loop {
            match self.bytes()? {
                [b'\n'] => return String::from_utf8(out).map_err(|_| "a name that is no text".into()),
                [b] if out.len() < 256 => out.push(b),
                _ => return Err("a name of more than 256 letters".into()),
            }
        }
    }

    /// Bytes with a one-byte length before them.
    fn short_bytes(&mut self) -> Result<Vec<u8>, String> {
        let [n] = self.bytes()?;
        self.take(n as usize)
    }

    /// Bytes with a four-byte length before them.
    fn long_bytes(&mut self) -> Result<Vec<u8>, String> {
        let n = u32::from_le_bytes(self.bytes()?);
        self.take(n as usize)
    }

    fn push(&mut self, node: Node) {
        self.stack.push(self.out.nodes.len() as Id);
        self.out.nodes.push(node);
    }

    /// Stack height at the last mark; only opcodes that use the mark may go below it.
    fn floor(&self) -> usize {
        self.marks.last().copied().unwrap_or(0)
    }

    fn pop(&mut self) -> Result<Id, String> {
        if self.stack.len() <= self.floor() {
            return Err(short());
        }
        self.stack.pop().ok_or_else(short)
    }

    fn since_mark(&mut self) -> Result<Vec<Id>, String> {
        let mark = self.marks.pop().ok_or_else(short)?;
        Ok(self.stack.split_off(mark))
    }

    fn top(&mut self) -> Result<&mut Node, String> {
        if self.stack.len() <= self.floor() {
            return Err(short());
        }
        let id = *self.stack.last().ok_or_else(short)?;
        Ok(&mut self.out.nodes[id as usize])
    }

    fn append(&mut self, v: Vec<Id>) -> Result<(), String> {
        match self.top()? {
            Node::List(list) => list.extend(v),
            _ => return Err("elements of what is no list".into()),
        }
        Ok(())
    }

    fn set(&mut self, v: &[Id]) -> Result<(), String> {
        let (pairs, rest) = v.as_chunks::<2>();
        match self.top()? {
            Node::Dict(dict) if rest.is_empty() => dict.extend(pairs.iter().map(|[k, v]| (*k, *v))),
            _ => return Err("entries of what is no dictionary".into()),
        }
        Ok(())
    }

    fn memo_put(&mut self, i: usize) -> Result<(), String> {
        // Memo indices are assigned in order; a gap as wide as the pickle is long cannot come from torch.save.
        if i > self.memo.len() + 256 {
            return Err("a memo out of order".into());
        }
        if i >= self.memo.len() {
            self.memo.resize(i + 1, None);
        }
        let id = *self.stack.last().ok_or_else(short)?;
        self.memo[i] = Some(id);
        Ok(())
    }

    fn memo_get(&mut self, i: usize) -> Result<(), String> {
        let id = self.memo.get(i).copied().flatten().ok_or("a memo that was never set")?;
        self.stack.push(id);
        Ok(())
    }
}

fn text(bytes: Vec<u8>) -> Result<Node, String> {
    Ok(Node::Text(String::from_utf8(bytes).map_err(|_| "a text that is not UTF-8")?))
}

fn short() -> String {
    "a pickle that takes more than it gave".into()
}

/// A little-endian two's complement integer; if it is wider than 64 bits, its bytes.
fn long(v: &[u8]) -> Node {
    if v.len() > 8 {
        return Node::Bytes(v.to_vec());
    }
    let fill = if v.last().is_some_and(|b| b & 0x80 != 0) { 0xff } else { 0 };
    let mut wide = [fill; 8];
    wide[..v.len()].copy_from_slice(v);
    Node::Int(i64::from_le_bytes(wide))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(bytes: &[u8]) -> Result<Pickle, String> {
        read(&mut &bytes[..])
    }

    #[test]
    fn pythons_own_bytes_are_read() {
        // pickle.dumps({"a": [1, -2, 3.5, None, True], "b": (70000, 2**40)}, 2)
        let bytes = b"\x80\x02}q\x00(X\x01\x00\x00\x00aq\x01]q\x02(K\x01J\xfe\xff\xff\xffG@\x0c\x00\x00\x00\x00\x00\x00N\x88eX\x01\x00\x00\x00bq\x03Jp\x11\x01\x00\x8a\x06\x00\x00\x00\x00\x00\x01\x86q\x04u.";
        let p = of(bytes).unwrap();
        let Node::Dict(entries) = p.root() else { panic!("{p:?}") };
        assert_eq!(p.text(entries[0].0), Some("a"));
        let a: Vec<&Node> = p.list(entries[0].1).unwrap().iter().map(|i| p.get(*i)).collect();
        assert_eq!(a, [&Node::Int(1), &Node::Int(-2), &Node::Float(3.5), &Node::None, &Node::Bool(true)]);
        let b: Vec<Option<i64>> = p.list(entries[1].1).unwrap().iter().map(|i| p.int(*i)).collect();
        assert_eq!(b, [Some(70000), Some(1 << 40)]);
    }

    #[test]
    fn calls_are_names_and_nothing_runs() {
        let p = of(b"\x80\x02cos\nsystem\nX\x04\x00\x00\x00true\x85R.").unwrap();
        let Node::Call(f, arguments) = p.root() else { panic!("{p:?}") };
        assert_eq!(p.get(*f), &Node::Global("os system".into()));
        assert_eq!(p.list(*arguments).map(|a| p.text(a[0])), Some(Some("true")));
    }

    #[test]
    fn hostile_pickles_are_refused() {
        for (bytes, what) in [
            (&b""[..], "too early"),
            (b"\x80\x09.", "protocol 9"),
            (b".", "takes more"),
            (b"\x80\x02}q\x00(K\x01u.", "no dictionary"),
            (b"N(0.", "takes more"),
            (b"Nr\xff\xff\xff\x7f.", "out of order"),
            (b"h\x07.", "never set"),
            (b"B\xff\xff\xff\x7f", "64 MiB"),
            (b"B\xff\xff\xff\x00abc", "too early"),
            (b"i\n", "opcode 0x69"),
        ] {
            let e = of(bytes).unwrap_err();
            assert!(e.contains(what), "{bytes:?}: {e}");
        }
        // A million nested tuples.
        let deep = [&b")"[..], &vec![0x85; 1_000_000], b"."].concat();
        assert!(of(&deep).is_ok());
        // A list that contains itself.
        assert!(of(b"]q\x00h\x00a.").is_ok());
    }
}
