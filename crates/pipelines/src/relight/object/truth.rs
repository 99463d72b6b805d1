//! What is exact of a generated object, in `truth/` beside its photographs: model, lights, base color, and the held-out views under a light
//! that no photograph of training has.

use crate::error::Result;
use diorama_data::{DataError, atomic, error};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

const NAME: &str = "object.json";
const LIMIT: u64 = 1 << 24;

/// Names of the files in `truth/`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ObjectTruth {
    pub model: String,
    /// The light of the photographs, and the unseen one, exposed as the photographs are.
    pub light: String,
    pub unseen: String,
    pub views: Vec<ViewTruth>,
}

/// A held-out view.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ViewTruth {
    /// Name of the photograph, without extension.
    pub photograph: String,
    /// Under the unseen light.
    pub unseen: String,
    /// Linear base color.
    pub base_color: String,
}

impl ObjectTruth {
    /// A file of the truth of a data set.
    pub fn file(data: &Path, name: &str) -> PathBuf {
        data.join("truth").join(name)
    }

    /// The truth of a data set, if it has one.
    ///
    /// # Errors
    /// When the file is damaged.
    pub fn read(data: &Path) -> Result<Option<ObjectTruth>> {
        let path = ObjectTruth::file(data, NAME);
        if !path.exists() {
            return Ok(None);
        }
        let bytes = error::read(&path, LIMIT)?;
        Ok(Some(serde_json::from_slice(&bytes).map_err(|e| DataError::input(&path, format!("{e}; generate the photographs again")))?))
    }

    /// # Errors
    /// When the file cannot be written.
    pub fn save(&self, data: &Path) -> Result<()> {
        Ok(atomic::write(&ObjectTruth::file(data, NAME), &serde_json::to_vec_pretty(self).expect("plain values"))?)
    }
}
