//! Distant light: an environment and, apart from it, a sun, whose shadows are sharp.

use crate::color::luminance;
use crate::environment::Environment;
use crate::sky::Sky;
use glam::DVec3;

/// Times the mean radiance from which a peak is a sun.
const PEAK: f64 = 50.0;
/// Angle around the peak in radians that belongs to it.
const GLARE: f64 = 0.09;

/// A distant disc of even radiance.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sun {
    /// Toward the center of the disc, of length 1.
    pub direction: DVec3,
    /// Angular diameter in radians.
    pub diameter: f64,
    /// Linear RGB that a surface facing the disc receives.
    pub irradiance: [f64; 3],
}

/// Light from all directions, and a sun in front of it.
#[derive(Clone, Debug, PartialEq)]
pub struct Daylight {
    pub environment: Environment,
    pub sun: Option<Sun>,
}

impl Sun {
    /// Solid angle in steradians.
    pub fn solid_angle(&self) -> f64 {
        // 1 − cos without cancellation.
        let s = (0.25 * self.diameter).sin();
        4.0 * std::f64::consts::PI * s * s
    }
}

impl Daylight {
    /// The light of a map without a separate sun.
    pub fn of(environment: Environment) -> Daylight {
        Daylight { environment, sun: None }
    }

    /// A clear sky as a map `[height, 2 height, 3]` with its sun apart; the ground below the horizon gives no light.
    pub fn clear(sky: &Sky, height: usize) -> Daylight {
        let environment = Environment::from_fn(height, |d| if d.z >= 0.0 { sky.radiance(d) } else { [0.0; 3] });
        let sun = Sun { direction: sky.sun(), diameter: Sky::SUN_DIAMETER, irradiance: sky.sun_irradiance() };
        Daylight { environment, sun: (sun.irradiance[1] > 0.0).then_some(sun) }
    }

    /// The same light with the sun of its map apart, where there is one: a peak that is at least `PEAK` times as bright as the mean. What
    /// lies within `GLARE` of it and is brighter than the ring around is the sun.
    pub fn sun_apart(self) -> Daylight {
        if self.sun.is_some() {
            return self;
        }
        let (mut peak, mut total) = ((0.0, DVec3::Z), 0.0);
        self.environment.for_each_pixel(|d, solid_angle, radiance| {
            let l = luminance(radiance);
            total += l * solid_angle;
            if l > peak.0 {
                peak = (l, d);
            }
        });
        if peak.0 < PEAK * total / (4.0 * std::f64::consts::PI) {
            return self;
        }
        let (mut ring, mut ring_angle) = ([0.0; 3], 0.0);
        self.environment.for_each_pixel(|d, solid_angle, radiance| {
            if (GLARE..2.0 * GLARE).contains(&d.angle_between(peak.1)) {
                (0..3).for_each(|k| ring[k] += solid_angle * radiance[k]);
                ring_angle += solid_angle;
            }
        });
        let around = ring.map(|v| v / f64::max(ring_angle, 1e-12));
        let (mut irradiance, mut toward) = ([0.0; 3], DVec3::ZERO);
        self.environment.for_each_pixel(|d, solid_angle, radiance| {
            if d.angle_between(peak.1) < GLARE {
                let more: [f64; 3] = std::array::from_fn(|k| (radiance[k] - around[k]).max(0.0) * solid_angle);
                (0..3).for_each(|k| irradiance[k] += more[k]);
                toward += luminance(more) * d;
            }
        });
        let environment = self.environment;
        let rest = Environment::from_fn(environment.image().height, |d| {
            let radiance = environment.radiance(d);
            if d.angle_between(peak.1) < GLARE { std::array::from_fn(|k| radiance[k].min(around[k])) } else { radiance }
        });
        let sun = Sun { direction: toward.normalize_or(peak.1), diameter: Sky::SUN_DIAMETER, irradiance };
        Daylight { environment: rest, sun: Some(sun) }
    }

    /// The light with its sources turned about +z by an angle in radians and scaled.
    pub fn turned(mut self, angle: f64, strength: f64) -> Daylight {
        self.environment.turn += angle;
        self.environment.strength *= strength;
        self.sun = self.sun.map(|s| Sun {
            direction: glam::DQuat::from_rotation_z(angle) * s.direction,
            irradiance: s.irradiance.map(|v| v * strength),
            ..s
        });
        self
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_disc_has_the_sun_s_solid_angle() {
        let sun = Sun { direction: DVec3::Z, diameter: 0.545f64.to_radians(), irradiance: [1.0; 3] };
        assert!((sun.solid_angle() / 7.106e-5 - 1.0).abs() < 1e-3, "{}", sun.solid_angle());
        let half = Sun { diameter: std::f64::consts::PI, ..sun };
        assert!((half.solid_angle() / std::f64::consts::TAU - 1.0).abs() < 1e-12);
    }

    #[test]
    fn the_sun_of_a_map_is_told_apart_and_an_even_sky_has_none() {
        let direction = DVec3::new(0.6, -0.3, 0.5).normalize();
        let mut map = Environment::from_fn(128, |d| if d.z > 0.0 { [0.3, 0.4, 0.6] } else { [0.1; 3] });
        assert_eq!(Daylight::of(map.clone()).sun_apart().sun, None);
        map.add_disc(direction, Sky::SUN_DIAMETER, [3.0, 2.8, 2.5]);
        let sun = Daylight::of(map).sun_apart();
        let found = sun.sun.unwrap();
        assert!(found.direction.angle_between(direction) < 0.03, "{}", found.direction);
        assert!((0..3).all(|k| (found.irradiance[k] - [3.0, 2.8, 2.5][k]).abs() < 0.05), "{:?}", found.irradiance);
        let left = sun.environment.radiance(direction);
        assert!((left[0] - 0.3).abs() < 0.05, "{left:?}");
    }

    #[test]
    fn a_turn_moves_sky_and_sun_together() {
        let sky = Sky::clear(0.6, 0.2);
        let (before, after) = (Daylight::clear(&sky, 64), Daylight::clear(&sky, 64).turned(0.9, 3.0));
        let turned = after.sun.unwrap().direction;
        // Counterclockwise from above lowers the azimuth.
        assert!((turned - Sky::clear(0.6, 0.2 - 0.9).sun()).length() < 1e-12, "{turned}");
        let (a, b) = (before.environment.radiance(sky.sun()), after.environment.radiance(turned));
        assert!((0..3).all(|k| (b[k] / a[k] - 3.0).abs() < 1e-3), "{a:?} {b:?}");
    }
}
