//! A folder that one process at a time may fill. The system frees the lock when its holder ends, however it ends.

use crate::error::{DataError, Result};
use std::fs::File;
use std::path::Path;

/// Name of the file that is locked.
pub const NAME: &str = ".lock";

/// Locks `folder`, which must exist, for as long as the file is kept.
///
/// # Errors
/// When another process holds it.
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
