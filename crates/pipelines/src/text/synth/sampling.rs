//! Cameras of samples: by clusters of text poses in equal numbers, or like the photographs.

use super::super::camera::{self, Placed, Wanted};
use super::super::fnv;
use super::super::pose_clusters::{clusters, distance};
use super::prior::Prior;
use super::scene::{Member, SynthScene};
use super::validity::Fault;
use diorama_geom::glam::{DMat3, DQuat, DVec2, DVec3};
use diorama_geom::rng::Rng;
use diorama_geom::{Camera, Pose};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Attempts per sample; each draws one of rotation, place and area anew.
const ATTEMPTS: u64 = 32;
/// Largest angle by which a rotation differs from its member's, in degrees.
const PERTURBED: f64 = 5.0;
/// Rounds of attempts in a cluster before it is given up.
pub(super) const OWN_ROUNDS: u64 = 8;
/// Shares of it that are tried.
const SHARES: [f64; 4] = [1.0, 0.5, 0.25, 0.125];
/// Deviation of the place, over the picture, and of the logarithm of the area, of a camera like a photograph.
const JITTER: [f64; 2] = [0.05, 0.2];
/// Area ratios among which possible ones are told, and their number.
const AREAS: [f64; 2] = [1e-4, 1.0];
const AREA_STEPS: usize = 65;
/// Stream of random numbers of a sample, and those of the probes of a scene.
const SAMPLE: u64 = 81;
const PROBE: u64 = 82;
/// Seed of the clusters.
const CLUSTERING: u64 = 0;
/// Random numbers of an attempt.
const PER_ATTEMPT: u64 = 32;

/// How cameras are drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Sampling {
    /// All clusters of text poses in equal numbers, places and areas by the prior.
    Balanced,
    /// Like the photographs.
    Random,
}

/// A camera and the region that it is to show.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Drawn {
    pub region: usize,
    pub cluster: usize,
    pub pose: Pose,
}

/// Clusters of the text poses of all scenes.
pub struct Clustering {
    pub centers: Vec<DQuat>,
    /// Members of each cluster, by scene.
    members: Vec<Vec<Vec<Member>>>,
}

/// Why a cluster has no camera: how often each check failed first.
pub type Faults = BTreeMap<Fault, usize>;

impl Clustering {
    /// At most `k` clusters, which data sets of the same scenes number alike.
    pub fn new(scenes: &[Vec<Member>], k: usize) -> Clustering {
        let all: Vec<DQuat> = scenes.iter().flatten().map(|m| m.camera_from_region).collect();
        let found = clusters(&all, k, CLUSTERING);
        let mut of = found.of.iter();
        let sorted = |members: &Vec<Member>| {
            let mut out = vec![Vec::new(); found.centers.len()];
            members.iter().for_each(|m| out[*of.next().expect("one for each")].push(*m));
            out
        };
        let members = scenes.iter().map(sorted).collect();
        Clustering { centers: found.centers, members }
    }

    /// The cluster of a rotation.
    pub fn nearest(&self, rotation: &DMat3) -> usize {
        let q = DQuat::from_mat3(rotation);
        (0..self.centers.len()).min_by(|a, b| distance(q, self.centers[*a]).total_cmp(&distance(q, self.centers[*b]))).unwrap_or(0)
    }

    /// Rotations of a cluster: those of the scene, else those of all scenes.
    fn rotations(&self, scene: usize, cluster: usize) -> Vec<Member> {
        let own = &self.members[scene][cluster];
        if own.is_empty() { self.members.iter().flat_map(|s| s[cluster].clone()).collect() } else { own.clone() }
    }
}

/// What cameras are drawn from.
pub struct Draws<'a> {
    pub scene: &'a SynthScene,
    /// Its number among the scenes of the clustering.
    pub number: usize,
    pub clustering: &'a Clustering,
    pub prior: &'a Prior,
    pub camera: Camera,
    pub seed: u64,
}

/// Seed of a sample, by the data set's seed, the scene's name and the sample's number in the scene.
pub fn sample_seed(seed: u64, scene: &str, index: usize) -> u64 {
    fnv::hash(seed.to_le_bytes().into_iter().chain(scene.bytes()).chain((index as u64).to_le_bytes()))
}

/// A rotation turned by at most a share of [`PERTURBED`] about any axis.
fn perturbed(q: DQuat, share: f64, rng: &Rng, counter: u64) -> DMat3 {
    let v = |k: u64| rng.normal(counter + k) as f64;
    let axis = DVec3::new(v(0), v(1), v(2)).normalize_or(DVec3::X);
    let angle = share * PERTURBED.to_radians() * rng.uniform(counter + 3) as f64;
    DMat3::from_quat(DQuat::from_axis_angle(axis, angle) * q)
}

impl Draws<'_> {
    /// A valid camera of a cluster.
    ///
    /// # Errors
    /// With the checks that the attempts failed first.
    pub fn balanced(&self, cluster: usize, sample: u64) -> Result<Drawn, Faults> {
        let members = self.clustering.rotations(self.number, cluster);
        self.attempts(&Rng::new(sample, SAMPLE), |rng, [turn, place, area]| {
            let member = members[rng.below(turn, members.len() as u64) as usize];
            let region = match self.clustering.members[self.number][cluster].is_empty() {
                true => rng.below(turn + 8, self.scene.regions.len() as u64) as usize,
                false => member.region,
            };
            let [x, y] = self.prior.center(rng, place);
            // Turned less where it would leave its cluster.
            let turned = |share: f64| perturbed(member.camera_from_region, share, rng, turn + 2);
            let is_own = |r: &DMat3| self.clustering.nearest(r) == cluster;
            let rotation = SHARES.into_iter().map(turned).find(is_own).unwrap_or_else(|| turned(0.0));
            (region, self.wanted(rotation, [x, y], self.prior.area(rng, area)))
        })
    }

    /// A valid camera like a photograph's.
    ///
    /// # Errors
    /// As [`Draws::balanced`].
    pub fn random(&self, sample: u64) -> Result<Drawn, Faults> {
        let members = &self.scene.members;
        self.attempts(&Rng::new(sample, SAMPLE), |rng, [turn, place, area]| {
            let member = members[rng.below(turn, members.len() as u64) as usize];
            let [x, y] = member.center;
            let center = [x + JITTER[0] * rng.normal(place) as f64, y + JITTER[0] * rng.normal(place + 1) as f64];
            let ratio = member.area_ratio * (JITTER[1] * rng.normal(area) as f64).exp();
            (member.region, self.wanted(perturbed(member.camera_from_region, 1.0, rng, turn + 2), center, ratio))
        })
    }

    fn wanted(&self, camera_from_region: DMat3, center: [f64; 2], area_ratio: f64) -> Wanted {
        let center_px = DVec2::new(center[0] * self.camera.width as f64, center[1] * self.camera.height as f64);
        Wanted { center_px, camera_from_region, area_ratio }
    }

    /// Draws until a camera is valid; each attempt has counters of the random numbers of rotation, place and area.
    fn attempts(&self, rng: &Rng, draw: impl Fn(&Rng, [u64; 3]) -> (usize, Wanted)) -> Result<Drawn, Faults> {
        let mut faults = Faults::new();
        for attempt in 0..ATTEMPTS {
            // The rotation is drawn anew first, then the place, then the area.
            let at = |k: u64| PER_ATTEMPT * ((attempt + 2 - k) / 3) + 10 * k;
            let (region, wanted) = draw(rng, [at(0), at(1), at(2)]);
            match self.tried(region, &wanted) {
                Ok(pose) => {
                    let cluster = self.clustering.nearest(&wanted.camera_from_region);
                    return Ok(Drawn { region, cluster, pose });
                }
                Err(fault) => *faults.entry(fault).or_default() += 1,
            }
        }
        Err(faults)
    }

    fn tried(&self, region: usize, wanted: &Wanted) -> Result<Pose, Fault> {
        let region = &self.scene.regions[region];
        let placed: Placed = region.placed().ok_or(Fault::NoCamera)?;
        let pose = camera::solve(&self.camera, &placed, wanted).map_err(|_| Fault::NoCamera)?;
        self.scene.check(region, &self.camera, &pose).map(|()| pose)
    }

    /// The check that most attempts failed first; where size or distance is at fault, also the areas that can be, of a cluster or of any.
    pub fn why(&self, cluster: Option<usize>, faults: &Faults) -> String {
        let Some((fault, _)) = faults.iter().max_by_key(|(_, n)| **n) else { return String::new() };
        if !matches!(fault, Fault::Small | Fault::Distance | Fault::Outside) {
            return fault.to_string();
        }
        let clusters = cluster.map_or(0..self.clustering.centers.len(), |c| c..c + 1);
        let areas: Vec<f64> = clusters.flat_map(|c| self.areas(c)).collect();
        let (low, high) = areas.iter().fold((f64::INFINITY, 0.0f64), |(low, high), a| (low.min(*a), high.max(*a)));
        match areas.is_empty() {
            true => format!("{fault}; no share of the picture can be its area"),
            false => format!("{fault}; {:.2} % to {:.2} % of the picture can be its area", 100.0 * low, 100.0 * high),
        }
    }

    /// Those of [`AREAS`] at which size, place, angle and distance are valid for a member of a cluster, in the middle of the picture or where
    /// the photograph shows it.
    fn areas(&self, cluster: usize) -> Vec<f64> {
        let [low, high] = AREAS.map(f64::ln);
        let all = (0..AREA_STEPS).map(|k| (low + (high - low) * k as f64 / (AREA_STEPS - 1) as f64).exp());
        let members = self.clustering.rotations(self.number, cluster);
        let is_valid = |member: &Member, center: [f64; 2], area: f64| {
            let wanted = self.wanted(DMat3::from_quat(member.camera_from_region), center, area);
            let Some(region) = self.scene.regions.get(member.region) else { return false };
            let pose = region.placed().and_then(|placed| camera::solve(&self.camera, &placed, &wanted).ok());
            pose.is_some_and(|pose| self.scene.check_geometry(region, &self.camera, &pose).is_ok())
        };
        all.filter(|a| members.iter().any(|m| is_valid(m, [0.5; 2], *a) || is_valid(m, m.center, *a))).collect()
    }

    /// Clusters of which the scene has cameras, and why it has none of the others.
    pub fn feasible(&self) -> (Vec<usize>, Vec<(usize, Faults)>) {
        let (mut out, mut lacking) = (Vec::new(), Vec::new());
        for cluster in 0..self.clustering.centers.len() {
            let seed = sample_seed(self.seed ^ PROBE, &self.scene.name, cluster);
            let mut faults = Faults::new();
            let mut fails = |round: u64| {
                let failed = self.balanced(cluster, seed.wrapping_add(round)).err();
                let is_failed = failed.is_some();
                failed.into_iter().flatten().for_each(|(fault, n)| *faults.entry(fault).or_default() += n);
                is_failed
            };
            if (0..OWN_ROUNDS).all(&mut fails) {
                lacking.push((cluster, faults));
            } else {
                out.push(cluster);
            }
        }
        (out, lacking)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn seeds_differ_by_scene_and_number_and_turns_are_small() {
        let all = [sample_seed(1, "a", 0), sample_seed(1, "a", 1), sample_seed(1, "b", 0), sample_seed(2, "a", 0)];
        assert!((0..4).all(|i| (0..i).all(|j| all[i] != all[j])));
        assert_eq!(sample_seed(1, "a", 0), all[0]);
        let rng = Rng::new(1, 1);
        let q = DQuat::from_rotation_y(0.4);
        for k in 0..200 {
            let angle = super::super::super::placed::angle_between(&DMat3::from_quat(q), &perturbed(q, 1.0, &rng, 8 * k)).to_degrees();
            assert!(angle <= PERTURBED + 1e-9);
        }
    }

    #[test]
    fn rotations_of_a_scene_come_first_and_its_cluster_is_the_nearest() {
        let member =
            |angle: f64| Member { region: 0, camera_from_region: DQuat::from_rotation_y(angle), center: [0.5; 2], area_ratio: 0.1 };
        let scenes = [vec![member(0.0), member(0.02)], vec![member(0.01), member(1.0), member(1.02)]];
        let c = Clustering::new(&scenes, 2);
        assert_eq!(c.centers.len(), 2);
        let [front, side] = [0.0, 1.0].map(|a| c.nearest(&DMat3::from_rotation_y(a)));
        assert_ne!(front, side);
        assert_eq!(c.rotations(0, front).len(), 2);
        assert_eq!(c.rotations(0, side).len(), 2, "those of the other scene");
    }
}
