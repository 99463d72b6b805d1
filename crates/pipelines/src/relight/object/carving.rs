//! Space carving (Kutulakos and Seitz 2000): masks leave webs of matter between parts of an object that stand close together. No surface is
//! what photographs show in different colors; it is taken off the hull until what is left is consistent.

use super::capture::{BOX_HALF, ObjectPhoto};
use super::hull::{self, Silhouette};
use super::placement::Placement;
use diorama_geom::color::srgb_from_linear;
use diorama_geom::glam::DVec3;
use rayon::prelude::*;

/// Width of a cell over that of a pixel, and cells along an axis.
const PIXELS: f64 = 1.2;
const CELLS: (f64, f64) = (32.0, 160.0);
/// Least number of photographs that must show a cell for it to be judged.
const FEW: usize = 4;
/// Difference of a channel in sRGB up to which colors agree, and share of the photographs that must agree on one.
const AGREES: f32 = 0.06;
const MAJORITY: f32 = 0.8;
/// Number of masks at whose border a cell is surface for sure, and distance in cells up to which it is at one. Gloss and metal look different
/// from everywhere, but thin parts of them are at many borders.
const SURE: usize = 6;
const BORDER: f64 = 1.5;
/// Largest share of the hull that may be taken off; beyond, the photographs do not agree on anything.
const MOST: f64 = 0.3;
/// Times at most that the surface is judged.
const ROUNDS: usize = 100;
/// Opacity above which a pixel shows the object alone.
const OPAQUE: f32 = 0.95;
/// No cell.
const NONE: u32 = u32::MAX;

/// Cells of the object's box.
pub struct Carving {
    /// Along an axis.
    cells: usize,
    /// May be matter.
    solid: Vec<bool>,
    /// Taken off.
    off: Vec<bool>,
}

/// A photograph's colors in sRGB with opacity, and the cell that each of its pixels shows.
struct Picture<'a> {
    photo: &'a ObjectPhoto,
    colors: Vec<[f32; 4]>,
    cells: Vec<u32>,
}

/// What a photograph shows of a cell: the least and the largest color of the pixels on it and beside these, their mean, and their number.
#[derive(Clone, Copy)]
struct Shown {
    cell: u32,
    low: [f32; 3],
    high: [f32; 3],
    sum: [f32; 3],
    pixels: f32,
}

impl Carving {
    /// Carves the hull of photographs. None where they agree on so little that more than three tenths would be lost.
    pub fn of(photos: &[&ObjectPhoto], silhouettes: &[Silhouette], placement: &Placement) -> Option<Carving> {
        let cells = cells(photos);
        let world = |i: usize| center(cells, i) * placement.scale + placement.center;
        let solid: Vec<bool> = (0..cells.pow(3)).into_par_iter().map(|i| hull::contains(silhouettes, world(i))).collect();
        let most = MOST * solid.iter().filter(|s| **s).count() as f64;
        let mut carving = Carving { cells, off: vec![false; solid.len()], solid };
        let width = BORDER * 2.0 * BOX_HALF / cells as f64 * placement.scale;
        let is_sure = |i: usize| silhouettes.iter().filter(|s| s.has_border(world(i), width)).count() >= SURE;
        carving.carve(photos, most as usize, &is_sure).then_some(carving)
    }

    /// Takes off what photographs do not agree on, except for what is sure. False once more than `most` cells would be off.
    fn carve(&mut self, photos: &[&ObjectPhoto], most: usize, is_sure: &(dyn Fn(usize) -> bool + Sync)) -> bool {
        let mut pictures: Vec<Picture> = photos.par_iter().map(|p| Picture::new(p, self)).collect();
        let mut taken = 0;
        for _ in 0..ROUNDS {
            let mut shown: Vec<Shown> = pictures.par_iter().flat_map(Picture::shown).collect();
            // Stable, so that sums do not depend on the number of threads.
            shown.par_sort_by_key(|s| s.cell);
            let is_off = |of: &&[Shown]| is_inconsistent(of) && !is_sure(of[0].cell as usize);
            let off: Vec<usize> = shown.par_chunk_by(|a, b| a.cell == b.cell).filter(is_off).map(|of| of[0].cell as usize).collect();
            taken += off.len();
            if off.is_empty() || taken > most {
                break;
            }
            off.into_iter().for_each(|i| (self.solid[i], self.off[i]) = (false, true));
            pictures.par_iter_mut().for_each(|p| p.look_again(self));
        }
        taken <= most
    }

    /// About the distance of a point from what was taken off, in cells up to 1; inside of it, down to −1.
    pub fn distance(&self, p: DVec3) -> f64 {
        let at = self.place(p) - 0.5;
        let (first, share) = (at.floor(), at - at.floor());
        let corner = |k: usize| DVec3::new((k & 1) as f64, (k >> 1 & 1) as f64, (k >> 2) as f64);
        let weight = |k: usize| (DVec3::ONE - corner(k) - share).abs().element_product();
        let off: f64 = (0..8).filter(|k| self.index(first + corner(*k)).is_some_and(|i| self.off[i])).map(weight).sum();
        1.0 - 2.0 * off
    }

    /// Edge of a cell in object space.
    pub fn cell(&self) -> f64 {
        2.0 * BOX_HALF / self.cells as f64
    }

    /// A point in cells.
    fn place(&self, p: DVec3) -> DVec3 {
        (p + BOX_HALF) / self.cell()
    }

    fn index(&self, cell: DVec3) -> Option<usize> {
        let n = self.cells;
        let inside = cell.min_element() >= 0.0 && cell.max_element() < n as f64;
        inside.then(|| cell.x as usize + n * (cell.y as usize + n * cell.z as usize))
    }

    /// The first solid cell on a ray (Amanatides and Woo 1987).
    fn first(&self, eye: DVec3, direction: DVec3) -> u32 {
        let n = self.cells as f64;
        let from = self.place(eye);
        let inverse = direction.recip();
        let (a, b) = (-from * inverse, (n - from) * inverse);
        let enter = a.min(b).max_element().max(0.0);
        if enter >= a.max(b).min_element() {
            return NONE;
        }
        let mut cell = (from + enter * direction).floor().clamp(DVec3::ZERO, DVec3::splat(n - 1.0));
        let step = direction.signum();
        let mut next = (cell + step.max(DVec3::ZERO) - from) * inverse;
        while let Some(i) = self.index(cell) {
            if self.solid[i] {
                return i as u32;
            }
            let k = if next.x < next.y && next.x < next.z {
                0
            } else if next.y < next.z {
                1
            } else {
                2
            };
            cell[k] += step[k];
            next[k] += inverse[k].abs();
        }
        NONE
    }
}

impl<'a> Picture<'a> {
    fn new(photo: &'a ObjectPhoto, carving: &Carving) -> Picture<'a> {
        let color = |p: &[f32; 4]| {
            let of = |k: usize| srgb_from_linear((p[k] / p[3].max(1e-6)).clamp(0.0, 1.0));
            [of(0), of(1), of(2), p[3]]
        };
        let colors: Vec<[f32; 4]> = photo.rgba.data.as_chunks::<4>().0.iter().map(color).collect();
        let mut picture = Picture { photo, cells: vec![NONE; colors.len()], colors };
        (0..picture.cells.len()).filter(|i| picture.colors[*i][3] > OPAQUE).for_each(|i| picture.cells[i] = first_of(photo, carving, i));
        picture
    }

    /// Follows the rays on whose cells were taken off.
    fn look_again(&mut self, carving: &Carving) {
        let photo = self.photo;
        for (i, cell) in self.cells.iter_mut().enumerate().filter(|(_, c)| **c != NONE) {
            if !carving.solid[*cell as usize] {
                *cell = first_of(photo, carving, i);
            }
        }
    }

    /// The cells that it shows.
    fn shown(&self) -> Vec<Shown> {
        let (w, h) = (self.photo.rgba.width, self.photo.rgba.height);
        let mut of: Vec<Shown> = Vec::new();
        for i in (0..w * h).filter(|i| self.cells[*i] != NONE) {
            let (x, y) = (i % w, i / w);
            let [r, g, b, _] = self.colors[i];
            let mut s = Shown { cell: self.cells[i], low: [f32::MAX; 3], high: [f32::MIN; 3], sum: [r, g, b], pixels: 1.0 };
            for y in y.saturating_sub(1)..(y + 2).min(h) {
                let row = &self.colors[y * w + x.saturating_sub(1)..y * w + (x + 2).min(w)];
                for c in row.iter().filter(|c| c[3] > OPAQUE) {
                    (0..3).for_each(|k| (s.low[k], s.high[k]) = (s.low[k].min(c[k]), s.high[k].max(c[k])));
                }
            }
            of.push(s);
        }
        of.sort_by_key(|s| s.cell);
        of.chunk_by(|a, b| a.cell == b.cell).map(|same| same[1..].iter().fold(same[0], Shown::and)).collect()
    }
}

/// The cell that a pixel shows.
fn first_of(photo: &ObjectPhoto, carving: &Carving, pixel: usize) -> u32 {
    let (w, pose) = (photo.rgba.width, &photo.view.pose);
    let direction = photo.view.camera.direction((pixel % w) as f64 + 0.5, (pixel / w) as f64 + 0.5);
    carving.first(pose.translation, pose.rotation * direction)
}

impl Shown {
    fn and(mut self, other: &Shown) -> Shown {
        for k in 0..3 {
            (self.low[k], self.high[k]) = (self.low[k].min(other.low[k]), self.high[k].max(other.high[k]));
            self.sum[k] += other.sum[k];
        }
        self.pixels += other.pixels;
        self
    }

    fn mean(&self) -> [f32; 3] {
        self.sum.map(|s| s / self.pixels)
    }

    /// Whether the photograph may show a surface of this color.
    fn allows(&self, c: [f32; 3]) -> bool {
        (0..3).all(|k| (self.low[k] - AGREES..=self.high[k] + AGREES).contains(&c[k]))
    }
}

/// Whether enough photographs show a cell, and too few of them agree on a color.
fn is_inconsistent(of: &[Shown]) -> bool {
    let agree = |s: &Shown| of.iter().filter(|o| o.allows(s.mean())).count();
    of.len() >= FEW && of.iter().all(|s| (agree(s) as f32) < MAJORITY * of.len() as f32)
}

/// Center of a cell in object space.
fn center(cells: usize, i: usize) -> DVec3 {
    let place = DVec3::new((i % cells) as f64, (i / cells % cells) as f64, (i / cells / cells) as f64);
    (place + 0.5) * (2.0 * BOX_HALF / cells as f64) - BOX_HALF
}

/// Cells along an axis, by the mean width of a pixel at the box's center.
fn cells(photos: &[&ObjectPhoto]) -> usize {
    let widths = photos.iter().map(|p| p.view.pose.translation.length() / p.view.camera.fx.min(p.view.camera.fy));
    let width = widths.sum::<f64>() / photos.len() as f64;
    (2.0 * BOX_HALF / (PIXELS * width)).clamp(CELLS.0, CELLS.1) as usize
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::relight::object::capture::ObjectView;
    use diorama_geom::capture::Split;
    use diorama_geom::rng::Rng;
    use diorama_geom::{Camera, Image, Pose};

    /// Two boxes on a plate: least and largest coordinates.
    const BOXES: [[[f64; 3]; 2]; 3] =
        [[[-0.9, -0.9, -0.6], [0.9, 0.9, -0.5]], [[-0.5, -0.4, -0.5], [-0.15, 0.4, 0.3]], [[0.15, -0.4, -0.5], [0.5, 0.4, 0.3]]];
    const STILL: Placement = Placement { center: DVec3::ZERO, scale: 1.0 };

    /// Distance to the nearest box, negative inside.
    fn away(p: DVec3) -> f64 {
        let of = |[low, high]: [[f64; 3]; 2]| (DVec3::from(low) - p).max(p - DVec3::from(high)).max_element();
        BOXES.map(of).into_iter().fold(f64::INFINITY, f64::min)
    }

    /// Squares of all colors; gray; or metal that looks different from everywhere.
    fn color(which: usize, p: DVec3, look: Look, eye: usize) -> [f32; 3] {
        match (look, which) {
            (Look::Gray, _) => [0.3; 3],
            (Look::Metal, _) => [0.1 + 0.8 * (eye as f32 * 0.618).fract(), 0.3, 0.9 - 0.8 * (eye as f32 * 0.382).fract()],
            _ => {
                // Squares of all colors.
                let square = (p / 0.22 + 0.01).floor();
                let rng = Rng::new(which as u64, 1);
                let at = (square.x + 20.0 * (square.y + 20.0 * square.z) + 10_000.0) as u64;
                [0, 1, 2].map(|k| 0.05 + 0.8 * rng.uniform(3 * at + k))
            }
        }
    }

    #[derive(Clone, Copy)]
    enum Look {
        Painted,
        Gray,
        Metal,
    }

    fn photo(i: usize, look: Look) -> ObjectPhoto {
        let camera = Camera::pinhole(96, 96, 0.65);
        let (angle, z) = (i as f64 * 2.4, 0.15 + 0.65 * (i as f64 * 0.618).fract());
        let r = (1.0 - z * z).sqrt();
        let pose = Pose::look_at(4.0 * DVec3::new(r * angle.cos(), r * angle.sin(), z), DVec3::ZERO, DVec3::Z);
        let pixel = |p: usize| {
            let d = pose.rotation * camera.direction((p % 96) as f64 + 0.5, (p / 96) as f64 + 0.5);
            let hit = |[low, high]: [[f64; 3]; 2]| {
                let (a, b) = ((DVec3::from(low) - pose.translation) / d, (DVec3::from(high) - pose.translation) / d);
                let (enter, leave) = (a.min(b).max_element(), a.max(b).min_element());
                if enter < leave { enter } else { f64::INFINITY }
            };
            let (which, t) = BOXES.map(hit).into_iter().enumerate().min_by(|a, b| a.1.total_cmp(&b.1)).expect("boxes");
            if t.is_infinite() {
                return [0.0; 4];
            }
            let [r, g, b] = color(which, pose.translation + t * d, look, i);
            [r, g, b, 1.0]
        };
        let rgba = Image { width: 96, height: 96, channels: 4, data: (0..96 * 96).flat_map(pixel).collect() };
        ObjectPhoto { name: i.to_string(), rgba, view: ObjectView::new(camera, pose), split: Split::Train }
    }

    fn carved(look: Look) -> Option<Carving> {
        let photos: Vec<ObjectPhoto> = (0..32).map(|i| photo(i, look)).collect();
        let silhouettes: Vec<Silhouette> = photos.iter().map(|p| Silhouette::new(&p.rgba, p.view.camera, p.view.pose)).collect();
        Carving::of(&photos.iter().collect::<Vec<_>>(), &silhouettes, &STILL)
    }

    #[test]
    fn webs_are_taken_off_and_matter_stays() {
        let c = carved(Look::Painted).expect("colors agree");
        // No photograph shows the plate from below.
        let far = |i: &usize| away(center(c.cells, *i)) > 1.5 * c.cell() && center(c.cells, *i).z > -0.5;
        let webs: Vec<usize> = (0..c.off.len()).filter(|i| c.solid[*i] || c.off[*i]).filter(far).collect();
        let off = webs.iter().filter(|i| c.off[**i]).count();
        assert!(webs.len() > 500 && off as f64 > 0.45 * webs.len() as f64, "{off} of {} cells of webs are off", webs.len());
        let deep = |i: &usize| away(center(c.cells, *i)) < -1.5 * c.cell();
        assert_eq!((0..c.off.len()).filter(deep).filter(|i| c.off[*i]).count(), 0, "matter is off");
        let i = *webs.iter().find(|i| c.off[**i]).expect("a cell");
        assert!(c.distance(center(c.cells, i)) < 0.0 && c.distance(DVec3::new(0.3, 0.0, 0.0)) == 1.0);
    }

    #[test]
    fn what_is_plain_keeps_its_hull() {
        let c = carved(Look::Gray).expect("colors agree");
        assert!(c.off.iter().all(|o| !o), "nothing tells where a plain surface is");
    }

    #[test]
    fn what_looks_different_from_everywhere_is_not_carved() {
        assert!(carved(Look::Metal).is_none());
    }
}
