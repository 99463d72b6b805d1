//! Which lights have a sun. A sun that all photographs share can stand in for albedo, and one that hardly explains anything for shadows that are
//! still in the albedos: each has to explain something of its own.

use super::{Fitted, Guess, SETTLING, Seen, Surfaces, explained, gray, guess, level, lit, misfit, settle, solve};
use crate::relight::outdoor::visibility::Visibility;
use diorama_geom::glam::Vec3;

/// Share of a level surface's light below which a sun may be one that is not there.
const WEAK: f32 = 0.5;
/// The same below which it is none: it would only make another shape of the sky likely.
const FAINT: f32 = 0.05;
/// Factor by which what is seen may be explained worse for every weak sun that is left out, and every other: what few photographs show of a
/// place is explained badly by any light, and a strong sun of some then explains little more of all.
const PER_WEAK_SUN: f64 = 1.1;
const PER_SUN: f64 = 1.01;
/// Times that lights settle once all suns are left out.
const WITHOUT: usize = 3;

/// Times at most that lights and albedos settle while suns are selected.
pub fn most_settled(lights: usize) -> usize {
    lights + WITHOUT + lights * (lights + 1) / 2
}

/// Lights with their surfaces, and how badly they explain what is seen.
#[derive(Clone)]
pub struct Told {
    pub guesses: Vec<Guess>,
    pub surfaces: Surfaces,
    misfit: f64,
}

/// What suns are selected by.
pub struct Selection<'a> {
    pub seen: &'a [Seen],
    pub visibility: &'a Visibility,
}

impl Selection<'_> {
    /// The better of leaving weak suns out and of beginning without any. None once `go_on` says so.
    pub fn best(&self, guesses: Vec<Guess>, surfaces: Surfaces, go_on: &mut dyn FnMut() -> bool) -> Option<Told> {
        let all = Told { misfit: misfit(self.seen, &surfaces, &guesses), guesses, surfaces };
        let some = self.added(&all, go_on)?;
        let all = self.dropped(all, go_on)?;
        Some(if some.score() < all.score() { some } else { all })
    }

    /// Without weak suns: an overcast sky gets one that explains shadows of other lights which are still in the albedos.
    fn dropped(&self, all: Told, go_on: &mut dyn FnMut() -> bool) -> Option<Told> {
        let share = |l: &usize| all.guesses[*l].sun_share();
        let mut weak: Vec<usize> = (0..all.guesses.len()).filter(|l| share(l) < WEAK).collect();
        weak.sort_by(|a, b| share(a).total_cmp(&share(b)));
        let mut told = all;
        for l in weak {
            let mut without = told.guesses.clone();
            without[l].sunlit.fill(0.0);
            let without = self.settled(without, &told.surfaces, 1, go_on)?;
            if without.score() <= told.score() || told.guesses[l].sun_share() < FAINT {
                told = without;
            }
        }
        Some(told)
    }

    /// Without any sun at first; then each in turn whose sun explains most, as long as it explains enough.
    fn added(&self, all: &Told, go_on: &mut dyn FnMut() -> bool) -> Option<Told> {
        let mut none = all.guesses.clone();
        for (l, g) in none.iter_mut().enumerate() {
            g.sunlit.fill(0.0);
            // All points count at first: what was trusted, was with suns.
            let points = lit(self.seen, &all.surfaces.albedos, l, &g.sent, None, &all.surfaces.points);
            g.fitted = solve(&points, &all.surfaces.points, &g.sunlit, Vec3::from_slice(&g.fitted.sun));
        }
        let mut told = self.settled(none, &all.surfaces, WITHOUT, go_on)?;
        loop {
            let mut best: Option<Told> = None;
            for l in (0..told.guesses.len()).filter(|l| !told.guesses[*l].has_sun()) {
                let albedos = explained(self.seen, &told.surfaces, &told.guesses, Some(l));
                let mut with = told.guesses.clone();
                with[l] = guess(self.seen, &told.surfaces, self.visibility, albedos, l, &told.guesses[l].sent, None);
                let with = self.settled(with, &told.surfaces, 1, go_on)?;
                if with.guesses[l].sun_share() > FAINT && best.as_ref().is_none_or(|b| with.misfit < b.misfit) {
                    best = Some(with);
                }
            }
            match best {
                Some(better) if better.score() < told.score() => told = better,
                _ => return Some(told),
            }
        }
    }

    fn settled(&self, mut guesses: Vec<Guess>, surfaces: &Surfaces, times: usize, go_on: &mut dyn FnMut() -> bool) -> Option<Told> {
        let mut surfaces = surfaces.clone();
        if !settle(self.seen, &mut surfaces, &mut guesses, times * SETTLING, go_on) {
            return None;
        }
        Some(Told { misfit: misfit(self.seen, &surfaces, &guesses), guesses, surfaces })
    }
}

impl Told {
    /// What is compared: less is better.
    fn score(&self) -> f64 {
        let price = |g: &Guess| if g.sun_share() < WEAK { PER_WEAK_SUN } else { PER_SUN };
        self.misfit * self.guesses.iter().filter(|g| g.has_sun()).map(price).product::<f64>()
    }
}

impl Guess {
    /// Share of a level surface's light that is the sun's.
    fn sun_share(&self) -> f32 {
        let Fitted { sun, sky, .. } = &self.fitted;
        sun[2] * gray(&sun[3..]) / gray(&level(sun, sky).to_array()).max(1e-6)
    }

    pub fn has_sun(&self) -> bool {
        self.fitted.sun[3..] != [0.0; 3]
    }
}
