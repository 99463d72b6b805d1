//! Images of characters in the installed fonts, by font family.

use ab_glyph::{Font, FontRef, OutlinedGlyph, PxScaleFactor, point};
use diorama_geom::{Image, ImageU8};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Side of an image in pixels.
pub const SIDE: usize = 48;
/// Height of a capital H, row of the baseline, and width of the widest character, in pixels.
const CAPITAL: f32 = 30.0;
const BASELINE: f32 = 38.0;
const WIDEST: f32 = 46.0;
/// Two faces count as the same drawing if less than this share of their ink differs.
const ALIKE: f32 = 0.1;
/// Bytes of the OS/2 table by which fonts of pictures declare themselves: IBM's symbol class, PANOSE's pictorial kind.
const PICTURES: [(usize, u8); 2] = [(30, 12), (32, 5)];

/// One image per character, in one channel: 255 is ink, 0 is paper.
pub type Face = Vec<ImageU8>;

/// Faces that must be on one side of the split.
pub struct Family {
    pub name: String,
    pub faces: Vec<Face>,
}

/// A character in three equal channels, as networks for photographs expect.
pub fn in_color(character: &ImageU8) -> Image {
    Image { width: SIDE, height: SIDE, channels: 3, data: character.data.iter().flat_map(|v| [*v as f32 / 255.0; 3]).collect() }
}

/// Families in the usual font folders, of faces that have all `characters` and are not fonts of pictures.
pub fn installed(characters: &str) -> Vec<Family> {
    let home = std::env::var("HOME").or(std::env::var("USERPROFILE")).unwrap_or_default();
    let shared = ["/usr/share/fonts", "/usr/local/share/fonts", "/Library/Fonts", "/System/Library/Fonts", "C:/Windows/Fonts"];
    let own = [".fonts", ".local/share/fonts", "Library/Fonts", "AppData/Local/Microsoft/Windows/Fonts"];
    let mut open: Vec<PathBuf> = shared.iter().map(PathBuf::from).chain(own.iter().map(|o| Path::new(&home).join(o))).collect();
    let mut files = Vec::new();
    while let Some(path) = open.pop() {
        match std::fs::read_dir(&path) {
            Ok(entries) => open.extend(entries.flatten().map(|e| e.path())),
            Err(_) => files.push(path),
        }
    }
    files.sort();
    let is_font = |f: &&PathBuf| f.extension().is_some_and(|e| ["ttf", "otf", "ttc"].iter().any(|x| e.eq_ignore_ascii_case(x)));
    let bytes = files.iter().filter(is_font).filter_map(|f| std::fs::read(f).ok());
    families(bytes.flat_map(|b| faces(&b, characters)).collect())
}

/// The usable faces of a font file, with their family names.
fn faces(bytes: &[u8], characters: &str) -> Vec<(String, Face)> {
    let read = |i| {
        let tables = ttf_parser::Face::parse(bytes, i).ok()?;
        let os2 = tables.raw_face().table(ttf_parser::Tag::from_bytes(b"OS/2")).unwrap_or_default();
        let mut names = tables.names().into_iter().filter(|n| n.name_id == ttf_parser::name_id::FAMILY);
        let face = draw(&FontRef::try_from_slice_and_index(bytes, i).ok()?, characters)?;
        Some((names.find_map(|n| n.to_string())?, face)).filter(|_| PICTURES.iter().all(|(at, kind)| os2.get(*at) != Some(kind)))
    };
    (0..ttf_parser::fonts_in_collection(bytes).unwrap_or(1)).filter_map(read).collect()
}

/// The characters at one scale on one baseline, each centered; `None` if one is missing.
fn draw(font: &FontRef, characters: &str) -> Option<Face> {
    let capital = font.outline(font.glyph_id('H'))?.bounds.height().abs();
    let character = |c: char| {
        let id = Some(font.glyph_id(c)).filter(|id| id.0 != 0)?;
        let outline = font.outline(id)?;
        let factor = (CAPITAL / capital).min(WIDEST / outline.bounds.width());
        let left = (SIDE as f32 - factor * (outline.bounds.min.x + outline.bounds.max.x)) / 2.0;
        let glyph = id.with_scale_and_position(1.0, point(left, BASELINE));
        let drawn = OutlinedGlyph::new(glyph, outline, PxScaleFactor { horizontal: factor, vertical: factor });
        let mut image = ImageU8 { width: SIDE, height: SIDE, channels: 1, data: vec![0; SIDE * SIDE] };
        let corner = drawn.px_bounds().min;
        drawn.draw(|x, y, ink| {
            let (x, y) = (x as i32 + corner.x as i32, y as i32 + corner.y as i32);
            if (0..SIDE as i32).contains(&x) && (0..SIDE as i32).contains(&y) {
                image.data[y as usize * SIDE + x as usize] = (ink.min(1.0) * 255.0) as u8;
            }
        });
        Some(image)
    };
    characters.chars().map(character).collect()
}

/// Groups faces by the first word of their family names ("Lato" and "Lato Black" are one), and merges groups that share a drawing.
fn families(faces: Vec<(String, Face)>) -> Vec<Family> {
    let mut by_word: BTreeMap<String, Vec<Face>> = BTreeMap::new();
    for (name, face) in faces {
        let word = name.split([' ', '-']).next().unwrap_or_default();
        by_word.entry(word.to_lowercase()).or_default().push(face);
    }
    type Shaped = (Family, Vec<Vec<f32>>);
    let mut out: Vec<Shaped> = Vec::new();
    for (name, faces) in by_word {
        let (mut shapes, mut family) = (faces.iter().map(|f| shape(f)).collect::<Vec<_>>(), Family { name, faces });
        let alike = |known: &Shaped| known.1.iter().any(|k| shapes.iter().any(|s| difference(k, s) < ALIKE));
        let (same, others): (Vec<Shaped>, Vec<Shaped>) = out.into_iter().partition(alike);
        for (known, more) in same {
            family.name = format!("{}, {}", known.name, family.name);
            family.faces.extend(known.faces);
            shapes.extend(more);
        }
        out = others;
        out.push((family, shapes));
    }
    out.into_iter().map(|(family, _)| family).collect()
}

/// Every fifth character of a face, at a quarter of its size.
fn shape(face: &[ImageU8]) -> Vec<f32> {
    face.iter().step_by(5).flat_map(|c| c.downsampled(SIDE / 4, SIDE / 4).to_f32().data).collect()
}

/// Share of the ink in which two shapes differ.
fn difference(a: &[f32], b: &[f32]) -> f32 {
    let (differs, all) = a.iter().zip(b).fold((0.0, 0.0), |(d, all), (a, b)| (d + (a - b).abs(), all + a.max(*b)));
    differs / all
}
