//! Results of a run, `summary.json`; the application chooses the figures.

use crate::error::Result;
use diorama_data::{DataError, atomic, error};
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::Value;
use std::path::Path;

/// File of the summary.
pub const NAME: &str = "summary.json";
/// Figure of which the largest of all parts of a run stays.
const PEAK: &str = "peak_memory_bytes";
const LIMIT: u64 = 1 << 30;

/// Writes the results of the run so far; the peak of memory is that of all of its parts.
///
/// # Errors
/// When the file cannot be written.
pub fn write(run: &Path, summary: &impl Serialize) -> Result<()> {
    let mut figures = serde_json::to_value(summary).expect("a summary is JSON");
    // A summary that is damaged is replaced.
    let before = read::<Value>(run).ok().flatten().and_then(|s| s.get(PEAK).and_then(Value::as_u64));
    if let (Some(before), Some(now)) = (before, figures.get_mut(PEAK)) {
        *now = before.max(now.as_u64().unwrap_or(0)).into();
    }
    let json = serde_json::to_vec_pretty(&figures).expect("a summary is JSON");
    Ok(atomic::write(&run.join(NAME), &json)?)
}

/// Results of a run; none before its end.
///
/// # Errors
/// When the file is malformed.
pub fn read<S: DeserializeOwned>(run: &Path) -> Result<Option<S>> {
    let file = run.join(NAME);
    if !file.exists() {
        return Ok(None);
    }
    let wrong = |e: serde_json::Error| DataError::input(&file, format!("is damaged: {e}; remove it"));
    Ok(Some(serde_json::from_slice(&error::read(&file, LIMIT)?).map_err(wrong)?))
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn the_largest_peak_stays_and_a_damaged_summary_is_replaced() {
        let dir = tempfile::tempdir().unwrap();
        let peak = |summary: Value| {
            write(dir.path(), &summary).unwrap();
            read::<Value>(dir.path()).unwrap().unwrap()[PEAK].as_u64()
        };
        assert_eq!(read::<Value>(dir.path()).unwrap(), None);
        assert_eq!(peak(json!({ "steps": 1, PEAK: 30 })), Some(30));
        assert_eq!(peak(json!({ "steps": 2, PEAK: 20 })), Some(30));
        assert_eq!(peak(json!({ "steps": 3, PEAK: null })), Some(30));
        assert_eq!(peak(json!({ "steps": 3, PEAK: 40 })), Some(40));
        std::fs::write(dir.path().join(NAME), b"{").unwrap();
        assert!(read::<Value>(dir.path()).unwrap_err().to_string().contains("is damaged"));
        assert_eq!(peak(json!({ "steps": 4, PEAK: 5 })), Some(5));
    }
}
