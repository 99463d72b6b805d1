//! Light as text: 9 rows of red, green and blue, the coefficients of [`ShLight`].
//!
//! Rows are in the order 1, y, z, x, xy, yz, 3z² − 1, xz, x² − y² of the orthonormal real spherical harmonics
//! ([`diorama_geom::sh_light::basis`]), with +z up. Their product with the basis of a normal is the linear radiance that a white diffuse
//! surface reflects: the projection of the radiance times 1, 2/3 and 1/4 in bands 0, 1 and 2. Lines that begin with `#` are comments.

use crate::atomic;
use crate::error::{self, DataError, Result};
use diorama_geom::sh_light::ShLight;
use std::path::Path;

/// Largest file that is read, in bytes.
const LIMIT: u64 = 1 << 20;

/// Reads coefficients.
///
/// # Errors
/// If there are not 9 rows of 3 finite numbers; row and column are named, counted from 1.
pub fn read(path: &Path) -> Result<ShLight> {
    let bytes = error::read(path, LIMIT)?;
    let wrong = |message: String| DataError::input(path, format!("{message}; give 9 rows of 3 numbers: red, green, blue"));
    let text = std::str::from_utf8(&bytes).map_err(|_| wrong("not text".into()))?;
    let rows: Vec<&str> =
        text.trim_start_matches('\u{feff}').lines().map(str::trim).filter(|l| !l.is_empty() && !l.starts_with('#')).collect();
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
    Ok(light)
}

/// Writes coefficients atomically; they are read as the same numbers.
pub fn save(path: &Path, light: &ShLight) -> Result<()> {
    let mut text = "# red green blue of 1, y, z, x, xy, yz, 3z^2-1, xz, x^2-y^2 (orthonormal, z up): radiance of a white diffuse surface\n"
        .to_string();
    light.0.iter().for_each(|[r, g, b]| text += &format!("{r} {g} {b}\n"));
    atomic::write(path, text.as_bytes())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Result<ShLight> {
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
        save(&path, &light).unwrap();
        assert_eq!(read(&path).unwrap(), light);
    }

    #[test]
    fn commas_comments_and_blank_lines_are_accepted() {
        let light = parse(&format!("# sky\n1, 2, 3\n\n{}", "0 0 0\r\n".repeat(8))).unwrap();
        assert_eq!(light.0[0], [1.0, 2.0, 3.0]);
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
        ] {
            let e = parse(&text).unwrap_err().to_string();
            assert!(e.contains(want) && e.contains("light.txt"), "{e}");
        }
    }
}
