//! Configurations of runs as TOML: keys by dotted path, overrides, the nearest key to an unknown one, reading and writing.
//!
//! An application's configuration is a struct that implements [`Configuration`]; its fields are its keys.

use crate::error::{PipelineError, Result};
use serde::de::{DeserializeOwned, Error as _};
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use std::path::PathBuf;

/// Key of the application's name in `config.toml`.
const APPLICATION: &str = "application";

/// The application of configurations that name none: they were written when there was only this one.
const FIRST_APPLICATION: &str = "object";

/// Everything that a run of one application depends on.
pub trait Configuration: Clone + Serialize + DeserializeOwned {
    /// The application's name, as `config.toml` gives it.
    const APPLICATION: &'static str;

    /// A configuration with every key that there is.
    fn template() -> Self;

    /// Path of the data set that the run is trained on, under the key `data.path`; none for applications without one.
    fn data_set(&mut self) -> Option<&mut PathBuf>;

    /// # Errors
    /// When values make no sense together or alone.
    fn check(&self) -> Result<()>;
}

/// A number, or `auto`: the application decides.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Auto {
    #[default]
    Auto,
    Is(f32),
}

impl Auto {
    /// The number, or `auto` in its place.
    pub fn or(self, auto: f32) -> f32 {
        match self {
            Auto::Auto => auto,
            Auto::Is(v) => v,
        }
    }
}

impl Serialize for Auto {
    fn serialize<S: Serializer>(&self, s: S) -> std::result::Result<S::Ok, S::Error> {
        match self {
            Auto::Auto => s.serialize_str("auto"),
            Auto::Is(v) => s.serialize_f32(*v),
        }
    }
}

impl<'de> Deserialize<'de> for Auto {
    fn deserialize<D: Deserializer<'de>>(d: D) -> std::result::Result<Auto, D::Error> {
        let value = toml::Value::deserialize(d)?;
        let number = match &value {
            toml::Value::String(s) if s == "auto" => return Ok(Auto::Auto),
            toml::Value::String(s) => s.parse().ok(),
            toml::Value::Integer(v) => Some(*v as f64),
            toml::Value::Float(v) => Some(*v),
            _ => None,
        };
        let number = number.filter(|v| v.is_finite() && *v >= 0.0);
        number.map(|v| Auto::Is(v as f32)).ok_or_else(|| D::Error::custom(format!("{value} is neither a number from 0 on nor \"auto\"")))
    }
}

/// Overrides one value, named by its path, for example `loss.distortion`.
///
/// # Errors
/// When the key does not exist (the nearest one is named) or the value has the wrong type.
pub fn set<C: Configuration>(config: &mut C, key: &str, value: &str) -> Result<()> {
    let mut table = table_of(config);
    let known = keys(&table, "");
    let mut at = &mut table;
    for part in key.split('.') {
        let exists = at.get(part).is_some();
        if !exists {
            return Err(PipelineError::Usage(unknown_key(key, &known)));
        }
        at = &mut at[part];
    }
    let parsed = match at {
        toml::Value::String(_) => Some(toml::Value::String(value.into())),
        toml::Value::Integer(_) => value.parse().ok().map(toml::Value::Integer),
        toml::Value::Float(_) if value == "auto" => Some(toml::Value::String(value.into())),
        toml::Value::Float(_) => value.parse().ok().filter(|v: &f64| v.is_finite()).map(toml::Value::Float),
        toml::Value::Boolean(_) => value.parse().ok().map(toml::Value::Boolean),
        _ => None,
    };
    let expected = match at {
        toml::Value::Integer(_) => "a whole number",
        toml::Value::Float(_) => "a number",
        _ => "true or false",
    };
    *at = parsed.ok_or_else(|| PipelineError::Usage(format!("{key}: {value:?} is not {expected}")))?;
    *config = table.try_into().map_err(|e: toml::de::Error| PipelineError::Usage(format!("{key} = {value:?}: {}", e.message())))?;
    config.check()
}

/// Sets the value of each `KEY=VALUE`, in order.
///
/// # Errors
/// As [`set`], and when there is no `=`.
pub fn set_all<C: Configuration>(config: &mut C, overrides: &[String]) -> Result<()> {
    overrides.iter().try_for_each(|text| {
        let (key, value) = key_and_value(text)?;
        set(config, key, value)
    })
}

/// The two sides of `KEY=VALUE`.
///
/// # Errors
/// When there is no `=`.
pub fn key_and_value(text: &str) -> Result<(&str, &str)> {
    let (key, value) = text.split_once('=').ok_or_else(|| PipelineError::Usage(format!("--set {text}: expected KEY=VALUE")))?;
    Ok((key.trim(), value.trim()))
}

/// Reads what [`to_toml`] wrote.
///
/// # Errors
/// When the text is no TOML, is of another application, or holds an unknown key (the nearest one is named) or a wrong value.
pub fn from_toml<C: Configuration>(text: &str) -> std::result::Result<C, String> {
    let mut table: toml::Table = toml::from_str(text).map_err(|e: toml::de::Error| e.message().to_string())?;
    let application = application(&table)?;
    if application != C::APPLICATION {
        return Err(format!("{APPLICATION}: {application:?}; expected a configuration of {}", C::APPLICATION));
    }
    table.remove(APPLICATION);
    let value = toml::Value::Table(table);
    let known = keys(&table_of(&C::template()), "");
    if let Some(bad) = keys(&value, "").into_iter().find(|k| !known.contains(k)) {
        return Err(unknown_key(&bad, &known));
    }
    value.try_into().map_err(|e: toml::de::Error| e.message().to_string())
}

/// The configuration as TOML, the application's name first.
pub fn to_toml<C: Configuration>(config: &C) -> String {
    let keys = toml::to_string(config).expect("a configuration is a table");
    format!("{APPLICATION} = {:?}\n{keys}", C::APPLICATION)
}

/// All keys with their values as text, in order.
pub fn values<C: Configuration>(config: &C) -> Vec<(String, String)> {
    let table = table_of(config);
    let of = |key: String| {
        let value = key.split('.').fold(&table, |at, part| &at[part]);
        let text = match value {
            toml::Value::String(s) => s.clone(),
            // As they were given, not as f64 has what f32 holds.
            toml::Value::Float(f) if *f as f32 as f64 == *f => (*f as f32).to_string(),
            v => v.to_string(),
        };
        (key, text)
    };
    keys(&table, "").into_iter().map(of).collect()
}

/// The application that a `config.toml` names.
///
/// # Errors
/// When the name is no text.
pub fn application(table: &toml::Table) -> std::result::Result<String, String> {
    match table.get(APPLICATION) {
        None => Ok(FIRST_APPLICATION.into()),
        Some(toml::Value::String(name)) => Ok(name.clone()),
        Some(other) => Err(format!("{APPLICATION}: {other} is not a name in quotes")),
    }
}

fn table_of<C: Configuration>(config: &C) -> toml::Value {
    toml::Value::try_from(config).expect("a configuration is a table")
}

/// Paths of all leaves.
fn keys(value: &toml::Value, prefix: &str) -> Vec<String> {
    match value {
        toml::Value::Table(t) => {
            t.iter().flat_map(|(k, v)| keys(v, &if prefix.is_empty() { k.clone() } else { format!("{prefix}.{k}") })).collect()
        }
        _ => vec![prefix.to_string()],
    }
}

fn unknown_key(key: &str, known: &[String]) -> String {
    format!("unknown configuration key {key}; did you mean {}?", nearest(key, known))
}

/// The known key that is most like another one, by its whole path or its last part; empty if none is known.
pub fn nearest<'a>(key: &str, known: &'a [String]) -> &'a str {
    let by = |k: &&String| distance(key, k).min(k.rsplit('.').next().map_or(99, |last| distance(key, last)));
    known.iter().min_by_key(by).map_or("", |k| k)
}

/// Levenshtein distance.
fn distance(a: &str, b: &str) -> usize {
    let b: Vec<char> = b.chars().collect();
    let mut row: Vec<usize> = (0..=b.len()).collect();
    for (i, x) in a.chars().enumerate() {
        let mut diagonal = row[0];
        row[0] = i + 1;
        for (j, y) in b.iter().enumerate() {
            let next = (diagonal + (x != *y) as usize).min(row[j] + 1).min(row[j + 1] + 1);
            diagonal = row[j + 1];
            row[j + 1] = next;
        }
    }
    row[b.len()]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A small configuration of an application that does not exist.
    #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(deny_unknown_fields)]
    struct Small {
        name: String,
        rate: f32,
        loss: Loss,
    }

    #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(deny_unknown_fields)]
    struct Loss {
        weight: Auto,
        steps: u64,
    }

    impl Configuration for Small {
        const APPLICATION: &'static str = "small";
        fn template() -> Self {
            Small { name: "a".into(), rate: 0.1, loss: Loss { weight: Auto::Auto, steps: 3 } }
        }
        fn data_set(&mut self) -> Option<&mut PathBuf> {
            None
        }
        fn check(&self) -> Result<()> {
            if self.rate > 0.0 { Ok(()) } else { Err(PipelineError::Usage("rate: above 0".into())) }
        }
    }

    #[test]
    fn keys_are_paths_and_unknown_ones_name_the_nearest() {
        let mut c = Small::template();
        set_all(&mut c, &["loss.steps = 7".into(), "loss.weight=0.5".into(), "name=b c".into()]).unwrap();
        assert_eq!(c, Small { name: "b c".into(), rate: 0.1, loss: Loss { weight: Auto::Is(0.5), steps: 7 } });
        let fault = |key: &str, value: &str| set(&mut c.clone(), key, value).unwrap_err().to_string();
        assert!(fault("loss.setps", "1").contains("did you mean loss.steps"));
        assert!(fault("weigth", "1").contains("did you mean loss.weight"));
        assert!(fault("loss.steps", "many").contains("a whole number"));
        assert!(fault("loss.weight", "-1").contains("neither"));
        assert_eq!(fault("rate", "-1"), "rate: above 0");
        assert!(set_all(&mut c, &["nonsense".into()]).unwrap_err().to_string().contains("KEY=VALUE"));
    }

    #[test]
    fn text_names_the_application_and_comes_back() {
        let c = Small::template();
        let text = to_toml(&c);
        assert!(text.starts_with("application = \"small\"\n"), "{text}");
        assert_eq!(from_toml::<Small>(&text), Ok(c));
        let other = from_toml::<Small>(&text.replace("\"small\"", "\"large\"")).unwrap_err();
        assert!(other.contains("large") && other.contains("small"), "{other}");
        assert!(from_toml::<Small>(&text.replace("\"small\"", "3")).unwrap_err().contains("not a name"));
        // Without a name it is a configuration of the first application.
        let unnamed = from_toml::<Small>(text.split_once('\n').unwrap().1).unwrap_err();
        assert!(unnamed.contains("object"), "{unnamed}");
        assert!(from_toml::<Small>(&text.replace("rate", "rat")).unwrap_err().contains("did you mean rate"));
    }
}
