//! JPEG files without decoding them (ITU T.81): size and orientation from the header, and a check whether the image data are complete.

use std::borrow::Cow;
use std::io::{self, BufRead, Read, Seek, SeekFrom};

/// What a file's header says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Header {
    /// As stored, before `orientation`.
    pub width: u32,
    pub height: u32,
    /// EXIF orientation, 1 to 8.
    pub orientation: u8,
}

/// Reads a file's markers up to its frame header; `None` if it is not a JPEG or ends before that.
///
/// # Errors
/// If the reader fails.
pub fn header(reader: &mut (impl BufRead + Seek)) -> io::Result<Option<Header>> {
    match markers(reader) {
        Err(e) if e.kind() == io::ErrorKind::UnexpectedEof => Ok(None),
        other => other,
    }
}

fn markers(reader: &mut (impl BufRead + Seek)) -> io::Result<Option<Header>> {
    let byte = |r: &mut dyn Read| -> io::Result<u8> {
        let mut b = [0];
        r.read_exact(&mut b)?;
        Ok(b[0])
    };
    if byte(reader)? != 0xff || byte(reader)? != 0xd8 {
        return Ok(None);
    }
    let mut orientation = 1;
    loop {
        // Skips fill bytes, and garbage that faulty writers leave between segments.
        while byte(reader)? != 0xff {}
        let mut marker = 0xff;
        while marker == 0xff {
            marker = byte(reader)?;
        }
        if matches!(marker, 0x00 | 0x01 | 0xd0..=0xd8) {
            continue;
        }
        if matches!(marker, 0xd9 | 0xda) {
            return Ok(None);
        }
        let length = u16::from_be_bytes([byte(reader)?, byte(reader)?]).saturating_sub(2) as usize;
        let is_frame = matches!(marker, 0xc0..=0xcf) && !matches!(marker, 0xc4 | 0xc8 | 0xcc);
        if is_frame || marker == 0xe1 {
            let mut body = vec![0; length];
            reader.read_exact(&mut body)?;
            if let (true, Some(h)) = (is_frame, body.get(1..5)) {
                let side = |i: usize| u16::from_be_bytes([h[i], h[i + 1]]) as u32;
                return Ok(Some(Header { width: side(2), height: side(0), orientation }));
            }
            if let Some(tiff) = body.strip_prefix(b"Exif\0\0") {
                orientation = image::metadata::Orientation::from_exif_chunk(tiff).map_or(1, |o| o.to_exif());
            }
        } else {
            reader.seek(SeekFrom::Current(length as i64))?;
        }
    }
}

/// A complete file, with its end marker added if it is missing; `None` if the image data end early. Only if the marker is missing, the coded
/// data are counted.
pub fn whole(file: &[u8]) -> Option<Cow<'_, [u8]>> {
    if has_end_marker(file)? {
        return Some(file.into());
    }
    Some([file.strip_suffix(&[0xff]).unwrap_or(file), &[0xff, 0xd9]].concat().into())
}

/// Position at which the coded data of a scan end: the next marker that is neither a stuffed byte, nor a restart, nor a fill byte.
pub(crate) fn end_of_scan(file: &[u8], from: usize) -> Option<usize> {
    let mut at = from;
    loop {
        at += file.get(at..)?.iter().position(|b| *b == 0xff)?;
        match file.get(at + 1)? {
            0 | 0xff | 0xd0..=0xd7 => at += 1,
            _ => return Some(at),
        }
    }
}

/// A component of the frame.
#[derive(Default)]
struct Component {
    id: u8,
    horizontal: usize,
    vertical: usize,
    /// Blocks of the picture, across and down; and across with the padding of interleaved scans.
    blocks: (usize, usize),
    stride: usize,
    /// Bits of each block's nonzero coefficients: refining scans depend on them.
    filled: Vec<u64>,
    /// Coefficients that are complete down to their last bit.
    done: u64,
}

#[derive(Default)]
struct Frame {
    is_progressive: bool,
    components: Vec<Component>,
    /// MCUs of interleaved scans, across and down.
    units: (usize, usize),
}

/// Most blocks that are counted: those of a picture of 65535 by 4096 pixels, which exceeds [`crate::photo::PhotoLimits`].
const MOST_BLOCKS: usize = 1 << 23;

/// Most scans: progressive files have about ten.
const MOST_SCANS: usize = 1000;

/// Most padding bytes after the last data of a scan.
const PADDING: usize = 16;

/// `Some(true)` at the end marker, `Some(false)` if the file ends after the last data, `None` if it ends before.
fn has_end_marker(file: &[u8]) -> Option<bool> {
    let mut frame = Frame::default();
    let (mut tables, mut restart) = (Tables::default(), 0usize);
    let mut at = 2;
    // Counting starts only when the end marker turns out to be missing, so most files are checked quickly.
    let mut count = false;
    let mut scans = Vec::new();
    loop {
        let Some(marker) = next_marker(file, &mut at) else {
            let all = count && frame.components.iter().all(|c| c.done == u64::MAX) && !frame.components.is_empty();
            return all.then_some(false);
        };
        if marker == 0xd9 {
            return Some(true);
        }
        let length = u16::from_be_bytes(file.get(at..at + 2)?.try_into().ok()?) as usize;
        let body = file.get(at + 2..at + length)?;
        at += length;
        match marker {
            0xc0..=0xc2 => frame = Frame::read(marker, body)?,
            0xc4 => tables.read(body)?,
            0xdd => restart = u16::from_be_bytes(body.get(..2)?.try_into().ok()?) as usize,
            0xda => {
                let end = end_of_scan(file, at);
                if scans.len() == MOST_SCANS {
                    return None;
                }
                scans.push((body, at, tables.clone(), restart));
                if end.is_none() {
                    // An interrupted copy may be filled with zeros, which could be read as data.
                    if file[at..].iter().rev().take_while(|b| **b == 0).count() >= PADDING {
                        return None;
                    }
                    // The file ends within this scan: are all scans complete, this one included?
                    count = true;
                    for (body, from, tables, restart) in std::mem::take(&mut scans) {
                        let stop = end_of_scan(file, from).unwrap_or(file.len());
                        frame.scan(body, &file[from..stop], &tables, restart)?;
                    }
                }
                at = end.unwrap_or(file.len());
            }
            _ => {}
        }
    }
}

/// Moves past the next marker and returns it.
fn next_marker(file: &[u8], at: &mut usize) -> Option<u8> {
    loop {
        *at += file.get(*at..)?.iter().position(|b| *b == 0xff)?;
        let marker = *file.get(*at + 1)?;
        if marker == 0xff {
            *at += 1;
            continue;
        }
        *at += 2;
        if !matches!(marker, 0x00 | 0x01 | 0xd0..=0xd8) {
            return Some(marker);
        }
    }
}

/// A Huffman table: codes of each length, the symbols in order.
#[derive(Clone, Default)]
struct Huffman {
    counts: [u8; 16],
    symbols: Vec<u8>,
}

#[derive(Clone, Default)]
struct Tables {
    /// DC and AC tables, four each.
    tables: [[Huffman; 4]; 2],
}

impl Tables {
    fn read(&mut self, mut body: &[u8]) -> Option<()> {
        while let Some((&head, rest)) = body.split_first() {
            let counts: [u8; 16] = rest.get(..16)?.try_into().ok()?;
            let n = counts.iter().map(|c| *c as usize).sum::<usize>();
            let symbols = rest.get(16..16 + n)?.to_vec();
            *self.tables.get_mut((head >> 4) as usize)?.get_mut((head & 15) as usize)? = Huffman { counts, symbols };
            body = &rest[16 + n..];
        }
        Some(())
    }
}

/// Bit reader of a scan; `None` at its end.
struct Bits<'a> {
    data: &'a [u8],
    at: usize,
    left: u32,
}

impl Bits<'_> {
    fn bit(&mut self) -> Option<usize> {
        if self.left == 0 {
            self.left = 8;
            if *self.data.get(self.at)? == 0xff && *self.data.get(self.at + 1)? != 0 {
                return None;
            }
        }
        self.left -= 1;
        let byte = self.data[self.at];
        if self.left == 0 {
            self.at += 1 + (byte == 0xff) as usize;
        }
        Some((byte >> self.left & 1) as usize)
    }

    fn bits(&mut self, n: usize) -> Option<usize> {
        (0..n).try_fold(0usize, |v, _| Some(v << 1 | self.bit()?))
    }

    fn symbol(&mut self, h: &Huffman) -> Option<u8> {
        let (mut code, mut first, mut index) = (0usize, 0usize, 0usize);
        for count in h.counts {
            code |= self.bit()?;
            let count = count as usize;
            if code < first + count {
                return h.symbols.get(index + code.checked_sub(first)?).copied();
            }
            index += count;
            first = (first + count) << 1;
            code <<= 1;
        }
        None
    }

    /// Skips a restart marker.
    fn restart(&mut self) -> Option<()> {
        if self.left > 0 {
            let byte = self.data[self.at];
            self.at += 1 + (byte == 0xff) as usize;
        }
        self.left = 0;
        while *self.data.get(self.at)? == 0xff && *self.data.get(self.at + 1)? == 0xff {
            self.at += 1;
        }
        let found = self.data.get(self.at..self.at + 2)?;
        self.at += 2;
        matches!(found, [0xff, 0xd0..=0xd7]).then_some(())
    }
}

/// Header of a scan: its components, coefficients and bits.
struct Band {
    from: usize,
    to: usize,
    high: u8,
    low: u8,
}

impl Frame {
    fn read(marker: u8, body: &[u8]) -> Option<Frame> {
        let side = |i: usize| Some(u16::from_be_bytes([*body.get(i)?, *body.get(i + 1)?]) as usize);
        let (height, width, n) = (side(1)?, side(3)?, *body.get(5)? as usize);
        let mut components = Vec::new();
        for c in body.get(6..6 + 3 * n)?.chunks_exact(3) {
            let (horizontal, vertical) = ((c[1] >> 4) as usize, (c[1] & 15) as usize);
            if !(1..=4).contains(&horizontal) || !(1..=4).contains(&vertical) {
                return None;
            }
            components.push(Component { id: c[0], horizontal, vertical, ..Component::default() });
        }
        let (most_h, most_v) =
            (components.iter().map(|c| c.horizontal).max().unwrap_or(1), components.iter().map(|c| c.vertical).max().unwrap_or(1));
        let units = (width.div_ceil(8 * most_h), height.div_ceil(8 * most_v));
        for c in &mut components {
            c.blocks = ((width * c.horizontal).div_ceil(8 * most_h), (height * c.vertical).div_ceil(8 * most_v));
            c.stride = units.0 * c.horizontal;
            if c.stride * units.1 * c.vertical > MOST_BLOCKS {
                return None;
            }
        }
        Some(Frame { is_progressive: marker == 0xc2, components, units })
    }

    /// Parses the data of a scan; `None` if they end too early.
    fn scan(&mut self, head: &[u8], data: &[u8], tables: &Tables, restart: usize) -> Option<()> {
        let n = *head.first()? as usize;
        let listed = head.get(1..1 + 2 * n)?;
        let parameters = head.get(1 + 2 * n..4 + 2 * n)?;
        let band = if self.is_progressive {
            Band { from: parameters[0] as usize, to: (parameters[1] as usize).min(63), high: parameters[2] >> 4, low: parameters[2] & 15 }
        } else {
            Band { from: 0, to: 63, high: 0, low: 0 }
        };
        let mut chosen = Vec::new();
        for pair in listed.chunks_exact(2) {
            let index = self.components.iter().position(|c| c.id == pair[0])?;
            let table = |kind: usize, nibble: u8| tables.tables[kind].get(nibble as usize);
            chosen.push((index, table(0, pair[1] >> 4)?, table(1, pair[1] & 15)?));
            let c = &mut self.components[index];
            c.filled.resize(c.stride * self.units.1 * c.vertical, 0);
        }
        let alone = chosen.len() == 1;
        let (across, down) = if alone { self.components[chosen[0].0].blocks } else { self.units };
        let mut bits = Bits { data, at: 0, left: 0 };
        let mut run = 0;
        for unit in 0..across * down {
            if restart > 0 && unit > 0 && unit % restart == 0 {
                bits.restart()?;
                run = 0;
            }
            for (index, direct, alternating) in &chosen {
                let c = &mut self.components[*index];
                let (h, v) = if alone { (1, 1) } else { (c.horizontal, c.vertical) };
                for k in 0..h * v {
                    let (x, y) = (unit % across * h + k % h, unit / across * v + k / h);
                    let filled = &mut c.filled[y * c.stride + x];
                    if self.is_progressive {
                        progressive(&mut bits, &band, direct, alternating, filled, &mut run)?;
                    } else {
                        sequential(&mut bits, direct, alternating)?;
                    }
                }
            }
        }
        if data.len() - bits.at.min(data.len()) > PADDING {
            return None;
        }
        if band.low == 0 {
            let coefficients = (u64::MAX >> (63 - band.to)) & (u64::MAX << band.from.min(63));
            chosen.iter().for_each(|c| self.components[c.0].done |= coefficients);
        }
        Some(())
    }
}

/// A block of a sequential scan (T.81, F.2.2).
fn sequential(bits: &mut Bits, direct: &Huffman, alternating: &Huffman) -> Option<()> {
    let size = bits.symbol(direct)? as usize;
    bits.bits(size.min(16))?;
    let mut k = 1;
    while k < 64 {
        let symbol = bits.symbol(alternating)? as usize;
        let (run, size) = (symbol >> 4, symbol & 15);
        if size == 0 && run < 15 {
            break;
        }
        bits.bits(size)?;
        k += run + 1;
    }
    Some(())
}

/// A block of a progressive scan (T.81, G.1.2); `run` counts the following blocks that are empty.
fn progressive(bits: &mut Bits, band: &Band, direct: &Huffman, alternating: &Huffman, filled: &mut u64, run: &mut usize) -> Option<()> {
    if band.from == 0 {
        let size = if band.high == 0 { bits.symbol(direct)? as usize } else { 1 };
        return bits.bits(size.min(16)).map(drop);
    }
    let refines = band.high > 0;
    let mut k = band.from;
    if *run == 0 {
        while k <= band.to {
            let symbol = bits.symbol(alternating)? as usize;
            let (mut zeros, size) = (symbol >> 4, symbol & 15);
            if size == 0 && zeros < 15 {
                *run = (1 << zeros) + bits.bits(zeros)?;
                break;
            }
            bits.bits(if refines { size.min(1) } else { size })?;
            // In a refining scan, each known coefficient takes one bit and does not count as a zero.
            while k <= band.to {
                if refines && *filled >> k & 1 == 1 {
                    bits.bit()?;
                } else if zeros == 0 {
                    break;
                } else {
                    zeros -= 1;
                }
                k += 1;
            }
            if size > 0 && k <= band.to {
                *filled |= 1 << k;
            }
            k += 1;
        }
    }
    if *run > 0 {
        *run -= 1;
        if refines {
            let rest = (k..=band.to).filter(|k| *filled >> k & 1 == 1).count();
            bits.bits(rest)?;
        }
    }
    Some(())
}
