//! `config.toml` of a run whose application is not known yet.

use super::config::{self, Configuration};
use crate::error::Result;
use diorama_data::{DataError, error};
use std::path::{Path, PathBuf};

/// File of a run's configuration.
pub const NAME: &str = "config.toml";
const LIMIT: u64 = 1 << 30;

/// Application of a run, and its configuration, which only the application understands.
#[derive(Clone, Debug, PartialEq)]
pub struct RunDescription {
    /// The file.
    pub file: PathBuf,
    /// Name of the application; of runs from before there were several, the first one.
    pub application: String,
    table: toml::Table,
    text: String,
}

impl RunDescription {
    /// Reads the description of the run in a folder.
    ///
    /// # Errors
    /// When the folder holds no run, or the file is no TOML.
    pub fn read(run: &Path) -> Result<RunDescription> {
        let file = run.join(NAME);
        if !file.exists() {
            return Err(DataError::input(run, "is not a run folder: it holds no config.toml; give the --out of a training run").into());
        }
        let bytes = error::read(&file, LIMIT)?;
        let text = String::from_utf8(bytes).map_err(|_| DataError::input(&file, "is not UTF-8 text"))?;
        let table: toml::Table = toml::from_str(&text).map_err(|e: toml::de::Error| DataError::input(&file, e.message()))?;
        let application = config::application(&table).map_err(|e| DataError::input(&file, e))?;
        Ok(RunDescription { file, application, table, text })
    }

    /// The configuration, as the application `C` understands it.
    ///
    /// # Errors
    /// When the run is of another application, or a key or a value is wrong.
    pub fn config<C: Configuration>(&self) -> Result<C> {
        let config: C = config::from_toml(&self.text).map_err(|e| DataError::input(&self.file, e))?;
        config.check()?;
        Ok(config)
    }

    /// The data set that the run was trained on, where it was then; empty where there was none.
    pub fn data_set(&self) -> PathBuf {
        self.table.get("data").and_then(|d| d.get("path")).and_then(toml::Value::as_str).map(PathBuf::from).unwrap_or_default()
    }
}
