//! The sun of a session apart from its sky: `E = P V max(0, n · s) + max(0, Tᵀ L) + B`, with the sun's direction `s` and power `P`, its
//! visibility `V`, the sky's harmonics `L` as what stands around lets them through, `T`, and light `B` from surfaces around. Directions are
//! searched, the rest then is linear; `B` follows from light and albedo, again and again.

use super::visibility::{Visibility, spread};
use diorama_geom::color::{LUMINANCE, srgb_from_linear};
use diorama_geom::glam::{DVec3, Vec3};
use diorama_geom::sh_light;
use rayon::prelude::*;
use std::sync::atomic::{AtomicBool, Ordering};

mod least_squares;
mod photograph;
mod selection;
mod surfaces;

use least_squares::solve;
pub use photograph::{Shown, of_photograph};
use selection::{Selection, Told};
use surfaces::Place;
pub use surfaces::Surfaces;

/// Numbers of a sun: direction and power.
pub const SUN: usize = 6;
/// Candidates over the sphere of which those above the horizon are tried.
const CANDIDATES: usize = 600;
/// Least height of a sun, as the sine of its elevation.
const HORIZON: f32 = 0.03;
/// Most points by which directions are tried.
const SEARCH_POINTS: usize = 1500;
/// Radii in radians of the circles about the best direction that are tried afterwards, and directions on each.
const CIRCLES: [f32; 5] = [0.1, 0.05, 0.025, 0.0125, 0.006];
const AROUND: usize = 10;
/// Light that surfaces send to each other over what a level white one receives, before it is known: about their albedo.
pub const BOUNCED: f32 = 0.25;
/// Albedo on the mean before anything is known, and luminance of the brightest twentieth.
const FIRST_ALBEDO: f32 = 0.3;
const BRIGHT: f32 = 0.7;
/// Lights at most that are taken for one without a sun, to begin with.
const TAKEN_FOR_EVEN: usize = 8;
/// Times that light and albedo approach each other before beginnings are compared.
const BEGUN: usize = 5;
/// Times that lights and albedos are found in turn, and after which the sun's direction is followed only.
const ROUNDS: usize = 5;
const SEARCHED: usize = 1;
/// Times of these at the end, by sure points alone.
const SURE: usize = 2;
const SETTLING: usize = 15;
/// Every so many of these, light from surfaces is found anew.
const SENT_AGAIN: usize = 3;
/// Difference in sRGB beyond which points count less and less where lights are compared, and where they are found.
const TRUSTED: f32 = 0.15;
const EXPLAINED: f32 = 0.4;
/// Weight of what a mistaken shadow would explain: a surface darker than where the sun shines, or brighter than where it does not. As if these
/// were noise, suns would be weak, and skies would shine in their place.
const DOUBTED: f32 = 0.05;
/// Least cosine between a normal and a sun at which there may be its shadow.
const GRAZING: f32 = 0.02;
/// How much the color of a point counts that no photograph in a light shows.
const UNSHOWN: f32 = 0.03;
/// How much a point tells of lights that lies on no plane.
const UNSURE: f32 = 0.1;
/// Linear light below which errors do not count more.
const DARK: f32 = 0.02;

/// A surface point and its linear color in each light.
#[derive(Clone, Debug)]
pub struct Seen {
    pub point: Vec3,
    pub normal: Vec3,
    pub colors: Vec<Vec3>,
    /// Whether a photograph in each light shows it; elsewhere its color is a guess.
    pub shown: Vec<bool>,
    /// Whether it lies on a plane, so that its sides and shadows are sure.
    pub is_flat: bool,
}

impl Seen {
    /// How much its color in a light counts.
    fn counts(&self, light: usize) -> f32 {
        if self.shown[light] { 1.0 } else { UNSHOWN }
    }

    /// How much it tells of a light: shadows that are wrong make suns weak.
    fn tells(&self, light: usize) -> f32 {
        self.counts(light) * if self.is_flat { 1.0 } else { UNSURE }
    }
}

/// Light that explains points.
#[derive(Clone, Debug, PartialEq)]
pub struct Fitted {
    /// Direction, power.
    pub sun: [f32; SUN],
    /// `[9, 3]`
    pub sky: [f32; 27],
    /// Mean squared error, about that of sRGB.
    pub error: f64,
}

/// A point in one light, for a fit.
#[derive(Clone, Copy)]
struct Lit {
    albedo: Vec3,
    seen: Vec3,
    /// Light from surfaces.
    sent: Vec3,
    /// How much the point counts: shadows that are a little off must not blur what is told apart.
    trust: f32,
    /// sRGB's slope, by which errors in linear light become those that are seen.
    slope: Vec3,
}

/// State of one light while lights are told apart.
#[derive(Clone)]
struct Guess {
    fitted: Fitted,
    sunlit: Vec<f32>,
    /// Light from surfaces at each point.
    sent: Vec<Vec3>,
}

impl Guess {
    /// Irradiance over π of a point.
    fn irradiance(&self, i: usize, place: &Place) -> Vec3 {
        self.sunlit[i] * Vec3::from_slice(&self.fitted.sun[3..]) + place.of_sky(&self.fitted.sky).max(Vec3::ZERO) + self.sent[i]
    }

    /// How much a point counts that should look like `got`: less where its traced shadow may be mistaken.
    fn believed(&self, i: usize, place: &Place, got: Vec3, seen: Vec3) -> f32 {
        let facing = place.facing(Vec3::from_slice(&self.fitted.sun));
        if !self.has_sun() || facing < GRAZING {
            return 1.0;
        }
        let reach = (self.sunlit[i] / facing).clamp(0.0, 1.0);
        let is_darker = (seen - got).dot(LUMINANCE.into()) < 0.0;
        1.0 - (1.0 - DOUBTED) * if is_darker { reach } else { 1.0 - reach }
    }
}

/// Lights that explain how surfaces look in each of them, and the surfaces with their albedo. Both are found in turn; how bright albedo is,
/// and its tint, is chosen such that its brightest twentieth has a luminance of 0.7 and the lights together are white. `progress` receives
/// the share that is done. None after an interrupt.
pub fn tell_apart(
    seen: &[Seen],
    visibility: &Visibility,
    interrupt: &AtomicBool,
    progress: &mut dyn FnMut(f64),
) -> Option<(Vec<Fitted>, Surfaces)> {
    let lights = seen.first().map_or(0, |s| s.colors.len());
    let mean = |of: &dyn Fn(&Seen) -> Vec3| seen.iter().map(of).sum::<Vec3>() / seen.len().max(1) as f32;
    let means: Vec<Vec3> = (0..lights).map(|l| mean(&|s| s.colors[l]).max(Vec3::splat(1e-4))).collect();
    let mut surfaces = Surfaces::new(seen.iter().map(|s| (s.point, s.normal)), vec![Vec3::ZERO; seen.len()], visibility);
    // Before anything is known, closed places receive a share of what is seen.
    let open: Vec<f32> = surfaces.points.iter().map(|p| p.open).collect();
    let sent = |l: usize| open.iter().map(|o| (1.0 - o) * BOUNCED / FIRST_ALBEDO * means[l]).collect();
    let first_sent: Vec<Vec<Vec3>> = (0..lights).map(sent).collect();
    // What is seen in a light without a sun shows albedos best, and each may be such a light.
    let step = lights.div_ceil(TAKEN_FOR_EVEN).max(1);
    let begun: Vec<usize> = (0..lights).step_by(step).collect();
    let total = (begun.len() * (1 + BEGUN) + (ROUNDS - 1 + selection::most_settled(lights) + SURE) * SETTLING) as f64;
    let mut done = 0;
    let mut go_on = || {
        done += 1;
        progress(done as f64 / total);
        !interrupt.load(Ordering::Relaxed)
    };
    // Few planes look about as well in a sun that all lights share: whether there are suns, all points tell.
    let alike: Vec<Seen> = seen.iter().map(|s| Seen { is_flat: true, ..s.clone() }).collect();
    let mut best: Option<(f64, Vec<Guess>, Vec<Vec3>)> = None;
    for even in begun {
        surfaces.albedos = albedos_under(&alike, even, &open);
        let find = |l: usize, albedos: Vec<Vec3>| guess(&alike, &surfaces, visibility, albedos, l, &first_sent[l], None);
        let mut guesses: Vec<Guess> = (0..lights).map(|l| find(l, surfaces.albedos.clone())).collect();
        guesses[even] = find(even, explained(&alike, &surfaces, &guesses, Some(even)));
        if !go_on() || !settle(&alike, &mut surfaces, &mut guesses, BEGUN, &mut go_on) {
            return None;
        }
        let misfit = misfit(&alike, &surfaces, &guesses);
        if best.as_ref().is_none_or(|b| misfit < b.0) {
            best = Some((misfit, guesses, surfaces.albedos.clone()));
        }
    }
    let (_, mut guesses, albedos) = best?;
    surfaces.albedos = albedos;
    for round in 1..ROUNDS {
        // Shadows may still be in the albedos, so the suns are looked for once more.
        let again = |(l, g): (usize, &Guess)| {
            let near = (round > SEARCHED).then(|| Vec3::from_slice(&g.fitted.sun));
            let albedos = explained(&alike, &surfaces, &guesses, Some(l));
            guess(&alike, &surfaces, visibility, albedos, l, &g.sent, near)
        };
        guesses = guesses.iter().enumerate().map(again).collect();
        if !settle(&alike, &mut surfaces, &mut guesses, SETTLING, &mut go_on) {
            return None;
        }
    }
    let Told { mut guesses, mut surfaces, .. } = Selection { seen: &alike, visibility }.best(guesses, surfaces, &mut go_on)?;
    for _ in 0..SURE {
        let again = |(l, g): (usize, &Guess)| {
            if !g.has_sun() {
                return g.clone();
            }
            let albedos = explained(seen, &surfaces, &guesses, Some(l));
            guess(seen, &surfaces, visibility, albedos, l, &g.sent, Some(Vec3::from_slice(&g.fitted.sun)))
        };
        guesses = guesses.iter().enumerate().map(again).collect();
        if !settle(seen, &mut surfaces, &mut guesses, SETTLING, &mut go_on) {
            return None;
        }
    }
    Some((guesses.into_iter().map(|g| g.fitted).collect(), surfaces))
}

/// Albedos if one light were an even sky: what is seen over how open a surface is.
fn albedos_under(seen: &[Seen], light: usize, open: &[f32]) -> Vec<Vec3> {
    let plain: Vec<Vec3> = seen.iter().zip(open).map(|(s, o)| s.colors[light] / (o + BOUNCED * (1.0 - o))).collect();
    let by = FIRST_ALBEDO / (plain.iter().sum::<Vec3>() / plain.len().max(1) as f32).max(Vec3::splat(1e-4));
    plain.into_iter().map(|a| a * by).collect()
}

/// A light that explains what is seen best with given albedos, near a direction of the sun or anywhere.
fn guess(
    seen: &[Seen],
    surfaces: &Surfaces,
    visibility: &Visibility,
    albedos: Vec<Vec3>,
    light: usize,
    sent: &[Vec3],
    near: Option<Vec3>,
) -> Guess {
    let points = lit(seen, &albedos, light, sent, None, &surfaces.points);
    let fitted = fit(&points, surfaces, visibility, near);
    Guess { sunlit: surfaces.sunlit(visibility, Vec3::from_slice(&fitted.sun)), sent: sent.to_vec(), fitted }
}

/// Lets albedo and light approach each other a number of times, which they do slowly; meanwhile suns stay where they are. Ends early, with
/// false, once `go_on` says so.
fn settle(seen: &[Seen], surfaces: &mut Surfaces, guesses: &mut [Guess], times: usize, go_on: &mut dyn FnMut() -> bool) -> bool {
    for k in 0..times {
        surfaces.albedos = explained(seen, surfaces, guesses, None);
        set_scale(guesses, &mut surfaces.albedos);
        let refit = |(l, g): (usize, &mut Guess)| {
            let trusted = lit(seen, &surfaces.albedos, l, &g.sent, Some((g, EXPLAINED)), &surfaces.points);
            g.fitted = solve(&trusted, &surfaces.points, &g.sunlit, Vec3::from_slice(&g.fitted.sun));
            if k % SENT_AGAIN == 0 {
                let irradiance: Vec<Vec3> = surfaces.points.iter().enumerate().map(|(i, p)| g.irradiance(i, p)).collect();
                let radiosity = surfaces.radiosity(&irradiance);
                g.sent = surfaces.points.iter().map(|p| p.sent(&radiosity)).collect();
            }
        };
        guesses.par_iter_mut().enumerate().for_each(refit);
        if !go_on() {
            return false;
        }
    }
    true
}

/// How badly lights and albedos explain what is seen: mean of `e² / (e² + t²)` over points and lights, in sRGB.
fn misfit(seen: &[Seen], surfaces: &Surfaces, guesses: &[Guess]) -> f64 {
    let (mut sum, mut total) = (0.0, 1e-9);
    for (i, s) in seen.iter().enumerate() {
        for (l, (g, c)) in guesses.iter().zip(&s.colors).enumerate() {
            let place = &surfaces.points[i];
            let got = surfaces.albedos[i] * g.irradiance(i, place);
            let weight = (s.counts(l) * g.believed(i, place, got, *c)) as f64;
            sum += weight * (1.0 - trust(got, *c, TRUSTED).sqrt()) as f64;
            total += weight;
        }
    }
    sum / total
}

/// Surface points in one light, each trusted as an explanation of it says, with errors up to about the number beside it.
fn lit(seen: &[Seen], albedos: &[Vec3], light: usize, sent: &[Vec3], by: Option<(&Guess, f32)>, places: &[Place]) -> Vec<Lit> {
    let of = |(i, s): (usize, &Seen)| {
        let (albedo, color) = (albedos[i], s.colors[light]);
        let (got, trust) = by.map_or((color, 1.0), |(g, trusted)| {
            let got = albedo * g.irradiance(i, &places[i]);
            (got, trust(got, color, trusted) * g.believed(i, &places[i], got, color))
        });
        Lit { albedo, seen: color, sent: sent[i], trust: trust * s.tells(light), slope: slope(got, color) }
    };
    seen.iter().enumerate().map(of).collect()
}

/// Albedos that lights explain best, with one of the lights left out: what it casts is not in them then, and it can be looked for. The albedos
/// before say which lights to trust.
fn explained(seen: &[Seen], surfaces: &Surfaces, guesses: &[Guess], left_out: Option<usize>) -> Vec<Vec3> {
    let is_only = guesses.len() == 1;
    let of = |(i, s): (usize, &Seen)| {
        let before = surfaces.albedos[i];
        let (mut a, mut b) = (Vec3::ZERO, Vec3::splat(1e-6));
        for (l, (g, c)) in guesses.iter().zip(&s.colors).enumerate() {
            if left_out == Some(l) && !is_only {
                continue;
            }
            let place = &surfaces.points[i];
            let white = g.irradiance(i, place);
            let trusted = trust(before * white, *c, EXPLAINED) * g.believed(i, place, before * white, *c);
            let weight = slope(*c, *c).powf(2.0) * trusted * s.counts(l);
            (a, b) = (a + weight * white * *c, b + weight * white * white);
        }
        (a / b).max(Vec3::ZERO)
    };
    seen.par_iter().enumerate().map(of).collect()
}

/// Luminance of a color or coefficient.
pub fn gray(c: &[f32]) -> f32 {
    Vec3::from_slice(c).dot(LUMINANCE.into())
}

/// Shares brightness and tint between lights and albedos.
fn set_scale(guesses: &mut [Guess], albedos: &mut [Vec3]) {
    let light = guesses.iter().map(|g| level(&g.fitted.sun, &g.fitted.sky)).sum::<Vec3>().max(Vec3::splat(1e-6));
    let luminance = Vec3::from(LUMINANCE);
    let tint = light / light.dot(luminance);
    let mut bright: Vec<f32> = albedos.iter().map(|a| (*a * tint).dot(luminance)).collect();
    bright.sort_by(f32::total_cmp);
    let by = tint * BRIGHT / bright.get(bright.len() * 19 / 20).copied().unwrap_or(BRIGHT).max(1e-3);
    albedos.iter_mut().for_each(|a| *a *= by);
    for g in guesses {
        g.sent.iter_mut().for_each(|s| *s /= by);
        (0..3).for_each(|k| {
            g.fitted.sun[3 + k] /= by[k];
            (0..9).for_each(|i| g.fitted.sky[3 * i + k] /= by[k]);
        });
    }
}

/// Irradiance over π of a level surface in the open.
pub fn level(sun: &[f32], sky: &[f32]) -> Vec3 {
    let up = sh_light::basis(DVec3::Z);
    let above: Vec3 = (0..9).map(|i| up[i] as f32 * Vec3::from_slice(&sky[3 * i..])).sum();
    above.max(Vec3::ZERO) + Vec3::from_slice(&sun[3..]) * sun[2].max(0.0)
}

/// Spherical harmonics of a sun's light, `[9, 3]`.
pub fn harmonics(sun: &[f32]) -> [f32; 27] {
    let mut light = diorama_geom::sh_light::ShLight::DARK;
    let power = [3, 4, 5].map(|k| sun[k] as f64 * std::f64::consts::PI);
    light.add_sun(DVec3::from([0, 1, 2].map(|k| sun[k] as f64)), power);
    std::array::from_fn(|i| light.0[i / 3][i % 3] as f32)
}

/// The light of points. Without a direction to begin with, the whole sky is searched.
fn fit(lit: &[Lit], surfaces: &Surfaces, visibility: &Visibility, near: Option<Vec3>) -> Fitted {
    let step = lit.len().div_ceil(SEARCH_POINTS).max(1);
    let few: Vec<Lit> = lit.iter().step_by(step).copied().collect();
    let places: Vec<Place> = surfaces.points.iter().step_by(step).cloned().collect();
    let best_of = |directions: Vec<Vec3>| {
        let tried = directions.into_par_iter().map(|d| {
            let sunlit: Vec<f32> = places.iter().map(|p| p.sunlit(visibility, d)).collect();
            solve(&few, &places, &sunlit, d)
        });
        tried.reduce_with(|a, b| if b.error < a.error { b } else { a })
    };
    let all = || (0..CANDIDATES).map(|i| spread(i, CANDIDATES).as_vec3()).filter(|d| d.z > HORIZON).collect();
    let mut best = best_of(near.map_or_else(all, |d| vec![d])).expect("a direction");
    for radius in CIRCLES {
        let center = Vec3::new(best.sun[0], best.sun[1], best.sun[2]);
        let (a, b) = center.any_orthonormal_pair();
        let (sin, cos) = radius.sin_cos();
        let circle = (0..AROUND).map(|i| {
            let (y, x) = (i as f32 / AROUND as f32 * std::f32::consts::TAU).sin_cos();
            (cos * center + sin * (x * a + y * b)).normalize()
        });
        let next = best_of(circle.filter(|d| d.z > HORIZON).collect());
        if let Some(next) = next.filter(|n| n.error < best.error) {
            best = next;
        }
    }
    let direction = Vec3::from_slice(&best.sun);
    solve(lit, &surfaces.points, &surfaces.sunlit(visibility, direction), direction)
}

/// Slope of sRGB's curve between two linear values, of about its power: at what is seen alone, dark outliers would count most of all.
fn slope(a: Vec3, b: Vec3) -> Vec3 {
    let middle = 0.5 * (a.max(Vec3::ZERO) + b);
    Vec3::from(middle.max(Vec3::splat(DARK)).to_array().map(|v| 0.44 * v.powf(-0.58)))
}

/// How much a point counts that should look like another color (Geman–McClure in about sRGB), with errors up to about `trusted`.
fn trust(got: Vec3, seen: Vec3, trusted: f32) -> f32 {
    (trusted * trusted / (trusted * trusted + off(got, seen))).powi(2)
}

/// Squared difference of two colors in sRGB.
fn off(got: Vec3, seen: Vec3) -> f32 {
    let shown = |v: f32| srgb_from_linear(v.clamp(0.0, 1.0));
    (0..3).map(|k| (shown(got[k]) - shown(seen[k])).powi(2)).sum()
}

#[cfg(test)]
#[path = "sun_tests.rs"]
mod tests;
