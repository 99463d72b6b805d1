//! Hashes that tell files and names apart (FNV-1a, Fowler, Noll and Vo).

/// Hash of bytes.
pub fn hash(bytes: impl IntoIterator<Item = u8>) -> u64 {
    with(0xcbf2_9ce4_8422_2325, bytes)
}

/// The hash of what came before and more bytes.
pub fn with(before: u64, bytes: impl IntoIterator<Item = u8>) -> u64 {
    bytes.into_iter().fold(before, |h, b| (h ^ b as u64).wrapping_mul(0x0100_0000_01b3))
}
