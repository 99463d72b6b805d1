//! Seasons and climates as moments: five styles that need no image.
//!
//! Each is a procedural distribution of colors: a palette of surfaces and sky with their shares of the picture, each of which light and
//! shade scale. Its mean and covariance are computed from that. Details are like those measured in photographs: their deviation grows 2.5
//! times with each level, they follow brightness more than hue, and diagonal ones are weaker. Palettes were chosen by eye, and judged on
//! photographs of a street and of a room.

use super::haar::LEVELS;
use super::transfer::{DETAIL, Moments};
use nalgebra::{SMatrix, SVector};

/// Deviation of a surface's hue, apart from light and shade.
const HUE_SPREAD: f64 = 0.012;
/// Deviation of a level's details over that of the next finer one.
const GROWTH: f64 = 2.5;
/// Share of details' variance that follows brightness; the rest is spread over all colors.
const GRAY_SHARE: f64 = 0.9;
/// Variance of diagonal details over that of the others.
const DIAGONAL_SHARE: f64 = 0.12;

/// A season or climate.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Preset {
    /// Brown and orange leaves under a pale sky.
    Autumn,
    /// Snow, its blue shade, and bare trees.
    Winter,
    /// Blue darkness with few warm lamps.
    Night,
    /// Gray light of low contrast on wet ground.
    Rain,
    /// Low golden sun and violet shade.
    Evening,
}

/// A color of a palette.
struct Paint {
    srgb: [f64; 3],
    /// Share of the picture.
    share: f64,
    /// Deviation of light and shade, as a factor.
    shade: f64,
}

const fn paint(srgb: [f64; 3], share: f64, shade: f64) -> Paint {
    Paint { srgb, share, shade }
}

const AUTUMN: [Paint; 5] = [
    paint([0.47, 0.31, 0.16], 0.30, 0.35),
    paint([0.76, 0.50, 0.20], 0.25, 0.20),
    paint([0.58, 0.24, 0.14], 0.10, 0.30),
    paint([0.28, 0.25, 0.18], 0.15, 0.40),
    paint([0.80, 0.82, 0.86], 0.20, 0.08),
];
const WINTER: [Paint; 5] = [
    paint([0.86, 0.89, 0.93], 0.38, 0.05),
    paint([0.68, 0.74, 0.83], 0.25, 0.10),
    paint([0.40, 0.42, 0.46], 0.20, 0.25),
    paint([0.26, 0.27, 0.31], 0.12, 0.30),
    paint([0.78, 0.84, 0.92], 0.05, 0.05),
];
const NIGHT: [Paint; 4] = [
    paint([0.11, 0.13, 0.22], 0.45, 0.30),
    paint([0.18, 0.20, 0.31], 0.33, 0.25),
    paint([0.29, 0.30, 0.39], 0.18, 0.20),
    paint([0.62, 0.52, 0.38], 0.04, 0.20),
];
const RAIN: [Paint; 4] = [
    paint([0.42, 0.45, 0.49], 0.35, 0.20),
    paint([0.64, 0.67, 0.70], 0.30, 0.08),
    paint([0.27, 0.30, 0.32], 0.25, 0.30),
    paint([0.35, 0.42, 0.37], 0.10, 0.20),
];
const EVENING: [Paint; 5] = [
    paint([0.96, 0.76, 0.50], 0.25, 0.08),
    paint([0.80, 0.56, 0.37], 0.25, 0.20),
    paint([0.46, 0.32, 0.29], 0.25, 0.30),
    paint([0.24, 0.18, 0.23], 0.15, 0.40),
    paint([0.66, 0.54, 0.58], 0.10, 0.10),
];

impl Preset {
    pub const ALL: [Preset; 5] = [Preset::Autumn, Preset::Winter, Preset::Night, Preset::Rain, Preset::Evening];

    /// The name that users write.
    pub fn name(self) -> &'static str {
        match self {
            Preset::Autumn => "autumn",
            Preset::Winter => "winter",
            Preset::Night => "night",
            Preset::Rain => "rain",
            Preset::Evening => "evening",
        }
    }

    /// The style of a name, if there is one.
    pub fn named(name: &str) -> Option<Preset> {
        Preset::ALL.into_iter().find(|p| p.name() == name)
    }

    /// Moments of its distribution of colors, sRGB-encoded.
    pub fn moments(self) -> Moments {
        match self {
            Preset::Autumn => moments(&AUTUMN, 0.045),
            Preset::Winter => moments(&WINTER, 0.035),
            Preset::Night => moments(&NIGHT, 0.018),
            Preset::Rain => moments(&RAIN, 0.022),
            Preset::Evening => moments(&EVENING, 0.035),
        }
    }
}

/// Moments of a palette, with a deviation of the finest details.
fn moments(palette: &[Paint], detail: f64) -> Moments {
    let color = |p: &Paint| SVector::<f64, 3>::from(p.srgb);
    let mean: SVector<f64, 3> = palette.iter().map(|p| p.share * color(p)).sum();
    let mut low = SMatrix::<f64, 3, 3>::from_diagonal_element(HUE_SPREAD * HUE_SPREAD);
    for p in palette {
        let (away, shaded) = (color(p) - mean, p.shade * color(p));
        low += p.share * (away * away.transpose() + shaded * shaded.transpose());
    }
    let gray = mean.normalize();
    let of_colors = GRAY_SHARE * gray * gray.transpose() + SMatrix::<f64, 3, 3>::from_diagonal_element((1.0 - GRAY_SHARE) / 3.0);
    let level = |l: usize| {
        let variance = 3.0 * (detail * GROWTH.powi(l as i32)).powi(2);
        let band = |b: usize| variance * if b == 2 { DIAGONAL_SHARE } else { 1.0 };
        SMatrix::<f64, DETAIL, DETAIL>::from_fn(|i, j| if i / 3 == j / 3 { band(i / 3) * of_colors[(i % 3, j % 3)] } else { 0.0 })
    };
    let details: [_; LEVELS] = std::array::from_fn(level);
    Moments { mean, low, details }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shares_add_up_to_the_whole_picture() {
        for palette in [&AUTUMN[..], &WINTER, &NIGHT, &RAIN, &EVENING] {
            assert!((palette.iter().map(|p| p.share).sum::<f64>() - 1.0).abs() < 1e-9);
        }
    }
}
