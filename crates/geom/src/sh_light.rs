//! Distant light as spherical harmonics of degree 2 (Ramamoorthi and Hanrahan 2001), and what it does to diffuse surfaces.

use crate::color::luminance;
use crate::environment::Environment;
use glam::{DMat3, DVec3};
use std::f64::consts::{FRAC_PI_4, PI};

/// Factors of the nine real spherical harmonics, in the order of [`basis`].
const FACTORS: [f64; 9] = [
    0.282_094_791_773_878_14,
    0.488_602_511_902_919_9,
    0.488_602_511_902_919_9,
    0.488_602_511_902_919_9,
    1.092_548_430_592_079_2,
    1.092_548_430_592_079_2,
    0.315_391_565_252_520_05,
    1.092_548_430_592_079_2,
    0.546_274_215_296_039_6,
];

/// Factors of a band under convolution with the clamped cosine, for bands 0 to 2: `A_l` of Ramamoorthi and Hanrahan.
const COSINE: [f64; 3] = [PI, 2.0 * PI / 3.0, FRAC_PI_4];

/// Band of each coefficient.
const BANDS: [usize; 9] = [0, 1, 1, 1, 2, 2, 2, 2, 2];

/// The real spherical harmonics up to degree 2 in a direction of length 1: of 1, y, z, x, xy, yz, 3z² − 1, xz and x² − y².
pub fn basis(n: DVec3) -> [f64; 9] {
    let DVec3 { x, y, z } = n;
    let monomials = [1.0, y, z, x, x * y, y * z, 3.0 * z * z - 1.0, x * z, x * x - y * y];
    std::array::from_fn(|i| FACTORS[i] * monomials[i])
}

/// Derivatives of [`basis`] with respect to the direction, as if its polynomials went on beyond the unit sphere.
pub fn basis_gradient(n: DVec3) -> [DVec3; 9] {
    let DVec3 { x, y, z } = n;
    let v = DVec3::new;
    let monomials = [
        v(0.0, 0.0, 0.0),
        v(0.0, 1.0, 0.0),
        v(0.0, 0.0, 1.0),
        v(1.0, 0.0, 0.0),
        v(y, x, 0.0),
        v(0.0, z, y),
        v(0.0, 0.0, 6.0 * z),
        v(z, 0.0, x),
        v(2.0 * x, -2.0 * y, 0.0),
    ];
    std::array::from_fn(|i| FACTORS[i] * monomials[i])
}

/// Light that reaches all points alike: coefficients `[9, RGB]` whose product with [`basis`] of a normal is the linear radiance that a white
/// diffuse surface reflects (its irradiance divided by π).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ShLight(pub [[f64; 3]; 9]);

impl ShLight {
    pub const DARK: ShLight = ShLight([[0.0; 3]; 9]);

    /// The same radiance from all directions.
    pub fn uniform(radiance: [f64; 3]) -> ShLight {
        let mut light = ShLight::DARK;
        light.0[0] = radiance.map(|r| r / FACTORS[0]);
        light
    }

    /// Light of an environment map: `L_lm = A_l / π ∫ Y_lm E dω`, pixel by pixel.
    pub fn of(environment: &Environment) -> ShLight {
        let mut light = ShLight::DARK;
        environment.for_each_pixel(|direction, solid_angle, radiance| {
            light.add_sun(direction, radiance.map(|r| r * solid_angle));
        });
        light
    }

    /// Environment map `[height, 2 height, 3]` of the smoothest light that shades as this does; black where that would be negative.
    pub fn environment(&self, height: usize) -> Environment {
        Environment::from_fn(height, |d| {
            let basis = basis(d);
            std::array::from_fn(|k| (0..9).map(|i| self.0[i][k] * basis[i] * PI / COSINE[BANDS[i]]).sum::<f64>().max(0.0))
        })
    }

    /// Adds a distant sun in a direction of length 1 that gives a surface facing it the irradiance `E`, linear RGB.
    ///
    /// A white surface then reflects `E / π (3/32 + c/2 + 15 c² / 32)` for the cosine `c` of its angle to the sun, in place of `E / π max(c, 0)`.
    pub fn add_sun(&mut self, direction: DVec3, irradiance: [f64; 3]) {
        let basis = basis(direction);
        for (i, c) in self.0.iter_mut().enumerate() {
            let weight = COSINE[BANDS[i]] / PI * basis[i];
            (0..3).for_each(|k| c[k] += weight * irradiance[k]);
        }
    }

    /// Linear radiance that a white diffuse surface with this normal (of length 1) reflects; can be slightly negative.
    pub fn shade(&self, normal: DVec3) -> [f64; 3] {
        let basis = basis(normal);
        std::array::from_fn(|k| self.0.iter().zip(basis).map(|(c, b)| c[k] * b).sum())
    }

    /// The light after a rotation of its sources: it shades `rotation · n` as the original shades `n`.
    pub fn rotated(&self, rotation: DMat3) -> ShLight {
        let mut out = *self;
        for k in 0..3 {
            let c: [f64; 9] = std::array::from_fn(|i| self.0[i][k] * FACTORS[i]);
            // Band 1 is a vector, band 2 a symmetric matrix without trace: v · n and nᵀ Q n.
            let v = rotation * DVec3::new(c[3], c[1], c[2]);
            let [xy, yz, zz, xz, xx_yy] = [c[4] / 2.0, c[5] / 2.0, c[6], c[7] / 2.0, c[8]];
            let q = DMat3::from_cols(DVec3::new(xx_yy - zz, xy, xz), DVec3::new(xy, -xx_yy - zz, yz), DVec3::new(xz, yz, 2.0 * zz));
            let q = rotation * q * rotation.transpose();
            let turned = [
                c[0],
                v.y,
                v.z,
                v.x,
                2.0 * q.y_axis.x,
                2.0 * q.y_axis.z,
                q.z_axis.z / 2.0,
                2.0 * q.x_axis.z,
                (q.x_axis.x - q.y_axis.y) / 2.0,
            ];
            (0..9).for_each(|i| out.0[i][k] = turned[i] / FACTORS[i]);
        }
        out
    }

    /// `strength` times as bright.
    pub fn scaled(&self, strength: f64) -> ShLight {
        ShLight(self.0.map(|c| c.map(|c| c * strength)))
    }

    /// The light between this one (`t = 0`) and another (`t = 1`), for time lapses.
    pub fn mix(&self, other: &ShLight, t: f64) -> ShLight {
        ShLight(std::array::from_fn(|i| std::array::from_fn(|k| (1.0 - t) * self.0[i][k] + t * other.0[i][k])))
    }

    /// Direction from which most light comes, by luminance, for a first guess of the sun; none for light without direction.
    pub fn brightest(&self) -> Option<DVec3> {
        let [y, z, x] = [1, 2, 3].map(|i| luminance(self.0[i]));
        DVec3::new(x, y, z).try_normalize()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gradients_of_the_basis_equal_differences() {
        let (n, step) = (DVec3::new(0.3, -0.7, 0.5), 1e-5);
        let got = basis_gradient(n);
        for (axis, along) in [DVec3::X, DVec3::Y, DVec3::Z].into_iter().enumerate() {
            let (up, down) = (basis(n + step * along), basis(n - step * along));
            for i in 0..9 {
                assert!((got[i][axis] - (up[i] - down[i]) / (2.0 * step)).abs() < 1e-9, "{i} {axis}");
            }
        }
    }

    #[test]
    fn light_s_environment_shades_as_the_light() {
        let mut light = ShLight::uniform([0.5, 0.6, 0.7]);
        light.0[2] = [0.1, 0.0, -0.1];
        light.0[4] = [0.05; 3];
        let back = ShLight::of(&light.environment(256));
        for (a, b) in light.0.iter().flatten().zip(back.0.iter().flatten()) {
            assert!((a - b).abs() < 2e-3, "{a} {b}");
        }
    }
    use crate::rng::Rng;
    use glam::DQuat;

    fn directions(n: u64) -> impl Iterator<Item = DVec3> {
        let rng = Rng::new(7, 0);
        (0..n).map(move |i| {
            let [a, b, c] = [0, 1, 2].map(|k| rng.normal(3 * i + k) as f64);
            DVec3::new(a, b, c).normalize()
        })
    }

    fn some_light() -> ShLight {
        let rng = Rng::new(8, 0);
        ShLight(std::array::from_fn(|i| std::array::from_fn(|k| rng.normal((3 * i + k) as u64) as f64)))
    }

    fn rotation() -> DMat3 {
        DMat3::from_quat(DQuat::from_euler(glam::EulerRot::XYZ, 0.4, -1.1, 2.0))
    }

    fn assert_near(a: [f64; 3], b: [f64; 3], tolerance: f64) {
        assert!((0..3).all(|k| (a[k] - b[k]).abs() <= tolerance), "{a:?} and {b:?} differ by more than {tolerance}");
    }

    #[test]
    fn the_basis_is_orthonormal() {
        let mut sums = [[0.0; 9]; 9];
        Environment::uniform([1.0; 3], 64).for_each_pixel(|d, solid_angle, _| {
            let b = basis(d);
            (0..9).for_each(|i| (0..9).for_each(|j| sums[i][j] += b[i] * b[j] * solid_angle));
        });
        for (i, row) in sums.iter().enumerate() {
            for (j, sum) in row.iter().enumerate() {
                assert!((sum - (i == j) as u8 as f64).abs() < 2e-3, "{i} {j}: {sum}");
            }
        }
    }

    #[test]
    fn a_band_limited_map_is_recovered() {
        let light = some_light();
        // Radiance whose projection is `light`.
        let radiance = ShLight(std::array::from_fn(|i| light.0[i].map(|c| c * PI / COSINE[BANDS[i]])));
        let map = Environment::from_fn(512, |d| {
            // Radiance is not negative.
            radiance.shade(d).map(|r| r + 20.0)
        });
        let mut found = ShLight::of(&map);
        let offset = ShLight::uniform([20.0; 3]);
        (0..9).for_each(|i| (0..3).for_each(|k| found.0[i][k] -= offset.0[i][k]));
        for (a, b) in found.0.iter().zip(light.0) {
            assert_near(*a, b, 1e-4);
        }
    }

    #[test]
    fn a_rotated_light_shades_rotated_normals_alike() {
        let (light, turn) = (some_light(), rotation());
        let turned = light.rotated(turn);
        for n in directions(100) {
            assert_near(turned.shade(turn * n), light.shade(n), 1e-12);
        }
        let norm = |l: &ShLight| l.0.iter().flatten().map(|c| c * c).sum::<f64>();
        assert!((norm(&turned) - norm(&light)).abs() < 1e-12 * norm(&light), "a rotation is orthogonal");
        assert!((turned.0[4][0] - light.0[4][0]).abs() > 1e-2, "and changes the light");
    }

    #[test]
    fn rotation_equals_resampling() {
        let turn = rotation();
        let radiance = |d: DVec3| [1.0 + d.x * d.y, 1.5 + d.z * d.z * d.z, 2.0 + d.x - d.y];
        let map = Environment::from_fn(512, radiance);
        let resampled = Environment::from_fn(512, |d| radiance(turn.transpose() * d));
        let (a, b) = (ShLight::of(&map).rotated(turn), ShLight::of(&resampled));
        for (a, b) in a.0.iter().zip(b.0) {
            assert_near(*a, b, 1e-5);
        }
    }

    #[test]
    fn a_sun_shades_as_its_polynomial() {
        let sun = DVec3::new(0.3, -0.5, 0.8).normalize();
        let mut light = ShLight::DARK;
        light.add_sun(sun, [PI, 2.0 * PI, 0.0]);
        for n in directions(100) {
            let c = n.dot(sun);
            let want = 3.0 / 32.0 + c / 2.0 + 15.0 / 32.0 * c * c;
            assert_near(light.shade(n), [want, 2.0 * want, 0.0], 1e-12);
        }
        assert!((light.brightest().unwrap() - sun).length() < 1e-12);
        assert_eq!(ShLight::uniform([1.0; 3]).brightest(), None);
    }

    #[test]
    fn uniform_light_shades_all_normals_alike() {
        let light = ShLight::of(&Environment::uniform([0.25, 0.5, 1.0], 256));
        for n in directions(20) {
            assert_near(light.shade(n), [0.25, 0.5, 1.0], 1e-5);
            assert_near(ShLight::uniform([0.25, 0.5, 1.0]).mix(&light.scaled(3.0), 0.5).shade(n), [0.5, 1.0, 2.0], 1e-5);
        }
    }
}
