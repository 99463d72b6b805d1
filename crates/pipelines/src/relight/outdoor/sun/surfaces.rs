//! Points of surfaces that light reaches from a sun, from the sky and from each other.

use super::SUN;
use crate::relight::outdoor::visibility::{Ambient, OPEN_CELLS, Radiosity, SIDES, Visibility, places, radiances, sides};
use diorama_geom::glam::Vec3;
use rayon::prelude::*;

/// Directions in which points of surfaces look.
const LOOKS: usize = 128;
/// Share of the points, the lowest, among which the ground outside is looked for.
const LOWEST: f32 = 0.25;
/// Points that must face a side for their mean to stand for others, and of those of one cell.
const FEW: f32 = 3.0;
const FACING: f32 = 0.1;
/// Side that faces up.
const UP: usize = 4;
/// Bounces of light between surfaces, where a light is given.
const BOUNCES: usize = 4;

/// Points of surfaces with their albedo, which send light to each other.
#[derive(Clone, Default)]
pub struct Surfaces {
    pub(super) points: Vec<Place>,
    pub albedos: Vec<Vec3>,
    /// Height below which the lowest of them lie.
    low: f32,
}

/// A mean of what is added.
#[derive(Clone, Copy, Default)]
struct Mean {
    sum: Vec3,
    weight: f32,
}

impl Mean {
    fn add(&mut self, value: Vec3, weight: f32) {
        (self.sum, self.weight) = (self.sum + weight * value, self.weight + weight);
    }

    /// The mean; something else where it is of no more than so much.
    fn or(&self, least: f32, other: Vec3) -> Vec3 {
        if self.weight > least { self.sum / self.weight } else { other }
    }
}

/// A point and what does not depend on light.
#[derive(Clone)]
pub(super) struct Place {
    pub(super) point: Vec3,
    pub(super) normal: Vec3,
    cell: u32,
    /// Share of an even sky's light that arrives.
    pub(super) open: f32,
    /// Light that arrives for each of the sky's coefficients.
    pub(super) sky: [f32; 9],
    /// Sides of cells that it sees, and the share of what they send that arrives.
    seen: Vec<(u32, f32)>,
    /// Share that arrives of a sun whose traced ray passes.
    pub(super) share: f32,
}

impl Surfaces {
    /// Points with normals and albedos.
    pub fn new(points: impl Iterator<Item = (Vec3, Vec3)>, albedos: Vec<Vec3>, visibility: &Visibility) -> Surfaces {
        let points: Vec<(Vec3, Vec3)> = points.collect();
        let mut heights: Vec<f32> = points.iter().map(|(point, _)| point.z).collect();
        heights.sort_by(f32::total_cmp);
        let low = heights.get((LOWEST * heights.len() as f32) as usize).copied().unwrap_or(0.0);
        Surfaces { points: points.par_iter().map(|(point, normal)| Place::of(visibility, *point, *normal)).collect(), albedos, low }
    }

    /// The same from [`Surfaces::numbers`].
    pub fn from_numbers(numbers: &[f32], visibility: &Visibility) -> Surfaces {
        let at = |p: &[f32], k: usize| Vec3::from_slice(&p[3 * k..]);
        let points = numbers.chunks_exact(9).map(|p| (at(p, 0), at(p, 1)));
        Surfaces::new(points, numbers.chunks_exact(9).map(|p| at(p, 2)).collect(), visibility)
    }

    /// Points, normals and albedos as a checkpoint keeps them, `[N, 9]`.
    pub fn numbers(&self) -> Vec<f32> {
        let each = self.points.iter().zip(&self.albedos);
        each.flat_map(|(p, a)| [p.point, p.normal, *a].into_iter().flat_map(|v| v.to_array())).collect()
    }

    /// Where the points lie.
    pub fn positions(&self) -> Vec<Vec3> {
        self.points.iter().map(|p| p.point).collect()
    }

    /// Share of a sun's light that reaches each point, times the cosine.
    pub(super) fn sunlit(&self, visibility: &Visibility, toward: Vec3) -> Vec<f32> {
        self.points.par_iter().map(|p| p.sunlit(visibility, toward)).collect()
    }

    /// What surfaces send of which each receives `irradiance`.
    pub(super) fn radiosity(&self, irradiance: &[Vec3]) -> Radiosity {
        let mut cells = vec![Mean::default(); SIDES * OPEN_CELLS.pow(3)];
        let mut by_height = [[Mean::default(); SIDES]; OPEN_CELLS];
        let (mut all, mut low, mut ground) = (Mean::default(), Mean::default(), Mean::default());
        for ((p, a), e) in self.points.iter().zip(&self.albedos).zip(irradiance) {
            let sent = *a * *e;
            for (side, share) in sides(p.normal) {
                cells[SIDES * p.cell as usize + side].add(sent, share);
                by_height[p.cell as usize / OPEN_CELLS.pow(2)][side].add(sent, share);
            }
            all.add(sent, 1.0);
            if p.point.z <= self.low {
                low.add(sent, 1.0);
                ground.add(sent, p.normal.z.max(0.0).powi(2));
            }
        }
        // What no photograph shows looks like the rest at its height that faces the same side; the ground outside, like what is low and faces up.
        let all = all.or(0.0, Vec3::ZERO);
        let ground = ground.or(FEW, low.or(0.0, all));
        let mut last = [all; SIDES];
        last[UP] = ground;
        let by_height = by_height.map(|sides| {
            last = std::array::from_fn(|k| sides[k].or(FEW, last[k]));
            last
        });
        let of_cell = |(i, m): (usize, Mean)| m.or(FACING, by_height[i / SIDES / OPEN_CELLS.pow(2)][i % SIDES]);
        Radiosity { cells: cells.into_iter().enumerate().map(of_cell).collect(), ground }
    }

    /// What of the sky, and of surfaces that it and suns `[N, 6]` light, reaches any place.
    pub fn light(&self, visibility: &Visibility, suns: &[f32], sky: &[f32]) -> Ambient {
        let of_suns = |p: &Place| {
            let of = |sun: &[f32]| p.sunlit(visibility, Vec3::from_slice(sun)) * Vec3::from_slice(&sun[3..]);
            suns.chunks_exact(SUN).map(of).sum::<Vec3>()
        };
        let direct: Vec<Vec3> = self.points.par_iter().map(of_suns).collect();
        let mut irradiance: Vec<Vec3> = self.points.iter().zip(&direct).map(|(p, d)| *d + p.of_sky(sky).max(Vec3::ZERO)).collect();
        let mut ambient = Ambient { sky: sky.to_vec(), radiosity: Radiosity::dark() };
        for _ in 0..BOUNCES {
            ambient.radiosity = self.radiosity(&irradiance);
            irradiance = self.points.par_iter().zip(&direct).map(|(p, d)| *d + p.ambient(&ambient)).collect();
        }
        ambient
    }
}

impl Place {
    pub(super) fn of(visibility: &Visibility, point: Vec3, normal: Vec3) -> Place {
        let (mut sky, mut open, mut seen) = ([0.0; 9], 0.0, Vec::with_capacity(LOOKS));
        for look in visibility.looks(point, normal, LOOKS, 0) {
            let share = 1.0 / LOOKS as f32;
            sky.iter_mut().zip(radiances(look.direction)).for_each(|(v, r)| *v += share * look.open * r);
            open += share * look.passes;
            if look.open < 1.0 {
                seen.extend(places(&look).map(|(place, part)| (place, part * share * (1.0 - look.open))));
            }
        }
        seen.sort_by_key(|s| s.0);
        seen.dedup_by(|next, kept| {
            let is_same = next.0 == kept.0;
            kept.1 += if is_same { next.1 } else { 0.0 };
            is_same
        });
        Place { point, normal, cell: visibility.cell_of(point), open, sky, seen, share: 1.0 }
    }

    /// Light of surfaces that send so much.
    pub(super) fn sent(&self, radiosity: &Radiosity) -> Vec3 {
        self.seen.iter().map(|(place, share)| *share * radiosity.of(*place)).sum()
    }

    /// Light of sky and surfaces.
    pub(super) fn ambient(&self, ambient: &Ambient) -> Vec3 {
        self.of_sky(&ambient.sky).max(Vec3::ZERO) + self.sent(&ambient.radiosity)
    }

    /// Cosine between the normal and a direction.
    pub(super) fn facing(&self, toward: Vec3) -> f32 {
        self.normal.dot(toward)
    }

    pub(super) fn sunlit(&self, visibility: &Visibility, toward: Vec3) -> f32 {
        let facing = self.facing(toward);
        if facing > 0.0 { self.share * facing * visibility.from_sun(self.point, self.normal, toward) } else { 0.0 }
    }

    /// Light of a sky `[9, 3]`.
    pub(super) fn of_sky(&self, sky: &[f32]) -> Vec3 {
        (0..9).map(|i| self.sky[i] * Vec3::from_slice(&sky[3 * i..])).sum()
    }
}
