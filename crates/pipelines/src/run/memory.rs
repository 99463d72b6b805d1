//! Memory that jobs may take.

use crate::error::{PipelineError, Result};
use diorama_data::memory;

/// Bytes in words.
pub fn size(bytes: u64) -> String {
    let mib = bytes as f64 / (1u64 << 20) as f64;
    if mib < 1024.0 { format!("{mib:.0} MiB") } else { format!("{:.1} GiB", mib / 1024.0) }
}

/// The variable that limits what jobs may take.
const LIMIT: &str = "DIORAMA_MEMORY";

/// Bytes that jobs may take: what the machine has available, or less where `DIORAMA_MEMORY` says so.
///
/// # Errors
/// When the variable holds no size.
pub fn available() -> Result<Option<u64>> {
    let limit = match std::env::var_os(LIMIT) {
        None => None,
        Some(text) => Some(bytes(&text.to_string_lossy()).map_err(|e| PipelineError::Usage(format!("{LIMIT}={e}")))?),
    };
    Ok(memory::of_machine().available.into_iter().chain(limit).min())
}

/// Bytes of a size in words.
fn bytes(text: &str) -> std::result::Result<u64, String> {
    let number = text.trim_end_matches(|c: char| c.is_ascii_alphabetic());
    let unit = match &text[number.len()..] {
        "" => 1,
        "MiB" => 1 << 20,
        "GiB" => 1 << 30,
        _ => 0,
    };
    let value = number.trim().parse::<f64>().ok().filter(|v| v.is_finite() && *v > 0.0 && unit > 0);
    value.map(|v| (v * unit as f64) as u64).ok_or_else(|| format!("{text}: expected bytes, or a number of MiB or GiB, such as 8GiB"))
}

/// Refuses a job that takes more than there is.
///
/// # Errors
/// Names what takes it, how much, how much there is, and the cure.
pub fn require(what: &str, bytes: u64, cure: &str) -> Result<()> {
    match available()? {
        Some(has) if bytes > has => {
            Err(PipelineError::Memory(format!("out of memory: {what} would take about {}, {} are free; {cure}", size(bytes), size(has))))
        }
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_have_units() {
        for (text, want) in [("1000", 1000), ("2MiB", 2 << 20), ("1.5 GiB", 3 << 29)] {
            assert_eq!(bytes(text), Ok(want), "{text}");
        }
        for text in ["", "GiB", "8 GB", "-1", "0", "nan", "eight"] {
            assert!(bytes(text).unwrap_err().starts_with(text), "{text}");
        }
    }
}
