//! Errors that name the file, the field and the remedy in one line.

use std::path::{Path, PathBuf};
/// Result of a function of this crate.
pub type Result<T> = std::result::Result<T, DataError>;

/// Error of reading, writing, or running another program.
#[derive(Debug, thiserror::Error)]
pub enum DataError {
    /// The file's content or the request is wrong; the user can correct it.
    #[error("{}: {message}", path.display())]
    Input { path: PathBuf, message: String },
    /// The system refused: disk full, permission, missing folder.
    #[error("{}: cannot {doing}: {source}", path.display())]
    Io { path: PathBuf, doing: &'static str, source: std::io::Error },
    /// Another program failed.
    #[error("{}: {message}", program.display())]
    Failed { program: PathBuf, message: String },
}

impl DataError {
    /// An error in the content of `path` or in the request.
    pub fn input(path: impl Into<PathBuf>, message: impl Into<String>) -> Self {
        DataError::Input { path: path.into(), message: message.into() }
    }

    /// A failure of another program or of an encoder; `program` is the program or the file that it was to write.
    pub fn failed(program: impl Into<PathBuf>, message: impl Into<String>) -> Self {
        DataError::Failed { program: program.into(), message: message.into() }
    }

    /// For `map_err`: an I/O error while `doing` something with `path`.
    pub fn io(path: &Path, doing: &'static str) -> impl FnOnce(std::io::Error) -> DataError {
        let path = path.to_path_buf();
        move |source| DataError::Io { path, doing, source }
    }

    /// Whether the input is at fault (exit code 2) rather than the work (exit code 1).
    pub fn is_input(&self) -> bool {
        match self {
            DataError::Input { .. } => true,
            DataError::Failed { .. } => false,
            DataError::Io { doing, source, .. } => doing.starts_with("read") && source.kind() == std::io::ErrorKind::NotFound,
        }
    }
}

/// Reads a whole file, refusing more than `limit` bytes.
pub fn read(path: &Path, limit: u64) -> Result<Vec<u8>> {
    let size = std::fs::metadata(path).map_err(DataError::io(path, "read"))?.len();
    if size > limit {
        return Err(DataError::input(path, format!("{size} bytes, more than the limit of {limit} for such a file")));
    }
    std::fs::read(path).map_err(DataError::io(path, "read"))
}
