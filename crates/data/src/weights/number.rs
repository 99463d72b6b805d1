//! Number formats in files of weights.

/// Number format of a storage.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Kind {
    Half,
    Brain,
    Single,
    Double,
    /// Numbers of this many bytes that are not floating point.
    Other(usize),
}

impl Kind {
    pub(super) fn of_storage(global: &str) -> Option<Kind> {
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

    pub(super) fn bytes(self) -> usize {
        match self {
            Kind::Half | Kind::Brain => 2,
            Kind::Single => 4,
            Kind::Double => 8,
            Kind::Other(n) => n,
        }
    }

    /// Decodes little-endian numbers to f32.
    pub(super) fn values(self, data: &[u8]) -> Vec<f32> {
        match self {
            Kind::Half => data.as_chunks::<2>().0.iter().map(|b| half(u16::from_le_bytes(*b))).collect(),
            Kind::Brain => data.as_chunks::<2>().0.iter().map(|b| f32::from_bits((u16::from_le_bytes(*b) as u32) << 16)).collect(),
            Kind::Single => data.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect(),
            Kind::Double => data.as_chunks::<8>().0.iter().map(|b| f64::from_le_bytes(*b) as f32).collect(),
            Kind::Other(_) => Vec::new(),
        }
    }
}

/// Converts an IEEE 754 half float.
pub(super) fn half(bits: u16) -> f32 {
    let (sign, exponent, fraction) = (bits >> 15, (bits >> 10 & 31) as i32, (bits & 1023) as f32);
    let magnitude = match exponent {
        0 => fraction * 2f32.powi(-24),
        31 if fraction == 0.0 => f32::INFINITY,
        31 => f32::NAN,
        e => (1.0 + fraction / 1024.0) * 2f32.powi(e - 15),
    };
    if sign == 1 { -magnitude } else { magnitude }
}
