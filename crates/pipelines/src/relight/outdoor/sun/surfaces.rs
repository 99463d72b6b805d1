//! Points of surfaces that light reaches from a sun, from the sky and from each other.

use super::SUN;
use crate::relight::outdoor::visibility::{Ambient, OPEN_CELLS, Radiosity, Visibility, radiances};
use diorama_geom::glam::Vec3;
use rayon::prelude::*;

/// Directions in which points of surfaces look.
const LOOKS: usize = 128;
/// Share of the points, the lowest, that the ground outside looks like.
const LOWEST: f32 = 0.1;
/// Bounces of light between surfaces, where a light is given.
const BOUNCES: usize = 4;

/// Points of surfaces with their albedo, which send light to each other.
#[derive(Clone, Default)]
pub struct Surfaces {
    pub(super) points: Vec<Place>,
    pub albedos: Vec<Vec3>,
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
    /// Cells of surfaces that it sees, and the share of what they send that arrives.
    seen: Vec<(u32, f32)>,
    /// Share that small things leave of a sun whose traced ray passes.
    pub(super) share: f32,
}

impl Surfaces {
    /// Points with normals and albedos.
    pub fn new(points: impl Iterator<Item = (Vec3, Vec3)>, albedos: Vec<Vec3>, visibility: &Visibility) -> Surfaces {
        let points: Vec<(Vec3, Vec3)> = points.collect();
        Surfaces { points: points.par_iter().map(|(point, normal)| Place::of(visibility, *point, *normal)).collect(), albedos }
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
        let mut sent: Vec<(Vec3, f32)> = vec![(Vec3::ZERO, 0.0); OPEN_CELLS.pow(3)];
        let mut by_height = [(Vec3::ZERO, 0.0); OPEN_CELLS];
        for ((p, a), e) in self.points.iter().zip(&self.albedos).zip(irradiance) {
            for of in [&mut sent[p.cell as usize], &mut by_height[p.cell as usize / OPEN_CELLS.pow(2)]] {
                *of = (of.0 + *a * *e, of.1 + 1.0);
            }
        }
        // What no photograph shows looks like the rest at its height; the ground outside, like the lowest tenth.
        let (mut ground, mut count) = (Vec3::ZERO, 0.0);
        for (sum, n) in by_height {
            if count < LOWEST * self.points.len() as f32 {
                (ground, count) = (ground + sum, count + n);
            }
        }
        let ground = ground / count.max(1.0);
        let mut last = ground;
        let by_height = by_height.map(|(sum, n)| {
            if n > 0.0 {
                last = sum / n;
            }
            last
        });
        let of_cell = |(i, (sum, n)): (usize, (Vec3, f32))| if n > 0.0 { sum / n } else { by_height[i / OPEN_CELLS.pow(2)] };
        Radiosity { cells: sent.into_iter().enumerate().map(of_cell).collect(), ground }
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
                seen.push((look.cell, share * (1.0 - look.open)));
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
        self.seen.iter().map(|(cell, share)| *share * radiosity.of(*cell)).sum()
    }

    /// Light of sky and surfaces.
    pub(super) fn ambient(&self, ambient: &Ambient) -> Vec3 {
        self.of_sky(&ambient.sky).max(Vec3::ZERO) + self.sent(&ambient.radiosity)
    }

    pub(super) fn sunlit(&self, visibility: &Visibility, toward: Vec3) -> f32 {
        let facing = self.normal.dot(toward);
        if facing > 0.0 { self.share * facing * visibility.from_sun(self.point, self.normal, toward) } else { 0.0 }
    }

    /// Light of a sky `[9, 3]`.
    pub(super) fn of_sky(&self, sky: &[f32]) -> Vec3 {
        (0..9).map(|i| self.sky[i] * Vec3::from_slice(&sky[3 * i..])).sum()
    }
}
