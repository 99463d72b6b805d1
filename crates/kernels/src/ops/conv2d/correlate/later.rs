//! Prefetches the input of the next pass while tiles are computed.

use crate::simd;
use crate::tile::Ahead;

/// Channel rows to prefetch, a part per tile; a tile with few terms prefetches only a sample of its part.
pub struct Later {
    /// Start of the current channel, and how many of its floats were requested.
    pub from: *const f32,
    pub at: usize,
    /// Floats of a channel.
    pub len: usize,
    pub per_tile: usize,
    /// Channels left, and channels of an image.
    pub planes: usize,
    pub channels: usize,
    /// Floats to the next channel, and from the last channel of an image to the next image's first.
    pub to_channel: usize,
    pub to_image: usize,
}

impl Later {
    /// The part that the next tile prefetches, in `rows` rows; none when all is requested.
    pub fn next(&mut self, rows: usize) -> Option<Ahead> {
        if self.planes == 0 {
            return None;
        }
        let ahead = Ahead::rows(self.from.wrapping_add(self.at), self.per_tile.div_ceil(rows.max(1)));
        self.at += self.per_tile;
        while self.at >= self.len && self.planes > 0 {
            self.at -= self.len;
            self.planes -= 1;
            let is_last = self.planes.is_multiple_of(self.channels);
            self.from = self.from.wrapping_add(if is_last { self.to_image } else { self.to_channel });
        }
        Some(ahead)
    }

    /// Prefetches the parts of several tiles at once.
    pub fn fetch(&mut self, tiles: usize) {
        for _ in 0..tiles {
            if let Some(part) = self.next(1) {
                simd::fetch_later(part.from, part.turn);
            }
        }
    }
}
