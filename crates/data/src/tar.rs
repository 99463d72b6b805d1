//! Tar archives (POSIX ustar) whose bytes depend on names and contents alone: no owner, and a modification time of 0.

use std::io::{Error, ErrorKind, Result, Write};

/// Headers, and contents with zeros behind them, are multiples of so many bytes.
const BLOCK: usize = 512;
/// Bytes of a name, and the size from which eleven octal digits do not hold it.
const LONGEST_NAME: usize = 100;
const SIZES: u64 = 1 << 33;

/// Appends a file to an archive.
///
/// # Errors
/// When the name is empty or longer than 100 bytes, the content has 8 GiB or more, or `out` cannot be written.
pub fn append(out: &mut impl Write, name: &str, bytes: &[u8]) -> Result<()> {
    out.write_all(&header(name, bytes.len() as u64)?)?;
    out.write_all(bytes)?;
    out.write_all(&[0; BLOCK][..bytes.len().next_multiple_of(BLOCK) - bytes.len()])
}

/// Ends an archive, with two blocks of zeros.
///
/// # Errors
/// When `out` cannot be written.
pub fn end(out: &mut impl Write) -> Result<()> {
    out.write_all(&[0; 2 * BLOCK])
}

fn header(name: &str, size: u64) -> Result<[u8; BLOCK]> {
    let wrong = |what: &str| Err(Error::new(ErrorKind::InvalidInput, format!("{name:?}: {what}")));
    if name.is_empty() || name.len() > LONGEST_NAME {
        return wrong("names in a tar archive have 1 to 100 bytes");
    }
    if size >= SIZES {
        return wrong("files in a tar archive have less than 8 GiB");
    }
    let mut out = [0; BLOCK];
    let mut put = |at: usize, text: &str| out[at..at + text.len()].copy_from_slice(text.as_bytes());
    put(0, name);
    // Mode, user, group, size, time; the checksum counts as spaces; a file; magic and version; device.
    put(100, "0000644\0");
    put(108, "0000000\0");
    put(116, "0000000\0");
    put(124, &format!("{size:011o}\0"));
    put(136, "00000000000\0");
    put(148, "        ");
    put(156, "0");
    put(257, "ustar\x0000");
    put(329, "0000000\0");
    put(337, "0000000\0");
    let sum: u32 = out.iter().map(|b| *b as u32).sum();
    out[148..156].copy_from_slice(format!("{sum:06o}\0 ").as_bytes());
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Names and contents of an archive's files, whose checksums are verified.
    fn files(mut bytes: &[u8]) -> Vec<(String, Vec<u8>)> {
        let octal = |b: &[u8]| u64::from_str_radix(std::str::from_utf8(b).unwrap().trim_end_matches(['\0', ' ']), 8).unwrap();
        let mut out = Vec::new();
        while bytes[..BLOCK].iter().any(|b| *b != 0) {
            let (header, rest) = bytes.split_at(BLOCK);
            let sum: u64 = header.iter().enumerate().map(|(i, b)| if (148..156).contains(&i) { 32 } else { *b as u64 }).sum();
            assert_eq!(sum, octal(&header[148..156]));
            assert_eq!((&header[257..265], header[156]), (&b"ustar\x0000"[..], b'0'));
            let size = octal(&header[124..136]) as usize;
            let name = header[..100].iter().copied().take_while(|b| *b != 0).collect();
            out.push((String::from_utf8(name).unwrap(), rest[..size].to_vec()));
            assert!(rest[size..size.next_multiple_of(BLOCK)].iter().all(|b| *b == 0));
            bytes = &rest[size.next_multiple_of(BLOCK)..];
        }
        assert_eq!(bytes, [0; 2 * BLOCK]);
        out
    }

    #[test]
    fn archives_hold_files_of_any_size_and_equal_ones_are_equal() {
        let wanted: Vec<(String, Vec<u8>)> = [0, 1, 511, 512, 513, 70_000].map(|n| (format!("{n}.ü"), vec![7; n])).to_vec();
        let made = || {
            let mut out = Vec::new();
            wanted.iter().for_each(|(name, bytes)| append(&mut out, name, bytes).unwrap());
            end(&mut out).unwrap();
            out
        };
        assert_eq!(files(&made()), wanted);
        assert_eq!(made(), made());
    }

    #[test]
    fn names_and_sizes_that_do_not_fit_are_refused() {
        assert!(header(&"a".repeat(100), SIZES - 1).is_ok());
        for (name, size, expected) in [("a".repeat(101), 0, "1 to 100 bytes"), (String::new(), 0, "1 to 100"), ("a".into(), SIZES, "8 GiB")]
        {
            let e = header(&name, size).unwrap_err();
            assert!(e.kind() == ErrorKind::InvalidInput && e.to_string().contains(expected), "{e}");
        }
    }
}
