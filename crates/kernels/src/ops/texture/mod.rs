//! Filtered lookups in textures and cube maps (Laine et al. 2020; mip maps: Williams 1983).
//!
//! # Conventions
//! - Coordinates (s, t) of a flat texture are 0 and 1 at its borders, t downwards: texel (x, y) has its center at
//!   `((x + 0.5) / W, (y + 0.5) / H)`.
//! - Coordinates of a cube map are directions of any length. Faces are +x, −x, +y, −y, +z, −z, turned as OpenGL has them. Between faces,
//!   lookups blend texels of both; at a corner, where the fourth texel is missing, the mean of the other three takes its place.
//! - Levels are halved by means of 2 × 2 texels for as long as both sizes are even or 1; a level of fraction `f` blends two.

pub mod cpu;
pub mod footprint;
pub mod mips;
pub mod reference;
mod scatter;
mod taps;
#[cfg(test)]
mod tests;

/// What lies beyond a texture's borders.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// The texture again.
    Repeat,
    /// The texels of the border; coordinates beyond their centers get no gradient.
    Clamp,
    /// Six square faces, around which directions turn.
    Cube,
}

/// How texels are blended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Filter {
    /// The texel that holds the point, of the finest level; coordinates get no gradient.
    Nearest,
    /// Four texels of the finest level.
    Bilinear,
    /// Four texels of each of the two levels around a given one.
    Trilinear,
}

/// Textures `[N, H, W, C]`, or cube maps `[N, 6, S, S, C]`, with or without their coarser levels, one after the other. Points, whose number
/// is a multiple of N, are shared out evenly: the first ones read the first texture.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Texture {
    pub kind: Kind,
    pub filter: Filter,
    /// N
    pub images: usize,
    /// `[H, W]` of the finest level, `[S, S]` of a cube map.
    pub size: [usize; 2],
    /// C
    pub channels: usize,
}

/// A level of a texture.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Level {
    pub size: [usize; 2],
    /// Texels of finer levels, of all images and faces.
    pub first: usize,
}

impl Texture {
    pub fn faces(&self) -> usize {
        if self.kind == Kind::Cube { 6 } else { 1 }
    }

    /// Numbers per point: (s, t), or a direction.
    pub fn coordinates(&self) -> usize {
        if self.kind == Kind::Cube { 3 } else { 2 }
    }

    /// Levels that lookups read, the finest first: one unless [`Filter::Trilinear`].
    pub fn levels(&self) -> Vec<Level> {
        let mut levels = vec![Level { size: self.size, first: 0 }];
        let mut size = self.size;
        let can_halve = |size: [usize; 2]| size != [1, 1] && size.iter().all(|n| *n == 1 || *n > 0 && n.is_multiple_of(2));
        while self.filter == Filter::Trilinear && can_halve(size) {
            let first = levels[levels.len() - 1].first + self.images * self.faces() * size[0] * size[1];
            size = size.map(|n| n.div_ceil(2));
            levels.push(Level { size, first });
        }
        levels
    }

    /// Numbers in all levels.
    pub fn numbers(&self) -> usize {
        self.levels().iter().map(|l| self.images * self.faces() * l.size[0] * l.size[1] * self.channels).sum()
    }

    fn check(&self, texels: usize, points: usize, level: usize, values: usize) {
        assert!(self.kind != Kind::Cube || self.size[0] == self.size[1], "texture: faces of {:?}", self.size);
        assert!(self.size.iter().all(|n| *n <= 1 << 15), "texture: size {:?}", self.size);
        assert_eq!(texels, self.numbers(), "texture: texels of all levels");
        assert!(texels <= u32::MAX as usize, "texture: too many texels");
        assert!(points == 0 || self.images > 0 && points.is_multiple_of(self.images) && texels > 0, "texture: points without texels");
        assert_eq!(level, if self.filter == Filter::Trilinear { points } else { 0 }, "texture: levels of points");
        assert_eq!(values, points * self.channels, "texture: values");
    }
}

/// A face's axes: the one that it lies on, and those along s and t.
type Face = [[f32; 3]; 3];

/// The faces as OpenGL has them (specification of version 4.6, table 8.19).
const FACES: [Face; 6] = [
    [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]],
    [[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]],
    [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]],
    [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]],
    [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]],
    [[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]],
];

/// Direction of a point (s, t) of a cube map's face; not of length 1.
pub fn cube_direction(face: usize, s: f32, t: f32) -> [f32; 3] {
    let [major, across, down] = FACES[face];
    std::array::from_fn(|k| major[k] + (2.0 * s - 1.0) * across[k] + (2.0 * t - 1.0) * down[k])
}

/// The face that a direction meets.
#[inline(always)]
fn face_of(d: [f32; 3]) -> usize {
    let size = d.map(f32::abs);
    let axis = if size[0] >= size[1] && size[0] >= size[2] {
        0
    } else if size[1] >= size[2] {
        1
    } else {
        2
    };
    2 * axis + (d[axis] < 0.0) as usize
}

#[inline(always)]
fn dot(a: [f32; 3], b: [f32; 3]) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}
