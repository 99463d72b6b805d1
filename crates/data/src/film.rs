//! Videos, in the format of their file extension.

use crate::error::{DataError, Result};
use crate::gif::Gif;
use crate::mp4::Video;
use diorama_geom::ImageU8;
use std::path::Path;

/// Video formats.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FilmFormat {
    /// H.264.
    Mp4,
    Gif,
}

impl FilmFormat {
    /// The format for a file name.
    ///
    /// # Errors
    /// If the extension is not one of these formats.
    pub fn of(path: &Path) -> Result<FilmFormat> {
        let extension = path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase());
        match extension.as_deref() {
            Some("mp4") => Ok(FilmFormat::Mp4),
            Some("gif") => Ok(FilmFormat::Gif),
            Some(other) => Err(DataError::input(path, format!("videos are written as .mp4 or .gif, not as .{other}; choose one of them"))),
            None => Err(DataError::input(path, "names no format; add the extension .mp4 or .gif")),
        }
    }
}

/// A video being written; no file appears before [`Film::finish`].
pub enum Film {
    Mp4(Box<Video>),
    Gif(Gif),
}

impl Film {
    /// Starts a video with frames of one size.
    ///
    /// # Errors
    /// If the format is unknown or does not support the size or frame rate, or if the file's folder does not exist.
    pub fn create(path: &Path, width: usize, height: usize, fps: u32) -> Result<Film> {
        if let Some(folder) = path.parent().filter(|p| !p.as_os_str().is_empty() && !p.is_dir()) {
            return Err(DataError::input(folder, "is not a folder; create it or choose another --video"));
        }
        match FilmFormat::of(path)? {
            FilmFormat::Mp4 => Video::create(path, width, height, fps).map(Box::new).map(Film::Mp4),
            FilmFormat::Gif => Gif::create(path, width, height, fps).map(Film::Gif),
        }
    }

    /// Adds a frame `[H, W, 3]`.
    ///
    /// # Errors
    /// If the encoder fails.
    pub fn push(&mut self, frame: &ImageU8) -> Result<()> {
        match self {
            Film::Mp4(f) => f.push(frame),
            Film::Gif(f) => f.push(frame),
        }
    }

    /// Writes the file with all frames added so far.
    ///
    /// # Errors
    /// If there are none, or the file cannot be written.
    pub fn finish(self) -> Result<()> {
        match self {
            Film::Mp4(f) => f.finish(),
            Film::Gif(f) => f.finish(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_say_the_format_and_unknown_ones_are_refused() {
        let dir = tempfile::tempdir().unwrap();
        let frame = ImageU8 { width: 32, height: 16, channels: 3, data: vec![90; 32 * 16 * 3] };
        for (name, head) in [("a.mp4", &b"\0\0\0\x18ftyp"[..]), ("b.GIF", b"GIF89a")] {
            let file = dir.path().join(name);
            let mut film = Film::create(&file, 32, 16, 10).unwrap();
            film.push(&frame).unwrap();
            film.finish().unwrap();
            assert!(std::fs::read(&file).unwrap().starts_with(head), "{name}");
        }
        for (name, why) in [("a.webm", ".webm"), ("a", "no format"), ("x/a.mp4", "is not a folder")] {
            let e = Film::create(&dir.path().join(name), 32, 16, 10).err().unwrap();
            assert!(e.is_input() && e.to_string().contains(why), "{e}");
        }
    }
}
