//! Making of a data set: sample by sample into a journal, then annotations of all formats.
//!
//! Every sample depends on the data set's seed, its scene and its number in the scene alone. A journal keeps what is done, so that an
//! interrupted call goes on; images are verified by their hashes.

use super::super::edit::Edit;
use super::super::fnv;
use super::image::{self, SceneEdits};
use super::plan::{self, Scenes, Shard, SynthOptions};
use super::prior::Prior;
use super::sampling::{Clustering, Draws, Faults, Sampling, sample_seed};
use super::scene::SynthScene;
use crate::error::{PipelineError, Result};
use diorama_data::text_set::{self, SetImage};
use diorama_data::{DataError, atomic, error, photo};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::io::Write;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

/// What a folder's data set is made of, and samples that are done.
pub const MANIFEST: &str = "synth.json";
pub const JOURNAL: &str = "journal.jsonl";
const LIMIT: u64 = 1 << 34;
/// Distance in pixels from which a label does not fit its glyphs.
const MISFIT_PX: f64 = 2.0;
/// Rounds of attempts in a sample's cluster, and all rounds, those in the next clusters, before it is given up.
const OWN_ROUNDS: u64 = 8;
const ROUNDS: u64 = 16;

/// What a data set, or a shard of one, was made of.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    pub options: SynthOptions,
    /// Name of each scene, and the state of its run.
    pub scenes: Vec<(String, String)>,
    pub shard: Shard,
}

/// A sample that is done.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Done {
    pub sample: usize,
    /// Cluster of the text pose that it was drawn for.
    pub cluster: usize,
    /// Hash of the image's file.
    pub hash: String,
    pub misfit_px: Option<f64>,
    pub record: SetImage,
}

/// What was made.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Synthesized {
    pub images: usize,
    pub words: usize,
    pub unreadable: usize,
    /// Words of edits whose label is more than 2 pixels from their glyphs, and the largest distance.
    pub misfits: usize,
    pub largest_misfit_px: f64,
    /// Images of each cluster of text poses.
    pub clusters: Vec<usize>,
    pub seconds: f64,
    pub images_per_s: f64,
    pub notes: Vec<String>,
    pub interrupted: bool,
}

/// Hash of a file's bytes.
fn hash(bytes: &[u8]) -> String {
    format!("{:016x}", fnv::hash(bytes.iter().copied()))
}

/// Makes a shard of a data set in a folder, or goes on with it.
///
/// # Errors
/// When the folder holds something else and is not replaced by `force`, a run cannot be read, a cluster that was asked for has no valid camera,
/// or a file cannot be written; the journal then keeps what is done.
pub fn synthesize(
    out: &Path,
    (scenes, options, shard): (&Scenes, &SynthOptions, Shard),
    force: bool,
    stop: &AtomicBool,
    progress: &mut dyn FnMut(f64, &str),
) -> Result<Synthesized> {
    options.check()?;
    let prior = options.prior.as_deref().map(Prior::read).transpose()?.unwrap_or_default();
    let states = scenes.scenes.iter().map(|s| Ok((s.name(), plan::fingerprint(&s.run)?))).collect::<Result<Vec<_>>>()?;
    let manifest = Manifest { options: options.clone(), scenes: states, shard };
    let mut done = begin(out, &manifest, force)?;
    let (mut result, start) = (Synthesized::default(), Instant::now());
    let before = done.len();
    let samples = shard.samples(options.count);
    let wanted: Vec<usize> = samples.clone().filter(|s| !done.contains_key(s)).collect();
    if !wanted.is_empty() {
        let mut maker = Maker::new(scenes, options, prior, progress)?;
        let mut journal = Journal::open(out, &done)?;
        for sample in wanted {
            if stop.load(Ordering::Relaxed) {
                result.interrupted = true;
                break;
            }
            progress((done.len()) as f64 / samples.len() as f64, "images");
            let made = maker.sample(sample, out, &mut result.notes)?;
            journal.add(&made)?;
            done.insert(sample, made);
        }
    }
    result.seconds = start.elapsed().as_secs_f64();
    result.images_per_s = (done.len() - before) as f64 / result.seconds.max(1e-9);
    if !result.interrupted {
        finish(out, &manifest.options, &done)?;
    }
    count(&mut result, &done, options.clusters);
    Ok(result)
}

/// Writes all annotations of the samples of a folder.
///
/// # Errors
/// When a file cannot be written.
pub fn finish(out: &Path, options: &SynthOptions, done: &BTreeMap<usize, Done>) -> Result<()> {
    let images: Vec<SetImage> = done.values().map(|d| d.record.clone()).collect();
    text_set::write(out, &images, &options.formats)?;
    // Written last: it says that the rest is there.
    Ok(text_set::save(out, &images)?)
}

/// Figures of samples.
pub fn count(result: &mut Synthesized, done: &BTreeMap<usize, Done>, clusters: usize) {
    result.images = done.len();
    result.clusters = vec![0; clusters];
    for d in done.values() {
        result.words += d.record.words.len();
        result.unreadable += d.record.words.iter().filter(|w| w.ignore).count();
        if let Some(c) = result.clusters.get_mut(d.cluster) {
            *c += 1;
        }
        let off = d.misfit_px.unwrap_or(0.0);
        result.misfits += (off > MISFIT_PX) as usize;
        result.largest_misfit_px = result.largest_misfit_px.max(off);
    }
    while result.clusters.last() == Some(&0) {
        result.clusters.pop();
    }
}

/// Prepares a folder; returns what is done there.
fn begin(out: &Path, manifest: &Manifest, force: bool) -> Result<BTreeMap<usize, Done>> {
    let path = out.join(MANIFEST);
    let now = serde_json::to_value(manifest).expect("plain values");
    if path.exists() && force {
        let earlier: Vec<SetImage> = journal(out)?.into_iter().map(|d| d.record).collect();
        text_set::remove(out, &earlier)?;
        for file in earlier.iter().map(|i| out.join(glyphs(&i.image))).chain([out.join(JOURNAL)]).filter(|f| f.exists()) {
            std::fs::remove_file(&file).map_err(DataError::io(&file, "remove"))?;
        }
    } else if path.exists() {
        let before = serde_json::to_value(read_manifest(out)?).expect("plain values");
        let differing = differing("", &before, &now);
        if !differing.is_empty() {
            let (out, differing) = (out.display(), differing.join(", "));
            let what = format!("{out}: holds a data set of other {differing}; give --force to replace it, or another --out");
            return Err(PipelineError::Usage(what));
        }
    }
    for sub in ["images", "glyphs"] {
        let sub = out.join(sub);
        std::fs::create_dir_all(&sub).map_err(DataError::io(&sub, "create"))?;
    }
    atomic::write(&path, &serde_json::to_vec_pretty(&now).expect("plain values"))?;
    read_journal(out)
}

/// Keys whose values differ.
fn differing(at: &str, a: &serde_json::Value, b: &serde_json::Value) -> Vec<String> {
    match (a.as_object(), b.as_object()) {
        (Some(a), Some(b)) => {
            let null = serde_json::Value::Null;
            b.iter()
                .flat_map(|(k, v)| differing(&format!("{at}{}{k}", if at.is_empty() { "" } else { "." }), a.get(k).unwrap_or(&null), v))
                .collect()
        }
        _ if a == b => Vec::new(),
        _ => vec![at.to_string()],
    }
}

/// # Errors
/// When the folder holds no data set.
pub fn read_manifest(folder: &Path) -> Result<Manifest> {
    let path = folder.join(MANIFEST);
    let bytes = error::read(&path, LIMIT)?;
    Ok(serde_json::from_slice(&bytes).map_err(|e| DataError::input(&path, format!("{e}; make the data set anew with --force")))?)
}

/// Lines of a folder's journal; the last may have been cut, and is then left out.
fn journal(folder: &Path) -> Result<Vec<Done>> {
    let path = folder.join(JOURNAL);
    if !path.exists() {
        return Ok(Vec::new());
    }
    let bytes = error::read(&path, LIMIT)?;
    Ok(bytes.split(|b| *b == b'\n').filter_map(|line| serde_json::from_slice(line).ok()).collect())
}

/// Samples of a folder's journal whose images are as they were written; others are to be drawn anew.
///
/// # Errors
/// When the journal or an image cannot be read.
pub fn read_journal(folder: &Path) -> Result<BTreeMap<usize, Done>> {
    let mut out = BTreeMap::new();
    for done in journal(folder)? {
        let image = folder.join(&done.record.image);
        if image.exists() && hash(&error::read(&image, LIMIT)?) == done.hash {
            out.insert(done.sample, done);
        }
    }
    Ok(out)
}

/// Place of the glyphs of an image.
pub fn glyphs(image: &str) -> String {
    image.replacen("images/", "glyphs/", 1)
}

/// Samples that are done, one per line.
struct Journal {
    file: std::fs::File,
    path: std::path::PathBuf,
}

impl Journal {
    /// The journal of a folder, with what is known to be done.
    fn open(folder: &Path, done: &BTreeMap<usize, Done>) -> Result<Journal> {
        let path = folder.join(JOURNAL);
        let lines: String = done.values().map(line).collect();
        atomic::write(&path, lines.as_bytes())?;
        let file = std::fs::OpenOptions::new().append(true).open(&path).map_err(DataError::io(&path, "write"))?;
        Ok(Journal { file, path })
    }

    fn add(&mut self, done: &Done) -> Result<()> {
        Ok(self.file.write_all(line(done).as_bytes()).map_err(DataError::io(&self.path, "write"))?)
    }
}

fn line(done: &Done) -> String {
    serde_json::to_string(done).expect("plain values") + "\n"
}

/// Draws samples scene by scene.
struct Maker<'a> {
    scenes: &'a Scenes,
    options: &'a SynthOptions,
    prior: Prior,
    clustering: Clustering,
    /// The scene whose text poses were read last, with its number: it need not be loaded again where it comes first.
    loaded: Option<(usize, SynthScene)>,
    present: Option<Present>,
}

/// The scene that is loaded.
struct Present {
    number: usize,
    scene: SynthScene,
    edits: SceneEdits,
    feasible: Vec<usize>,
}

impl<'a> Maker<'a> {
    fn new(scenes: &'a Scenes, options: &'a SynthOptions, prior: Prior, progress: &mut dyn FnMut(f64, &str)) -> Result<Maker<'a>> {
        let (mut members, mut loaded, n) = (Vec::new(), None, scenes.scenes.len());
        for (k, entry) in scenes.scenes.iter().enumerate() {
            let look = &mut |s| progress((k as f64 + s) / n as f64, "text poses of the photographs");
            let scene = SynthScene::load(entry.name(), &entry.run, look)?;
            members.push(scene.members.clone());
            loaded = Some((k, scene));
        }
        let clustering = Clustering::new(&members, options.clusters, options.seed);
        Ok(Maker { scenes, options, prior, clustering, loaded, present: None })
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
            let (found, lacking) = self.draws(&scene, number).feasible();
            let is_asked = |c: &usize| self.options.only.is_empty() || self.options.only.contains(c);
            feasible = found.into_iter().filter(is_asked).collect();
            let why = |f: &Faults| f.iter().max_by_key(|(_, n)| **n).map(|(f, _)| f.to_string()).unwrap_or_default();
            notes.extend(
                lacking
                    .iter()
                    .filter(|(c, _)| is_asked(c))
                    .map(|(c, f)| format!("{}: cluster {c} has no valid camera: {}", scene.name, why(f))),
            );
            if feasible.is_empty() {
                let why = notes.last().cloned().unwrap_or_else(|| format!("{}: there is no such cluster", scene.name));
                return Err(PipelineError::Usage(why));
            }
        }
        self.present = Some(Present { number, scene, edits, feasible });
        Ok(())
    }

    fn draws<'b>(&'b self, scene: &'b SynthScene, number: usize) -> Draws<'b> {
        let camera = scene.camera(self.options.size);
        Draws { scene, number, clustering: &self.clustering, prior: &self.prior, camera, seed: self.options.seed }
    }

    /// Draws a sample and writes its image.
    fn sample(&mut self, sample: usize, out: &Path, notes: &mut Vec<String>) -> Result<Done> {
        let (number, index) = plan::place(sample, self.options.count, self.scenes.scenes.len());
        if self.present.as_ref().is_none_or(|p| p.number != number) {
            self.enter(number, notes)?;
        }
        let p = self.present.as_ref().expect("a scene");
        let draws = self.draws(&p.scene, number);
        let seed = sample_seed(self.options.seed, &p.scene.name, index);
        let mut drawn = None;
        for again in 0..ROUNDS {
            let own = seed.wrapping_add(again);
            let found = match self.options.sampling {
                Sampling::Balanced => {
                    let other = (again + 1).saturating_sub(OWN_ROUNDS) as usize;
                    draws.balanced(p.feasible[(index + other) % p.feasible.len()], own)
                }
                Sampling::Random => draws.random(own),
            };
            if let Ok(found) = found {
                drawn = Some(found);
                break;
            }
        }
        let Some(drawn) = drawn else {
            return Err(PipelineError::Usage(format!("{}: sample {index} has no valid camera in {ROUNDS} rounds", p.scene.name)));
        };
        let name = format!("{sample:08}");
        let made = image::draw(&p.scene, &p.edits, &self.clustering, (&draws.camera, &drawn), (&name, seed));
        text_set::check(&made.record).map_err(|e| PipelineError::Usage(format!("image {name}: {e}")))?;
        let bytes = photo::encode_png(&made.picture);
        atomic::write(&out.join(&made.record.image), &bytes)?;
        photo::save_png(&out.join(glyphs(&made.record.image)), &made.glyphs)?;
        Ok(Done { sample, cluster: drawn.cluster, hash: hash(&bytes), misfit_px: made.misfit_px, record: made.record })
    }
}
