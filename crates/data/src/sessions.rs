//! Sessions: photographs of one session were taken in the same light.

use crate::error::{self, DataError, Result};
use std::collections::HashMap;
use std::path::{Path, PathBuf};

/// How photographs are divided into sessions.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum SessionRule {
    /// A new session begins after a pause of more than 30 minutes in the times of the EXIF data.
    Exif,
    /// By what comes before the number at the end of the file name.
    Names,
    /// By the folder of the photograph.
    Folders,
    /// Each photograph is one, as where many people photographed a place.
    Each,
    /// By lines `PHOTOGRAPH SESSION` of a text file.
    File(PathBuf),
}

impl std::str::FromStr for SessionRule {
    type Err = String;

    fn from_str(s: &str) -> std::result::Result<SessionRule, String> {
        match s {
            "exif" => Ok(SessionRule::Exif),
            "names" => Ok(SessionRule::Names),
            "folders" => Ok(SessionRule::Folders),
            "each" => Ok(SessionRule::Each),
            file if Path::new(file).is_file() => Ok(SessionRule::File(file.into())),
            _ => Err(format!("sessions {s:?}: expected exif, names, folders, each, or a file with lines PHOTOGRAPH SESSION")),
        }
    }
}

/// Seconds of a pause after which a new session begins.
const PAUSE: i64 = 30 * 60;
/// Largest list that is read, in bytes.
const LIMIT: u64 = 16 << 20;

/// The session of each photograph, numbered from 0 in the order of their names or times.
///
/// # Errors
/// If a photograph has no time, or is not in the list.
pub fn assign(rule: &SessionRule, photos: &[PathBuf]) -> Result<Vec<u32>> {
    let by = |name: &dyn Fn(&Path) -> String| numbered(&photos.iter().map(|p| name(p)).collect::<Vec<_>>());
    match rule {
        SessionRule::Each => Ok((0..photos.len() as u32).collect()),
        SessionRule::Names => Ok(by(&|p| session_name(&stem(p)))),
        SessionRule::Folders => Ok(by(&|p| p.parent().map_or(String::new(), |p| p.to_string_lossy().into_owned()))),
        SessionRule::Exif => {
            let time = |p: &PathBuf| {
                let cure = "give --sessions names, folders, each, or a file with lines PHOTOGRAPH SESSION";
                taken_at(p).ok_or_else(|| DataError::input(p, format!("has no time in its EXIF data; {cure}")))
            };
            Ok(by_pauses(&photos.iter().map(time).collect::<Result<Vec<i64>>>()?))
        }
        SessionRule::File(file) => {
            let listed = parse_list(&error::read(file, LIMIT)?, file)?;
            let of = |p: &PathBuf| {
                let name = p.file_name().unwrap_or_default().to_string_lossy().into_owned();
                let found = listed.get(&name).or_else(|| listed.get(&stem(p)));
                found.cloned().ok_or_else(|| DataError::input(file, format!("has no line for {name}; add one: {name} SESSION")))
            };
            Ok(numbered(&photos.iter().map(of).collect::<Result<Vec<String>>>()?))
        }
    }
}

fn stem(p: &Path) -> String {
    p.file_stem().unwrap_or_default().to_string_lossy().into_owned()
}

/// What comes before the number at the end, without separators: `01-08_07_30_IMG_6715` → `01-08_07_30_IMG`.
fn session_name(stem: &str) -> String {
    let front = stem.trim_end_matches(|c: char| c.is_ascii_digit());
    front.trim_end_matches(['_', '-', ' ', '.']).to_string()
}

/// Numbers of names in alphabetical order.
fn numbered(names: &[String]) -> Vec<u32> {
    let mut all: Vec<&String> = names.iter().collect();
    all.sort();
    all.dedup();
    names.iter().map(|n| all.binary_search(&n).expect("listed") as u32).collect()
}

/// Sessions of times in seconds.
fn by_pauses(times: &[i64]) -> Vec<u32> {
    let mut order: Vec<usize> = (0..times.len()).collect();
    order.sort_by_key(|i| times[*i]);
    let (mut out, mut session) = (vec![0; times.len()], 0);
    for pair in order.windows(2) {
        session += (times[pair[1]] - times[pair[0]] > PAUSE) as u32;
        out[pair[1]] = session;
    }
    out
}

/// Seconds since the year 0 at which a photograph was taken, from its EXIF data.
fn taken_at(photo: &Path) -> Option<i64> {
    let mut file = std::io::BufReader::new(std::fs::File::open(photo).ok()?);
    let exif = exif::Reader::new().read_from_container(&mut file).ok()?;
    let field = exif.get_field(exif::Tag::DateTimeOriginal, exif::In::PRIMARY).or(exif.get_field(exif::Tag::DateTime, exif::In::PRIMARY))?;
    let exif::Value::Ascii(texts) = &field.value else { return None };
    let t = exif::DateTime::from_ascii(texts.first()?).ok()?;
    let days = days_of(t.year as i64, t.month as i64, t.day as i64);
    Some(((days * 24 + t.hour as i64) * 60 + t.minute as i64) * 60 + t.second as i64)
}

/// Days of the Gregorian calendar since 1 March of the year 0.
fn days_of(year: i64, month: i64, day: i64) -> i64 {
    let (y, m) = if month > 2 { (year, month - 3) } else { (year - 1, month + 9) };
    365 * y + y.div_euclid(4) - y.div_euclid(100) + y.div_euclid(400) + (153 * m + 2) / 5 + day - 1
}

/// Parses lines `PHOTOGRAPH SESSION`; the session is the last word. Lines that begin with `#` are comments.
///
/// # Errors
/// If a line has one word; `file` and the line are named.
pub fn parse_list(bytes: &[u8], file: &Path) -> Result<HashMap<String, String>> {
    let text = String::from_utf8_lossy(bytes);
    let mut out = HashMap::new();
    for (i, line) in text.lines().enumerate() {
        let line = line.trim_start_matches('\u{feff}').trim();
        if line.is_empty() || line.starts_with('#') {
            continue;
        }
        let (name, session) = line
            .rsplit_once(|c: char| c.is_whitespace() || c == ',')
            .ok_or_else(|| DataError::input(file, format!("line {}: expected PHOTOGRAPH SESSION, found {line:.60}", i + 1)))?;
        out.insert(name.trim_end_matches(|c: char| c.is_whitespace() || c == ',').to_string(), session.to_string());
    }
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pauses_of_more_than_half_an_hour_divide() {
        let minutes = |m: &[i64]| m.iter().map(|m| m * 60).collect::<Vec<_>>();
        assert_eq!(by_pauses(&minutes(&[0, 10, 100, 40, 131])), [0, 0, 1, 0, 2]);
        assert_eq!(by_pauses(&minutes(&[300, 0, 5])), [1, 0, 0]);
        assert!(by_pauses(&[]).is_empty());
        // The turn of a leap year's February, and of a year.
        assert_eq!(days_of(2024, 3, 1) - days_of(2024, 2, 28), 2);
        assert_eq!(days_of(2023, 3, 1) - days_of(2023, 2, 28), 1);
        assert_eq!(days_of(2024, 1, 1) - days_of(2023, 12, 31), 1);
    }

    #[test]
    fn names_and_folders_tell_sessions() {
        let photos = |names: &[&str]| names.iter().map(PathBuf::from).collect::<Vec<_>>();
        let named = photos(&["x/01-08_07_30_IMG_6715.jpg", "x/01-08_07_30_IMG_6716.jpg", "x/01-08_16_00_IMG_1.jpg"]);
        assert_eq!(assign(&SessionRule::Names, &named).unwrap(), [0, 0, 1]);
        let placed = photos(&["noon/a.jpg", "dawn/a.jpg", "noon/b.jpg"]);
        assert_eq!(assign(&SessionRule::Folders, &placed).unwrap(), [1, 0, 1]);
        assert_eq!(assign(&SessionRule::Each, &placed).unwrap(), [0, 1, 2]);
    }

    #[test]
    fn lists_name_photographs_and_errors_name_lines() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("sessions.txt");
        std::fs::write(&file, "# light of each\na.jpg  noon\nb, dawn\r\nc d.jpg noon\n").unwrap();
        let rule: SessionRule = file.to_str().unwrap().parse().unwrap();
        let photos: Vec<PathBuf> = ["p/a.jpg", "p/b.jpg", "p/c d.jpg"].map(PathBuf::from).into();
        assert_eq!(assign(&rule, &photos).unwrap(), [1, 0, 1]);
        let e = assign(&rule, &["p/e.jpg".into()]).unwrap_err().to_string();
        assert!(e.contains("no line for e.jpg") && e.contains("sessions.txt"), "{e}");
        let e = parse_list(b"a noon\nb\n", &file).unwrap_err().to_string();
        assert!(e.contains("line 2"), "{e}");
        assert!("no_such_file".parse::<SessionRule>().unwrap_err().contains("exif"));
        let e = assign(&SessionRule::Exif, &[file]).unwrap_err().to_string();
        assert!(e.contains("no time") && e.contains("--sessions"), "{e}");
    }
}
