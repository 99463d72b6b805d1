//! TensorBoard event files: TFRecord frames (length, masked CRC32C, payload, masked CRC32C) around
//! protobuf `Event` messages with one scalar each.

use std::fs::File;
use std::io::{BufWriter, Result, Write};
use std::path::Path;

/// An open event file.
pub struct TfEvents {
    out: BufWriter<File>,
}

impl TfEvents {
    /// Starts a file with the version record.
    pub fn create(path: &Path) -> Result<TfEvents> {
        let mut t = TfEvents { out: BufWriter::new(File::create(path)?) };
        let mut event = Vec::new();
        double(&mut event, 1, 0.0);
        bytes(&mut event, 3, b"brain.Event:2");
        t.record(&event)?;
        Ok(t)
    }

    /// Appends one scalar; `seconds` is shown as wall time.
    pub fn scalar(&mut self, tag: &str, step: u64, seconds: f64, value: f32) -> Result<()> {
        let mut v = Vec::new();
        bytes(&mut v, 1, tag.as_bytes());
        v.push(2 << 3 | 5);
        v.extend(value.to_le_bytes());
        let mut summary = Vec::new();
        bytes(&mut summary, 1, &v);
        let mut event = Vec::new();
        double(&mut event, 1, seconds);
        event.push(2 << 3);
        varint(&mut event, step);
        bytes(&mut event, 5, &summary);
        self.record(&event)?;
        self.out.flush()
    }

    fn record(&mut self, payload: &[u8]) -> Result<()> {
        let length = (payload.len() as u64).to_le_bytes();
        self.out.write_all(&length)?;
        self.out.write_all(&masked(&length).to_le_bytes())?;
        self.out.write_all(payload)?;
        self.out.write_all(&masked(payload).to_le_bytes())
    }
}

fn varint(out: &mut Vec<u8>, mut v: u64) {
    while v >= 0x80 {
        out.push(v as u8 | 0x80);
        v >>= 7;
    }
    out.push(v as u8);
}

fn double(out: &mut Vec<u8>, field: u8, v: f64) {
    out.push(field << 3 | 1);
    out.extend(v.to_le_bytes());
}

fn bytes(out: &mut Vec<u8>, field: u8, v: &[u8]) {
    out.push(field << 3 | 2);
    varint(out, v.len() as u64);
    out.extend(v);
}

/// CRC-32C (Castagnoli), bit by bit.
fn crc32c(data: &[u8]) -> u32 {
    !data.iter().fold(!0u32, |c, b| (0..8).fold(c ^ *b as u32, |c, _| if c & 1 == 1 { c >> 1 ^ 0x82f6_3b78 } else { c >> 1 }))
}

fn masked(data: &[u8]) -> u32 {
    crc32c(data).rotate_right(15).wrapping_add(0xa282_ead8)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_checksum_is_castagnolis() {
        assert_eq!(crc32c(b"123456789"), 0xe306_9283);
    }

    #[test]
    fn frames_can_be_walked_and_hold_the_tag() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("e");
        let mut t = TfEvents::create(&path).unwrap();
        t.scalar("train/psnr", 300, 1.5, 25.0).unwrap();
        let data = std::fs::read(&path).unwrap();
        let (mut at, mut payloads) = (0, vec![]);
        while at < data.len() {
            let n = u64::from_le_bytes(data[at..at + 8].try_into().unwrap()) as usize;
            assert_eq!(masked(&data[at..at + 8]), u32::from_le_bytes(data[at + 8..at + 12].try_into().unwrap()));
            let p = &data[at + 12..at + 12 + n];
            assert_eq!(masked(p), u32::from_le_bytes(data[at + 12 + n..at + 16 + n].try_into().unwrap()));
            payloads.push(p);
            at += 16 + n;
        }
        assert_eq!(payloads.len(), 2);
        assert!(payloads[1].windows(10).any(|w| w == b"train/psnr"));
        assert!(payloads[1].windows(4).any(|w| w == 25.0f32.to_le_bytes()));
    }
}
