//! Samples of a data set, drawn scene by scene.

use super::super::edit::Edit;
use super::super::styling::Style;
use super::appearance::Appearance;
use super::image::{self, Drawing, SceneEdits};
use super::journal::{Done, glyphs, hash};
use super::plan::{self, Scenes, SynthOptions};
use super::prior::Prior;
use super::sampling::{Clustering, Draws, Faults, OWN_ROUNDS, Sampling, sample_seed};
use super::scene::SynthScene;
use crate::error::{PipelineError, Result};
use diorama_data::{atomic, photo, text_set};
use rayon::prelude::*;
use std::path::Path;
use std::time::{Duration, Instant};

/// Rounds of attempts in a sample's cluster and the next ones before it is given up.
const ROUNDS: u64 = 2 * OWN_ROUNDS;
/// Samples per thread that are drawn side by side.
const SIDE_BY_SIDE: usize = 4;

/// Draws samples scene by scene.
pub(super) struct Maker<'a> {
    scenes: &'a Scenes,
    options: &'a SynthOptions,
    prior: Prior,
    clustering: Clustering,
    styles: Vec<Style>,
    /// Time that changes of looks took, the statistics of scenes among it, and time that all images took.
    styling: Duration,
    drawing: Duration,
    /// The scene whose text poses were read last, with its number: it need not be loaded again where it comes first.
    loaded: Option<(usize, SynthScene)>,
    present: Option<Present>,
}

/// Samples that were drawn side by side.
pub(super) struct Drawn<'s> {
    pub done: Vec<Done>,
    pub failure: Option<PipelineError>,
    /// Samples that come after them.
    pub rest: &'s [usize],
}

/// The scene that is loaded.
struct Present {
    number: usize,
    scene: SynthScene,
    edits: SceneEdits,
    appearance: Option<Appearance>,
    feasible: Vec<usize>,
}

impl<'a> Maker<'a> {
    /// Reads the text poses of all scenes.
    pub fn new(
        (scenes, options): (&'a Scenes, &'a SynthOptions),
        prior: Prior,
        styles: Vec<Style>,
        progress: &mut dyn FnMut(f64, &str),
    ) -> Result<Maker<'a>> {
        let (mut members, mut loaded, n) = (Vec::new(), None, scenes.scenes.len());
        for (k, entry) in scenes.scenes.iter().enumerate() {
            let look = &mut |s| progress((k as f64 + s) / n as f64, "text poses of the photographs");
            let scene = SynthScene::load(entry.name(), &entry.run, look)?;
            members.push(scene.members.clone());
            loaded = Some((k, scene));
        }
        let clustering = Clustering::new(&members, options.clusters);
        Ok(Maker { scenes, options, prior, clustering, styles, styling: Duration::ZERO, drawing: Duration::ZERO, loaded, present: None })
    }

    /// Makes a scene the present one.
    fn enter(&mut self, number: usize, notes: &mut Vec<String>) -> Result<()> {
        let entry = &self.scenes.scenes[number];
        let mut scene = match self.loaded.take() {
            Some((k, scene)) if k == number => scene,
            _ => SynthScene::load(entry.name(), &entry.run, &mut |_| ())?,
        };
        scene.look();
        let edits = Edit::names(&entry.run)?.iter().map(|n| Edit::read(&entry.run, n)).collect::<Result<Vec<_>>>()?;
        let edits = SceneEdits::new(&scene, edits, entry.original);
        let mut feasible = Vec::new();
        if self.options.sampling == Sampling::Balanced {
            let draws = self.draws(&scene, number);
            let (found, lacking) = draws.feasible();
            let is_asked = |c: &usize| self.options.only.is_empty() || self.options.only.contains(c);
            feasible = found.into_iter().filter(is_asked).collect();
            notes.extend(
                lacking
                    .iter()
                    .filter(|(c, _)| is_asked(c))
                    .map(|(c, f)| format!("{}: cluster {c} has no valid camera: {}", scene.name, draws.why(Some(*c), f))),
            );
            if feasible.is_empty() {
                let why = notes.last().cloned().unwrap_or_else(|| format!("{}: no cluster has a valid camera", scene.name));
                let cure = if self.scenes.scenes.len() > 1 { "; leave this scene out of the list of scenes" } else { "" };
                return Err(PipelineError::Usage(why + cure));
            }
        }
        let began = Instant::now();
        let appearance = Appearance::new(&scene, self.options.size, &self.styles, self.options.mask);
        if appearance.is_some() {
            self.styling += began.elapsed();
        }
        self.present = Some(Present { number, scene, edits, appearance, feasible });
        Ok(())
    }

    fn draws<'b>(&'b self, scene: &'b SynthScene, number: usize) -> Draws<'b> {
        let camera = scene.camera(self.options.size);
        Draws { scene, number, clustering: &self.clustering, prior: &self.prior, camera, seed: self.options.seed }
    }

    /// Share of the time of all images that changes of looks took.
    pub fn styling_share(&self) -> f64 {
        self.styling.as_secs_f64() / self.drawing.as_secs_f64().max(1e-9)
    }

    /// Draws the first of the samples, which are of one scene, side by side, and writes their images; returns those that succeeded, the first
    /// failure, and the other samples.
    ///
    /// # Errors
    /// When a scene cannot be read. A failure is that a sample has no valid camera, or that an image cannot be written.
    pub fn side_by_side<'s>(&mut self, samples: &'s [usize], out: &Path, notes: &mut Vec<String>) -> Result<Drawn<'s>> {
        let scene_of = |sample: &usize| plan::place(*sample, self.options.count, self.scenes.scenes.len()).0;
        let number = scene_of(&samples[0]);
        let most = SIDE_BY_SIDE * rayon::current_num_threads();
        let (own, rest) = samples.split_at(samples.iter().take(most).take_while(|s| scene_of(s) == number).count());
        let began = Instant::now();
        if self.present.as_ref().is_none_or(|p| p.number != number) {
            self.enter(number, notes)?;
        }
        self.drawing += began.elapsed();
        let made: Vec<Result<(Done, [Duration; 2])>> = own.par_iter().map(|s| self.sample(*s, out)).collect();
        let mut drawn = Drawn { done: Vec::new(), failure: None, rest };
        for made in made {
            match made {
                Ok((done, [styling, drawing])) => {
                    (self.styling, self.drawing) = (self.styling + styling, self.drawing + drawing);
                    drawn.done.push(done);
                }
                Err(e) => drawn.failure = drawn.failure.or(Some(e)),
            }
        }
        Ok(drawn)
    }

    /// Draws a sample of the present scene and writes its image; also how long its look and all of it took.
    fn sample(&self, sample: usize, out: &Path) -> Result<(Done, [Duration; 2])> {
        let began = Instant::now();
        let (number, index) = plan::place(sample, self.options.count, self.scenes.scenes.len());
        let p = self.present.as_ref().expect("a scene");
        let draws = self.draws(&p.scene, number);
        let seed = sample_seed(self.options.seed, &p.scene.name, index);
        let (mut posed, mut faults) = (None, Faults::new());
        for again in 0..ROUNDS {
            let own = seed.wrapping_add(again);
            let found = match self.options.sampling {
                Sampling::Balanced => {
                    let other = (again + 1).saturating_sub(OWN_ROUNDS) as usize;
                    draws.balanced(p.feasible[(index + other) % p.feasible.len()], own)
                }
                Sampling::Random => draws.random(own),
            };
            match found {
                Ok(found) => {
                    posed = Some(found);
                    break;
                }
                Err(failed) => failed.into_iter().for_each(|(fault, n)| *faults.entry(fault).or_default() += n),
            }
        }
        let Some(drawn) = posed else {
            let (scene, why) = (&p.scene.name, draws.why(None, &faults));
            return Err(PipelineError::Usage(format!("{scene}: sample {index} has no valid camera in {ROUNDS} rounds: {why}")));
        };
        let name = format!("{sample:08}");
        let made = image::draw(&p.scene, (&p.edits, p.appearance.as_ref()), &self.clustering, (&draws.camera, &drawn), (&name, seed));
        text_set::check(&made.record).map_err(|e| PipelineError::Usage(format!("image {name}: {e}")))?;
        let bytes = photo::encode_png(&made.picture);
        atomic::write(&out.join(&made.record.image), &bytes)?;
        photo::save_png(&out.join(glyphs(&made.record.image)), &made.glyphs)?;
        let Drawing { compared, misfits, misfit_px, styling, record, .. } = made;
        let done = Done { sample, cluster: drawn.cluster, hash: hash(&bytes), compared, misfits, misfit_px, record };
        Ok((done, [styling, began.elapsed()]))
    }
}
