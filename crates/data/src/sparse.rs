//! The points of a structure-from-motion model: which photographs see them, and whether they agree with the poses.

use crate::colmap_model::{self, Keypoint, Registered};
use crate::error::Result;
use diorama_geom::capture::{Agreement, Frame, FrameAgreement};
use diorama_geom::glam::DVec2;
use diorama_geom::{Camera, Pose, SparsePoint};
use std::collections::HashMap;
use std::path::Path;

/// Most observations per photograph that are compared with its pose.
const COMPARED: usize = 500;
/// Errors above this share of the diagonal and this many pixels are reported.
const INEXACT: (f64, f64) = (0.003, 3.0);
/// A photograph does not fit the others if its mean error is this many times the median.
const OUTLIER: f64 = 4.0;
/// Most names listed in one note.
const NAMED: usize = 5;

/// A point in a photograph: where the pose projects it, and where it was observed.
struct Sample {
    image: u32,
    /// `None` if the point is behind the camera.
    projected: Option<DVec2>,
    seen: DVec2,
}

/// Points of a model, collected image by image.
pub(crate) struct Sparse {
    index: HashMap<u64, u32>,
    /// Frame numbers are ids of registered images until [`Sparse::finish`].
    points: Vec<SparsePoint>,
    samples: Vec<Sample>,
    observations: usize,
    absent: usize,
    images: u32,
}

impl Sparse {
    /// Starts with the model's points, without observations.
    pub fn read(model: &Path) -> Result<Sparse> {
        let mut out = Sparse { index: HashMap::new(), points: Vec::new(), samples: Vec::new(), observations: 0, absent: 0, images: 0 };
        colmap_model::each_point(model, &mut |p, _| {
            out.index.insert(p.id, out.points.len() as u32);
            out.points.push(SparsePoint { position: p.position, color: p.rgb, error: p.error.max(0.0) as f32, frames: Vec::new() });
        })?;
        Ok(out)
    }

    /// Adds the observations of the next registered image.
    pub fn observe(&mut self, camera: Option<&Camera>, world_from_camera: &Pose, keypoints: &[Keypoint]) {
        let image = self.images;
        self.images += 1;
        if self.points.is_empty() {
            return;
        }
        let mut shown = Vec::new();
        for k in keypoints {
            let Some(id) = k.point else { continue };
            self.observations += 1;
            let Some(&at) = self.index.get(&id) else {
                self.absent += 1;
                continue;
            };
            let frames = &mut self.points[at as usize].frames;
            if frames.last() != Some(&image) {
                frames.push(image);
            }
            shown.push((at, k.px));
        }
        self.compare(image, camera, world_from_camera, &shown);
    }

    fn compare(&mut self, image: u32, camera: Option<&Camera>, world_from_camera: &Pose, shown: &[(u32, [f64; 2])]) {
        let Some(camera) = camera else { return };
        let camera_from_world = world_from_camera.inverse();
        for (at, px) in shown.iter().step_by(shown.len().div_ceil(COMPARED).max(1)) {
            let x = camera_from_world.point(self.points[*at as usize].position);
            let projected = camera.project(x).filter(|p| p.is_finite());
            self.samples.push(Sample { image, projected, seen: DVec2::from_array(*px) });
        }
    }

    /// If most observations refer to points that are not in the model, compares by the points' own tracks instead.
    pub fn check_tracks<'a>(
        &mut self,
        model: &Path,
        images: &[Registered],
        camera: impl Fn(&Registered) -> Option<&'a Camera>,
    ) -> Result<()> {
        if self.absent * 2 <= self.observations {
            return Ok(());
        }
        let number: HashMap<u32, u32> = images.iter().enumerate().map(|(n, i)| (i.id, n as u32)).collect();
        let mut shown: Vec<Vec<(u32, u32)>> = vec![Vec::new(); images.len()];
        let mut at = 0;
        colmap_model::each_point(model, &mut |_, track| {
            for (image, keypoint) in track {
                if let Some(n) = number.get(image) {
                    shown[*n as usize].push((at, *keypoint));
                }
            }
            at += 1;
        })?;
        self.points.iter_mut().for_each(|p| p.frames.clear());
        self.samples.clear();
        let mut n = 0;
        colmap_model::read_images(model, &mut |image, keypoints| {
            let at_hand = shown[n].iter().filter_map(|(p, k)| keypoints.get(*k as usize).map(|k| (*p, k.px)));
            let at_hand: Vec<(u32, [f64; 2])> = at_hand.collect();
            for (p, _) in &at_hand {
                let frames = &mut self.points[*p as usize].frames;
                if frames.last() != Some(&(n as u32)) {
                    frames.push(n as u32);
                }
            }
            self.compare(n as u32, camera(image), &image.world_from_camera, &at_hand);
            n += 1;
        })?;
        Ok(())
    }

    /// The points with the frames that see them, and how well they agree; `frame_of` maps registered images to frames.
    pub fn finish(mut self, frame_of: &[Option<u32>], frames: &[Frame]) -> (Vec<SparsePoint>, Option<Agreement>) {
        let mut shared = vec![0; frames.len()];
        for p in &mut self.points {
            let seen_by = p.frames.len();
            p.frames = p.frames.iter().filter_map(|i| frame_of[*i as usize]).collect();
            p.frames.sort_unstable();
            if seen_by > 1 {
                p.frames.iter().for_each(|f| shared[*f as usize] += 1);
            }
        }
        if self.observations == 0 || frames.is_empty() {
            return (self.points, None);
        }
        let diagonal_px = median(frames.iter().map(|f| (f.camera.width as f64).hypot(f.camera.height as f64))).unwrap_or(1.0);
        let scale = self.keypoint_scale(diagonal_px);
        let error = |s: &Sample| s.projected.map_or(diagonal_px, |p| (p - s.seen / scale).length());
        let mut per_frame = vec![(0.0, 0usize); frames.len()];
        for s in &self.samples {
            if let Some(f) = frame_of[s.image as usize] {
                let (sum, n) = &mut per_frame[f as usize];
                (*sum, *n) = (*sum + error(s), *n + 1);
            }
        }
        let mean = self.samples.iter().map(error).sum::<f64>() / self.samples.len().max(1) as f64;
        let frames = per_frame
            .into_iter()
            .zip(shared)
            .map(|((sum, n), shared)| FrameAgreement { error_px: (n > 0).then(|| sum / n as f64), shared })
            .collect();
        let error_px = median(self.samples.iter().map(error)).map(|m| (mean, m));
        let agreement = Agreement { observations: self.observations, absent: self.absent, error_px, diagonal_px, frames };
        (self.points, Some(agreement))
    }

    /// Ratio of keypoint coordinates to camera coordinates. It is not 1 if the cameras were scaled for photographs of another size.
    fn keypoint_scale(&self, diagonal_px: f64) -> f64 {
        let at = |scale: f64| {
            let error = |s: &Sample| s.projected.map_or(f64::INFINITY, |p| (p - s.seen / scale).length());
            median(self.samples.iter().map(error)).unwrap_or(0.0)
        };
        let plain = at(1.0);
        if plain < INEXACT.0 * diagonal_px {
            return 1.0;
        }
        // Ratios of positions close to the corner are unreliable.
        let inside = |p: &DVec2| p.min_element() > 0.1 * diagonal_px && p.max_element() < diagonal_px;
        let ratio = |s: &Sample| s.projected.filter(inside).map(|p| s.seen.length() / p.length());
        match median(self.samples.iter().filter_map(ratio)) {
            Some(r) if r > 0.01 && (r - 1.0).abs() > 0.02 && at(r) < 0.1 * plain && at(r) < INEXACT.0 * diagonal_px => r,
            _ => 1.0,
        }
    }
}

fn median(values: impl Iterator<Item = f64>) -> Option<f64> {
    let mut v: Vec<f64> = values.collect();
    if v.is_empty() {
        return None;
    }
    let middle = v.len() / 2;
    Some(*v.select_nth_unstable_by(middle, f64::total_cmp).1)
}

/// Message for a model whose poses contradict its points.
pub fn broken(a: &Agreement) -> String {
    let (_, middle) = a.error_px.unwrap_or_default();
    let mixed = match a.is_mixed() {
        true => format!(" ({} of {} observations are of points that are not in the model)", a.absent, a.observations),
        false => String::new(),
    };
    format!(
        "the model's poses contradict its points: half of the points lie {middle:.0} pixels or more from where the photographs show them{mixed}"
    )
}

/// Remedy for [`broken`] models.
pub const BROKEN_CURE: &str =
    "run `diorama prepare` on the photographs; or remove points3D.bin (or .txt) if the poses are known to be right";

/// Other image lists in a model's folder, one of which may be the right one. `None` if there are none or the folder cannot be listed,
/// since this is only a hint in an error message.
pub fn others_beside(model: &Path) -> Option<String> {
    let is_other = |n: &String| n.starts_with("images") && (n.ends_with(".bin") || n.ends_with(".txt")) && n.len() > "images.bin".len();
    let names = std::fs::read_dir(model).ok()?.flatten().map(|e| e.file_name().to_string_lossy().into_owned());
    let mut others: Vec<String> = names.filter(is_other).collect();
    others.sort();
    (!others.is_empty()).then(|| {
        format!(
            "{} is in the model's folder too: if it is the right one, rename it to replace the present list of images",
            others.join(", ")
        )
    })
}

/// Notes about a model, one line each; frames are in the capture's order.
pub fn warnings(a: &Agreement, frames: &[Frame]) -> Vec<String> {
    let mut out = Vec::new();
    if a.is_broken() {
        return vec![format!("{}; {BROKEN_CURE}", broken(a))];
    }
    if a.is_mixed() {
        let checked = match a.error_px {
            Some((mean, _)) => format!("by the points' own lists, poses and points are {mean:.1} pixels apart"),
            None => "poses and points could not be compared".into(),
        };
        out.push(format!(
            "{} of the model's {} observations are of points that are not in it (points were removed, or its files come from different reconstructions); {checked}",
            a.absent, a.observations
        ));
    }
    let limit = (INEXACT.0 * a.diagonal_px).max(INEXACT.1);
    let (_, middle) = a.error_px.unwrap_or_default();
    if middle > limit {
        out.push(format!(
            "the model's poses are inexact: half of its points lie {middle:.1} pixels or more from where the photographs show them; \
             run `diorama prepare` on the photographs, or train with --set camera.refine=true"
        ));
    }
    let list = |which: &[usize], describe: &dyn Fn(usize) -> String| {
        let shown: Vec<String> = which.iter().take(NAMED).map(|i| describe(*i)).collect();
        shown.join(", ") + if which.len() > NAMED { ", …" } else { "" }
    };
    let usual = median(a.frames.iter().filter_map(|f| f.error_px)).unwrap_or(0.0);
    let off = |f: &FrameAgreement| f.error_px.is_some_and(|e| e > limit.max(OUTLIER * usual));
    let wrong: Vec<usize> = (0..a.frames.len()).filter(|i| off(&a.frames[*i])).collect();
    if !wrong.is_empty() {
        let describe = |i: usize| format!("{} ({:.1} pixels)", frames[i].name, a.frames[i].error_px.unwrap_or(0.0));
        out.push(format!(
            "{} of {} photographs do not fit the model's points: {}; their poses may be wrong: leave them out, or run `diorama prepare`",
            wrong.len(),
            frames.len(),
            list(&wrong, &describe)
        ));
    }
    let alone: Vec<usize> = (0..a.frames.len()).filter(|i| a.frames[*i].shared == 0).collect();
    if !alone.is_empty() && a.error_px.is_some() {
        out.push(format!(
            "{} of {} photographs share no points with others: {}; nothing confirms their poses: leave them out, or run `diorama prepare`",
            alone.len(),
            frames.len(),
            list(&alone, &|i| frames[i].name.clone())
        ));
    }
    out
}

/// Updates the points after frames were left out; `kept` are the indices of the remaining frames, ascending. Points seen only by the
/// others are removed.
pub fn keep(points: &mut Vec<SparsePoint>, agreement: Option<&mut Agreement>, kept: &[usize]) {
    let number: HashMap<u32, u32> = kept.iter().enumerate().map(|(new, old)| (*old as u32, new as u32)).collect();
    points.retain_mut(|p| {
        let was_seen = !p.frames.is_empty();
        p.frames = p.frames.iter().filter_map(|f| number.get(f).copied()).collect();
        !was_seen || !p.frames.is_empty()
    });
    if let Some(a) = agreement {
        a.frames = kept.iter().filter_map(|i| a.frames.get(*i).copied()).collect();
    }
}
