//! Where houses, trees, cars and lamps stand: the road runs along x, façades stand at y = ±11 and at both ends.

use diorama_geom::glam::{DVec3, dvec3};
use diorama_geom::rng::Rng;
use std::f64::consts::PI;

/// Height of the pavement over the road in meters.
pub const PAVEMENT: f64 = 0.12;

/// Distance of the façades from the middle of the road in meters.
pub const FACADE: f64 = 11.0;

/// Depth of houses in meters.
pub const DEPTH: f64 = 9.0;

/// End of the street on both sides in meters.
pub const END: f64 = 30.0;

/// Something at a place: position and angle about the vertical axis.
#[derive(Clone, Copy, Debug)]
pub struct Place {
    pub at: DVec3,
    pub angle: f64,
    /// Which of its kind it is.
    pub kind: usize,
    pub size: f64,
}

/// An upright cylinder that no camera may enter.
#[derive(Clone, Copy, Debug)]
pub struct Obstacle {
    pub at: DVec3,
    pub radius: f64,
    pub z: [f64; 2],
}

/// All places of one street.
#[derive(Clone, Debug)]
pub struct Layout {
    pub cars: Vec<Place>,
    pub trees: Vec<Place>,
    pub lamps: Vec<Place>,
    pub benches: Vec<Place>,
    pub bollards: Vec<Place>,
    pub fountain: DVec3,
}

impl Layout {
    /// The layout of a seed: cars stand, turn and are painted differently; trees differ in size.
    pub fn new(seed: u64) -> Layout {
        let rng = Rng::new(seed, 81);
        let uniform = |k: u64, lo: f64, hi: f64| lo + (hi - lo) * rng.uniform(k) as f64;
        let north = [-25.0, -16.0, -1.0, 10.5, 24.0].map(|x| (x, 2.32, PI));
        let south = [-22.5, -10.0, 13.0].map(|x| (x, -2.32, 0.0));
        let first = rng.below(99, 5) as usize;
        let cars = north.into_iter().chain(south).enumerate().filter(|(k, _)| *k != first).map(|(k, (x, y, angle))| {
            let c = 10 * k as u64;
            let at = dvec3(x + uniform(c, -0.5, 0.5), y + uniform(c + 1, -0.06, 0.06), 0.0);
            Place { at, angle: angle + uniform(c + 2, -0.03, 0.03), kind: k, size: 1.0 }
        });
        let trees = [(-20.5, 5.9), (-7.0, 5.9), (5.2, 5.9), (17.5, 5.9), (-25.0, -6.6), (2.6, -6.0)];
        let trees = trees.into_iter().enumerate().map(|(k, (x, y))| {
            let c = 200 + 3 * k as u64;
            Place { at: dvec3(x, y, PAVEMENT), angle: uniform(c, 0.0, 2.0 * PI), kind: k % 2, size: uniform(c + 1, 0.85, 1.12) }
        });
        let upright = |(x, y, angle): (f64, f64, f64)| Place { at: dvec3(x, y, PAVEMENT), angle, kind: 0, size: 1.0 };
        let lamps = [(-27.0, 4.3, 0.0), (-13.5, 4.3, 0.0), (-0.5, 4.3, 0.0), (12.5, 4.3, 0.0), (26.0, 4.3, 0.0)];
        let lamps = lamps.into_iter().chain([-18.5, -4.0, 9.5, 23.0].map(|x| (x, -4.4, 0.0))).map(upright);
        let benches = [(-14.0, 5.6, 0.0), (11.0, 5.6, 0.0), (-9.3, -7.6, 0.5 * PI), (-17.0, -7.6, -0.5 * PI)].into_iter().map(upright);
        let bollards = (0..12).map(|k| upright((-20.0 + 2.9 * k as f64 + if k > 5 { 7.0 } else { 0.0 }, -4.15, 0.0)));
        Layout {
            cars: cars.collect(),
            trees: trees.collect(),
            lamps: lamps.collect(),
            benches: benches.collect(),
            bollards: bollards.filter(|p| (p.at.x + 18.5).abs() > 0.6 && p.at.x < 26.0).collect(),
            fountain: dvec3(-13.2, -7.4, PAVEMENT),
        }
    }

    /// Cylinders around everything that stands in the free space.
    pub fn obstacles(&self) -> Vec<Obstacle> {
        let of = |p: &Place, radius: f64, z: [f64; 2]| Obstacle { at: p.at, radius, z };
        let mut out = vec![Obstacle { at: self.fountain, radius: 2.6, z: [0.0, 3.3] }];
        for c in &self.cars {
            out.extend([-1.3, 0.0, 1.3].map(|s| Obstacle { at: c.at + DVec3::X * s, radius: 1.45, z: [0.0, 2.1] }));
        }
        for t in &self.trees {
            out.extend([of(t, 0.6, [0.0, 2.4]), of(t, 3.2 * t.size, [2.1, 8.8 * t.size])]);
        }
        out.extend(self.lamps.iter().map(|p| of(p, 0.55, [0.0, 4.6])));
        out.extend(self.benches.iter().map(|p| of(p, 1.05, [0.0, 1.3])));
        out.extend(self.bollards.iter().map(|p| of(p, 0.3, [0.0, 1.1])));
        out
    }
}
