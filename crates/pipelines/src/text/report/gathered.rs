//! Statistics of labelled images: where words are, how large, how visible, in what script, and in what pose they are seen.

use super::super::pose_clusters::{clusters, distance, mean};
use super::super::synth::prior::Prior;
use diorama_data::text_labels::{Kind, LabelledImage, LabelledRegion, UNREADABLE};
use diorama_data::text_set::{SetImage, SetWord};
use diorama_geom::glam::{DQuat, DVec3};
use std::collections::{BTreeMap, BTreeSet, HashMap};
use unicode_script::{Script, UnicodeScript};

/// Bins of the visible share.
pub const VISIBILITY: usize = 10;
/// Clusters where the data set tells none.
const CLUSTERS: usize = 16;
/// Words whose directions are kept.
const MOST_NORMALS: usize = 1500;
/// Visible share of a word that may stand for its cluster.
const WHOLE: f64 = 0.99;

/// Words seen in similar poses.
#[derive(Clone, Debug, PartialEq)]
pub struct PoseCluster {
    pub number: usize,
    pub words: usize,
    /// Those of them that are not to be read.
    pub unreadable: usize,
    /// Mean rotation from the region to the camera.
    pub mean: DQuat,
    /// Median of width over height.
    pub aspect: f64,
    /// Image and word, as numbers, that are closest to the mean; those to be read and wholly visible come first.
    pub example: (usize, usize),
}

/// Statistics of labelled images.
#[derive(Clone, Debug, PartialEq)]
pub struct Gathered {
    /// What the page calls it.
    pub name: String,
    pub images: usize,
    pub words: usize,
    /// Those of them that are not to be read.
    pub unreadable: usize,
    /// Names of scenes, where they are told.
    pub scenes: usize,
    /// Mean of the images' width over height.
    pub aspect: f64,
    /// Places and areas of the words that are to be read.
    pub prior: Prior,
    /// Words by their visible share, in equal bins from 0 to 1; none where it is not told.
    pub visibility: Option<Vec<usize>>,
    /// Words by script, most first; those that are not to be read apart, last.
    pub scripts: Vec<(String, usize)>,
    pub clusters: Vec<PoseCluster>,
    /// Whether the clusters are the data set's own: those that `text synth` numbers.
    pub are_told: bool,
    /// Where words face to from the camera: degrees to the right and up, `[N, 2]`, of at most 1500 words.
    pub normals: Vec<[f64; 2]>,
}

/// Angles in degrees by which a text faces to the right and upward; 0, 0 is toward the camera.
pub fn facing(camera_from_region: DQuat) -> [f64; 2] {
    let n = camera_from_region * DVec3::Z;
    [n.x.atan2(-n.z).to_degrees(), (-n.y).atan2(n.x.hypot(n.z)).to_degrees()]
}

/// Angle in degrees by which a text's line falls in the picture, clockwise from level.
pub fn slope(camera_from_region: DQuat) -> f64 {
    let x = camera_from_region * DVec3::X;
    x.y.atan2(x.x).to_degrees()
}

fn is_unreadable(word: &SetWord) -> bool {
    word.ignore || word.transcription == UNREADABLE
}

/// The script of a text: the one that is told, else that of its first letter with one.
fn script(told: Option<&str>, text: &str) -> String {
    let own = || text.chars().map(|c| c.script()).find(|s| !matches!(s, Script::Common | Script::Inherited | Script::Unknown));
    told.map(str::to_string).or_else(|| own().map(|s| s.full_name().to_string())).unwrap_or_else(|| "digits and signs".into())
}

/// Counts of scripts of words that are to be read, most first, and of those that are not.
fn scripts(of: impl Iterator<Item = String>, unreadable: usize) -> Vec<(String, usize)> {
    let mut counts: BTreeMap<String, usize> = BTreeMap::new();
    of.for_each(|s| *counts.entry(s).or_default() += 1);
    let mut out: Vec<(String, usize)> = counts.into_iter().collect();
    out.sort_by_key(|(_, n)| std::cmp::Reverse(*n));
    out.extend((unreadable > 0).then(|| (UNREADABLE.to_string(), unreadable)));
    out
}

fn mean_aspect(sizes: impl Iterator<Item = (u32, u32)>) -> f64 {
    let (sum, n) = sizes.fold((0.0, 0), |(sum, n), (w, h)| (sum + w as f64 / h.max(1) as f64, n + 1));
    if n > 0 { sum / n as f64 } else { 1.0 }
}

/// A word with a pose: its image and number, and what it is.
struct Posed<'a> {
    at: (usize, usize),
    word: &'a SetWord,
    rotation: DQuat,
    aspect: f64,
}

fn posed(images: &[SetImage]) -> Vec<Posed<'_>> {
    let mut out = Vec::new();
    for (i, image) in images.iter().enumerate() {
        for (k, word) in image.words.iter().enumerate() {
            let Some(pose) = &word.pose else { continue };
            let [w, x, y, z] = pose.quaternion;
            let rotation = DQuat::from_xyzw(x, y, z, w).normalize();
            out.push(Posed { at: (i, k), word, rotation, aspect: pose.size[0] / pose.size[1].max(1e-12) });
        }
    }
    out
}

/// Statistics of one cluster's words, of which there is at least one.
fn cluster(number: usize, words: &[&Posed]) -> PoseCluster {
    let mean = mean(&words.iter().map(|p| p.rotation).collect::<Vec<_>>());
    let mut aspects: Vec<f64> = words.iter().map(|p| p.aspect).collect();
    aspects.sort_by(f64::total_cmp);
    let rank = |p: &Posed| (is_unreadable(p.word), p.word.visibility < WHOLE);
    let closest = words.iter().min_by(|a, b| {
        let far = |p: &Posed| distance(p.rotation, mean);
        rank(a).cmp(&rank(b)).then(far(a).total_cmp(&far(b)))
    });
    PoseCluster {
        number,
        words: words.len(),
        unreadable: words.iter().filter(|p| is_unreadable(p.word)).count(),
        mean,
        aspect: aspects[aspects.len() / 2],
        example: closest.expect("at least one word").at,
    }
}

/// Pose clusters by number: those that the words tell, else found anew; and whether they are told.
fn pose_clusters(posed: &[Posed]) -> (Vec<PoseCluster>, bool) {
    let are_told = posed.iter().any(|p| p.word.cluster.is_some());
    let numbers: Vec<Option<usize>> = match are_told {
        true => posed.iter().map(|p| p.word.cluster).collect(),
        false => {
            let rotations: Vec<DQuat> = posed.iter().map(|p| p.rotation).collect();
            clusters(&rotations, CLUSTERS, 0).of.into_iter().map(Some).collect()
        }
    };
    let mut of: BTreeMap<usize, Vec<&Posed>> = BTreeMap::new();
    for (p, number) in posed.iter().zip(numbers) {
        number.iter().for_each(|n| of.entry(*n).or_default().push(p));
    }
    (of.iter().map(|(n, words)| cluster(*n, words)).collect(), are_told)
}

impl Gathered {
    /// Statistics of a data set.
    pub fn of_set(name: &str, images: &[SetImage]) -> Gathered {
        let words = || images.iter().flat_map(|i| &i.words);
        let region = |w: &SetWord| LabelledRegion {
            id: w.id,
            polygon: w.polygon.clone(),
            transcription: w.transcription.clone(),
            script: None,
            kind: Kind::Text,
            ignore: is_unreadable(w),
        };
        let labelled: Vec<LabelledImage> =
            images.iter().map(|i| LabelledImage { image: i.image.clone(), regions: i.words.iter().map(region).collect() }).collect();
        let sizes: HashMap<String, (u32, u32)> = images.iter().map(|i| (i.image.clone(), (i.width, i.height))).collect();
        let unreadable = words().filter(|w| is_unreadable(w)).count();
        let mut visibility = vec![0; VISIBILITY];
        words().for_each(|w| visibility[((w.visibility * VISIBILITY as f64) as usize).min(VISIBILITY - 1)] += 1);
        let posed = posed(images);
        let (clusters, are_told) = pose_clusters(&posed);
        let step = posed.len().div_ceil(MOST_NORMALS).max(1);
        Gathered {
            name: name.into(),
            images: images.len(),
            words: words().count(),
            unreadable,
            scenes: images.iter().map(|i| &i.scene).filter(|s| !s.is_empty()).collect::<BTreeSet<_>>().len(),
            aspect: mean_aspect(images.iter().map(|i| (i.width, i.height))),
            prior: Prior::of(&labelled, &sizes),
            visibility: Some(visibility),
            scripts: scripts(words().filter(|w| !is_unreadable(w)).map(|w| script(w.script.as_deref(), &w.transcription)), unreadable),
            clusters,
            are_told,
            normals: posed.iter().step_by(step).map(|p| facing(p.rotation)).collect(),
        }
    }

    /// Statistics of labels of photographs, whose sizes are known by name.
    pub fn of_labels(name: &str, images: &[LabelledImage], sizes: &HashMap<String, (u32, u32)>) -> Gathered {
        let regions = || images.iter().flat_map(|i| &i.regions);
        let read = || regions().filter(|r| !r.ignore && r.transcription != UNREADABLE);
        let unreadable = regions().count() - read().count();
        Gathered {
            name: name.into(),
            images: images.len(),
            words: regions().count(),
            unreadable,
            scenes: 0,
            aspect: mean_aspect(images.iter().filter_map(|i| sizes.get(&i.image).copied())),
            prior: Prior::of(images, sizes),
            visibility: None,
            scripts: scripts(read().map(|r| script(r.script.as_deref(), &r.transcription)), unreadable),
            clusters: Vec::new(),
            are_told: false,
            normals: Vec::new(),
        }
    }
}
