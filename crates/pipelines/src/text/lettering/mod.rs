//! Writing set in fonts: shaped, ordered and drawn by `cosmic-text`, as coverage of ink with the bounds of its words and characters.

mod fonts;

use crate::error::{PipelineError, Result};
use cosmic_text::{Attrs, Buffer, Family, Metrics, Shaping, SwashCache, SwashContent, Wrap};
use diorama_geom::ImageU8;
use std::ops::Range;

pub use fonts::{Face, Fonts};

/// Pixels drawn per pixel of the ink, along an axis.
const SUPERSAMPLED: usize = 4;
/// Coverage from which a drawn pixel is ink, for bounds.
const INKED: u8 = 64;
/// Line height over font size.
const LEADING: f32 = 1.25;
/// Largest edge of the drawn pixels.
const LARGEST: usize = 1 << 14;

/// A rectangle in pixels, y down.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bounds {
    pub low: [f32; 2],
    pub high: [f32; 2],
}

/// A character or word: its text, where it is in the whole text, and the bounds of its ink.
#[derive(Clone, Debug, PartialEq)]
pub struct Piece {
    pub text: String,
    pub bytes: Range<usize>,
    pub bounds: Bounds,
}

/// Writing as drawn; the image ends where its ink ends.
#[derive(Clone, Debug, PartialEq)]
pub struct Lettering {
    /// Share of each pixel that is ink, one channel.
    pub ink: ImageU8,
    /// In the order of the text; letters that share a glyph are one.
    pub characters: Vec<Piece>,
    /// What spaces and line ends separate.
    pub words: Vec<Piece>,
}

impl Bounds {
    /// Of nothing.
    const NONE: Bounds = Bounds { low: [f32::INFINITY; 2], high: [f32::NEG_INFINITY; 2] };

    /// Of both.
    pub fn with(self, other: Bounds) -> Bounds {
        Bounds { low: [0, 1].map(|a| self.low[a].min(other.low[a])), high: [0, 1].map(|a| self.high[a].max(other.high[a])) }
    }

    fn is_empty(self) -> bool {
        self.low[0] >= self.high[0]
    }

    fn moved(self, by: [f32; 2]) -> Bounds {
        Bounds { low: [0, 1].map(|a| self.low[a] + by[a]), high: [0, 1].map(|a| self.high[a] + by[a]) }
    }
}

/// Ink of a glyph in supersampled pixels.
struct Drawn {
    bytes: Range<usize>,
    left: i32,
    top: i32,
    width: usize,
    ink: Vec<u8>,
}

impl Drawn {
    fn bounds(&self) -> Bounds {
        let inked =
            self.ink.iter().enumerate().filter(|(_, v)| **v >= INKED).map(|(i, _)| ((i % self.width) as i32, (i / self.width) as i32));
        inked.fold(Bounds::NONE, |all, (x, y)| {
            let (x, y) = ((self.left + x) as f32, (self.top + y) as f32);
            all.with(Bounds { low: [x, y], high: [x + 1.0, y + 1.0] })
        })
    }
}

impl Fonts {
    /// Sets text, whose lines `\n` ends, in a face at a size in pixels per em.
    ///
    /// # Errors
    /// When no loaded font has a character, with its code point and script; when nothing of the text has ink, or it is too large to draw.
    pub fn set(&mut self, text: &str, face: &Face, size_px: f32) -> Result<Lettering> {
        let scale = SUPERSAMPLED as f32;
        let mut buffer = Buffer::new(&mut self.system, Metrics::new(scale * size_px, LEADING * scale * size_px));
        buffer.set_wrap(Wrap::None);
        buffer.set_size(None, None);
        let attrs = Attrs::new().family(Family::Name(&face.family)).weight(face.weight).style(face.style).stretch(face.stretch);
        buffer.set_text(text, &attrs, Shaping::Advanced, None);
        buffer.shape_until_scroll(&mut self.system, false);
        // Where each line begins in the text.
        let begins: Vec<usize> = std::iter::once(0).chain(text.match_indices('\n').map(|(i, _)| i + 1)).collect();
        let (mut drawn, mut cache, mut missing) = (Vec::new(), SwashCache::new(), Vec::new());
        for run in buffer.layout_runs() {
            let begin = begins.get(run.line_i).copied().unwrap_or(0);
            for glyph in run.glyphs {
                let bytes = begin + glyph.start..begin + glyph.end;
                if glyph.glyph_id == 0 {
                    missing.extend(run.text[glyph.start..glyph.end].chars());
                    continue;
                }
                let at = glyph.physical((0.0, run.line_y), 1.0);
                let image = cache.get_image_uncached(&mut self.system, at.cache_key);
                if let Some(image) = image.filter(|i| i.placement.width > 0 && i.placement.height > 0) {
                    let (left, top) = (at.x + image.placement.left, at.y - image.placement.top);
                    drawn.push(Drawn {
                        bytes,
                        left,
                        top,
                        width: image.placement.width as usize,
                        ink: coverage(&image.data, image.content),
                    });
                }
            }
        }
        if !missing.is_empty() {
            return Err(fonts::lacking(&face.family, &missing));
        }
        composed(text, &drawn)
    }
}

/// Coverage of a glyph's pixels; of colored ones, their opacity.
fn coverage(data: &[u8], content: SwashContent) -> Vec<u8> {
    match content {
        SwashContent::Mask => data.to_vec(),
        SwashContent::Color => data.chunks_exact(4).map(|p| p[3]).collect(),
        SwashContent::SubpixelMask => data.chunks_exact(4).map(|p| ((p[0] as u32 + p[1] as u32 + p[2] as u32) / 3) as u8).collect(),
    }
}

/// The image of all glyphs, cropped to whole pixels around their ink, with its pieces.
fn composed(text: &str, drawn: &[Drawn]) -> Result<Lettering> {
    let all = drawn.iter().fold(Bounds::NONE, |all, d| all.with(d.bounds()));
    if all.is_empty() {
        return Err(PipelineError::Usage(format!("text {text:?}: nothing of it has ink; give letters")));
    }
    let s = SUPERSAMPLED as i32;
    let low = [0, 1].map(|a| (all.low[a] as i32).div_euclid(s) * s);
    let size = [0, 1].map(|a| ((all.high[a] as i32 - low[a]) as usize).div_ceil(SUPERSAMPLED));
    if size.iter().any(|v| v * SUPERSAMPLED > LARGEST) {
        return Err(PipelineError::Usage(format!("text of {} × {} pixels: too large to draw; give a smaller size", size[0], size[1])));
    }
    let [w, h] = size;
    let mut sums = vec![0u32; w * h];
    let mut fine = vec![0u8; w * h * SUPERSAMPLED * SUPERSAMPLED];
    let fine_width = w * SUPERSAMPLED;
    for d in drawn {
        for (i, v) in d.ink.iter().enumerate() {
            let (x, y) = (d.left + (i % d.width) as i32 - low[0], d.top + (i / d.width) as i32 - low[1]);
            if x >= 0 && y >= 0 && (x as usize) < fine_width && (y as usize) < h * SUPERSAMPLED {
                let at = &mut fine[y as usize * fine_width + x as usize];
                // Glyphs that overlap are one shape.
                *at = (*at).max(*v);
            }
        }
    }
    for (i, v) in fine.iter().enumerate() {
        sums[i / fine_width / SUPERSAMPLED * w + i % fine_width / SUPERSAMPLED] += *v as u32;
    }
    let per = (SUPERSAMPLED * SUPERSAMPLED) as u32;
    let ink = ImageU8 { width: w, height: h, channels: 1, data: sums.into_iter().map(|v| ((v + per / 2) / per) as u8).collect() };
    let piece = |bytes: Range<usize>| {
        let own = drawn.iter().filter(|d| d.bytes.start < bytes.end && bytes.start < d.bytes.end);
        let bounds = own.fold(Bounds::NONE, |all, d| all.with(d.bounds()));
        let bounds = bounds.moved([-low[0] as f32, -low[1] as f32]);
        let scaled = Bounds { low: bounds.low.map(|v| v / s as f32), high: bounds.high.map(|v| v / s as f32) };
        (!bounds.is_empty()).then(|| Piece { text: text[bytes.clone()].into(), bytes, bounds: scaled })
    };
    Ok(Lettering {
        ink,
        characters: clusters(drawn).into_iter().filter_map(piece).collect(),
        words: words(text).into_iter().filter_map(piece).collect(),
    })
}

/// Byte ranges of the glyphs, those that overlap as one, in the order of the text.
fn clusters(drawn: &[Drawn]) -> Vec<Range<usize>> {
    let mut all: Vec<Range<usize>> = drawn.iter().map(|d| d.bytes.clone()).collect();
    all.sort_by_key(|r| (r.start, r.end));
    let mut out: Vec<Range<usize>> = Vec::new();
    for r in all {
        match out.last_mut() {
            Some(last) if r.start < last.end => last.end = last.end.max(r.end),
            _ => out.push(r),
        }
    }
    out
}

/// Byte ranges between white space.
fn words(text: &str) -> Vec<Range<usize>> {
    text.split_whitespace()
        .map(|w| w.as_ptr() as usize - text.as_ptr() as usize)
        .zip(text.split_whitespace())
        .map(|(at, w)| at..at + w.len())
        .collect()
}

#[cfg(test)]
mod tests;
