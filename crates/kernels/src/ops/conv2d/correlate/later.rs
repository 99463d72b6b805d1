//! What a later pass reads, asked of memory while tiles are computed.

use crate::tile::Ahead;

/// Rows of channels, of which every tile asks for a part; a tile of few terms asks for a sample of its part.
pub struct Later {
    /// Where the channel whose turn it is begins, and how much of it was asked for.
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
    /// The part of the next tile, in so many rows.
    pub fn next(&mut self, rows: usize) -> Option<Ahead> {
        if self.planes == 0 {
            return None;
        }
        let ahead = Ahead { from: self.from.wrapping_add(self.at), step: self.per_tile.div_ceil(rows.max(1)) };
        self.at += self.per_tile;
        while self.at >= self.len && self.planes > 0 {
            self.at -= self.len;
            self.planes -= 1;
            let is_last = self.planes.is_multiple_of(self.channels);
            self.from = self.from.wrapping_add(if is_last { self.to_image } else { self.to_channel });
        }
        Some(ahead)
    }
}
