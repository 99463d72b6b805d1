//! Light as text: 9 rows of red, green and blue, the coefficients of [`ShLight`].
//!
//! Rows are in the order 1, y, z, x, xy, yz, 3z² − 1, xz, x² − y² of the orthonormal real spherical harmonics
//! ([`diorama_geom::sh_light::basis`]), with +z up. Their product with the basis of a normal is the linear radiance that a white diffuse
//! surface reflects: the projection of the radiance times 1, 2/3 and 1/4 in bands 0, 1 and 2. Lines that begin with `#` are comments. A line
//! `sun x y z r g b` adds a sun, which the coefficients then lack: its direction, and the irradiance of a surface that faces it.

use crate::atomic;
use crate::error::{self, DataError, Result};
use diorama_geom::glam::DVec3;
use diorama_geom::sh_light::ShLight;
use std::path::Path;

/// Largest file that is read, in bytes.
const LIMIT: u64 = 1 << 20;

/// Coefficients, and a sun apart: its direction of length 1, and the irradiance of a surface that faces it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LightText {
    pub light: ShLight,
    pub sun: Option<(DVec3, [f64; 3])>,
}

/// Reads coefficients, and a sun where there is one.
///
/// # Errors
/// If there are not 9 rows of 3 finite numbers; row and column are named, counted from 1. If a sun has no direction or negative light.
pub fn read(path: &Path) -> Result<LightText> {
    let bytes = error::read(path, LIMIT)?;
    let wrong = |message: String| DataError::input(path, format!("{message}; give 9 rows of 3 numbers: red, green, blue"));
    let text = std::str::from_utf8(&bytes).map_err(|_| wrong("not text".into()))?;
    let lines = text.trim_start_matches('\u{feff}').lines().map(str::trim).filter(|l| !l.is_empty() && !l.starts_with('#'));
    let (suns, rows): (Vec<&str>, Vec<&str>) = lines.partition(|l| l.starts_with("sun"));
    let sun = match suns[..] {
        [] => None,
        [line] => Some(
            parsed_sun(line).ok_or_else(|| DataError::input(path, "sun: give `sun x y z r g b`, a direction above or below and light"))?,
        ),
        _ => return Err(DataError::input(path, format!("sun: there are {} lines; give one", suns.len()))),
    };
    let mut light = ShLight::DARK;
    for (i, row) in rows.iter().enumerate() {
        if i == 9 {
            return Err(wrong(format!("row 10 is too many: there are {} rows", rows.len())));
        }
        let words: Vec<&str> = row.split(|c: char| c.is_whitespace() || c == ',').filter(|w| !w.is_empty()).collect();
        if words.len() != 3 {
            return Err(wrong(format!("row {} has {} columns, not 3", i + 1, words.len())));
        }
        for (k, word) in words.iter().enumerate() {
            let number = word.parse::<f64>().ok().filter(|v| v.is_finite());
            light.0[i][k] = number.ok_or_else(|| wrong(format!("row {}, column {}: {word:.40} is not a finite number", i + 1, k + 1)))?;
        }
    }
    if rows.len() < 9 {
        return Err(wrong(format!("row {} is missing: there are {} rows", rows.len() + 1, rows.len())));
    }
    Ok(LightText { light, sun })
}

fn parsed_sun(line: &str) -> Option<(DVec3, [f64; 3])> {
    let words = line.strip_prefix("sun")?.split(|c: char| c.is_whitespace() || c == ',').filter(|w| !w.is_empty());
    let numbers: Vec<f64> = words.map(|w| w.parse().ok().filter(|v: &f64| v.is_finite())).collect::<Option<_>>()?;
    let [x, y, z, r, g, b] = numbers.try_into().ok()?;
    let direction = DVec3::new(x, y, z).try_normalize()?;
    [r, g, b].iter().all(|v| *v >= 0.0).then_some((direction, [r, g, b]))
}

/// Writes coefficients and a sun atomically; they are read as the same numbers, but for the length of the direction.
pub fn save(path: &Path, light: &ShLight, sun: Option<&(DVec3, [f64; 3])>) -> Result<()> {
    let mut text = "# red green blue of 1, y, z, x, xy, yz, 3z^2-1, xz, x^2-y^2 (orthonormal, z up): radiance of a white diffuse surface\n"
        .to_string();
    light.0.iter().for_each(|[r, g, b]| text += &format!("{r} {g} {b}\n"));
    if let Some((d, [r, g, b])) = sun {
        text += &format!("sun {} {} {} {r} {g} {b}\n", d.x, d.y, d.z);
    }
    atomic::write(path, text.as_bytes())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Result<LightText> {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("light.txt");
        std::fs::write(&path, text).unwrap();
        read(&path)
    }

    #[test]
    fn light_round_trips() {
        let light = ShLight(std::array::from_fn(|i| std::array::from_fn(|k| ((3 * i + k) as f64).sin() * 10f64.powi(i as i32 - 4))));
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("light.txt");
        for sun in [None, Some((DVec3::new(0.6, 0.0, 0.8), [3.0, 2.5, 0.1]))] {
            save(&path, &light, sun.as_ref()).unwrap();
            assert_eq!(read(&path).unwrap(), LightText { light, sun });
        }
    }

    #[test]
    fn commas_comments_and_blank_lines_are_accepted() {
        let light = parse(&format!("# sky\n1, 2, 3\n\n{}", "0 0 0\r\n".repeat(8))).unwrap();
        assert_eq!((light.light.0[0], light.sun), ([1.0, 2.0, 3.0], None));
    }

    #[test]
    fn errors_name_row_and_column() {
        let rows = |n: usize| "1 2 3\n".repeat(n);
        for (text, want) in [
            (rows(8), "row 9 is missing: there are 8 rows"),
            (rows(10), "row 10 is too many: there are 10 rows"),
            (rows(4) + "1 2\n" + &rows(4), "row 5 has 2 columns, not 3"),
            (rows(2) + "1 x 3\n" + &rows(6), "row 3, column 2: x is not a finite number"),
            (rows(2) + "1 2 NaN\n" + &rows(6), "row 3, column 3: NaN is not a finite number"),
            (rows(9) + "sun 0 0 0 1 1 1\n", "sun x y z r g b"),
            (rows(9) + "sun 0 0 1 1 -1 1\n", "sun x y z r g b"),
            (rows(9) + "sun 0 0 1 1 1 1\nsun 0 0 1 1 1 1\n", "there are 2 lines"),
        ] {
            let e = parse(&text).unwrap_err().to_string();
            assert!(e.contains(want) && e.contains("light.txt"), "{e}");
        }
    }
}
