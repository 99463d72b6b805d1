//! A clear sky and its sun: light scattered once by air and dust, and absorbed by ozone, in a spherical atmosphere.
//!
//! T. Nishita et al., "Display of the Earth Taking into Account Atmospheric Scattering", SIGGRAPH 1993, in 24 wavelengths. The medium
//! is that of E. Bruneton and F. Neyret, "Precomputed Atmospheric Scattering", EGSR 2008, with ozone as in Bruneton's revision of 2017.

use crate::environment::Environment;
use glam::DVec3;
use std::f64::consts::PI;
use std::sync::LazyLock;

/// Radii of the ground and of the top of the atmosphere, in metres.
const GROUND: f64 = 6.36e6;
const TOP: f64 = 6.42e6;
/// Heights over which the densities of air and dust fall by e, in metres.
const AIR_HEIGHT: f64 = 8000.0;
const DUST_HEIGHT: f64 = 1200.0;
/// Extinction by dust at sea level per metre, and how much of it is scattering.
const DUST: f64 = 5.328e-3 / DUST_HEIGHT;
const DUST_ALBEDO: f64 = 0.9;
/// Asymmetry of scattering by dust.
const FORWARD: f64 = 0.8;
/// Molecules of ozone per cubic metre where they are densest: 300 Dobson units in a tent of 15 km half width.
const OZONE: f64 = 300.0 * 2.687e20 / 15_000.0;
/// Wavelengths in nanometres: `FIRST + STEP · i`.
const FIRST: f64 = 385.0;
const STEP: f64 = 15.0;
const COUNT: usize = 24;
/// Steps along a view ray, and along a ray to the sun.
const STEPS: usize = 48;
const SUN_STEPS: usize = 24;

/// Irradiance of the sun outside the atmosphere from 360 to 830 nm in bins of 10 nm, in W m⁻² nm⁻¹ (ASTM G-173).
const SOLAR: [f64; 48] = [
    1.11776, 1.14259, 1.01249, 1.14716, 1.72765, 1.73054, 1.6887, 1.61253, 1.91198, 2.03474, 2.02042, 2.02212, 1.93377, 1.95809, 1.91686,
    1.8298, 1.8685, 1.8931, 1.85149, 1.8504, 1.8341, 1.8345, 1.8147, 1.78158, 1.7533, 1.6965, 1.68194, 1.64654, 1.6048, 1.52143, 1.55622,
    1.5113, 1.474, 1.4482, 1.41018, 1.36775, 1.34188, 1.31429, 1.28303, 1.26758, 1.2367, 1.2082, 1.18737, 1.14683, 1.12362, 1.1058,
    1.07124, 1.04992,
];

/// Absorption cross section of an ozone molecule at 233 K in the same bins, in 10⁻²⁵ m² (Serdyuchenko et al. 2014).
const ABSORPTION: [f64; 48] = [
    0.0118, 0.002182, 0.002818, 0.006636, 0.01527, 0.02763, 0.0552, 0.08451, 0.1582, 0.2316, 0.3669, 0.4924, 0.7752, 0.9016, 1.48, 1.602,
    2.139, 2.755, 3.091, 3.5, 4.266, 4.672, 4.398, 4.701, 5.019, 4.305, 3.74, 3.215, 2.662, 2.238, 1.852, 1.473, 1.209, 0.9423, 0.7455,
    0.6566, 0.5105, 0.415, 0.4228, 0.3237, 0.2451, 0.2801, 0.2534, 0.1624, 0.1465, 0.2078, 0.1383, 0.07105,
];

type Spectrum = [f64; COUNT];

/// A clear sky, with the horizontal plane at z = 0 and +z up.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sky {
    /// Height of the sun above the horizon in radians.
    pub elevation: f64,
    /// Direction of the sun in radians, from +y towards +x.
    pub azimuth: f64,
    /// Height above the sea in metres.
    pub altitude: f64,
    /// Densities relative to those of a clear day.
    pub air: f64,
    pub dust: f64,
    pub ozone: f64,
}

/// Wavelength of a sample in nanometres.
fn wavelength(i: usize) -> f64 {
    FIRST + STEP * i as f64
}

/// What of the medium depends on the wavelength, per metre of its reference density.
struct Spectra {
    /// Irradiance outside the atmosphere.
    solar: Spectrum,
    /// Scattering by air: proportional to `λ⁻⁴`.
    air: Spectrum,
    /// Absorption by ozone.
    ozone: Spectrum,
}

static SPECTRA: LazyLock<Spectra> = LazyLock::new(|| Spectra {
    solar: std::array::from_fn(|i| tabulated(&SOLAR, wavelength(i))),
    air: std::array::from_fn(|i| 1.24062e-6 * (1000.0 / wavelength(i)).powi(4)),
    ozone: std::array::from_fn(|i| OZONE * tabulated(&ABSORPTION, wavelength(i)) * 1e-25),
});

/// Value of a table of 10 nm bins at a wavelength.
fn tabulated(table: &[f64; 48], nanometres: f64) -> f64 {
    let x = ((nanometres - 365.0) / 10.0).clamp(0.0, 47.0);
    let i = (x as usize).min(46);
    table[i] + (table[i + 1] - table[i]) * (x - i as f64)
}

/// CIE 1931 color matching functions (Wyman, Sloan and Shirley 2013, multi-lobe fit).
fn matching(nanometres: f64) -> [f64; 3] {
    let lobe = |center: f64, left: f64, right: f64| {
        let t = (nanometres - center) / if nanometres < center { left } else { right };
        (-0.5 * t * t).exp()
    };
    [
        1.056 * lobe(599.8, 37.9, 31.0) + 0.362 * lobe(442.0, 16.0, 26.7) - 0.065 * lobe(501.1, 20.4, 26.2),
        0.821 * lobe(568.8, 46.9, 40.5) + 0.286 * lobe(530.9, 16.3, 31.1),
        1.217 * lobe(437.0, 11.8, 36.0) + 0.681 * lobe(459.0, 26.0, 13.8),
    ]
}

/// Linear RGB (Rec. 709 primaries) of a spectrum; what lies outside of its gamut is clipped.
fn rgb(spectrum: &Spectrum) -> [f64; 3] {
    let mut xyz = [0.0; 3];
    for (i, s) in spectrum.iter().enumerate() {
        let m = matching(wavelength(i));
        (0..3).for_each(|k| xyz[k] += s * m[k] * STEP);
    }
    let [x, y, z] = xyz;
    [3.2406 * x - 1.5372 * y - 0.4986 * z, -0.9689 * x + 1.8758 * y + 0.0415 * z, 0.0557 * x - 0.204 * y + 1.057 * z].map(|v| v.max(0.0))
}

/// Amounts of air, dust and ozone along a path, in metres of their reference density.
type Depth = [f64; 3];

impl Sky {
    /// Angular diameter of the sun in radians.
    pub const SUN_DIAMETER: f64 = 0.545 * PI / 180.0;

    /// A clear day at sea level with the sun at an elevation and an azimuth in radians.
    pub fn clear(elevation: f64, azimuth: f64) -> Sky {
        Sky { elevation, azimuth, altitude: 0.0, air: 1.0, dust: 1.0, ozone: 1.0 }
    }

    /// Direction to the sun.
    pub fn sun(&self) -> DVec3 {
        let (up, along) = self.elevation.sin_cos();
        DVec3::new(along * self.azimuth.sin(), along * self.azimuth.cos(), up)
    }

    /// Irradiance in linear RGB of a surface that faces the sun, from the sun alone; black below the horizon. Units as of [`Sky::radiance`].
    pub fn sun_irradiance(&self) -> [f64; 3] {
        match depth(self.eye(), self.sun(), SUN_STEPS * 4) {
            None => [0.0; 3],
            Some(depth) => rgb(&std::array::from_fn(|i| SPECTRA.solar[i] * self.transmittance(&SPECTRA, depth, i))),
        }
    }

    /// Radiance of the sky without the sun's disc from a direction of length 1, in linear RGB weighted by the CIE 1931 functions, in
    /// W m⁻² sr⁻¹. Below the horizon it is that of the horizon.
    pub fn radiance(&self, direction: DVec3) -> [f64; 3] {
        let level = DVec3::new(direction.x, direction.y, direction.z.max(0.0));
        let direction = if level.length() > 1e-9 { level.normalize() } else { DVec3::Y };
        rgb(&self.scattered(direction))
    }

    /// The sky above the horizon and its sun as a map `[height, 2 height, 3]`, black below. Pixels that the sun's disc touches share its light.
    pub fn environment(&self, height: usize) -> Environment {
        let mut map = Environment::from_fn(height, |d| if d.z >= 0.0 { self.radiance(d) } else { [0.0; 3] });
        if self.elevation > 0.0 {
            map.add_disc(self.sun(), Sky::SUN_DIAMETER, self.sun_irradiance());
        }
        map
    }

    fn eye(&self) -> DVec3 {
        DVec3::new(0.0, 0.0, GROUND + self.altitude.max(1.0))
    }

    /// Share of light of wavelength `i` that passes.
    fn transmittance(&self, spectra: &Spectra, depth: Depth, i: usize) -> f64 {
        (-(self.air * spectra.air[i] * depth[0] + self.dust * DUST * depth[1] + self.ozone * spectra.ozone[i] * depth[2])).exp()
    }

    /// Light scattered once towards the eye.
    fn scattered(&self, direction: DVec3) -> Spectrum {
        let (eye, sun, spectra) = (self.eye(), self.sun(), &*SPECTRA);
        let cosine = direction.dot(sun);
        let air_phase = 3.0 / (16.0 * PI) * (1.0 + cosine * cosine);
        let g = FORWARD;
        // Cornette and Shanks 1992.
        let dust_phase =
            3.0 / (8.0 * PI) * (1.0 - g * g) * (1.0 + cosine * cosine) / ((2.0 + g * g) * (1.0 + g * g - 2.0 * g * cosine).powf(1.5));
        let mut sum = [0.0; COUNT];
        let end = leaves(eye, direction, TOP);
        let mut before: Depth = [0.0; 3];
        // Steps are short near the eye, where the medium is dense.
        for step in 0..STEPS {
            let border = |i: usize| end * (i as f64 / STEPS as f64).powi(2);
            let (from, to) = (border(step), border(step + 1));
            let p = eye + direction * (0.5 * (from + to));
            let here = densities(p.length() - GROUND).map(|d| d * (to - from));
            let middle: Depth = std::array::from_fn(|k| before[k] + 0.5 * here[k]);
            if let Some(to_sun) = depth(p, sun, SUN_STEPS) {
                let path = std::array::from_fn(|k| middle[k] + to_sun[k]);
                for (i, s) in sum.iter_mut().enumerate() {
                    let scattered = self.air * spectra.air[i] * here[0] * air_phase + self.dust * DUST * DUST_ALBEDO * here[1] * dust_phase;
                    *s += spectra.solar[i] * scattered * self.transmittance(spectra, path, i);
                }
            }
            before = std::array::from_fn(|k| before[k] + here[k]);
        }
        sum
    }
}

/// Relative densities of air, dust and ozone at a height.
fn densities(height: f64) -> [f64; 3] {
    let tent = 1.0 - (height - 25_000.0).abs() / 15_000.0;
    [(-height / AIR_HEIGHT).exp(), (-height / DUST_HEIGHT).exp(), tent.max(0.0)]
}

/// Distance at which a ray from inside leaves a sphere around the origin.
fn leaves(p: DVec3, direction: DVec3, radius: f64) -> f64 {
    let b = p.dot(direction);
    -b + (b * b - p.length_squared() + radius * radius).max(0.0).sqrt()
}

/// Depth of the atmosphere from a point outwards; none if the ground is in the way.
fn depth(p: DVec3, direction: DVec3, steps: usize) -> Option<Depth> {
    let b = p.dot(direction);
    let nearest = p.length_squared() - b * b;
    if b < 0.0 && nearest < GROUND * GROUND {
        return None;
    }
    let end = leaves(p, direction, TOP);
    let mut sum = [0.0; 3];
    for step in 0..steps {
        let border = |i: usize| end * (i as f64 / steps as f64).powi(2);
        let (from, to) = (border(step), border(step + 1));
        let here = densities((p + direction * (0.5 * (from + to))).length() - GROUND);
        (0..3).for_each(|k| sum[k] += here[k] * (to - from));
    }
    Some(sum)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn degrees(elevation: f64) -> Sky {
        Sky::clear(elevation.to_radians(), 0.0)
    }

    #[test]
    fn vertical_depths_are_those_of_the_literature() {
        let depth = depth(DVec3::new(0.0, 0.0, GROUND + 1.0), DVec3::Z, 2000).unwrap();
        let at = |nanometres: f64| ((nanometres - FIRST) / STEP).round() as usize;
        // Bodhaine et al. 1999: 0.0973 at 550 nm for 1013 hPa, by a scale height of 8.0 km instead of the standard atmosphere's.
        assert!((SPECTRA.air[at(550.0)] * depth[0] - 0.1085).abs() < 0.006, "{}", SPECTRA.air[at(550.0)] * depth[0]);
        // 300 Dobson units × 5.0e-25 m² at 600 nm.
        assert!((SPECTRA.ozone[at(600.0)] * depth[2] - 0.0395).abs() < 0.002, "{}", SPECTRA.ozone[at(600.0)] * depth[2]);
        assert!((DUST * depth[1] - 5.328e-3).abs() < 1e-5);
    }

    #[test]
    fn daylight_is_blue_above_and_red_at_dusk() {
        let noon = degrees(60.0);
        let [r, g, b] = noon.radiance(DVec3::Z);
        assert!(b > 1.3 * g && g > 1.3 * r, "{r} {g} {b}");
        // A white surface under the sun outside the atmosphere gets 106.9 · 1.85 weighted W/m².
        let [r, g, b] = noon.sun_irradiance();
        assert!(g > 130.0 && g < 200.0 && r > g && g > b, "{r} {g} {b}");
        let dusk = degrees(2.0);
        let [r, g, b] = dusk.sun_irradiance();
        assert!(r > 2.0 * g && g > 2.0 * b, "{r} {g} {b}");
        let toward = DVec3::new(0.0, 1.0, 0.05).normalize();
        let [r, _, b] = dusk.radiance(toward);
        assert!(r > b, "{r} {b}");
        assert_eq!(degrees(-1.0).sun_irradiance(), [0.0; 3]);
        let night = degrees(-30.0).radiance(DVec3::Z);
        assert!(night.iter().all(|v| *v < 1e-6 * noon.radiance(DVec3::Z)[2]), "{night:?}");
    }

    #[test]
    fn the_sky_dims_with_the_sun_and_is_brightest_near_it() {
        let mean = |sky: &Sky| {
            let mut sum = 0.0;
            let map = Environment::from_fn(16, |d| if d.z > 0.0 { sky.radiance(d) } else { [0.0; 3] });
            map.for_each_pixel(|d, solid, radiance| sum += radiance[1] * solid * d.z.max(0.0));
            sum
        };
        let by_elevation: Vec<f64> = [60.0, 30.0, 10.0, 0.0, -4.0].iter().map(|e| mean(&degrees(*e))).collect();
        assert!(by_elevation.windows(2).all(|w| w[0] > w[1]), "{by_elevation:?}");
        // Of what reaches the ground on a clear day, about a tenth comes from the sky.
        let direct = degrees(60.0).sun_irradiance()[1] * 60f64.to_radians().sin();
        let share = by_elevation[0] / (by_elevation[0] + direct);
        assert!((0.05..0.2).contains(&share), "{share}");
        let sky = degrees(30.0);
        let beside = |angle: f64| sky.radiance(DVec3::new(0.0, (0.52 + angle).cos(), (0.52 + angle).sin()))[1];
        assert!(beside(0.1) > beside(0.3) && beside(0.3) > beside(0.8), "brighter near the sun");
    }

    #[test]
    fn the_azimuth_turns_the_sky_and_the_map_holds_the_sun() {
        let sky = Sky { azimuth: 0.9, ..degrees(35.0) };
        let d = DVec3::new(0.3, 0.5, 0.4).normalize();
        // From +y towards +x is clockwise, seen from above.
        let turned = glam::DQuat::from_rotation_z(-0.9) * d;
        let (a, b) = (degrees(35.0).radiance(d), sky.radiance(turned));
        assert!((0..3).all(|k| (a[k] - b[k]).abs() < 1e-9 * a[k]), "{a:?} {b:?}");
        let map = sky.environment(64);
        let mut near = [0.0; 3];
        map.for_each_pixel(|d, solid, radiance| {
            if d.dot(sky.sun()) > 0.99 {
                let sky = sky.radiance(d);
                (0..3).for_each(|k| near[k] += (radiance[k] - sky[k]) * solid);
            }
        });
        let want = sky.sun_irradiance();
        assert!((0..3).all(|k| (near[k] / want[k] - 1.0).abs() < 1e-3), "{near:?} {want:?}");
    }
}
