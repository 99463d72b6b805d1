//! Number of training views that see the places where held-out rays end. Errors are large where few do.

use super::held_out::spread;
use super::model::ObjectModel;
use super::scored_view::{ScoredView, admits};
use diorama_engine::metrics;
use diorama_engine::renderers::volume::Quality;
use diorama_geom::glam::DVec3;
use diorama_geom::{Camera, Image, ImageU8, Pose, Reduction};
use rayon::prelude::*;
use serde::Serialize;

/// Most training views that are asked, and pixels along the shorter side of their pictures of distances.
const VIEWS: usize = 200;
const VIEW_PX: u32 = 96;
/// A point this much farther than the surface in its pixel, as a share of the distance, still counts as seen.
const SLACK: f64 = 0.1;
/// Places that so many training views see are well explained.
const MANY: usize = 4;
/// Fewest views that tell a distance.
const STEREO: usize = 2;
/// Colors of places that no, one, two, three, and [`MANY`] or more training views see; and of rays that end nowhere, or do not count.
const COLORS: [[u8; 3]; MANY + 1] = [[90, 0, 110], [200, 30, 40], [240, 140, 30], [250, 220, 90], [60, 150, 90]];
const NOWHERE: [u8; 3] = [40, 40, 40];
/// Training views that are named beside a held-out one.
const NAMED: usize = 3;

/// A training view's camera, and the distances of the surfaces that it shows, in the world.
struct Sight {
    frame: usize,
    camera: Camera,
    camera_from_world: Pose,
    /// Infinite where its rays end nowhere.
    distance: Vec<f64>,
}

impl Sight {
    fn new(frame: usize, camera: Camera, world_from_camera: &Pose, distance: Vec<f64>) -> Sight {
        Sight { frame, camera, camera_from_world: world_from_camera.inverse(), distance }
    }

    fn sees(&self, p_in_world: DVec3) -> bool {
        let q = self.camera_from_world.point(p_in_world);
        let Some(px) = self.camera.project(q) else { return false };
        let (w, h) = (self.camera.width as f64, self.camera.height as f64);
        if !((0.0..w).contains(&px.x) && (0.0..h).contains(&px.y)) {
            return false;
        }
        // Far beside the axis a lens's polynomial may turn back into the picture.
        let is_there = self.camera.direction(px.x, px.y).dot(q / q.length().max(1e-300)) > 0.999;
        is_there && q.length() <= self.distance[px.y as usize * self.camera.width as usize + px.x as usize] * (1.0 + SLACK)
    }
}

/// What one training view alone, or with one other, explains of a held-out view.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Source {
    pub name: String,
    /// Share of the held-out view's light.
    pub share: f64,
}

/// How many training views see what a held-out view shows.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SeenBy {
    pub name: String,
    /// Shares of the light from places that no, one, two, three, and four or more training views see.
    pub shares: [f64; MANY + 1],
    /// Mean squared error of the pixels in each class; none where a class is empty.
    pub errors: [Option<f64>; MANY + 1],
    /// PSNR (dB) over the pixels whose rays end on surfaces that two or more training views see; none where there are none.
    pub psnr_where_seen: Option<f64>,
    /// The training views that see most of what at most two of them see.
    pub sources: Vec<Source>,
}

/// All training views' sights.
pub struct Sights(Vec<Sight>);

impl Sights {
    /// Draws the training views; `progress` receives (done, of).
    pub fn of(model: &ObjectModel, progress: &mut dyn FnMut(usize, usize)) -> Sights {
        let frames = spread(&model.train, VIEWS);
        let tracer = model.tracer(Quality::Fast);
        let unit = 1.0 / model.model_from_world.scale;
        let all = frames.len();
        let sight = |(done, i): (usize, usize)| {
            progress(done, all);
            let f = &model.capture.frames[i];
            let camera = f.camera.reduced(Reduction::ShortestSide(VIEW_PX));
            let view = tracer.view(&model.to_model(camera, &f.world_from_camera), &mut |_| {});
            let ends = view.depth.data.iter().zip(&view.opacity.data);
            let distance = ends.map(|(d, o)| if *o > 0.5 { *d as f64 * unit } else { f64::INFINITY }).collect();
            Sight::new(i, camera, &f.world_from_camera, distance)
        };
        Sights(frames.into_iter().enumerate().map(sight).collect())
    }

    /// Training views that were asked.
    pub fn len(&self) -> usize {
        self.0.len()
    }

    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Sights other than frame `own` that see a point.
    fn seeing(&self, p_in_world: DVec3, own: usize) -> Vec<&Sight> {
        self.0.iter().filter(|s| s.frame != own && s.sees(p_in_world)).collect()
    }

    /// Who sees what frame `frame` shows, and a map of how many do.
    pub fn explain(&self, model: &ObjectModel, frame: usize, scored: &ScoredView) -> (SeenBy, ImageU8) {
        let f = &model.capture.frames[frame];
        let unit = 1.0 / model.model_from_world.scale;
        let view = &scored.view;
        let (w, h) = (view.rgb.width, view.rgb.height);
        let (sx, sy) = (f.camera.width as f64 / w as f64, f.camera.height as f64 / h as f64);
        let counts = admits(&scored.counts);
        // None where the ray ends nowhere, or the pixel does not count.
        let seeing = |i: usize| {
            let (x, y) = (i % w, i / w);
            (view.opacity.data[i] > 0.5 && counts(x, y)).then(|| {
                let direction = f.camera.direction((x as f64 + 0.5) * sx, (y as f64 + 0.5) * sy);
                self.seeing(f.world_from_camera.point(direction * (view.depth.data[i] as f64 * unit)), frame)
            })
        };
        let all: Vec<Option<Vec<&Sight>>> = (0..w * h).into_par_iter().map(seeing).collect();
        let mut tally = Tally::default();
        let mut map = ImageU8 { width: w, height: h, channels: 3, data: Vec::with_capacity(w * h * 3) };
        for (i, seeing) in all.iter().enumerate() {
            let Some(seeing) = seeing else {
                map.data.extend(NOWHERE);
                continue;
            };
            map.data.extend(COLORS[seeing.len().min(MANY)]);
            tally.add(seeing, view.opacity.data[i] as f64, squared_error(&view.rgb, &scored.photo, i));
        }
        (tally.summarize(&f.name, |i| model.capture.frames[i].name.clone()), map)
    }
}

fn squared_error(a: &Image, b: &Image, pixel: usize) -> f64 {
    let at = pixel * 3..pixel * 3 + 3;
    a.data[at.clone()].iter().zip(&b.data[at]).map(|(a, b)| ((a.clamp(0.0, 1.0) - b) as f64).powi(2)).sum::<f64>() / 3.0
}

/// Sums over a view's pixels.
#[derive(Default)]
struct Tally {
    light: [f64; MANY + 1],
    errors: [f64; MANY + 1],
    pixels: [usize; MANY + 1],
    /// Frame and light of what at most two views see.
    of_few: Vec<(usize, f64)>,
}

impl Tally {
    fn add(&mut self, seeing: &[&Sight], light: f64, error: f64) {
        let class = seeing.len().min(MANY);
        self.light[class] += light;
        self.errors[class] += error;
        self.pixels[class] += 1;
        for s in seeing.iter().filter(|_| seeing.len() <= STEREO) {
            match self.of_few.iter_mut().find(|(frame, _)| *frame == s.frame) {
                Some((_, sum)) => *sum += light,
                None => self.of_few.push((s.frame, light)),
            }
        }
    }

    fn summarize(mut self, name: &str, name_of: impl Fn(usize) -> String) -> SeenBy {
        let all = self.light.iter().sum::<f64>().max(1e-300);
        self.of_few.sort_by(|a, b| b.1.total_cmp(&a.1));
        let sources = self.of_few.iter().take(NAMED).map(|(frame, light)| Source { name: name_of(*frame), share: light / all }).collect();
        let (pixels, error) = (self.pixels[STEREO..].iter().sum::<usize>(), self.errors[STEREO..].iter().sum::<f64>());
        SeenBy {
            name: name.into(),
            psnr_where_seen: (pixels > 0).then(|| metrics::psnr(error / pixels as f64)),
            shares: self.light.map(|l| l / all),
            errors: std::array::from_fn(|k| (self.pixels[k] > 0).then(|| self.errors[k] / self.pixels[k] as f64)),
            sources,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A camera four away from the origin along y, turned about z, that looks at a wall through the origin.
    fn sight(frame: usize, turn: f64, distance: f64) -> Sight {
        let eye = DVec3::new(4.0 * turn.sin(), -4.0 * turn.cos(), 0.0);
        let camera = Camera::pinhole(24, 24, 0.8);
        Sight::new(frame, camera, &Pose::look_at(eye, DVec3::ZERO, DVec3::Z), vec![distance; 24 * 24])
    }

    #[test]
    fn a_point_is_seen_where_it_is_in_the_picture_and_nothing_stands_before_it() {
        let s = sight(0, 0.0, 4.0);
        for (p, seen, why) in [
            (DVec3::ZERO, true, "on the surface"),
            (DVec3::new(0.0, 0.3, 0.0), true, "within the slack behind it"),
            (DVec3::new(0.0, -2.0, 0.0), true, "before it"),
            (DVec3::new(0.0, 1.0, 0.0), false, "behind it"),
            (DVec3::new(3.0, 0.0, 0.0), false, "beside the picture"),
            (DVec3::new(0.0, -9.0, 0.0), false, "behind the camera"),
        ] {
            assert_eq!(s.sees(p), seen, "{why}");
        }
    }

    #[test]
    fn what_few_views_see_is_told_with_its_views() {
        let sights = Sights(vec![sight(3, 0.0, 4.0), sight(5, 1.0, 4.0), sight(8, 2.0, 1.0)]);
        let mut tally = Tally::default();
        for (p, error) in [(DVec3::ZERO, 0.1), (DVec3::ZERO, 0.3), (DVec3::new(9.0, 9.0, 9.0), 0.5), (DVec3::new(0.0, -3.0, 0.0), 0.7)] {
            tally.add(&sights.seeing(p, 9), 1.0, error);
        }
        assert!(sights.seeing(DVec3::ZERO, 3).iter().all(|s| s.frame != 3), "a training view does not vouch for itself");
        let summary = tally.summarize("held out", |i| format!("view {i}"));
        assert_eq!(summary.shares, [0.25, 0.25, 0.5, 0.0, 0.0]);
        assert_eq!(summary.errors.map(|e| e.map(|e| (e * 10.0).round())), [Some(5.0), Some(7.0), Some(2.0), None, None]);
        assert!((summary.psnr_where_seen.unwrap() - 6.9897).abs() < 1e-3, "{:?} of 0.1 and 0.3", summary.psnr_where_seen);
        let mut of_one = Tally::default();
        of_one.add(&sights.seeing(DVec3::new(0.0, -3.0, 0.0), 9), 1.0, 0.7);
        assert_eq!(of_one.summarize("held out", |i| i.to_string()).psnr_where_seen, None);
        let sources: Vec<(&str, f64)> = summary.sources.iter().map(|s| (&s.name[..], s.share)).collect();
        assert_eq!(sources, [("view 3", 0.75), ("view 5", 0.5)], "the third camera has something before it");
    }
}
