//! The light of a photograph that shows surfaces of known albedo.

use super::{BOUNCED, FIRST_ALBEDO, Fitted, Guess, Place, SEARCHED, Seen, Surfaces, TRUSTED, fit, lit, misfit, off, slope, solve};
use crate::relight::outdoor::visibility::Visibility;
use diorama_geom::glam::Vec3;
use std::sync::atomic::{AtomicBool, Ordering};

/// Linear value of a channel from which on a photograph is overexposed.
const OVEREXPOSED: f32 = 0.97;
/// Factor by which a photograph may be explained worse without a sun for it to have none.
const NO_WORSE: f64 = 1.01;
/// Times that the light of a photograph and what surfaces send are found in turn.
const PHOTOGRAPH_ROUNDS: usize = 10;
/// Errors up to so many times their median are trusted: who stands before the place may be more than the place.
const MEDIANS: f32 = 2.0;

/// A surface point in one photograph, with what a model knows of it.
#[derive(Clone, Copy, Debug)]
pub struct Shown {
    pub point: Vec3,
    pub normal: Vec3,
    pub albedo: Vec3,
    /// Share that arrives of a sun whose traced ray passes.
    pub share: f32,
    /// Linear.
    pub color: Vec3,
}

/// The light of a photograph that shows surfaces of known albedo, among surfaces that send light to them; without a sun where one explains
/// hardly more. None after an interrupt.
pub fn of_photograph(shown: &[Shown], around: &Surfaces, visibility: &Visibility, interrupt: &AtomicBool) -> Option<Fitted> {
    let albedos: Vec<Vec3> = shown.iter().map(|s| s.albedo).collect();
    let mut places = Surfaces::new(shown.iter().map(|s| (s.point, s.normal)), albedos.clone(), visibility);
    places.points.iter_mut().zip(shown).for_each(|(p, s)| p.share = s.share);
    let seen: Vec<Seen> =
        shown.iter().map(|s| Seen { point: s.point, normal: s.normal, colors: vec![s.color], shown: vec![true], is_flat: true }).collect();
    let mean = shown.iter().map(|s| s.color).sum::<Vec3>() / shown.len().max(1) as f32;
    let sent_first = |p: &Place| (1.0 - p.open) * BOUNCED / FIRST_ALBEDO * mean;
    let mut sent: Vec<Vec3> = places.points.iter().map(sent_first).collect();
    // What is overexposed says that there is at least so much light.
    let counting = |found: &Option<Guess>, sent: &[Vec3]| {
        let by = found.as_ref().map(|g| {
            let error = |(i, s): (usize, &Shown)| off(s.albedo * g.irradiance(i, &places.points[i]), s.color).sqrt();
            (g, TRUSTED.max(MEDIANS * median(shown.iter().enumerate().map(error))))
        });
        let mut points = lit(&seen, &albedos, 0, sent, by, &places.points);
        if found.is_none() {
            // As bright as the place is on the median, before its light is known.
            let light = median(shown.iter().map(|s| s.color.element_sum() / s.albedo.element_sum().max(1e-3)));
            points.iter_mut().for_each(|p| p.slope = slope(light * p.albedo, p.seen));
        }
        for (i, p) in points.iter_mut().enumerate().filter(|(_, p)| p.seen.max_element() > OVEREXPOSED) {
            let is_reached = |g: &Guess| (p.albedo * g.irradiance(i, &places.points[i])).max_element() >= p.seen.max_element();
            p.trust *= found.as_ref().is_none_or(|g| !is_reached(g)) as u8 as f32;
        }
        points
    };
    let mut found: Option<Guess> = None;
    for round in 0..PHOTOGRAPH_ROUNDS {
        if interrupt.load(Ordering::Relaxed) {
            return None;
        }
        let points = counting(&found, &sent);
        let near = found.as_ref().filter(|_| round > SEARCHED).map(|g| Vec3::from_slice(&g.fitted.sun));
        let fitted = fit(&points, &places, visibility, near);
        let ambient = around.light(visibility, &fitted.sun, &fitted.sky);
        sent = places.points.iter().map(|p| p.sent(&ambient.radiosity)).collect();
        found = Some(Guess { sunlit: places.sunlit(visibility, Vec3::from_slice(&fitted.sun)), sent: sent.clone(), fitted });
    }
    let points = counting(&found, &sent);
    let found = found?;
    let none = vec![0.0; shown.len()];
    let fitted = solve(&points, &places.points, &none, Vec3::from_slice(&found.fitted.sun));
    let without = Guess { sunlit: none, sent, fitted };
    let is_needed =
        misfit(&seen, &places, std::slice::from_ref(&without)) > NO_WORSE * misfit(&seen, &places, std::slice::from_ref(&found));
    Some(if is_needed { found } else { without }.fitted)
}

fn median(values: impl Iterator<Item = f32>) -> f32 {
    let mut values: Vec<f32> = values.collect();
    values.sort_by(f32::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(0.0)
}
