//! One scene: a place with painted boards, its photographs and what is exact of them.

use super::super::lettering::{Face, Fonts};
use super::super::regions::{self, Region};
use super::super::truth::{Shown, Truth, ViewTruth, file, rows};
use super::{CAPTURE, HELD_OUT, PAINT, SceneOptions, pictures};
use crate::error::Result;
use diorama_data::text_labels::{self, Kind, LabelledImage, LabelledRegion, UNREADABLE};
use diorama_data::{DataError, atomic, error, photo, transforms_json};
use diorama_geom::capture::{Capture, Frame, SceneBox, Split};
use diorama_geom::color::{luminance, srgb_from_linear};
use diorama_geom::daylight::Daylight;
use diorama_geom::glam::DVec3;
use diorama_geom::rng::Rng;
use diorama_geom::{Camera, Image, ImageU8, Pose};
use diorama_kernels::ops::denoise;
use diorama_kernels::ops::path_trace::{Film, FirstHit, Scene, Settings, View, cpu};
use diorama_scenes::signs::Stage;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

/// Visibility below which a region is not listed, and below which nobody is to read it.
const LEAST_VISIBLE: f64 = 0.1;
const READABLE: f64 = 0.5;
/// Length of the shortest side in pixels below which nobody is to read it.
const READABLE_PX: f64 = 8.0;
/// Views, their size and samples, by which the exposure is metered, and by which the scene's cube is chosen.
const METERED: usize = 4;
const METERED_SIZE: (u32, u32) = (48, 36);
const METERED_SAMPLES: u32 = 16;
/// Luminance of all photographs that the share of pixels exceeds.
const BRIGHT: f64 = 0.7;
const BRIGHTER: f64 = 0.07;
/// Bounces of light.
const BOUNCES: u32 = 6;
/// Rays of a pixel along an axis that tell its ink.
const FOOTPRINT: usize = 3;
/// Amplitude in stops of the exposure's drift along the walk.
const DRIFT: f64 = 0.15;
const LIMIT: u64 = 1 << 26;

/// A place with painted boards.
pub struct Staged {
    stage: Stage,
    seed: u64,
    scene: Scene,
    /// Ink of each board.
    inks: Vec<ImageU8>,
    /// The board of each instance of the model.
    board_of: Vec<Option<usize>>,
    regions: Vec<Region>,
    fonts: Vec<String>,
}

impl Staged {
    /// A place whose boards have at most so many words each.
    ///
    /// # Errors
    /// When a font cannot draw a word.
    pub fn new(stage: Stage, (seed, words): (u64, usize), fonts: &mut Fonts, faces: &[Face]) -> Result<Staged> {
        let (mut painted_boards, mut inks, mut regions, mut used) = (Vec::new(), Vec::new(), Vec::<Region>::new(), Vec::new());
        for (k, board) in stage.boards.iter().enumerate() {
            let rng = Rng::new(seed, PAINT + 1 + k as u64);
            let painted = pictures::paint(board, (k, regions.len(), words), fonts, faces, &rng)?;
            painted_boards.push(painted.picture);
            inks.push(painted.ink);
            regions.extend(painted.regions);
            used.push(painted.font);
        }
        let model = stage.model(&painted_boards);
        let board = |name: &str| name.strip_prefix("board.")?.strip_suffix(".front")?.parse().ok();
        let board_of = model.instances.iter().map(|i| board(&model.parts[i.part].name)).collect();
        let light = stage.light();
        let mut scene = Scene::new(&model, &light);
        let light = exposed(&scene, light, &stage.cameras(METERED, METERED_SIZE.0, METERED_SIZE.1));
        scene.set_light(&light);
        Ok(Staged { stage, seed, scene, inks, board_of, regions, fonts: used })
    }

    /// Number of text regions.
    pub fn regions(&self) -> usize {
        self.regions.len()
    }

    /// Photographs the place into a folder; returns how many photographs it has, fewer than asked for after an interrupt.
    ///
    /// # Errors
    /// When a file cannot be written.
    pub fn photograph(&self, folder: &Path, o: &SceneOptions, stop: &AtomicBool, progress: &mut dyn FnMut(f64)) -> Result<usize> {
        for sub in ["images", "truth"] {
            let sub = folder.join(sub);
            std::fs::create_dir_all(&sub).map_err(DataError::io(&sub, "create"))?;
        }
        let cameras = self.stage.cameras(o.views, o.size.0, o.size.1);
        let held_out = held_out(o.views);
        let mut views = Vec::new();
        for (v, (camera, pose)) in cameras.iter().enumerate() {
            if stop.load(Ordering::Relaxed) {
                return Ok(v);
            }
            let done = file(folder, &format!("{v:03}.json"));
            // Written last for a view, so that what an interrupt left half done is made anew.
            let view = if done.exists() {
                let bytes = error::read(&done, LIMIT)?;
                serde_json::from_slice(&bytes).map_err(|e| DataError::input(&done, format!("{e}; remove it to make the view anew")))?
            } else {
                let view = self.view((v, held_out[v]), camera, pose, o, folder)?;
                atomic::write(&done, &serde_json::to_vec(&view).expect("plain values"))?;
                view
            };
            views.push(view);
            progress((v + 1) as f64 / o.views as f64);
        }
        self.finish(folder, views, &cameras, o)?;
        Ok(o.views)
    }

    /// One photograph and what is exact of it.
    fn view(&self, (v, is_held_out): (usize, bool), camera: &Camera, pose: &Pose, o: &SceneOptions, folder: &Path) -> Result<ViewTruth> {
        let (name, view) = (format!("{v:03}"), View { camera: *camera, world_from_camera: *pose, lens: None });
        let mut film = Film::new(camera);
        let settings = Settings { seed: self.seed.wrapping_mul(100_003) + v as u64, bounces: BOUNCES, ..Settings::default() };
        cpu::render(&self.scene, &view, &settings, o.samples, &mut film);
        denoise::cpu::run(&mut film);
        let exposure = drift(&Rng::new(self.seed, PAINT - 1), v as f64 / o.views as f64);
        let gain = exposure.exp2() as f32;
        let srgb = film.image(|p| p.color.map(|v| srgb_from_linear((gain * v).clamp(0.0, 1.0))));
        photo::save_png(&folder.join("images").join(format!("{name}.png")), &srgb.to_u8())?;
        let layers = self.layers(&view);
        photo::save_png(&file(folder, &format!("{name}_classes.png")), &layers.classes)?;
        photo::save_png(&file(folder, &format!("{name}_ink.png")), &layers.ink)?;
        photo::save_exr(&file(folder, &format!("{name}_depth.exr")), &layers.depth)?;
        let shown = self.regions.iter().filter_map(|r| self.shown(r, camera, pose)).collect();
        Ok(ViewTruth { name, held_out: is_held_out, exposure, regions: shown })
    }

    /// A region in a view; none where less than [`LEAST_VISIBLE`] of it is visible.
    fn shown(&self, region: &Region, camera: &Camera, pose: &Pose) -> Option<Shown> {
        let board = &self.stage.boards[region.board];
        let quad = regions::quad(board, &region.rect, camera, pose)?;
        let visibility = regions::visibility(&self.scene, board, &region.rect, camera, pose);
        let characters = region.characters.iter().map(|c| regions::quad(board, &c.rect, camera, pose)).collect();
        let shown = Shown {
            id: region.id,
            quad,
            polygon: regions::polygon(board, &region.rect, camera, pose)?,
            characters,
            visibility,
            text_pose: rows(&regions::text_pose(board, &region.rect, pose)),
            size: region.rect.size().to_array(),
        };
        (visibility >= LEAST_VISIBLE).then_some(shown)
    }

    /// Classes, ink and depth of a view.
    fn layers(&self, view: &View) -> Layers {
        let (w, h, n) = (view.camera.width as usize, view.camera.height as usize, FOOTPRINT);
        let fine = View { camera: view.camera.resized((n * w) as u32, (n * h) as u32), ..*view };
        let hits = cpu::first_hits(&self.scene, &fine, true);
        let at = |i: usize, k: usize| hits[(n * (i / w) + k / n) * n * w + n * (i % w) + k % n];
        let middle = |i: usize| at(i, n * n / 2);
        let class = |i: usize| middle(i).and_then(|h| self.region_at(&h)).map_or(0, |id| id as u8 + 1);
        let ink = |i: usize| {
            let inked: f64 = (0..n * n).filter_map(|k| at(i, k)).map(|h| self.ink_at(&h)).sum();
            (255.0 * inked / (n * n) as f64).round() as u8
        };
        let depth = |i: usize| middle(i).map_or([0.0; 3], |h| [h.depth as f32, 1.0, 0.0]);
        let gray = |data: Vec<u8>| ImageU8 { width: w, height: h, channels: 1, data };
        Layers {
            classes: gray((0..w * h).map(class).collect()),
            ink: gray((0..w * h).map(ink).collect()),
            depth: Image { width: w, height: h, channels: 3, data: (0..w * h).flat_map(depth).collect() },
        }
    }

    /// The region at which a ray ends.
    fn region_at(&self, hit: &FirstHit) -> Option<usize> {
        let k = self.board_of[hit.instance as usize]?;
        let at = self.stage.boards[k].locate(hit.position);
        self.regions.iter().find(|r| r.board == k && r.rect.contains(at)).map(|r| r.id)
    }

    /// Share of ink where a ray ends.
    fn ink_at(&self, hit: &FirstHit) -> f64 {
        let Some(k) = self.board_of[hit.instance as usize] else { return 0.0 };
        let (board, ink) = (&self.stage.boards[k], &self.inks[k]);
        let at = board.locate(hit.position) / board.size;
        let x = ((at.x + 0.5) * ink.width as f64).clamp(0.0, ink.width as f64 - 1.0) as usize;
        let y = ((0.5 - at.y) * ink.height as f64).clamp(0.0, ink.height as f64 - 1.0) as usize;
        ink.data[y * ink.width + x] as f64 / 255.0
    }

    /// Labels of all views in the truth and of some beside the photographs, and the capture, which says that the scene is complete.
    fn finish(&self, folder: &Path, views: Vec<ViewTruth>, cameras: &[(Camera, Pose)], o: &SceneOptions) -> Result<()> {
        let all: Vec<LabelledImage> = views.iter().map(|v| self.labels(v, READABLE_PX, o)).collect();
        text_labels::save(&file(folder, "labels.jsonl"), &all)?;
        let chosen = labelled(&views, o.labelled);
        let some: Vec<LabelledImage> = chosen.iter().map(|v| self.labels(&views[*v], 0.0, o)).collect();
        text_labels::save(&folder.join("labels.jsonl"), &some)?;
        let frame = |(view, (camera, pose)): (&ViewTruth, &(Camera, Pose))| {
            let mut frame = Frame::new(view.name.clone(), folder.join(format!("images/{}.png", view.name)), *camera, *pose);
            frame.split = if view.held_out { Split::Test } else { Split::Train };
            frame
        };
        let frames: Vec<Frame> = views.iter().zip(cameras).map(frame).collect();
        let family = self.stage.family.name().to_string();
        Truth { family, seed: self.seed, fonts: self.fonts.clone(), regions: self.regions.clone(), views }.save(folder)?;
        let mut seen: Vec<DVec3> = Vec::new();
        for (camera, pose) in cameras {
            let view = View { camera: camera.resized(METERED_SIZE.0, METERED_SIZE.1), world_from_camera: *pose, lens: None };
            seen.extend(cpu::first_hits(&self.scene, &view, true).into_iter().flatten().map(|h| h.position));
        }
        let eyes: Vec<DVec3> = cameras.iter().map(|(_, pose)| pose.translation).collect();
        let capture = Capture::new(frames, SceneBox::holding(&eyes, &seen));
        Ok(transforms_json::write(&folder.join(CAPTURE), folder, &capture, None)?)
    }

    /// Labels of a view, with outlines that end with the photograph; shorter sides than `readable_px` are not to be read.
    fn labels(&self, view: &ViewTruth, readable_px: f64, o: &SceneOptions) -> LabelledImage {
        let size = [o.size.0, o.size.1].map(f64::from);
        let label = |shown: &Shown| {
            let region = &self.regions[shown.id];
            let polygon = regions::clipped(&shown.polygon, size);
            let ignore = shown.visibility < READABLE || regions::shortest_side(&shown.quad) < readable_px;
            (polygon.len() > 2).then(|| LabelledRegion {
                id: shown.id as u32,
                polygon,
                transcription: if ignore { UNREADABLE.into() } else { region.transcription.clone() },
                script: Some(region.script.clone()),
                kind: Kind::Text,
                ignore,
            })
        };
        LabelledImage { image: format!("images/{}.png", view.name), regions: view.regions.iter().filter_map(label).collect() }
    }
}

/// What is exact of each pixel.
struct Layers {
    classes: ImageU8,
    ink: ImageU8,
    /// Distance along the ray, and whether it meets a surface.
    depth: Image,
}

/// The light scaled such that [`BRIGHTER`] of the metered pixels are brighter than [`BRIGHT`].
fn exposed(scene: &Scene, light: Daylight, cameras: &[(Camera, Pose)]) -> Daylight {
    let mut values = Vec::new();
    for (camera, pose) in cameras {
        let mut film = Film::new(camera);
        let view = View { camera: *camera, world_from_camera: *pose, lens: None };
        cpu::render(scene, &view, &Settings { bounces: BOUNCES, ..Settings::default() }, METERED_SAMPLES, &mut film);
        denoise::cpu::run(&mut film);
        let pixels = film.image(|p| [p.color[0], p.color[1], p.color[2], p.opacity]);
        let surfaces = pixels.data.as_chunks::<4>().0.iter().filter(|p| p[3] > 0.5);
        values.extend(surfaces.map(|p| luminance([p[0], p[1], p[2]].map(f64::from))));
    }
    values.sort_by(f64::total_cmp);
    let at = ((1.0 - BRIGHTER) * values.len().saturating_sub(1) as f64) as usize;
    let bright = values.get(at).copied().filter(|v| *v > 0.0).unwrap_or(BRIGHT);
    light.turned(0.0, BRIGHT / bright)
}

/// Exposure in stops at a share of the walk: two slow waves.
fn drift(rng: &Rng, share: f64) -> f64 {
    let wave = |k: u64, turns: f64| (std::f64::consts::TAU * (turns * share + rng.uniform(k) as f64)).sin();
    DRIFT * (0.7 * wave(0, 1.0) + 0.3 * wave(1, 3.0))
}

/// Which views are held out, evenly spaced.
pub fn held_out(views: usize) -> Vec<bool> {
    let n = ((HELD_OUT * views as f64).round() as usize).max(1);
    let mut out = vec![false; views];
    (0..n).for_each(|k| out[((k as f64 + 0.5) * views as f64 / n as f64) as usize] = true);
    out
}

/// `n` views of training to label: each the one that shows most of what those before did not.
fn labelled(views: &[ViewTruth], n: usize) -> Vec<usize> {
    let worth = |shown: &Shown, times: usize| {
        let readable = if shown.visibility >= READABLE { shown.visibility } else { 0.0 };
        readable * regions::shortest_side(&shown.quad).sqrt() / (1.0 + 3.0 * times as f64)
    };
    let mut chosen: Vec<usize> = Vec::new();
    while chosen.len() < n {
        let times = |id: usize| chosen.iter().filter(|v| views[**v].regions.iter().any(|s| s.id == id && s.visibility >= READABLE)).count();
        let value = |v: &usize| views[*v].regions.iter().map(|s| worth(s, times(s.id))).sum::<f64>();
        let left = (0..views.len()).filter(|v| !views[*v].held_out && !chosen.contains(v));
        let Some(best) = left.max_by(|a, b| value(a).total_cmp(&value(b))) else { break };
        chosen.push(best);
    }
    chosen.sort_unstable();
    chosen
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fifteen_in_a_hundred_views_are_held_out_evenly() {
        for (views, expected) in [(14, 2), (60, 9), (8, 1)] {
            let out = held_out(views);
            assert_eq!(out.iter().filter(|v| **v).count(), expected);
            let at: Vec<usize> = (0..views).filter(|v| out[*v]).collect();
            assert!(at.windows(2).all(|w| w[1] - w[0] >= views / expected - 1 && w[1] - w[0] <= views / expected + 1));
        }
    }

    #[test]
    fn labelled_views_show_different_regions_and_are_not_held_out() {
        let quad = [[0.0, 0.0], [40.0, 0.0], [40.0, 10.0], [0.0, 10.0]];
        let shown = |id: usize, visibility: f64| Shown {
            id,
            quad,
            polygon: quad.to_vec(),
            characters: Vec::new(),
            visibility,
            text_pose: [[0.0; 4]; 3],
            size: [1.0, 0.25],
        };
        let view = |held_out: bool, regions: Vec<Shown>| ViewTruth { name: String::new(), held_out, exposure: 0.0, regions };
        let views = [
            view(false, vec![shown(0, 1.0), shown(1, 1.0)]),
            view(true, vec![shown(0, 1.0), shown(1, 1.0), shown(2, 1.0)]),
            view(false, vec![shown(0, 1.0), shown(1, 0.9)]),
            view(false, vec![shown(2, 0.8), shown(0, 0.4)]),
        ];
        assert_eq!(labelled(&views, 2), [0, 3]);
        assert_eq!(labelled(&views, 9), [0, 2, 3]);
    }
}
