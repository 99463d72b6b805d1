//! Level ground, which cameras see from close above it: a distance that is off by a tenth makes it lumpy, but its height is off by a tenth of
//! the camera's height alone. Heights that many rays agree on are those of ground.

use rayon::prelude::*;

/// Sine of the angle below the horizon from which a ray may show ground.
const DOWN: f64 = 0.04;
/// Relative difference of a distance to that of the ground it is of.
const NEAR: f64 = 0.06;
/// How much farther than the ground a ray may seem to end: nothing is seen below it.
const BELOW: f64 = 1.0;
/// Heights that are tried, and most that are kept.
const TRIED: usize = 400;
const MOST: usize = 3;
/// Times that a height moves to the median of the rays that end there.
const ROUNDS: usize = 5;
/// Relative difference of heights below a camera within which there may be other ground, as a road's beside a sidewalk.
const STEP: f64 = 0.25;
/// Least share of the rays below the horizon that ground takes.
const SHARE: f64 = 0.12;

/// A ray: height of its camera, downward part of its unit direction, and how far away it ends.
#[derive(Clone, Copy)]
pub struct Sight {
    pub eye: f64,
    pub down: f64,
    pub distance: f64,
}

/// Heights of level ground.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Levels(Vec<f64>);

impl Sight {
    /// Distance to where the ray ends over that to a height; infinite where it does not come down to it.
    fn over(&self, height: f64) -> f64 {
        let drop = self.eye - height;
        if drop > 0.0 { self.down * self.distance / drop } else { f64::INFINITY }
    }

    fn height(&self) -> f64 {
        self.eye - self.down * self.distance
    }

    fn is_at(&self, height: f64) -> bool {
        (self.over(height) - 1.0).abs() < NEAR
    }
}

impl Levels {
    /// Heights that many rays end at, the most frequent first, without those that as many rays end below.
    pub fn of(sights: impl Iterator<Item = Sight>) -> Levels {
        let all: Vec<Sight> = sights.filter(|s| s.down > DOWN).collect();
        let (mut left, mut found) = (all.clone(), Vec::new());
        for _ in 0..MOST {
            let Some((votes, best)) = most_frequent(&left) else { break };
            let under = all.iter().filter(|s| s.over(best).is_finite() && s.over(best) > 1.0 + BELOW).count();
            if (votes as f64) < SHARE * all.len() as f64 || under > votes {
                break;
            }
            let eye = all[0].eye;
            let is_near = |first: &f64| ((eye - best) / (eye - first) - 1.0).abs() < STEP;
            if found.first().is_none_or(is_near) {
                found.push(best);
            }
            left.retain(|s| !s.is_at(best));
        }
        Levels(found)
    }

    /// Distance along a ray to the ground that it shows; none where it shows something else.
    pub fn distance(&self, sight: &Sight) -> Option<f64> {
        let off = |height: &f64| (sight.over(*height) - 1.0).abs();
        let nearest = self.0.iter().min_by(|a, b| off(a).total_cmp(&off(b)))?;
        let is_ground = sight.down > DOWN && (-NEAR..BELOW).contains(&(sight.over(*nearest) - 1.0));
        is_ground.then(|| (sight.eye - nearest) / sight.down)
    }
}

/// The height that most rays end at, in the median of theirs, and how many.
fn most_frequent(sights: &[Sight]) -> Option<(usize, f64)> {
    let mut heights: Vec<f64> = sights.iter().map(Sight::height).collect();
    heights.sort_by(f64::total_cmp);
    let tried: Vec<f64> = heights.into_iter().step_by(sights.len().div_ceil(TRIED).max(1)).collect();
    let voters = |h: f64| sights.iter().filter(move |s| s.is_at(h));
    let first = tried.into_par_iter().map(|h| (voters(h).count(), h)).max_by(|a, b| a.0.cmp(&b.0).then(b.1.total_cmp(&a.1)))?.1;
    let settled = (0..ROUNDS).fold(first, |h, _| {
        let mut heights: Vec<f64> = voters(h).map(Sight::height).collect();
        heights.sort_by(f64::total_cmp);
        heights.get(heights.len() / 2).copied().unwrap_or(h)
    });
    Some((voters(settled).count(), settled))
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_geom::rng::Rng;

    /// Rays of a camera 1.6 above lumpy ground, and of walls 10 away that stand on it.
    fn street(ground: f64, noise: f64) -> Vec<Sight> {
        let rng = Rng::new(1, 1);
        let ray = |i: usize| {
            let down = 0.05 + 0.4 * (i as f64 * 0.618).fract();
            let (to_ground, to_wall) = (1.6 / down, 10.0 / (1.0 - down * down).sqrt());
            let at_random = |k: u64| rng.uniform(2 * i as u64 + k) as f64;
            let lumps = 1.0 + noise * (at_random(0) - at_random(1));
            Sight { eye: ground + 1.6, down, distance: if to_ground < to_wall { lumps * to_ground } else { to_wall } }
        };
        (0..4000).map(ray).collect()
    }

    #[test]
    fn lumpy_ground_is_level_and_walls_are_not_ground() {
        let sights = street(-0.5, 0.15);
        let levels = Levels::of(sights.iter().copied());
        assert!((levels.0[0] + 0.5).abs() < 0.05, "{levels:?}");
        let shows_ground = |s: &&Sight| s.down > 0.16;
        let told =
            sights.iter().filter(shows_ground).filter(|s| levels.distance(s).is_some_and(|d| (s.down * d - 1.6).abs() < 0.2)).count();
        let ground = sights.iter().filter(shows_ground).count();
        assert!(told * 3 > ground * 2, "{told} of {ground}");
        let walls: Vec<&Sight> = sights.iter().filter(|s| s.down < 0.13).collect();
        assert!(walls.len() > 100 && walls.iter().all(|s| levels.distance(s).is_none()), "walls 0.3 and more above the ground");
    }

    #[test]
    fn what_seems_to_lie_below_ground_is_ground() {
        let levels = Levels::of(street(0.0, 0.0).into_iter());
        let through = Sight { eye: 1.6, down: 0.4, distance: 7.0 };
        assert!((levels.distance(&through).unwrap() - 4.0).abs() < 0.1);
        assert_eq!(levels.distance(&Sight { distance: 3.0, ..through }), None, "something stands there");
        assert_eq!(levels.distance(&Sight { down: -0.4, ..through }), None, "the sky");
    }

    #[test]
    fn without_level_ground_there_is_none() {
        // A slope seen from above: every height as often as any other.
        let slope = (0..4000).map(|i| Sight { eye: 10.0, down: 0.3, distance: 1.0 + i as f64 * 0.02 });
        assert_eq!(Levels::of(slope), Levels::default());
        assert_eq!(Levels::of(std::iter::empty()), Levels::default());
    }
}
