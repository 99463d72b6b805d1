//! Differences of exposure and light between training photographs, measured by the colors of places that several show, and their
//! correction.

use super::config::Auto;
use super::model::ObjectModel;
use crate::error::Result;
use crate::run::prepare::finish::exposure::gains;
use diorama_engine::samplers::pixels::{Observation, PixelSource};
use diorama_geom::color::linear_from_srgb;
use diorama_geom::glam::DVec3;
use diorama_kernels::ops::ray_generation::PosedCamera;
use rayon::prelude::*;

/// Standard deviation of the log exposures from which on each photograph has an appearance code, and the code's numbers.
const DIFFERS: f32 = 0.1;
const CODE: f32 = 8.0;

/// Most places that are asked, and in how many photographs besides their own: those that look from closest by, within so many degrees.
const PLACES: usize = 6000;
const OTHERS: usize = 4;
const ANGLE_DEG: f64 = 30.0;
/// Clipped colors, and those too dark to tell.
const RANGE: (f32, f32) = (0.03, 0.97);
/// Fewest places.
const FEWEST: usize = 200;

/// Log gains of training photographs, `[N][3]`; none where too few places are known, or where nobody asks.
pub(super) fn measure(source: &dyn PixelSource, model: &ObjectModel, known: &[Observation]) -> Option<Vec<[f32; 3]>> {
    let is_asked = model.config.field.appearance != Auto::Is(0.0);
    if is_asked { log_gains(source, &model.base_cameras(), known, model.is_linear()) } else { None }
}

/// Gives an untrained model appearance codes where the photographs' light differs and its configuration leaves that open; a note says so.
pub(super) fn settle_codes(mut model: ObjectModel, gains: Option<&[[f32; 3]]>) -> Result<(ObjectModel, Option<String>)> {
    if model.config.field.appearance != Auto::Auto {
        return Ok((model, None));
    }
    let Some(spread) = gains.map(spread).filter(|s| *s > DIFFERS) else {
        model.config.field.appearance = Auto::Is(0.0);
        return Ok((model, None));
    };
    let percent = 100.0 * spread;
    let note = format!(
        "exposure or light differ by {percent:.0} % between photographs: each wears an appearance code (--set field.appearance=0: none)"
    );
    let ObjectModel { mut config, capture, has_alpha, .. } = model;
    config.field.appearance = Auto::Is(CODE);
    Ok((ObjectModel::new(config, capture, has_alpha)?, Some(note)))
}

/// By what to multiply the light of each photograph so that all have the mean exposure: what codes then say is what differs beyond that,
/// and the mean code is that of a photograph of mean exposure.
pub(super) fn to_the_mean(gains: &[[f32; 3]]) -> Vec<[f32; 3]> {
    let mean = [0, 1, 2].map(|k| gains.iter().map(|g| g[k]).sum::<f32>() / gains.len() as f32);
    gains.iter().map(|g| [0, 1, 2].map(|k| (mean[k] - g[k]).exp())).collect()
}

/// Standard deviation (by the middle two thirds) of the photographs' log gains.
fn spread(gains: &[[f32; 3]]) -> f32 {
    let mut green: Vec<f32> = gains.iter().map(|g| g[1]).collect();
    green.sort_by(f32::total_cmp);
    let at = |share: f64| green[((green.len() - 1) as f64 * share).round() as usize];
    0.5 * (at(5.0 / 6.0) - at(1.0 / 6.0))
}

fn log_gains(source: &dyn PixelSource, cameras: &[PosedCamera], observations: &[Observation], is_linear: bool) -> Option<Vec<[f32; 3]>> {
    let step = observations.len().div_ceil(PLACES).max(1);
    let places: Vec<&Observation> = observations.iter().step_by(step).collect();
    if places.len() < FEWEST {
        return None;
    }
    let from_world: Vec<_> = cameras.iter().map(|c| c.pose.inverse()).collect();
    let shown = |o: &Observation| -> Vec<(usize, [f32; 3])> {
        let own = &cameras[o.image as usize];
        let (x, y) = (o.x as f64 + 0.5, o.y as f64 + 0.5);
        let p = own.pose.point(own.camera.direction(x, y) * o.distance as f64);
        let angle = |c: &PosedCamera| (c.pose.translation - p).angle_between(own.pose.translation - p).to_degrees();
        let mut others: Vec<(f64, usize)> = cameras.iter().map(angle).zip(0..).filter(|(a, _)| *a < ANGLE_DEG).collect();
        others.sort_by(|a, b| a.0.total_cmp(&b.0));
        let seen = |i: usize| {
            let q: DVec3 = from_world[i].point(p);
            let px = cameras[i].camera.project(q)?;
            color(source, i, px.x, px.y, is_linear).map(|c| (i, c))
        };
        // Its own photograph comes first, at no angle.
        others.into_iter().filter_map(|(_, i)| seen(i)).take(OTHERS + 1).collect()
    };
    let all: Vec<Vec<(usize, [f32; 3])>> = places.par_iter().map(|o| shown(o)).collect();
    let mut of_photographs = vec![Vec::new(); cameras.len()];
    for (id, place) in all.iter().enumerate() {
        place.iter().for_each(|(image, c)| of_photographs[*image].push((id as u64, *c)));
    }
    Some(gains(&of_photographs))
}

/// Log of the mean linear color of 3 x 3 pixels; none where it is clipped, dark, outside of the photograph, or does not count.
fn color(source: &dyn PixelSource, image: usize, x: f64, y: f64, is_linear: bool) -> Option<[f32; 3]> {
    let (w, h) = source.size(image);
    if !(1.0..w as f64 - 1.0).contains(&x) || !(1.0..h as f64 - 1.0).contains(&y) {
        return None;
    }
    let mut sum = [0.0f32; 3];
    for k in 0..9u32 {
        let (x, y) = source.snap(image, x as u32 + k % 3 - 1, y as u32 + k / 3 - 1);
        let c = source.rgba(image, x, y);
        if !source.counts(image, x, y) || c[..3].iter().any(|v| !(RANGE.0..=RANGE.1).contains(v)) {
            return None;
        }
        (0..3).for_each(|n| sum[n] += if is_linear { c[n] } else { linear_from_srgb(c[n]) } / 9.0);
    }
    Some(sum.map(f32::ln))
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_geom::{Camera, Pose};

    const SIZE: u32 = 64;

    /// A wall of slow waves that cameras on an arc photograph, each with its own log exposure; whether pixels are linear light.
    struct Wall(Vec<PosedCamera>, Vec<f32>, bool);

    impl Wall {
        fn new(exposure: fn(usize) -> f32) -> Wall {
            let posed = |i: usize| {
                let turn = (i as f64 - 6.0) * 0.08;
                let eye = DVec3::new(3.0 * turn.sin(), 0.0, 3.0 * turn.cos());
                PosedCamera { camera: Camera::pinhole(SIZE, SIZE, 0.6), pose: Pose::look_at(eye, DVec3::ZERO, DVec3::Y) }
            };
            Wall((0..12).map(posed).collect(), (0..12).map(exposure).collect(), false)
        }

        fn meets(&self, image: usize, x: f64, y: f64) -> (DVec3, f64) {
            let d = self.0[image].pose.rotation * self.0[image].camera.direction(x, y);
            let t = -self.0[image].pose.translation.z / d.z;
            (self.0[image].pose.translation + d * t, t)
        }

        fn gains(&self, places: u32) -> Option<Vec<[f32; 3]>> {
            let place = |k: u32| {
                let (image, x, y) = (k % 12, 4 + k * 37 % (SIZE - 8), 4 + k * 11 % (SIZE - 8));
                let (_, t) = self.meets(image as usize, x as f64 + 0.5, y as f64 + 0.5);
                Observation { image, x, y, distance: t as f32 }
            };
            log_gains(self, &self.0, &(0..places).map(place).collect::<Vec<_>>(), self.2)
        }

        fn spread(&self, places: u32) -> Option<f32> {
            self.gains(places).map(|g| spread(&g))
        }
    }

    impl PixelSource for Wall {
        fn images(&self) -> usize {
            self.0.len()
        }
        fn size(&self, _: usize) -> (u32, u32) {
            (SIZE, SIZE)
        }
        fn rgba(&self, image: usize, x: u32, y: u32) -> [f32; 4] {
            let (p, _) = self.meets(image, x as f64 + 0.5, y as f64 + 0.5);
            let light = (0.2 + 0.1 * (3.0 * p.x).sin() * (4.0 * p.y).cos()) as f32 * self.1[image].exp();
            let v = if self.2 { light } else { diorama_geom::color::srgb_from_linear(light) };
            [v, v, v, 1.0]
        }
        fn counts(&self, _: usize, _: u32, _: u32) -> bool {
            true
        }
    }

    #[test]
    fn exposures_that_differ_are_measured_and_equal_ones_are_not() {
        // One photograph in three is brighter or darker.
        let differing = Wall::new(|i| [0.0, 0.2, -0.2][i % 3]).spread(3000).unwrap();
        assert!((differing - 0.2).abs() < 0.02, "{differing}");
        let mut linear = Wall::new(|i| [0.0, 0.2, -0.2][i % 3]);
        linear.2 = true;
        let of_linear = linear.spread(3000).unwrap();
        assert!((of_linear - 0.2).abs() < 0.02, "{of_linear} in linear light");
        let equal = Wall::new(|_| 0.3).spread(3000).unwrap();
        assert!(equal < 0.01, "{equal}");
        assert_eq!(Wall::new(|_| 0.0).spread(FEWEST as u32 - 1), None, "too few places");
    }

    #[test]
    fn photographs_come_to_their_mean_exposure() {
        let exposure = |i: usize| [0.0, 0.3, -0.1][i % 3];
        let by = to_the_mean(&Wall::new(exposure).gains(3000).unwrap());
        let mean = 0.2 / 3.0;
        for (i, by) in by.iter().enumerate() {
            assert!(by.iter().all(|b| (b.ln() - (mean - exposure(i))).abs() < 0.03), "{i}: {by:?}");
        }
    }
}
