//! Fonts that writing is set in: those that the program brings along, installed ones, and files of the user's.

use crate::error::{PipelineError, Result};
use crate::text::fnv;
use cosmic_text::FontSystem;
use cosmic_text::fontdb::{Database, Stretch, Style, Weight};
use diorama_data::DataError;
use diorama_data::error::read;
use std::path::Path;
use unicode_script::UnicodeScript;

/// Fonts that the program brings along; `fonts/OFL.txt` has their license.
const SHIPPED: [&[u8]; 5] = [
    include_bytes!("../fonts/allerta_medium.otf"),
    include_bytes!("../fonts/Arapey-Regular.otf"),
    include_bytes!("../fonts/ComicNeue-Bold.otf"),
    include_bytes!("../fonts/Sora-SemiBold.otf"),
    include_bytes!("../fonts/YanoneKaffeesatz-Bold.otf"),
];
/// Characters that a font for Latin words has.
const LATIN: &str = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789&-.!";
/// Bytes of the OS/2 table by which fonts of pictures declare themselves: IBM's symbol class, PANOSE's pictorial kind.
const PICTURES: [(usize, u8); 2] = [(30, 12), (32, 5)];
/// Largest font file that is read.
const LARGEST: u64 = 1 << 27;

/// Loaded fonts, and what shapes text with them.
pub struct Fonts {
    pub(super) system: FontSystem,
    shipped: usize,
}

/// A font of a family.
#[derive(Clone, Debug, PartialEq)]
pub struct Face {
    pub family: String,
    pub(super) weight: Weight,
    pub(super) style: Style,
    pub(super) stretch: Stretch,
}

impl Face {
    /// Its family, and what sets it apart in it.
    pub fn name(&self) -> String {
        let style = if self.style == Style::Normal { "" } else { " slanted" };
        let stretch = if self.stretch == Stretch::Normal { String::new() } else { format!(" {:?}", self.stretch) };
        format!("{} {}{style}{stretch}", self.family, self.weight.0)
    }
}

impl Fonts {
    /// The fonts that the program brings along: the same writing on every machine.
    pub fn shipped() -> Fonts {
        let mut db = Database::new();
        SHIPPED.iter().for_each(|font| db.load_font_data(font.to_vec()));
        let shipped = db.len();
        Fonts { system: FontSystem::new_with_locale_and_db("en-US".into(), db), shipped }
    }

    /// Adds the fonts that are installed on this machine.
    pub fn with_installed(mut self) -> Fonts {
        self.system.db_mut().load_system_fonts();
        self
    }

    /// Adds the fonts of a file, and returns the first of them.
    ///
    /// # Errors
    /// When the file cannot be read or holds no font.
    pub fn add(&mut self, file: &Path) -> Result<Face> {
        let bytes = read(file, LARGEST)?;
        let before = self.system.db().len();
        self.system.db_mut().load_font_data(bytes);
        let added = self.system.db().faces().nth(before).map(face_of);
        added.ok_or_else(|| DataError::input(file, "holds no font; give a .ttf, .otf or .ttc file").into())
    }

    /// [`Fonts::add`] of a font for Latin words.
    ///
    /// # Errors
    /// As [`Fonts::add`], and when it lacks Latin letters or digits.
    pub fn add_latin(&mut self, file: &Path) -> Result<Face> {
        let face = self.add(file)?;
        if !self.latin().contains(&face) {
            return Err(DataError::input(file, "lacks Latin letters or digits, in which words of signs are; give another font").into());
        }
        Ok(face)
    }

    /// A number that differs where faces or their fonts differ.
    pub fn fingerprint(&self, faces: &[Face]) -> u64 {
        let db = self.system.db();
        let mut hash = fnv::hash([]);
        let mut add = |bytes: &[u8]| hash = fnv::with(hash, bytes.iter().copied());
        faces.iter().for_each(|f| add(f.name().as_bytes()));
        let used = db.faces().filter(|info| faces.contains(&face_of(info))).map(|info| info.id);
        used.for_each(|id| db.with_face_data(id, |data, _| add(data)).unwrap_or(()));
        hash
    }

    /// Faces that have all Latin letters and digits and are no pictures, shipped ones first, the others by name.
    pub fn latin(&self) -> Vec<Face> {
        let db = self.system.db();
        let is_latin = |id| db.with_face_data(id, has_letters).unwrap_or(false);
        let ids: Vec<_> = db.faces().map(|f| f.id).collect();
        let usable =
            ids.iter().enumerate().filter(|(_, id)| is_latin(**id)).filter_map(|(k, id)| Some((k < self.shipped, face_of(db.face(*id)?))));
        let mut out: Vec<(bool, Face)> = usable.collect();
        out.sort_by_key(|(is_shipped, face)| (!is_shipped, face.name()));
        out.dedup_by(|a, b| a.1 == b.1);
        out.into_iter().map(|(_, face)| face).collect()
    }
}

fn face_of(info: &cosmic_text::fontdb::FaceInfo) -> Face {
    let family = info.families.first().map(|(name, _)| name.clone()).unwrap_or_default();
    Face { family, weight: info.weight, style: info.style, stretch: info.stretch }
}

fn has_letters(data: &[u8], index: u32) -> bool {
    let Ok(face) = ttf_parser::Face::parse(data, index) else { return false };
    let os2 = face.raw_face().table(ttf_parser::Tag::from_bytes(b"OS/2")).unwrap_or_default();
    let is_picture = PICTURES.iter().any(|(at, kind)| os2.get(*at) == Some(kind));
    !is_picture && LATIN.chars().all(|c| face.glyph_index(c).is_some_and(|g| g.0 != 0))
}

/// The error of characters that no loaded font has.
pub(super) fn lacking(family: &str, missing: &[char]) -> PipelineError {
    let mut all: Vec<char> = missing.to_vec();
    all.sort_unstable();
    all.dedup();
    let code = |c: &char| format!("U+{:04X} {c} ({})", *c as u32, c.script().full_name());
    let codes: Vec<String> = all.iter().map(code).collect();
    PipelineError::Usage(format!("font {family:?} and its fallbacks lack {}; give --font a file that has them", codes.join(", ")))
}
