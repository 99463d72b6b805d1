//! List of the applications, and the application of a run. Verbs that accept any run (`eval`, `render`, `export`, `view`, `info`, `compare`,
//! `train --resume`) match on [`Application::of_run`]: a new application does not compile until each of them says what it does with it.

use crate::error::{PipelineError, Result};
use crate::object::{config::Config, run_folder};
use crate::relight::{object as relit, outdoor};
use crate::run::RunDescription;
use crate::run::config::Configuration;
use crate::text::{detectors, field as writing};
use diorama_data::DataError;
use serde_json::Value;
use std::path::Path;

/// Every application of the program.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Application {
    /// Photographs to a radiance field, novel views and a mesh.
    Object,
    /// Photographs in several lights to albedo, normals, shadow and light.
    Relight,
    /// Photographs of an object to a mesh with materials, and its light.
    RelightObject,
    /// Photographs of writing to a field with classes.
    Text,
    /// Labelled images to a detector of writing.
    Detector,
}

impl Application {
    /// All of them, in the order in which they are listed to users.
    pub const ALL: [Application; 5] =
        [Application::Object, Application::Relight, Application::RelightObject, Application::Text, Application::Detector];

    /// The name that `config.toml` gives.
    pub fn name(self) -> &'static str {
        match self {
            Application::Object => Config::APPLICATION,
            Application::Relight => outdoor::config::Config::APPLICATION,
            Application::RelightObject => relit::config::Config::APPLICATION,
            Application::Text => writing::config::Config::APPLICATION,
            Application::Detector => detectors::config::Config::APPLICATION,
        }
    }

    /// The application that the run in a folder is of.
    ///
    /// # Errors
    /// When there is no run, or its application is unknown.
    pub fn of_run(run: &Path) -> Result<Application> {
        let described = RunDescription::read(run)?;
        let found = Application::ALL.into_iter().find(|a| a.name() == described.application);
        found.ok_or_else(|| {
            let known = Application::ALL.map(Application::name).join(", ");
            let unknown =
                format!("application: {:?} is unknown; this program has {known}, a newer one may have more", described.application);
            DataError::input(&described.file, unknown).into()
        })
    }

    /// The error of a command that does not take runs of this application; `instead` is what does.
    pub fn refuse(self, run: &Path, instead: &str) -> PipelineError {
        DataError::input(run, format!("is a run of {}; use {instead}", self.name())).into()
    }

    /// Description of a run of this application for `diorama info`.
    ///
    /// # Errors
    /// When the run is damaged.
    pub fn describe(self, run: &Path) -> Result<Value> {
        match self {
            Application::Object => run_folder::describe(run),
            Application::Relight => outdoor::recipe::describe(run),
            Application::RelightObject => relit::recipe::describe(run),
            Application::Text => writing::recipe::describe(run),
            Application::Detector => detectors::recipe::describe(run),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::object::config::Method;

    #[test]
    fn runs_name_their_application_and_those_of_before_are_object() {
        let dir = tempfile::tempdir().unwrap();
        let of = |text: &str| {
            std::fs::write(dir.path().join("config.toml"), text).unwrap();
            Application::of_run(dir.path())
        };
        let text = Config::new(Method::Ngp, "data".into()).to_toml();
        let (name, before) = text.split_once('\n').unwrap();
        assert_eq!(name, "application = \"object\"");
        assert_eq!(of(&text).unwrap(), Application::Object);
        assert_eq!(of(before).unwrap(), Application::Object, "a run from before there were applications");
        let unknown = of(&text.replace("\"object\"", "\"sculpture\"")).unwrap_err();
        assert!(unknown.is_input());
        let unknown = unknown.to_string();
        assert!(["config.toml", "sculpture", "object"].iter().all(|w| unknown.contains(w)) && !unknown.contains('\n'), "{unknown}");
        assert!(of("application = 3").unwrap_err().to_string().contains("name in quotes"));
        assert!(of("[").unwrap_err().is_input());
        let none = Application::of_run(&dir.path().join("none")).unwrap_err().to_string();
        assert!(none.contains("not a run folder"), "{none}");
    }

    #[test]
    fn a_run_of_another_application_is_not_read_as_an_object() {
        let dir = tempfile::tempdir().unwrap();
        let text = Config::new(Method::Ngp, "data".into()).to_toml();
        std::fs::write(dir.path().join("config.toml"), text.replace("\"object\"", "\"head\"")).unwrap();
        let e = run_folder::read_config(dir.path()).unwrap_err().to_string();
        assert!(e.contains("head") && e.contains("object"), "{e}");
    }
}
