//! JSON readers whose errors name the field.

use crate::error::{self, DataError, Result};
use serde_json::Value;
use std::path::Path;

/// Largest JSON file that is read, in bytes.
const LIMIT: u64 = 512 << 20;

/// A JSON object with its file and position, for messages.
#[derive(Clone, Copy)]
pub struct Object<'a> {
    pub path: &'a Path,
    pub place: &'a str,
    pub map: &'a serde_json::Map<String, Value>,
}

/// Parses a file that must hold one JSON object.
pub fn read(path: &Path) -> Result<serde_json::Map<String, Value>> {
    parse(&error::read(path, LIMIT)?, path)
}

/// Parses text that must hold one JSON object; `path` is named in errors.
pub fn parse(bytes: &[u8], path: &Path) -> Result<serde_json::Map<String, Value>> {
    let text = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes);
    match serde_json::from_slice(text) {
        Ok(Value::Object(map)) => Ok(map),
        Ok(_) => Err(DataError::input(path, "not a JSON object: expected { … }")),
        Err(e) if e.is_eof() => Err(DataError::input(path, format!("the JSON ends too early ({e}); copy the file again"))),
        Err(e) => Err(DataError::input(path, format!("not valid JSON: {e}"))),
    }
}

impl<'a> Object<'a> {
    fn wrong(&self, key: &str, what: &str) -> DataError {
        DataError::input(self.path, format!("{}{key}: {what}", self.place))
    }

    /// A finite number, if the key exists.
    pub fn number(&self, key: &str) -> Result<Option<f64>> {
        let Some(v) = self.map.get(key) else { return Ok(None) };
        let x = v.as_f64().ok_or_else(|| self.wrong(key, &format!("expected a number, found {v:.40}")))?;
        if !x.is_finite() || x.abs() > f32::MAX as f64 {
            return Err(self.wrong(key, &format!("{v} is not a finite 32-bit number")));
        }
        Ok(Some(x))
    }

    /// A positive number, if the key exists.
    pub fn positive(&self, key: &str) -> Result<Option<f64>> {
        match self.number(key)? {
            Some(x) if x <= 0.0 => Err(self.wrong(key, &format!("{x} must be greater than 0"))),
            other => Ok(other),
        }
    }

    /// Text, if the key exists.
    pub fn text(&self, key: &str) -> Result<Option<&'a str>> {
        match self.map.get(key) {
            None | Some(Value::Null) => Ok(None),
            Some(Value::String(s)) => Ok(Some(s)),
            Some(v) => Err(self.wrong(key, &format!("expected text, found {v:.40}"))),
        }
    }

    /// A boolean, if the key exists.
    pub fn flag(&self, key: &str) -> Result<Option<bool>> {
        match self.map.get(key) {
            None => Ok(None),
            Some(Value::Bool(b)) => Ok(Some(*b)),
            Some(v) => Err(self.wrong(key, &format!("expected true or false, found {v:.40}"))),
        }
    }

    /// A list, if the key exists.
    pub fn array(&self, key: &str) -> Result<Option<&'a Vec<Value>>> {
        match self.map.get(key) {
            None => Ok(None),
            Some(Value::Array(a)) => Ok(Some(a)),
            Some(v) => Err(self.wrong(key, &format!("expected a list, found {v:.40}"))),
        }
    }

    /// A list of exactly `N` numbers.
    pub fn numbers<const N: usize>(&self, key: &str) -> Result<Option<[f64; N]>> {
        let Some(a) = self.array(key)? else { return Ok(None) };
        if a.len() != N {
            return Err(self.wrong(key, &format!("expected {N} numbers, found {}", a.len())));
        }
        let mut out = [0.0; N];
        for (o, v) in out.iter_mut().zip(a) {
            *o = v.as_f64().filter(|x| x.is_finite()).ok_or_else(|| self.wrong(key, &format!("{v:.40} is not a number")))?;
        }
        Ok(Some(out))
    }

    /// A matrix of at least `rows` rows of 4, row-major, nested or flat.
    pub fn matrix(&self, key: &str, rows: usize) -> Result<Option<Vec<f64>>> {
        let Some(a) = self.array(key)? else { return Ok(None) };
        let flat: Vec<&Value> = a.iter().flat_map(|r| r.as_array().map_or(vec![r], |r| r.iter().collect())).collect();
        if flat.len() < rows * 4 {
            return Err(self.wrong(key, &format!("expected {rows} rows of 4 numbers, found {} numbers", flat.len())));
        }
        flat.iter()
            .map(|v| {
                v.as_f64()
                    .filter(|x| x.abs() <= f32::MAX as f64)
                    .ok_or_else(|| self.wrong(key, &format!("{v:.40} is not a finite 32-bit number; estimate this pose again")))
            })
            .collect::<Result<Vec<f64>>>()
            .map(Some)
    }
}
