//! A lock that lets one process at a time write to a folder. The system releases the lock when its holder ends, even after a crash.

use crate::error::{DataError, Result};
use std::fs::File;
use std::path::Path;

/// Name of the lock file.
pub const NAME: &str = ".lock";

/// Locks `folder`, which must exist, as long as the returned file is open.
///
/// # Errors
/// If another process holds the lock.
pub fn take(folder: &Path) -> Result<File> {
    let name = folder.join(NAME);
    let lock = File::create(&name).map_err(DataError::io(&name, "create"))?;
    lock.try_lock().map_err(|_| DataError::input(folder, "is in use by another process; wait for it or choose another --out"))?;
    Ok(lock)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_at_a_time_and_what_a_dead_process_left_is_no_obstacle() {
        let dir = tempfile::tempdir().unwrap();
        std::fs::write(dir.path().join(NAME), b"left behind").unwrap();
        let first = take(dir.path()).unwrap();
        let e = take(dir.path()).unwrap_err();
        assert!(e.is_input() && e.to_string().contains("in use"), "{e}");
        drop(first);
        take(dir.path()).unwrap();
    }
}
